"""When does late fusion help? The table and the plots of docs/when-fusion-helps.md, from KITTI-layout folders.

    python benchmarks/when_fusion_helps.py /data --plots docs/images

``/data`` holds ``kitti`` and ``kitti_tracking`` with results of the detectors named in ``PAIRS``. Prints one table (or
``--json``): the LiDAR branch alone, a hard filter, the ``kitti`` preset without labels (``--calibration auto``),
the same with a calibration in cross-validation, and with evidence weights fitted on the other folder. The plots show
what happens as either branch gets worse: noise is added to LiDAR scores, or camera detections are taken away.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from lcf3d import FusionConfig, LateCascadeFusion, Lcf3dError
from lcf3d.evaluation.calibration_study import CalibrationStudy, open_study
from lcf3d.evaluation.svg import PALETTE, Line, line_chart
from lcf3d.fusion.calibration import Calibration, natural_transform, transform_scores
from lcf3d.fusion.evidence import SUPPORT_IOU
from lcf3d.fusion.self_calibration import self_calibrate
from lcf3d.run.setup import RunRequest
from lcf3d.structures import Detections2D, Detections3D

PRESET = FusionConfig.preset("kitti").updated(recovery=False)
# the paper's filter with scores that stay comparable
FILTER = FusionConfig.preset("paper").updated(
    ensemble="probabilistic", assignment="gated", recovery=False, lidar_score_threshold=0.0
)
ALONE = "LiDAR alone"


@dataclass(frozen=True)
class Pair:
    """Two detectors on one folder, and the classes to report."""

    folder: str
    lidar: str
    camera: str
    classes: tuple[str, ...]


PAIRS = (
    Pair("kitti", "point_gnn", "rcnn_2d", ("Car",)),
    Pair("kitti", "point_gnn", "frustum_pointnets_2d", ("Car",)),
    Pair("kitti_tracking", "pointrcnn", "rrc_2d", ("Car", "Pedestrian", "Cyclist")),
)


def open_pair(data: Path, pair: Pair, folds: int) -> CalibrationStudy:
    """Frames, labels and detections of a pair."""
    root = data / pair.folder
    lidar, camera = (f"results:{root / 'results' / name}" for name in (pair.lidar, pair.camera))
    return open_study(RunRequest(f"kitti:{root}", lidar, {"*": camera}, "val", config="kitti"), folds)


def fuse(
    study: CalibrationStudy,
    lidar: Sequence[Detections3D],
    camera: Sequence[Mapping[str, Detections2D]],
    config: FusionConfig | None,
    calibration: Calibration | None = None,
) -> dict[str, tuple[float, ...]]:
    """3D AP of the fusion (of the LiDAR branch alone without ``config``), self-calibrated if not told otherwise."""
    results = list(lidar)
    if config is not None:
        taught = calibration or self_calibrate(zip(study.frames, lidar, camera, strict=True), config)
        if config is FILTER:
            # the paper judges every class, known to the camera or not
            taught = taught.model_copy(update={"camera_classes": None})
        fusion = LateCascadeFusion(config, calibration=taught)
        results = [fusion(*item).detections for item in zip(study.frames, lidar, camera, strict=True)]
    return study.evaluation.figures(results)


def table(studies: dict[Pair, CalibrationStudy]) -> list[dict[str, object]]:
    """One row a pair, class and way of fusing."""
    rows: list[dict[str, object]] = []
    fitted = {pair: study.fit() for pair, study in studies.items()}
    for pair, study in studies.items():
        branches = study.lidar_inputs, study.camera_inputs
        reports = {r.class_name: r for r in study.cross_validate(fitted[pair])}
        others = [fitted[p].evidence for p in studies if p.folder != pair.folder]
        elsewhere = fitted[pair].model_copy(update={"evidence": {k: v for e in others for k, v in e.items()}})
        ways = {
            "hard filter": fuse(study, *branches, FILTER),
            "kitti preset, no labels": fuse(study, *branches, PRESET),
            "evidence of the other folder": fuse(study, *branches, PRESET, elsewhere),
        }
        for name in pair.classes:
            ap = {ALONE: reports[name].before}
            ap |= {way: figures[name] for way, figures in ways.items()}
            if not any(name in evidence for evidence in others):
                del ap["evidence of the other folder"]
            ap["calibrated, cross-validated"] = reports[name].after
            rows += [
                {"folder": pair.folder, "lidar": pair.lidar, "camera": pair.camera, "class": name, "way": way, "ap": v}
                for way, v in ap.items()
            ]
    return rows


def print_table(rows: Sequence[dict[str, object]]) -> None:
    """Markdown, as in the docs; gains against the LiDAR branch in brackets."""
    print("| detectors | class | way | easy | moderate | hard |\n|---|---|---|---|---|---|")
    before: Sequence[float] = ()
    for row in rows:
        values: Sequence[float] = row["ap"]  # type: ignore[assignment]
        before = values if row["way"] == ALONE else before
        gains = [cell(v, b, row["way"] == ALONE) for v, b in zip(values, before, strict=True)]
        print(f"| {row['lidar']} + {row['camera']} | {row['class']} | {row['way']} | {' | '.join(gains)} |")


def cell(value: float, before: float, alone: bool) -> str:
    """A figure and its gain; a dash where a class has no boxes left."""
    if np.isnan(value):
        return "-"
    return f"{value:.2f}" if alone else f"{value:.2f} ({value - before:+.2f})"


def noisy_lidar(study: CalibrationStudy, amount: float) -> CalibrationStudy:
    """Noise on the LiDAR scores: ``amount`` times the spread of the (transformed) scores."""
    scores = np.concatenate([found.scores for found in study.lidar_inputs])
    x = transform_scores(scores, natural_transform(scores))
    x = x + amount * np.random.default_rng(0).normal(0, 1, len(x)) * x.std()
    parts = np.split(x, np.cumsum([len(found) for found in study.lidar_inputs])[:-1])
    lidar = [replace(found, scores=own) for found, own in zip(study.lidar_inputs, parts, strict=True)]
    return altered(study, lidar, study.camera_inputs)


def thinned_camera(study: CalibrationStudy, share: float) -> CalibrationStudy:
    """Without a random ``share`` of the camera detections."""
    rng = np.random.default_rng(0)
    camera = [{n: d[rng.random(len(d)) >= share] for n, d in seen.items()} for seen in study.camera_inputs]
    return altered(study, study.lidar_inputs, camera)


def altered(
    study: CalibrationStudy, lidar: Sequence[Detections3D], camera: Sequence[Mapping[str, Detections2D]]
) -> CalibrationStudy:
    """The same frames with other detections."""
    return CalibrationStudy(study.frames, study.evaluation, lidar, camera, study.config, study.folds)


def sweep_chart(study: CalibrationStudy, class_name: str, worse: str) -> str:
    """3D AP moderate as one branch gets worse; calibration is fitted on the frames it is used on."""
    amounts = np.linspace(0, 2, 5) if worse == "lidar" else np.linspace(0, 0.8, 5)
    curves: dict[str, list[float]] = {ALONE: [], "hard filter": [], "kitti preset, no labels": [], "calibrated": []}
    for amount in amounts:
        at = noisy_lidar(study, amount) if worse == "lidar" else thinned_camera(study, amount)
        ways = ((None, None), (FILTER, None), (PRESET, None), (PRESET, at.fit()))
        for values, (config, calibration) in zip(curves.values(), ways, strict=True):
            values.append(fuse(at, at.lidar_inputs, at.camera_inputs, config, calibration)[class_name][1])
    lines = [
        Line(way, amounts, values, color, dashed=way == ALONE)
        for (way, values), color in zip(curves.items(), (PALETTE[8], *PALETTE[1::-1], PALETTE[2]), strict=True)
    ]
    x_label = "noise on LiDAR scores, in spreads" if worse == "lidar" else "share of camera detections taken away"
    low = min(min(values) for values in curves.values())
    high = max(max(values) for values in curves.values())
    margin = 0.08 * (high - low)
    y_range = (max(low - margin, 0.0), high + margin)
    return line_chart(lines, x_label, f"{class_name} 3D AP moderate", (0.0, float(amounts[-1])), y_range, markers=True)


def support_chart(fitted: dict[str, Calibration]) -> str:
    """Log-odds that a certain 2D detection adds, against its image IoU."""
    lines = []
    for name, calibration in fitted.items():
        for class_name, evidence in calibration.evidence.items():
            color = PALETTE[len(lines)]
            lines.append(Line(f"{class_name}, {name}", (0.0, *SUPPORT_IOU), (0.0, *evidence.support), color))
    highest = max(max(line.y) for line in lines)
    return line_chart(lines, "image IoU", "log-odds added", (0.0, 1.0), (0.0, highest * 1.05), width=480, markers=True)


def draw(studies: dict[Pair, CalibrationStudy], folder: Path) -> None:
    """Write the plots."""
    folder.mkdir(parents=True, exist_ok=True)
    first, tracking = studies[PAIRS[0]], studies[PAIRS[2]]
    charts = {
        "fusion_lidar_noise_car": sweep_chart(first, "Car", "lidar"),
        "fusion_camera_loss_car": sweep_chart(first, "Car", "camera"),
        "fusion_camera_loss_pedestrian": sweep_chart(tracking, "Pedestrian", "camera"),
        "fusion_support": support_chart({pair.camera: study.fit() for pair, study in studies.items()}),
    }
    for name, chart in charts.items():
        text = chart.replace("<svg ", "<svg xmlns='http://www.w3.org/2000/svg' ", 1)
        text = text.replace(">", "><rect width='100%' height='100%' fill='white'/>", 1)
        (folder / f"{name}.svg").write_text(text, encoding="utf-8")


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", type=Path)
    parser.add_argument("--folds", type=int, default=5)
    parser.add_argument("--plots", type=Path, help="folder for SVG files")
    parser.add_argument("--no-table", action="store_true", help="plots only")
    parser.add_argument("--json", action="store_true")
    arguments = parser.parse_args()
    try:
        studies = {pair: open_pair(arguments.data, pair, arguments.folds) for pair in PAIRS}
        rows = [] if arguments.no_table else table(studies)
        if arguments.json:
            print(json.dumps(rows, indent=2))
        elif rows:
            print_table(rows)
        if arguments.plots:
            draw(studies, arguments.plots)
    except Lcf3dError as error:
        raise SystemExit(f"error: {error}") from None


if __name__ == "__main__":
    main()
