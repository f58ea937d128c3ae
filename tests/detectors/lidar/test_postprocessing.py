"""From made-up head outputs with distinct scores to boxes, against plain loops with shapely's polygons.

The loops are written from the published rules, one box at a time, and share no code with the package.
"""

from __future__ import annotations

import math
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from shapely import affinity
from shapely.geometry import box as rectangle

from lcf3d.detectors.lidar.config import AnchorLevel, CenterSpec
from lcf3d.detectors.lidar.inputs import map_detections
from lcf3d.detectors.lidar.presets import PRESETS

AREA = (0.0, -4.0, 8.0, 4.0)


def sigmoid(x):
    return 1 / (1 + math.exp(-x))


def wrapped(angle):
    return math.atan2(math.sin(angle), math.cos(angle))


def polygon(box):
    x, y, _, length, width, _, yaw = box[:7]
    flat = rectangle(-length / 2, -width / 2, length / 2, width / 2)
    return affinity.translate(affinity.rotate(flat, yaw, origin=(0, 0), use_radians=True), x, y)


def suppressed(found, threshold):
    """Of (score, box, ...) tuples, best first, those that no better one kept overlaps by more."""
    kept, shapes = [], []
    for candidate in sorted(found, key=lambda f: -f[0]):
        shape = polygon(candidate[1])
        overlaps = [(s.intersection(shape).area, s.area + shape.area) for s in shapes if s.intersects(shape)]
        if all(shared / (total - shared) <= threshold for shared, total in overlaps):
            kept.append(candidate)
            shapes.append(shape)
    return kept


def anchors_of(maps, config):
    """(best score, class scores, box, direction bin) of every anchor of one level, in the order of the map."""
    (logits, residuals, bins), level, spec = maps, config.level, config.anchors
    classes, (height, width) = len(config.class_names), logits.shape[1:]
    x0, y0, x1, y1 = spec.area
    found = []
    for size, (length, wide, high) in enumerate(level.sizes):
        for turn, rotation in enumerate((0.0, 1.57)):
            a = 2 * size + turn
            for row in range(height):
                for column in range(width):
                    if spec.aligned:
                        x = x0 + (column + 0.5) * (x1 - x0) / width
                        y = y0 + (row + 0.5) * (y1 - y0) / height
                    else:
                        x = x0 + column * (x1 - x0) / (width - 1)
                        y = y0 + row * (y1 - y0) / (height - 1)
                    scores = [sigmoid(logits[a * classes + k, row, column]) for k in range(classes)]
                    d = [residuals[a * spec.code_size + i, row, column] for i in range(spec.code_size)]
                    diagonal = math.sqrt(length**2 + wide**2)
                    middle = level.bottoms[size] + high / 2
                    box = [d[0] * diagonal + x, d[1] * diagonal + y, d[2] * high + middle]
                    box += [math.exp(d[3]) * length, math.exp(d[4]) * wide, math.exp(d[5]) * high, d[6] + rotation]
                    box += d[7:]
                    found.append(
                        (max(scores), scores, box, int(bins[2 * a + 1, row, column] > bins[2 * a, row, column]))
                    )
    return found


def directed(box, chosen, offset):
    """The yaw brought into the half turn that begins at the offset, and turned by another half in bin 1."""
    turned = list(box)
    rest = (box[6] - offset) % math.pi
    turned[6] = rest + offset + math.pi * chosen
    return turned


def best_anchors(maps, config, count):
    levels = [
        anchors_of(level_maps, SimpleNamespace(level=level, anchors=config.anchors, class_names=config.class_names))
        for level_maps, level in zip(maps, config.anchors.levels, strict=True)
    ]
    if config.anchors.joint:
        levels = [[anchor for level in levels for anchor in level]]
    return [anchor for level in levels for anchor in sorted(level, key=lambda a: -a[0])[:count]]


def by_class(maps, config):
    """OpenMMLab: each class on its own, then the best of all."""
    rule, chosen = config.suppression, best_anchors(maps, config, config.suppression.candidates)
    final = []
    for label in range(len(config.class_names)):
        passed = [(a[1][label], a[2], a[3], label) for a in chosen if a[1][label] > rule.score_threshold]
        final += suppressed(passed, rule.iou_threshold)
    final = sorted(final, key=lambda f: -f[0])[: rule.max_boxes]
    return [(s, directed(box, b, config.anchors.direction_offset), label) for s, box, b, label in final]


def over_classes(maps, config):
    """OpenPCDet: the best class of each anchor that passes, best 4,096 of them, one suppression, at most 500."""
    anchors = [(a[0], a[2], a[3], int(np.argmax(a[1]))) for a in best_anchors(maps, config, 10**6) if a[0] >= 0.1]
    final = suppressed(sorted(anchors, key=lambda f: -f[0])[:4096], 0.01)[:500]
    return [(s, directed(box, b, 0.78539), label) for s, box, b, label in final]


