"""Bounding box matching from general libraries, to measure ours against: shapely, networkx, scipy."""

from __future__ import annotations

from typing import Any

import numpy as np

from lcf3d.errors import MissingExtraError
from lcf3d.geometry.boxes import bev_corners, box_corners
from lcf3d.structures import Camera, FloatArray, IntArray


def plain_matching(
    boxes: FloatArray,
    scores: FloatArray,
    camera: Camera,
    boxes2d: FloatArray,
    cluster_iou: float,
    match_iou: float,
) -> tuple[list[list[int]], IntArray]:
    """Clusters (members, best first) and the 2D box of each or -1, by the rules of ``lcf3d.fusion.matching``.

    All boxes must be in front of the camera: this reference does not cut them at the near plane.
    """
    try:
        import networkx
        import shapely
    except ImportError as error:
        raise MissingExtraError(error.name or "networkx", "dev", "the reference of the benchmark") from None
    from scipy.optimize import linear_sum_assignment

    polygons = shapely.polygons(bev_corners(boxes))
    first, second = shapely.STRtree(polygons).query(polygons, predicate="intersects")
    once = first < second
    first, second = first[once], second[once]
    shared = shapely.area(shapely.intersection(polygons[first], polygons[second]))
    areas = shapely.area(polygons)
    linked = shared / (areas[first] + areas[second] - shared) > cluster_iou
    graph: Any = networkx.Graph()
    graph.add_nodes_from(range(len(boxes)))
    graph.add_edges_from(zip(first[linked].tolist(), second[linked].tolist(), strict=True))
    clusters = _greedy_cliques(graph, np.argsort(-scores).tolist())

    projected = _project(boxes, camera)
    iou = np.zeros((len(clusters), len(boxes2d)))
    for c, members in enumerate(clusters):
        for m, box2d in enumerate(boxes2d):
            iou[c, m] = max(_image_iou(projected[i], box2d) for i in members)
    gated = np.where(iou > match_iou, iou, 0)
    rows, columns = linear_sum_assignment(gated, maximize=True)
    match = np.full(len(clusters), -1, dtype=np.int64)
    kept = gated[rows, columns] > 0
    match[rows[kept]] = columns[kept]
    return clusters, match


def _greedy_cliques(graph: Any, order: list[int]) -> list[list[int]]:
    free = dict.fromkeys(order)
    clusters = []
    while free:
        seed = next(iter(free))
        members = [seed]
        del free[seed]
        for other in [i for i in free if graph.has_edge(seed, i)]:
            if all(graph.has_edge(other, member) for member in members):
                members.append(other)
                del free[other]
        clusters.append(members)
    return clusters


def _project(boxes: FloatArray, camera: Camera) -> FloatArray:
    corners = box_corners(boxes).reshape(-1, 3)
    homogeneous = corners @ camera.pixels_from_lidar[:, :3].T + camera.pixels_from_lidar[:, 3]
    pixels = (homogeneous[:, :2] / homogeneous[:, 2:]).reshape(-1, 8, 2)
    limits = np.array([camera.width, camera.height])
    return np.concatenate([np.clip(pixels.min(axis=1), 0, limits), np.clip(pixels.max(axis=1), 0, limits)], axis=1)


def _image_iou(a: FloatArray, b: FloatArray) -> float:
    width, height = min(a[2], b[2]) - max(a[0], b[0]), min(a[3], b[3]) - max(a[1], b[1])
    if width <= 0 or height <= 0:
        return 0.0
    shared = width * height
    return float(shared / ((a[2] - a[0]) * (a[3] - a[1]) + (b[2] - b[0]) * (b[3] - b[1]) - shared))
