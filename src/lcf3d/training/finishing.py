"""From trained weights to a finished network: scores calibrated, exported, measured on what it has not seen."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from lcf3d.networks.checkpoints import load_parameters, read_training

Figures = dict[str, Any]
SECONDS_AN_IMAGE = 0.25
"""Generous, for what is known to be done in the time that is left."""


def halves(paths: Sequence[Path], until: float) -> tuple[list[Path], list[Path]]:
    """Held-out samples to calibrate with and others to measure with, as many as there is time for."""
    most = max(4, int((until - time.time()) / (2 * SECONDS_AN_IMAGE)))
    chosen = list(paths)[:most]
    return chosen[::2], chosen[1::2]


def finish_camera(network: Any, held_out: Sequence[Path], out: Path, until: float) -> Figures:
    """Write ``camera.onnx``; figures on half of the held-out images, scores calibrated on the others."""
    from lcf3d.detectors.camera.onnx import OnnxDetector
    from lcf3d.detectors.camera.small_export import export_small
    from lcf3d.training.camera_calibration import calibrate
    from lcf3d.training.camera_evaluation import evaluate_detector
    from lcf3d.training.camera_images import read_samples

    export_small(network, out / "camera.onnx")
    fitted, measured = halves(held_out, until)
    if fitted:
        calibrate(network, read_samples(fitted, masks=False))
        export_small(network, out / "camera.onnx")
    if not measured:
        return {}
    detector = OnnxDetector(out / "camera.onnx", score_threshold=0.02)
    return dict(evaluate_detector(detector, read_samples(measured)).figures())


def finish_lidar(network: Any, held_out: Sequence[Path], out: Path, until: float) -> Figures:
    """Write ``lidar.onnx``; figures on half of the held-out scans, scores calibrated on the others."""
    from lcf3d.detectors.lidar.export import export_onnx
    from lcf3d.detectors.lidar.onnx import OnnxLidarDetector
    from lcf3d.detectors.lidar.presets import COMPACT_KITTI
    from lcf3d.training.lidar import trained_detector
    from lcf3d.training.lidar_calibration import calibrate
    from lcf3d.training.lidar_evaluation import detector_figures, sample_scans
    from lcf3d.training.lidar_scans import labelled_scan
    from lcf3d.training.samples import read_scan

    export_onnx(trained_detector(network, COMPACT_KITTI), out / "lidar.onnx")
    fitted, measured = halves(held_out, until)
    if fitted:
        calibrate(network, COMPACT_KITTI, (labelled_scan(read_scan(p), COMPACT_KITTI.class_names) for p in fitted))
        export_onnx(trained_detector(network, COMPACT_KITTI), out / "lidar.onnx")
    if not measured:
        return {}
    detector = OnnxLidarDetector(out / "lidar.onnx", score_threshold=0.05)
    return dict(detector_figures(detector, sample_scans(measured)))


def finish_localizer(classes: str, network: Any, held_out: Sequence[Path], out: Path, until: float) -> Figures:
    """Write ``localizer_CLASSES.onnx``; figures on the held-out scans."""
    from lcf3d.localizers.pointnet import export_onnx
    from lcf3d.training.arriving import localizer_of
    from lcf3d.training.localizer import LocalizerTask

    task = localizer_of(classes, out, 2)
    export_onnx(network, task.spec, out / f"localizer_{classes}.onnx")
    frustums = []
    # cutting takes most of the time
    enough = time.time() + 0.6 * (until - time.time())
    for path in held_out:
        if time.time() > enough:
            break
        frustums += task.frustums(path, 1)
    if all(f.empty for f in frustums):
        return {}
    return dict(LocalizerTask(task.spec, frustums, frustums, 2).validate(network))


FINISHERS: Mapping[str, Callable[[Any, Sequence[Path], Path, float], Figures]] = {
    "camera": finish_camera,
    "lidar": finish_lidar,
    "localizer_kitti": lambda *arguments: finish_localizer("kitti", *arguments),
    "localizer_nuscenes": lambda *arguments: finish_localizer("nuscenes", *arguments),
}


def network_of(name: str, path: Path) -> Any:
    """The network (``camera``, ``lidar``, ``localizer_kitti``, ``localizer_nuscenes``) with averaged weights of a file.

    Raises:
        DetectorError: the file is no checkpoint, or of another architecture.
    """
    if name == "camera":
        from lcf3d.detectors.camera.small_network import SmallConfig, SmallDetector

        network: Any = SmallDetector(SmallConfig())
    elif name == "lidar":
        from lcf3d.detectors.lidar.compact import CompactPillars
        from lcf3d.detectors.lidar.presets import COMPACT_KITTI

        network = CompactPillars.build(COMPACT_KITTI)
    else:
        from lcf3d.localizers.spec import LocalizerSpec
        from lcf3d.training.localizer import build_network

        network = build_network(LocalizerSpec.of("v1", name.removeprefix("localizer_")))
    load_parameters(network, read_training(path)["averaged"], str(path))
    return network.eval().requires_grad_(False)
