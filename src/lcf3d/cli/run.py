"""``lcf3d run``: a dataset through two detectors and the fusion into result files with reasons."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from lcf3d.errors import ConfigError

if TYPE_CHECKING:
    from lcf3d.run.frames import FrameSummary
    from lcf3d.run.setup import Run


# where a run's bag goes
_BAGS = {"mcap": "fused.mcap", "rosbag2": "fused_bag", "rosbag1": "fused.bag"}


def run(
    dataset: Annotated[str, typer.Argument(help="kitti:ROOT, nuscenes:ROOT or another installed kind")],
    lidar: Annotated[str, typer.Option(help="LiDAR detector, kind:argument, for example results:DIR")],
    out: Annotated[Path, typer.Option(help="folder for results, provenance and settings")],
    camera: Annotated[
        str | None, typer.Option(help="camera detector, kind:argument, for example results:DIR or yolox:nano")
    ] = None,
    camera_left: Annotated[str | None, typer.Option(help="stereo pair: detector of the left camera")] = None,
    camera_right: Annotated[str | None, typer.Option(help="stereo pair: detector of the right camera")] = None,
    split: Annotated[
        str | None, typer.Option(help="file of ROOT/ImageSets, or nuScenes split; all if left out")
    ] = None,
    tables: Annotated[str | None, typer.Option(help="nuScenes: folder of tables; the only one if left out")] = None,
    frame: Annotated[list[str] | None, typer.Option(help="only this frame; repeatable")] = None,
    config: Annotated[
        str | None,
        typer.Option(help="preset (default, paper, kitti, nuscenes) or YAML file; the dataset's if left out"),
    ] = None,
    set_: Annotated[list[str] | None, typer.Option("--set", help="change a setting, name=value; repeatable")] = None,
    recovery: Annotated[str | None, typer.Option(help="on or off; off needs no scans")] = None,
    localizer: Annotated[
        str, typer.Option(help="geometric, network, combined, onnx:FILE or frustum-pointnet:CHECKPOINT")
    ] = "geometric",
    tiles: Annotated[
        int, typer.Option(min=1, help="overlapping tiles across wide images, for yolox: and onnx: detectors")
    ] = 1,
    calibration: Annotated[
        str, typer.Option(help="score calibration: a file of 'lcf3d calibrate', auto, or none")
    ] = "auto",
    missing: Annotated[str, typer.Option(help="result files that are not there: error, or empty")] = "error",
    self_calibrate: Annotated[
        bool, typer.Option("--self-calibrate", help="turn cameras as the matches of the whole drive say")
    ] = False,
    memory: Annotated[
        bool, typer.Option("--memory", help="let recent frames of a drive testify too, and give tracks")
    ] = False,
    smooth: Annotated[
        bool, typer.Option("--smooth", help="as --memory, and later frames testify as well; not for live use")
    ] = False,
    jobs: Annotated[int, typer.Option(min=1, help="processes")] = 1,
    ray: Annotated[
        str | None, typer.Option(help="on a Ray cluster: its address, or auto for that of this machine")
    ] = None,
    shard: Annotated[str | None, typer.Option(help="only part i/n of the frames, see 'lcf3d merge'")] = None,
    format_: Annotated[
        str,
        typer.Option(
            "--format",
            help="of --out: folder (files of each frame) or parquet; mcap, rosbag2, rosbag1: a folder and a bag",
        ),
    ] = "folder",
    pictures: Annotated[bool, typer.Option("--pictures", help="also draw every frame")] = False,
    resume: Annotated[bool, typer.Option("--resume", help="continue a run that was interrupted")] = False,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="replace the run that --out holds")] = False,
    json_: Annotated[bool, typer.Option("--json", help="print the summary as JSON")] = False,
) -> None:
    """Fuse the detections of two detectors on a dataset.

    Examples:

    lcf3d run kitti:KITTI --split val --lidar results:pointpillars --camera yolox:nano --tiles 2 --out fused

    lcf3d run kitti:KITTI --lidar results:DIR --camera-left results:L --camera-right results:R --out fused

    lcf3d run nuscenes:NUSCENES --lidar results:centerpoint.json --camera results:detections_2d.json --out fused
    """
    from lcf3d.cli.console import print_json
    from lcf3d.formats.bag_files import require_writer
    from lcf3d.remote.places import local
    from lcf3d.remote.urls import is_url, url_of
    from lcf3d.run.frames import total
    from lcf3d.run.ray_workers import require_processes
    from lcf3d.run.sequences import pending_frames
    from lcf3d.run.setup import RunRequest, prepare_run

    request = RunRequest(
        dataset=dataset,
        lidar=lidar,
        cameras=_cameras(camera, camera_left, camera_right),
        split=split,
        tables=tables,
        frames=tuple(frame or ()),
        config=config,
        changes=tuple(set_ or ()),
        recovery=recovery,
        localizer=localizer,
        tiles=tiles,
        calibration=calibration,
        missing=missing,
        self_calibrate=self_calibrate,
        memory=memory,
        smooth=smooth,
        shard=shard,
        form="parquet" if format_ == "parquet" else "folder",
    )
    if format_ not in ("folder", "parquet", *_BAGS):
        raise ConfigError(f"--format takes folder, parquet, {', '.join(_BAGS)}, got {format_!r}")
    if format_ in _BAGS and is_url(out):
        raise ConfigError(f"--format {format_} writes a bag on this machine; --out {url_of(out)} is elsewhere")
    require_processes(request, jobs, ray)
    if format_ in _BAGS:
        require_writer(_BAGS[format_])
    prepared = prepare_run(request, local(out, new=True), resume=resume, overwrite=overwrite)
    pending, sequences = pending_frames(prepared)
    summaries = _fuse(prepared, pending, jobs, sequences, ray, quiet=json_)
    prepared.folder.finish(prepared.frame_ids)
    if format_ in _BAGS:
        _write_bag(prepared, prepared.folder.path / _BAGS[format_])
    if pictures:
        _draw(prepared, quiet=json_)
    counts = {
        **total(summaries),
        "left_out": list(prepared.notes),
        "warnings": list(prepared.warnings()),
        "already_done": len(prepared.frame_ids) - len(pending),
        "out": url_of(out) or str(out),
    }
    if json_:
        print_json(counts)
    else:
        _print(counts)


def _cameras(camera: str | None, left: str | None, right: str | None) -> dict[str, str]:
    """The detector of each camera: one for all that the dataset uses, or one of each side of a stereo pair."""
    if camera and not (left or right):
        return {"*": camera}
    if left and right and not camera:
        return {"left": left, "right": right}
    raise ConfigError("name the camera branch with --camera, or with both --camera-left and --camera-right")


def _fuse(
    prepared: Run, pending: list[str], jobs: int, sequences: list[Sequence[str]] | None, ray: str | None, quiet: bool
) -> list[FrameSummary]:
    """Run the frames under a progress bar."""
    from rich.progress import Progress

    from lcf3d.run.ray_workers import fuse_frames

    summaries = []
    with Progress(disable=quiet) as progress:
        task = progress.add_task("fusing", total=len(pending))
        for summary in fuse_frames(prepared, pending, jobs, ray, sequences):
            summaries.append(summary)
            progress.advance(task)
    return summaries


def _write_bag(prepared: Run, path: Path) -> None:
    """The sensors' data and the fused boxes as a bag; one that is there is replaced."""
    import shutil

    from lcf3d.datasets.bag_export import write_bag

    if path.is_dir():
        shutil.rmtree(path)
    path.unlink(missing_ok=True)
    write_bag(map(prepared.dataset.frame, prepared.frame_ids), path, prepared.folder.read)


