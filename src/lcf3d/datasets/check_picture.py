"""The picture of a check: what the cameras of a frame see, with the points of its scan and its labels."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from lcf3d.datasets.base import Dataset
from lcf3d.frame import Frame
from lcf3d.structures import Detections3D
from lcf3d.visualization.png import draw_frame
from lcf3d.visualization.points import paint_points
from lcf3d.visualization.scene import Scene

if TYPE_CHECKING:
    import PIL.Image


def draw_check(dataset: Dataset) -> PIL.Image.Image:
    """The first frame that has a scan and an image, else the first: points fall on what they were measured on.

    Raises:
        Lcf3dError: the frame cannot be read.
    """
    frame = next((f for f in map(dataset.frame, dataset.ids[:20]) if f.points is not None and f.images), None)
    if frame is None:
        frame = dataset.frame(dataset.ids[0])
    images = {}
    for camera in frame.cameras:
        image = frame.images.get(camera.name)
        if image is None:
            image = np.full((camera.height, camera.width, 3), 40, np.uint8)
        images[camera.name] = image if frame.points is None else paint_points(image, camera, frame.points)
    painted = Frame(frame.id, frame.points, frame.cameras, images, frame.labels)
    return draw_frame(painted, Scene.from_detections(Detections3D.empty(()), truth=frame.labels))
