"""Detection objects of other libraries, in memory, from and to ours.

Nothing is imported from those libraries: objects are read by the fields that they have. Tensors may need gradients, be
of half precision or live on any device. What each library calls its classes is kept; `lcf3d.detectors.classes` maps
names. `Detections2D.from_supervision` and the like are the same functions.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lcf3d.errors import ConfigError, DetectorError, Lcf3dError, MissingExtraError
from lcf3d.formats.objects3d import as_array, field_of
from lcf3d.structures import Detections2D, Detections3D, InstanceMask


def from_supervision(detections: Any, class_names: Sequence[str] | None = None) -> Detections2D:
    """From ``supervision.Detections``.

    Args:
        detections: with ``xyxy``, ``confidence`` (1 if None), ``class_id``, and ``mask`` (dense or compact) if it has.
        class_names: what ``class_id`` counts; without it the names in ``data["class_name"]``.

    Raises:
        DetectorError: neither class ids with names nor names, or no such object.
    """
    boxes = as_array(field_of(detections, "xyxy", "a supervision Detections"))
    confidence = getattr(detections, "confidence", None)
    scores = np.ones(len(boxes)) if confidence is None else as_array(confidence)
    given = dict(getattr(detections, "data", None) or {}).get("class_name")
    if class_names is None:
        if given is None and len(boxes):
            raise DetectorError("these supervision Detections hold no class names: give class_names")
        names = [str(name) for name in (() if given is None else given)]
        class_names = tuple(dict.fromkeys(names))
        labels = np.array([class_names.index(name) for name in names], dtype=np.int64)
    else:
        ids = getattr(detections, "class_id", None)
        if ids is None:
            raise DetectorError("these supervision Detections have no class_id, so that class_names say nothing")
        labels = as_array(ids)
    mask = getattr(detections, "mask", None)
    if mask is not None and hasattr(mask, "to_dense"):
        mask = mask.to_dense()
    return _detections(boxes, scores, labels, class_names, mask)


def from_ultralytics(result: Any, class_names: Sequence[str] | None = None) -> Detections2D:
    """From one ``ultralytics`` ``Results`` (of the list that a model returns), with its masks.

    Masks of the network's size are taken from their outlines, which are in the pixels of the image.

    Args:
        result: with ``boxes``, ``names``, ``orig_shape`` and, of a segmentation model, ``masks``.
        class_names: in place of the result's own names.

    Raises:
        DetectorError: no such object, or one without upright boxes (classification, oriented boxes).
    """
    boxes = getattr(result, "boxes", None)
    if boxes is None:
        raise DetectorError("expected an ultralytics Results with boxes, one of the list that the model returns")
    names = class_names
    if names is None:
        own = field_of(result, "names", "an ultralytics Results")
        names = [own[i] for i in range(max(own) + 1)] if isinstance(own, Mapping) else list(own)
    masks = getattr(result, "masks", None)
    bitmaps: Any = None
    if masks is not None:
        height, width = (int(v) for v in result.orig_shape)
        bitmaps = as_array(masks.data)
        if bitmaps.shape[1:] != (height, width):
            bitmaps = [_filled(outline, height, width) for outline in masks.xy]
    return _detections(as_array(boxes.xyxy), as_array(boxes.conf), as_array(boxes.cls), names, bitmaps)


def from_torchvision(prediction: Mapping[str, Any], class_names: Sequence[str]) -> Detections2D:
    """From one dictionary of the list that a torchvision detection model returns.

    Args:
        prediction: ``boxes``, ``scores``, ``labels`` and, of Mask R-CNN, ``masks`` (N, 1, H, W) of probabilities.
        class_names: ``weights.meta["categories"]``, the background first, as ``labels`` count.

    Raises:
        DetectorError: no such dictionary.
    """
    what = "a prediction of torchvision"
    masks = prediction.get("masks") if isinstance(prediction, Mapping) else None
    if masks is not None:
        masks = as_array(masks)[:, 0] > 0.5
    return _detections(
        as_array(field_of(prediction, "boxes", what)),
        as_array(field_of(prediction, "scores", what)),
        as_array(field_of(prediction, "labels", what)),
        class_names,
        masks,
    )


def from_mmdet(sample: Any, class_names: Sequence[str]) -> Detections2D:
    """From a ``DetDataSample`` of mmdetection 3, or its ``pred_instances``.

    Args:
        sample: with ``bboxes``, ``scores``, ``labels`` and, where the model has them, ``masks``.
        class_names: ``model.dataset_meta["classes"]``.

    Raises:
        DetectorError: no such object.
    """
    instances, what = getattr(sample, "pred_instances", sample), "a DetDataSample of mmdet"
    boxes = field_of(instances, "bboxes", what)
    masks = getattr(instances, "masks", None)
    if masks is not None:
        masks = as_array(getattr(masks, "masks", masks))
    return _detections(
        as_array(getattr(boxes, "tensor", boxes)),
        as_array(field_of(instances, "scores", what)),
        as_array(field_of(instances, "labels", what)),
        class_names,
        masks,
    )


def to_supervision(detections: Detections2D, image_size: tuple[int, int] | None = None) -> Any:
    """``supervision.Detections`` with the names of the classes in ``data["class_name"]``.

    Args:
        detections: ours.
        image_size: height and width of the image; masks need it, and are left out without it.

    Raises:
        Lcf3dError: supervision is not installed.
    """
    try:
        import supervision
    except ModuleNotFoundError:
        raise Lcf3dError("to_supervision needs supervision; install it with: pip install supervision") from None
    masks = None
    if detections.masks is not None and image_size is not None:
        masks = np.zeros((len(detections), *image_size), dtype=bool)
        for row, mask in zip(masks, detections.masks, strict=True):
            if mask is not None and mask.bitmap.size:
                place = row[mask.y : mask.y + mask.bitmap.shape[0], mask.x : mask.x + mask.bitmap.shape[1]]
                place[:] = mask.bitmap[: place.shape[0], : place.shape[1]]
    return supervision.Detections(
        xyxy=np.array(detections.boxes),
        mask=masks,
        confidence=np.array(detections.scores),
        class_id=np.array(detections.labels),
        data={"class_name": _names(detections)},
    )


def to_dataframe(detections: Detections2D | Detections3D) -> Any:
    """A pandas ``DataFrame``, a row a detection.

    Columns: of 2D ``x1 y1 x2 y2``, of 3D ``x y z length width height yaw``; ``score``, ``class_name``; and of 3D, where
    there are any, ``velocity_x velocity_y`` and ``attribute``.

    Raises:
        MissingExtraError: pandas is not installed.
    """
    try:
        import pandas  # type: ignore[import-untyped]
    except ModuleNotFoundError:
        raise MissingExtraError("pandas", "formats", "a table of detections") from None
    flat = isinstance(detections, Detections2D)
    places = ("x1", "y1", "x2", "y2") if flat else ("x", "y", "z", "length", "width", "height", "yaw")
    columns: dict[str, Any] = dict(zip(places, np.array(detections.boxes).T, strict=True))
    columns["score"], columns["class_name"] = np.array(detections.scores), _names(detections)
    if isinstance(detections, Detections3D):
        if detections.velocities is not None:
            columns["velocity_x"], columns["velocity_y"] = np.array(detections.velocities).T
        if detections.attributes is not None:
            columns["attribute"] = np.array(detections.attributes)
    return pandas.DataFrame(columns)


def _names(detections: Detections2D | Detections3D) -> NDArray[np.str_]:
    return np.array([detections.class_names[i] for i in detections.labels], dtype=np.str_)


def _detections(boxes: Any, scores: Any, labels: Any, class_names: Sequence[str], masks: Any) -> Detections2D:
    """Ours, from arrays; ``masks`` are (N, H, W) or None."""
    found = None if masks is None else tuple(InstanceMask.from_image(mask) for mask in masks)
    if isinstance(class_names, str):
        raise ConfigError(f"class_names must be a sequence of names, got the single text {class_names!r}")
    return Detections2D(boxes, scores, np.asarray(labels).astype(np.int64), tuple(class_names), found)


def _filled(outline: NDArray[np.floating], height: int, width: int) -> NDArray[np.uint8]:
    """(H, W) the inside of an (M, 2) outline in pixels."""
    from PIL import Image, ImageDraw

    picture = Image.new("L", (width, height))
    if len(outline) > 2:
        ImageDraw.Draw(picture).polygon([(float(x), float(y)) for x, y in outline], fill=1, outline=1)
    return np.asarray(picture)
