"""``lcf3d ablate``: what each part of the fusion brings, one table."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Annotated

import typer

from lcf3d.errors import DatasetError

if TYPE_CHECKING:
    from lcf3d.evaluation.ablation import AblationInput, AblationRow
    from lcf3d.evaluation.protocol import Evaluation, TableData
    from lcf3d.run.setup import Inputs


def ablate(
    dataset: Annotated[str, typer.Argument(help="kitti:ROOT, nuscenes:ROOT or another installed kind, with labels")],
    lidar: Annotated[str, typer.Option(help="LiDAR detector, kind:argument, for example results:DIR")],
    camera: Annotated[str, typer.Option(help="camera detector, kind:argument, for example results:DIR or yolox:nano")],
    split: Annotated[str | None, typer.Option(help="split of the dataset; the usual one if left out")] = None,
    tables: Annotated[str | None, typer.Option(help="nuScenes: folder of tables; the only one if left out")] = None,
    calibration: Annotated[
        str, typer.Option(help="score calibration: a file of 'lcf3d calibrate', auto, or none")
    ] = "auto",
    config: Annotated[
        str | None, typer.Option(help="preset or YAML file that the variants change; the dataset's if left out")
    ] = None,
    set_: Annotated[list[str] | None, typer.Option("--set", help="change a setting, name=value; repeatable")] = None,
    localizer: Annotated[str, typer.Option(help="for recovery, as for lcf3d run")] = "geometric",
    tiles: Annotated[int, typer.Option(min=1, help="overlapping tiles across wide images, for onnx: detectors")] = 1,
    missing: Annotated[str, typer.Option(help="results that are not there: error, or empty")] = "error",
    samples: Annotated[
        int, typer.Option(min=0, help="KITTI: draws of the frames for intervals of the gain over the LiDAR alone")
    ] = 0,
    json_: Annotated[bool, typer.Option("--json", help="print the rows as JSON")] = False,
) -> None:
    """Measure the fusion with parts of it switched off or exchanged.

    Rows with detection recovery need LiDAR scans for all frames, mask modes a camera detector with masks.

    Examples:

    lcf3d ablate kitti:KITTI --split val --lidar results:point_gnn --camera results:rcnn

    lcf3d ablate nuscenes:NUSCENES --lidar results:centerpoint.json --camera results:detections_2d.json
    """
    from lcf3d.cli.console import plain, print_json, print_table, tracked
    from lcf3d.evaluation.ablation import ablate as measure
    from lcf3d.evaluation.opening import open_evaluation, usual_frames
    from lcf3d.run.setup import RunRequest, read_inputs
    from lcf3d.run.sources import LidarOnScans
    from lcf3d.run.teaching import find_calibration

    request = RunRequest(
        dataset,
        lidar,
        {"*": camera},
        split,
        tables,
        config=config,
        changes=tuple(set_ or ()),
        localizer=localizer,
        tiles=tiles,
        missing=missing,
    )
    found = read_inputs(request, usual_frames)
    evaluation = open_evaluation(found.dataset, found.frame_ids)
    inputs = detections_of(found)
    scores = find_calibration(calibration, found.dataset, found.frame_ids, found.lidar, found.cameras, found.config)
    progress, suppress = plain if json_ else tracked, isinstance(found.lidar, LidarOnScans)
    rows = measure(inputs, evaluation, found.config, scores, found.localizer, progress, suppress, samples)
    scans = all(item.frame.points is not None for item in inputs)
    if json_:
        print_json({"frames": len(inputs), "scans": scans, "rows": [r.to_json() for r in rows]})
        return
    print_table(ablation_table(rows, evaluation, len(inputs), scans))


def detections_of(found: Inputs) -> list[AblationInput]:
    """Frames with the detections of both branches, read or made now.

    Raises:
        DatasetError: a frame has no image for the camera branch.
    """
    from lcf3d.evaluation.ablation import AblationInput

    inputs = []
    for frame in map(found.dataset.frame, found.frame_ids):
        there = [camera.name for camera in frame.cameras if camera.name in found.cameras]
        seen = {n: found.cameras[n].detect(frame, n) for n in there if found.cameras[n].sees(frame, n)}
        if there and not seen:
            raise DatasetError(f"frame {frame.id} has no image of {' or '.join(there)}; pass results:PATH as --camera")
        inputs.append(AblationInput(frame, found.lidar.detect(frame), seen))
    return inputs


def ablation_table(rows: Sequence[AblationRow], evaluation: Evaluation, frames: int, scans: bool) -> TableData:
    """The rows under their headings; classes without any figure are left out, and their mean is added for many."""
    from lcf3d.evaluation.protocol import TableData

    names = [name for name in rows[0].ap if any(row.ap[name][0] == row.ap[name][0] for row in rows)]
    wide = len(names) > 4
    titles = ("", *names) if wide else tuple(names)
    cells: list[tuple[str, ...] | None] = []
    group = ""
    for row in rows:
        if row.group != group:
            group = row.group
            cells.append((f"{group}:", *("" for _ in range(len(names) + wide + 3))))
        values = [" ".join(f"{value:.1f}" if wide else f"{value:.2f}" for value in row.ap[name]) for name in names]
        if wide:
            known = [row.ap[name][0] for name in names if row.ap[name][0] == row.ap[name][0]]
            values = [f"{sum(known) / max(len(known), 1):.2f}", *values]
        values = [_with_gain(value, row, name) for value, name in zip(values, titles, strict=True)]
        cells.append((f"  {row.name}", *values, str(row.matched), str(row.recovered), str(row.kept)))
    columns = ("mean", *(_short(name) for name in names)) if wide else tuple(names)
    notes = [] if scans else ["not every frame has a LiDAR scan: rows with detection recovery are left out"]
    if any(row.gain for row in rows):
        notes.append("below: moderate AP less that of the LiDAR alone, with 95 % intervals over frames drawn again")
    title = f"{evaluation.heading}, {' '.join(evaluation.columns)}, on {frames} frames"
    return TableData(title, ("variant", *columns, "mat-\nched", "reco-\nvered", "kept"), cells, tuple(notes))


def _with_gain(value: str, row: AblationRow, name: str) -> str:
    """A class's figures, and below them the gain over the LiDAR branch alone with its interval, if there is one."""
    gain = row.gain.get(name)
    return value if gain is None else f"{value}\n{gain.value:+.1f} [{gain.low:+.1f}, {gain.high:+.1f}]"


def _short(name: str) -> str:
    """A class name for a narrow column."""
    return name if len(name) <= 6 else "\n".join(part[:7] for part in name.replace("_", " ").split())
