"""What the image says of each point: class scores of a segmentation network, or of instance masks."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from lcf3d import plugins
from lcf3d.detectors.base import CameraDetector, Image
from lcf3d.detectors.camera.onnx_images import IMAGENET_MEAN, IMAGENET_STD
from lcf3d.detectors.classes import class_mapping, read_class_names
from lcf3d.detectors.named import load_detector
from lcf3d.detectors.resizing import resize_bilinear
from lcf3d.errors import ConfigError, DetectorError
from lcf3d.structures import FloatArray

# fmt: off
VOC_CLASSES = (
    "background", "aeroplane", "bicycle", "bird", "boat", "bottle", "bus", "car", "cat", "chair", "cow", "diningtable",
    "dog", "horse", "motorbike", "person", "pottedplant", "sheep", "sofa", "train", "tvmonitor",
)
# fmt: on
"""Classes of torchvision's segmentation networks."""
SEGMENTATION_MODELS = (
    "deeplabv3_mobilenet_v3_large",
    "deeplabv3_resnet50",
    "deeplabv3_resnet101",
    "fcn_resnet50",
    "fcn_resnet101",
    "lraspp_mobilenet_v3_large",
)
STRIDE = 32
"""Images go to networks that take any size in multiples of it."""


class Painter(Protocol):
    """Gives points in an image their class scores."""

    def __call__(self, image: Image, pixels: FloatArray) -> NDArray[np.float32]:
        """(M, K) scores from 0 to 1 of the classes it was made for.

        Args:
            image: (H, W, 3) uint8 RGB.
            pixels: (M, 2) where the points lie, all inside the image.
        """
        ...


class MaskPainter:
    """Scores of instance masks: a point takes the highest score of the masks of a class that it falls on.

    Args:
        detector: a camera detector with masks.
        class_names: classes of the scores.
    """

    def __init__(self, detector: CameraDetector, class_names: Sequence[str]) -> None:
        self.detector, self.class_names = detector, tuple(class_names)

    def __call__(self, image: Image, pixels: FloatArray) -> NDArray[np.float32]:
        """See `Painter`.

        Raises:
            DetectorError: the detector has no masks.
        """
        found = self.detector([image])[0].with_classes(self.class_names)
        scores = np.zeros((len(pixels), len(self.class_names)), np.float32)
        if found.masks is None and len(found):
            raise DetectorError(
                "the camera detector gives no instance masks to paint points with; name one that has them, for example "
                "masks:shipped:kitti or masks:torchvision:maskrcnn_resnet50_fpn"
            )
        for mask, score, label in zip(found.masks or (), found.scores, found.labels, strict=True):
            if mask is not None:
                on = mask.contains(pixels)
                scores[on, label] = np.maximum(scores[on, label], np.float32(score))
        return scores


