"""Every layout decoded against numbers worked out by hand: a 128 x 64 image in a 64 x 64 input (scale 0.5)."""

from __future__ import annotations

import pickle
from pathlib import Path

import numpy as np
import pytest

from lcf3d.detectors.camera.onnx import OnnxDetector
from lcf3d.detectors.classes import COCO_CLASSES
from lcf3d.errors import ConfigError, DetectorError, ShapeError
from lcf3d.structures import KITTI_CLASSES
from tests.detectors.camera.onnx_graphs import constant_graph, helper, numpy_helper, onnx

IMAGE_INPUT = {"images": [1, 3, 64, 64]}
CELLS = 64 + 16 + 4
NAMES = "car,person"


def yolox_output() -> np.ndarray:
    """One car in column 2, row 1 of the stride-16 grid: input box 28 12 52 28."""
    output = np.zeros((1, CELLS, 7), dtype=np.float32)
    output[0, 64 + 1 * 4 + 2] = [0.5, 0.25, np.log(1.5), 0.0, 0.8, 0.5, 0.1]
    return output


def ultralytics_output(masks: int = 0) -> np.ndarray:
    """A person at input box 24 24 40 40, a less sure one on the same spot, a car on the same spot."""
    output = np.zeros((1, 6 + masks, CELLS), dtype=np.float32)
    output[0, :6, 5] = [32, 32, 16, 16, 0.1, 0.9]
    output[0, :6, 6] = [32.5, 32, 16, 16, 0.0, 0.6]
    output[0, :6, 7] = [32, 32, 16, 16, 0.7, 0.0]
    if masks:
        output[0, 6, 5:8] = 1
    return output


def test_yolox(tmp_path: Path, black: np.ndarray) -> None:
    detector = OnnxDetector(constant_graph(tmp_path / "m.onnx", {"out": yolox_output()}, IMAGE_INPUT), names=NAMES)
    assert detector.layout == "yolox"
    (found,) = detector([black])
    np.testing.assert_allclose(found.boxes, [[56, 24, 104, 56]], atol=1e-4)
    np.testing.assert_allclose(found.scores, [0.4], atol=1e-6)
    assert found.class_names == KITTI_CLASSES
    assert found.labels.tolist() == [0]
    assert found.masks is None


def test_ultralytics_suppresses_within_a_class_only(tmp_path: Path, black: np.ndarray) -> None:
    path = constant_graph(tmp_path / "m.onnx", {"out": ultralytics_output()}, IMAGE_INPUT)
    detector = OnnxDetector(path, names=NAMES)
    assert detector.layout == "ultralytics"
    (found,) = detector([black])
    # the letterbox puts 16 rows above the image
    np.testing.assert_allclose(found.boxes, [[48, 16, 80, 48], [48, 16, 80, 48]], atol=1e-4)
    np.testing.assert_allclose(found.scores, [0.9, 0.7], atol=1e-6)
    assert [found.class_names[label] for label in found.labels] == ["Pedestrian", "Car"]


@pytest.mark.parametrize("dynamic", [False, True])
def test_masks_follow_the_prototypes(tmp_path: Path, black: np.ndarray, dynamic: bool) -> None:
    prototypes = np.zeros((1, 4, 16, 16), dtype=np.float32)
    prototypes[0, 0, :, :8], prototypes[0, 0, :, 8:] = 1, -1
    outputs = {"output0": ultralytics_output(masks=4), "output1": prototypes}
    inputs = {"images": ["N", 3, "H", "W"]} if dynamic else IMAGE_INPUT
    path = constant_graph(tmp_path / "m.onnx", outputs, inputs, {"names": "{0: 'car', 1: 'person'}"}, dynamic)
    detector = OnnxDetector(path, size=64 if dynamic else None)
    assert detector.layout == "ultralytics"
    (found,) = detector([black])
    assert found.masks is not None
    mask = found.masks[0]
    assert mask is not None
    assert (mask.x, mask.y, mask.bitmap.shape) == (48, 16, (32, 32))
    # prototype columns 0-7 are image columns 0-63
    assert mask.bitmap[:, :16].all()
    assert not mask.bitmap[:, 16:].any()


