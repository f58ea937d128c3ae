"""Speed of the fusion's stages."""

from __future__ import annotations

from importlib.util import find_spec

import numpy as np

from lcf3d.benchmark.reference import plain_matching
from lcf3d.benchmark.scenes import detections
from lcf3d.benchmark.timing import Timing, timed
from lcf3d.fusion.clustering import cluster_boxes
from lcf3d.fusion.config import FusionConfig
from lcf3d.fusion.frustum import extract_frustums
from lcf3d.fusion.matching import match_view, merge_views
from lcf3d.fusion.pipeline import LateCascadeFusion
from lcf3d.fusion.recovery import recover
from lcf3d.fusion.semantic import semantic_fusion
from lcf3d.geometry.camera import project_boxes
from lcf3d.geometry.iou import image_iou
from lcf3d.localizers.named import load_localizer

MATCHING_BUDGETS_MS = {(200, 20): 0.9, (500, 40): 3.0}
SEMANTIC_BUDGET_MS = 0.14
RECOVERY_BUDGETS_MS = {"geometric": 5.0, "network": 15.0}
"""15 ms for a network, then 5."""
STEP_BUDGET_MS = 5.0


def bench_fusion(seconds: float = 1.0) -> list[Timing]:
    """Timings of matching, recovery, semantic fusion and the whole step, with budgets and references.

    The reference needs shapely and networkx (extra ``dev``); without them that column stays empty.
    """
    timings = [_matching(lidar, camera, seconds) for lidar, camera in MATCHING_BUDGETS_MS]
    timings += [_one_spot(seconds), _semantic(seconds)]
    timings += [_recovery(name, seconds) for name in RECOVERY_BUDGETS_MS]
    return [*timings, *(_step(name, seconds) for name in ("geometric", "network"))]


def _matching(lidar_count: int, camera_count: int, seconds: float) -> Timing:
    frame, lidar, camera = detections(lidar_count, camera_count)
    config, view = FusionConfig(), frame.cameras[0]

    def ours() -> None:
        clusters = cluster_boxes(lidar.boxes, lidar.scores, lidar.labels, iou_threshold=config.cluster_iou)
        found = match_view(lidar.boxes, clusters, view, camera.boxes, iou_threshold=config.match_iou)
        merge_views([found], len(clusters))

    def reference() -> None:
        plain_matching(lidar.boxes, lidar.scores, view, camera.boxes, config.cluster_iou, config.match_iou)

    return timed(
        f"bounding box matching, {lidar_count} x {camera_count}",
        ours,
        budget_ms=MATCHING_BUDGETS_MS[lidar_count, camera_count],
        reference=reference if find_spec("shapely") and find_spec("networkx") else None,
        seconds=seconds,
    )


def _one_spot(seconds: float) -> Timing:
    """The worst case: as many boxes as ``max_boxes`` allows, all on one spot."""
    count = FusionConfig().max_boxes
    rng = np.random.default_rng(0)
    boxes = np.tile([20.0, 0, -0.9, 3.9, 1.6, 1.6, 0.3], (count, 1)) + rng.normal(0, 0.01, (count, 7))
    scores, labels = rng.uniform(0, 1, count), np.zeros(count, dtype=np.int64)
    return timed(
        f"clustering, {count} boxes on one spot", lambda: cluster_boxes(boxes, scores, labels), seconds=seconds
    )


def _semantic(seconds: float) -> Timing:
    rng = np.random.default_rng(0)
    lidar_scores, camera_scores = rng.uniform(0, 1, (2, 40))
    lidar_labels, camera_labels = rng.integers(0, 3, (2, 40))
    priors = FusionConfig().prior_array()
    return timed(
        "semantic fusion, 40 matches",
        lambda: semantic_fusion(lidar_scores, lidar_labels, camera_scores, camera_labels, priors),
        budget_ms=SEMANTIC_BUDGET_MS,
        seconds=seconds,
    )


def _recovery(name: str, seconds: float) -> Timing:
    localizer = load_localizer(name)
    frame, _, camera = detections(10, 20)
    points, config = frame.points, FusionConfig()
    assert points is not None
    # of twenty objects those whose frustums are nearest to the 1,000 points that the budget speaks of
    everything = extract_frustums(points, frame.cameras, [camera], [np.arange(len(camera))])
    order = np.argsort(np.abs(np.diff(everything.offsets) - 1000), kind="stable")[:5]
    chosen = np.sort(everything.detection_index[order])

    def ours() -> None:
        recover(
            points,
            frame.cameras,
            [camera],
            [chosen],
            np.zeros((0, 7)),
            localizer,
            enlargement=config.enlargement,
            min_points=config.min_points,
            mask_mode=config.mask_mode,
            confirm_iou=config.confirm_iou,
            duplicate_iou=config.duplicate_iou,
            min_quality=config.min_quality,
        )

    return timed(f"detection recovery, 5 frustums, {name}", ours, budget_ms=RECOVERY_BUDGETS_MS[name], seconds=seconds)


def _step(name: str, seconds: float) -> Timing:
    """200 LiDAR boxes, 20 camera detections, about two of which have no LiDAR box."""
    frame, lidar, camera = detections(200, 20)
    # the LiDAR detector misses what the first two camera detections show
    overlap = image_iou(project_boxes(lidar.boxes, frame.cameras[0])[0], camera.boxes[:2])
    away = lidar[np.flatnonzero((overlap < 0.1).all(axis=1))]
    fusion = LateCascadeFusion(FusionConfig(), load_localizer(name))
    return timed(
        f"whole fusion step, 200 x 20, 120,000 points, {name}",
        lambda: fusion(frame, away, {"left": camera}),
        budget_ms=STEP_BUDGET_MS,
        seconds=seconds,
    )
