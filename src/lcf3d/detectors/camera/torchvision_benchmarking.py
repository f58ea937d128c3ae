"""What the camera networks cost, in the same table as the LiDAR networks (the paper's complexity table)."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from lcf3d.detectors.base import Image
from lcf3d.detectors.camera.torchvision_fasterrcnn import FasterRCNNNetwork, TorchvisionFasterRCNN
from lcf3d.detectors.camera.torchvision_styles import STYLES
from lcf3d.detectors.lidar.benchmarking import Cost, count_gflops, cpu_threads, median_ms, peak_memory_mb
from lcf3d.errors import ConfigError
from lcf3d.networks.torch import torch

NETWORKS = {"fasterrcnn-r101-kitti": (101, "kitti"), "fasterrcnn-r50-nuscenes": (50, "nuscenes")}
"""Name -> depth of the ResNet and style."""


def benchmark_camera(
    names: Sequence[str] | None = None,
    image: Image | None = None,
    repeats: int = 5,
    device: str = "cpu",
    threads: int | None = None,
) -> list[Cost]:
    """Measure the Faster R-CNNs of the paper with untrained weights.

    Args:
        names: of `NETWORKS`; all without it.
        image: (H, W, 3) uint8; noise of KITTI's 1242 x 375 pixels without it.
        repeats: timed runs, after one that is not.
        device: torch device.
        threads: CPU threads; as many as torch takes without it.

    Raises:
        ConfigError: an unknown network.
    """
    chosen = list(NETWORKS) if names is None else list(names)
    unknown = [name for name in chosen if name not in NETWORKS]
    if unknown:
        raise ConfigError(f"unknown camera network {unknown[0]!r}; known: {', '.join(NETWORKS)}")
    if image is None:
        image = np.random.default_rng(0).integers(0, 256, (375, 1242, 3), dtype=np.uint8)
    costs = []
    with cpu_threads(threads):
        for name in chosen:
            depth, style = NETWORKS[name]
            with torch.random.fork_rng(devices=[]):
                torch.manual_seed(0)
                state = FasterRCNNNetwork(depth, STYLES[style]).state_dict()
            detector = TorchvisionFasterRCNN.from_state_dict(state, device=device)
            parameters = sum(value.numel() for value in detector.network.parameters()) / 1e6
            memory = peak_memory_mb(lambda detector=detector: detector([image]), device)  # type: ignore[misc]
            gflops = count_gflops(lambda detector=detector: detector([image]))  # type: ignore[misc]
            ms = median_ms(lambda detector=detector: detector([image]), repeats, device)  # type: ignore[misc]
            costs.append(Cost(name, "torch", device, None, ms, gflops, parameters, memory))
    return costs
