"""Points painted by masks, segmentation networks and frustums; worked out on images of a few pixels."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from lcf3d.detectors.fusion.frustum_pillars import FrustumPainter
from lcf3d.detectors.fusion.painters import MaskPainter, SegmentationPainter, load_painter
from lcf3d.detectors.fusion.painting import PaintedDetector, painted_points
from lcf3d.detectors.lidar.inputs import statistics_of
from lcf3d.detectors.lidar.presets import COMPACT_KITTI, painted_config
from lcf3d.detectors.lidar.statistics import FEATURES, painted_statistics, pillar_statistics
from lcf3d.errors import ConfigError, DatasetError, DetectorError, ShapeError
from lcf3d.frame import Frame
from lcf3d.structures import KITTI_CLASSES, Camera, Detections2D, Detections3D, InstanceMask

# looks along x; a point (x, y, z) is seen at (32 - 40 y / x, 16 - 40 z / x)
CAMERA = Camera(
    "left",
    np.array([[40.0, 0, 32, 0], [0, 40, 16, 0], [0, 0, 1, 0]]),
    np.array([[0.0, -1, 0, 0], [0, 0, -1, 0], [1, 0, 0, 0], [0, 0, 0, 1]]),
    64,
    32,
)
IMAGE = np.zeros((32, 64, 3), np.uint8)
POINTS = np.array([[10, 0, 0, 0.5], [10, 4, 0, 0.5], [10, -40, 0, 0.5], [-10, 0, 0, 0.5]], np.float32)
"""In the middle of the image, at column 16, beside the image, behind the camera."""


def detector(boxes, scores, labels, masks=None):
    found = Detections2D(np.array(boxes, float), np.array(scores), np.array(labels), KITTI_CLASSES, masks)
    return lambda images: [found] * len(images)


def mask(x, y, w, h):
    return InstanceMask(x, y, np.ones((h, w), dtype=bool))


def test_points_take_the_highest_score_of_the_masks_they_fall_on():
    found = detector(
        [[20, 0, 50, 32]] * 3, [0.6, 0.9, 0.8], [0, 0, 1], (mask(30, 10, 10, 10), mask(30, 10, 5, 10), None)
    )
    points = painted_points(POINTS, CAMERA, IMAGE, MaskPainter(found, KITTI_CLASSES), 3)
    # the two points that the camera sees, in their order
    np.testing.assert_allclose(points[:, :4], POINTS[:2])
    np.testing.assert_allclose(points[:, 4:], [[0.9, 0, 0], [0, 0, 0]], atol=1e-6)


def test_a_detector_without_masks_cannot_paint():
    with pytest.raises(DetectorError, match="no instance masks"):
        painted_points(POINTS, CAMERA, IMAGE, MaskPainter(detector([[0, 0, 9, 9]], [0.9], [0]), KITTI_CLASSES), 3)


def test_segmentation_scores_are_summed_by_class():
    # left half person, right half a van and a car, at half the image's resolution
    logits = np.full((4, 16, 32), -20.0, np.float32)
    logits[1, :, :16] = 0.0
    logits[2:, :, 16:] = 0.0
    painter = SegmentationPainter(lambda image: logits, ("road", "person", "car", "van"), KITTI_CLASSES)
    scores = painter(IMAGE, np.array([[5.0, 5.0], [60.0, 31.9], [31.9, 0.0]]))
    np.testing.assert_allclose(scores, [[0, 1, 0], [1, 0, 0], [0, 1, 0]], atol=1e-5)


def test_segmentation_takes_class_indices_and_probabilities_too():
    classes = ("road", "person", "car")
    indices = np.zeros((32, 64), np.int64)
    indices[:, 40:], indices[:, 60:] = 2, 255
    painter = SegmentationPainter(lambda image: indices, classes, KITTI_CLASSES)
    pixels = np.array([[0.0, 0.0], [45.5, 3.0], [61.0, 3.0]])
    np.testing.assert_array_equal(painter(IMAGE, pixels), [[0, 0, 0], [1, 0, 0], [0, 0, 0]])
    shares = np.stack([np.full((32, 64), 0.5), np.full((32, 64), 0.25), np.full((32, 64), 0.25)])
    painter = SegmentationPainter(lambda image: shares, classes, KITTI_CLASSES)
    np.testing.assert_allclose(painter(IMAGE, pixels), [[0.25, 0.25, 0]] * 3)


def test_an_onnx_network_paints(tmp_path):
    onnx = pytest.importorskip("onnx")
    helper, kind = onnx.helper, onnx.TensorProto.FLOAT
    shape = [1, 3, 32, 64]
    graph = helper.make_graph(
        [helper.make_node("Identity", ["image"], ["scores"])],
        "copies",
        [helper.make_tensor_value_info("image", kind, shape)],
        [helper.make_tensor_value_info("scores", kind, shape)],
    )
    path = tmp_path / "copies.onnx"
    onnx.save(helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=9), str(path))
    image = IMAGE.copy()
    image[:, 32:, 1] = 255
    painter = load_painter(f"onnx:{path}?classes=car,person,road&normalize=none", KITTI_CLASSES)
    e = np.e
    np.testing.assert_allclose(
        painter(image, np.array([[3.0, 3.0], [50.0, 3.0]])),
        [[1 / 3, 1 / 3, 0], [1 / (2 + e), e / (2 + e), 0]],
        atol=1e-6,
    )
    with pytest.raises(DetectorError, match=r"expected \(2, h, w\) scores"):
        load_painter(f"onnx:{path}?classes=car,person&normalize=none", KITTI_CLASSES)(image, np.zeros((1, 2)))


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("brush:x", "a painter is masks:CAMERA"),
        ("masks", "a painter is masks:CAMERA"),
        ("onnx:a.onnx", "needs its classes in order"),
        ("onnx:a.onnx?classes=car&size=3", "HEIGHTxWIDTH"),
        ("onnx:a.onnx?classes=car&normalize=zero", "imagenet or none"),
        ("onnx:a.onnx?colour=red", "has no setting 'colour'"),
        ("torchvision:unet", "unknown segmentation network"),
    ],
)
def test_what_paints_nothing_is_refused(text, message):
    if text.startswith("torchvision"):
        pytest.importorskip("torch")
    with pytest.raises((ConfigError, DetectorError), match=message):
        load_painter(text, KITTI_CLASSES)


def test_a_segmentation_network_of_other_classes_is_refused():
    with pytest.raises(ConfigError, match="knows none of Car"):
        SegmentationPainter(lambda image: image, ("sky", "road"), KITTI_CLASSES)


def test_torchvision_segmentation_paints_with_a_checkpoint(tmp_path):
    torch = pytest.importorskip("torch")
    torchvision = pytest.importorskip("torchvision")
    name = "lraspp_mobilenet_v3_large"
    torch.manual_seed(0)
    network = torchvision.models.get_model(name, weights=None, weights_backbone=None, num_classes=3).eval()
    path = tmp_path / "seg.pth"
    torch.save(network.state_dict(), path)
    painter = load_painter(f"torchvision:{name}?checkpoint={path}&classes=background,person,car", KITTI_CLASSES)
    scores = painter(IMAGE, np.array([[3.0, 3.0], [50.0, 20.0]]))
    assert scores.shape == (2, 3)
    assert (scores[:, :2] > 0).all()
    assert (scores[:, 2] == 0).all()


def test_points_in_frustums_take_the_gaussian_of_their_box():
    # sigma is the width and height; the middle point is the centre of the first box, 4 pixels left of the second's
    found = detector([[22, 6, 42, 26], [18, 6, 54, 26], [0, 0, 5, 5]], [0.9, 0.9, 0.9], [0, 1, 2])
    points = painted_points(POINTS, CAMERA, IMAGE, FrustumPainter(found, KITTI_CLASSES), 3)
    np.testing.assert_allclose(points[:, 4:], [[1, np.exp(-((4 / 36) ** 2) / 2), 0], [0, 0, 0]], atol=1e-6)


def test_a_pillar_has_mean_and_highest_of_each_score():
    cloud = np.array([[1.0, 1, -1, 0.5, 0.2, 0], [1.01, 1, -1, 0.5, 0.6, 0], [5, 5, -1, 0.5, 0, 0.3]], np.float32)
    features, cells = painted_statistics(cloud, COMPACT_KITTI.voxels, 2)
    plain, same = pillar_statistics(np.ascontiguousarray(cloud[:, :4]), COMPACT_KITTI.voxels)
    np.testing.assert_array_equal(cells, same)
    np.testing.assert_array_equal(features[:, :FEATURES], plain)
    np.testing.assert_allclose(features[:, FEATURES:], [[0.4, 0, 0.6, 0], [0, 0.3, 0, 0.3]], atol=1e-6)
    frustums = replace(painted_config("masks:x", only_painted=True), painted=("Car", "Pedestrian"))
    unpainted = np.concatenate([cloud, [[7, 7, -1, 0.5, 0, 0]]]).astype(np.float32)
    assert len(statistics_of(unpainted, frustums)[1]) == 2
    assert len(statistics_of(unpainted, replace(frustums, only_painted=False))[1]) == 3


def test_plain_points_are_refused_by_a_painted_network():
    with pytest.raises(ShapeError, match="give its file to a detector that paints them"):
        statistics_of(POINTS, painted_config("masks:x"))


class Network:
    """Finds a car where a painted point is."""

    class_names = KITTI_CLASSES

    def __init__(self, config):
        self.config = config

    def __call__(self, points, around=None):
        self.seen, self.around = points, around
        hit = points[points[:, 4:].any(axis=1)]
        boxes = np.concatenate([hit[:, :3], np.tile([4.0, 2, 1.5, 0], (len(hit), 1))], axis=1)
        return Detections3D(boxes, np.ones(len(hit)), np.zeros(len(hit), np.int64), KITTI_CLASSES)


def test_a_painted_detector_looks_at_frames():
    painter = MaskPainter(detector([[20, 0, 50, 32]], [0.6], [0], (mask(30, 10, 10, 10),)), KITTI_CLASSES)
    network = Network(painted_config("masks:x"))
    frame = Frame("7", POINTS, (CAMERA,), {"left": IMAGE})
    found = PaintedDetector(network, painter).detect_frame(frame)
    np.testing.assert_allclose(found.boxes[:, :3], [[10, 0, 0]])
    assert network.seen.shape == (2, 7)
    assert len(network.around) == len(POINTS), "the ground is looked for in the whole scan"
    blind = Frame("7", POINTS, (CAMERA,), {})
    with pytest.raises(DatasetError, match="frame 7 has no image of camera left"):
        PaintedDetector(network, painter).detect_frame(blind)
    assert len(PaintedDetector(network, painter, without_image="unpainted").detect_frame(blind)) == 0
    with pytest.raises(DatasetError, match="frame 7 has no scan"):
        PaintedDetector(network, painter).detect_frame(Frame("7", None, (CAMERA,), {"left": IMAGE}))
    with pytest.raises(ConfigError, match="has no camera 'right'"):
        PaintedDetector(network, painter, camera="right").detect_frame(frame)


def test_networks_and_settings_that_do_not_fit_are_refused():
    with pytest.raises(DetectorError, match="takes plain points; run it as onnx-lidar"):
        PaintedDetector(Network(COMPACT_KITTI), MaskPainter(detector([], [], []), KITTI_CLASSES))
    with pytest.raises(ConfigError, match="error or unpainted"):
        PaintedDetector(Network(painted_config("masks:x")), None, without_image="skip")
