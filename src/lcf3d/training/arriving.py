"""Tasks of `lcf3d.training.clocked` on samples that arrive in a folder while the training goes on."""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from lcf3d.detectors.lidar.config import LidarConfig
from lcf3d.errors import FormatError
from lcf3d.files import list_files
from lcf3d.training.camera_appearance import Appearance, changed_look
from lcf3d.training.camera_images import LabelledImage, from_sample
from lcf3d.training.camera_store import DeviceViews, ImageStore, draw_views
from lcf3d.training.clocked import mixed
from lcf3d.training.frustum_batch import Augmentation
from lcf3d.training.frustums import PooledFrustum, frustums_of, scenes_of_samples
from lcf3d.training.lidar_scans import LabelledScan, labelled_scan, levelled_scan
from lcf3d.training.lidar_store import DeviceAugmentation, ScanStore, beam_of, changed_scans
from lcf3d.training.lidar_targets import center_losses
from lcf3d.training.lidar_tensors import statistics_of, targets_of
from lcf3d.training.localizer import LocalizerTask
from lcf3d.training.loop import import_torch
from lcf3d.training.samples import read_image, read_scan

HELD_OUT_EVERY = 16
"""Of so many samples the last is held out, by its number."""
CHECKED = 60
"""Held-out samples that a training is checked with on its way."""


def is_held_out(path: Path) -> bool:
    """Whether a sample is measured with and never learned from."""
    return int(path.stem) % HELD_OUT_EVERY == HELD_OUT_EVERY - 1


class Arrivals:
    """The samples of a folder, read and prepared by a thread in the order in which they arrive.

    Args:
        folder: where they are written, each whole at once.
        prepare: makes of a path what is learned from; a sample that it cannot read is reported and passed over.
        report: takes lines about such samples.
    """

    def __init__(self, folder: Path, prepare: Callable[[Path], Any], report: Callable[[str], None] = print) -> None:
        self.folder, self.prepare, self.report = folder, prepare, report
        self._ready: deque[Any] = deque()
        self._thread: threading.Thread | None = None

    def take(self) -> list[Any]:
        """What has become ready since the last call."""
        if self._thread is None:
            self._thread = threading.Thread(target=self._read, daemon=True)
            self._thread.start()
        return [self._ready.popleft() for _ in range(len(self._ready))]

    def held_out(self) -> list[Path]:
        """The held-out samples that are there."""
        return [p for p in list_files(self.folder, ".npz") if is_held_out(p)]

    def _read(self) -> None:
        seen: set[str] = set()
        while True:
            new = [p for p in list_files(self.folder, ".npz") if p.name not in seen and not is_held_out(p)]
            for path in new:
                seen.add(path.name)
                self._ready.extend(self.prepared([path]))
            if not new:
                time.sleep(0.5)

    def prepared(self, paths: Sequence[Path]) -> list[Any]:
        """The samples of paths, prepared; those that cannot be read are left out."""
        found = []
        for path in paths:
            try:
                found.append(self.prepare(path))
            except (FormatError, ValueError) as error:
                self.report(f"{path} is passed over: {error}")
        return found


