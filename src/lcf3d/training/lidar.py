"""Training of the small LiDAR detector (`lcf3d.detectors.lidar.CompactPillars`)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from lcf3d.detectors.lidar.config import LidarConfig, VoxelSpec
from lcf3d.detectors.lidar.inputs import statistics_of
from lcf3d.detectors.lidar.presets import COMPACT_KITTI
from lcf3d.errors import ConfigError
from lcf3d.evaluation.generalization import evaluate_generalization
from lcf3d.geometry.boxes import points_in_boxes
from lcf3d.networks.checkpoints import load_parameters, read_training
from lcf3d.structures import Detections3D
from lcf3d.training.lidar_augmentation import (
    AugmentationSettings,
    ObjectDatabase,
    augment,
    choose_window,
    collect_objects,
    crop,
)
from lcf3d.training.lidar_scans import LabelledScan, ScanSource, levelled_scan
from lcf3d.training.lidar_targets import center_losses, center_targets
from lcf3d.training.loop import import_torch


@dataclass(frozen=True)
class LidarTask:
    """What a LiDAR detector learns from; a `lcf3d.training.loop.TrainingTask`.

    Attributes:
        scans: to learn from.
        held_out: to validate on; None for no validation.
        config: of the network.
        batch_size: windows a step.
        window: pillars along x and y of a window, multiples of 8; see `choose_window`.
        windows_a_scan: windows that are taken of one changed scan.
        augmentation: how far scans are changed.
        objects: to be pasted into scans; see `objects_of`.
        box_weight: weight of the box terms beside that of the heat.
        data: what the scans are, in words.
        begin: exported network whose weights are begun with, see `lcf3d.training.lidar_start`.
    """

    scans: ScanSource
    held_out: ScanSource | None = None
    config: LidarConfig = COMPACT_KITTI
    batch_size: int = 4
    window: tuple[int, int] = (112, 120)
    windows_a_scan: int = 2
    augmentation: AugmentationSettings = field(default_factory=AugmentationSettings)
    objects: ObjectDatabase | None = None
    box_weight: float = 2.0
    data: str = ""
    begin: Path | None = None

    def network(self) -> Any:
        """The network with random weights, or with those of the exported network that it begins with."""
        from lcf3d.detectors.lidar.compact import CompactPillars

        network = CompactPillars.build(self.config)
        if self.begin is not None:
            from lcf3d.training.lidar_start import begin_with

            begin_with(network, self.begin, self.batch(0, np.random.default_rng(7)), self.window)
        return network

    def described(self) -> dict[str, Any]:
        """What batches depend on, as plain data."""
        told = {"data": self.data, "scans": self.scans.count, "network": self.config.name}
        if self.begin is not None:
            told["begin"] = self.begin.name
        if self.config.painted:
            told["painter"] = self.config.painter
        batch = {"batch_size": self.batch_size, "window": self.window, "windows_a_scan": self.windows_a_scan}
        return {**told, **batch, "box_weight": self.box_weight, **asdict(self.augmentation)}

    def starting(self, weights: dict[str, Any]) -> dict[str, Any]:
        """Weights to begin with, as they are."""
        return weights

    def batch(self, step: int, rng: np.random.Generator) -> dict[str, Any]:
        """Tensors of a step; see `center_losses` and `lcf3d.detectors.lidar.compact.CompactNetwork`."""
        spec, stride = self.config.voxels, _stride(self.config)
        windows = []
        for number in range(self.batch_size):
            if number % self.windows_a_scan == 0:
                scan = levelled_scan(self.scans.read(int(rng.integers(self.scans.count))), self.config)
                scan = augment(scan, spec.area, self.scans.turn, self.objects, self.augmentation, rng)
            windows.append((scan, choose_window(scan, spec, stride, self.window, rng)))
        return collate(windows, self.config)

    def loss(self, network: Any, batch: Any) -> dict[str, Any]:
        """Loss terms of a batch."""
        maps = network(batch["features"], batch["pillars"], len(batch["heat"]), self.window)
        return center_losses(maps[0], batch, self.box_weight)

    def validate(self, network: Any) -> dict[str, float]:
        """Centre-distance AP of each class that the held-out scans have, cut to the network's range."""
        if self.held_out is None:
            return {}
        from lcf3d.detectors.lidar.compact import CompactPillars

        detector = CompactPillars(network, self.config, nms="keep")
        truths, found = [], []
        for number in range(self.held_out.count):
            scan = crop(self.held_out.read(number), self.config.voxels.area)
            truths.append(_truth(scan, self.config.class_names))
            found.append(_without_ignored(detector(scan.points), scan))
        metrics = evaluate_generalization(truths, found, class_names=self.config.class_names)
        there = {k for truth in truths for k in truth.labels.tolist()}
        rows = enumerate(zip(metrics.class_names, metrics.aps.mean(axis=1), strict=True))
        return {f"AP {name}": float(ap) for k, (name, ap) in rows if k in there}