def test_end_to_end(tmp_path: Path, black: np.ndarray) -> None:
    output = np.zeros((1, 5, 6), dtype=np.float32)
    output[0, 0] = [24, 24, 40, 40, 0.9, 1]
    output[0, 1] = [25, 24, 40, 40, 0.8, 1]
    detector = OnnxDetector(constant_graph(tmp_path / "m.onnx", {"out": output}, IMAGE_INPUT), names=NAMES)
    assert detector.layout == "end2end"
    (found,) = detector([black])
    # the graph has suppressed already: nothing more is taken away
    np.testing.assert_allclose(found.boxes, [[48, 16, 80, 48], [50, 16, 80, 48]], atol=1e-4)


def test_end_to_end_with_masks(tmp_path: Path, black: np.ndarray) -> None:
    output = np.zeros((1, 5, 10), dtype=np.float32)
    output[0, 0, :7] = [24, 24, 40, 40, 0.9, 1, -1]
    prototypes = np.zeros((1, 4, 16, 16), dtype=np.float32)
    prototypes[0, 0, :8], prototypes[0, 0, 8:] = 1, -1
    path = constant_graph(tmp_path / "m.onnx", {"out": output, "protos": prototypes}, IMAGE_INPUT)
    (found,) = OnnxDetector(path, names=NAMES)([black])
    assert found.masks is not None
    mask = found.masks[0]
    assert mask is not None
    # the coefficient is negative: the lower half, from input row 32 = image row 32, belongs to the object
    assert not mask.bitmap[:16].any()
    assert mask.bitmap[16:].all()


def test_detr(tmp_path: Path, black: np.ndarray) -> None:
    outputs = {
        "scores": np.array([[0.5, 0.9, 0.01]], dtype=np.float32),
        "labels": np.array([[2, 0, 2]], dtype=np.int64),
        "boxes": np.array([[[16, 16, 32, 48], [0, 0, 8, 80], [1, 1, 2, 2]]], dtype=np.float32),
    }
    inputs = {**IMAGE_INPUT, "orig_target_sizes": [1, 2]}
    detector = OnnxDetector(constant_graph(tmp_path / "m.onnx", outputs, inputs))
    assert detector.layout == "detr"
    assert detector.own_class_names == COCO_CLASSES
    (found,) = detector([black])
    # stretched: x doubles, y stays; what reaches out of the image is clipped
    np.testing.assert_allclose(found.boxes, [[0, 0, 16, 64], [32, 16, 64, 48]], atol=1e-4)
    assert [found.class_names[label] for label in found.labels] == ["Pedestrian", "Car"]


def test_detr_is_told_width_before_height(tmp_path: Path, black: np.ndarray) -> None:
    box = np.array([[[0, 0, 0.5, 1]]], dtype=np.float32)
    nodes = [
        helper.make_node("Cast", ["orig_target_sizes"], ["sizes"], to=1),
        helper.make_node("Concat", ["sizes", "sizes"], ["sides"], axis=1),
        helper.make_node("Mul", ["box", "sides"], ["boxes"]),
        helper.make_node("Identity", ["label"], ["labels"]),
        helper.make_node("Identity", ["score"], ["scores"]),
    ]
    initializers = [
        numpy_helper.from_array(box, "box"),
        numpy_helper.from_array(np.array([[2]], dtype=np.int64), "label"),
        numpy_helper.from_array(np.array([[0.9]], dtype=np.float32), "score"),
    ]
    info = helper.make_tensor_value_info
    graph = helper.make_graph(
        nodes,
        "sizes",
        [info("images", 1, [1, 3, 32, 96]), info("orig_target_sizes", 7, [1, 2])],
        [info("labels", 7, [1, 1]), info("boxes", 1, [1, 1, 4]), info("scores", 1, [1, 1])],
        initializers,
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)])
    model.ir_version = 8
    onnx.save(model, tmp_path / "m.onnx")
    (found,) = OnnxDetector(tmp_path / "m.onnx")([black])
    np.testing.assert_allclose(found.boxes, [[0, 0, 64, 64]], atol=1e-4)