class ArrivingCamera:
    """The camera detector on arriving images; a `lcf3d.training.clocked.ClockTask`.

    Args:
        folder: of samples of the sensor ``camera``.
        config: of the network.
        device: torch's name of the device.
        batch_size: views a step.
        view: (height, width) of the views, multiples of 32.
        views: how they are drawn.
        look: how their look is changed.
        seed: of the views.
    """

    def __init__(
        self,
        folder: Path,
        config: Any,
        device: str,
        batch_size: int = 48,
        view: tuple[int, int] = (256, 512),
        views: DeviceViews | None = None,
        look: Appearance | None = None,
        seed: int = 0,
    ) -> None:
        torch = import_torch()
        self.config, self.device, self.batch_size, self.view = config, device, batch_size, view
        self.arrivals = Arrivals(folder, self._prepared)
        self.views, self.look = views or DeviceViews(), look or Appearance()
        self.store, self.held_out = (ImageStore(device, masks=bool(config.prototypes)) for _ in range(2))
        self.rng = torch.Generator(device=device).manual_seed(seed)

    def network(self) -> Any:
        """A detector with random weights."""
        from lcf3d.detectors.camera.small_network import SmallDetector

        return SmallDetector(self.config).to(memory_format=import_torch().channels_last)

    def refresh(self) -> int:
        """Take the images that have come."""
        for image in self.arrivals.take():
            self.store.add(image)
        self.store.commit()
        return len(self.store)

    def _prepared(self, path: Path) -> LabelledImage:
        return from_sample(read_image(path), self.store.masks)

    def loss(self, network: Any, step: int) -> dict[str, Any]:
        """Weighted terms of score, box and mask."""
        terms: dict[str, Any] = self._loss(network, self.store, self.views, self.look, self.rng)
        return terms

    def _loss(self, network: Any, store: ImageStore, views: DeviceViews, look: Appearance | None, rng: Any) -> Any:
        from lcf3d.training.camera_losses import Targets, losses

        torch = import_torch()
        batch = draw_views(store, self.batch_size, self.view, views, rng)
        pixels = batch["pixels"] if look is None else changed_look(batch["pixels"], batch.get("owner"), look, rng)
        pixels = pixels.contiguous(memory_format=torch.channels_last)
        with mixed(self.device):
            outputs = network.outputs(pixels)
        targets = Targets(batch["boxes"], batch["visible"], batch["labels"], batch.get("owner"), batch["numbers"])
        return losses(outputs, targets, self.view)

    def check(self, network: Any) -> dict[str, float]:
        """Terms of the loss on held-out images as they are."""
        torch = import_torch()
        store = self.held_out
        if len(store) < CHECKED:
            store = self.held_out = ImageStore(self.device, self.store.masks)
            for image in self.arrivals.prepared(self.arrivals.held_out()[:CHECKED]):
                store.add(image)
            store.commit()
        if not len(store):
            return {}
        plain = DeviceViews(scales=(1.0, 1.0), as_it_is=1.0, sought=0.5, mosaic=0.0, pasted=0.0)
        rng = torch.Generator(device=self.device).manual_seed(1)
        terms = self._loss(network, store, plain, None, rng)
        return {f"held-out {name}": float(value) for name, value in terms.items()}


class ArrivingLidar:
    """The LiDAR detector on arriving scans; a `lcf3d.training.clocked.ClockTask`.

    Args:
        folder: of samples of the sensor ``lidar``.
        config: of the network.
        device: torch's name of the device.
        batch_size: scans a step.
        changes: how scans are changed.
        box_weight: weight of the box terms beside that of the heat.
        seed: of the changes.
    """

    def __init__(
        self,
        folder: Path,
        config: LidarConfig,
        device: str,
        batch_size: int = 12,
        changes: DeviceAugmentation | None = None,
        box_weight: float = 2.0,
        seed: int = 0,
    ) -> None:
        torch = import_torch()
        self.config, self.device, self.batch_size = config, device, batch_size
        self.arrivals = Arrivals(folder, self._prepared)
        self.changes, self.box_weight = changes or DeviceAugmentation(), box_weight
        self.store, self.held_out = ScanStore(config, device), ScanStore(config, device)
        self.rng = torch.Generator(device=device).manual_seed(seed)

    def network(self) -> Any:
        """The network with random weights."""
        from lcf3d.detectors.lidar.compact import CompactPillars

        return CompactPillars.build(self.config).to(memory_format=import_torch().channels_last)

    def refresh(self) -> int:
        """Take the scans that have come."""
        new = self.arrivals.take()
        for scan, beams in new:
            self.store.add(scan, beams)
        if new:
            self.store.commit()
        return len(self.store)

    def _prepared(self, path: Path) -> tuple[LabelledScan, Any]:
        scan = labelled_scan(read_scan(path), self.config.class_names)
        return levelled_scan(scan, self.config), beam_of(scan.points)

    def loss(self, network: Any, step: int) -> dict[str, Any]:
        """Terms of `lcf3d.training.lidar_targets.center_losses`."""
        return self._loss(network, self.store, self.changes, self.rng)

    def _loss(self, network: Any, store: ScanStore, changes: DeviceAugmentation, rng: Any) -> dict[str, Any]:
        points, scan, boxes, labels = changed_scans(store, self.batch_size, changes, rng)
        features, cells = statistics_of(points, scan, self.batch_size, self.config.voxels)
        batch = targets_of(boxes, labels, self.config)
        with mixed(self.device):
            maps = network(features, cells, self.batch_size)
        return center_losses(maps[0], batch, self.box_weight)

    def check(self, network: Any) -> dict[str, float]:
        """Terms of the loss on held-out scans, turned but otherwise as they are."""
        torch = import_torch()
        store = self.held_out
        if len(store) < CHECKED:
            store = self.held_out = ScanStore(self.config, self.device)
            for scan, beams in self.arrivals.prepared(self.arrivals.held_out()[:CHECKED]):
                store.add(scan, beams)
            if not len(store):
                return {}
            store.commit()
        rng = torch.Generator(device=self.device).manual_seed(1)
        paste = (0,) * len(self.config.class_names)
        plain = DeviceAugmentation(3, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, paste)
        terms = self._loss(network, store, plain, rng)
        return {f"held-out {name}": float(value) for name, value in terms.items()}


