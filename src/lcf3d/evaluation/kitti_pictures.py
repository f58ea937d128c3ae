"""Pictures of single frames for the report: boxes over the camera image, where there is one, and from above."""

from __future__ import annotations

import base64
import io
from pathlib import Path

import numpy as np
from PIL import Image

from lcf3d.evaluation.kitti_matching import BELOW, COUNTS, FALSE_POSITIVE, IGNORED, TRUE_POSITIVE
from lcf3d.evaluation.kitti_study import KittiStudy, worst_frames
from lcf3d.evaluation.report import FATE_COLORS
from lcf3d.evaluation.svg import Shape, bev_scene, image_scene
from lcf3d.formats.kitti import KittiObjects
from lcf3d.structures import FloatArray

# images are embedded this wide: sharp enough to judge a miss, about 80 kB a frame
PICTURE_WIDTH_PX = 1040


def worst_frame_pictures(study: KittiStudy, root: Path | None, count: int = 8) -> dict[str, str]:
    """HTML of the ``count`` frames with most errors, by heading; camera images come from ``root/training/image_2``."""
    pictures = {}
    for frame, wrong, missed in worst_frames(study, count):
        name = study.evaluator.truth.frame_ids[frame]
        pictures[f"{name}: {wrong} wrong, {missed} missed"] = frame_picture(study, frame, root)
    return pictures


def frame_picture(study: KittiStudy, frame: int, root: Path | None) -> str:
    """HTML of one frame: its camera image with boxes, if the image is there, and the bird's-eye view in 3D."""
    parts = []
    path = _image_path(root, study.evaluator.truth.frame_ids[frame])
    if path is not None:
        picture, width, height = _embedded(path)
        shapes = [Shape(_rectangle(box), color, title, dashed) for _, box, color, title, dashed in _boxes(study, frame)]
        parts.append(image_scene(picture, width, height, shapes))
    if any(part.selection.measure == "3d" for part in study.classes):
        shapes = [
            Shape(footprint, color, title, dashed)
            for footprint, _, color, title, dashed in _boxes(study, frame)
            if footprint is not None
        ]
        parts.append(bev_scene(shapes))
    return "".join(parts)


def footprints(objects: KittiObjects) -> FloatArray:
    """(N, 4, 2) ground corners of the boxes, metres right and forward of the camera, the two front corners first."""
    length, width = objects.dimensions[:, 2, None] / 2, objects.dimensions[:, 1, None] / 2
    along, across = length * [1, 1, -1, -1], width * [1, -1, -1, 1]
    cos, sin = np.cos(objects.rotation_y)[:, None], np.sin(objects.rotation_y)[:, None]
    right = along * cos + across * sin + objects.locations[:, :1]
    forward = across * cos - along * sin + objects.locations[:, 2:]
    return np.stack([right, forward], axis=2)


def _boxes(study: KittiStudy, frame: int) -> list[tuple[FloatArray | None, FloatArray, str, str, bool]]:
    """Footprint (None without a 3D box), image box, colour, title and dashing of all that is shown of a frame."""
    evaluator = study.evaluator
    truth, results = evaluator.truth, evaluator.results
    first_object, last_object = truth.starts[frame : frame + 2]
    first_detection, last_detection = results.starts[frame : frame + 2]
    shown: list[tuple[FloatArray | None, FloatArray, str, str, bool]] = []

    def show(objects: KittiObjects, row: int, fate: str, title: str, dashed: bool) -> None:
        one = objects[row : row + 1]
        footprint = footprints(one)[0] if one.has_box3d[0] else None
        shown.append((footprint, one.boxes2d[0], FATE_COLORS[fate], title, dashed))

    for part in study.classes:
        object_codes, _ = evaluator.codes(part.selection)
        for row in range(first_object, last_object):
            name = truth.objects.class_names[row]
            if object_codes[row] == COUNTS:
                fate = "missed" if part.fates.missed[row] else "found"
                show(truth.objects, row, fate, f"{name}, {fate}", True)
            elif object_codes[row] == IGNORED:
                show(truth.objects, row, "ignored", f"{name}, does not count", True)
        for row in range(first_detection, last_detection):
            outcome = part.fates.outcomes[row]
            if outcome == BELOW or results.objects.class_names[row].lower() != part.selection.class_name.lower():
                continue
            fate = {TRUE_POSITIVE: "right", FALSE_POSITIVE: "wrong"}.get(int(outcome), "ignored")
            score = results.objects.scores[row] if results.objects.scores is not None else np.nan
            show(results.objects, row, fate, f"{part.selection.class_name} {score:.2f}, {fate}", False)
    return shown


def _rectangle(box: FloatArray) -> FloatArray:
    return box[[[0, 1], [2, 1], [2, 3], [0, 3]]]


def _image_path(root: Path | None, frame_id: str) -> Path | None:
    if root is None:
        return None
    paths = [Path(root) / "training" / "image_2" / f"{frame_id}{suffix}" for suffix in (".png", ".jpg", ".jpeg")]
    return next((path for path in paths if path.is_file()), None)


def _embedded(path: Path) -> tuple[str, int, int]:
    """A ``data:`` address of the image as JPEG, and the size of the original in pixels."""
    with Image.open(path) as image:
        width, height = image.size
        small = image.convert("RGB")
        small.thumbnail((PICTURE_WIDTH_PX, PICTURE_WIDTH_PX))
        buffer = io.BytesIO()
        small.save(buffer, "JPEG", quality=82)
    return f"data:image/jpeg;base64,{base64.b64encode(buffer.getvalue()).decode('ascii')}", width, height