def test_tiles_put_their_boxes_where_they_lie(tmp_path: Path, black: np.ndarray) -> None:
    outputs = {
        "labels": np.array([[2]], dtype=np.int64),
        "boxes": np.array([[[16, 16, 32, 48]]], dtype=np.float32),
        "scores": np.array([[0.9]], dtype=np.float32),
    }
    path = constant_graph(tmp_path / "m.onnx", outputs, {**IMAGE_INPUT, "orig_target_sizes": [1, 2]})
    (found,) = OnnxDetector(path, tiles=2)([black])
    # two tiles of 72 columns, from 0 and from 56; no two boxes overlap enough to be one
    expected = [[32, 16, 64, 48], [18, 16, 36, 48], [74, 16, 92, 48]]
    np.testing.assert_allclose(found.boxes, expected, atol=1e-4)


def test_threshold_classes_and_mapping(tmp_path: Path, black: np.ndarray) -> None:
    path = constant_graph(tmp_path / "m.onnx", {"out": ultralytics_output()}, IMAGE_INPUT)
    (found,) = OnnxDetector(path, ("pedestrian", "car"), names=NAMES, score_threshold=0.8)([black])
    assert (found.labels.tolist(), found.class_names) == ([0], ("pedestrian", "car"))
    (found,) = OnnxDetector(path, names=NAMES, mapping={"person": "", "car": "Cyclist"})([black])
    assert [found.class_names[label] for label in found.labels] == ["Cyclist"]


def test_no_detections_and_several_images(tmp_path: Path, black: np.ndarray) -> None:
    path = constant_graph(tmp_path / "m.onnx", {"out": yolox_output()}, IMAGE_INPUT)
    detector = OnnxDetector(path, names=NAMES, score_threshold=0.5)
    found = detector([black, np.zeros((30, 20, 3), dtype=np.uint8)])
    assert [len(f) for f in found] == [0, 0]
    assert detector([]) == []


def test_detectors_travel_to_other_processes(tmp_path: Path, black: np.ndarray) -> None:
    path = constant_graph(tmp_path / "m.onnx", {"out": yolox_output()}, IMAGE_INPUT)
    detector = OnnxDetector(path, names=NAMES, threads=1)
    other = pickle.loads(pickle.dumps(detector))
    np.testing.assert_array_equal(other([black])[0].boxes, detector([black])[0].boxes)
    assert len(other([black])[0]) == 1


def test_names_from_a_file(tmp_path: Path) -> None:
    (tmp_path / "names.txt").write_text("car\n\nperson\n")
    path = constant_graph(tmp_path / "m.onnx", {"out": yolox_output()}, IMAGE_INPUT)
    assert OnnxDetector(path, names=str(tmp_path / "names.txt")).own_class_names == ("car", "person")


def test_missing_and_broken_files(tmp_path: Path) -> None:
    with pytest.raises(DetectorError, match=r"absent\.onnx does not exist"):
        OnnxDetector(tmp_path / "absent.onnx")
    (tmp_path / "broken.onnx").write_bytes(b"\x08\x07not a graph")
    with pytest.raises(DetectorError, match=r"broken\.onnx cannot be read as an ONNX file"):
        OnnxDetector(tmp_path / "broken.onnx")


@pytest.mark.parametrize(
    ("inputs", "shape", "message"),
    [
        ({"features": [1, 10]}, (1, 84, 7), "not a camera detector: expected one float image input"),
        (IMAGE_INPUT, (1, 1000), "not a usable camera detector.*layouts: yolox, yolov5"),
        (IMAGE_INPUT, (1, 21, 85), "not a usable camera detector"),
        (IMAGE_INPUT, (1, 84, 7), "has 2 classes and does not name them; name them with names="),
    ],
)
def test_graphs_that_are_no_detectors(
    tmp_path: Path, inputs: dict[str, list[int | str]], shape: tuple[int, ...], message: str
) -> None:
    path = constant_graph(tmp_path / "m.onnx", {"out": np.zeros(shape, dtype=np.float32)}, inputs)
    with pytest.raises(DetectorError, match=message):
        OnnxDetector(path)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"tiles": 0}, "tiles must be 1 or more"),
        ({"score_threshold": 1.5}, "score_threshold must be in"),
        ({"layout": "yolo"}, "unknown layout 'yolo'"),
        ({"normalize": "coco"}, "normalize must be none or imagenet"),
        ({"size": 50}, "size must be a multiple of 32"),
        ({"size": "64x64x64"}, "size must be a multiple of 32"),
        ({"size": 128}, "fixed input of 64 x 64"),
    ],
)
def test_settings_that_make_no_sense(tmp_path: Path, settings: dict[str, object], message: str) -> None:
    path = constant_graph(tmp_path / "m.onnx", {"out": yolox_output()}, IMAGE_INPUT)
    with pytest.raises(ConfigError, match=message):
        OnnxDetector(path, names=NAMES, **settings)  # type: ignore[arg-type]