def collate(windows: Sequence[tuple[LabelledScan, VoxelSpec]], config: LidarConfig) -> dict[str, Any]:
    """The tensors of a batch: scans, and the equally large windows that are looked at."""
    torch = import_torch()
    parts: dict[str, list[Any]] = {name: [] for name in ("features", "pillars", "heat", "counted", "cells", "boxes")}
    for number, (scan, spec) in enumerate(windows):
        features, pillars = statistics_of(scan.points, replace(config, voxels=spec))
        seen = crop(scan, spec.area)
        targets = center_targets(seen.boxes, seen.labels, replace(config, voxels=spec))
        parts["features"].append(features)
        parts["pillars"].append(pillars + number * spec.grid[0] * spec.grid[1])
        parts["heat"].append(targets.heat[None])
        parts["counted"].append(targets.counted[None])
        parts["cells"].append(targets.cells + number * targets.counted.size)
        parts["boxes"].append(targets.boxes)
    return {name: torch.from_numpy(np.concatenate(values)) for name, values in parts.items()}


def objects_of(scans: ScanSource, config: LidarConfig, limit: int = 1500, seed: int = 0) -> ObjectDatabase:
    """Objects to paste, at most ``limit`` a class, from the scans of a source in random order."""
    order = np.random.default_rng([seed, 1]).permutation(scans.count)
    level = ScanSource(lambda number: levelled_scan(scans.read(number), config), scans.count, scans.turn)
    return collect_objects(level, len(config.class_names), limit, order.tolist())


def checkpoint_detector(path: Path, config: LidarConfig = COMPACT_KITTI, **options: Any) -> Any:
    """The detector of a training's ``last.pt``, with the averaged weights.

    Args:
        path: the checkpoint.
        config: of the network.
        options: of `lcf3d.detectors.lidar.CompactPillars`.

    Raises:
        DetectorError: the file is no checkpoint, or of another architecture.
    """
    from lcf3d.detectors.lidar.compact import CompactPillars

    network = CompactPillars.build(config)
    load_parameters(network, read_training(path)["averaged"], str(path))
    return trained_detector(network, config, **options)


def trained_detector(network: Any, config: LidarConfig, **options: Any) -> Any:
    """The detector of a trained network; a copy, with the normalization folded into the layers."""
    import copy

    from lcf3d.detectors.lidar.compact import CompactPillars
    from lcf3d.detectors.lidar.fusing import fuse_batch_norm

    return CompactPillars(fuse_batch_norm(copy.deepcopy(network).eval()), config, **options)


def _stride(config: LidarConfig) -> int:
    if config.centers is None:
        raise ConfigError(f"{config.name} has no centre head, which is what is trained here; use one with centers")
    return config.centers.stride


def _truth(scan: LabelledScan, class_names: Sequence[str]) -> Detections3D:
    kept = scan.labels >= 0
    return Detections3D(scan.boxes[kept], np.ones(int(kept.sum())), scan.labels[kept], tuple(class_names))


def _without_ignored(found: Detections3D, scan: LabelledScan) -> Detections3D:
    """Detections whose centre lies in no box that is neither to be found nor background."""
    ignored = scan.boxes[scan.labels < 0].copy()
    ignored[:, 5] = math.inf
    return found[~points_in_boxes(found.boxes[:, :3], ignored).any(axis=0)]
