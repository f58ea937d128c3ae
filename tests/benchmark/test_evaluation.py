from lcf3d.benchmark.evaluation import made_up_frames
from lcf3d.evaluation.kitti import evaluate


def test_made_up_frames_are_worth_evaluating():
    truth, found = made_up_frames(60)
    assert len(truth) == len(found) == 60
    metrics = evaluate(truth, found)
    assert 5 < metrics.ap("Car", "bev", "moderate", "R40") < 99
