"""Camera detectors as ONNX files, run by onnxruntime on the CPU."""

from __future__ import annotations

import ast
import logging
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lcf3d.detectors.base import Image
from lcf3d.detectors.camera.onnx_images import Placement, instance_masks, prepare_image
from lcf3d.detectors.camera.onnx_layouts import LAYOUTS, SIZES_INPUT, class_count, identify_layout, tell_by_values
from lcf3d.detectors.camera.tiling import merge_tiles, non_maximum_suppression, tile_spans
from lcf3d.detectors.classes import COCO_CLASSES, read_class_names, reported_classes, to_classes
from lcf3d.errors import ConfigError, DetectorError, ShapeError
from lcf3d.files import shortened
from lcf3d.networks.onnx import first_line, open_session, read_metadata
from lcf3d.structures import KITTI_CLASSES, Detections2D

log = logging.getLogger(__name__)

# input side for networks that leave it open and do not record it either
DEFAULT_SIZE = 640
# no image holds more objects than this; bounds the cost of suppression
MAX_CANDIDATES = 1000
_IMAGE_TYPES = {"tensor(float)": np.float32, "tensor(float16)": np.float16}


class OnnxDetector:
    """A camera detector in an ONNX file: YOLOX, Ultralytics exports, RT-DETR, D-FINE, DEIM (see `onnx_layouts`).

    Args:
        path: the ONNX file.
        class_names: classes the detections shall have; the network's own are mapped by name, persons on bicycles become
            cyclists (`lcf3d.detectors.classes`).
        tiles: 1 looks at the whole image only; more add a pass over each of so many overlapping tiles, side by side.
        score_threshold: detections below it are left out (before classes are mapped).
        iou_threshold: boxes of a class that overlap more are one object.
        layout: ``auto``, or a name of `LAYOUTS` where the graph's own inputs and outputs mislead.
        size: side of the network's input in pixels, or ``HEIGHTxWIDTH``; only for networks that leave it open.
        names: the network's own classes in their order: a sequence, a comma-separated string or a text file with one
            name a line. Otherwise its metadata are asked, then COCO is assumed where the number of classes allows.
        mapping: own class name to target name, where the automatic mapping is not wanted; empty drops the class.
        normalize: ``none``, or ``imagenet`` for networks that want mean and deviation of ImageNet taken out.
        threads: threads of onnxruntime; 0 takes all cores.

    Raises:
        DetectorError: the file is absent, broken or not a detector of a known layout.
        ConfigError: a setting makes no sense.
    """

    def __init__(
        self,
        path: str | Path,
        class_names: Sequence[str] = KITTI_CLASSES,
        tiles: int = 1,
        score_threshold: float = 0.1,
        iou_threshold: float = 0.6,
        layout: str = "auto",
        size: int | str | None = None,
        names: str | Sequence[str] | None = None,
        mapping: Mapping[str, str] | None = None,
        normalize: str = "none",
        threads: int = 0,
    ) -> None:
        _check_settings(tiles, score_threshold, iou_threshold, layout, normalize)
        self.path = Path(path)
        self.class_names = tuple(class_names)
        self._tiles = tiles
        self._score_threshold = score_threshold
        self._iou_threshold = iou_threshold
        self._mapping = mapping
        self._imagenet = normalize == "imagenet"
        self._session = open_session(self.path, threads, "a camera detector")
        metadata = read_metadata(self._session, path)
        image_input = self._image_input()
        self._image_name: str = image_input.name
        self._dtype = _IMAGE_TYPES[image_input.type]
        self._size = self._input_size(image_input.shape[2:], size, metadata)
        self._require_detector(image_input, metadata)
        shapes = self._output_shapes()
        recorded = read_class_names(names) if names is not None else _metadata_names(metadata)
        try:
            chosen = layout
            if layout == "auto":
                chosen = identify_layout(self._input_names(), shapes, self._size, len(recorded or ()) or None)
            if "/" in chosen:
                chosen = tell_by_values(chosen, self._run_empty(list(shapes))[0])
        except DetectorError as error:
            raise DetectorError(f"{self.path} is not a usable camera detector: {error}") from None
        self._layout = LAYOUTS[chosen]
        # the graph may list its outputs in any order
        self._outputs = ["labels", "boxes", "scores"] if chosen == "detr" else list(shapes)
        if not set(self._outputs) <= set(shapes):
            raise DetectorError(f"{self.path}: layout detr needs outputs labels, boxes and scores, got {list(shapes)}")
        self.own_class_names = self._own_names(recorded, class_count(chosen, list(shapes.values())))
        if not self.reports:
            raise DetectorError(
                f"{self.path}: none of its classes ({shortened(', '.join(self.own_class_names))}) has a counterpart "
                f"among {', '.join(self.class_names)}; say what they are with names=NAME,NAME,..."
            )

    @property
    def layout(self) -> str:
        """Name of the output layout in use."""
        return self._layout.name

    @property
    def reports(self) -> tuple[str, ...]:
        """The target classes that the network can report."""
        return reported_classes(self.own_class_names, self.class_names, self._mapping)

    def __call__(self, images: Sequence[Image]) -> list[Detections2D]:
        """Detections of each (H, W, 3) uint8 RGB image, by descending score, in the target classes."""
        return [self._detect(np.asarray(image)) for image in images]

    def _detect(self, image: Image) -> Detections2D:
        if image.ndim != 3 or image.shape[2] != 3 or image.dtype != np.uint8 or not image.size:
            raise ShapeError(f"an image must be (H, W, 3) uint8 RGB, got {image.shape} {image.dtype}")
        found = self._forward(image)
        if self._tiles > 1:
            width = image.shape[1]
            spans = tile_spans(width, self._tiles)
            parts = [self._forward(np.ascontiguousarray(image[:, start:stop])) for start, stop in spans]
            found = merge_tiles(found, parts, spans, width, self._iou_threshold)
        mapped = to_classes(found, self.class_names, self._mapping)
        return mapped[np.argsort(-mapped.scores, kind="stable")]

    def inputs(self, image: Image) -> dict[str, NDArray[Any]]:
        """What the network is given for an (H, W, 3) uint8 RGB image, by the names of its inputs."""
        return self._inputs(self._prepared(image)[0])

    def _prepared(self, image: Image) -> tuple[NDArray[np.float32], Placement]:
        return prepare_image(image, self._size, self._layout, self._imagenet)

    def _forward(self, image: Image) -> Detections2D:
        """One pass over one image or tile, in the network's own classes."""
        values, placement = self._prepared(image)
        outputs = self._run(values)
        try:
            raw = self._layout.decode(outputs, self._size, self._score_threshold)
        except DetectorError as error:
            raise DetectorError(f"{self.path}: {error}") from None
        boxes = placement.to_image(raw.boxes)
        usable = np.isfinite(boxes).all(axis=1) & (boxes[:, 2:] > boxes[:, :2]).all(axis=1)
        kept = np.flatnonzero(usable)
        kept = kept[np.argsort(-raw.scores[kept], kind="stable")[:MAX_CANDIDATES]]
        if self._layout.overlapping:
            kept = kept[non_maximum_suppression(boxes[kept], raw.scores[kept], raw.labels[kept], self._iou_threshold)]
        labels = raw.labels[kept]
        if len(labels) and not (labels.min() >= 0 and labels.max() < len(self.own_class_names)):
            raise DetectorError(
                f"{self.path} gave class {labels.max()} but {len(self.own_class_names)} class names are known; "
                "give them with names=..."
            )
        masks = None
        if raw.coefficients is not None and raw.prototypes is not None:
            masks = instance_masks(raw.coefficients[kept], raw.prototypes, boxes[kept], placement, self._size)
        scores = np.clip(raw.scores[kept], 0, 1)
        return Detections2D(boxes[kept], scores, labels, self.own_class_names, masks)

    def _inputs(self, values: NDArray[np.float32]) -> dict[str, NDArray[Any]]:
        inputs: dict[str, NDArray[Any]] = {self._image_name: values.astype(self._dtype, copy=False)}
        if SIZES_INPUT in self._input_names():
            # width before height; naming the input's own size keeps the boxes in its pixels
            inputs[SIZES_INPUT] = np.array([[self._size[1], self._size[0]]], dtype=np.int64)
        return inputs

    def _run(self, values: NDArray[np.float32]) -> list[NDArray[Any]]:
        """The chosen outputs for one prepared input."""
        try:
            return list(self._session.run(self._outputs, self._inputs(values)))
        except Exception as error:  # onnxruntime's exceptions share no base class
            raise DetectorError(f"{self.path} cannot be run on an image: {first_line(error)}") from error

    def _input_names(self) -> list[str]:
        return [node.name for node in self._session.get_inputs()]

    def _image_input(self) -> Any:
        """The graph's image input, the only one beside ``orig_target_sizes``."""
        nodes = [node for node in self._session.get_inputs() if node.name != SIZES_INPUT]
        if (
            len(nodes) == 1
            and len(nodes[0].shape) == 4
            and nodes[0].type in _IMAGE_TYPES
            and nodes[0].shape[1] in (3, None)
        ):
            return nodes[0]
        described = ", ".join(f"{node.name} {node.shape} {node.type}" for node in self._session.get_inputs())
        raise DetectorError(
            f"{self.path} is not a camera detector: expected one float image input 1 x 3 x H x W "
            f"(and at most {SIZES_INPUT} beside it), got {described}"
        )

    def _input_size(
        self, dimensions: Sequence[Any], wanted: int | str | None, metadata: Mapping[str, str]
    ) -> tuple[int, int]:
        """(height, width) of the input: of the graph, else ``wanted``, else of the metadata, else the default."""
        asked = _parse_size(wanted)
        fixed = tuple(d if isinstance(d, int) and d > 0 else None for d in dimensions)
        if asked is None:
            recorded = _literal(metadata.get("imgsz"), list)
            told = recorded is not None and len(recorded) == 2 and all(isinstance(n, int) and n > 0 for n in recorded)
            asked = (recorded[0], recorded[1]) if told else (DEFAULT_SIZE,) * 2
        elif any(f is not None and f != a for f, a in zip(fixed, asked, strict=True)):
            raise ConfigError(f"{self.path} has a fixed input of {fixed[0]} x {fixed[1]}; leave size={wanted} out")
        return (fixed[0] or asked[0], fixed[1] or asked[1])

    def _output_shapes(self) -> dict[str, tuple[int, ...]]:
        """Shape of each output by name; a network that leaves some open is run once to see them."""
        nodes = self._session.get_outputs()
        shapes = {node.name: tuple(node.shape) for node in nodes}
        if all(isinstance(d, int) and d > 0 for shape in shapes.values() for d in shape):
            return shapes
        outputs = self._run_empty(list(shapes))
        return {node.name: np.shape(output) for node, output in zip(nodes, outputs, strict=True)}

    def _run_empty(self, outputs: list[str]) -> list[NDArray[Any]]:
        """The outputs for an empty image."""
        self._outputs = outputs
        return self._run(np.zeros((1, 3, *self._size), dtype=np.float32))

    def _require_detector(self, image_input: Any, metadata: Mapping[str, str]) -> None:
        """Refuse exports that take several images at once, or give something else than boxes."""
        batch = image_input.shape[0]
        if isinstance(batch, int) and batch != 1:
            raise DetectorError(f"{self.path} takes a fixed batch of {batch} images; export it for one (batch=1)")
        task = metadata.get("task", "detect")
        if task not in ("detect", "segment"):
            raise DetectorError(
                f"{self.path} is an export for the task {shortened(task, 20)!r}; expected a detector of upright boxes "
                "(task detect or segment)"
            )

    def _own_names(self, names: tuple[str, ...] | None, count: int | None) -> tuple[str, ...]:
        """The network's own class names, from the user or its metadata, else COCO's; checked against their number."""
        if names is None and count in (None, len(COCO_CLASSES)):
            log.warning(
                "%s does not name its classes: COCO is assumed; names=NAME,NAME,... says otherwise",
                self.path,
            )
            names = COCO_CLASSES
        if names is None:
            raise DetectorError(f"{self.path} has {count} classes and does not name them; name them with names=...")
        if count is not None and len(names) != count:
            raise DetectorError(f"{self.path} has {count} classes but {len(names)} names were given or recorded")
        return names


