"""Ours against CLOCs on the same real detections, frames and metric, from KITTI-layout folders.

    python benchmarks/clocs_study.py /data --out clocs.json
    python benchmarks/clocs_study.py /data --pair pointrcnn+rrc_2d --folds 3 --steps 300

``/data`` holds ``kitti`` and ``kitti_tracking`` with results of the detectors named in ``PAIRS``. The LiDAR branch
alone, the paper's filter, our default settings without labels, with the product as ensemble, and calibrated, and CLOCs;
CLOCs and the calibration are cross-validated on the same folds. Only boxes of the LiDAR branch take part: there are no
scans to recover others from. ``--out`` keeps the rows of each pair as soon as it is measured; another run goes on from
there. All three pairs with five folds take some ten minutes of one core; ``--folds 2 --steps 300`` two.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from lcf3d import FusionConfig, LateCascadeFusion, Lcf3dError
from lcf3d.evaluation.bootstrap import Interval
from lcf3d.evaluation.calibration_study import CalibrationStudy, open_study
from lcf3d.evaluation.reliability import calibration_error, reliability
from lcf3d.files import read_json, write_json
from lcf3d.fusion.self_calibration import self_calibrate
from lcf3d.run.setup import RunRequest
from lcf3d.structures import Detections3D
from lcf3d.training.clocs import SETTINGS, fuse_folds


class Pair(NamedTuple):
    """Two detectors on one folder, and the classes that both detect."""

    folder: str
    lidar: str
    camera: str
    classes: tuple[str, ...]

    @property
    def name(self) -> str:
        """What ``--pair`` calls it."""
        return f"{self.lidar}+{self.camera}"


PAIRS = (
    Pair("kitti_tracking", "pointrcnn", "rrc_2d", ("Car", "Pedestrian")),
    Pair("kitti", "point_gnn", "rcnn_2d", ("Car",)),
    Pair("kitti", "point_gnn", "frustum_pointnets_2d", ("Car",)),
)
ALONE, FILTER, DEFAULT, PRODUCT, CALIBRATED, CLOCS = (
    "LiDAR alone",
    "paper's filter",
    "ours, default",
    "ours, ensemble=product",
    "ours, calibrated",
    "CLOCs",
)


class Way(NamedTuple):
    """What one way of fusing says about a class.

    ``results`` are in the order that the metric looks at, ``probabilities`` the same with scores that should be shares
    of right ones, None where there are none.
    """

    results: Sequence[Detections3D]
    probabilities: Sequence[Detections3D] | None
    seconds: float


def without_labels(study: CalibrationStudy, config: FusionConfig) -> list[Detections3D]:
    """Fused detections, the scores of the LiDAR branch calibrated with the camera as teacher."""
    frames = list(zip(study.frames, study.lidar_inputs, study.camera_inputs, strict=True))
    taught = self_calibrate(frames, config)
    if config.unmatched == "drop":
        # the paper judges every class, known to the camera or not
        taught = taught.model_copy(update={"camera_classes": None})
    fusion = LateCascadeFusion(config, calibration=taught)
    return [fusion(*item).detections for item in frames]


def ways_of(study: CalibrationStudy, class_names: Sequence[str], steps: int) -> Iterator[tuple[str, str, Way]]:
    """Name of a way, class (``*`` for all of them), and what it gives."""
    yield ALONE, "*", Way(study.lidar_inputs, None, 0.0)
    kitti = FusionConfig.preset("kitti").updated(recovery=False)
    paper = FusionConfig.preset("paper").updated(
        ensemble="probabilistic", assignment="gated", recovery=False, lidar_score_threshold=0.0
    )
    for name, config in ((FILTER, paper), (DEFAULT, kitti), (PRODUCT, kitti.updated(ensemble="product"))):
        start = time.process_time()
        found = without_labels(study, config)
        yield name, "*", Way(found, None if name == PRODUCT else found, time.process_time() - start)
    start = time.process_time()
    fused = study.fuse_folds(study.fit())
    seconds = time.process_time() - start
    yield CALIBRATED, "*", Way(study.rescored(fused.equivalents), study.rescored(fused.probabilities), seconds)
    for name in class_names:
        start = time.process_time()
        found = study.rescored(fuse_folds(study, name, replace(SETTINGS, steps=steps, checkpoint_every=steps)))
        yield CLOCS, name, Way(found, found, time.process_time() - start)


def error_of(study: CalibrationStudy, class_name: str, results: Sequence[Detections3D] | None) -> float:
    """Expected calibration error of a class; NaN where the scores are no probabilities."""
    if results is None:
        return float("nan")
    verdict = study.evaluation.judge_lidar(results)
    labels = np.concatenate([found.labels for found in results])
    scores = np.concatenate([found.scores for found in results])
    own = verdict.judged & (labels == study.config.class_names.index(class_name))
    return calibration_error(reliability(scores[own], verdict.right[own]))


def measure(data: Path, pair: Pair, folds: int, steps: int, samples: int) -> list[dict[str, Any]]:
    """One row a class and way: 3D AP, interval of the moderate one and of its gain over LiDAR alone, and the rest."""
    root = data / pair.folder
    lidar, camera = (f"results:{root / 'results' / name}" for name in (pair.lidar, pair.camera))
    study = open_study(RunRequest(f"kitti:{root}", lidar, {"*": camera}, "val", config="kitti"), folds)
    evaluation: Any = study.evaluation
    rows: dict[str, list[dict[str, Any]]] = {name: [] for name in pair.classes}
    drawn: dict[str, dict[str, Any]] = {}
    for name, class_name, way in ways_of(study, pair.classes, steps):
        figures, aps = evaluation.figures(way.results), evaluation.resampled(way.results, samples)
        for own in pair.classes if class_name == "*" else (class_name,):
            drawn.setdefault(own, {})[name] = aps[own]
            row: dict[str, Any] = {"pair": pair.name, "class": own, "way": name, "ap": figures[own]}
            row["interval"] = bounds(Interval.of(aps[own][0], aps[own][1:]))
            row["error"] = error_of(study, own, way.probabilities)
            row["seconds"] = round(way.seconds, 1)
            for other, key in ((ALONE, "gain"), (CALIBRATED, "behind_calibrated")):
                if other in drawn[own] and other != name:
                    gain = aps[own] - drawn[own][other]
                    row[key] = bounds(Interval.of(gain[0], gain[1:]))
            rows[own].append(row)
    return [row for own in rows.values() for row in own]


def bounds(interval: Interval) -> list[float]:
    """Value, lower and upper end."""
    return [interval.value, interval.low, interval.high]


def print_rows(rows: Sequence[Mapping[str, Any]]) -> None:
    """Markdown, as in the docs."""
    print("| detectors | class | way | easy | moderate | hard | gain, moderate | calibration error |")
    print("|---|---|---|---|---|---|---|---|")
    for row in rows:
        easy, moderate, hard = row["ap"]
        low, high = row["interval"][1:]
        gain = "{:+.2f} ({:+.2f} to {:+.2f})".format(*row["gain"]) if "gain" in row else ""
        error = "-" if not np.isfinite(row["error"] or np.nan) else f"{100 * row['error']:.1f} %"
        cells = f"{easy:.2f} | {moderate:.2f} ({low:.1f} to {high:.1f}) | {hard:.2f} | {gain} | {error}"
        print(f"| {row['pair']} | {row['class']} | {row['way']} | {cells} |")


def study_pairs(
    data: Path, names: Sequence[str], folds: int, steps: int, samples: int, out: Path | None
) -> list[dict[str, Any]]:
    """Rows of the pairs asked for; those that ``out`` holds, measured alike, are taken from there."""
    kept: dict[str, Any] = read_json(out) if out is not None and out.is_file() else {}
    rows = []
    for pair in PAIRS:
        if names and pair.name not in names:
            continue
        key = f"{pair.name} folds={folds} steps={steps} samples={samples}"
        if key not in kept:
            kept[key] = measure(data, pair, folds, steps, samples)
            if out is not None:
                write_json(out, kept)
        rows += kept[key]
    return rows


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", type=Path)
    parser.add_argument("--pair", action="append", default=[], choices=[pair.name for pair in PAIRS])
    parser.add_argument("--folds", type=int, default=5, help="2 or more")
    parser.add_argument("--steps", type=int, default=SETTINGS.steps, help="batches of each training of CLOCs")
    parser.add_argument("--samples", type=int, default=300, help="draws of frames for the intervals")
    parser.add_argument("--out", type=Path, help="JSON file that keeps what is measured")
    options = parser.parse_args()
    if min(options.folds - 1, options.steps, options.samples) < 1:
        parser.error("--folds must be 2 or more, --steps and --samples 1 or more")
    try:
        print_rows(study_pairs(options.data, options.pair, options.folds, options.steps, options.samples, options.out))
    except Lcf3dError as error:
        raise SystemExit(f"error: {error}") from None


if __name__ == "__main__":
    main()
