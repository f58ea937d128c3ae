"""2D detections of many images: COCO results JSON with instance masks, and the simple list by sample and camera.

COCO results: a list of ``{"image_id", "category_id", "bbox": [x, y, w, h], "score", "segmentation"?}``, with
the images and categories named in a second file. Simple list: ``{"sample_token", "camera", "bbox": [x, y, w, h],
"score", "category_name", "segmentation"?}``. Boxes are pixels, x and y of the top-left corner.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lcf3d.detectors.joins import LeftOut, join_classes
from lcf3d.errors import FormatError
from lcf3d.files import read_json, shortened, write_json
from lcf3d.structures import Detections2D, InstanceMask

CameraDetections = dict[tuple[str, str], Detections2D]
"""Detections by (frame id, camera name)."""


MOST_MASK_PIXELS = 64_000_000
"""Larger masks are refused unread."""


def decode_mask(segmentation: Mapping[str, Any]) -> NDArray[np.bool_]:
    """(H, W) mask of a COCO run-length encoding.

    Runs alternate between background and object, begin with background and go down the columns. ``counts`` is a list
    of run lengths (uncompressed), or text that packs them five bits a character (compressed).

    Raises:
        FormatError: not such an encoding, or its runs do not add up to the image.
    """
    try:
        height, width = (int(n) for n in segmentation["size"])
        counts = segmentation["counts"]
        runs = np.array(unpack_counts(counts) if isinstance(counts, str | bytes) else counts, dtype=np.int64)
    except (KeyError, TypeError, ValueError, OverflowError):
        raise FormatError("a mask must be a COCO run-length encoding {'size': [h, w], 'counts': ...}") from None
    if height < 0 or width < 0 or runs.ndim != 1 or (runs < 0).any() or runs.sum() != height * width:
        raise FormatError(f"the runs of a mask add up to {runs.sum()} pixels, its size is {height} x {width}")
    if height * width > MOST_MASK_PIXELS:
        raise FormatError(f"a mask of {height} x {width} pixels is larger than any image")
    values = np.zeros(len(runs), dtype=bool)
    values[1::2] = True
    return np.repeat(values, runs).reshape(width, height).T


def encode_mask(mask: NDArray[Any], compressed: bool = True) -> dict[str, Any]:
    """COCO run-length encoding of an (H, W) mask; the inverse of `decode_mask`."""
    full = np.asarray(mask) != 0
    flat = full.T.reshape(-1)
    changes = np.flatnonzero(flat[1:] != flat[:-1]) + 1
    # the first run is background, of length 0 where the first pixel is the object's
    edges = np.concatenate([[0], [0] if len(flat) and flat[0] else [], changes, [len(flat)]]).astype(np.int64)
    runs = np.diff(edges).tolist()
    return {"size": list(full.shape), "counts": pack_counts(runs) if compressed else runs}


def unpack_counts(text: str | bytes) -> list[int]:
    """Run lengths of a compressed COCO encoding.

    Each character holds five bits, lowest first, and a sixth that says whether more follow; from the fourth number on
    they are differences to the number two before.

    Raises:
        ValueError: the text breaks off within a number or holds other characters.
    """
    numbers: list[int] = []
    value = shift = 0
    for code in text.encode("ascii") if isinstance(text, str) else text:
        bits = code - 48
        if not 0 <= bits < 64:
            raise ValueError(f"character {code} is not of a compressed mask")
        value |= (bits & 31) << shift
        shift += 5
        if not bits & 32:
            if bits & 16:
                value -= 1 << shift
            numbers.append(value + (numbers[-2] if len(numbers) > 2 else 0))
            value = shift = 0
    if shift:
        raise ValueError("the mask breaks off")
    return numbers


def pack_counts(runs: Sequence[int]) -> str:
    """Compressed COCO encoding of run lengths; the inverse of `unpack_counts`."""
    characters = []
    for i, run in enumerate(runs):
        value = run - runs[i - 2] if i > 2 else run
        while True:
            bits, value = value & 31, value >> 5
            more = not ((value == 0 and not bits & 16) or (value == -1 and bits & 16))
            characters.append(chr(48 + bits + 32 * more))
            if not more:
                break
    return "".join(characters)


def read_camera_detections(
    path: str | Path, class_names: Sequence[str], left_out: LeftOut | None = None, content: Any = None
) -> CameraDetections:
    """Detections of a simple list (see the module's text) by (sample token, camera), with masks where there are some.

    Classes that are none of ``class_names`` (`lcf3d.detectors.joins`) are left out and counted in ``left_out``;
    ``content`` is that of the file, where it was read already.

    Raises:
        FormatError: not such a list; the message names the record.
    """
    records = _records(path, content)
    return _group(path, records, lambda r: (str(r["sample_token"]), str(r["camera"])), class_names, left_out)


def write_camera_detections(path: str | Path, detections: Mapping[tuple[str, str], Detections2D]) -> None:
    """Write detections by (sample token, camera) as a simple list; masks are not written."""
    records = []
    for (token, camera), found in detections.items():
        for box, score, label in zip(found.boxes, found.scores, found.labels, strict=True):
            x1, y1, x2, y2 = box.tolist()
            records.append(
                {
                    "sample_token": token,
                    "camera": camera,
                    "bbox": [x1, y1, x2 - x1, y2 - y1],
                    "score": float(score),
                    "category_name": found.class_names[label],
                }
            )
    write_json(path, records, indent=None)


def read_coco_results(
    path: Path,
    class_names: Sequence[str],
    categories: Mapping[int, str],
    images: Mapping[int | str, tuple[str, str]],
    left_out: LeftOut | None = None,
    content: Any = None,
) -> CameraDetections:
    """Detections of a COCO results file by (frame id, camera), with masks where there are some.

    Args:
        path: the results, a JSON list.
        class_names: classes to keep; others are left out.
        categories: name by ``category_id`` (`read_coco_index`).
        images: (frame id, camera) by ``image_id`` (`read_coco_index`).
        left_out: counts detections of other classes.
        content: of the file, where it was read already.

    Raises:
        FormatError: not such a file, or it names an image or category that is not known.
    """
    records = _records(path, content)
    for i, record in enumerate(records):
        for key, known in (("category_id", categories), ("image_id", images)):
            if key not in record or not isinstance(record[key], int | str) or record[key] not in known:
                raise FormatError(
                    f"{path}: record {i} has {key} {shortened(record.get(key))}, which the index does not name"
                )
    named = [{**record, "category_name": categories[record["category_id"]]} for record in records]
    return _group(path, named, lambda r: images[r["image_id"]], class_names, left_out)


def read_coco_index(
    path: Path, frames_of_files: Mapping[str, tuple[str, str]], content: Any = None
) -> tuple[dict[int, str], dict[int | str, tuple[str, str]]]:
    """Names of categories by id, and (frame id, camera) of images by id, of a COCO annotation file.

    Args:
        path: JSON with ``categories`` and ``images``.
        frames_of_files: (frame id, camera) by image path; of a file name, as many last parts as tell them apart.
        content: of the file, where it was read already.

    Raises:
        FormatError: not such a file.
    """
    index = read_json(path) if content is None else content
    try:
        categories = {int(record["id"]): str(record["name"]) for record in index["categories"]}
        files = {record["id"]: str(record["file_name"]) for record in index["images"]}
    except (KeyError, TypeError, ValueError, OverflowError):
        raise FormatError(
            f"{path} must hold 'categories' with id and name and 'images' with id and file_name"
        ) from None
    frames = _by_path_end(frames_of_files)
    found = {i: _frame_of(name, frames, path) for i, name in files.items()}
    return categories, {i: frame for i, frame in found.items() if frame is not None}


def _by_path_end(frames_of_files: Mapping[str, tuple[str, str]]) -> dict[str, set[tuple[str, str]]]:
    """The frames whose image path ends in each sequence of its last parts."""
    found: dict[str, set[tuple[str, str]]] = {}
    for name, frame in frames_of_files.items():
        parts = Path(name).parts
        for first in range(len(parts)):
            found.setdefault("/".join(parts[first:]), set()).add(frame)
    return found


def _frame_of(name: str, frames: Mapping[str, set[tuple[str, str]]], path: Path) -> tuple[str, str] | None:
    """The frame of a file name: of as many of its last parts as are needed to tell.

    Raises:
        FormatError: several images end in the whole name.
    """
    parts = Path(name).parts
    for first in range(len(parts)):
        candidates = frames.get("/".join(parts[first:]), set())
        if len(candidates) == 1:
            return next(iter(candidates))
        if candidates:
            raise FormatError(
                f"{path}: {shortened(name)} fits {len(candidates)} images of the dataset; write more of their paths "
                "into file_name"
            )
    return None


def read_coco_annotations(
    path: Path,
    class_names: Sequence[str],
    frames_of_files: Mapping[str, tuple[str, str]],
    left_out: LeftOut | None = None,
    content: Any = None,
) -> CameraDetections:
    """2D boxes of a COCO file with ``images``, ``categories`` and ``annotations``; those without a score get 1.

    Args:
        path: the file.
        class_names: classes to keep; others are left out.
        frames_of_files: see `read_coco_index`.
        left_out: counts detections of other classes, and of images that are none of the dataset's.
        content: of the file, where it was read already.

    Raises:
        FormatError: not such a file, or none of its images is known.
    """
    content = read_json(path) if content is None else content
    categories, images = read_coco_index(path, frames_of_files, content)
    records = content.get("annotations")
    if not isinstance(records, list) or not all(isinstance(record, dict) for record in records):
        raise FormatError(f"{path} must hold 'annotations', a list of records")
    if not images:
        raise FormatError(f"{path}: none of its images is one of the {len(frames_of_files)} of the dataset")
    kept = [record for record in records if _known(record.get("image_id"), images)]
    if left_out is not None:
        left_out.frames.update(
            f"image {shortened(r.get('image_id'))}" for r in records if not _known(r.get("image_id"), images)
        )
    named = [{"score": 1.0, **r, "category_name": categories.get(r.get("category_id", -1), "")} for r in kept]
    # polygons are no run-length masks
    named = [{k: v for k, v in r.items() if k != "segmentation" or isinstance(v, dict)} for r in named]
    looked_at = {place: Detections2D.empty(class_names) for place in images.values()}
    return {**looked_at, **_group(path, named, lambda r: images[r["image_id"]], class_names, left_out)}


def _known(image: Any, images: Mapping[int | str, tuple[str, str]]) -> bool:
    return isinstance(image, int | str) and image in images


def _records(path: str | Path, content: Any = None) -> list[dict[str, Any]]:
    records = read_json(path) if content is None else content
    if not isinstance(records, list) or not all(isinstance(record, dict) for record in records):
        raise FormatError(f"{path} must hold a list of detections, got {type(records).__name__}")
    return records


def _group(
    path: str | Path, records: list[dict[str, Any]], key: Any, class_names: Sequence[str], left_out: LeftOut | None
) -> CameraDetections:
    """Detections of ``records`` by ``key``."""
    names = tuple(class_names)
    own = {str(record.get("category_name")) for record in records}
    label_of = {name: names.index(target) for name, target in join_classes(own, names).items()}
    rows: dict[tuple[str, str], list[tuple[list[float], float, int, InstanceMask | None]]] = {}
    for i, record in enumerate(records):
        try:
            x, y, width, height = (float(n) for n in record["bbox"])
            score, name, place = float(record["score"]), str(record["category_name"]), key(record)
        except KeyError as error:
            raise FormatError(f"{path}: record {i} has no {error.args[0]!r}") from None
        except (TypeError, ValueError, OverflowError):
            raise FormatError(f"{path}: record {i} must have a bbox of four numbers and a score") from None
        if not np.isfinite([x, y, width, height, score]).all() or width < 0 or height < 0:
            raise FormatError(f"{path}: record {i} has a bbox or score that is NaN, infinite or of negative size")
        # an image whose detections are all of other classes has been looked at: it stays, empty
        found = rows.setdefault(place, [])
        if name not in label_of:
            if left_out is not None:
                left_out.classes[name] += 1
            continue
        mask = None
        if record.get("segmentation"):
            try:
                mask = InstanceMask.from_image(decode_mask(record["segmentation"]))
            except FormatError as error:
                raise FormatError(f"{path}: record {i}: {error}") from None
        found.append(([x, y, x + width, y + height], score, label_of[name], mask))
    return {place: _detections(found, names) for place, found in rows.items()}


def _detections(
    rows: list[tuple[list[float], float, int, InstanceMask | None]], names: tuple[str, ...]
) -> Detections2D:
    boxes, scores, labels, masks = zip(*rows, strict=True) if rows else ((), (), (), ())
    has_masks = any(mask is not None for mask in masks)
    return Detections2D(
        np.array(boxes).reshape(-1, 4),
        np.array(scores),
        np.array(labels, dtype=np.int64),
        names,
        masks if has_masks else None,
    )
