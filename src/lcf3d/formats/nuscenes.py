"""nuScenes submission files: ``{"meta": {...}, "results": {sample_token: [box, ...]}}``, boxes in the global frame.

A tracking submission has ``tracking_name``, ``tracking_score`` and ``tracking_id`` in place of a detection's name,
score and attribute.
"""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from lcf3d.errors import DatasetError, FormatError
from lcf3d.files import read_text, reading, write_text
from lcf3d.formats.json_stream import JsonCursor
from lcf3d.formats.nuscenes_boxes import NUSCENES_ATTRIBUTES, GlobalBoxes
from lcf3d.structures import NUSCENES_CLASSES, BoolArray, FloatArray

MAX_BOXES_PER_SAMPLE = 500
"""The most boxes that the nuScenes benchmark accepts for one sample."""
TRACKING_CLASSES = ("bicycle", "bus", "car", "motorcycle", "pedestrian", "trailer", "truck")
"""The classes that the nuScenes tracking benchmark knows."""

META = {"use_camera": True, "use_lidar": True, "use_radar": False, "use_map": False, "use_external": False}
"""What a submission says of its inputs, unless told otherwise."""
_UNKNOWN = -2


class _Form(NamedTuple):
    """What the boxes of a kind of file have.

    Attributes:
        title: what the file is.
        kind: ``detection`` or ``tracking``: how the keys of name and score begin.
        numbers: keys of numbers, and their shapes.
        names: keys of names, and what each is as a number.
        texts: keys of texts.
    """

    title: str
    kind: str
    numbers: dict[str, tuple[int, ...]]
    names: dict[str, dict[str, int]]
    texts: tuple[str, ...] = ()


_BOX: dict[str, tuple[int, ...]] = {"translation": (3,), "size": (3,), "rotation": (4,), "velocity": (2,)}
_CLASSES = {name: i for i, name in enumerate(NUSCENES_CLASSES)}
_DETECTIONS = _Form(
    "a nuScenes submission",
    "detection",
    {**_BOX, "detection_score": ()},
    {
        "detection_name": _CLASSES,
        "attribute_name": {name: i for i, name in enumerate(NUSCENES_ATTRIBUTES)} | {"": -1},
    },
)
_TRACKS = _Form(
    "a nuScenes tracking submission",
    "tracking",
    {**_BOX, "tracking_score": ()},
    {"tracking_name": {name: _CLASSES[name] for name in TRACKING_CLASSES}},
    ("tracking_id",),
)


def read_submission(path: Path, max_boxes: int = MAX_BOXES_PER_SAMPLE) -> tuple[GlobalBoxes, dict[str, Any]]:
    """Boxes and ``meta`` of a submission file, in file order.

    Raises:
        FormatError: not a submission; a sample token that occurs twice or holds more than ``max_boxes`` boxes; a box
            with a missing key, an unknown class or attribute, a score or coordinate that is not a finite number, or a
            size that is not positive. The message names the file and the sample.
    """
    tokens, parts, meta = _read(path, _DETECTIONS, max_boxes)
    return _join(path, tokens, parts, _DETECTIONS), meta


def read_tracking(
    path: Path, max_boxes: int = MAX_BOXES_PER_SAMPLE
) -> tuple[GlobalBoxes, NDArray[np.str_], dict[str, Any]]:
    """Boxes, the (N,) tracks that they belong to, and ``meta`` of a tracking submission, in file order.

    Raises:
        FormatError: see `read_submission`; also where a sample holds a track twice.
    """
    tokens, parts, meta = _read(path, _TRACKS, max_boxes)
    for token, part in zip(tokens, parts, strict=True):
        repeated = [name for name, times in Counter(part["tracking_id"]).items() if times > 1]
        if repeated:
            raise FormatError(f"{path}: sample {token} holds track {repeated[0]!r} twice; give each object its own id")
    ids = np.array([own for part in parts for own in part["tracking_id"]], dtype=np.str_)
    return _join(path, tokens, parts, _TRACKS), ids, meta


def _read(path: Path, form: _Form, max_boxes: int) -> tuple[list[str], list[dict[str, Any]], dict[str, Any]]:
    """Sample tokens, the arrays of each sample's boxes, and ``meta``."""
    try:
        cursor = JsonCursor(read_text(path))
    except DatasetError as error:
        raise FormatError(str(error)) from None
    except OSError as error:
        raise FormatError(f"{path} cannot be read ({error.strerror})") from None
    tokens: list[str] = []
    parts: list[dict[str, Any]] = []
    meta: dict[str, Any] | None = None
    found = False
    try:
        with reading(path, form.title):
            for key in cursor.members():
                if key == "results":
                    found = True
                    for token in cursor.members():
                        tokens.append(token)
                        parts.append(_read_sample(path, token, cursor.value(), max_boxes, form))
                elif key == "meta":
                    meta = cursor.value()
                else:
                    cursor.value()
    except json.JSONDecodeError as error:
        raise FormatError(f"{path}:{error.lineno}:{error.colno}: not {form.title} ({error.msg})") from None
    if not found:
        raise FormatError(f"{path} has no 'results'; {form.title} is {{'meta': ..., 'results': ...}}")
    repeated = [token for token, times in Counter(tokens).items() if times > 1]
    if repeated:
        raise FormatError(f"{path}: sample token {repeated[0]} occurs twice (as do {len(repeated) - 1} more)")
    return tokens, parts, meta or {}


