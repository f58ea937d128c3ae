"""Compare trained networks with the shipped ones, and put those that are better into ``src/lcf3d/models``.

    python benchmarks/install_networks.py trained --held-out held --kitti /data/kitti
    python benchmarks/install_networks.py trained --held-out held --kitti /data/kitti --install camera,lidar

TRAINED holds what ``benchmarks/train_all.py`` wrote. HELD holds samples of other scenes, ``lidar/*.npz`` and
``camera/*.npz``, made with ``--simulate N`` if they are missing: scores are calibrated on the even ones, figures are of
the odd ones. The real KITTI scans and photographs are measured on and nothing else.
"""

from __future__ import annotations

import argparse
import json
import shutil
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

MODELS = Path(__file__).parents[1] / "src" / "lcf3d" / "models"
FILES = {
    "camera": "camera_kitti.onnx",
    "lidar": "lidar_kitti.onnx",
    "localizer_kitti": "localizer_kitti.onnx",
    "localizer_nuscenes": "localizer_nuscenes.onnx",
}
SEED = 3001
LOWEST_PX = 15.0
"""Objects lower than this in KITTI's images were not learned, and are not counted."""


def main() -> None:
    """Export, calibrate, measure, print, and install on request."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("trained", type=Path)
    parser.add_argument("--held-out", type=Path, required=True, help="folder of samples to calibrate and measure with")
    parser.add_argument("--simulate", type=int, default=0, help="make so many samples first")
    parser.add_argument("--preset", default="kitti64", help="of those samples")
    parser.add_argument("--kitti", type=Path, help="KITTI folder with the splits sensor_train, lidar_train, sensor_val")
    parser.add_argument("--networks", default=",".join(FILES), help=f"of {', '.join(FILES)}")
    parser.add_argument("--install", default="", help="networks to put in the shipped ones' place")
    options = parser.parse_args()
    if options.simulate:
        simulate(options.held_out, options.preset, options.simulate)
    figures: dict[str, Any] = {}
    for name in options.networks.split(","):
        weights = options.trained / f"{name}.pt"
        if not weights.is_file():
            print(f"{weights} is not there: {name} is left as it is")
            continue
        new = options.trained / FILES[name]
        export(name, weights, options.held_out, new)
        figures[name] = {"shipped": measure(name, MODELS / FILES[name], options), "new": measure(name, new, options)}
        print(json.dumps({name: figures[name]}, indent=1), flush=True)
        if name in options.install.split(","):
            shutil.copyfile(new, MODELS / FILES[name])
            print(f"installed: {MODELS / FILES[name]}; its card must say what is new")
    (options.trained / "comparison.json").write_text(json.dumps(figures, indent=1))


def simulate(root: Path, preset: str, count: int) -> None:
    """Scans and images of ``count`` scenes that no training has seen."""
    from lcf3d.training.samples import SampleRecipe, write_scene_samples

    recipes = {
        root / "lidar": SampleRecipe("lidar", preset, 1, SEED),
        root / "camera": SampleRecipe("camera", preset, 1, SEED),
    }
    for folder in recipes:
        folder.mkdir(parents=True, exist_ok=True)
    other = {root / "nuscenes": SampleRecipe("lidar", "nuscenes32", 1, SEED + 2)}
    (root / "nuscenes").mkdir(exist_ok=True)
    for index in range(count):
        write_scene_samples(recipes, index)
    for index in range(count // 2):
        write_scene_samples(other, index)


def samples(root: Path, sensor: str, odd: bool) -> list[Path]:
    """Samples to measure with (odd) or to calibrate on."""
    return sorted((root / sensor).glob("*.npz"))[int(odd) :: 2]


def export(name: str, weights: Path, held_out: Path, path: Path) -> None:
    """Write the network of averaged weights as ONNX, its scores calibrated."""
    from lcf3d.training.finishing import network_of

    network = network_of(name, weights)
    if name == "camera":
        from lcf3d.detectors.camera.small_export import export_small
        from lcf3d.training.camera_calibration import calibrate
        from lcf3d.training.camera_images import read_samples

        calibrate(network, read_samples(samples(held_out, "camera", odd=False), masks=False))
        export_small(network, path)
    elif name == "lidar":
        from lcf3d.detectors.lidar.export import export_onnx
        from lcf3d.detectors.lidar.presets import COMPACT_KITTI
        from lcf3d.training import lidar_calibration
        from lcf3d.training.lidar import trained_detector
        from lcf3d.training.lidar_scans import labelled_scan
        from lcf3d.training.samples import read_scan

        paths = samples(held_out, "lidar", odd=False)
        scans = (labelled_scan(read_scan(p), COMPACT_KITTI.class_names) for p in paths)
        lidar_calibration.calibrate(network, COMPACT_KITTI, scans)
        export_onnx(trained_detector(network, COMPACT_KITTI), path)
    else:
        from lcf3d.localizers.pointnet import export_onnx as export_localizer
        from lcf3d.localizers.spec import LocalizerSpec

        export_localizer(network, LocalizerSpec.of("v1", name.removeprefix("localizer_")), path)


def measure(name: str, path: Path, options: argparse.Namespace) -> dict[str, Any]:
    """Figures of an exported network on held-out simulation, the demo's drive and real KITTI."""
    if name == "camera":
        return measure_camera(path, options)
    if name == "lidar":
        return measure_lidar(path, options)
    return measure_localizer(path, name.removeprefix("localizer_"), options)


