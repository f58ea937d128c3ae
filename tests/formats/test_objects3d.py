"""3D objects of other libraries, by stand-ins with their fields: each box convention worked out by hand."""

from types import SimpleNamespace

import numpy as np
import pytest
import torch

from lcf3d.detectors.classes import to_classes
from lcf3d.errors import DetectorError
from lcf3d.structures import Detections3D

CLASSES = ("Pedestrian", "Cyclist", "Car")
# a car whose bottom is at z = -1.7 and whose centre is at -0.9, nose to the left (+y)
CANONICAL = [10.0, 2.0, -0.9, 4.0, 1.8, 1.6, np.pi / 2]


class LiDARInstance3DBoxes:
    """The fields of mmdet3d's class that are read."""

    def __init__(self, rows):
        self.tensor = torch.tensor(rows, requires_grad=True)


class CameraInstance3DBoxes(LiDARInstance3DBoxes):
    pass


def test_mmdet3d_has_its_boxes_at_the_bottom():
    boxes = LiDARInstance3DBoxes([[10.0, 2.0, -1.7, 4.0, 1.8, 1.6, np.pi / 2, 3.0, -1.0]])
    instances = SimpleNamespace(bboxes_3d=boxes, scores_3d=torch.tensor([0.8]), labels_3d=torch.tensor([2]))
    for sample in (SimpleNamespace(pred_instances_3d=instances), instances):
        found = Detections3D.from_mmdet3d(sample, CLASSES)
        np.testing.assert_allclose(found.boxes, [CANONICAL], rtol=1e-6)
        assert [found.class_names[i] for i in found.labels] == ["Car"]
        np.testing.assert_allclose(found.velocities, [[3, -1]])
    plain = {"bboxes_3d": [[10.0, 2.0, -1.7, 4.0, 1.8, 1.6, np.pi / 2]], "scores_3d": [0.8], "labels_3d": [2]}
    np.testing.assert_allclose(Detections3D.from_mmdet3d({**plain, "box_type_3d": "LiDAR"}, CLASSES).boxes, [CANONICAL])
    assert len(Detections3D.from_mmdet3d({"bboxes_3d": [], "scores_3d": [], "labels_3d": []}, CLASSES)) == 0


def test_mmdet3d_boxes_of_a_camera_are_refused():
    boxes = CameraInstance3DBoxes([[10.0, 2.0, -1.7, 4.0, 1.8, 1.6, 0.0]])
    instances = SimpleNamespace(bboxes_3d=boxes, scores_3d=torch.tensor([0.8]), labels_3d=torch.tensor([2]))
    with pytest.raises(DetectorError, match="type CameraInstance3DBoxes, not in the LiDAR frame"):
        Detections3D.from_mmdet3d(instances, CLASSES)
    with pytest.raises(DetectorError, match="type Camera, not"):
        Detections3D.from_mmdet3d({"bboxes_3d": [], "box_type_3d": "Camera"}, CLASSES)


def test_labels_beyond_the_names():
    plain = {"bboxes_3d": [[10.0, 2.0, -1.7, 4.0, 1.8, 1.6, 0]], "scores_3d": [0.8], "labels_3d": [2]}
    with pytest.raises(DetectorError, match="labels go from 2 to 2, but there are 2 class names"):
        Detections3D.from_mmdet3d(plain, CLASSES[:2])


def test_openpcdet_counts_classes_from_one_and_has_the_centre():
    prediction = {
        "pred_boxes": torch.tensor([[10.0, 2.0, -0.9, 4.0, 1.8, 1.6, np.pi / 2 + 2 * np.pi]], requires_grad=True),
        "pred_scores": torch.tensor([0.8]),
        "pred_labels": torch.tensor([3]),
    }
    found = Detections3D.from_openpcdet(prediction, CLASSES)
    np.testing.assert_allclose(found.boxes, [CANONICAL], rtol=1e-6)
    assert found.labels.tolist() == [2]
    with pytest.raises(DetectorError, match=r"cfg\.CLASS_NAMES"):
        Detections3D.from_openpcdet(prediction)


def test_records_of_openpcdet():
    record = {
        "name": np.array(["Car"]),
        "score": np.array([0.8], np.float32),
        "boxes_lidar": np.array([CANONICAL], np.float32),
        "frame_id": "000008",
    }
    np.testing.assert_allclose(Detections3D.from_openpcdet(record).boxes, [CANONICAL], rtol=1e-6)
    assert Detections3D.from_openpcdet(record, CLASSES).labels.tolist() == [2]
    # without detections OpenPCDet leaves the template of zeros
    nothing = {"name": np.zeros(0), "score": np.zeros(0), "boxes_lidar": np.zeros([0, 7]), "frame_id": "000009"}
    assert len(Detections3D.from_openpcdet(nothing, CLASSES)) == 0
    with pytest.raises(DetectorError, match="class 'Car', which is not among Van"):
        Detections3D.from_openpcdet(record, ("Van",))
    with pytest.raises(DetectorError, match="with 'pred_boxes'"):
        Detections3D.from_openpcdet({"boxes": 1}, CLASSES)


def quaternion(yaw):
    return np.array([np.cos(yaw / 2), 0, 0, np.sin(yaw / 2)])


def test_nuscenes_boxes_have_width_before_length_and_a_quaternion():
    box = SimpleNamespace(
        center=np.array([10.0, 2.0, -0.9]),
        wlh=np.array([1.8, 4.0, 1.6]),
        orientation=SimpleNamespace(elements=quaternion(np.pi / 2)),
        name="car",
        score=0.8,
        velocity=np.array([0.0, 3.0, 0.0]),
    )
    found = Detections3D.from_nuscenes_boxes([box])
    np.testing.assert_allclose(found.boxes, [CANONICAL])
    assert found.class_names == ("car",)
    np.testing.assert_allclose(found.velocities, [[0, 3]])
    # annotations have no score
    box.score = np.nan
    assert Detections3D.from_nuscenes_boxes([box]).scores.tolist() == [1.0]


def test_nuscenes_detection_boxes_come_through_a_transform():
    # the devkit's LiDAR has y ahead: 10 m ahead there is x = 10 here, and its yaw is a quarter turn more
    box = SimpleNamespace(
        translation=(-2.0, 10.0, -0.9),
        size=(1.8, 4.0, 1.6),
        rotation=tuple(quaternion(np.pi)),
        velocity=(-3.0, 0.0),
        detection_name="car",
        detection_score=0.8,
    )
    lidar_from_source = np.array([[0.0, 1, 0, 0], [-1, 0, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]])
    found = Detections3D.from_nuscenes_boxes([box], ("truck", "car"), lidar_from_source)
    np.testing.assert_allclose(found.boxes, [CANONICAL], atol=1e-12)
    np.testing.assert_allclose(found.velocities, [[0, 3]], atol=1e-12)
    assert found.labels.tolist() == [1]
    with pytest.raises(DetectorError, match="class 'car', which is not among truck"):
        Detections3D.from_nuscenes_boxes([box], ("truck",))
    assert len(Detections3D.from_nuscenes_boxes([], ("truck",))) == 0
    with pytest.raises(DetectorError, match="a Box of the nuScenes devkit"):
        Detections3D.from_nuscenes_boxes([SimpleNamespace(x=1)])


def test_classes_of_3d_detections_map_by_name():
    found = Detections3D(np.array([CANONICAL] * 3), [0.9, 0.8, 0.7], [0, 1, 2], ("car", "van", "tram"))
    mapped = to_classes(found, ("Pedestrian", "Car"))
    assert [mapped.class_names[i] for i in mapped.labels] == ["Car", "Car"]
