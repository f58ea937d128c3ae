"""What a camera detector of COCO's classes does to objects that COCO has no name for, on nuScenes.

Barriers, cones, trailers and construction vehicles have no class in COCO: that such a camera does not report one says
nothing. The LiDAR branch's boxes of these classes that lie in some camera's image are followed through the fusion, once
with the camera believed on everything (``judged``), once only on what it can report (``not judged``, what `lcf3d run`
does). The camera branch is a result file of which only COCO's classes are left.

python benchmarks/coco_on_nuscenes.py NUSCENES --lidar centerpoint.json --camera camera_2d_simulated.json
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from lcf3d import FusionConfig, LateCascadeFusion
from lcf3d.datasets.nuscenes import NuscenesDataset
from lcf3d.frame import Frame
from lcf3d.geometry.camera import project_boxes
from lcf3d.structures import NUSCENES_CLASSES, Detections2D, Detections3D

COCO = ("car", "truck", "bus", "pedestrian", "motorcycle", "bicycle")
OTHERS = tuple(name for name in NUSCENES_CLASSES if name not in COCO)
SURE = 0.5

Inputs = Sequence[tuple[Frame, Detections3D, dict[str, Detections2D]]]


def read(args: argparse.Namespace) -> Inputs:
    """Frames with the detections of both branches; the camera's are of `COCO` only."""
    dataset = NuscenesDataset(args.root, split=args.split)
    lidar = dataset.lidar_results(args.lidar, NUSCENES_CLASSES)
    camera = dataset.camera_results(args.camera, NUSCENES_CLASSES)
    for source in (lidar, camera):
        source.load(dataset.ids)
    found = []
    for frame in dataset:
        seen = {c.name: camera.detect(frame, c.name) for c in frame.cameras}
        named = [NUSCENES_CLASSES.index(name) for name in COCO]
        found.append((frame, lidar.detect(frame), {n: s[np.isin(s.labels, named)] for n, s in seen.items()}))
    return found


def follow(config: FusionConfig, inputs: Inputs, reports: dict[str, Sequence[str]] | None) -> tuple[list[float], int]:
    """Scores after the fusion of the sure boxes of `OTHERS` that some camera looks at, 0 where deleted; and how many
    of them are left."""
    fusion = LateCascadeFusion(config, reports=reports)
    scores: list[float] = []
    for frame, boxes, seen in inputs:
        fused = fusion(frame, boxes, seen)
        followed = (boxes.scores >= SURE) & np.isin(boxes.labels, [NUSCENES_CLASSES.index(name) for name in OTHERS])
        followed &= np.any([project_boxes(boxes.boxes, camera)[1] for camera in frame.cameras], axis=0)
        for i in np.flatnonzero(followed):
            output = int(fused.lidar.output[i])
            scores.append(float(fused.detections.scores[output]) if output >= 0 else 0.0)
    return scores, sum(score > 0 for score in scores)


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("root", type=Path)
    parser.add_argument("--split", default="mini_val")
    parser.add_argument("--lidar", type=Path, required=True)
    parser.add_argument("--camera", type=Path, required=True)
    args = parser.parse_args()
    inputs = read(args)
    reports = {camera.name: COCO for camera in inputs[0][0].cameras}
    before = [
        score
        for _, boxes, _ in inputs
        for score, label in zip(boxes.scores.tolist(), boxes.labels.tolist(), strict=True)
        if score >= SURE and NUSCENES_CLASSES[label] in OTHERS
    ]
    print(f"{len(before)} boxes of {', '.join(OTHERS)}, median score of the LiDAR branch {np.median(before):.2f}")
    print("preset    camera      seen  left  median score after the fusion")
    for preset in ("nuscenes", "paper"):
        config = FusionConfig.preset(preset, class_names=NUSCENES_CLASSES).updated(recovery=False)
        for name, known in (("judged", None), ("not judged", reports)):
            scores, left = follow(config, inputs, known)
            print(f"{preset:9} {name:10} {len(scores):6} {left:5}  {np.median(scores):.2f}")


if __name__ == "__main__":
    main()
