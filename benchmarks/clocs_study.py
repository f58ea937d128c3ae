"""Ours against CLOCs on the same detections, frames and metric: the table of docs/clocs.md, from KITTI-layout folders.

    python benchmarks/clocs_study.py /data

``/data`` holds ``kitti`` and ``kitti_tracking`` with results of the detectors named in ``PAIRS``. Prints one table (or
``--json``): the LiDAR branch alone, CLOCs, the default settings of ours without labels, and ours calibrated; CLOCs and
the calibration are cross-validated on the same folds. Only boxes of the LiDAR branch take part: nothing is recovered.
"""

from __future__ import annotations

import argparse
import json
import time
from pathlib import Path

from lcf3d import FusionConfig, LateCascadeFusion
from lcf3d.evaluation.calibration_study import CalibrationStudy, open_study
from lcf3d.fusion.self_calibration import self_calibrate
from lcf3d.run.setup import RunRequest
from lcf3d.training.clocs import cross_validate

PAIRS = (
    ("kitti_tracking", "pointrcnn", "rrc_2d", ("Car", "Pedestrian")),
    ("kitti", "point_gnn", "rcnn_2d", ("Car",)),
    ("kitti", "point_gnn", "frustum_pointnets_2d", ("Car",)),
)
"""Folder, LiDAR detector, camera detector, classes that both detect."""


def without_labels(study: CalibrationStudy) -> dict[str, tuple[float, ...]]:
    """Our default settings, score calibration taught by the camera."""
    config = FusionConfig.preset("kitti").updated(recovery=False)
    frames = list(zip(study.frames, study.lidar_inputs, study.camera_inputs, strict=True))
    fusion = LateCascadeFusion(config, calibration=self_calibrate(frames, config))
    return study.evaluation.figures([fusion(*item).detections for item in frames])


def rows_of(data: Path, folder: str, lidar: str, camera: str, classes: tuple[str, ...], folds: int) -> list[dict]:
    """One row a class and way of fusing."""
    root = data / folder
    specs = (f"results:{root / 'results' / name}" for name in (lidar, camera))
    study = open_study(RunRequest(f"kitti:{root}", next(specs), {"*": next(specs)}, "val", config="kitti"), folds)
    alone = study.evaluation.figures(study.lidar_inputs)
    default = without_labels(study)
    start = time.perf_counter()
    calibrated = {report.class_name: report.after for report in study.cross_validate(study.fit())}
    middle = time.perf_counter()
    clocs = cross_validate(study, classes)
    seconds = {"ours, calibrated": middle - start, "CLOCs": time.perf_counter() - middle}
    rows = []
    for name in classes:
        ways = {
            "LiDAR alone": alone[name],
            "CLOCs": clocs[name],
            "ours, default": default[name],
            "ours, calibrated": calibrated[name],
        }
        for way, ap in ways.items():
            rows.append({"pair": f"{lidar} + {camera}", "class": name, "way": way, "ap": ap, "s": seconds.get(way)})
    return rows


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("data", type=Path)
    parser.add_argument("--folds", type=int, default=5)
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    if not options.json:
        print("| detectors | class | way | easy | moderate | hard |\n|---|---|---|---|---|---|")
    for pair in PAIRS:
        for row in rows_of(options.data, *pair, folds=options.folds):
            if options.json:
                print(json.dumps(row), flush=True)
                continue
            cells = " | ".join(f"{value:.2f}" for value in row["ap"])
            print(f"| {row['pair']} | {row['class']} | {row['way']} | {cells} |", flush=True)


if __name__ == "__main__":
    main()