class SegmentationPainter:
    """Scores of a network that says of every pixel what it shows.

    Args:
        segment: from the (1, 3, h, w) float32 input to (C, h', w') logits or probabilities, or (h', w') class indices.
        own_classes: the network's classes, in order.
        class_names: classes of the scores; the network's own go there by name, several to one are added up.
        size: (height, width) that images are stretched to; their own, in multiples of `STRIDE`, without it.
        imagenet: take mean and deviation of ImageNet out of the images.

    Raises:
        ConfigError: no class of the network is one of ``class_names``.
    """

    def __init__(
        self,
        segment: Callable[[NDArray[np.float32]], NDArray[Any]],
        own_classes: Sequence[str],
        class_names: Sequence[str],
        size: tuple[int, int] | None = None,
        imagenet: bool = True,
    ) -> None:
        mapping = class_mapping(tuple(own_classes), tuple(class_names))
        if not mapping:
            raise ConfigError(
                f"the segmentation network knows none of {', '.join(class_names)}; its classes: "
                f"{', '.join(own_classes)}"
            )
        self.segment, self.size, self.imagenet = segment, size, imagenet
        self.table = np.zeros((len(own_classes), len(class_names)), np.float32)
        for row, name in enumerate(own_classes):
            if name in mapping:
                self.table[row, tuple(class_names).index(mapping[name])] = 1.0

    def __call__(self, image: Image, pixels: FloatArray) -> NDArray[np.float32]:
        """See `Painter`.

        Raises:
            DetectorError: the network's output is no segmentation in its classes.
        """
        height, width = image.shape[:2]
        tall, wide = self.size or (-(-height // STRIDE) * STRIDE, -(-width // STRIDE) * STRIDE)
        values = resize_bilinear(image, wide, tall).astype(np.float32) / 255
        if self.imagenet:
            values = (values - IMAGENET_MEAN) / IMAGENET_STD
        output = np.asarray(self.segment(np.ascontiguousarray(values.transpose(2, 0, 1)[None])))
        scale = np.array([output.shape[-1] / width, output.shape[-2] / height])
        column, row = np.minimum((pixels * scale).astype(np.int64), np.array(output.shape[:-3:-1]) - 1).T
        return self._scores(output, row, column)

    def _scores(self, output: NDArray[Any], row: Any, column: Any) -> NDArray[np.float32]:
        classes = len(self.table)
        if output.ndim == 2:
            indices = output[row, column].astype(np.int64)
            known = (indices >= 0) & (indices < classes)
            painted: NDArray[np.float32] = self.table[np.where(known, indices, 0)] * known[:, None]
            return painted
        if output.ndim != 3 or len(output) != classes:
            raise DetectorError(
                f"the segmentation network gives an output of shape {output.shape}, expected ({classes}, h, w) scores "
                "of its classes or (h, w) class indices; name its classes with classes=..."
            )
        values = output[:, row, column].T.astype(np.float32)
        if not len(values) or (values.min() >= 0 and np.allclose(values.sum(axis=1), 1, atol=1e-3)):
            probabilities = values
        else:
            powers = np.exp(values - values.max(axis=1, keepdims=True))
            probabilities = powers / powers.sum(axis=1, keepdims=True)
        summed: NDArray[np.float32] = np.minimum(probabilities @ self.table, 1.0)
        return summed


def masks_painter(argument: str, class_names: Sequence[str], score_threshold: float = 0.1) -> MaskPainter:
    """``masks:CAMERA``: instance masks of a camera detector, ``masks:shipped:kitti`` for the one that comes along."""
    return MaskPainter(
        load_detector(argument, "camera", class_names, {"score_threshold": score_threshold}), class_names
    )


def onnx_painter(
    argument: str,
    class_names: Sequence[str],
    classes: str = "",
    size: str = "",
    normalize: str = "imagenet",
    threads: int = 0,
) -> SegmentationPainter:
    """``onnx:FILE?classes=NAMES``: a semantic segmentation network.

    Args:
        argument: the file; its input is (1, 3, H, W).
        class_names: classes of the scores.
        classes: the network's own classes in order, comma-separated or a file with one a line.
        size: ``HEIGHTxWIDTH`` of the input, where the file leaves it open.
        normalize: ``imagenet`` or ``none`` (0 to 1).
        threads: of onnxruntime; 0 takes all cores.

    Raises:
        ConfigError: a setting makes no sense.
        DetectorError: the file is absent or no such network.
    """
    from lcf3d.networks.onnx import open_session

    if not classes:
        raise ConfigError("a segmentation network needs its classes in order: onnx:FILE?classes=road,car,person,...")
    if normalize not in ("imagenet", "none"):
        raise ConfigError(f"normalize takes imagenet or none, got {normalize!r}")
    # a single number is read as one
    asked = _size(str(size))
    session = open_session(Path(argument), threads, "a segmentation network")
    inputs = session.get_inputs()
    shape: Sequence[Any] = inputs[0].shape if len(inputs) == 1 else ()
    if len(shape) != 4 or shape[1] != 3:
        raise DetectorError(f"{argument} takes {[i.shape for i in inputs]}, expected one image of shape (1, 3, H, W)")
    fixed = [side for side in shape[2:] if isinstance(side, int)]
    wanted = (fixed[0], fixed[1]) if len(fixed) == 2 else asked

    def segment(image: NDArray[np.float32]) -> NDArray[Any]:
        output = np.asarray(session.run(None, {inputs[0].name: image})[0])[0]
        map_of_classes: NDArray[Any] = output[0] if output.ndim == 3 and len(output) == 1 else output
        return map_of_classes

    return SegmentationPainter(segment, read_class_names(classes), class_names, wanted, normalize == "imagenet")


def torchvision_painter(
    argument: str, class_names: Sequence[str], checkpoint: str = "", classes: str = "", device: str = "cpu"
) -> SegmentationPainter:
    """``torchvision:NAME``: a segmentation network of torchvision with its COCO weights, or a checkpoint.

    Args:
        argument: one of `SEGMENTATION_MODELS`.
        class_names: classes of the scores.
        checkpoint: file of parameters; torchvision's own, downloaded at first use, without it.
        classes: the checkpoint's own classes in order, background included; `VOC_CLASSES` without them.
        device: torch device.

    Raises:
        ConfigError: there is no such network.
        DetectorError: the weights cannot be had, or are another network's.
        MissingExtraError: torch or torchvision is not installed.
    """
    from lcf3d.detectors.camera.torchvision_models import coco_parameters
    from lcf3d.networks.checkpoints import load_parameters, read_state_dict
    from lcf3d.networks.torch import torch, torch_device, torchvision

    if argument not in SEGMENTATION_MODELS:
        raise ConfigError(
            f"unknown segmentation network {argument!r} of torchvision; expected one of: "
            f"{', '.join(SEGMENTATION_MODELS)}"
        )
    own = read_class_names(classes) if classes else VOC_CLASSES
    state = read_state_dict(Path(checkpoint)) if checkpoint else coco_parameters(argument)
    # the auxiliary classifier serves training only
    state = {name: value for name, value in state.items() if not name.startswith("aux_classifier.")}
    network = torchvision().models.get_model(argument, weights=None, weights_backbone=None, num_classes=len(own))
    load_parameters(network, state, checkpoint or argument)
    network.eval().requires_grad_(False).to(torch_device(device))

    def segment(image: NDArray[np.float32]) -> NDArray[Any]:
        with torch.inference_mode():
            values: NDArray[Any] = network(torch.from_numpy(image).to(device))["out"][0].cpu().numpy()
        return values

    return SegmentationPainter(segment, own, class_names)


PAINTERS: Mapping[str, Callable[..., Painter]] = {
    "masks": masks_painter,
    "onnx": onnx_painter,
    "torchvision": torchvision_painter,
}
"""Kinds of painters by name."""


def load_painter(text: str, class_names: Sequence[str]) -> Painter:
    """The painter that a string names: ``masks:CAMERA``, ``onnx:FILE?classes=...`` or ``torchvision:NAME``.

    Raises:
        ConfigError: an unknown kind or setting.
        DetectorError: it cannot be loaded.
    """
    spec = plugins.parse(text)
    if spec.kind not in PAINTERS or not spec.argument:
        raise ConfigError(f"a painter is masks:CAMERA, onnx:FILE?classes=... or torchvision:NAME, got {text!r}")
    call = PAINTERS[spec.kind]
    known = set(inspect.signature(call).parameters) - {"argument", "class_names"}
    unknown = sorted(set(spec.settings) - known)
    if unknown:
        raise ConfigError(
            f"painter {spec.kind!r} has no setting {unknown[0]!r}; its settings: {', '.join(sorted(known))}"
        )
    return call(spec.argument, tuple(class_names), **spec.settings)


def _size(text: str) -> tuple[int, int] | None:
    if not text:
        return None
    height, _, width = text.partition("x")
    if not (height.isdigit() and width.isdigit() and int(height) and int(width)):
        raise ConfigError(f"size takes HEIGHTxWIDTH in pixels, for example 384x1248, got {text!r}")
    return int(height), int(width)
