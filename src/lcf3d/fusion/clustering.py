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
# rows of cells lie so far apart in the hash table of cells
STRIDE = 7919


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

    Boxes are put into square cells as wide as the largest box, so that only nine cells need a look. Plain loops: numba
    compiles numpy's sorting and searching for longer than all of this.
    """
    n = len(boxes)
    cos, sin, cells = np.empty(n), np.empty(n), np.empty((n, 2), np.int64)
    x, y, reach = np.inf, np.inf, 1e-3
    for i in range(n):
        cos[i], sin[i] = math.cos(boxes[i, 6]), math.sin(boxes[i, 6])
        x, y, reach = min(x, boxes[i, 0]), min(y, boxes[i, 1]), max(reach, math.hypot(boxes[i, 3], boxes[i, 4]))
    for i in range(n):
        cells[i, 0], cells[i, 1] = int((boxes[i, 0] - x) / reach), int((boxes[i, 1] - y) / reach)
    slots = 16
    while slots < 2 * n:
        slots *= 2
    # of each slot of a hash table the first box, and of each box the next one in its slot
    first_of, next_of = np.empty(slots, np.int64), np.empty(n, np.int64)
    for slot in range(slots):
        first_of[slot] = -1
    for i in range(n - 1, -1, -1):
        slot = (cells[i, 0] * STRIDE + cells[i, 1]) & (slots - 1)
        next_of[i], first_of[slot] = first_of[slot], i
    pairs = np.empty((4 * n + 16, 2), np.int64)
    links = 0
    for i in range(n):
        area = boxes[i, 3] * boxes[i, 4]
        for step in range(9):
            column, row = cells[i, 0] + step // 3 - 1, cells[i, 1] + step % 3 - 1
            j = first_of[(column * STRIDE + row) & (slots - 1)]
            while j >= 0:
                here, j = j, next_of[j]
                if here <= i or cells[here, 0] != column or cells[here, 1] != row:
                    continue
                if class_aware and labels[i] != labels[here]:
                    continue
                other = boxes[here, 3] * boxes[here, 4]
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
                    boxes[here, 0],
                    boxes[here, 1],
                    boxes[here, 3],
                    boxes[here, 4],
                    cos[here],
                    sin[here],
                )
                if shared > iou_threshold * (area + other - shared):
                    if links == len(pairs):
                        pairs = _doubled(pairs)
                    pairs[links, 0], pairs[links, 1] = i, here
                    links += 1
    return _rows(pairs[:links], n)


@kernel
def _doubled(pairs):  # type: ignore[no-untyped-def]
    """A copy of (E, 2) pairs with place for as many again."""
    longer = np.empty((2 * len(pairs), 2), np.int64)
    for e in range(len(pairs)):
        longer[e, 0], longer[e, 1] = pairs[e, 0], pairs[e, 1]
    return longer


@kernel
def _rows(pairs, n):  # type: ignore[no-untyped-def]
    """(E,) second boxes of (E, 2) pairs in the ascending rows of their first ones, and (n + 1,) where rows begin."""
    offsets, starts = np.empty(n + 1, np.int64), np.empty(n + 1, np.int64)
    for i in range(n + 1):
        offsets[i] = starts[i] = 0
    for e in range(len(pairs)):
        offsets[pairs[e, 0] + 1] += 1
        starts[pairs[e, 1] + 1] += 1
    for i in range(n):
        offsets[i + 1] += offsets[i]
        starts[i + 1] += starts[i]
    # ordered by their second boxes, they fill each row in ascending order
    order, neighbours = np.empty(len(pairs), np.int64), np.empty(len(pairs), np.int64)
    for e in range(len(pairs)):
        order[starts[pairs[e, 1]]] = e
        starts[pairs[e, 1]] += 1
    for i in range(n):
        starts[i] = offsets[i]
    for k in range(len(pairs)):
        i = pairs[order[k], 0]
        neighbours[starts[i]] = pairs[order[k], 1]
        starts[i] += 1
    return neighbours, offsets


@kernel
def _partition(neighbours, offsets, method):  # type: ignore[no-untyped-def]
    """Cluster index of boxes sorted by descending score, from their links; ``method`` is a code of ``_CODES``."""
    n = len(offsets) - 1
    cluster, shared = np.empty(n, np.int64), np.empty(n, np.int64)
    for i in range(n):
        cluster[i], shared[i] = -2, 0
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
    root = np.empty(n, np.int64)
    for i in range(n):
        root[i] = i
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
