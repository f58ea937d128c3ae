"""Make the drive that is shipped with the package; needs the extra ``simulate``.

``python -m lcf3d.demo.pack`` (from a checkout with ``pip install -e '.[simulate]'``) rebuilds
``src/lcf3d/demo/data/drive.zip`` with the same bytes, given the same versions of numpy, embreex and Pillow.
Seed, street and density below were chosen by looking at the pictures of drives 0 to 59.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy import ndimage

from lcf3d.datasets.drive import DRIVE, Distractors, Objects, ShippedFrame, write_drive
from lcf3d.geometry.boxes import transform_boxes
from lcf3d.geometry.rotation import invert_rigid
from lcf3d.simulation import simulate_drive
from lcf3d.simulation.frames import SimulatedFrame
from lcf3d.simulation.labels import label_order
from lcf3d.simulation.presets import get_preset
from lcf3d.structures import FloatArray

SEED, DRIVE_NUMBER, STREET, DENSITY, FRAMES = 4, 39, "city", 1.8, 20
KEEP_BEHIND_M = 6.0
MAX_DISTRACTOR_DISTANCE_M = 60.0
CELL_M = 0.2
# a distractor is a cluster of returns between these heights above the ground, so slim, so high, with so many returns
LOW_M, HIGH_M, SLIM_M, LEAST_HEIGHT_M, LEAST_RETURNS = 0.35, 2.2, 1.5, 0.9, 30
POLE_WIDTH_M = 0.65


def simulate() -> list[SimulatedFrame]:
    """The drive, with the left camera only."""
    preset = get_preset("kitti64")
    one_eyed = replace(preset, cameras=preset.cameras[:1])
    return list(simulate_drive(one_eyed, SEED, FRAMES, drive=DRIVE_NUMBER, street=STREET, density=DENSITY))


def find_distractors(frames: Sequence[SimulatedFrame]) -> tuple[FloatArray, list[str]]:
    """(M, 7) world boxes and kinds of slim clusters in the returns of all frames that belong to no road user."""
    terrain = frames[0].scene.site.terrain
    parts = []
    for frame in frames:
        pose = frame.world_from_lidar
        points = frame.scan.points[frame.scan.owner == 0, :3].astype(np.float64) @ pose[:3, :3].T + pose[:3, 3]
        height = points[:, 2] - terrain.height(points[:, 0], points[:, 1])
        kept = (height > LOW_M) & (height < HIGH_M)
        parts.append(np.column_stack([points[kept], height[kept]]))
    points = np.concatenate(parts)
    low = points[:, :2].min(axis=0)
    cells = ((points[:, :2] - low) / CELL_M).astype(np.int64)
    # a single return of a moment does not join two things
    taken = np.zeros(cells.max(axis=0) + 1, dtype=np.int64)
    np.add.at(taken, tuple(cells.T), 1)
    clusters, count = ndimage.label(taken > 2, structure=np.ones((3, 3)))
    member = clusters[tuple(cells.T)]
    boxes, kinds = [], []
    for cluster in range(1, count + 1):
        own = points[member == cluster]
        if len(own) < LEAST_RETURNS:
            continue
        size, middle = np.ptp(own, axis=0), (own.max(axis=0) + own.min(axis=0)) / 2
        if max(size[:2]) > SLIM_M or size[3] + LOW_M < LEAST_HEIGHT_M:
            continue
        top, bottom = own[:, 2].max(), float(terrain.height(middle[0], middle[1]))
        boxes.append([*middle[:2], (top + bottom) / 2, *np.maximum(size[:2], 0.1), top - bottom, 0.0])
        kinds.append("pole" if max(size[:2]) < POLE_WIDTH_M else "bush")
    return np.array(boxes).reshape(-1, 7), kinds


def ship(frame: SimulatedFrame, distractors: FloatArray, kinds: Sequence[str], number: int) -> ShippedFrame:
    """What of a simulated frame is shipped: the scan in front, the left image, labels, distractors near enough."""
    camera = frame.preset.cameras[0]
    order, labelled = label_order(frame.actors, frame.boxes, frame.sightings["left"], frame.points_on, camera)
    seen, kitti = order[:labelled], frame.kitti[:labelled]
    objects = Objects(
        frame.boxes[seen],
        kitti.class_names,
        np.array([frame.actors[k].id for k in seen], dtype=np.int64),
        frame.sightings["left"].boxes2d[seen],
        kitti.occluded,
        kitti.truncated,
    )
    boxes = transform_boxes(distractors, invert_rigid(frame.world_from_lidar[None])[0])
    near = np.flatnonzero((np.hypot(boxes[:, 0], boxes[:, 1]) < MAX_DISTRACTOR_DISTANCE_M) & (boxes[:, 0] > 0))
    things = Distractors(boxes[near], np.array(kinds, dtype=np.str_)[near], near)
    points = frame.scan.points[frame.scan.points[:, 0] > -KEEP_BEHIND_M]
    return ShippedFrame(f"{number:06d}", points, camera, frame.renders["left"].image, objects, things)


def main(path: Path = DRIVE) -> None:
    """Simulate, pack and write the drive."""
    frames = simulate()
    distractors, kinds = find_distractors(frames)
    shipped = [ship(frame, distractors, kinds, number) for number, frame in enumerate(frames)]
    write_drive(path, shipped, "python -m lcf3d.demo.pack")
    print(f"{path}: {path.stat().st_size / 1e6:.2f} MB")


if __name__ == "__main__":
    main(*(Path(argument) for argument in sys.argv[1:2]))
