"""Targets of the centre head: what is learned is what is decoded."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from lcf3d.detectors.lidar.decoding import decode_center_maps, detections
from lcf3d.detectors.lidar.presets import COMPACT_KITTI
from lcf3d.training.lidar_targets import BOX_CHANNELS, center_losses, center_targets

SPEC = replace(COMPACT_KITTI.voxels, area=(0.0, -10.24, -3.0, 20.48, 10.24, 1.0))
CONFIG = replace(COMPACT_KITTI, voxels=SPEC)
BOXES = np.array(
    [
        [5.0, 1.0, -0.9, 3.9, 1.6, 1.5, 0.3],
        [12.3, -4.0, -0.8, 0.8, 0.6, 1.75, -2.0],
        [9.0, 6.0, -0.8, 1.8, 0.6, 1.7, 3.0],
    ]
)
LABELS = np.array([0, 1, 2])


def maps_of(targets):
    """Maps of a network that says exactly what it was taught."""
    _, height, width = targets.heat.shape
    flat = np.zeros((BOX_CHANNELS - 1, height * width), np.float32)
    flat[:, targets.cells] = targets.boxes[:, :-1].T
    values = flat.reshape(-1, height, width)
    heat = np.log(np.clip(targets.heat, 1e-6, 1 - 1e-3) / (1 - np.clip(targets.heat, 1e-6, 1 - 1e-3)))
    return {
        "reg": values[:2],
        "height": values[2:3],
        "dim": values[3:6],
        "rot": values[6:8],
        "axis": values[8:10],
        "heatmap": heat,
    }


def test_decoding_inverts_the_targets():
    targets = center_targets(BOXES, LABELS, CONFIG)
    maps = maps_of(targets)
    found = detections(*decode_center_maps([maps], CONFIG, 0.9, "off"), CONFIG)
    order = np.argsort(found.labels)
    np.testing.assert_allclose(found.boxes[order], BOXES, atol=1e-5)
    assert found.velocities is None
    # without suppression, the cells around an object say the same box once more
    many = detections(*decode_center_maps([maps], CONFIG, 0.4, "off"), CONFIG)
    assert len(many) > 2 * len(BOXES)
    nearest = BOXES[many.labels]
    np.testing.assert_allclose(many.boxes, nearest, atol=1e-5)
    kept = detections(*decode_center_maps([maps], CONFIG, 0.4, "keep"), CONFIG)
    assert sorted(kept.labels.tolist()) == [0, 1, 2]


def test_the_axis_holds_where_front_and_rear_are_confused():
    maps = maps_of(center_targets(BOXES, LABELS, CONFIG))
    maps["rot"] = np.stack([np.sin(0.9 + 0 * maps["rot"][0]), np.cos(0.9 + 0 * maps["rot"][0])])
    found = detections(*decode_center_maps([maps], CONFIG, 0.9, "off"), CONFIG)
    turn = found.boxes[np.argsort(found.labels), 6] - BOXES[:, 6]
    np.testing.assert_allclose(np.abs(np.cos(turn)), 1, atol=1e-6)
    assert (np.cos(found.boxes[:, 6] - 0.9) >= 0).all()


def test_weights_of_an_object_sum_to_one():
    targets = center_targets(BOXES, LABELS, CONFIG)
    assert targets.boxes[:, -1].sum() == pytest.approx(len(BOXES))
    assert (targets.heat >= 1).sum() == len(BOXES)


def test_ignored_objects_are_neither_wanted_nor_background():
    targets = center_targets(BOXES, np.array([0, -2, 2]), CONFIG)
    column, row = int(12.3 / 0.64), int((-4.0 + 10.24) / 0.64)
    assert targets.counted[row, column] == 0
    assert targets.heat[:, row, column].max() == 0
    assert targets.counted.sum() < targets.counted.size
    # an object to be found beside an ignored one is still to be found
    both = center_targets(np.repeat(BOXES[:1], 2, axis=0), np.array([0, -2]), CONFIG)
    assert both.counted[(both.heat >= 1).any(axis=0)].all()


def test_nothing_to_be_found():
    targets = center_targets(np.zeros((0, 7)), np.zeros(0, np.int64), CONFIG)
    assert targets.heat.max() == 0
    assert len(targets.cells) == 0
    outside = center_targets(BOXES + np.array([100, 0, 0, 0, 0, 0, 0]), LABELS, CONFIG)
    assert outside.heat.max() == 0


def test_losses_vanish_for_the_right_answer_and_grow_with_errors():
    torch = pytest.importorskip("torch")
    targets = center_targets(BOXES, LABELS, CONFIG)
    batch = {
        "heat": torch.from_numpy(targets.heat[None]),
        "counted": torch.from_numpy(targets.counted[None]),
        "cells": torch.from_numpy(targets.cells),
        "boxes": torch.from_numpy(targets.boxes),
    }
    maps = {name: torch.from_numpy(value[None]) for name, value in maps_of(targets).items()}
    right = center_losses(maps, batch, 2.0)
    assert float(right["place"]) == pytest.approx(0, abs=1e-5)
    assert float(right["heading"]) == pytest.approx(0, abs=1e-5)
    maps["height"] = maps["height"] + 0.5
    wrong = center_losses(maps, batch, 2.0)
    assert float(wrong["place"]) == pytest.approx(2.0 * 0.5, abs=1e-4)
    maps["heatmap"] = -maps["heatmap"]
    assert float(center_losses(maps, batch, 2.0)["heat"]) > 10 * float(right["heat"])
    empty = {name: value[:0] if name in ("cells", "boxes") else value * 0 for name, value in batch.items()}
    assert all(torch.isfinite(value) for value in center_losses(maps, empty, 2.0).values())
