import json
from pathlib import Path

import numpy as np
import pytest

from lcf3d.decisions import Decisions
from lcf3d.errors import FormatError
from lcf3d.evaluation.kitti import KittiEvaluator, Selection
from lcf3d.evaluation.kitti_outcomes import fusion_outcomes, read_provenance, working_point
from lcf3d.evaluation.kitti_study import study
from lcf3d.geometry.boxes import lidar_from_kitti
from lcf3d.provenance import FusedDetections
from lcf3d.reasons import Outcome, Reason
from lcf3d.structures import Detections2D, Detections3D

from .kitti_frames import frames

CAMERA_FROM_LIDAR = np.array([[0, -1, 0, 0], [0, 0, -1, 0], [1, 0, 0, 0], [0, 0, 0, 1.0]])
MODERATE = Selection("Car", "3d", "moderate")


def car(x: float, **changes: object) -> dict[str, object]:
    """A car 20 m ahead and ``x`` metres to the right."""
    return {"location": (x, 1.5, 20), "box": (100 * x, 0, 100 * x + 90, 50), **changes}


def detections(rows: list[dict[str, object]]) -> Detections3D:
    objects = frames([rows], True)[0]
    boxes = lidar_from_kitti(objects.locations, objects.dimensions, objects.rotation_y, CAMERA_FROM_LIDAR)
    assert objects.scores is not None
    return Detections3D(boxes, objects.scores, np.zeros(len(rows)), ("Car",))


def fusion() -> tuple[list[dict[str, object]], list[dict[str, object]], FusedDetections]:
    """Five objects; the fusion confirms one, recovers one, reports a wrong box, drops one object and one wrong box."""
    truth = [car(0), car(5), car(10), car(15, occluded=3), car(20)]
    lidar = [car(0, score=0.9), car(10, score=0.8), car(-10, score=0.7), car(-20, score=0.6), car(15, score=0.5)]
    output = [car(0, score=0.95), car(-10, score=0.7), car(5, score=0.6)]
    table = Decisions.blank(5)
    table.outcome[:] = [Outcome.MATCHED, Outcome.DROPPED, Outcome.KEPT, Outcome.DROPPED, Outcome.DROPPED]
    table.reason[:] = [Reason.CONFIRMED, Reason.UNCONFIRMED, Reason.DOWNWEIGHTED, Reason.UNCONFIRMED, Reason.LOW_SCORE]
    table.output[:] = [0, -1, 1, -1, -1]
    camera = Decisions.blank(1)
    camera.outcome[:], camera.reason[:], camera.output[:] = Outcome.RECOVERED, Reason.LOCALIZED, 2
    camera.camera[:], camera.detection[:] = 0, 0
    seen = Detections2D([[500, 0, 590, 50]], [0.6], [0], ("Car",))
    fused = FusedDetections(detections(output), table, camera, detections(lidar), (seen,), ("left",))
    return truth, output, fused


def test_outcomes_at_a_threshold() -> None:
    truth, output, _ = fusion()
    evaluator = KittiEvaluator(frames([truth], False), frames([output], True))
    assert working_point(evaluator, MODERATE, 0.0).counts == {"true_positives": 2, "false_positives": 1, "misses": 2}
    assert working_point(evaluator, MODERATE, 0.8).counts == {"true_positives": 1, "false_positives": 0, "misses": 3}


def test_outcomes_split_by_what_the_fusion_did() -> None:
    truth, output, fused = fusion()
    evaluator = KittiEvaluator(frames([truth], False), frames([output], True))
    split = fusion_outcomes(evaluator, {"0": fused}, {"0": CAMERA_FROM_LIDAR}, MODERATE)
    # the best F1 is that of all three: 2 of 3 right, 2 of 4 found
    assert working_point(evaluator, MODERATE).threshold == 0.6
    assert split.true_positives == {"matched": 1, "recovered": 1}
    assert split.false_positives == {"downweighted": 1}
    assert split.dropped_wrongly == {"unconfirmed": 1}
    # the box on the object that does not count (too much occluded) is neither right nor wrong to drop
    assert split.dropped_rightly == {"unconfirmed": 1}
    assert split.misses == {"dropped": 1, "below_threshold": 0, "not_proposed": 1}
    assert json.loads(json.dumps(split.to_json()))["misses"]["dropped"] == 1


def test_a_line_that_the_writer_left_out_shifts_nothing() -> None:
    truth, output, fused = fusion()
    evaluator = KittiEvaluator(frames([truth], False), frames([output[1:]], True))
    split = fusion_outcomes(evaluator, {"0": fused}, {"0": CAMERA_FROM_LIDAR}, MODERATE)
    assert split.true_positives == {"recovered": 1}
    assert split.false_positives == {"downweighted": 1}


def test_frames_without_provenance_are_unknown() -> None:
    truth, output, _ = fusion()
    evaluator = KittiEvaluator(frames([truth], False), frames([output], True))
    split = fusion_outcomes(evaluator, {}, {}, MODERATE)
    assert split.true_positives == {"unknown": 2}
    assert split.dropped_wrongly == {}
    assert split.misses == {"dropped": 0, "below_threshold": 0, "not_proposed": 2}


def test_provenance_is_read_where_there_is_some(tmp_path: Path) -> None:
    assert read_provenance(tmp_path, ("0",)) == {}
    (tmp_path / "provenance").mkdir()
    (tmp_path / "provenance" / "0.json").write_text(json.dumps(fusion()[2].to_json()))
    read = read_provenance(tmp_path, ("0", "1"))
    assert list(read) == ["0"]
    assert len(read["0"].lidar) == 5
    (tmp_path / "provenance" / "1.json").write_text("{")
    with pytest.raises(FormatError, match=r"1\.json"):
        read_provenance(tmp_path, ("0", "1"))


def test_worst_frames_come_first() -> None:
    truth = [[car(0)], [car(0), car(5)], [car(0)]]
    results = [[car(0)], [car(10), car(20)], [car(30), car(0)]]
    evaluator = KittiEvaluator(frames(truth, False), frames(results, True))
    one = study(evaluator, "x", {}, {}, lambda _: CAMERA_FROM_LIDAR)
    assert [(f, one.wrong[f], one.missed[f]) for f in one.worst_frames(5)] == [(1, 2, 2), (2, 1, 0)]
    assert one.worst_frames(1) == [1]
