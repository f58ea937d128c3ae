"""``lcf3d run``: a dataset through two detectors and the fusion into result files with reasons."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from lcf3d.errors import ConfigError

if TYPE_CHECKING:
    from lcf3d.datasets.kitti import KittiDataset
    from lcf3d.detectors.base import CameraDetector, LidarDetector
    from lcf3d.detectors.results import CameraResults, KittiResults, LidarResults
    from lcf3d.fusion.config import FusionConfig
    from lcf3d.runner import FrameRunner, FrameSummary


def run(
    dataset: Annotated[str, typer.Argument(help="kitti:ROOT")],
    lidar: Annotated[str, typer.Option(help="LiDAR detector, kind:argument, for example results:DIR")],
    camera: Annotated[str, typer.Option(help="camera detector, kind:argument, for example results:DIR or onnx:FILE")],
    out: Annotated[Path, typer.Option(help="folder for results, provenance and settings")],
    split: Annotated[str | None, typer.Option(help="file of ROOT/ImageSets; all frames if left out")] = None,
    frame: Annotated[list[str] | None, typer.Option(help="only this frame; repeatable")] = None,
    config: Annotated[str, typer.Option(help="preset (paper, kitti) or YAML file")] = "kitti",
    set_: Annotated[list[str] | None, typer.Option("--set", help="change a setting, name=value; repeatable")] = None,
    recovery: Annotated[str | None, typer.Option(help="on or off; off needs no scans")] = None,
    tiles: Annotated[int, typer.Option(help="overlapping tiles across wide images, for onnx: detectors")] = 1,
    calibration: Annotated[
        str, typer.Option(help="score calibration: a file of 'lcf3d calibrate', auto, or none")
    ] = "auto",
    missing: Annotated[str, typer.Option(help="result files that are not there: error, or empty")] = "error",
    jobs: Annotated[int, typer.Option(min=1, help="processes")] = 1,
    pictures: Annotated[bool, typer.Option("--pictures", help="also draw every frame")] = False,
    resume: Annotated[bool, typer.Option("--resume", help="continue a run that was interrupted")] = False,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="replace what --out holds")] = False,
    json_: Annotated[bool, typer.Option("--json", help="print the summary as JSON")] = False,
) -> None:
    """Fuse the detections of two detectors on a dataset.

    Example: lcf3d run kitti:KITTI --split val --lidar results:pointpillars --camera onnx:yolox_nano.onnx --out fused
    """
    import json

    from lcf3d.cli.options import build_config
    from lcf3d.formats.run_folder import RunFolder
    from lcf3d.runner import pending_frames, total

    settings = build_config(config, set_ or [])
    settings = settings.updated(recovery=_switch("--recovery", recovery, settings.recovery))
    data, frame_ids = _open(dataset, split, frame or [], settings)
    folder = RunFolder(out)
    runner = _runner(data, frame_ids, lidar, camera, tiles, missing, settings, folder, calibration)
    inputs = {
        "dataset": dataset,
        "split": split,
        "lidar": lidar,
        "camera": camera,
        "tiles": tiles,
        "calibration": calibration,
    }
    folder.begin(settings, {"lcf3d": _version(), **inputs}, resume=resume, overwrite=overwrite)
    pending = pending_frames(folder, frame_ids)
    summaries = _progress(runner, pending, jobs, quiet=json_)
    if pictures:
        _draw(data, folder, frame_ids, quiet=json_)
    counts = {**total(summaries), "already_done": len(frame_ids) - len(pending), "out": str(out)}
    if json_:
        typer.echo(json.dumps(counts, indent=2))
    else:
        _print(counts)


def _switch(option: str, value: str | None, default: bool) -> bool:
    if value is None:
        return default
    if value not in ("on", "off"):
        raise ConfigError(f"{option} takes on or off, got {value!r}")
    return value == "on"


def _version() -> str:
    from lcf3d import __version__

    return __version__


def _open(
    dataset: str, split: str | None, chosen: Sequence[str], settings: FusionConfig
) -> tuple[KittiDataset, tuple[str, ...]]:
    """The dataset and the frames to run."""
    from lcf3d.datasets.kitti import KittiDataset
    from lcf3d.datasets.opening import parse_dataset

    kind, root = parse_dataset(dataset)
    if kind != "kitti":
        raise ConfigError(f"run reads kitti:ROOT, got {dataset!r}")
    data = KittiDataset(root, split, class_names=settings.class_names)
    unknown = [frame_id for frame_id in chosen if frame_id not in data.ids]
    if unknown:
        raise ConfigError(f"{dataset} has no frame {unknown[0]!r}" + (f" in split {split!r}" if split else ""))
    data.require_calibrations()
    return data, tuple(chosen) or data.ids


def _runner(
    data: KittiDataset,
    frame_ids: Sequence[str],
    lidar: str,
    camera: str,
    tiles: int,
    missing: str,
    settings: FusionConfig,
    folder: Any,
    calibration: str,
) -> FrameRunner:
    """Both branches loaded, their result files read and checked, and the fusion."""
    from lcf3d.datasets.kitti import CAMERAS
    from lcf3d.detectors.specs import load_detector
    from lcf3d.fusion.pipeline import LateCascadeFusion
    from lcf3d.runner import FrameRunner

    if missing not in ("error", "empty"):
        raise ConfigError(f"--missing takes error or empty, got {missing!r}")
    defaults: dict[str, int | float | bool | str] = {"missing": missing}
    lidar_branch: LidarResults | LidarDetector = load_detector(lidar, "lidar", settings.class_names, defaults)
    if tiles > 1:
        defaults["tiles"] = tiles
    camera_branch: CameraResults | CameraDetector = load_detector(camera, "camera", settings.class_names, defaults)
    for branch in (lidar_branch, camera_branch):
        _load_results(branch, frame_ids)
    return FrameRunner(data, lidar_branch, {CAMERAS[0][0]: camera_branch}, LateCascadeFusion(settings), folder)


def _load_results(branch: KittiResults | LidarDetector | CameraDetector, frame_ids: Sequence[str]) -> None:
    """Read the files of a ``results:`` branch now, so that a bad one stops the run before it starts."""
    from lcf3d.detectors.results import KittiResults

    if isinstance(branch, KittiResults):
        branch.load(frame_ids)


def _progress(runner: FrameRunner, frame_ids: Sequence[str], jobs: int, quiet: bool) -> list[FrameSummary]:
    """Run the frames under a progress bar."""
    from rich.progress import Progress

    from lcf3d.runner import run_frames

    summaries = []
    with Progress(disable=quiet) as progress:
        task = progress.add_task("fusing", total=len(frame_ids))
        for summary in run_frames(runner, frame_ids, jobs):
            summaries.append(summary)
            progress.advance(task)
    return summaries


def _draw(data: KittiDataset, folder: Any, frame_ids: Sequence[str], quiet: bool) -> None:
    """Write ``pictures/ID.png`` for every frame."""
    raise NotImplementedError


def _print(counts: dict[str, Any]) -> None:
    """The summary for people."""
    from rich.console import Console
    from rich.table import Table

    classes = sorted({name for stage in counts["outputs"].values() for name in stage})
    table = Table(title=f"{counts['frames']} frames fused, {counts['already_done']} already done")
    table.add_column("stage")
    for name in classes:
        table.add_column(name, justify="right")
    for stage, by_class in counts["outputs"].items():
        table.add_row(stage, *(str(by_class.get(name, 0)) for name in classes))
    console = Console()
    console.print(table)
    for reason, count in counts["dropped_lidar"].items():
        console.print(f"dropped LiDAR detections, {reason.replace('_', ' ')}: {count}")
    if counts["median_ms"]:
        console.print("median ms a frame: " + ", ".join(f"{k} {v:.1f}" for k, v in counts["median_ms"].items()))
    console.print(f"results in {counts['out']}", soft_wrap=True)