def check(found, expected, frame="canonical"):
    """Detections against (score, box with its geometric centre, label), in order."""
    assert len(expected) > 3
    np.testing.assert_allclose(found.scores, [e[0] for e in expected], rtol=1e-6)
    assert found.labels.tolist() == [e[2] for e in expected]
    boxes = np.array([e[1] for e in expected])
    if frame == "lidar_top":
        boxes[:, 0], boxes[:, 1] = boxes[:, 1].copy(), -boxes[:, 0]
        boxes[:, 6] -= math.pi / 2
    np.testing.assert_allclose(found.boxes[:, :6], boxes[:, :6], rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose([wrapped(y) for y in found.boxes[:, 6] - boxes[:, 6]], 0, atol=1e-5)
    if boxes.shape[1] == 9:
        expected_velocities = boxes[:, 7:] if frame == "canonical" else np.stack([boxes[:, 8], -boxes[:, 7]], axis=1)
        np.testing.assert_allclose(found.velocities, expected_velocities, rtol=1e-5, atol=1e-6)


def small(name):
    """A preset with the same rules over eight metres."""
    config = PRESETS[name]
    anchors = config.anchors and replace(config.anchors, area=AREA)
    return replace(config, anchors=anchors)


def anchor_maps(config, seed, height=6, width=5):
    rng = np.random.default_rng(seed)
    maps = []
    for level in config.anchors.levels:
        anchors, shape = 2 * len(level.sizes), (height, width)
        logits = rng.normal(-1.0, 2.0, (anchors * len(config.class_names), *shape))
        residuals = rng.normal(0, 0.3, (anchors * config.anchors.code_size, *shape))
        maps.append((logits, residuals, rng.normal(0, 1, (anchors * 2, *shape))))
    return maps


@pytest.mark.parametrize("seed", [0, 1])
@pytest.mark.parametrize(
    "name",
    [
        "pointpillars-kitti",
        "pointpillars-kitti-car",
        "second-kitti",
        "pointpillars-nuscenes",
        "ssn-nuscenes",
        "pointpillars-kitti-openpcdet",
        "second-kitti-openpcdet",
    ],
)
def test_anchor_heads(name, seed):
    config = small(name)
    # fewer candidates than anchors, so that the choice of the best matters
    if config.suppression.candidates == 1000:
        config = replace(config, suppression=replace(config.suppression, candidates=60, max_boxes=150))
    maps = anchor_maps(config, seed)
    expected = (over_classes if name.endswith("openpcdet") else by_class)(maps, config)
    check(map_detections(maps, config, config.suppression.score_threshold, "keep"), expected, config.frame)


def center_boxes(tasks, config):
    """CenterPoint: 500 peaks a task, score and limits, one suppression a task, at most 83 boxes of each."""
    spec, (low_x, low_y) = config.centers, config.voxels.area[:2]
    step = config.voxels.size[0] * spec.stride
    final, first = [], 0
    for names, maps in zip(spec.tasks, tasks, strict=True):
        classes, height, width = maps["heatmap"].shape
        peaks = []
        for k in range(classes):
            for row in range(height):
                for column in range(width):
                    x = (column + maps["reg"][0, row, column]) * step + low_x
                    y = (row + maps["reg"][1, row, column]) * step + low_y
                    sizes = [math.exp(maps["dim"][i, row, column]) for i in range(3)]
                    yaw = math.atan2(maps["rot"][0, row, column], maps["rot"][1, row, column])
                    box = [x, y, maps["height"][0, row, column], *sizes, yaw, *maps["vel"][:, row, column]]
                    peaks.append((sigmoid(maps["heatmap"][k, row, column]), box, first + k))
        peaks = sorted(peaks, key=lambda p: -p[0])[: spec.max_candidates]
        low, high = spec.limits[:3], spec.limits[3:]
        inside = [p for p in peaks if p[0] > 0.1 and all(low[i] <= p[1][i] <= high[i] for i in range(3))]
        final += suppressed(inside, 0.2)[: spec.max_per_task]
        first += len(names)
    return final


@pytest.mark.parametrize("seed", [0, 1])
def test_center_heads(seed):
    config = PRESETS["centerpoint-voxel01-nuscenes"]
    config = replace(config, centers=replace(config.centers, max_per_task=12, max_candidates=120))
    assert isinstance(config.centers, CenterSpec)
    rng, tasks = np.random.default_rng(seed), []
    for names in config.centers.tasks:
        channels = {"reg": 2, "height": 1, "dim": 3, "rot": 2, "vel": 2, "heatmap": len(names)}
        tasks.append({name: rng.normal(0, 0.6, (count, 12, 11)) for name, count in channels.items()})
        tasks[-1]["heatmap"] *= 4
        tasks[-1]["height"] *= 9
    found = map_detections(tasks, config, 0.1, "keep")
    check(found, center_boxes(tasks, config), "lidar_top")


def refined(region, d):
    """A region (geometric centre) moved and resized in its own frame."""
    x, y, z, length, width, height, yaw = region
    diagonal = math.hypot(length, width)
    ahead, aside = d[0] * diagonal, d[1] * diagonal
    moved = [x + ahead * math.cos(yaw) - aside * math.sin(yaw), y + ahead * math.sin(yaw) + aside * math.cos(yaw)]
    sizes = [length * math.exp(d[3]), width * math.exp(d[4]), height * math.exp(d[5])]
    return [*moved, z + d[2] * height, *sizes, yaw + d[6]]


@pytest.mark.parametrize("stage", ["keep", "off"])
@pytest.mark.parametrize("name", ["part-a2-kitti", "pv-rcnn-kitti", "pv-rcnn-kitti-openpcdet"])
def test_both_stages_of_the_two_stage_networks(name, stage):
    torch = pytest.importorskip("torch")
    from lcf3d.detectors.lidar.loading import detector_class
    from lcf3d.detectors.lidar.roi import propose

    config = small(name)
    config = replace(config, proposals=replace(config.proposals, candidates=90, max_boxes=40))
    maps = anchor_maps(config, 3)
    chosen = [(a[0], a[2], a[3], a[1]) for a in best_anchors(maps, config, 90)]
    regions = suppressed(chosen, 0.7 if stage == "keep" else 1.0)[:40]
    offset = config.anchors.direction_offset
    regions = [(scores, directed(box, b, offset), int(np.argmax(scores))) for _, box, b, scores in regions]

    proposals = propose(maps, config, stage)
    bottoms = np.array([[*box[:2], box[2] - box[5] / 2, *box[3:]] for _, box, _ in regions])
    np.testing.assert_allclose(proposals.boxes, bottoms, rtol=1e-6, atol=1e-9)
    np.testing.assert_allclose(proposals.scores, [scores for scores, _, _ in regions], rtol=1e-6)
    assert proposals.labels.tolist() == [label for _, _, label in regions]

    rng = np.random.default_rng(4)
    logits, residuals = rng.normal(0, 2, len(regions)), rng.normal(0, 0.1, (len(regions), 7))
    detector = detector_class(config.architecture).__new__(detector_class(config.architecture))
    detector.config, detector.nms, detector.score_threshold, detector.device = config, "keep", 0.1, "cpu"
    outputs = (torch.from_numpy(logits), torch.from_numpy(residuals))
    detector.network = SimpleNamespace(roi_head=lambda *_: outputs)
    boxes = [refined(box, d) for (_, box, _), d in zip(regions, residuals, strict=True)]
    if name == "part-a2-kitti":
        found = detector.refine(None, None, proposals)
        # class by class, ranked by the first stage; every class of a region that passes; scored by the second
        expected = []
        for label in range(3):
            passed = [
                (scores[label], box, sigmoid(logit), own)
                for (scores, _, own), box, logit in zip(regions, boxes, logits, strict=True)
                if scores[label] >= 0.1
            ]
            expected += [(score, box, own) for _, box, score, own in suppressed(passed, 0.01)]
    else:
        found = detector.refine((None, None, None), proposals)
        scored = [
            (sigmoid(logit), box, label) for (_, _, label), box, logit in zip(regions, boxes, logits, strict=True)
        ]
        expected = suppressed([s for s in scored if s[0] >= 0.1], 0.1)
    check(found, expected)


def test_first_stage_suppression_is_refused_where_there_is_one_stage():
    torch = pytest.importorskip("torch")
    from lcf3d.detectors.lidar import PointPillars
    from lcf3d.errors import ConfigError

    config = PRESETS["pointpillars-kitti"]
    with pytest.raises(ConfigError, match="one stage; leave first_stage_nms=off out"):
        PointPillars(torch.nn.Identity(), config, first_stage_nms="off")
    with pytest.raises(ConfigError, match="nms must be one of"):
        PointPillars(torch.nn.Identity(), config, first_stage_nms="some")


def test_class_orders_of_the_frameworks():
    assert PRESETS["second-kitti"].class_names == ("Pedestrian", "Cyclist", "Car")
    assert PRESETS["second-kitti-openpcdet"].class_names == ("Car", "Pedestrian", "Cyclist")
    level: AnchorLevel = PRESETS["second-kitti-openpcdet"].anchors.levels[0]
    assert level.sizes == ((3.9, 1.6, 1.56), (0.8, 0.6, 1.73), (1.76, 0.6, 1.73))
    assert level.bottoms == (-1.78, -0.6, -0.6)