def _check_settings(tiles: int, score_threshold: float, iou_threshold: float, layout: str, normalize: str) -> None:
    if tiles < 1:
        raise ConfigError(f"tiles must be 1 or more, got {tiles}")
    for name, value in (("score_threshold", score_threshold), ("iou_threshold", iou_threshold)):
        if not 0 <= value <= 1:
            raise ConfigError(f"{name} must be in [0, 1], got {value}")
    if layout != "auto" and layout not in LAYOUTS:
        raise ConfigError(f"unknown layout {layout!r}; expected auto, {', '.join(LAYOUTS)}")
    if normalize not in ("none", "imagenet"):
        raise ConfigError(f"normalize must be none or imagenet, got {normalize!r}")


def _parse_size(size: int | str | None) -> tuple[int, int] | None:
    """(height, width) from a side or ``HEIGHTxWIDTH``."""
    if size is None:
        return None
    sides = str(size).lower().split("x")
    try:
        height, width = (int(sides[0]), int(sides[-1])) if len(sides) <= 2 else (0, 0)
    except ValueError:
        height = width = 0
    if height < 32 or width < 32 or height % 32 or width % 32:
        raise ConfigError(f"size must be a multiple of 32 pixels or HEIGHTxWIDTH of such, got {size!r}")
    return height, width


def _metadata_names(metadata: Mapping[str, str]) -> tuple[str, ...] | None:
    """Names from the ``names`` that Ultralytics records as a Python dictionary or list."""
    names = _literal(metadata.get("names"), dict) or _literal(metadata.get("names"), list)
    if isinstance(names, dict):
        try:
            names = [names[key] for key in sorted(names, key=int)]
        except (ValueError, TypeError, OverflowError):
            return None
    return tuple(str(name) for name in names) if names else None


def _literal(text: str | None, kind: type) -> Any:
    """The Python literal in ``text`` if it is one of ``kind``, else None."""
    try:
        value = ast.literal_eval(text or "")
    except (ValueError, SyntaxError, TypeError, MemoryError, RecursionError):
        return None
    return value if isinstance(value, kind) else None
