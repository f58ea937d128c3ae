import numpy as np
import pytest

from lcf3d.datasets.base import BaseDataset
from lcf3d.errors import DatasetError
from lcf3d.frame import Frame
from lcf3d.fusion.alignment import realigned
from lcf3d.geometry.camera import project_boxes
from lcf3d.run.alignment import aligned_frame, alignment_findings, describe, find_alignment
from lcf3d.structures import Detections2D, Detections3D
from tests.fusion.scenes import camera
from tests.fusion.test_alignment import NAMES, street


class Street(BaseDataset):
    """Frames of a camera at the origin; the real one is turned by some degrees, from ``knock`` on by others."""

    class_names, camera_names = NAMES, ("left",)

    def __init__(self, count, degrees, knock=None):
        self.ids = tuple(str(i) for i in range(count))
        self.degrees, self.knock = degrees, knock

    def frame(self, frame_id):
        return Frame(frame_id, cameras=[camera()])

    def boxes(self, frame):
        return street(np.random.default_rng(int(frame.id)))

    def detect(self, frame, name=None):
        boxes, labels = self.boxes(frame)
        if name is None:
            return Detections3D(boxes, np.full(len(boxes), 0.8), labels, NAMES)
        moved = self.knock is not None and int(frame.id) >= len(self.ids) // 2
        real = realigned(camera(), np.deg2rad(self.knock if moved else self.degrees))
        projected, visible = project_boxes(boxes, real)
        return Detections2D(projected[visible], np.full(visible.sum(), 0.9), labels[visible], NAMES)

    def sees(self, frame, name):
        return True


def reports(data):
    return find_alignment(data, data.ids, data, {"left": data}, NAMES)


def test_a_turned_camera_is_found_over_a_whole_drive_and_told():
    found = reports(Street(30, [0, 2.5, 0]))
    assert np.allclose(np.rad2deg(found["left"][0].alignment.rotation), [0, 2.5, 0], atol=0.03)
    (finding,) = alignment_findings(found)
    assert (finding.id, finding.severity) == ("CAM01", "error")
    assert "yaw +2.50" in finding.message


def test_a_camera_as_its_calibration_says_has_no_finding():
    found = reports(Street(30, [0, 0, 0]))
    assert found["left"][0].status == "ok"
    assert alignment_findings(found) == []


def test_a_camera_that_moved_during_the_drive_is_told_with_both_halves():
    findings = alignment_findings(reports(Street(60, [0, 0, 0], knock=[0, 1.0, 0])))
    message = next(f.message for f in findings if f.id == "CAM02")
    assert "yaw +0.00" in message
    assert "yaw +1.00" in message


def test_too_few_pairs_are_told_as_such_and_correct_nothing():
    data = Street(1, [0, 3.0, 0])
    found = reports(data)
    assert [f.id for f in alignment_findings(found)] == ["CAM03"]
    frame = data.frame("0")
    same = aligned_frame(frame, {"left": found["left"][0].alignment})
    assert same.cameras[0] is frame.cameras[0]


def test_the_aligned_frame_sees_what_the_real_camera_sees():
    data = Street(30, [0.4, -1.0, 0.2])
    whole = reports(data)["left"][0]
    frame = aligned_frame(data.frame("3"), {"left": whole.alignment})
    projected, visible = project_boxes(data.boxes(frame)[0], frame.cameras[0])
    assert np.abs(projected[visible] - data.detect(frame, "left").boxes).max() < 1.0
    assert "pairs in 30 frames" in describe(whole)


def test_no_detections_at_all_are_an_error():
    data = Street(3, [0, 0, 0])
    data.sees = lambda frame, name: False
    with pytest.raises(DatasetError, match="nothing to compare"):
        reports(data)