class ArrivingLocalizer:
    """A frustum network on arriving scans; a `lcf3d.training.clocked.ClockTask`, on the CPU.

    Args:
        folder: of samples of the sensor ``lidar``.
        spec: of the network.
        labels: label by class name.
        cameras: that look at the scans; see `lcf3d.training.frustums.scenes_of_samples`.
        views: headings of each scan.
        shares: share of each class in the batches.
        batch_size: frustums a step.
        augmentation: of the frustums.
        seed: of the frustums.
    """

    def __init__(
        self,
        folder: Path,
        spec: Any,
        labels: dict[str, int],
        cameras: Sequence[Any],
        views: int,
        shares: dict[str, float],
        batch_size: int = 64,
        augmentation: Augmentation | None = None,
        seed: int = 0,
    ) -> None:
        self.spec, self.labels, self.cameras, self.views = spec, labels, cameras, views
        self.arrivals = Arrivals(folder, lambda path: self.frustums(path, seed))
        self.held_out: list[PooledFrustum] = []
        self.checked = 0
        self.shares, self.batch_size, self.augmentation, self.seed = shares, batch_size, augmentation, seed
        self.pool: list[PooledFrustum] = []
        self.scans = 0
        self.task: LocalizerTask | None = None

    def network(self) -> Any:
        """The network with random weights."""
        from lcf3d.training.localizer import build_network

        return build_network(self.spec)

    def refresh(self) -> int:
        """Cut frustums from the scans that have come; gives the number of scans."""
        new = self.arrivals.take()
        for frustums in new:
            self.pool += frustums
        self.scans += len(new)
        if new and any(not f.empty for f in self.pool):
            self.task = LocalizerTask(self.spec, self.pool, [], self.batch_size, self.augmentation, self.shares)
        return self.scans if self.task is not None else 0

    def frustums(self, path: Path, seed: int) -> list[PooledFrustum]:
        """Frustums of a sample, looked at from several headings."""
        rng = np.random.default_rng([seed, int(path.stem)])
        scenes = scenes_of_samples([path], self.cameras, self.views, int(rng.integers(2**31)))
        return [frustum for scene in scenes for frustum in frustums_of(scene, self.labels, rng)]

    def loss(self, network: Any, step: int) -> dict[str, Any]:
        """Terms of `lcf3d.training.localizer.frustum_losses`."""
        assert self.task is not None
        return self.task.loss(network, self.task.batch(step, np.random.default_rng([self.seed, step])))

    def check(self, network: Any) -> dict[str, float]:
        """Mean 3D IoU by class on held-out scans."""
        for path in self.arrivals.held_out()[self.checked : CHECKED // 3]:
            self.held_out += self.frustums(path, self.seed + 1)
            self.checked += 1
        if all(f.empty for f in self.held_out):
            return {}
        task = LocalizerTask(self.spec, self.held_out, self.held_out, self.batch_size)
        figures = task.validate(network)
        return {name: figures[name] for name in (f"{c} IoU" for c in self.spec.class_names) if name in figures}


def localizer_of(classes: str, folder: Path, batch_size: int) -> ArrivingLocalizer:
    """The task of the localizer of ``kitti`` or ``nuscenes`` classes, by its recipe."""
    from lcf3d.localizers.spec import LocalizerSpec
    from lcf3d.training.recipes import recipe_of, training_cameras

    recipe, spec = recipe_of(classes), LocalizerSpec.of("v1", classes)
    labels = {name: k for k, name in enumerate(spec.class_names)}
    labels |= {other: labels[name] for other, name in recipe.synonyms.items()}
    cameras = training_cameras(recipe)
    return ArrivingLocalizer(folder, spec, labels, cameras, recipe.views, dict(recipe.shares), batch_size)
