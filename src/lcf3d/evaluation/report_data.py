"""What the report's page works on, as plain JSON values: curves, the boxes of every frame, the worst frames whole."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from lcf3d.datasets.base import Dataset
from lcf3d.errors import DatasetError
from lcf3d.evaluation.pictures import embedded_image, embedded_scan
from lcf3d.evaluation.reliability import calibration_error
from lcf3d.evaluation.study import ClassStudy, ShownBox, Study
from lcf3d.frame import Frame
from lcf3d.geometry.camera import project_boxes
from lcf3d.provenance import FusedDetections
from lcf3d.structures import Camera, FloatArray

OUTCOMES = ("right", "wrong", "missed", "found", "ignored", "dropped")
"""Of boxes; ``dropped`` are LiDAR detections that the fusion left out."""
ORIGINS = ("matched", "recovered", "downweighted", "kept", "predicted")
"""What the fusion did to its outputs."""
LIMIT_BYTES = 10_000_000
"""Largest size of a report unless told otherwise."""

# points of a curve: more than a screen has pixels for it
_CURVE_POINTS = 400
# shares of the size for the boxes of all frames, and for the sentences on them
_BOX_SHARE, _REASON_SHARE = 0.35, 0.15
# for the page itself: style, script, tables
_PAGE_BYTES = 250_000


class Names:
    """Numbers for names, in the order in which they come."""

    def __init__(self, names: Sequence[str] = ()) -> None:
        self.numbers = {name: number for number, name in enumerate(dict.fromkeys(names))}

    def __call__(self, name: str) -> int:
        """The number of a name."""
        return self.numbers.setdefault(name, len(self.numbers))


class FrameSource:
    """Frames by id, read once; those without calibration stand without cameras.

    Args:
        dataset: where they come from; None for results without one.
    """

    def __init__(self, dataset: Dataset | None) -> None:
        self.dataset = dataset
        self.camera_names = () if dataset is None else dataset.used_cameras

    def __call__(self, frame_id: str) -> Frame:
        """The frame of that id."""
        if self.dataset is None:
            return Frame(frame_id)
        try:
            return self.dataset.frame(frame_id)
        except DatasetError:
            # results can be measured without calibrations, but not drawn into images
            return Frame(frame_id)

    def cameras(self, frame_id: str) -> list[Camera]:
        """Those of its cameras that are used by default."""
        return [camera for camera in self(frame_id).cameras if camera.name in self.camera_names]


def report_data(
    studies: Sequence[Study], dataset: Dataset | None, worst: int, limit_bytes: int = LIMIT_BYTES
) -> dict[str, Any]:
    """Everything that the page shows but its tables.

    Frames come worst first. Where the size is used up, boxes, sentences, and pictures of better frames are left out;
    ``left_out`` counts the frames without boxes.

    Args:
        studies: one result set, or two of the same frames; the worst frames are those of the last.
        dataset: where images, scans and cameras come from.
        worst: frames with pictures, the worst of those that have images or a scan.
        limit_bytes: size of the whole report.
    """
    names = Names([part.class_name for study in studies for part in study.classes])
    source = FrameSource(dataset)
    main = studies[-1]
    order = np.argsort(-(main.wrong + main.missed), kind="stable").tolist()
    room = max(limit_bytes - _PAGE_BYTES, 0)
    runs = [{"name": study.name, "classes": [_class_json(part) for part in study.classes]} for study in studies]
    room -= _size(runs)
    frames = _frames(studies, order, names, source, int(_BOX_SHARE * room))
    sentences = int(_REASON_SHARE * room)
    for number, frame in zip(order, frames, strict=False):
        sentences -= _add_reasons(frame, studies, number)
        if sentences <= 0:
            break
    room -= _size(frames)
    pictures = _pictures(frames, source, worst, room)
    return {
        "heading": main.heading,
        "classes": list(names.numbers),
        "outcomes": list(OUTCOMES),
        "origins": list(ORIGINS),
        "cameras": list(source.camera_names),
        "runs": runs,
        "frames": frames,
        "left_out": len(order) - len(frames),
        "pictures": pictures,
    }


def _size(value: Any) -> int:
    return len(json.dumps(value, separators=(",", ":")))


def _class_json(part: ClassStudy) -> dict[str, Any]:
    """Curves and bars of one class."""
    # the first point at each recall: between two hits precision only falls
    _, firsts = np.unique(part.recall, return_index=True)
    kept = firsts[np.unique(np.linspace(0, len(firsts) - 1, _CURVE_POINTS).astype(np.int64))] if len(firsts) else firsts
    values = part.to_json()
    return {
        "name": part.class_name,
        **{key: values[key] for key in ("measure", "threshold", "best_f1")},
        "fusion": values.get("fusion"),
        "ap": [list(part.ap_over_threshold), _numbers(list(part.ap_over_threshold.values()), 2)],
        "distance": [
            [row["near_m"], row["far_m"], None if row["AP"] is None else round(row["AP"], 2), row["objects"]]
            for row in values["ap_by_distance"]
        ],
        "curve": [_numbers(column[kept], 4) for column in (part.recall, part.precision, part.scores)],
        "reliability": [[round(row.score, 4), round(row.right, 4), row.detections] for row in part.reliability],
        "calibration_error": round(calibration_error(part.reliability), 4) if part.reliability else None,
    }


def _numbers(values: Any, decimals: int) -> list[float | None]:
    """Rounded, None for what is not finite."""
    return [round(float(v), decimals) if np.isfinite(v) else None for v in values]


def _frames(
    studies: Sequence[Study], order: Sequence[int], names: Names, source: FrameSource, room: int
) -> list[dict[str, Any]]:
    """Every frame with the boxes of each result set, until the room is used up."""
    frames = []
    for number in order:
        frame_id = studies[-1].frame_ids[number]
        cameras = source.cameras(frame_id) if len(source.camera_names) > 1 else []
        runs = []
        for study in studies:
            boxes = _boxes(study, number, names)
            _add_views(boxes, cameras, source.camera_names)
            counts = {"wrong": int(study.wrong[number]), "missed": int(study.missed[number])}
            runs.append({**counts, "boxes": boxes})
        frame = {"id": frame_id, "runs": runs}
        room -= _size(frame)
        if room < 0:
            break
        frames.append(frame)
    return frames


def _boxes(study: Study, number: int, names: Names) -> list[dict[str, Any]]:
    """The boxes of one frame: class, outcome, score, what the fusion did, box in space, box in the first image."""
    fused = study.fused(number)
    origins = [] if fused is None else fused.origins
    rows = []
    for box in study.boxes(number):
        row = _box(names(box.class_name), box.outcome, box.score, box.box3d, box.box2d)
        output = _output(box, fused)
        if output is not None:
            row["g"], row["n"] = ORIGINS.index(origins[output]), output
        rows.append(row)
    if fused is None:
        return rows
    inputs, known = fused.lidar_inputs, {part.class_name for part in study.classes}
    for i in fused.dropped_lidar.tolist():
        name = inputs.class_names[inputs.labels[i]]
        if name in known and np.isfinite(inputs.boxes[i]).all():
            row = _box(names(name), "dropped", float(inputs.scores[i]), inputs.boxes[i], None)
            rows.append({**row, "d": i})
    return rows


def _box(
    label: int, outcome: str, score: float | None, box3d: FloatArray | None, box2d: FloatArray | None
) -> dict[str, Any]:
    row: dict[str, Any] = {"c": label, "o": OUTCOMES.index(outcome)}
    if score is not None:
        row["s"] = round(score, 4)
    if box3d is not None:
        row["b"] = [*_numbers(box3d[:6], 2), round(float(box3d[6]), 3)]
    if box2d is not None:
        row["r"] = _numbers(box2d, 0)
    return row


def _output(box: ShownBox, fused: FusedDetections | None) -> int | None:
    """The output of the fusion that a detection is, if that is what it says."""
    if fused is None or box.output is None or not 0 <= box.output < len(fused.detections):
        return None
    found = fused.detections
    same = found.class_names[found.labels[box.output]].lower() == box.class_name.lower()
    return box.output if same else None


def _add_views(boxes: list[dict[str, Any]], cameras: Sequence[Camera], names: Sequence[str]) -> None:
    """Note which cameras look at each box, by number."""
    solid = [box for box in boxes if "b" in box]
    if not solid or not cameras:
        return
    corners = np.array([box["b"] for box in solid])
    for camera in cameras:
        _, visible = project_boxes(corners, camera)
        for row in np.flatnonzero(visible).tolist():
            solid[row].setdefault("v", []).append(list(names).index(camera.name))


def _add_reasons(frame: dict[str, Any], studies: Sequence[Study], number: int) -> int:
    """Sentences on why each box is there or not; returns their size."""
    size = 0
    for run, study in zip(frame["runs"], studies, strict=True):
        fused = study.fused(number)
        if fused is None:
            continue
        for box in run["boxes"]:
            if "n" in box:
                box["w"] = fused.explain(box.pop("n"))
            elif "d" in box:
                box["w"] = fused.explain_lidar(box.pop("d"))
            size += len(box.get("w", ""))
    return size


def _pictures(frames: Sequence[dict[str, Any]], source: FrameSource, count: int, room: int) -> dict[str, Any]:
    """Images with the boxes in them, and scans, of the first frames that have any, until the room is used up."""
    pictures: dict[str, Any] = {}
    for shown in frames:
        if len(pictures) == count:
            break
        picture = frame_picture(shown, source)
        room -= _size(picture)
        if room < 0:
            break
        if picture["images"] or "scan" in picture:
            pictures[shown["id"]] = picture
    return pictures


def frame_picture(shown: Mapping[str, Any], source: FrameSource) -> dict[str, Any]:
    """Images of one frame with the boxes in them, and its scan; ``shown`` is the frame as `report_data` has it."""
    frame = source(shown["id"])
    cameras = [c for c in frame.cameras if c.name in frame.images and c.name in source.camera_names]
    picture: dict[str, Any] = {
        "images": [
            {
                "camera": camera.name,
                "size": [camera.width, camera.height],
                "src": embedded_image(frame.images[camera.name]),
                "boxes": [_in_image(run["boxes"], camera, camera is frame.cameras[0]) for run in shown["runs"]],
            }
            for camera in cameras
        ]
    }
    scan = _scan(frame)
    if scan is not None:
        picture["scan"] = scan
    return picture


def _scan(frame: Frame) -> str | None:
    try:
        return None if frame.points is None else embedded_scan(frame.points)
    except DatasetError:
        return None


def _in_image(boxes: Sequence[Mapping[str, Any]], camera: Camera, first: bool) -> list[list[float | None]]:
    """Rows of box number and rectangle; in the first camera the evaluated rectangle where there is one."""
    solid = [i for i, box in enumerate(boxes) if "b" in box]
    flat: dict[int, list[float | None]] = {}
    if solid:
        rectangles, visible = project_boxes(np.array([boxes[i]["b"] for i in solid]), camera)
        flat = {
            i: _numbers(rectangle, 0) for i, rectangle, seen in zip(solid, rectangles, visible, strict=True) if seen
        }
    if first:
        flat.update({i: box["r"] for i, box in enumerate(boxes) if "r" in box})
    return [[i, *rectangle] for i, rectangle in sorted(flat.items())]