def test_override_that_does_not_fit(tmp_path: Path, black: np.ndarray) -> None:
    path = constant_graph(tmp_path / "m.onnx", {"out": yolox_output()}, IMAGE_INPUT)
    with pytest.raises(DetectorError, match="layout detr needs outputs labels, boxes and scores"):
        OnnxDetector(path, names=NAMES, layout="detr")
    with pytest.raises(DetectorError, match="has 80 classes but 2 names"):
        OnnxDetector(path, names=NAMES, layout="ultralytics")
    detector = OnnxDetector(path, names=",".join(["car", *map(str, range(79))]), layout="ultralytics")
    with pytest.raises(DetectorError, match="layout ultralytics expects an output 1 x C x 84"):
        detector([black])


def test_boxes_labels_and_scores_without_a_batch(tmp_path: Path, black: np.ndarray) -> None:
    outputs = {
        "boxes": np.zeros((5, 4), dtype=np.float32),
        "labels": np.zeros(5, dtype=np.int64),
        "scores": np.zeros(5, dtype=np.float32),
    }
    path = constant_graph(tmp_path / "m.onnx", outputs, IMAGE_INPUT)
    with pytest.raises(DetectorError, match="not a usable camera detector"):
        OnnxDetector(path)
    with pytest.raises(DetectorError, match="layout detr expects labels 1 x N"):
        OnnxDetector(path, layout="detr")([black])


def test_unknown_class_index(tmp_path: Path, black: np.ndarray) -> None:
    output = np.array([[[24, 24, 40, 40, 0.9, 7]]], dtype=np.float32)
    path = constant_graph(tmp_path / "m.onnx", {"out": output}, IMAGE_INPUT)
    with pytest.raises(DetectorError, match="gave class 7 but 2 class names are known"):
        OnnxDetector(path, names=NAMES)([black])


def test_images_of_the_wrong_kind(tmp_path: Path) -> None:
    path = constant_graph(tmp_path / "m.onnx", {"out": yolox_output()}, IMAGE_INPUT)
    detector = OnnxDetector(path, names=NAMES)
    for image in (np.zeros((64, 128)), np.zeros((64, 128, 3)), np.zeros((0, 128, 3), dtype=np.uint8)):
        with pytest.raises(ShapeError, match="uint8 RGB"):
            detector([image])


@pytest.mark.real
@pytest.mark.parametrize(
    ("file", "layout"),
    [("yolox_nano", "yolox"), ("deimv2_femto", "detr"), ("yolov8n-seg_int8", "ultralytics")],
)
def test_real_weights_find_the_cars_of_a_real_frame(shared: Path, weights: Path, file: str, layout: str) -> None:
    from lcf3d.datasets.images import read_image
    from lcf3d.formats.kitti import detections_2d, read_objects
    from lcf3d.geometry.iou import image_iou

    training = shared / "data/kitti/training"
    labels = detections_2d(read_objects(training / "label_2/000008.txt", results=False), ("Car",)).boxes
    detector = OnnxDetector(weights / f"{file}.onnx", tiles=2, threads=1)
    assert detector.layout == layout
    (found,) = detector([read_image(training / "image_2/000008.png")])
    cars = found[(found.labels == 0) & (found.scores > 0.5)]
    # four of the six cars are near and hardly hidden
    assert (image_iou(cars.boxes, labels).max(axis=0) > 0.7).sum() >= 4
    assert (found.masks is not None) == (layout == "ultralytics")
    if found.masks is not None:
        covered = [m.bitmap.mean() for m in found.masks[:4] if m is not None]
        assert min(covered) > 0.6
