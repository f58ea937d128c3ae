"""LiDAR alone, one view and stereo on a KITTI-layout folder with scans and labels, as a table of average precision.

    lcf3d simulate drives --frames 100
    python benchmarks/stereo_accuracy.py drives --split val
    python benchmarks/stereo_accuracy.py drives --split val --camera onnx:yolox_nano.onnx

The LiDAR detections are the labels with a detector's errors (missed the more, the fewer points an object has; several
boxes an object; false boxes). So are those of the cameras, unless ``--camera`` names a detector to run on the images.
Of the cameras' errors the share ``--shared`` strikes both views alike, since both show the same scene to the same
detector; the rest are independent.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

import numpy as np

from lcf3d import Detections2D, Detections3D, Frame, FusionConfig, LateCascadeFusion
from lcf3d.datasets.kitti import KittiDataset
from lcf3d.evaluation.kitti import evaluate
from lcf3d.formats.kitti import KittiFrames, objects_from_detections, read_folder
from lcf3d.fusion.stereo import StereoConfig, StereoLateCascadeFusion
from lcf3d.geometry.boxes import points_in_boxes
from lcf3d.geometry.camera import project_boxes
from lcf3d.structures import KITTI_CLASSES, FloatArray

Generator = np.random.Generator
# share of the objects of each KITTI occlusion level that a camera detector finds
SEEN = (0.97, 0.9, 0.65, 0.2)
POINTS_FOR_DETECTION = 25.0
FALSE_LIDAR, FALSE_CAMERA = 4.0, 0.5


def lidar_detections(frame: Frame, labels: Detections3D, rng: Generator) -> Detections3D:
    """What a LiDAR detector without non-maximum suppression might find."""
    assert frame.points is not None
    counts = points_in_boxes(frame.points, labels.boxes).sum(axis=1)
    found = rng.random(len(labels)) < 1 - np.exp(-counts / POINTS_FOR_DETECTION)
    groups = np.repeat(np.flatnonzero(found), 3)
    error = rng.normal(0, [0.15, 0.08, 0.05, 0.15, 0.05, 0.05, 0.06], (len(groups), 7))
    # small objects are placed more exactly
    boxes = labels.boxes[groups] + error * np.where(labels.labels[groups] > 0, 0.5, 1.0)[:, None]
    classes = labels.labels[groups].copy()
    confused = (rng.random(len(groups)) < 0.15) & (classes > 0)
    classes[confused] = 3 - classes[confused]
    scores = rng.beta(5, 2, len(groups))
    # false boxes stand on points, as real ones do
    ahead = frame.points[(frame.points[:, 0] > 5) & (np.abs(frame.points[:, 1]) < 25)]
    places = ahead[rng.integers(0, len(ahead), rng.poisson(FALSE_LIDAR))]
    false_classes = rng.integers(0, 3, len(places))
    sizes = np.array([[3.9, 1.6, 1.5], [0.8, 0.6, 1.75], [1.8, 0.6, 1.75]])[false_classes]
    headings = rng.uniform(-np.pi, np.pi, len(places))
    false = np.column_stack([places[:, :2], sizes[:, 2] / 2 - 1.7, sizes, headings])
    return Detections3D(
        np.concatenate([boxes, false]),
        np.concatenate([scores, rng.beta(2, 3, len(places))]),
        np.concatenate([classes, false_classes]),
        KITTI_CLASSES,
    )


class Cameras:
    """Made-up detections of both views of one frame, with errors in common."""

    def __init__(self, labels: Detections3D, occlusion: FloatArray, shared: float, rng: Generator) -> None:
        self.labels, self.rng, self.shared = labels, rng, shared
        self.luck, self.chance = rng.random(len(labels)), np.array(SEEN)[occlusion.astype(int).clip(0, 3)]
        self.scores = rng.beta(6, 2, len(labels))
        count = rng.poisson(FALSE_CAMERA)
        distance = rng.uniform(8, 50, count)
        place = np.stack([distance, rng.uniform(-0.6, 0.6, count) * distance], axis=1)
        size = np.array([[0.8, 0.6, 1.7]]).repeat(count, axis=0)
        self.false = np.column_stack([place, np.full(count, -0.8), size, np.zeros(count)])

    def detect(self, frame: Frame, name: str) -> Detections2D:
        """The detections of one view."""
        rng, view = self.rng, frame.camera(name)
        exact, visible = project_boxes(self.labels.boxes, view)
        own = rng.random(len(exact)) >= self.shared
        luck = np.where(own, rng.random(len(exact)), self.luck)
        tall = exact[:, 3] - exact[:, 1] > 20
        seen = np.flatnonzero(visible & tall & (luck < self.chance))
        scores = np.where(own, rng.beta(6, 2, len(exact)), self.scores)[seen]
        false, there = project_boxes(self.false, view)
        false = false[there & (rng.random(len(false)) < self.shared)]
        lonely = rng.poisson(FALSE_CAMERA * (1 - self.shared))
        corner = rng.uniform([0, 140], [view.width - 60, 200], (lonely, 2))
        lonely_boxes = np.concatenate([corner, corner + rng.uniform(25, 60, (lonely, 2))], axis=1)
        boxes = np.concatenate([exact[seen], false, lonely_boxes])
        boxes += rng.normal(0, 0.03, boxes.shape) * np.tile(boxes[:, 2:] - boxes[:, :2], 2)
        classes = np.concatenate([self.labels.labels[seen], np.full(len(false), 1), rng.integers(0, 3, lonely)])
        return Detections2D(
            np.clip(boxes, 0, [view.width, view.height] * 2),
            np.concatenate([scores, rng.beta(3, 3, len(false) + lonely)]),
            classes,
            KITTI_CLASSES,
        )


def main() -> None:
    """Run the benchmark."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("root", type=Path)
    parser.add_argument("--split", default="val")
    parser.add_argument("--camera", help="camera detector to run on the images, for example onnx:FILE?tiles=2")
    parser.add_argument("--shared", type=float, default=0.5, help="share of the camera errors that both views have")
    parser.add_argument("--preset", default="kitti")
    parser.add_argument("--seed", type=int, default=0, help="of the made-up detections")
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()

    detector: Any = None
    if options.camera:
        from lcf3d.detectors.named import load_detector

        detector = load_detector(options.camera, "camera", KITTI_CLASSES)
    stereo = StereoConfig.preset(options.preset)
    single = LateCascadeFusion(FusionConfig.preset(options.preset))
    ways: dict[str, LateCascadeFusion] = {
        "one view": single,
        "stereo, unpaired discard": StereoLateCascadeFusion(stereo.updated(unpaired="discard")),
        "the same without check_depth": StereoLateCascadeFusion(stereo.updated(unpaired="discard", check_depth=False)),
        "stereo, unpaired single_view": StereoLateCascadeFusion(stereo.updated(unpaired="single_view")),
    }
    data = KittiDataset(options.root, options.split)
    truth = read_folder(data.folder / "label_2", data.ids, results=False)
    results: dict[str, list[Any]] = {name: [] for name in ("lidar", *ways)}
    rng = np.random.default_rng(options.seed)
    for frame_id, objects in zip(data.ids, truth, strict=True):
        frame = data.frame(frame_id)
        labels = frame.labels
        assert labels is not None
        wanted = np.isin(objects.class_names, KITTI_CLASSES)
        lidar = lidar_detections(frame, labels, rng)
        if detector is None:
            cameras = Cameras(labels, objects.occluded[wanted], options.shared, rng)
            found = {name: cameras.detect(frame, name) for name in ("left", "right")}
        else:
            found = {name: detector([frame.images[name]])[0] for name in ("left", "right")}
        left = frame.camera("left")
        # alone, the LiDAR branch gets the non-maximum suppression that its clusters are otherwise for
        outputs = {"lidar": single(frame, lidar, {}).detections}
        for name, fusion in ways.items():
            outputs[name] = fusion(frame, lidar, {"left": found["left"]} if name == "one view" else found).detections
        for name, detections in outputs.items():
            boxes2d, visible = project_boxes(detections.boxes, left)
            kept = np.flatnonzero(visible)
            results[name].append(objects_from_detections(detections[kept], boxes2d[kept], left.camera_from_lidar))
    table: dict[str, dict[str, dict[str, float]]] = {}
    for name, frames in results.items():
        metrics = evaluate(truth, KittiFrames.from_frames(data.ids, frames))
        table[name] = {
            c: {level: metrics.ap(c, "3d", level) for level in ("easy", "moderate", "hard")} for c in KITTI_CLASSES
        }
    if options.json:
        print(json.dumps({"frames": len(data), "ap_3d_r40": table}, indent=2))
        return
    print(f"{len(data)} frames; 3D AP R40, easy / moderate / hard")
    for name, row in table.items():
        cells = "   ".join(f"{c} " + " / ".join(f"{v:5.1f}" for v in row[c].values()) for c in KITTI_CLASSES)
        print(f"{name:30s} {cells}")


if __name__ == "__main__":
    main()
