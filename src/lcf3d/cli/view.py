"""``lcf3d view``: frames of a dataset, or of a run with its reasons, as PNG pictures."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from lcf3d.errors import ConfigError, DatasetError

if TYPE_CHECKING:
    from lcf3d.datasets.base import CameraSource, Dataset, LidarSource
    from lcf3d.frame import Frame
    from lcf3d.visualization.scene import Scene


def view(
    source: Annotated[str, typer.Argument(help="kind:ROOT, for example kitti:ROOT, or a folder written by lcf3d run")],
    frame: Annotated[list[str] | None, typer.Option(help="this frame; repeatable; a run's frames if left out")] = None,
    results: Annotated[
        Path | None, typer.Option(help="what to draw: a run folder, or results in the form of the dataset")
    ] = None,
    out: Annotated[
        Path | None, typer.Option(help="a .png file for one frame, else a folder; by default ID.png or RUN/pictures")
    ] = None,
    truth: Annotated[bool, typer.Option(help="also draw the ground truth, thin and white")] = True,
    limit: Annotated[
        int, typer.Option(min=0, help="of frames that are not named draw the first so many; 0 draws all of them")
    ] = 50,
    min_score: Annotated[float, typer.Option(help="leave out boxes of a lower score")] = float("-inf"),
    gif: Annotated[
        Path | None, typer.Option(help="no pictures but one that moves: a .gif file, with the trails of tracks")
    ] = None,
    rerun: Annotated[
        str | None,
        typer.Option(help="no pictures but a Rerun recording: a .rrd file, or viewer to open it (run folders)"),
    ] = None,
) -> None:
    """Draw frames: images with boxes coloured by stage, and the bird's-eye view.

    Examples:

    lcf3d view fused/

    lcf3d view fused/ --frame 000008 --out picture.png

    lcf3d view kitti:KITTI --frame 000008 --results fused/

    lcf3d view fused/ --limit 100 --gif fused.gif

    lcf3d view fused/ --rerun fused.rrd
    """
    from rich.progress import Progress

    from lcf3d.datasets.opening import open_dataset
    from lcf3d.remote.places import local
    from lcf3d.visualization.png import draw_frame, save_gif, save_png

    run_folder = _run_folder(source)
    if run_folder and results:
        raise ConfigError(f"{source} is a run folder and holds its own results; leave --results out")
    dataset = _open_run(run_folder) if run_folder else open_dataset(source)
    shown = run_folder or (None if results is None else local(results))
    ids, more = _frame_ids(dataset, frame or [], shown, limit)
    rest = f", {more} more with --limit 0" if more else ""
    if rerun is not None:
        place = _record(dataset, shown, ids, None if rerun == "viewer" else Path(rerun), truth)
        typer.echo(f"{len(ids)} frames in {place}{rest}")
        return
    scene_of = _scenes(dataset, shown, truth, min_score, ids[0])
    if gif is not None:
        if gif.suffix.lower() != ".gif" or out is not None:
            raise ConfigError(f"--gif takes a file that ends in .gif and goes without --out, got {gif}")
        with Progress(disable=len(ids) < 2) as progress:
            frames = (dataset.frame(frame_id) for frame_id in progress.track(ids, description="drawing"))
            save_gif(((frame.timestamp, draw_frame(frame, scene_of(frame))) for frame in frames), gif)
        typer.echo(f"{len(ids)} frames in {gif}{rest}")
        return
    paths = _paths(ids, out, run_folder)
    with Progress(disable=len(ids) < 2) as progress:
        for frame_id in progress.track(ids, description="drawing"):
            item = dataset.frame(frame_id)
            save_png(draw_frame(item, scene_of(item)), paths[frame_id])
    typer.echo(str(paths[ids[0]] if len(ids) == 1 else f"{len(ids)} pictures in {paths[ids[0]].parent}{rest}"))


def _record(dataset: Dataset, shown: Path | None, ids: Sequence[str], path: Path | None, truth: bool) -> str:
    """The frames of a run into a Rerun recording or viewer; gives where they are."""
    from rich.progress import Progress

    from lcf3d.run.folder import RunFolder
    from lcf3d.run.table_folder import open_run_folder
    from lcf3d.visualization.rerun_log import RerunLog

    if shown is None or not RunFolder.is_run(shown):
        raise ConfigError("--rerun shows a run with its reasons: name a folder written by lcf3d run")
    if path is not None and path.suffix != ".rrd":
        raise ConfigError(f"--rerun takes a file that ends in .rrd, or viewer, got {path}")
    folder = open_run_folder(shown)
    log = RerunLog(path, dataset.used_cameras)
    with Progress(disable=len(ids) < 2) as progress:
        for frame_id in progress.track(ids, description="recording"):
            frame = dataset.frame(frame_id)
            log.log(frame, folder.read(frame_id), truth=frame.labels if truth else None)
    log.close()
    return str(path or "the viewer")


def _run_folder(source: str) -> Path | None:
    """The path, if it is a folder written by ``lcf3d run``."""
    from lcf3d.remote.places import local
    from lcf3d.remote.urls import is_url
    from lcf3d.run.folder import RunFolder

    path = local(source) if is_url(source) else Path(source).expanduser()
    if RunFolder.is_run(path):
        return path
    if (":" not in source or is_url(source)) and not path.exists():
        raise ConfigError(f"{source} does not exist; view takes kind:ROOT or a folder of lcf3d run")
    return None


def _open_run(run_folder: Path) -> Dataset:
    """The dataset that a run was made from."""
    from lcf3d.datasets.opening import open_dataset
    from lcf3d.run.folder import RunFolder

    run = RunFolder(run_folder).request()
    dataset = run.get("dataset")
    instead = f"name it: lcf3d view kind:ROOT --results {run_folder}"
    if not isinstance(dataset, str):
        raise ConfigError(f"{run_folder / 'run.json'} does not say what dataset was run; {instead}")
    try:
        return open_dataset(dataset, split=run.get("split"), version=run.get("tables", run.get("version")))
    except DatasetError as error:
        raise ConfigError(f"the dataset of this run is not there ({error}); {instead}") from None


def _frame_ids(dataset: Dataset, chosen: Sequence[str], shown: Path | None, limit: int) -> tuple[list[str], int]:
    """The frames to draw: those chosen, else the first of the run; and how many more the run has."""
    from lcf3d.datasets.base import require_frames
    from lcf3d.run.folder import RunFolder
    from lcf3d.run.table_folder import open_run_folder

    most = None
    if not chosen:
        most = limit or None
        if shown is None or not RunFolder.is_run(shown):
            raise ConfigError(
                f"name the frames to draw with --frame, for example --frame {dataset.ids[0]}; "
                "without it, view draws the frames of a run folder"
            )
        chosen = open_run_folder(shown).frame_ids()
        if not chosen:
            raise ConfigError(f"{shown} holds no finished frames yet")
    ids = list(require_frames(dataset, chosen, "the dataset"))
    return ids[:most], len(ids[most:]) if most else 0


def _scenes(
    dataset: Dataset, shown: Path | None, truth: bool, min_score: float, first: str
) -> Callable[[Frame], Scene]:
    """What to draw over a frame."""
    from lcf3d.run.folder import RunFolder
    from lcf3d.run.table_folder import open_run_folder
    from lcf3d.structures import Detections3D
    from lcf3d.visualization.scene import Scene
    from lcf3d.visualization.trails import Trails

    if shown is not None and not shown.exists():
        raise ConfigError(f"{shown} does not exist; --results takes a run folder or result files of the dataset's form")
    if shown is None:
        return lambda frame: Scene.from_detections(Detections3D.empty(()), truth=frame.labels if truth else None)
    if RunFolder.is_run(shown):
        folder = open_run_folder(shown)
        trails = Trails()

        def fused_scene(frame: Frame) -> Scene:
            fused = folder.read(frame.id)
            return Scene.from_fused(fused, frame.labels if truth else None, min_score, trails(frame, fused))

        return fused_scene
    boxes, flat = _result_readers(dataset, shown, first)

    def scene(frame: Frame) -> Scene:
        found = boxes.detect(frame) if boxes is not None else Detections3D.empty(dataset.class_names)
        seen = {c.name: flat.detect(frame, c.name) for c in frame.cameras[:1]} if flat is not None else {}
        return Scene.from_detections(found, seen, frame.labels if truth else None, min_score)

    return scene


def _result_readers(dataset: Dataset, path: Path, first: str) -> tuple[LidarSource | None, CameraSource | None]:
    """Result files as 3D detections, or as 2D detections where they hold no 3D boxes."""
    try:
        lidar = dataset.lidar_results(path, dataset.class_names)
        lidar.detect(dataset.frame(first))
        return lidar, None
    except DatasetError as error:
        if "no 3D boxes" not in str(error):
            raise
        return None, dataset.camera_results(path, dataset.class_names)


def _paths(ids: Sequence[str], out: Path | None, run_folder: Path | None) -> dict[str, Path]:
    """Where each picture goes."""
    if out is not None and out.suffix.lower() == ".png" and not out.is_dir():
        if len(ids) > 1:
            raise ConfigError(f"--out {out} is one file, but {len(ids)} frames are to be drawn; pass a folder")
        return {ids[0]: out}
    if out is not None and out.is_file():
        raise ConfigError(f"--out must be a .png file or a folder, got the file {out}")
    folder = out or (run_folder / "pictures" if run_folder else Path())
    return {frame_id: folder / f"{frame_id}.png" for frame_id in ids}
