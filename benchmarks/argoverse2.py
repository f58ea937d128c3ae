"""Argoverse 2 from end to end: the figures and the picture of docs/argoverse2.md.

    python benchmarks/argoverse2.py ARGOVERSE2 --lidar perturbed.feather --picture docs/images/argoverse2.jpg

``ARGOVERSE2`` holds logs, ``--lidar`` is a file in the submission form. Camera detections are simulated from the
annotations, since there may be no images: boxes projected into the seven ring cameras, hidden ones left out, edges
moved, some missed, some false. Prints the speed of the metrics, AP before and after fusion, and what recovery finds on
the frames with a sweep when the LiDAR branch finds nothing. The picture shows one frame: seven cameras on plain ground
where there are no images, and the bird's-eye view.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from statistics import median
from time import perf_counter

import numpy as np

from lcf3d import Detections2D, Detections3D, FusionConfig, LateCascadeFusion
from lcf3d.datasets.argoverse2 import RING_CAMERAS, Argoverse2Dataset
from lcf3d.datasets.argoverse2_frames import detections_by_frame, results_of_frames
from lcf3d.evaluation.argoverse import ArgoverseMetrics, evaluate_argoverse
from lcf3d.formats.argoverse import read_submission
from lcf3d.formats.coco import write_camera_detections
from lcf3d.frame import Frame
from lcf3d.geometry.camera import depths_of, project_boxes, project_points
from lcf3d.geometry.iou import iou_3d
from lcf3d.reasons import Outcome
from lcf3d.structures import ARGOVERSE_CLASSES, Camera, FloatArray
from lcf3d.visualization.png import draw_frame
from lcf3d.visualization.scene import Scene

CONFIG = FusionConfig.preset("argoverse2")
LEAST_HEIGHT_PX = 12
HIDDEN_SHARE = 0.7
SHOWN_CAMERAS = tuple(
    f"ring_{name}"
    for name in ("front_left", "front_center", "front_right", "side_left", "rear_left", "side_right", "rear_right")
)


def simulated_detections(frame: Frame, rng: np.random.Generator) -> dict[str, Detections2D]:
    """Detections of an imaginary camera detector in every ring camera of a frame."""
    assert frame.labels is not None
    return {
        camera.name: _in_camera(frame.labels, camera, rng) for camera in frame.cameras if camera.name in RING_CAMERAS
    }


def _in_camera(labels: Detections3D, camera: Camera, rng: np.random.Generator) -> Detections2D:
    boxes, visible = project_boxes(labels.boxes, camera)
    visible &= boxes[:, 3] - boxes[:, 1] >= LEAST_HEIGHT_PX
    visible &= hidden_shares(boxes, depths_of(labels.boxes[:, :3], camera), visible) < HIDDEN_SHARE
    height = boxes[:, 3] - boxes[:, 1]
    found = visible & (rng.random(len(boxes)) < 0.92 * np.clip((height - LEAST_HEIGHT_PX) / 20, 0.3, 1))
    size = np.tile(boxes[found, 2:] - boxes[found, :2], 2)
    moved = boxes[found] + rng.normal(0, 0.03, (int(found.sum()), 4)) * size
    count = rng.poisson(0.4)
    centre = rng.uniform([0, 0.35], [1, 0.75], (count, 2)) * [camera.width, camera.height]
    extent = rng.uniform(20, 150, (count, 2))
    false = np.hstack([centre - extent / 2, centre + extent / 2])
    scores = np.concatenate([rng.beta(7, 2, len(moved)), rng.beta(2, 4, count)])
    classes = np.concatenate([labels.labels[found], rng.choice(labels.labels, count)])
    return Detections2D(np.vstack([moved, false]), scores, classes, labels.class_names)


def hidden_shares(boxes: FloatArray, depths: FloatArray, visible: FloatArray) -> FloatArray:
    """(N,) share of each image box that nearer ones cover, on a grid of 16 x 16 places."""
    steps = (np.arange(16) + 0.5) / 16
    shares = np.zeros(len(boxes))
    for i in np.flatnonzero(visible):
        x = boxes[i, 0] + steps * (boxes[i, 2] - boxes[i, 0])
        y = boxes[i, 1] + steps * (boxes[i, 3] - boxes[i, 1])
        nearer = boxes[visible & (depths < depths[i])]
        covers_x = (x >= nearer[:, :1]) & (x <= nearer[:, 2:3])
        covers_y = (y >= nearer[:, 1:2]) & (y <= nearer[:, 3:])
        shares[i] = (covers_x[:, :, None] & covers_y[:, None, :]).any(axis=0).mean()
    return shares


def print_metrics(before: ArgoverseMetrics, after: ArgoverseMetrics) -> None:
    """Markdown table of the annotated classes."""
    print("| class | annotated | AP | AP fused | CDS | CDS fused |\n|---|---|---|---|---|---|")
    annotated = before.ground_truth_counts > 0
    for c in np.flatnonzero(annotated):
        cells = [100 * v for m in (before, after) for v in (m.ap[c],)] + [
            100 * v for m in (before, after) for v in (m.cds[c],)
        ]
        name = ARGOVERSE_CLASSES[c]
        print(f"| {name} | {before.ground_truth_counts[c]} | " + " | ".join(f"{v:.1f}" for v in cells) + " |")
    means = [100 * m.table(annotated)[key] for key in ("AP", "CDS") for m in (before, after)]
    print("| mean of these | | " + " | ".join(f"{v:.1f}" for v in means) + " |")


def measure_recovery(frames: Sequence[Frame], cameras: Sequence[str], seed: int) -> str:
    """What recovery finds in the given cameras of frames with a sweep when the LiDAR branch finds nothing."""
    fusion = LateCascadeFusion(CONFIG)
    rng = np.random.default_rng(seed)
    proposals = recovered = near = right_class = 0
    overlaps, spent = [], []
    for frame in frames:
        assert frame.labels is not None
        camera = {name: found for name, found in simulated_detections(frame, rng).items() if name in cameras}
        start = perf_counter()
        fused = fusion(frame, Detections3D.empty(ARGOVERSE_CLASSES), camera)
        spent.append(perf_counter() - start)
        proposals += sum(int((found.scores > CONFIG.decisive_score).sum()) for found in camera.values())
        boxes = fused.detections[fused.outcomes == Outcome.RECOVERED]
        recovered += len(boxes)
        distances = np.linalg.norm(boxes.boxes[:, None, :2] - frame.labels.boxes[None, :, :2], axis=2)
        nearest = distances.argmin(axis=1)
        hit = distances[np.arange(len(boxes)), nearest] < 2
        near += int(hit.sum())
        right_class += int((boxes.labels == frame.labels.labels[nearest])[hit].sum())
        overlaps += [
            iou_3d(boxes.boxes[i : i + 1], frame.labels.boxes[nearest[i] : nearest[i] + 1])[0, 0]
            for i in np.flatnonzero(hit)
        ]
    return (
        f"{proposals} 2D detections above {CONFIG.decisive_score}, {recovered} recovered, {near} within 2 m of an "
        f"annotation ({right_class} of its class), their median 3D IoU {np.median(overlaps):.2f}"
    )


def point_pictures(frame: Frame, scene: Scene) -> tuple[Frame, Scene]:
    """The frame with its scan drawn in place of images, near points bright; upper and lower quarter are cut off."""
    cameras, images, drawn = [], {}, {}
    for camera in frame.cameras:
        top, height = camera.height // 4, camera.height // 2
        projection = np.array(camera.projection)
        projection[1] -= top * projection[2]
        view = replace(camera, projection=projection, height=height)
        picture = np.full((height, view.width, 3), 24, dtype=np.uint8)
        if frame.points is not None:
            pixels, depths = project_points(frame.points, view)
            inside = (depths > 1) & (pixels >= 4).all(axis=1) & (pixels < [view.width - 4, height - 4]).all(axis=1)
            order = np.flatnonzero(inside)[np.argsort(-depths[inside])]
            bright = np.clip(235 - 45 * np.log(depths[order]), 40, 235).astype(np.uint8)
            for dy, dx in np.ndindex(5, 5):
                rows, columns = pixels[order, 1].astype(int) + dy - 2, pixels[order, 0].astype(int) + dx - 2
                picture[rows, columns] = bright[:, None]
        cameras.append(view)
        images[camera.name] = picture
        if camera.name in scene.image_boxes:
            found = scene.image_boxes[camera.name]
            drawn[camera.name] = replace(found, boxes=found.boxes - [0, top, 0, top])
    return Frame(frame.id, frame.points, cameras, images, frame.labels), replace(scene, image_boxes=drawn)


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("root", type=Path)
    parser.add_argument("--lidar", type=Path, required=True, help="detections in the submission form")
    parser.add_argument("--camera-out", type=Path, help="where to write the simulated camera detections, as JSON")
    parser.add_argument("--picture", type=Path, help="where to draw one frame")
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    dataset = Argoverse2Dataset(arguments.root)
    truth, lidar = dataset.ground_truth(), read_submission(arguments.lidar)
    found = detections_by_frame(lidar)
    before = evaluate_argoverse(truth, lidar)
    spent = []
    for _ in range(9):
        start = perf_counter()
        evaluate_argoverse(truth, lidar)
        spent.append(perf_counter() - start)
    print(
        f"metrics of {len(lidar)} detections and {len(truth)} annotations: {1e3 * median(spent):.0f} ms (median of 9)"
    )

    fusion, rng, fused = LateCascadeFusion(CONFIG), np.random.default_rng(arguments.seed), {}
    scanned, cameras_found = [], {}
    for frame in dataset:
        if frame.labels is None:
            continue
        boxes = found.get(frame.id, Detections3D.empty(ARGOVERSE_CLASSES))
        camera = simulated_detections(frame, rng)
        cameras_found.update({(frame.id, name): seen for name, seen in camera.items()})
        fused[frame.id] = fusion(frame, boxes, camera)
        if frame.points is not None:
            scanned.append(frame)
    after = evaluate_argoverse(truth, results_of_frames({id: result.detections for id, result in fused.items()}))
    print_metrics(before, after)
    if scanned:
        for title, cameras in (("ring_front_center", RING_CAMERAS[:1]), ("seven cameras", RING_CAMERAS)):
            print(f"recovery on {len(scanned)} sweeps, {title}: {measure_recovery(scanned, cameras, arguments.seed)}")
    if arguments.camera_out:
        write_camera_detections(arguments.camera_out, cameras_found)
    if arguments.picture:
        frame = scanned[0] if scanned else dataset[0]
        scene = Scene.from_fused(fused[frame.id], frame.labels)
        arguments.picture.parent.mkdir(parents=True, exist_ok=True)
        draw_frame(*point_pictures(frame, scene), SHOWN_CAMERAS).save(arguments.picture, quality=85)


if __name__ == "__main__":
    main()
