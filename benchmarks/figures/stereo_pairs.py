"""Draws docs/images/stereo_pairs.jpg: 2D boxes of two views paired along epipolar lines.

lcf3d simulate drives --frames 15 --seed 11
python benchmarks/figures/stereo_pairs.py drives 000014
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import PIL.Image

from lcf3d import Detections2D, Detections3D, Frame
from lcf3d.datasets.kitti import KittiDataset
from lcf3d.formats.kitti import detections_3d, read_objects
from lcf3d.fusion.stereo_pairing import pair_views
from lcf3d.geometry.camera import project_boxes
from lcf3d.geometry.epipolar import epipolar_lines, fundamental_matrix
from lcf3d.structures import KITTI_CLASSES, FloatArray
from lcf3d.visualization.camera_view import rectangle
from lcf3d.visualization.canvas import Canvas, Colour

PAIR_COLOURS: list[Colour] = [
    (240, 160, 0),
    (86, 180, 233),
    (0, 190, 135),
    (240, 228, 66),
    (214, 130, 178),
    (230, 97, 1),
]
ALONE: Colour = (255, 255, 255)
LEAST_HEIGHT = 35.0


def detections(frame: Frame, labels: Detections3D, name: str, missed: int, rng: np.random.Generator) -> Detections2D:
    """The larger labels as a detector might see them in one view, one of them missed."""
    boxes, visible = project_boxes(labels.boxes, frame.camera(name))
    left, _ = project_boxes(labels.boxes, frame.camera("left"))
    seen = np.flatnonzero(visible & (left[:, 3] - left[:, 1] > LEAST_HEIGHT))
    seen = np.delete(seen, missed)
    noise = rng.normal(0, 0.025, (len(seen), 4)) * np.tile(boxes[seen, 2:] - boxes[seen, :2], 2)
    return Detections2D(boxes[seen] + noise, np.full(len(seen), 0.9), labels.labels[seen], labels.class_names)


def across(lines: FloatArray, width: int) -> FloatArray:
    """(N, 4) segments of (N, 3) lines from the left to the right border of an image."""
    at = np.array([0.0, width])
    heights = -(lines[:, :1] * at + lines[:, 2:]) / lines[:, 1:2]
    return np.stack([np.zeros(len(lines)), heights[:, 0], np.full(len(lines), float(width)), heights[:, 1]], axis=1)


def corners(canvas: Canvas, box: FloatArray, colour: Colour) -> None:
    """Dots on the top left and the bottom right corner."""
    turn = np.linspace(0, 2 * np.pi, 24)
    for corner in (box[:2], box[2:]):
        canvas.polygon(corner + 5 * np.stack([np.cos(turn), np.sin(turn)], axis=1), colour, 1.0)


def main() -> None:
    """Draw it."""
    data = KittiDataset(Path(sys.argv[1]))
    frame = data.frame(sys.argv[2])
    objects = read_objects(data.folder / "label_2" / f"{frame.id}.txt", results=False)
    calibration = data.calibration(frame.id)
    labels = detections_3d(objects[objects.occluded <= 1], calibration.camera_from_lidar, KITTI_CLASSES)
    rng = np.random.default_rng(3)
    cameras = [frame.camera("left"), frame.camera("right")]
    found = [detections(frame, labels, "left", 0, rng), detections(frame, labels, "right", 1, rng)]
    pairs = pair_views(*cameras, *found, gate_px=10.0, check_depth=True)
    fundamental = fundamental_matrix(*cameras)
    canvases = [Canvas(PIL.Image.fromarray(frame.images[c.name])) for c in cameras]
    for own, other in pairs:
        colour = PAIR_COLOURS[own % len(PAIR_COLOURS)]
        box = found[0].boxes[own]
        lines = epipolar_lines(fundamental, np.stack([box[:2], box[2:]]))
        canvases[1].lines(across(lines, cameras[1].width), colour, width=1.0, opacity=0.7)
        for canvas, corner_box in ((canvases[0], box), (canvases[1], found[1].boxes[other])):
            canvas.lines(rectangle(corner_box), colour, width=2.0, halo=True)
            corners(canvas, corner_box, colour)
    for canvas, view, column in zip(canvases, found, pairs.T, strict=True):
        for alone in np.setdiff1d(np.arange(len(view)), column):
            canvas.lines(rectangle(view.boxes[alone]), ALONE, width=1.5, dashed=True, halo=True)
            canvas.label(view.boxes[alone].tolist(), "unpaired", ALONE, filled=False)
    canvases[0].text(8, 6, "left", ALONE, size=16, plate=True)
    canvases[1].text(8, 6, "right, with the epipolar lines of the left boxes' corners", ALONE, size=16, plate=True)
    pictures = [canvas.image() for canvas in canvases]
    whole = PIL.Image.new("RGB", (pictures[0].width, 2 * pictures[0].height + 6), (40, 43, 48))
    for row, picture in enumerate(pictures):
        whole.paste(picture, (0, row * (picture.height + 6)))
    whole.save(Path(__file__).parents[2] / "docs" / "images" / "stereo_pairs.jpg", quality=82)


if __name__ == "__main__":
    main()
