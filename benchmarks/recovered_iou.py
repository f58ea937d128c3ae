"""What a run on KITTI layout matched, recovered and dropped, frame by frame, and how well recovered boxes fit labels.

lcf3d run kitti:KITTI --split SPLIT ... --out fused
python benchmarks/recovered_iou.py KITTI fused
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

from lcf3d.datasets.kitti import KittiDataset
from lcf3d.geometry.iou import bev_iou, iou_3d
from lcf3d.reasons import Outcome, Reason
from lcf3d.run.folder import RunFolder

# Van and Person_sitting are neighbours of Car and Pedestrian: a box on one of them is no mistake
CLASSES = ("Car", "Pedestrian", "Cyclist", "Van", "Truck", "Person_sitting", "Misc")


def main() -> None:
    """Print the report."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("root", type=Path, help="KITTI-layout folder")
    parser.add_argument("run", type=Path, help="folder written by lcf3d run")
    arguments = parser.parse_args()
    dataset, folder = KittiDataset(arguments.root, class_names=CLASSES), RunFolder(arguments.run)
    for path in sorted((arguments.run / "provenance").glob("*.json")):
        fused, frame = folder.read(path.stem), dataset.frame(path.stem)
        counts = np.bincount(fused.outcomes, minlength=4)
        reasons = [Reason(r).name.lower() for r in fused.camera.reason[fused.camera.outcome == Outcome.DROPPED]]
        print(
            f"{path.stem}: matched {counts[Outcome.MATCHED]}, recovered {counts[Outcome.RECOVERED]}, "
            f"kept {counts[Outcome.KEPT]}, LiDAR dropped {len(fused.dropped_lidar)}; 2D detections without a box: "
            + (", ".join(f"{reasons.count(r)} {r}" for r in sorted(set(reasons) - {"low_score"})) or "none")
        )
        labels = frame.labels
        if labels is None or not len(labels):
            continue
        for i in np.flatnonzero(fused.outcomes == Outcome.RECOVERED):
            box = fused.detections.boxes[[i]]
            flat, solid = bev_iou(box, labels.boxes)[0], iou_3d(box, labels.boxes)[0]
            near = np.hypot(*(labels.boxes[:, :2] - box[0, :2]).T)
            best = int(np.argmax(flat)) if flat.max() > 0 else int(np.argmin(near))
            name = fused.detections.class_names[fused.detections.labels[i]]
            away = np.hypot(*box[0, :2])
            print(
                f"    {name} {fused.detections.scores[i]:.2f} at {away:.0f} m: 3D IoU {solid[best]:.2f}, BEV IoU "
                f"{flat[best]:.2f}, {near[best]:.2f} m from the nearest {labels.class_names[labels.labels[best]]}"
            )


if __name__ == "__main__":
    main()
