import pytest

from lcf3d.fusion.config import FusionConfig
from lcf3d.run.joins import score_notes


@pytest.mark.parametrize("preset", ["default", "kitti", "nuscenes", "argoverse2"])
def test_scores_within_0_to_1_need_no_word(preset: str) -> None:
    assert score_notes(FusionConfig.preset(preset)) == ()


def test_scores_of_the_paper_may_exceed_1_and_the_run_says_so() -> None:
    (note,) = score_notes(FusionConfig.preset("paper"))
    assert "may exceed 1" in note
    assert "no probabilities" in note