def write_submission(path: Path, boxes: GlobalBoxes, meta: Mapping[str, Any] | None = None) -> None:
    """Write ``boxes`` as a submission file: every sample token, the highest scores first, at most 500 a sample.

    Velocities that are unknown are written as 0, the only value the format has for them. ``meta`` says which inputs
    were used (default: camera and LiDAR).

    Raises:
        FormatError: a coordinate, size or score is not a finite number.
    """
    for name in ("translations", "sizes", "rotations", "scores"):
        bad = _not_finite(getattr(boxes, name))
        if bad.any():
            token = boxes.sample_tokens[boxes.samples[np.flatnonzero(bad)[0]]]
            raise FormatError(f"cannot write {path}: {name} of a box of sample {token} hold NaN or infinite values")
    results: dict[str, list[dict[str, Any]]] = {token: [] for token in boxes.sample_tokens}
    velocities = np.nan_to_num(boxes.velocities)
    for i in np.lexsort((-boxes.scores, boxes.samples)):
        token = boxes.sample_tokens[boxes.samples[i]]
        if len(results[token]) == MAX_BOXES_PER_SAMPLE:
            continue
        results[token].append(
            {
                "sample_token": token,
                "translation": boxes.translations[i].tolist(),
                "size": boxes.sizes[i].tolist(),
                "rotation": boxes.rotations[i].tolist(),
                "velocity": velocities[i].tolist(),
                "detection_name": NUSCENES_CLASSES[boxes.labels[i]],
                "detection_score": float(boxes.scores[i]),
                "attribute_name": "" if boxes.attributes[i] < 0 else NUSCENES_ATTRIBUTES[boxes.attributes[i]],
            }
        )
    write_text(path, json.dumps({"meta": dict(META if meta is None else meta), "results": results}) + "\n")


def _read_sample(path: Path, token: str, boxes: Any, max_boxes: int, form: _Form) -> dict[str, Any]:
    """Arrays by key of one sample's boxes; attributes and classes as indices, texts as lists."""
    if not isinstance(boxes, list) or not all(isinstance(box, dict) for box in boxes):
        raise FormatError(f"{path}: sample {token} must hold a list of boxes")
    if len(boxes) > max_boxes:
        raise FormatError(
            f"{path}: sample {token} holds {len(boxes)} boxes, at most {max_boxes} are allowed; "
            "keep those of the highest scores"
        )
    arrays: dict[str, Any] = {}
    try:
        for key, shape in form.numbers.items():
            try:
                array = np.array([box[key] for box in boxes], dtype=np.float64)
            except (TypeError, ValueError, OverflowError):
                array = np.empty(())
            if array.shape != (len(boxes), *shape) and boxes:
                expected = f"{shape[0]} numbers" if shape else "a number"
                raise FormatError(f"{path}: {key} of a box of sample {token} must be {expected}")
            arrays[key] = array.reshape(len(boxes), *shape)
        for key, index in form.names.items():
            arrays[key] = np.array([index.get(box[key], _UNKNOWN) for box in boxes], dtype=np.int64)
            if (arrays[key] == _UNKNOWN).any():
                name = boxes[int(np.argmax(arrays[key] == _UNKNOWN))][key]
                known = ", ".join(filter(None, index))
                raise FormatError(f"{path}: sample {token} holds a box of unknown {key} {name!r}; known are {known}")
        for key in form.texts:
            if not all(isinstance(box[key], str | int) and box[key] != "" for box in boxes):
                raise FormatError(f"{path}: {key} of a box of sample {token} must be text or a whole number")
            arrays[key] = [str(box[key]) for box in boxes]
    except KeyError as error:
        other = "detection_name" if form.kind == "tracking" else "tracking_name"
        hint = f": it has {other!r}, so this is another kind of file" if any(other in box for box in boxes) else ""
        raise FormatError(f"{path}: a box of sample {token} has no {error.args[0]!r}{hint}") from None
    except TypeError:
        raise FormatError(f"{path}: {key} of a box of sample {token} must be text") from None
    if any(box.get("sample_token", token) != token for box in boxes):
        raise FormatError(f"{path}: a box listed under sample {token} carries another sample's token")
    return arrays


def _join(path: Path, tokens: list[str], parts: list[dict[str, Any]], form: _Form) -> GlobalBoxes:
    """The samples' arrays joined, with their values checked."""
    samples = np.repeat(np.arange(len(parts)), [len(part["translation"]) for part in parts])
    joined: dict[str, Any] = {
        key: np.concatenate([part[key] for part in parts] + [np.zeros((0, *shape))])
        for key, shape in form.numbers.items()
    }
    # a velocity may be unknown (NaN); nothing else may
    checks = [(f"{key} that is NaN or infinite", _not_finite(joined[key])) for key in form.numbers if key != "velocity"]
    checks.append(("size that is not positive", (joined["size"] <= 0).any(axis=1)))
    checks.append(("rotation that is zero", (joined["rotation"] == 0).all(axis=1)))
    for what, bad in checks:
        if bad.any():
            token = tokens[samples[np.argmax(bad)]]
            raise FormatError(f"{path}: {int(bad.sum())} boxes, the first of sample {token}, have a {what}")
    names = {key: np.concatenate([part[key] for part in parts] + [np.zeros(0, np.int64)]) for key in form.names}
    none = np.full(len(samples), -1, dtype=np.int64)
    return GlobalBoxes(
        tuple(tokens),
        samples.astype(np.int64),
        joined["translation"],
        joined["size"],
        joined["rotation"],
        joined["velocity"],
        names[f"{form.kind}_name"],
        joined[f"{form.kind}_score"],
        names.get("attribute_name", none),
        none,
    )


def _not_finite(values: FloatArray) -> BoolArray:
    """(N,) whether a row of ``values`` (N,) or (N, K) holds NaN or infinite numbers."""
    columns = values[:, None] if values.ndim == 1 else values
    return np.asarray(~np.isfinite(columns).all(axis=1), dtype=np.bool_)
