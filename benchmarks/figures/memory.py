"""Draws docs/images/memory.webp: a rider whom one frame misses and a false alarm of one frame, with the real memory.

    lcf3d simulate DRIVES --preset mono64 --sequence --frames 240 --seed 4711
    lcf3d run kitti:DRIVES --lidar 'shipped:kitti?nms=off' --camera shipped:kitti --out alone
    python benchmarks/figures/memory.py DRIVES alone

Simulated drives; the detections are those of the networks that ship with lcf3d.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from PIL import Image, ImageDraw

from lcf3d.datasets.kitti import KittiDataset
from lcf3d.frame import Frame
from lcf3d.fusion.memory import remember_sequence
from lcf3d.geometry.boxes import transform_boxes
from lcf3d.geometry.camera import project_boxes
from lcf3d.geometry.rotation import invert_rigid
from lcf3d.provenance import FusedDetections
from lcf3d.run.folder import RunFolder
from lcf3d.structures import BoolArray, FloatArray
from lcf3d.visualization.camera_view import projected_edges
from lcf3d.visualization.canvas import font

BLUE, AMBER, RED, GREY, INK = "#38bdf8", "#fbbf24", "#dc2626", "#64748b", "#0f172a"
PANEL, GAP, LEFT, HEAD = 168, 6, 108, 46
# boxes below this are not drawn
LEAST_SCORE = 0.1


class Story(NamedTuple):
    """Some frames of a drive around a place.

    Attributes:
        title: what is to be seen.
        drive: its name.
        frames: numbers of the frames.
        place: (x, y, z) in the LiDAR frame of the first of ``frames``, metres.
        window: width and height of what is shown of the image, pixels.
    """

    title: str
    drive: str
    frames: Sequence[int]
    place: tuple[float, float, float]
    window: float


STORIES = (
    Story(
        "A rider, 38 m away: taken for a pedestrian at 1.1 s, missed at 1.4 s. The memory predicts where the rider is.",
        "0004",
        (10, 11, 12, 13, 14, 15),
        (38.9, -3.5, -0.7),
        58.0,
    ),
    Story(
        "A shrub, taken for a person at 0.9 s. A frame before, somebody looked there and saw none: it loses.",
        "0005",
        (7, 8, 9, 10, 11, 12),
        (20.4, -6.1, -0.7),
        150.0,
    ),
)


def drive_of(dataset: KittiDataset, run: RunFolder, story: Story) -> list[tuple[Frame, FusedDetections]]:
    """All frames of the story's drive up to its last, and what each alone gave."""
    ids = [f"{story.drive}_{number:06d}" for number in range(story.frames[-1] + 1)]
    return [(dataset.frame(one), run.read(one)) for one in ids]


def panel(frame: Frame, found: FusedDetections, predicted: BoolArray, middle: FloatArray, window: float) -> Image.Image:
    """A square of the image around a pixel, with the boxes of people and riders there and their scores."""
    camera = frame.cameras[0]
    scale, corner = PANEL / window, middle - window / 2
    area = (*corner, *(corner + window))
    picture = Image.fromarray(frame.images[camera.name]).transform(
        (PANEL, PANEL), Image.Transform.EXTENT, area, Image.Resampling.BICUBIC
    )
    draw, lines = ImageDraw.Draw(picture), []
    own = found.detections
    pixels, visible = project_boxes(own.boxes, camera)
    centres = (pixels[:, :2] + pixels[:, 2:]) / 2
    near = visible & (np.abs(centres - middle).max(axis=1) < window / 4) & (own.scores > LEAST_SCORE)
    near &= own.labels != own.class_names.index("Car")
    for i in np.flatnonzero(near):
        colour = AMBER if predicted[i] else BLUE
        for x1, y1, x2, y2 in projected_edges(own.boxes[i : i + 1], camera)[0]:
            ends = (np.array([x1, y1, x2, y2]) - np.tile(corner, 2)) * scale
            draw.line([*ends], fill=colour, width=2)
        lines.append((f"{own.class_names[own.labels[i]]} {own.scores[i]:.2f}", colour))
        if predicted[i]:
            lines.append(("predicted", colour))
    for k, (words, colour) in enumerate(lines or [("nothing", "#cbd5e1")]):
        width = draw.textlength(words, font=font(15))
        draw.rectangle((0, 22 * k, width + 10, 22 * k + 21), fill=INK)
        draw.text((5, 22 * k + 2), words, fill=colour, font=font(15))
    return picture


def strip(story: Story, dataset: KittiDataset, run: RunFolder) -> Image.Image:
    """Two rows of panels: what each frame says, and what it says with the memory."""
    frames = drive_of(dataset, run, story)
    remembered = list(remember_sequence(frames))
    picture = Image.new("RGB", (LEFT + len(story.frames) * (PANEL + GAP), HEAD + 2 * (PANEL + GAP)), "white")
    draw = ImageDraw.Draw(picture)
    draw.text((4, 2), story.title, fill=INK, font=font(16))
    for row, words in enumerate(("the frame\nalone", "with\nmemory")):
        draw.text((4, HEAD + row * (PANEL + GAP) + PANEL / 2 - 20), words, fill=INK, font=font(16))
    first = frames[story.frames[0]][0]
    assert first.world_from_lidar is not None
    place = transform_boxes(np.array([[*story.place, 0.6, 0.6, 1.6, 0.0]]), first.world_from_lidar)
    for column, number in enumerate(story.frames):
        (frame, alone), result = frames[number], remembered[number]
        assert frame.world_from_lidar is not None
        assert result.tracks is not None
        here, _ = project_boxes(transform_boxes(place, invert_rigid(frame.world_from_lidar)), frame.cameras[0])
        middle, x = (here[0, :2] + here[0, 2:]) / 2, LEFT + column * (PANEL + GAP)
        draw.text((x + 4, HEAD - 20), f"{frame.timestamp:.1f} s", fill=GREY, font=font(14))
        rows = ((alone, np.zeros(len(alone), dtype=bool)), (result, result.tracks.predicted))
        for row, (found, predicted) in enumerate(rows):
            picture.paste(panel(frame, found, predicted, middle, story.window), (x, HEAD + row * (PANEL + GAP)))
    return picture


def main() -> None:
    """Write the picture."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("root", type=Path, help="simulated drives")
    parser.add_argument("run", type=Path, help="folder of 'lcf3d run' without memory")
    options = parser.parse_args()
    dataset, run = KittiDataset(options.root), RunFolder(options.run)
    strips = [strip(story, dataset, run) for story in STORIES]
    picture = Image.new("RGB", (max(s.width for s in strips), sum(s.height for s in strips) + 12), "white")
    top = 0
    for one in strips:
        picture.paste(one, (0, top))
        top += one.height + 12
    picture.save(Path(__file__).parents[2] / "docs" / "images" / "memory.webp", quality=88, method=6)


if __name__ == "__main__":
    main()
