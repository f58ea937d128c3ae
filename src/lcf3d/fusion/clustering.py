"""Clusters of LiDAR boxes in bird's-eye view (paper section 4.1.3, equation 2; docs/method.md, matching 1-2)."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np

from lcf3d.geometry.iou import turned_intersection
from lcf3d.kernels import kernel
from lcf3d.structures import FloatArray, IntArray

Clustering = Literal["cliques", "components", "nms"]
_CODES = {"cliques": 0, "components": 1, "nms": 2}

# cluster of a box that non-maximum suppression removed
SUPPRESSED = -1


@dataclass(frozen=True, eq=False)
class Clusters:
    """A partition of boxes.

    Attributes:
        index: (N,) cluster of every box, or `SUPPRESSED`.
        representative: (C,) highest-scoring box of every cluster: the paper's cluster-wise NMS (end of section 4.1.3).
    """

    index: IntArray
    representative: IntArray

    def __len__(self) -> int:
        return len(self.representative)


def cluster_boxes(
    boxes: FloatArray,
    scores: FloatArray,
    labels: IntArray,
    *,
    method: Clustering = "cliques",
    iou_threshold: float = 0.3,
    class_aware: bool = False,
) -> Clusters:
    """Cluster of every box; two boxes are linked when their rotated BEV IoU is above ``iou_threshold``.

    Args:
        boxes: (N, 7) canonical boxes.
        scores: (N,) scores.
        labels: (N,) labels.
        method: ``cliques`` partitions greedily: the free box of highest score begins a cluster, then every free box, in
            descending score, that is linked to all members so far joins it. ``components``: connected components.
            ``nms``: the predecessor's rule, suppression first and one cluster a surviving box.
        iou_threshold: ``tau_z``, exclusive.
        class_aware: link boxes of equal label only.

    Returns:
        `Clusters`, numbered by descending highest score. Equal scores are ordered by the boxes' own numbers, so that
        the result does not depend on the order of the input. Time grows with the number of overlapping pairs: N log N
        for separated boxes, N^2 / 2 overlaps of about 0.1 us each when all stand on one spot.
    """
    if not len(boxes):
        return Clusters(np.zeros(0, dtype=np.int64), np.zeros(0, dtype=np.int64))
    order = np.argsort(-scores, kind="stable")
    descending = scores[order]
    if (descending[1:] == descending[:-1]).any():
        order = np.lexsort((labels, *boxes.T[::-1], -scores))
    partition, first = _cluster_sorted(boxes[order], labels[order], iou_threshold, class_aware, _CODES[method])
    clusters = np.empty(len(boxes), dtype=np.int64)
    clusters[order] = partition
    return Clusters(clusters, order[first])


@kernel
def _cluster_sorted(boxes, labels, iou_threshold, class_aware, method):  # type: ignore[no-untyped-def]
    """Clusters of boxes sorted by descending score, and the first box of each; ``method`` is a code of ``_CODES``."""
    neighbours, offsets = _links(boxes, labels, iou_threshold, class_aware)
    partition = _partition(neighbours, offsets, method)
    first = np.empty(len(boxes), np.int64)
    count = 0
    for i in range(len(boxes)):
        # clusters are numbered in the order of their first boxes
        if partition[i] == count:
            first[count] = i
            count += 1
    return partition, first[:count]


@kernel
def _links(boxes, labels, iou_threshold, class_aware):  # type: ignore[no-untyped-def]
    """Linked later boxes of every box: (E,) neighbours in ascending order and (N + 1,) offsets.

    Boxes are sorted into square cells as wide as the largest box, so that only nine cells need a look.
    """
    n = len(boxes)
    cos, sin = np.cos(boxes[:, 6]), np.sin(boxes[:, 6])
    reach = 0.0
    for i in range(n):
        reach = max(reach, math.hypot(boxes[i, 3], boxes[i, 4]))
    cell = max(reach, 1e-3)
    column = np.floor((boxes[:, 0] - boxes[:, 0].min()) / cell).astype(np.int64)
    row = np.floor((boxes[:, 1] - boxes[:, 1].min()) / cell).astype(np.int64)
    stride = row.max() + 3
    key = (column + 1) * stride + row + 1
    by_key = np.argsort(key, kind="mergesort")
    sorted_key = key[by_key]
    neighbours = np.empty(4 * n + 16, np.int64)
    offsets = np.zeros(n + 1, np.int64)
    links = 0
    for i in range(n):
        first = links
        area = boxes[i, 3] * boxes[i, 4]
        for step in range(-1, 2):
            low = np.searchsorted(sorted_key, key[i] + step * stride - 1)
            for at in range(low, n):
                if sorted_key[at] > key[i] + step * stride + 1:
                    break
                j = by_key[at]
                if j <= i or (class_aware and labels[i] != labels[j]):
                    continue
                other = boxes[j, 3] * boxes[j, 4]
                # the IoU cannot exceed the ratio of the areas
                if min(area, other) <= iou_threshold * max(area, other):
                    continue
                shared = turned_intersection(
                    boxes[i, 0],
                    boxes[i, 1],
                    boxes[i, 3],
                    boxes[i, 4],
                    cos[i],
                    sin[i],
                    boxes[j, 0],
                    boxes[j, 1],
                    boxes[j, 3],
                    boxes[j, 4],
                    cos[j],
                    sin[j],
                )
                if shared > iou_threshold * (area + other - shared):
                    if links == len(neighbours):
                        neighbours = np.concatenate((neighbours, np.empty(links, np.int64)))
                    neighbours[links] = j
                    links += 1
        neighbours[first:links].sort()
        offsets[i + 1] = links
    return neighbours[:links], offsets


@kernel
def _partition(neighbours, offsets, method):  # type: ignore[no-untyped-def]
    """Cluster index of boxes sorted by descending score, from their links; ``method`` is a code of ``_CODES``."""
    n = len(offsets) - 1
    cluster = np.full(n, -2, np.int64)
    shared = np.zeros(n, np.int64)
    members = 0
    clusters = 0
    if method == 1:
        return _components(neighbours, offsets)
    for seed in range(n):
        if cluster[seed] != -2:
            continue
        cluster[seed] = clusters
        if method == 2:
            for at in range(offsets[seed], offsets[seed + 1]):
                if cluster[neighbours[at]] == -2:
                    cluster[neighbours[at]] = -1
            clusters += 1
            continue
        # shared[j] counts the members that j is linked to; j joins when that is all of them
        for at in range(offsets[seed], offsets[seed + 1]):
            shared[neighbours[at]] = 1
        members = 1
        for at in range(offsets[seed], offsets[seed + 1]):
            j = neighbours[at]
            if cluster[j] != -2 or shared[j] != members:
                continue
            cluster[j] = clusters
            members += 1
            for onward in range(offsets[j], offsets[j + 1]):
                shared[neighbours[onward]] += 1
        clusters += 1
        for at in range(offsets[seed], offsets[seed + 1]):
            shared[neighbours[at]] = 0
            for onward in range(offsets[neighbours[at]], offsets[neighbours[at] + 1]):
                shared[neighbours[onward]] = 0
    return cluster


@kernel
def _components(neighbours, offsets):  # type: ignore[no-untyped-def]
    """Connected components, numbered by their first box."""
    n = len(offsets) - 1
    root = np.arange(n)
    for i in range(n):
        for at in range(offsets[i], offsets[i + 1]):
            a, b = i, neighbours[at]
            while root[a] != a:
                root[a] = root[root[a]]
                a = root[a]
            while root[b] != b:
                root[b] = root[root[b]]
                b = root[b]
            root[max(a, b)] = min(a, b)
    cluster = np.empty(n, np.int64)
    clusters = 0
    for i in range(n):
        a = i
        while root[a] != a:
            a = root[a]
        if a == i:
            cluster[i] = clusters
            clusters += 1
        else:
            cluster[i] = cluster[a]
    return cluster