def measure_camera(path: Path, options: argparse.Namespace) -> dict[str, Any]:
    """AP, masks and calibration of a camera detector."""
    from lcf3d.detectors.camera.onnx import OnnxDetector
    from lcf3d.detectors.camera.small import INPUT_SIZE
    from lcf3d.training.camera_evaluation import evaluate_detector
    from lcf3d.training.camera_images import drive_images, read_kitti, read_samples

    detector = OnnxDetector(path, score_threshold=0.02, threads=1)
    images = {
        "simulated": read_samples(samples(options.held_out, "camera", odd=True)),
        "drive": drive_images(),
    }
    if options.kitti:
        images |= {split: read_kitti(options.kitti, split, INPUT_SIZE) for split in ("sensor_train", "sensor_val")}
    return {name: evaluate_detector(detector, of, lowest=LOWEST_PX).figures() for name, of in images.items() if of}


def measure_lidar(path: Path, options: argparse.Namespace) -> dict[str, Any]:
    """3D, bird's-eye and centre-distance AP of a LiDAR detector."""
    from lcf3d.detectors.lidar.onnx import OnnxLidarDetector
    from lcf3d.training.lidar_evaluation import detector_figures, drive_scans, kitti_scans, sample_scans

    detector = OnnxLidarDetector(path, score_threshold=0.05, threads=1)
    paths = samples(options.held_out, "lidar", odd=True)
    found = {"drive": detector_figures(detector, drive_scans())}
    if paths:
        found["simulated"] = detector_figures(detector, sample_scans(paths))
    if options.kitti:
        real = [*kitti_scans(options.kitti, "lidar_train"), *kitti_scans(options.kitti, "sensor_val")]
        found["real"] = detector_figures(detector, real)
    return found


def measure_localizer(path: Path, classes: str, options: argparse.Namespace) -> dict[str, Any]:
    """Mean 3D IoU of a localizer's boxes behind exact 2D boxes and its shares above limits, by class."""
    from lcf3d.training.arriving import localizer_of
    from lcf3d.training.frustums import collect, scenes_of_dataset
    from lcf3d.training.localizer import LocalizerTask

    folder = "lidar" if classes == "kitti" else "nuscenes"
    task = localizer_of(classes, options.held_out, 2)
    pools = {"simulated": [f for p in samples(options.held_out, folder, odd=True) for f in task.frustums(p, 1)]}
    if options.kitti and classes == "kitti":
        real = f"kitti:{options.kitti}"
        scenes = (scene for split in ("sensor_train", "sensor_val") for scene in scenes_of_dataset(real, split))
        pools["real"] = collect(scenes, task.labels, 0)
    network = Exported(path)
    figures = {}
    for name, pool in pools.items():
        if any(not frustum.empty for frustum in pool):
            found = LocalizerTask(task.spec, pool, pool, 2).validate(network)
            figures[name] = {key: round(value, 3) for key, value in found.items() if " m" not in key}
    return figures


class Exported:
    """An exported localizer in the place of its torch network."""

    def __init__(self, path: Path) -> None:
        from lcf3d.localizers.onnx import OnnxLocalizer

        self._run = OnnxLocalizer(path)._run

    def parameters(self) -> Iterator[Any]:
        """One tensor on the CPU, which says where the network is."""
        import torch

        yield torch.zeros(1)

    def __call__(self, points: Any, context: Any) -> Any:
        """Centre, box and quality as the torch network gives them."""
        import torch

        values = self._run(points.numpy(), context.numpy())
        return SimpleNamespace(**dict(zip(("centre", "box", "quality"), map(torch.from_numpy, values), strict=True)))


if __name__ == "__main__":
    main()
