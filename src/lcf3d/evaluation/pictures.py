"""Pictures of single frames for the report: boxes over the camera image, where there is one, and from above."""

from __future__ import annotations

import base64
import io

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from lcf3d.datasets.base import Dataset
from lcf3d.errors import DatasetError
from lcf3d.evaluation.report import OUTCOME_COLORS
from lcf3d.evaluation.study import ShownBox, Study
from lcf3d.evaluation.svg import Shape, bev_scene, image_scene
from lcf3d.geometry.boxes import box_corners
from lcf3d.structures import FloatArray, Frame

# images are embedded this wide: sharp enough to judge a miss, about 80 kB a frame
PICTURE_WIDTH_PX = 1040


def worst_frame_pictures(study: Study, dataset: Dataset, count: int = 8) -> dict[str, str]:
    """HTML of the ``count`` frames with most errors, by heading."""
    pictures = {}
    for f in study.worst_frames(count):
        heading = f"{study.frame_ids[f]}: {study.wrong[f]} wrong, {study.missed[f]} missed"
        try:
            frame = dataset.frame(study.frame_ids[f])
        except DatasetError:
            # results can be measured without calibrations, but not drawn into images
            frame = Frame(study.frame_ids[f])
        pictures[heading] = frame_picture(study, f, frame)
    return pictures


def frame_picture(study: Study, number: int, frame: Frame) -> str:
    """HTML of one frame: its first camera's image with boxes, if the image is there, and the bird's-eye view."""
    shown, parts = study.boxes(number), []
    camera = next((camera for camera in frame.cameras if camera.name in frame.images), None)
    if camera is not None and camera is frame.cameras[0]:
        picture = _embedded(frame.images[camera.name])
        flat = [_shape(box, _rectangle(box.box2d)) for box in shown if box.box2d is not None]
        parts.append(image_scene(picture, camera.width, camera.height, flat))
    solid = [_shape(box, footprint(box.box3d)) for box in shown if box.box3d is not None]
    if solid:
        parts.append(bev_scene(solid))
    return "".join(parts)


def footprint(box: FloatArray) -> FloatArray:
    """(4, 2) ground corners of a (7,) box, metres right and forward of the LiDAR, the two front corners first."""
    forward, left = box_corners(box[None])[0][[0, 1, 2, 3], :2].T
    return np.stack([-left, forward], axis=1)


def _shape(box: ShownBox, corners: FloatArray) -> Shape:
    what = box.class_name if box.score is None else f"{box.class_name} {box.score:.2f}"
    text = "does not count" if box.outcome == "ignored" else box.outcome
    return Shape(corners, OUTCOME_COLORS[box.outcome], f"{what}, {text}", box.score is None)


def _rectangle(box: FloatArray) -> FloatArray:
    return box[[[0, 1], [2, 1], [2, 3], [0, 3]]]


def _embedded(image: NDArray[np.uint8]) -> str:
    """A ``data:`` address of the image as JPEG."""
    small = Image.fromarray(image)
    small.thumbnail((PICTURE_WIDTH_PX, PICTURE_WIDTH_PX))
    buffer = io.BytesIO()
    small.save(buffer, "JPEG", quality=82)
    return f"data:image/jpeg;base64,{base64.b64encode(buffer.getvalue()).decode('ascii')}"
