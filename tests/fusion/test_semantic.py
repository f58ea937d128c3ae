import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from lcf3d.fusion.semantic import fuse_scores, semantic_fusion

score = st.floats(0, 1)


def one(s3d, s2d, prior, method="probabilistic"):
    return fuse_scores(np.array([s3d]), np.array([s2d]), np.array([prior]), method)[0]


def test_product_is_the_printed_formula():
    assert one(0.6, 0.5, 0.25, "product") == pytest.approx(1.2)


def test_probabilistic_by_hand():
    # a = 0.8 * 0.7 / 0.5 = 1.12, b = 0.2 * 0.3 / 0.5 = 0.12
    assert one(0.8, 0.7, 0.5) == pytest.approx(1.12 / 1.24)
    # a rare class: the same evidence stands out more; a = 5.6, b = 0.06 / 0.9
    assert one(0.8, 0.7, 0.1) == pytest.approx(5.6 / (5.6 + 0.06 / 0.9))


def test_an_undecided_camera_changes_nothing():
    assert one(0.37, 0.5, 0.5) == pytest.approx(0.37)


@given(score, score, score, st.floats(0.01, 0.99))
def test_probabilistic_stays_in_bounds_and_grows_with_support(s3d, low, high, prior):
    low, high = min(low, high), max(low, high)
    assert 0 <= one(s3d, low, prior) <= one(s3d, high, prior) + 1e-12 <= 1 + 1e-12


def test_certain_branches_that_disagree_give_a_number():
    assert one(1.0, 0.0, 0.5) == pytest.approx(0.5)


def test_algorithm_1_line_by_line():
    # line 5: always the camera's label; line 7: ensemble where labels agree; line 9: else the camera's score
    scores, labels = semantic_fusion(
        np.array([0.8, 0.8]), np.array([0, 1]), np.array([0.7, 0.7]), np.array([0, 0]), np.array([0.5, 0.5])
    )
    assert labels.tolist() == [0, 0]
    assert scores[0] == pytest.approx(1.12 / 1.24)
    assert scores[1] == 0.7
