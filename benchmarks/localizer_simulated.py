"""How well frustum localizers place boxes on the simulated scans that the shipped networks did not learn from.

    python benchmarks/localizer_simulated.py --classes kitti --localizer geometric --localizer network

The held-out scans of the recipe (`lcf3d.training.recipes`), each seen from several headings; frustums of the projected
boxes of all objects with five returns or more, jittered by up to ``--jitter`` of their sides.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from lcf3d.fusion.frustum import FrustumProposals, extract_frustums
from lcf3d.geometry.boxes import points_in_boxes
from lcf3d.geometry.camera import project_boxes
from lcf3d.localizers.named import load_localizer
from lcf3d.localizers.spec import TEMPLATES
from lcf3d.structures import Detections2D, FloatArray
from lcf3d.training.frustums import FEWEST_ON_OBJECT, LOWEST_PX, scenes_of_samples
from lcf3d.training.localizer import paired_iou
from lcf3d.training.recipes import default_samples_root, recipe_of, training_cameras
from lcf3d.training.samples import write_samples


def proposals_of(classes: str, root: Path, views: int, jitter: float) -> Iterator[tuple[FrustumProposals, FloatArray]]:
    """Frustums of each scene, with the true boxes in their frustum frames."""
    recipe, names = recipe_of(classes), tuple(TEMPLATES[classes])
    paths = write_samples(recipe.samples, root / recipe.samples.folder, 2)[-recipe.held_out :]
    rng = np.random.default_rng(0)
    for scene in scenes_of_samples(paths, training_cameras(recipe), views, seed=1):
        boxes2d, visible = project_boxes(scene.boxes, scene.camera)
        known = np.array([recipe.synonyms.get(str(n), str(n)) for n in scene.names])
        tall = boxes2d[:, 3] - boxes2d[:, 1] >= LOWEST_PX
        hit = points_in_boxes(scene.points, scene.boxes).sum(axis=1) >= FEWEST_ON_OBJECT
        rows = np.flatnonzero(visible & tall & hit & np.isin(known, names))
        if not len(rows):
            continue
        sides = np.tile(boxes2d[rows, 2:] - boxes2d[rows, :2], 2)
        moved = boxes2d[rows] + rng.uniform(-jitter, jitter, sides.shape) * sides
        labels = np.array([names.index(n) for n in known[rows]], dtype=np.int64)
        found = Detections2D(moved, np.ones(len(rows)), labels, names)
        proposals = extract_frustums(scene.points, [scene.camera], [found], [np.arange(len(rows))])
        if len(proposals):
            yield proposals, proposals.frustum_from_lidar(scene.boxes[rows[proposals.detection_index]])


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--classes", default="kitti", help="kitti or nuscenes")
    parser.add_argument("--localizer", action="append", help="as for lcf3d run; repeatable")
    parser.add_argument("--views", type=int, default=3, help="headings of each scan")
    parser.add_argument("--jitter", type=float, default=0.05, help="largest shift of an edge, as a share of its side")
    parser.add_argument("--samples", type=Path, default=default_samples_root(), help="folder of simulated samples")
    arguments = parser.parse_args()
    data = list(proposals_of(arguments.classes, arguments.samples, arguments.views, arguments.jitter))
    labels = np.concatenate([proposals.labels for proposals, _ in data])
    truth = np.concatenate([boxes for _, boxes in data])
    for text in arguments.localizer or ["geometric", "network"]:
        localizer = load_localizer(text)
        boxes = np.concatenate([localizer(proposals)[0] for proposals, _ in data])
        there = np.isfinite(boxes[:, 0])
        overlap, bev = np.zeros(len(boxes)), np.zeros(len(boxes))
        overlap[there], bev[there] = (
            paired_iou(boxes[there], truth[there]),
            paired_iou(boxes[there], truth[there], True),
        )
        centre = np.where(there, np.linalg.norm(boxes[:, :3] - truth[:, :3], axis=1), np.inf)
        print(f"{text}: class, n, mean 3D IoU, > 0.5, > 0.7, median BEV IoU, median centre error")
        for k, name in enumerate(TEMPLATES[arguments.classes]):
            rows = labels == k
            if rows.any():
                iou = overlap[rows]
                figures = f"{iou.mean():.3f} | {(iou > 0.5).mean():.2f} | {(iou > 0.7).mean():.2f}"
                print(f"{name} | {rows.sum()} | {figures} | {np.median(bev[rows]):.3f} | {np.median(centre[rows]):.2f}")


if __name__ == "__main__":
    main()
