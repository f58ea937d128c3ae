"""How well a frustum localizer places boxes, on KITTI frames with labels and scans.

    python benchmarks/localizer_kitti.py /data/kitti --split sensor_val
    python benchmarks/localizer_kitti.py /data/kitti --split sensor_val --boxes /data/kitti/results/rcnn_2d/data

The frustums come from the labels' own 2D boxes, or (``--boxes``) from the 2D detections of a folder of KITTI result
files, each taken with the label of its class that it overlaps most (IoU of 0.5 or more). ``--localizer`` is what
``lcf3d run --localizer`` takes: geometric, network, onnx:FILE, ...
"""

from __future__ import annotations

import argparse
import json
import time
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lcf3d.datasets.kitti import KittiDataset
from lcf3d.errors import DatasetError
from lcf3d.formats.kitti import KittiObjects, detections_2d, read_objects
from lcf3d.fusion.frustum import FrustumProposals, extract_frustums
from lcf3d.fusion.localizer import Localizer
from lcf3d.geometry.boxes import lidar_from_kitti
from lcf3d.geometry.camera import project_boxes
from lcf3d.geometry.iou import bev_iou, image_iou, iou_3d
from lcf3d.localizers.named import load_localizer
from lcf3d.structures import KITTI_CLASSES, Camera, Detections2D, FloatArray

# a recovered box is confirmed when its image IoU exceeds this (paper, tau_d)
CONFIRMED = 0.3
DISTANCES = ((0.0, 20.0), (20.0, 40.0), (40.0, np.inf))


@dataclass
class Row:
    """One object: where it is, and how far the localizer's box is from its label."""

    frame: str
    label_class: str
    distance: float
    points: int
    iou_3d: float
    bev_iou: float
    image_iou: float
    centre_error: float
    yaw_error_deg: float
    quality: float


def proposals_of(
    points: NDArray[np.float32],
    camera: Camera,
    objects: KittiObjects,
    detections: Detections2D | None,
    jitter: float,
    seed: int,
    cut: float,
) -> tuple[FrustumProposals, list[int]]:
    """Frustums of a frame, and for each the row of its label in ``objects``."""
    known = np.isin(objects.class_names, KITTI_CLASSES) & objects.has_box3d & (objects.truncated >= cut)
    labelled = np.flatnonzero(known)
    if detections is None:
        truth = detections_2d(objects[labelled], KITTI_CLASSES)
        shift = np.random.default_rng(seed).uniform(-jitter, jitter, (len(truth), 4))
        sides = (truth.boxes[:, 2:] - truth.boxes[:, :2])[:, [0, 1, 0, 1]]
        found = Detections2D(truth.boxes + shift * sides, truth.scores, truth.labels, KITTI_CLASSES)
        target = labelled
    else:
        overlap = image_iou(detections.boxes, objects.boxes2d[labelled])
        names = np.array(KITTI_CLASSES)[detections.labels]
        overlap[names[:, None] != objects.class_names[labelled][None]] = 0
        good = overlap.max(axis=1, initial=0) >= 0.5
        found, target = detections[good], labelled[overlap[good].argmax(axis=1)] if good.any() else labelled[:0]
    proposals = extract_frustums(points, [camera], [found], [np.arange(len(found))])
    return proposals, [int(target[d]) for d in proposals.detection_index]


def measure(
    root: Path,
    split: str,
    localizer: Localizer,
    boxes: Path | None,
    score: float,
    jitter: float = 0.0,
    seed: int = 0,
    cut: float = 0.0,
) -> tuple[list[Row], int, list[float]]:
    """All rows of a split, the number of objects asked for, and the seconds that the localizer took on each frame."""
    rows, asked, seconds = [], 0, []
    dataset = KittiDataset(root, split)
    for frame in dataset.ids:
        camera, points = dataset.frame(frame).camera("left"), dataset.frame(frame).points
        if points is None:
            raise DatasetError(f"frame {frame} has no scan in {root / 'training/velodyne'}; choose a split that has")
        objects = read_objects(root / "training/label_2" / f"{frame}.txt", results=False)
        detections = None
        if boxes is not None:
            results = read_objects(boxes / f"{frame}.txt", results=True)
            detections = detections_2d(results, KITTI_CLASSES)
            detections = detections[detections.scores >= score]
        proposals, target = proposals_of(points, camera, objects, detections, jitter, seed, cut)
        asked += int(np.isin(objects.class_names, KITTI_CLASSES).sum()) if detections is None else len(target)
        if not len(proposals):
            continue
        started = time.perf_counter()
        found, quality = localizer(proposals)
        seconds.append(time.perf_counter() - started)
        lidar_boxes = proposals.lidar_from_frustum(found)
        labels = lidar_from_kitti(
            objects.locations[target], objects.dimensions[target], objects.rotation_y[target], camera.camera_from_lidar
        )
        for k, box in enumerate(lidar_boxes):
            part = proposals.part(k)
            rows.append(_row(frame, box, labels[k], proposals, k, part.stop - part.start, float(quality[k]), camera))
    return rows, asked, seconds


