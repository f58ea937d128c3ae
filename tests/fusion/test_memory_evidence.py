"""What the past and the way things move are worth, by the shares that the formulas state."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from lcf3d.fusion.memory_evidence import motion_log_odds


@given(st.floats(0, 1), st.floats(0, 0.95))
def test_motion_is_the_ratio_of_how_often_objects_and_false_alarms_are_so(standing, doubt):
    stand = (1 + doubt) / 2
    expected = np.log(0.5 / (stand * standing + (1 - stand) * (1 - standing)))
    assert motion_log_odds(np.array([standing]), np.array([doubt])) == pytest.approx([expected])


def test_nothing_is_added_while_nothing_is_known_or_doubted():
    assert motion_log_odds(np.array([0.5, 1.0, 0.0]), np.array([0.6, 0.0, 0.0])).tolist() == [0, 0, 0]
