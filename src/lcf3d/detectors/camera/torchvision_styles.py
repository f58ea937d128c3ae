"""What the parameters of a Faster or Mask R-CNN of OpenMMLab do not tell, and what else in the file does.

Facts of the configurations of the LCF3D authors (KITTI, nuScenes), of the nuImages models of mmdetection3d 1.4.0 and of
the COCO models of mmdetection 3.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

from lcf3d.detectors.classes import COCO_CLASSES
from lcf3d.errors import ConfigError, DetectorError
from lcf3d.structures import KITTI_CLASSES

NORMALIZATIONS = ("pytorch", "caffe")

NUIMAGES_CLASSES = (
    "car",
    "truck",
    "trailer",
    "bus",
    "construction_vehicle",
    "bicycle",
    "motorcycle",
    "pedestrian",
    "traffic_cone",
    "barrier",
)


@dataclass(frozen=True)
class Style:
    """What a checkpoint's parameters do not tell.

    Attributes:
        ratios: height over width of the anchors.
        scale: side of the square anchor in strides.
        mean: subtracted from the image's channels, RGB.
        std: then divided by, RGB.
        bgr: channels in the order blue, green, red.
        caffe: the stride of a bottleneck is in its first convolution.
        image_size: longer and shorter side that the image is brought into, in pixels.
        iou_threshold: of the final suppression, per class.
        soft: that suppression lowers scores instead of removing boxes.
        classes: in the order of the checkpoint.
    """

    ratios: tuple[float, ...]
    scale: float
    mean: tuple[float, float, float]
    std: tuple[float, float, float]
    bgr: bool
    caffe: bool
    image_size: tuple[int, int]
    iou_threshold: float
    soft: bool
    classes: tuple[str, ...]


STYLES: dict[str, Style] = {
    "kitti": Style(
        (0.5, 1.0, 2.0, 3.0),
        4,
        (123.675, 116.28, 103.53),
        (58.395, 57.12, 57.375),
        bgr=False,
        caffe=False,
        image_size=(1333, 800),
        iou_threshold=0.7,
        soft=True,
        classes=KITTI_CLASSES,
    ),
    "nuscenes": Style(
        (0.5, 1.0, 2.0),
        8,
        (123.675, 116.28, 103.53),
        (1.0, 1.0, 1.0),
        bgr=True,
        caffe=True,
        image_size=(1600, 900),
        iou_threshold=0.5,
        soft=False,
        classes=NUIMAGES_CLASSES,
    ),
    "coco": Style(
        (0.5, 1.0, 2.0),
        8,
        (123.675, 116.28, 103.53),
        (58.395, 57.12, 57.375),
        bgr=False,
        caffe=False,
        image_size=(1333, 800),
        iou_threshold=0.5,
        soft=False,
        classes=COCO_CLASSES,
    ),
}


def normalized(style: Style, normalization: str) -> Style:
    """The style with the image normalization of backbones from ``pytorch`` or from ``caffe``.

    The former take RGB divided by its deviation, the latter BGR with only the mean taken out; with it goes where a
    bottleneck of the backbone strides.

    Raises:
        ConfigError: neither of the two.
    """
    if normalization not in NORMALIZATIONS:
        raise ConfigError(f"normalization must be {' or '.join(NORMALIZATIONS)}, got {normalization!r}")
    caffe = normalization == "caffe"
    return replace(style, bgr=caffe, caffe=caffe, std=(1.0, 1.0, 1.0) if caffe else STYLES["coco"].std)


def normalization_of(config: str) -> str | None:
    """The normalization that the text of a configuration in a checkpoint tells, None where it tells none."""
    backbone = re.search(r"style\s*=\s*['\"](caffe|pytorch)['\"]", config)
    if backbone:
        return backbone.group(1)
    order = re.search(r"\b(?:to_rgb|bgr_to_rgb)\s*=\s*(True|False)", config)
    return {"True": "pytorch", "False": "caffe"}[order.group(1)] if order else None


def parse_size(text: str) -> tuple[int, int]:
    """Longer and shorter side from ``LONGERxSHORTER``, in pixels.

    Raises:
        ConfigError: not of that form, or too small for the coarsest cells of the pyramid.
    """
    found = re.fullmatch(r"(\d{2,5})x(\d{2,5})", text)
    sides = (int(found.group(1)), int(found.group(2))) if found else (0, 0)
    if min(sides) < 64 or sides[0] < sides[1]:
        raise ConfigError(
            f"size must read LONGERxSHORTER, in pixels and 64 or more, for example 1333x800, got {text!r}"
        )
    return sides


def find_style(state: Mapping[str, Any], classes: tuple[str, ...] = ()) -> Style:
    """The style whose numbers of classes and anchors are those of the parameters.

    Args:
        state: parameter name -> tensor.
        classes: class names that the file tells; of as many classes as the parameters have, they are taken.

    Raises:
        DetectorError: none is, or the parameters are not of a Faster R-CNN.
    """
    names = ("roi_head.bbox_head.fc_cls.weight", "rpn_head.rpn_cls.weight")
    if not all(name in state for name in names):
        raise DetectorError(f"the checkpoint is no Faster R-CNN of OpenMMLab: it lacks {' and '.join(names)}")
    count, anchors = len(state[names[0]]) - 1, len(state[names[1]])
    told = classes if len(classes) == count else ()
    alike = [style for style in STYLES.values() if len(style.ratios) == anchors]
    for style in alike:
        if len(style.classes) == count:
            return replace(style, classes=told or style.classes)
    if told and alike:
        # a training of somebody's own classes, from the configuration that most start with
        return replace(alike[-1], classes=told)
    known = ", ".join(f"{name}: {len(s.classes)} and {len(s.ratios)}" for name, s in STYLES.items())
    raise DetectorError(f"no Faster R-CNN with {count} classes and {anchors} anchors a cell is known ({known})")