def _row(
    frame: str,
    box: FloatArray,
    label: FloatArray,
    proposals: FrustumProposals,
    k: int,
    points: int,
    quality: float,
    camera: Camera,
) -> Row:
    name = proposals.class_names[proposals.labels[k]]
    distance = float(np.hypot(label[0], label[1]))
    if not np.isfinite(box).all():
        return Row(frame, name, distance, points, 0.0, 0.0, 0.0, float("inf"), float("nan"), quality)
    projected, _ = project_boxes(box[None], camera)
    turned = abs((box[6] - label[6] + np.pi / 2) % np.pi - np.pi / 2)
    return Row(
        frame,
        name,
        distance,
        points,
        float(iou_3d(box[None], label[None])[0, 0]),
        float(bev_iou(box[None], label[None])[0, 0]),
        float(image_iou(projected, proposals.boxes2d[k : k + 1])[0, 0]),
        float(np.linalg.norm(box[:3] - label[:3])),
        float(np.degrees(turned)),
        quality,
    )


def table(rows: list[Row]) -> list[list[str]]:
    """One line a class and distance: n, mean 3D IoU, share over 0.5 and 0.7, medians, confirmation rate."""
    lines = []
    for name in KITTI_CLASSES:
        for low, high in ((0.0, np.inf), *DISTANCES):
            chosen = [r for r in rows if r.label_class == name and low <= r.distance < high]
            if not chosen:
                continue
            iou = np.array([r.iou_3d for r in chosen])
            reach = (
                "all" if (low, high) == (0.0, np.inf) else f"{low:.0f}-{high:.0f} m" if high < 1e9 else f">{low:.0f} m"
            )
            figures = (
                f"{iou.mean():.3f}",
                f"{(iou > 0.5).mean():.2f}",
                f"{(iou > 0.7).mean():.2f}",
                f"{np.median([r.bev_iou for r in chosen]):.3f}",
                f"{np.median([r.centre_error for r in chosen]):.2f}",
                f"{np.nanmedian([r.yaw_error_deg for r in chosen]):.1f}",
                f"{np.mean([r.image_iou > CONFIRMED for r in chosen]):.2f}",
            )
            lines.append([name, reach, str(len(chosen)), *figures])
    return lines


HEADER = ["class", "distance", "n", "3D IoU", ">0.5", ">0.7", "BEV med", "centre m", "yaw deg", "confirmed"]


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("root", type=Path, help="KITTI folder with ImageSets/ and training/")
    parser.add_argument("--split", default="val", help="name of a file in ImageSets/")
    parser.add_argument("--boxes", type=Path, help="folder of KITTI result files; default: the labels' 2D boxes")
    parser.add_argument("--score", type=float, default=0.5, help="least score of a 2D detection")
    parser.add_argument("--jitter", type=float, default=0.0, help="move the edges of label boxes by up to this share")
    parser.add_argument("--cut", type=float, default=0.0, help="labels of which at least this share is cut off only")
    parser.add_argument("--localizer", default="geometric", help="as for lcf3d run")
    parser.add_argument("--json", type=Path, help="write every object's figures to this file")
    parser.add_argument("--each", action="store_true", help="print every object")
    arguments = parser.parse_args()
    localizer = load_localizer(arguments.localizer)
    rows, asked, seconds = measure(
        arguments.root,
        arguments.split,
        localizer,
        arguments.boxes,
        arguments.score,
        arguments.jitter,
        cut=arguments.cut,
    )
    if arguments.each:
        for row in rows:
            print(
                f"{row.frame} {row.label_class:10s} {row.distance:5.1f} m {row.points:5d} points  3D {row.iou_3d:.2f}  "
                f"BEV {row.bev_iou:.2f}  image {row.image_iou:.2f}  centre {row.centre_error:5.2f} m  "
                f"yaw {row.yaw_error_deg:4.1f} deg  quality {row.quality:.2f}"
            )
    lines = [HEADER, *table(rows)]
    widths = [max(len(line[i]) for line in lines) for i in range(len(HEADER))]
    print("\n".join("  ".join(f"{field:>{w}}" for field, w in zip(line, widths, strict=True)) for line in lines))
    print(f"{len(rows)} of {asked} objects have a proposal (10 points or more)")
    # the first frame pays for compiling
    print(f"localizer: median {1000 * np.median(seconds[1:] or [np.nan]):.1f} ms a frame")
    if arguments.json:
        arguments.json.write_text(json.dumps([asdict(row) for row in rows], indent=1))


if __name__ == "__main__":
    main()