def _draw(prepared: Run, quiet: bool) -> None:
    """Write ``pictures/ID.png`` for every frame."""
    from rich.progress import Progress

    from lcf3d.visualization.png import draw_frame, save_png
    from lcf3d.visualization.scene import Scene

    with Progress(disable=quiet) as progress:
        for frame_id in progress.track(prepared.frame_ids, description="drawing"):
            frame = prepared.dataset.frame(frame_id)
            picture = draw_frame(frame, Scene.from_fused(prepared.folder.read(frame_id), frame.labels))
            save_png(picture, prepared.folder.path / "pictures" / f"{frame_id}.png")


def _print(counts: dict[str, Any]) -> None:
    """The summary for people."""
    from rich.table import Table

    from lcf3d.cli.console import console

    outputs = counts["outputs"]
    done = f", {counts['already_done']} were done before" if counts["already_done"] else ""
    table = Table("class", title=f"{counts['frames']} frames fused{done}")
    for outcome in outputs:
        table.add_column(outcome, justify="right")
    for name in sorted({name for by_class in outputs.values() for name in by_class}):
        table.add_row(name, *(str(by_class.get(name, 0)) for by_class in outputs.values()))
    out = console()
    out.print(table)
    for reason, count in counts["dropped_lidar"].items():
        out.print(f"dropped LiDAR detections, {reason.replace('_', ' ')}: {count}")
    for note in counts["left_out"]:
        out.print(note, soft_wrap=True)
    for note, count in counts["notes"].items():
        out.print(f"in {count} frames: {note}", soft_wrap=True)
    if counts["median_ms"]:
        out.print("median ms a frame: " + ", ".join(f"{k} {v:.1f}" for k, v in counts["median_ms"].items()))
    for warning in counts["warnings"]:
        out.print(f"warning: {warning}", soft_wrap=True)
    out.print(f"results in {counts['out']}", soft_wrap=True)
