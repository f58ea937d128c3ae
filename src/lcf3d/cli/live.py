"""``lcf3d live``: a dataset as a stream through `lcf3d.live.Fuser`, in real time."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from lcf3d.errors import ConfigError

if TYPE_CHECKING:
    from lcf3d.live.replay import ReplayReport


def live(
    dataset: Annotated[str, typer.Argument(help="kitti:ROOT, bag:FILE or another installed kind")],
    lidar: Annotated[str, typer.Option(help="LiDAR detector, kind:argument, for example results:DIR")],
    camera: Annotated[str, typer.Option(help="camera detector of all cameras, kind:argument")],
    rate: Annotated[float, typer.Option(min=0, help="times as fast as it was; 0 for as fast as possible")] = 1.0,
    hertz: Annotated[float, typer.Option(min=0.1, help="frames a second where the dataset has no times")] = 10.0,
    split: Annotated[str | None, typer.Option(help="split of the dataset; all frames if left out")] = None,
    tables: Annotated[str | None, typer.Option(help="nuScenes: folder of tables; the only one if left out")] = None,
    frames: Annotated[int | None, typer.Option(min=1, help="only so many frames from the first on")] = None,
    config: Annotated[str | None, typer.Option(help="preset or YAML file; the dataset's if left out")] = None,
    set_: Annotated[list[str] | None, typer.Option("--set", help="change a setting, name=value; repeatable")] = None,
    recovery: Annotated[str | None, typer.Option(help="on or off; off needs no scans")] = None,
    calibration: Annotated[str, typer.Option(help="score calibration: a file, auto, or none")] = "auto",
    self_calibrate: Annotated[
        bool, typer.Option("--self-calibrate", help="turn each camera as the calibration watch says")
    ] = False,
    memory: Annotated[bool, typer.Option("--memory", help="let recent frames testify too, and give tracks")] = False,
    pictures: Annotated[Path | None, typer.Option(help="draw a PNG a frame into this folder")] = None,
    health: Annotated[Path | None, typer.Option(help="write a JSON line of health after each second here")] = None,
    rerun: Annotated[str | None, typer.Option(help="a .rrd file to record into, or viewer to watch it live")] = None,
    json_: Annotated[bool, typer.Option("--json", help="print the report as JSON")] = False,
) -> None:
    """Replay a dataset in real time and watch latency, what is dropped, each sensor's health and calibration.

    Examples:

    lcf3d live kitti:KITTI --lidar results:pointrcnn --camera results:rrc_2d --rate 1.0

    lcf3d live kitti:DRIVE --lidar shipped:kitti --camera shipped --self-calibrate

    lcf3d live bag:drive.mcap --lidar topic:/lidar/objects --camera topic:/front/objects --pictures seen/
    """
    from lcf3d.cli.console import print_json
    from lcf3d.live.outputs import Outputs
    from lcf3d.live.replay import in_order, make_fuser, replay
    from lcf3d.live.warming import settle_memory
    from lcf3d.run.setup import RunRequest, calibrated_fusion, read_inputs
    from lcf3d.run.teaching import find_calibration

    request = RunRequest(
        dataset, lidar, {"*": camera}, split=split, tables=tables, config=config, changes=tuple(set_ or ()),
        recovery=recovery, calibration=calibration,
    )  # fmt: skip
    inputs = read_inputs(request)
    frame_ids = inputs.frame_ids[:frames]
    if not frame_ids:
        raise ConfigError(f"{dataset} has no frames to replay")
    if memory:
        frame_ids = in_order(inputs.dataset, frame_ids)
    inputs = inputs._replace(frame_ids=frame_ids)
    scores = find_calibration(calibration, inputs.dataset, frame_ids, inputs.lidar, inputs.cameras, inputs.config)
    fusion, notes = calibrated_fusion(inputs, scores)
    first = inputs.dataset.frame(frame_ids[0])
    fuser = make_fuser(
        fusion, inputs.lidar, inputs.cameras, first, realtime=rate > 0, correct=self_calibrate, memory=memory
    )  # fmt: skip
    outputs = Outputs(
        fuser, rate > 0, pictures=pictures, rerun=rerun, health=health, cameras=inputs.dataset.used_cameras
    )
    fuser.warm_up()
    outputs.warm_up()
    settle_memory()
    report = replay(
        inputs.dataset, frame_ids, inputs.lidar, inputs.cameras, fuser, rate=rate, hertz=hertz,
        shown=pictures is not None or rerun is not None, on_results=outputs,
    )  # fmt: skip
    made = outputs.close()
    if json_:
        print_json({**report.to_json(), "outputs": made, "left_out": notes})
    else:
        _print(report, [*made, *notes])


def _print(report: ReplayReport, sentences: list[str]) -> None:
    """The report for people."""
    from rich.table import Table

    from lcf3d.cli.console import console

    out = console()
    out.print(
        f"{report.frames} frames in {report.seconds:.1f} s: {report.results} results, {report.behind} behind time"
        + (", then interrupted" if report.interrupted else "")
    )
    table = Table("stage", "median ms", "99th percentile")
    for part, values in report.latency_ms.items():
        table.add_row(part, f"{values['median']:.2f}", f"{values['p99']:.2f}")
    out.print(table)
    for sentence in sentences:
        out.print(sentence, soft_wrap=True)
    if report.unreadable:
        first = report.unreadable[0]
        out.print(f"{len(report.unreadable)} frames could not be read in full, first: {first}", soft_wrap=True)
    for cause, count in report.dropped.items():
        out.print(f"dropped, {cause}: {count}")
    for status in report.diagnostics:
        level = ("", "warning, ", "error, ", "silent, ")[status["level"]]
        out.print(f"{status['hardware_id']}: {level}{status['message']}", soft_wrap=True)
