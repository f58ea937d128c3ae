"""What each setting of the nuScenes preset brings, class by class, with results in files and no scans.

    python benchmarks/nuscenes_presets.py NUSCENES --lidar centerpoint.json --camera camera_2d_simulated.json

Each row adds one change to the row above. Also counts how often the camera's label replaces the LiDAR's (paper,
Algorithm 1) and how often that is right: the annotation nearest to the box, within 2 m, decides. ``--json`` prints the
numbers as JSON. With camera detections that are simulated from ground truth only the order of the rows means anything.
"""

from __future__ import annotations

import argparse
import json
from collections import Counter
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from lcf3d import FusionConfig, LateCascadeFusion, Lcf3dError
from lcf3d.datasets.nuscenes import NuscenesDataset
from lcf3d.evaluation.nuscenes import NuscenesMetrics, evaluate_nuscenes
from lcf3d.formats.nuscenes_boxes import global_from_detections
from lcf3d.frame import Frame
from lcf3d.fusion.evidence import Evidence
from lcf3d.provenance import FusedDetections
from lcf3d.structures import NUSCENES_CLASSES, Detections2D, Detections3D

# the weights that the kitti preset has for people, without the competing, for every class
_EVIDENCE = Evidence(base=-1.0, trust=1.0, support=(2.5, 4.5, 6.0, 6.0), miss=0.3, off_ground=0.0, competing=0.0)
START: dict[str, Any] = {
    "recovery": False,
    "class_names": NUSCENES_CLASSES,
    "camera_score_threshold": 0.2,
    "decisive_score": 0.0,
    "lidar_score_threshold": 0.05,
    "class_aware": False,
    "assignment": "gated",
    "match_iou": 0.5,
    "unmatched": "downweight",
    "ensemble": "probabilistic",
}
STEPS: dict[str, dict[str, Any]] = {
    "the method's values": {},
    "+ equal classes first": {"class_aware": True, "assignment": "class_first"},
    "+ match_iou 0.4": {"match_iou": 0.4},
    "+ evidence": {
        "ensemble": "evidence",
        "camera_score_threshold": 0.1,
        "evidence": {name: _EVIDENCE.model_dump() for name in NUSCENES_CLASSES},
    },
    "+ labels change above 0.5": {"decisive_score": 0.5},
    "+ above 0.7": {"decisive_score": 0.7},
    "+ above 0.8": {"decisive_score": 0.8},
}


def label_changes(frames: list[Frame], fused: Mapping[str, FusedDetections]) -> Counter[str]:
    """How often a matched camera detection changed a label: ``right``, ``wrong`` (it was right), ``neither``."""
    counts: Counter[str] = Counter(right=0, wrong=0, neither=0)
    for frame in frames:
        result, truth = fused[frame.id], frame.labels
        assert truth is not None
        rows = np.flatnonzero((result.lidar.output >= 0) & (result.lidar.detection >= 0))
        before = result.lidar_inputs.labels[rows]
        after = result.detections.labels[result.lidar.output[rows]]
        for row, old, new in zip(rows, before, after, strict=True):
            if old == new:
                continue
            apart = np.linalg.norm(truth.boxes[:, :2] - result.lidar_inputs.boxes[row, :2], axis=1)
            is_near = len(apart) > 0 and apart.min() < 2
            true_label = truth.labels[apart.argmin()] if is_near else -1
            counts["right" if true_label == new else "wrong" if true_label == old else "neither"] += 1
    return counts


def evaluate(dataset: NuscenesDataset, detections: Mapping[str, Detections3D]) -> NuscenesMetrics:
    """Official metrics; missing attributes become the defaults, for LiDAR alone as for the fused."""
    transforms = {token: dataset.global_from_lidar(token) for token in dataset.ids}
    boxes = global_from_detections(detections, transforms, dataset.ids)
    return evaluate_nuscenes(dataset.tables, dataset.sample_rows, boxes)


def measure(root: Path, split: str, lidar: Path, camera: Path) -> list[dict[str, Any]]:
    """One row for LiDAR alone and one for every step."""
    dataset = NuscenesDataset(root, split=split, late_cameras="drop")
    frames = [dataset.frame(token) for token in dataset.ids]
    found3d = dataset.lidar_results(lidar, NUSCENES_CLASSES)
    found2d = dataset.camera_results(camera, NUSCENES_CLASSES)
    lidar_of = {frame.id: found3d.detect(frame) for frame in frames}
    camera_of: dict[str, dict[str, Detections2D]] = {
        frame.id: {view.name: found2d.detect(frame, view.name) for view in frame.cameras} for frame in frames
    }
    rows = [_row("LiDAR alone", evaluate(dataset, lidar_of), Counter())]
    config = FusionConfig(**START)
    for name, changes in STEPS.items():
        config = config.updated(**changes)
        fusion = LateCascadeFusion(config)
        fused = {frame.id: fusion(frame, lidar_of[frame.id], camera_of[frame.id]) for frame in frames}
        metrics = evaluate(dataset, {token: result.detections for token, result in fused.items()})
        rows.append(_row(name, metrics, label_changes(frames, fused)))
    return rows


def _row(name: str, metrics: NuscenesMetrics, changes: Counter[str]) -> dict[str, Any]:
    counted = zip(metrics.class_names, metrics.aps.mean(axis=1), metrics.ground_truth_counts, strict=True)
    return {
        "settings": name,
        "ap": {label: round(100 * float(ap), 2) for label, ap, count in counted if count},
        "mAP": round(100 * metrics.mean_ap, 2),
        "NDS": round(100 * metrics.nd_score, 2),
        "NDS^": round(100 * metrics.nds_hat, 2),
        "label_changes": dict(changes),
    }


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description="What each setting of the nuScenes preset brings.")
    parser.add_argument("root", type=Path)
    parser.add_argument("--split", default="mini_val")
    parser.add_argument("--lidar", type=Path, required=True)
    parser.add_argument("--camera", type=Path, required=True)
    parser.add_argument("--json", action="store_true")
    arguments = parser.parse_args()
    try:
        rows = measure(arguments.root, arguments.split, arguments.lidar, arguments.camera)
    except Lcf3dError as error:
        parser.error(str(error))
    if arguments.json:
        print(json.dumps(rows, indent=2))
        return
    classes = list(rows[0]["ap"])
    print(f"{'':26}" + "".join(f"{name[:10]:>11}" for name in (*classes, "mAP", "NDS", "NDS^")) + "  labels changed")
    for row in rows:
        numbers = [*(row["ap"][name] for name in classes), row["mAP"], row["NDS"], row["NDS^"]]
        changes = row["label_changes"]
        text = f"  {changes['right']} right, {changes['wrong']} wrong, {changes['neither']} neither" if changes else ""
        print(f"{row['settings']:26}" + "".join(f"{n:11.2f}" for n in numbers) + text)


if __name__ == "__main__":
    main()
