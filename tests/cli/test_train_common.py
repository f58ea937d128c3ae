import pytest

from lcf3d.cli.train_common import held_out_of
from lcf3d.errors import ConfigError


@pytest.mark.parametrize(
    ("count", "asked", "held_out"), [(1000, None, 100), (501, None, 100), (50, None, 10), (2, None, 1), (50, 3, 3)]
)
def test_a_fifth_of_few_samples_is_held_out(count, asked, held_out):
    assert held_out_of(count, asked, 100) == held_out


@pytest.mark.parametrize(("count", "asked"), [(3, 3), (1, None)])
def test_something_must_be_left_to_learn_from(count, asked):
    with pytest.raises(ConfigError, match="too few to hold out"):
        held_out_of(count, asked, 100)
