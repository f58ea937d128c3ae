"""``lcf3d ablate``: what each part of the fusion brings, one table."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Annotated

import typer

from lcf3d.errors import ConfigError, DatasetError

if TYPE_CHECKING:
    from rich.table import Table

    from lcf3d.evaluation.ablation import AblationInput, AblationRow
    from lcf3d.formats.kitti import KittiFrames
    from lcf3d.fusion.calibration import Calibration
    from lcf3d.fusion.config import FusionConfig
    from lcf3d.run.setup import RunRequest


def ablate(
    dataset: Annotated[str, typer.Argument(help="kitti:ROOT, with labels")],
    lidar: Annotated[str, typer.Option(help="LiDAR detector, kind:argument, for example results:DIR")],
    camera: Annotated[str, typer.Option(help="camera detector, kind:argument, for example results:DIR or onnx:FILE")],
    split: Annotated[str, typer.Option(help="file of ROOT/ImageSets")] = "val",
    calibration: Annotated[
        str, typer.Option(help="score calibration: a file of 'lcf3d calibrate', auto, or none")
    ] = "auto",
    config: Annotated[str, typer.Option(help="preset or YAML file that the variants change")] = "kitti",
    set_: Annotated[list[str] | None, typer.Option("--set", help="change a setting, name=value; repeatable")] = None,
    localizer: Annotated[str, typer.Option(help="for recovery, as for lcf3d run")] = "geometric",
    tiles: Annotated[int, typer.Option(min=1, help="overlapping tiles across wide images, for onnx: detectors")] = 1,
    missing: Annotated[str, typer.Option(help="result files that are not there: error, or empty")] = "error",
    json_: Annotated[bool, typer.Option("--json", help="print the rows as JSON")] = False,
) -> None:
    """Measure the fusion with parts of it switched off or exchanged (3D AP R40).

    Rows with detection recovery need LiDAR scans for all frames, mask modes a camera detector with masks.

    Examples:

    lcf3d ablate kitti:KITTI --split val --lidar results:point_gnn --camera results:rcnn

    lcf3d ablate kitti:KITTI --split val --lidar results:point_gnn --camera onnx:segmentation.onnx --tiles 2
    """
    import json

    from lcf3d.cli.calibrate import plain, tracked, wide_console
    from lcf3d.evaluation.ablation import ablate as measure
    from lcf3d.localizers.named import load_localizer
    from lcf3d.run.setup import RunRequest

    request = RunRequest(
        dataset, lidar, {"left": camera}, split, config=config, changes=tuple(set_ or ()), tiles=tiles, missing=missing
    )
    inputs, truth, settings, suppress = _read(request)
    scores = _calibration(calibration, inputs, settings)
    chosen, progress = load_localizer(localizer), plain if json_ else tracked
    rows = measure(inputs, truth, settings, scores, chosen, progress, suppress)
    scans = all(item.frame.points is not None for item in inputs)
    if json_:
        typer.echo(json.dumps({"frames": len(inputs), "scans": scans, "rows": [r.to_json() for r in rows]}, indent=2))
        return
    console = wide_console()
    console.print(_table(rows, len(inputs)))
    if not scans:
        console.print("not every frame has a LiDAR scan: rows with detection recovery are left out", soft_wrap=True)


def _read(request: RunRequest) -> tuple[list[AblationInput], KittiFrames, FusionConfig, bool]:
    """Frames with their detections, the labels, the settings, and whether a LiDAR network ran here without NMS."""
    from lcf3d.datasets.kitti import KittiDataset
    from lcf3d.evaluation.ablation import AblationInput
    from lcf3d.formats.kitti import read_folder
    from lcf3d.run.setup import read_inputs
    from lcf3d.run.sources import LidarOnScans

    found = read_inputs(request)
    if not isinstance(found.dataset, KittiDataset):
        raise ConfigError(f"ablate reads kitti:ROOT, got {request.dataset!r}")
    truth = read_folder(found.dataset.folder / "label_2", found.frame_ids, results=False)
    inputs = []
    for frame in map(found.dataset.frame, found.frame_ids):
        camera = found.cameras["left"]
        if not camera.sees(frame, "left"):
            raise DatasetError(f"frame {frame.id} has no left image; pass results:DIR as the camera branch")
        inputs.append(AblationInput(frame, found.lidar.detect(frame), camera.detect(frame, "left")))
    return inputs, truth, found.config, isinstance(found.lidar, LidarOnScans)


def _calibration(text: str, inputs: Sequence[AblationInput], settings: FusionConfig) -> Calibration | None:
    from lcf3d.fusion.calibration import load_calibration
    from lcf3d.fusion.self_calibration import self_calibrate

    if text == "auto":
        return self_calibrate(inputs, settings)
    if not text:
        raise ConfigError("--calibration takes a file, auto or none")
    return load_calibration(text)


def _table(rows: Sequence[AblationRow], frames: int) -> Table:
    """The rows under their headings; classes without any figure are left out."""
    from rich.table import Table

    names = [name for name in rows[0].ap if any(ap[0] == ap[0] for ap in (row.ap[name] for row in rows))]
    table = Table(title=f"3D AP R40, easy moderate hard, on {frames} frames")
    table.add_column("variant", no_wrap=True)
    for name in names:
        table.add_column(name, justify="right", no_wrap=True)
    for stage in ("matched", "recovered", "kept"):
        table.add_column(stage, justify="right", no_wrap=True)
    group = ""
    for row in rows:
        if row.group != group:
            group = row.group
            table.add_section()
            table.add_row(f"[bold]{group}[/bold]")
        cells = (" ".join(f"{value:.2f}" for value in row.ap[name]) for name in names)
        table.add_row(row.name, *cells, str(row.matched), str(row.recovered), str(row.kept))
    return table
