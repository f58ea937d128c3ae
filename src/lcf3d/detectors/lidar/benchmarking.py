"""What the LiDAR networks cost: time, operations, parameters, memory (the paper's complexity table)."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lcf3d.detectors.lidar.config import LidarConfig
from lcf3d.detectors.lidar.detector import TorchLidarDetector
from lcf3d.detectors.lidar.export import export_onnx
from lcf3d.detectors.lidar.fusing import fuse_batch_norm
from lcf3d.detectors.lidar.loading import detector_class
from lcf3d.detectors.lidar.onnx import OnnxLidarDetector
from lcf3d.detectors.lidar.pillars import PillarNetwork
from lcf3d.detectors.lidar.presets import PRESETS
from lcf3d.errors import ConfigError
from lcf3d.networks.torch import count_flops, nn, torch


@dataclass(frozen=True)
class Cost:
    """One detector's cost for one scan or image.

    Attributes:
        name: configuration.
        runtime: ``torch`` or ``onnxruntime``.
        device: where it ran.
        points: points of the scan in range; None for a camera detector.
        milliseconds: median time, preparation of the input and suppression included.
        gflops: multiplications and additions, in thousand millions; None where not counted.
        parameters: of the network, in millions.
        peak_memory_mb: memory taken beyond the loaded network, at most; None where the system does not tell.
    """

    name: str
    runtime: str
    device: str
    points: int | None
    milliseconds: float
    gflops: float | None
    parameters: float
    peak_memory_mb: float | None

    def to_dict(self) -> dict[str, Any]:
        """Plain values, for JSON."""
        return asdict(self)


def benchmark(
    names: Sequence[str] | None = None,
    points: NDArray[np.floating] | None = None,
    repeats: int = 5,
    device: str = "cpu",
    threads: int | None = None,
    onnx: bool = True,
) -> list[Cost]:
    """Measure detectors with untrained weights, in torch and, where they can be exported, in onnxruntime.

    Args:
        names: configurations of `lcf3d.detectors.lidar.presets.PRESETS`; those of the paper without it.
        points: (N, 4 or more) scan; `example_scan` without it.
        repeats: timed runs, after one that is not.
        device: torch device.
        threads: CPU threads; as many as torch takes without it.
        onnx: measure onnxruntime too (on the CPU).

    Raises:
        ConfigError: an unknown configuration.
    """
    chosen = list(names) if names is not None else [n for n in PRESETS if not n.endswith(("-car", "-openpcdet"))]
    unknown = [name for name in chosen if name not in PRESETS]
    if unknown:
        raise ConfigError(f"unknown detector {unknown[0]!r}; known: {', '.join(PRESETS)}")
    scan = example_scan() if points is None else points
    with cpu_threads(threads):
        return [cost for name in chosen for cost in _measure(PRESETS[name], scan, repeats, device, threads or 0, onnx)]


def _measure(
    config: LidarConfig, scan: NDArray[np.floating], repeats: int, device: str, threads: int, onnx: bool
) -> list[Cost]:
    detector = untrained(config, device)
    inputs = detector.inputs(scan)
    if inputs is None:
        raise ConfigError(f"the scan has no point in the range of {config.name}")
    parameters = sum(value.numel() for value in detector.network.parameters()) / 1e6
    count = len(inputs["points"] if "points" in inputs else inputs["features"])
    memory = peak_memory_mb(lambda: detector(scan), device)
    base = Cost(config.name, "torch", device, count, 0.0, count_gflops(lambda: detector(scan)), parameters, memory)
    costs = [replace(base, milliseconds=median_ms(lambda: detector(scan), repeats, device))]
    if onnx and isinstance(detector.network, PillarNetwork):
        with tempfile.TemporaryDirectory() as folder:
            export_onnx(detector, Path(folder) / "network.onnx")
            session = OnnxLidarDetector(Path(folder) / "network.onnx", threads=threads)
            peak = peak_memory_mb(lambda: session(scan), "cpu")
            ms = median_ms(lambda: session(scan), repeats, "cpu")
        costs.append(replace(base, runtime="onnxruntime", device="cpu", milliseconds=ms, peak_memory_mb=peak))
    return costs


def untrained(config: LidarConfig, device: str = "cpu") -> TorchLidarDetector:
    """A detector with fixed random weights, as it runs with trained ones: normalization folded."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        kind = detector_class(config.architecture)
        network = kind.build(config).eval()
        for name, module in network.named_modules():
            # as in training, so that few anchors score and suppression has a usual amount to do
            if name.endswith(("conv_cls", "heatmap.1")) and isinstance(module, nn.Conv2d):
                nn.init.constant_(module.bias, -4.6)
    detector: TorchLidarDetector = kind(fuse_batch_norm(network), config, device=device)
    return detector


def example_scan(seed: int = 0) -> NDArray[np.float32]:
    """(N, 5) a scan of 64 beams over flat ground with 60 boxes on it, of about 50,000 points."""
    generator = np.random.default_rng(seed)
    azimuth, elevation = np.meshgrid(np.linspace(-np.pi, np.pi, 900), np.radians(np.linspace(-24.5, -1.3, 64)))
    ground = 1.73 / np.tan(-elevation)
    distance = ground.copy()
    for angle, radius in zip(generator.uniform(-np.pi, np.pi, 60), generator.uniform(6, 60, 60), strict=True):
        hit = (np.abs(azimuth - angle) < 1.2 / radius) & (ground > radius) & (radius * np.tan(elevation) < 0)
        distance[hit] = np.minimum(distance[hit], radius)
    keep = distance < 80
    azimuth, elevation, distance = (
        azimuth[keep],
        elevation[keep],
        distance[keep] + generator.normal(0, 0.02, keep.sum()),
    )
    columns = (distance * np.cos(azimuth), distance * np.sin(azimuth), distance * np.tan(elevation))
    return np.stack([*columns, generator.random(len(distance)), np.zeros(len(distance))], axis=1).astype(np.float32)


def median_ms(run: Callable[[], object], repeats: int, device: str) -> float:
    """Median time of ``repeats`` runs, after one that is not timed."""
    run()
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        run()
        if device != "cpu":
            torch.cuda.synchronize()
        times.append(time.perf_counter() - start)
    return float(np.median(times) * 1e3)


def count_gflops(run: Callable[[], object]) -> float:
    """Operations of convolutions and matrix products, a multiplication and an addition counted as two."""
    return count_flops(run) / 1e9


def peak_memory_mb(run: Callable[[], object], device: str) -> float | None:
    """Memory that a run takes at most beyond what was taken before it; None where the system does not tell."""
    if device != "cpu":
        torch.cuda.reset_peak_memory_stats()
        before = torch.cuda.memory_allocated()
        run()
        return float(torch.cuda.max_memory_allocated() - before) / 2**20
    try:
        # Linux: forget the peak so far, then read the new one
        Path("/proc/self/clear_refs").write_text("5")
        before = _status_kb("VmRSS")
        run()
        return (_status_kb("VmHWM") - before) / 1024
    except OSError:
        return None


def _status_kb(field: str) -> int:
    for line in Path("/proc/self/status").read_text().splitlines():
        if line.startswith(field + ":"):
            return int(line.split()[1])
    raise OSError(f"/proc/self/status has no {field}")


@contextmanager
def cpu_threads(count: int | None) -> Iterator[None]:
    """torch with so many CPU threads, or as many as before for None."""
    before = torch.get_num_threads()
    if count is not None:
        torch.set_num_threads(count)
    try:
        yield
    finally:
        torch.set_num_threads(before)
