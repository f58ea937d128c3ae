"""All systems that run here, side by side: the figures of docs/comparison.md.

    lcf3d simulate SIM --preset kitti64 --frames 240 --seed 3101
    lcf3d simulate RAIN --preset rain --frames 60 --seed 3101
    python benchmarks/compare_systems.py SIM --rain RAIN --painted painted.onnx --plain plain.onnx \\
        --frustum frustum.onnx --real /data --out comparison

The first ``--held-out`` frames of SIM are measured on; the calibration and CLOCs learn from the rest, as the painted
networks did (`lcf3d train lidar kitti:SIM --paint masks:shipped:kitti --init shipped:kitti`). RAIN shows the same
streets in rain. ``--real`` adds the table of `benchmarks/clocs_study.py`. Everything measured is kept in ``--out``
(comparison.json, and comparison.md for the docs) and not measured again.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np
from clocs_study import bounds, print_rows, study_pairs

from lcf3d import FusionConfig, LateCascadeFusion, Lcf3dError, load_detector
from lcf3d.datasets.kitti import KittiDataset
from lcf3d.evaluation.bootstrap import Interval
from lcf3d.evaluation.calibration_study import CalibrationStudy
from lcf3d.evaluation.kitti_task import KittiEvaluation
from lcf3d.evaluation.protocol import EvaluationOptions
from lcf3d.evaluation.reliability import calibration_error, reliability
from lcf3d.files import read_json, write_json
from lcf3d.frame import Frame
from lcf3d.fusion.calibration import Calibration
from lcf3d.fusion.calibration_fit import block_folds
from lcf3d.fusion.clocs import ClocsFusion
from lcf3d.localizers.named import load_localizer
from lcf3d.structures import KITTI_CLASSES, Camera, Detections2D, Detections3D

CAMERA = "shipped:kitti"
OFF, KEEP = "shipped:kitti", "shipped:kitti?nms=keep"
DEFAULT, ALONE, PAPER = "ours, default", "LiDAR alone", "LCF3D, the paper's preset"
CONDITIONS = ("clean", "no camera", "camera turned 1 degree", "half the points", "rain")
Fuse = Callable[[Frame, Detections3D, dict[str, Detections2D]], Detections3D]

ALTERED = {"no camera": ("clean", "none"), "half the points": ("half", "clean"), "rain": ("rain", "rain")}
"""Which scans and images a condition has."""


@dataclass(frozen=True)
class System:
    """What is compared.

    Attributes:
        name: in the tables.
        lidar: the LiDAR branch; empty for none.
        build: makes what becomes of both branches; None where the LiDAR branch is all.
        trained: CLOCs and the calibration learn from frames first.
    """

    name: str
    lidar: str
    build: Callable[[Any], Fuse] | None = None
    trained: str = ""


def cascade(config: FusionConfig, localizer: str = "geometric", calibrated: bool = False) -> Callable[[Any], Fuse]:
    """Late-cascade fusion; with the fitted calibration where that is wanted."""

    def build(fitted: Any) -> Fuse:
        fusion = LateCascadeFusion(config, load_localizer(localizer), fitted if calibrated else None)
        return lambda frame, lidar, camera: fusion(frame, lidar, camera).detections

    return build


def systems(painted: Path | None, plain: Path | None, frustum: Path | None) -> list[System]:
    """All systems; those without a trained network are left out."""
    paper, kitti = FusionConfig.preset("paper"), FusionConfig.preset("kitti")
    bounded = paper.updated(ensemble="probabilistic")
    every = [
        System(ALONE, KEEP),
        System("paper's filter, no recovery", OFF, cascade(bounded.updated(recovery=False))),
        System(PAPER, OFF, cascade(paper, "network")),
        System("the same, probabilistic ensemble", OFF, cascade(bounded, "network")),
        System(DEFAULT, OFF, cascade(kitti)),
        System("ours, network localizer", OFF, cascade(kitti, "network")),
        System("ours, no recovery", OFF, cascade(kitti.updated(recovery=False))),
        System("ours, ensemble=product", OFF, cascade(kitti.updated(ensemble="product"))),
        System("ours, calibrated", OFF, cascade(kitti, calibrated=True), "calibration"),
        System("CLOCs", KEEP, lambda fitted: fitted, "clocs"),
        System("pure cascade, geometric", "", cascade(bounded)),
        System("pure cascade, network (Frustum PointNet)", "", cascade(bounded, "network")),
    ]
    if plain is not None:
        every.append(System("LiDAR alone, trained on", f"onnx-lidar:{plain}?nms=keep"))
    if painted is not None:
        every.append(System("PointPainting", f"painted:{painted}?nms=keep&without_image=unpainted"))
    if frustum is not None:
        every.append(System("Frustum PointPillars", f"frustum-pillars:{frustum}?nms=keep&without_image=unpainted"))
    return every


class Branches:
    """Detections of frames by both branches, each computed once.

    Args:
        frames: the frames.
        scans: detections by LiDAR branch on the same scans, shared between conditions that leave them as they are.
        images: the same of the camera branch.
    """

    def __init__(
        self, frames: Sequence[Frame], scans: dict[str, Any] | None = None, images: dict[str, Any] | None = None
    ) -> None:
        self.frames = list(frames)
        self.scans = {} if scans is None else scans
        self.images = {} if images is None else images
        self.seconds: dict[str, float] = {}

    def lidar(self, spec: str) -> list[Detections3D]:
        """By the LiDAR branch that ``spec`` names."""
        # a painted network sees the image too
        kept = self.scans if spec.startswith(("shipped:", "onnx-lidar:")) else {}
        if spec not in kept:
            kept[spec], self.seconds[spec] = timed(lidar_branch(spec), [(frame,) for frame in self.frames])
        return kept[spec]

    def camera(self) -> list[dict[str, Detections2D]]:
        """By the camera branch; a frame without an image has none."""
        if CAMERA not in self.images:
            frames = [(frame,) for frame in self.frames]
            self.images[CAMERA], self.seconds["camera"] = timed(camera_branch(), frames)
        return self.images[CAMERA]


def timed(call: Callable[..., Any], inputs: Sequence[tuple[Any, ...]]) -> tuple[list[Any], float]:
    """What a call gives, input by input, and the median of its processor seconds."""
    results, seconds = [], []
    for one in inputs:
        start = time.process_time()
        results.append(call(*one))
        seconds.append(time.process_time() - start)
    return results, median(seconds)


def lidar_branch(spec: str) -> Callable[[Frame], Detections3D]:
    """The detector that ``spec`` names, on frames; nothing without one."""
    if not spec:
        return lambda frame: Detections3D.empty(KITTI_CLASSES)
    detector = load_detector(spec, "lidar", KITTI_CLASSES)
    if hasattr(detector, "detect_frame"):
        return lambda frame: detector.detect_frame(frame)
    return lambda frame: detector(frame.points)


def camera_branch() -> Callable[[Frame], dict[str, Detections2D]]:
    """The shipped camera detector on the left image."""
    detector = load_detector(CAMERA, "camera", KITTI_CLASSES)
    return lambda frame: {"left": detector([frame.images["left"]])[0]} if "left" in frame.images else {}


def altered(frame: Frame, condition: str) -> Frame:
    """The frame as the systems get it: one camera at most, and what the condition does to it."""
    left = frame.camera("left")
    points, images = frame.points, {"left": frame.images["left"]}
    if condition == "no camera":
        images = {}
    elif condition == "camera turned 1 degree":
        angle = np.radians(1.0)
        turn = np.eye(4)
        turn[0, 0], turn[0, 2], turn[2, 0], turn[2, 2] = np.cos(angle), np.sin(angle), -np.sin(angle), np.cos(angle)
        left = Camera(left.name, left.projection, turn @ left.camera_from_lidar, left.width, left.height)
    elif condition == "half the points":
        assert points is not None
        points = points[np.random.default_rng(int(frame.id)).random(len(points)) < 0.5]
    return Frame(frame.id, points, (left,), images)


def fitted_on(root: Path, first: int, count: int, known: str) -> Any:
    """What learns from the ``count`` frames after the held-out ones: the ``calibration`` or ``clocs``."""
    dataset = KittiDataset(root)
    ids = dataset.ids[first : first + count]
    branches = Branches([altered(dataset.frame(i), "clean") for i in ids])
    config = FusionConfig.preset("kitti").updated(ensemble="evidence", unmatched="downweight", recovery=False)
    evaluation = KittiEvaluation(dataset, ids, EvaluationOptions())
    # of several boxes around one object the protocol calls one right: fit on what suppression leaves
    lidar = branches.lidar(KEEP)
    study = CalibrationStudy(branches.frames, evaluation, lidar, branches.camera(), config, block_folds(ids, 5))
    if known == "calibration":
        return study.fit()
    from lcf3d.training.clocs import train_clocs

    return train_clocs(study)[0]


def learned(options: argparse.Namespace, system: System) -> Any:
    """The same, kept in a file of the output folder."""
    if not system.trained:
        return None
    path = options.out / f"{system.trained}.json"
    kind: Any = Calibration if system.trained == "calibration" else ClocsFusion
    if not path.is_file():
        fitted_on(options.simulated, options.held_out, options.learn, system.trained).dump(path)
    return kind.load(path)


def fused(system: System, branches: Branches, fitted: Any) -> tuple[list[Detections3D], float | None]:
    """What a system finds on all frames, and processor seconds a frame of branches and fusion, if all were run now."""
    lidar = branches.lidar(system.lidar)
    if system.build is None:
        return lidar, branches.seconds.get(system.lidar)
    found, seconds = timed(system.build(fitted), list(zip(branches.frames, lidar, branches.camera(), strict=True)))
    parts = [branches.seconds.get(name) for name in (system.lidar, "camera")]
    return found, None if None in parts else seconds + sum(part for part in parts if part is not None)


def measured(evaluation: KittiEvaluation, found: Sequence[Detections3D], samples: int) -> dict[str, Any]:
    """AP of each class with its draws, and the expected calibration error over all classes."""
    drawn = evaluation.resampled(found, samples)
    verdict = evaluation.judge_lidar(found)
    scores = np.concatenate([one.scores for one in found])[verdict.judged]
    error = calibration_error(reliability(scores, verdict.right[verdict.judged]))
    return {"drawn": {name: aps.tolist() for name, aps in drawn.items()}, "error": error}


def print_memory(options: argparse.Namespace) -> None:
    """Print the highest memory in MiB of one system on three frames, in this process alone."""
    system = next(s for s in systems(options.painted, options.plain, options.frustum) if s.name == options.memory_of)
    dataset = KittiDataset(options.simulated)
    branches = Branches([altered(dataset.frame(i), "clean") for i in dataset.ids[:3]])
    fused(system, branches, learned(options, system))
    print(json.dumps(peak_mib()))


def peak_mib() -> float:
    """The most memory that this process has held, in MiB."""
    # getrusage would tell that of the process that started this one, where it is higher
    line = next(line for line in Path("/proc/self/status").read_text().splitlines() if line.startswith("VmHWM:"))
    return int(line.split()[1]) / 1024


def memory_of(name: str) -> float:
    """The same from a process of its own."""
    command = [sys.executable, __file__, *sys.argv[1:], "--memory-of", name]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode:
        raise SystemExit(f"error: {name} failed: {done.stderr.strip().splitlines()[-1]}")
    return float(json.loads(done.stdout.splitlines()[-1]))


def measure_all(options: argparse.Namespace) -> dict[str, Any]:
    """Everything, system by system and condition by condition; what is kept is not measured again."""
    path = options.out / "comparison.json"
    kept: dict[str, Any] = read_json(path) if path.is_file() else {}
    roots = dict.fromkeys(CONDITIONS, options.simulated) | {"rain": options.rain}
    shared: dict[str, dict[str, Any]] = {}
    every = systems(options.painted, options.plain, options.frustum)
    for condition in CONDITIONS:
        missing = [system for system in every if condition not in kept.get(system.name, {})]
        if roots[condition] is None or not missing:
            continue
        dataset = KittiDataset(roots[condition])
        ids = dataset.ids[: options.held_out]
        evaluation = KittiEvaluation(dataset, ids, EvaluationOptions())
        frames = [altered(dataset.frame(i), condition) for i in ids]
        scans, images = ALTERED.get(condition, ("clean", "clean"))
        branches = Branches(frames, shared.setdefault(f"scans {scans}", {}), shared.setdefault(f"images {images}", {}))
        for system in missing:
            fitted = learned(options, system)
            found, seconds = fused(system, branches, fitted)
            result = measured(evaluation, found, options.samples)
            if seconds is not None:
                result["seconds"] = seconds
            kept.setdefault(system.name, {})[condition] = result
            write_json(path, kept)
            print(f"{condition}: {system.name}", file=sys.stderr, flush=True)
    for system in every:
        if options.memory and "memory" not in kept[system.name]:
            kept[system.name]["memory"] = memory_of(system.name)
            write_json(path, kept)
    return {system.name: kept[system.name] for system in every}


def interval(values: Sequence[float], signed: bool = False) -> str:
    """A value and the interval of its draws."""
    value, low, high = bounds(Interval.of(values[0], np.asarray(values[1:])))
    return f"{value:+.1f} ({low:+.1f} to {high:+.1f})" if signed else f"{value:.1f} ({low:.0f} to {high:.0f})"


def mean_ap(result: dict[str, Any]) -> np.ndarray:
    """Mean over the classes, draw by draw."""
    return np.mean([result["drawn"][name] for name in KITTI_CLASSES], axis=0)


def tables(kept: dict[str, Any]) -> str:
    """Markdown: figures on clean frames, gain over our default, robustness with what each condition costs."""
    classes = " | ".join(KITTI_CLASSES)
    lines = [f"| system | {classes} | calibration error | s a frame | MiB |", "|---|" + "---|" * 6]
    for name, own in kept.items():
        aps = " | ".join(interval(own["clean"]["drawn"][c]) for c in KITTI_CLASSES)
        error = own["clean"]["error"]
        shown = "-" if error is None or not np.isfinite(error) else f"{100 * error:.1f} %"
        spent = [own[c]["seconds"] for c in CONDITIONS if "seconds" in own.get(c, {})]
        cells = f"{spent[0]:.2f}" if spent else "-"
        cells += f" | {own['memory']:.0f}" if "memory" in own else " | -"
        lines.append(f"| {name} | {aps} | {shown} | {cells} |")
    lines += ["", f"| minus {DEFAULT} | {classes} | mean |", "|---|" + "---|" * 4]
    base = kept[DEFAULT]["clean"]
    for name, own in kept.items():
        if name == DEFAULT:
            continue
        gains = [np.subtract(own["clean"]["drawn"][c], base["drawn"][c]) for c in KITTI_CLASSES]
        gains.append(mean_ap(own["clean"]) - mean_ap(base))
        lines.append(f"| {name} | {' | '.join(interval(gain, signed=True) for gain in gains)} |")
    there = [c for c in CONDITIONS if c in next(iter(kept.values()))]
    lines += ["", f"| mean AP | {' | '.join(there)} |", "|---|" + "---|" * len(there)]
    for name, own in kept.items():
        clean = mean_ap(own["clean"])
        cells = [f"{clean[0]:.1f}"]
        for condition in there[1:]:
            aps = mean_ap(own[condition])
            cells.append(f"{aps[0]:.1f}, {interval(aps - clean, signed=True)}")
        lines.append(f"| {name} | {' | '.join(cells)} |")
    return "\n".join(lines) + "\n"


def main() -> None:
    """Measure, print, write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("simulated", type=Path)
    parser.add_argument("--rain", type=Path, help="the same streets in rain")
    parser.add_argument("--held-out", type=int, default=60, help="first frames, which nothing learned from")
    parser.add_argument("--learn", type=int, default=100, help="frames after them, for the calibration and CLOCs")
    for name in ("painted", "plain", "frustum"):
        parser.add_argument(f"--{name}", type=Path, help=f"{name} network of lcf3d train lidar")
    parser.add_argument("--real", type=Path, help="folder of kitti and kitti_tracking with result files")
    parser.add_argument("--samples", type=int, default=200, help="draws of frames for the intervals")
    parser.add_argument("--memory", action="store_true", help="also the memory of each, in processes of their own")
    parser.add_argument("--out", type=Path, default=Path("comparison"))
    parser.add_argument("--memory-of", help=argparse.SUPPRESS)
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    try:
        if options.memory_of:
            print_memory(options)
            return
        text = tables(measure_all(options))
        (options.out / "comparison.md").write_text(text, encoding="utf-8")
        print(text)
        if options.real is not None:
            print_rows(study_pairs(options.real, [], 5, 1000, options.samples, options.out / "real.json"))
    except Lcf3dError as error:
        raise SystemExit(f"error: {error}") from None


if __name__ == "__main__":
    main()
