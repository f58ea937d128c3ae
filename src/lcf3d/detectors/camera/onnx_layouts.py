"""The output layouts of common camera detectors: how each wants its image and how its outputs become boxes.

- ``yolox`` (YOLOX): one output 1 x M x (5 + classes) of cell offsets, log sizes, objectness and class scores; exports
  with decoding inside have centre and size in pixels instead, told by sizes that no logarithm has. Image: BGR 0-255,
  letterbox in the top left corner.
- ``yolov5`` (YOLOv5, YOLOv7): one output 1 x 3 M x (5 + classes) of centre, size, objectness and class scores. Image:
  RGB 0-1, centred letterbox.
- ``ultralytics`` (YOLOv8 and later exports): one output 1 x (4 + classes [+ K]) x M of centre, size, class scores and,
  in segmentation exports, K mask coefficients, with 1 x K x h x w prototypes as second output. Image: RGB 0-1, centred
  letterbox.
- ``end2end`` (exports with suppression inside, YOLOv10, YOLO26): one output 1 x N x (6 [+ K]) of corners, score, class
  and mask coefficients, with prototypes as above. Image: as ``ultralytics``.
- ``corners`` (DeepStream exports): one output 1 x M x 6 of corners, score, class, not suppressed. Image: as
  ``ultralytics``.
- ``queries`` (RT-DETR as Ultralytics exports it): one output 1 x N x (4 + classes) of centre and size as shares of the
  input, and class scores. Image: RGB 0-1, stretched to the input.
- ``detr`` (RT-DETR, D-FINE, DEIM, DEIMv2): outputs ``labels``, ``boxes``, ``scores``, second input
  ``orig_target_sizes``. Image: RGB 0-1, stretched to the input.

M is the number of cells of the grids of strides 8, 16 and 32, which tells ``yolox`` and ``ultralytics`` apart. Six
columns fit several layouts: then the values that the network gives for an empty image decide (`tell_by_values`).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from lcf3d.errors import DetectorError
from lcf3d.structures import FloatArray, IntArray

STRIDES = (8, 16, 32)
SIZES_INPUT = "orig_target_sizes"
# no box is exp(10) strides wide, every image has one of more than 10 pixels
MOST_LOG_SIZE = 10.0
# coordinates of boxes that are given as shares of the input
NORMALISED = 1.5
Fit = Literal["corner", "centre", "stretch"]


@dataclass(frozen=True)
class RawDetections:
    """What one forward pass found, in pixels of the network's input.

    Attributes:
        boxes: (N, 4) corners.
        scores: (N,).
        labels: (N,) indices into the network's own classes.
        coefficients: (N, K) mask coefficients, or None.
        prototypes: (K, h, w) mask prototypes over the whole input, or None.
    """

    boxes: FloatArray
    scores: FloatArray
    labels: IntArray
    coefficients: NDArray[np.floating] | None = None
    prototypes: NDArray[np.floating] | None = None


@dataclass(frozen=True)
class Layout:
    """How to feed a network and read its outputs.

    Attributes:
        name: as in the table of this module.
        fit: how the image is brought to the input size; ``corner`` and ``centre`` keep its proportions.
        bgr: the channels are blue, green, red.
        divisor: pixel values are divided by it.
        overlapping: boxes still need non-maximum suppression.
        decode: ``(outputs, (height, width) of the input, lowest score)`` to detections.
    """

    name: str
    fit: Fit
    bgr: bool
    divisor: float
    overlapping: bool
    decode: Callable[[Sequence[NDArray[Any]], tuple[int, int], float], RawDetections]


def cell_count(size: tuple[int, int]) -> int:
    """Number of grid cells of all `STRIDES` for an input of (height, width)."""
    return sum((size[0] // s) * (size[1] // s) for s in STRIDES)


def identify_layout(
    input_names: Sequence[str],
    output_shapes: Mapping[str, tuple[int, ...]],
    size: tuple[int, int],
    names: int | None = None,
) -> str:
    """The layout's name, from the graph's inputs and outputs.

    Args:
        input_names: of all inputs.
        output_shapes: shape of each output by name, in the graph's order, all dimensions known.
        size: (height, width) of the image input.
        names: how many classes the file names, if it does.

    Returns:
        The name; several with ``/`` between them where shapes leave a choice to `tell_by_values`.

    Raises:
        DetectorError: they fit none.
    """
    if {"labels", "boxes", "scores"} <= set(output_shapes) and len(output_shapes["boxes"]) == 3:
        return "detr"
    shapes = list(output_shapes.values())
    masks = shapes[1][1] if len(shapes) > 1 and len(shapes[1]) == 4 else 0
    if len(input_names) == 1 and shapes and len(shapes[0]) == 3:
        _, rows, columns = shapes[0]
        cells = cell_count(size)
        turned = {(cells, 4 + (names or 0)): "ultralytics", (5 + (names or 0), cells): "yolox"}.get((rows, columns))
        if turned and names and names > 2 and not masks:
            raise DetectorError(
                f"its output 1 x {rows} x {columns} is that of layout {turned} for {names} classes, transposed; "
                "export it without the transposition"
            )
        if rows == cells and columns == 6:
            return "yolox/corners"
        if rows == cells and columns >= 6:
            return "yolox"
        if rows == 3 * cells and columns >= 6:
            return "yolov5"
        if columns == cell_count(size) and rows >= 5 + masks:
            return "ultralytics"
        if columns == 6 and names == 2:
            return "end2end/queries"
        if columns == 6 + masks:
            return "end2end"
        if names and columns == 4 + names and not masks and rows < cells:
            return "queries"
    described = ", ".join(f"{name} {list(shape)}" for name, shape in output_shapes.items())
    raise DetectorError(
        f"its outputs ({described}, for an input of {size[0]} x {size[1]}) are not those of a known detector; known "
        f"layouts: {', '.join(LAYOUTS)}; name one with layout=... if the automatic choice is wrong"
    )


def tell_by_values(choices: str, output: NDArray[Any]) -> str:
    """Which of the layouts that `identify_layout` leaves to choose an output's values are of.

    Args:
        choices: names with ``/`` between them.
        output: (1, N, 6) first output for an empty image.

    Raises:
        DetectorError: they fit none or several; says how to name the layout.
    """
    if "/" not in choices:
        return choices
    table = output[0].astype(np.float64)
    whole = bool((table[:, 5] == np.round(table[:, 5])).all())
    normalised = bool((np.abs(table[:, :4]) <= NORMALISED).all()) and bool(table[:, :4].any())
    if choices == "yolox/corners" and not whole:
        return "yolox"
    if choices == "yolox/corners" and (table[:, 2:4] >= table[:, :2]).all() and table[:, :4].any():
        return "corners"
    if choices == "end2end/queries" and normalised:
        return "queries"
    if choices == "end2end/queries" and whole:
        return "end2end"
    raise DetectorError(
        f"its output 1 x {len(table)} x 6 fits several layouts ({choices.replace('/', ', ')}) and its values do not "
        "tell which; name one with layout=..."
    )


def class_count(layout: str, output_shapes: Sequence[tuple[int, ...]]) -> int | None:
    """How many classes the network tells apart, None where its outputs do not say."""
    if layout in ("yolox", "yolov5"):
        return output_shapes[0][2] - 5
    if layout == "queries":
        return output_shapes[0][2] - 4
    if layout == "ultralytics":
        return output_shapes[0][1] - 4 - (output_shapes[1][1] if len(output_shapes) > 1 else 0)
    return None


def decode_yolox(outputs: Sequence[NDArray[Any]], size: tuple[int, int], lowest: float) -> RawDetections:
    """Cell offsets in cells and log sizes in strides, or pixels; score = objectness x class score."""
    table = _rows(outputs[0], cell_count(size), axis=0, layout="yolox")
    scores, labels = _best_class(table[:, 5:])
    scores = scores * table[:, 4]
    kept = np.flatnonzero(scores >= lowest)
    if (table[:, 2:4] > MOST_LOG_SIZE).any():
        # decoded inside the network
        pixels = table[kept, :4].astype(np.float64)
        return RawDetections(_corners(pixels[:, :2], pixels[:, 2:]), scores[kept], labels[kept])
    cells, strides = _grid(size)
    centres = (table[kept, :2] + cells[kept]) * strides[kept, None]
    sides = np.exp(table[kept, 2:4]) * strides[kept, None]
    return RawDetections(_corners(centres, sides), scores[kept], labels[kept])


def decode_yolov5(outputs: Sequence[NDArray[Any]], size: tuple[int, int], lowest: float) -> RawDetections:
    """One row an anchor: centre and size in input pixels, objectness, class scores."""
    table = _rows(outputs[0], 3 * cell_count(size), axis=0, layout="yolov5")
    scores, labels = _best_class(table[:, 5:])
    scores = scores * table[:, 4]
    kept = np.flatnonzero(scores >= lowest)
    pixels = table[kept, :4].astype(np.float64)
    return RawDetections(_corners(pixels[:, :2], pixels[:, 2:]), scores[kept], labels[kept])


def decode_queries(outputs: Sequence[NDArray[Any]], size: tuple[int, int], lowest: float) -> RawDetections:
    """One row a query: centre and size as shares of the input, class scores."""
    table = _rows(outputs[0], None, axis=0, layout="queries")
    scores, labels = _best_class(table[:, 4:])
    kept = np.flatnonzero(scores >= lowest)
    if len(kept) and np.abs(table[kept, :4]).max() > NORMALISED:
        raise DetectorError("layout queries expects boxes as shares of the input, got pixels; name another layout=...")
    boxes = table[kept, :4].astype(np.float64) * np.array([size[1], size[0]] * 2)
    return RawDetections(_corners(boxes[:, :2], boxes[:, 2:]), scores[kept], labels[kept])


def decode_ultralytics(outputs: Sequence[NDArray[Any]], size: tuple[int, int], lowest: float) -> RawDetections:
    """One column an anchor: centre and size in input pixels, class scores, mask coefficients."""
    table = _rows(outputs[0], cell_count(size), axis=1, layout="ultralytics").T
    prototypes = _prototypes(outputs)
    end = table.shape[1] - (0 if prototypes is None else len(prototypes))
    scores, labels = _best_class(table[:, 4:end])
    kept = np.flatnonzero(scores >= lowest)
    return RawDetections(
        _corners(table[kept, :2].astype(np.float64), table[kept, 2:4].astype(np.float64)),
        scores[kept],
        labels[kept],
        None if prototypes is None else table[kept, end:],
        prototypes,
    )


def decode_end2end(outputs: Sequence[NDArray[Any]], size: tuple[int, int], lowest: float) -> RawDetections:
    """One row a detection: corners in input pixels, score, class, mask coefficients."""
    table = _rows(outputs[0], None, axis=0, layout="end2end")
    prototypes = _prototypes(outputs)
    table = table[table[:, 4] >= lowest]
    if len(table) and (np.abs(table[:, :4]).max() <= NORMALISED or (table[:, 5] != np.round(table[:, 5])).any()):
        raise DetectorError(
            "its output is not corners in pixels, score and class, as layout end2end (or corners) expects; name the "
            "right one with layout=..."
        )
    return RawDetections(
        table[:, :4].astype(np.float64),
        table[:, 4].astype(np.float64),
        table[:, 5].astype(np.int64),
        None if prototypes is None else table[:, 6:],
        prototypes,
    )


def decode_detr(outputs: Sequence[NDArray[Any]], size: tuple[int, int], lowest: float) -> RawDetections:
    """Labels, corners and scores of the queries; the runner names the input size as the original size."""
    shapes = [list(output.shape) for output in outputs]
    if [len(shape) for shape in shapes] != [2, 3, 2]:
        raise DetectorError(f"layout detr expects labels 1 x N, boxes 1 x N x 4 and scores 1 x N, got {shapes}")
    labels, boxes, scores = (output[0] for output in outputs)
    kept = scores >= lowest
    return RawDetections(boxes[kept].astype(np.float64), scores[kept].astype(np.float64), labels[kept].astype(np.int64))


LAYOUTS: dict[str, Layout] = {
    layout.name: layout
    for layout in (
        Layout("yolox", "corner", True, 1.0, True, decode_yolox),
        Layout("yolov5", "centre", False, 255.0, True, decode_yolov5),
        Layout("corners", "centre", False, 255.0, True, decode_end2end),
        Layout("queries", "stretch", False, 255.0, False, decode_queries),
        Layout("ultralytics", "centre", False, 255.0, True, decode_ultralytics),
        Layout("end2end", "centre", False, 255.0, False, decode_end2end),
        Layout("detr", "stretch", False, 255.0, False, decode_detr),
    )
}


def _rows(output: NDArray[Any], count: int | None, axis: int, layout: str) -> NDArray[Any]:
    """The one image's table of an output, checked to have ``count`` anchors along ``axis``."""
    if output.ndim != 3 or (count is not None and output.shape[1 + axis] != count):
        expected = f"1 x {count} x C" if axis == 0 else f"1 x C x {count}"
        raise DetectorError(f"layout {layout} expects an output {expected}, got {list(output.shape)}")
    table: NDArray[Any] = output[0]
    return table


def _best_class(scores: NDArray[Any]) -> tuple[FloatArray, IntArray]:
    labels = scores.argmax(axis=1)
    best = np.take_along_axis(scores, labels[:, None], axis=1)[:, 0]
    return best.astype(np.float64), labels.astype(np.int64)


def _prototypes(outputs: Sequence[NDArray[Any]]) -> NDArray[np.floating] | None:
    return outputs[1][0] if len(outputs) > 1 and outputs[1].ndim == 4 else None


def _corners(centres: FloatArray, sides: FloatArray) -> FloatArray:
    return np.concatenate([centres - sides / 2, centres + sides / 2], axis=1)


def _grid(size: tuple[int, int]) -> tuple[FloatArray, FloatArray]:
    """(M, 2) column and row of each cell, and (M,) its stride; finest grid first, row by row."""
    cells, strides = [], []
    for stride in STRIDES:
        rows, columns = np.mgrid[: size[0] // stride, : size[1] // stride]
        cells.append(np.stack([columns.ravel(), rows.ravel()], axis=1))
        strides.append(np.full(rows.size, stride))
    return np.concatenate(cells).astype(np.float64), np.concatenate(strides).astype(np.float64)
