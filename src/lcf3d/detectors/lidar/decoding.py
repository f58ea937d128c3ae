"""From the output maps of a head to boxes: anchors, box coding, direction bins, heat-map peaks.

Boxes here are ``x y z length width height yaw [vx vy]`` with z at the bottom face, as the networks were trained;
`detections` makes them canonical.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from lcf3d.detectors.lidar.config import AnchorLevel, AnchorSpec, LidarConfig, Suppression
from lcf3d.detectors.lidar.frames import canonical_boxes
from lcf3d.detectors.lidar.suppression import NmsMode, bev_nms, suppression_threshold
from lcf3d.geometry.boxes import canonical_from_mmdet3d
from lcf3d.structures import BoolArray, Detections3D, FloatArray, IntArray

Map = NDArray[np.float32]


@dataclass(frozen=True)
class Candidates:
    """Boxes before suppression.

    Attributes:
        boxes: (N, 7 or 9), bottom centre.
        scores: (N, K) score of every class.
        directions: (N,) 0 or 1, which half turn the direction classifier chose.
    """

    boxes: FloatArray
    scores: FloatArray
    directions: IntArray


def sigmoid(logits: NDArray[np.floating]) -> FloatArray:
    """1 / (1 + exp(-x)) without overflow."""
    result: FloatArray = 0.5 * (1.0 + np.tanh(0.5 * np.asarray(logits, np.float64)))
    return result


def best(values: NDArray[np.floating], count: int) -> IntArray:
    """Indices of the ``count`` largest of (N,) values, largest first; of equal ones the first."""
    if count < len(values):
        threshold = np.partition(values, len(values) - count)[len(values) - count]
        chosen = np.flatnonzero(values >= threshold)
    else:
        chosen = np.arange(len(values))
    order: IntArray = chosen[np.argsort(-values[chosen], kind="stable")][:count]
    return order


def anchor_boxes(
    level: AnchorLevel, spec: AnchorSpec, height: int, width: int, index: tuple[IntArray, IntArray, IntArray]
) -> FloatArray:
    """(N, 7 or 9) anchors of a map of ``height`` x ``width`` cells at ``index``: anchor of the cell, row, column."""
    anchor, row, column = index
    x0, y0, x1, y1 = spec.area
    if spec.aligned:
        xs, ys = x0 + (np.arange(width) + 0.5) * (x1 - x0) / width, y0 + (np.arange(height) + 0.5) * (y1 - y0) / height
    else:
        xs, ys = np.linspace(x0, x1, width), np.linspace(y0, y1, height)
    size, rotation = np.divmod(anchor, len(spec.rotations))
    boxes = np.zeros((len(anchor), spec.code_size))
    boxes[:, 0], boxes[:, 1], boxes[:, 2] = xs[column], ys[row], np.array(level.bottoms)[size]
    boxes[:, 3:6] = np.array(level.sizes)[size]
    boxes[:, 6] = np.array(spec.rotations)[rotation]
    return boxes


def decode_residuals(anchors: FloatArray, residuals: FloatArray) -> FloatArray:
    """(N, 7 or 9) boxes from anchors and residuals (section 3.2.2 of the SECOND paper); z at the bottom face."""
    diagonal = np.hypot(anchors[:, 3], anchors[:, 4])
    boxes = np.array(residuals, dtype=np.float64)
    boxes[:, 0] = residuals[:, 0] * diagonal + anchors[:, 0]
    boxes[:, 1] = residuals[:, 1] * diagonal + anchors[:, 1]
    # a network's exponent may be anything; beyond this float32 overflows
    boxes[:, 3:6] = np.exp(np.minimum(residuals[:, 3:6], 88.0)) * anchors[:, 3:6]
    center_z = residuals[:, 2] * anchors[:, 5] + anchors[:, 2] + anchors[:, 5] / 2
    boxes[:, 2] = center_z - boxes[:, 5] / 2
    boxes[:, 6:] = residuals[:, 6:] + anchors[:, 6:]
    return boxes


def decode_anchor_maps(maps: Sequence[tuple[Map, Map, Map]], spec: AnchorSpec, classes: int, count: int) -> Candidates:
    """The ``count`` best anchors (of each map, or of all when ``spec.joint``), decoded.

    Args:
        maps: class logits (A K, H, W), residuals (A D, H, W) and direction logits (A 2, H, W) of each level.
        spec: the anchors.
        classes: number of classes K.
        count: candidates to take.
    """
    peaks = [cls.reshape(-1, classes, *cls.shape[1:]).max(axis=1).ravel() for cls, _, _ in maps]
    if spec.joint:
        bounds = np.cumsum([0] + [len(p) for p in peaks])
        chosen = best(np.concatenate(peaks), count)
        selections = [chosen[(chosen >= a) & (chosen < b)] - a for a, b in pairwise(bounds)]
    else:
        selections = [best(peak, count) for peak in peaks]
    parts = [
        _decode_level(level_maps, level, spec, classes, selection)
        for level_maps, level, selection in zip(maps, spec.levels, selections, strict=True)
    ]
    return Candidates(
        np.concatenate([p.boxes for p in parts]),
        np.concatenate([p.scores for p in parts]),
        np.concatenate([p.directions for p in parts]),
    )


def _decode_level(
    maps: tuple[Map, Map, Map], level: AnchorLevel, spec: AnchorSpec, classes: int, selection: IntArray
) -> Candidates:
    cls, residuals, direction = maps
    height, width = cls.shape[1:]
    anchor, cell = np.divmod(selection, height * width)
    row, column = np.divmod(cell, width)

    def at(values: Map, depth: int) -> FloatArray:
        gathered: FloatArray = values.reshape(-1, depth, height, width)[anchor, :, row, column].astype(np.float64)
        return gathered

    anchors = anchor_boxes(level, spec, height, width, (anchor, row, column))
    boxes = decode_residuals(anchors, at(residuals, spec.code_size))
    return Candidates(boxes, sigmoid(at(cls, classes)), at(direction, 2).argmax(axis=1))


def turn_by_direction(yaw: FloatArray, directions: IntArray, offset: float) -> FloatArray:
    """(N,) headings: the regressed angle brought into the half turn from ``offset``, plus pi where the bin is 1."""
    turned: FloatArray = (yaw - offset) % np.pi + offset + np.pi * directions
    return turned


def select_by_class(
    candidates: Candidates, spec: AnchorSpec, rule: Suppression, score_threshold: float, nms: NmsMode
) -> tuple[FloatArray, FloatArray, IntArray]:
    """Boxes, scores and labels after thresholding and suppression, each class on its own.

    A candidate may come out once for each class whose score it passes; by a rule ``over_classes``, once with its best.
    Without NMS, as many boxes as candidates.
    """
    if rule.over_classes:
        return _select_over_classes(candidates, spec, rule, score_threshold, nms)
    iou_threshold = suppression_threshold(nms, rule.iou_threshold)
    indices, labels = [], []
    for label in range(candidates.scores.shape[1]):
        scores = candidates.scores[:, label]
        passed = np.flatnonzero(scores > score_threshold)
        kept = passed[bev_nms(candidates.boxes[passed], scores[passed], iou_threshold)]
        indices.append(kept)
        labels.append(np.full(len(kept), label))
    index, label_array = np.concatenate(indices), np.concatenate(labels)
    scores = candidates.scores[index, label_array]
    limit = rule.max_boxes if nms == "keep" else max(rule.max_boxes, rule.candidates)
    order = np.argsort(-scores, kind="stable")[:limit]
    boxes = candidates.boxes[index[order]]
    boxes[:, 6] = turn_by_direction(boxes[:, 6], candidates.directions[index[order]], spec.direction_offset)
    return boxes, scores[order], label_array[order]


def _select_over_classes(
    candidates: Candidates, spec: AnchorSpec, rule: Suppression, score_threshold: float, nms: NmsMode
) -> tuple[FloatArray, FloatArray, IntArray]:
    """Each candidate with its best class; boxes of all classes suppress one another."""
    scores, labels = candidates.scores.max(axis=1), candidates.scores.argmax(axis=1)
    passed = np.flatnonzero(scores >= score_threshold)
    threshold = suppression_threshold(nms, rule.iou_threshold)
    index = passed[bev_nms(candidates.boxes[passed], scores[passed], threshold)]
    index = index[: rule.max_boxes if nms == "keep" else max(rule.max_boxes, rule.candidates)]
    boxes = candidates.boxes[index]
    boxes[:, 6] = turn_by_direction(boxes[:, 6], candidates.directions[index], spec.direction_offset)
    return boxes, scores[index], labels[index]


def decode_center_maps(
    tasks: Sequence[Mapping[str, Map]], config: LidarConfig, score_threshold: float, nms: NmsMode
) -> tuple[FloatArray, FloatArray, IntArray]:
    """Boxes, scores and labels of a centre head (section 4 of the CenterPoint paper), suppressed task by task.

    Args:
        tasks: for each task the maps ``heatmap`` (K, H, W), ``reg`` (2), ``height`` (1), ``dim`` (3), ``rot`` (2) and,
            where the configuration says so, ``vel`` (2) and ``axis`` (2), all at one resolution.
        config: a configuration with ``centers``.
        score_threshold: boxes need a higher score.
        nms: the mode of suppression.
    """
    spec, rule = config.centers, config.suppression
    if spec is None:
        raise TypeError("a centre head needs LidarConfig.centers")
    iou_threshold = suppression_threshold(nms, rule.iou_threshold)
    parts: list[tuple[FloatArray, FloatArray, IntArray]] = []
    first_label = 0
    for names, maps in zip(spec.tasks, tasks, strict=True):
        heat = maps["heatmap"]
        peaks = best(heat.ravel(), spec.max_candidates)
        boxes = _center_boxes(maps, peaks % heat[0].size, config)
        scores, labels = sigmoid(heat.ravel()[peaks]), peaks // heat[0].size + first_label
        passed = np.flatnonzero((scores > score_threshold) & _within(boxes, spec.limits))[: rule.candidates]
        kept = passed[bev_nms(boxes[passed], scores[passed], iou_threshold)]
        if nms == "keep":
            kept = kept[: spec.max_per_task]
        parts.append((boxes[kept], scores[kept], labels[kept]))
        first_label += len(names)
    boxes, scores, labels = (np.concatenate(values) for values in zip(*parts, strict=True))
    return boxes, scores, labels


def _center_boxes(maps: Mapping[str, Map], cells: IntArray, config: LidarConfig) -> FloatArray:
    """(N, 7 or 9) boxes at the given flat cells of a task's maps."""
    assert config.centers is not None
    values = {name: m.reshape(len(m), -1)[:, cells].astype(np.float64) for name, m in maps.items() if name != "heatmap"}
    row, column = np.divmod(cells, maps["heatmap"].shape[2])
    step = np.array(config.voxels.size[:2]) * config.centers.stride
    boxes = np.empty((len(cells), 9 if config.has_velocity else 7))
    boxes[:, 0] = (column + values["reg"][0]) * step[0] + config.voxels.area[0]
    boxes[:, 1] = (row + values["reg"][1]) * step[1] + config.voxels.area[1]
    boxes[:, 3:6] = np.exp(np.minimum(values["dim"], 88.0)).T
    boxes[:, 2] = values["height"][0] - boxes[:, 5] / 2
    boxes[:, 6] = np.arctan2(values["rot"][0], values["rot"][1])
    if config.centers.axis:
        along = np.arctan2(values["axis"][0], values["axis"][1]) / 2
        # of the two headings along the axis, the one that is nearer what the network thinks is the front
        boxes[:, 6] = along + np.pi * (np.cos(boxes[:, 6] - along) < 0)
    if config.has_velocity:
        boxes[:, 7:] = values["vel"].T
    return boxes


def _within(boxes: FloatArray, limits: tuple[float, ...]) -> BoolArray:
    """Whether the geometric centre of each box lies in the (6,) volume."""
    centers = boxes[:, :3].copy()
    centers[:, 2] += boxes[:, 5] / 2
    inside: BoolArray = np.all((centers >= limits[:3]) & (centers <= limits[3:]), axis=1)
    return inside


def detections(boxes: FloatArray, scores: FloatArray, labels: IntArray, config: LidarConfig) -> Detections3D:
    """Canonical detections of bottom-centre boxes (N, 7 or 9) in the network's frame."""
    boxes = canonical_boxes(boxes, config.frame)
    velocities = boxes[:, 7:9] if config.has_velocity else None
    return Detections3D(canonical_from_mmdet3d(boxes), scores, labels, config.class_names, velocities)
