"""Stereo fusion on KITTI's frame 000107: real images of both cameras through a real detector."""

import numpy as np
import pytest

from lcf3d import Lcf3dError
from lcf3d.datasets.kitti import KittiDataset
from lcf3d.datasets.kitti_results import KittiLidarResults
from lcf3d.detectors.camera.onnx import OnnxDetector
from lcf3d.fusion.stereo import StereoConfig, StereoLateCascadeFusion
from lcf3d.fusion.stereo_pairing import epipolar_costs
from lcf3d.geometry.epipolar import fundamental_matrix
from lcf3d.geometry.iou import iou_3d
from lcf3d.reasons import Outcome
from lcf3d.structures import KITTI_CLASSES, Detections3D
from tests.fusion.scenes import PLAIN

pytestmark = pytest.mark.real


@pytest.fixture(scope="module")
def scene(shared):
    """The frame, its LiDAR detections with scores squashed into [0, 1], and the camera detections of both views."""
    frame = KittiDataset(shared / "data/kitti", "stereo").frame("000107")
    detector = OnnxDetector(shared / "weights/yolox_nano.onnx", tiles=2)
    found = {name: detector([frame.images[name]])[0] for name in ("left", "right")}
    cars = KittiLidarResults(shared / "data/kitti/results/point_gnn", KITTI_CLASSES).detect(frame)
    squashed = 1 / (1 + np.exp(-(cars.scores - 20) / 10))
    return frame, Detections3D(cars.boxes, squashed, cars.labels, cars.class_names), found


def test_three_cars_are_seen_by_all_and_one_is_recovered(scene):
    frame, cars, found = scene
    fused = StereoLateCascadeFusion(StereoConfig(**PLAIN, unpaired="discard"))(frame, cars, found)
    in_both = (fused.lidar.outcome == Outcome.MATCHED) & (fused.lidar.pair >= 0)
    assert in_both.sum() == 3
    recovered = np.flatnonzero(fused.outcomes == Outcome.RECOVERED)
    assert len(recovered) == 1
    # the car right beside us, cut by the image's edge
    overlap = iou_3d(fused.detections.boxes[recovered], frame.labels.boxes)[0]
    assert frame.labels.boxes[overlap.argmax(), 0] < 6
    assert overlap.max() > 0.6
    assert (fused.camera.output == recovered[0]).sum() == 2
    matched = fused.detections.boxes[fused.lidar.output[in_both]]
    assert (iou_3d(matched, frame.labels.boxes).max(axis=1) > 0.7).all()


def test_camera_alone_recovers_four_cars_in_pairs(scene):
    frame, _, found = scene
    fused = StereoLateCascadeFusion(StereoConfig(**PLAIN, unpaired="discard"))(
        frame, Detections3D.empty(KITTI_CLASSES), found
    )
    assert fused.outcomes.tolist() == [Outcome.RECOVERED] * 4
    assert (iou_3d(fused.detections.boxes, frame.labels.boxes).max(axis=1) > 0.5).all()
    left = np.flatnonzero((fused.camera.camera == 0) & (fused.camera.output >= 0))
    right = fused.camera.pair[left]
    lines = fundamental_matrix(frame.camera("left"), frame.camera("right"))
    own = found["left"].boxes[fused.camera.detection[left]]
    other = found["right"].boxes[fused.camera.detection[right]]
    assert (np.diag(epipolar_costs(own, other, lines)) / 2 < 5).all()


@pytest.mark.parametrize("threshold", [0.1, 0.5])
def test_exchanged_images_are_refused(scene, threshold):
    frame, cars, found = scene
    exchanged = {"left": found["right"], "right": found["left"]}
    with pytest.raises(Lcf3dError, match="with the views exchanged"):
        StereoLateCascadeFusion(StereoConfig(**{**PLAIN, "camera_score_threshold": threshold}))(frame, cars, exchanged)
