"""Exports whose shapes fit several layouts are told by their values, or refused with a sentence that says why."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from lcf3d.detectors.camera.onnx import OnnxDetector
from lcf3d.errors import DetectorError
from tests.detectors.camera.onnx_graphs import constant_graph

# a 128 x 64 image in a 64 x 64 input: half as large; the centred letterbox moves it down by 16 rows
INPUT = {"images": [1, 3, 64, 64]}
CELLS = 84
IN_IMAGE = [[40, 20, 80, 40]]
CAR = "{0: 'car'}"


def detect(path: Path, black: np.ndarray, **settings: object) -> tuple[str, list[list[float]]]:
    detector = OnnxDetector(path, **settings)  # type: ignore[arg-type]
    (found,) = detector([black])
    return detector.layout, found.boxes.round(3).tolist()


def rows(count: int, columns: int) -> np.ndarray:
    return np.zeros((1, count, columns), dtype=np.float32)


def test_yolox_with_decoding_inside(tmp_path: Path, black: np.ndarray) -> None:
    output = rows(CELLS, 7)
    output[0, :, 2:4] = 12
    output[0, 9] = [30, 15, 20, 10, 0.9, 0.9, 0]
    path = constant_graph(tmp_path / "m.onnx", {"out": output}, INPUT)
    assert detect(path, black, names="car,person") == ("yolox", IN_IMAGE)


def test_one_class_of_three_anchors_a_cell(tmp_path: Path, black: np.ndarray) -> None:
    output = rows(3 * CELLS, 6)
    output[0, :, 4:] = 0.01
    output[0, 9] = [30, 31, 20, 10, 0.9, 0.95]
    path = constant_graph(tmp_path / "m.onnx", {"out": output}, INPUT, {"names": CAR})
    assert detect(path, black) == ("yolov5", IN_IMAGE)


def test_corners_without_suppression(tmp_path: Path, black: np.ndarray) -> None:
    output = rows(CELLS, 6)
    output[0, :, 2:4] = 1
    output[0, 3:5] = [20, 26, 40, 36, 0.9, 0]
    path = constant_graph(tmp_path / "m.onnx", {"out": output}, INPUT, {"names": CAR})
    assert detect(path, black) == ("corners", IN_IMAGE)


def test_two_classes_of_queries(tmp_path: Path, black: np.ndarray) -> None:
    output = rows(30, 6)
    output[0, :, :4] = 0.5
    output[0, :, 5] = 0.02
    # stretched: shares of the image
    output[0, 7] = [60 / 128, 30 / 64, 40 / 128, 20 / 64, 0.9, 0.02]
    path = constant_graph(tmp_path / "m.onnx", {"out": output}, INPUT, {"names": "{0: 'car', 1: 'person'}"})
    assert detect(path, black) == ("queries", IN_IMAGE)


def test_what_values_do_not_tell_is_refused(tmp_path: Path) -> None:
    path = constant_graph(tmp_path / "m.onnx", {"out": rows(CELLS, 6)}, INPUT, {"names": CAR})
    with pytest.raises(DetectorError, match=r"layout=\.\.\."):
        OnnxDetector(path)


@pytest.mark.parametrize(
    ("shape", "image", "metadata", "said"),
    [
        ((1, 84, CELLS), [4, 3, 64, 64], {}, "fixed batch of 4"),
        ((1, 56, CELLS), [1, 3, 64, 64], {"names": "{0: 'person'}", "task": "pose"}, "task 'pose'"),
        ((1, CELLS, 7), [1, 3, 64, 64], {"names": "{0: 'car', 1: 'bus', 2: 'person'}"}, "transposed"),
        ((1, 6, CELLS), [1, 3, 64, 64], {"names": "{0: 'Lorry', 1: 'VRU'}"}, r"none of its classes \(Lorry, VRU\)"),
        ((1, 6, CELLS), [1, 3, 64, 64], {"names": "{'a': 'car', 'b': 'bus'}"}, "names=..."),
    ],
)
def test_exports_that_cannot_be_used_say_why(
    tmp_path: Path, shape: tuple[int, ...], image: list[int], metadata: dict[str, str], said: str
) -> None:
    output = np.zeros(shape, dtype=np.float32)
    path = constant_graph(tmp_path / "m.onnx", {"out": output}, {"images": image}, metadata)
    with pytest.raises(DetectorError, match=said):
        OnnxDetector(path)


def test_words_as_input_size_in_the_metadata_are_passed_over(tmp_path: Path) -> None:
    output = np.zeros((1, 6, CELLS), dtype=np.float32)
    metadata = {"names": "{0: 'car', 1: 'person'}", "imgsz": "['wide', 'high']"}
    assert OnnxDetector(constant_graph(tmp_path / "m.onnx", {"out": output}, INPUT, metadata)).layout == "ultralytics"


def test_assumed_names_are_said(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    path = constant_graph(tmp_path / "m.onnx", {"out": rows(30, 6)}, INPUT)
    assert OnnxDetector(path).reports == ("Car", "Pedestrian", "Cyclist")
    assert "COCO is assumed" in caplog.text
    caplog.clear()
    assert OnnxDetector(path, names="Pedestrian,Car").reports == ("Car", "Pedestrian")
    assert not caplog.text
