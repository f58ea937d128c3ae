"""``lcf3d view``: frames of a dataset, or of a run with its reasons, as PNG pictures."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from lcf3d.errors import ConfigError, DatasetError

if TYPE_CHECKING:
    from lcf3d.datasets.kitti import KittiDataset
    from lcf3d.datasets.nuscenes import NuscenesDataset
    from lcf3d.structures import Frame
    from lcf3d.visualization.scene import Scene


def view(
    source: Annotated[str, typer.Argument(help="kitti:ROOT, nuscenes:ROOT, or a folder written by lcf3d run")],
    frame: Annotated[list[str] | None, typer.Option(help="this frame; repeatable; a run's frames if left out")] = None,
    results: Annotated[
        Path | None, typer.Option(help="what to draw: a run folder, KITTI result files or a nuScenes JSON")
    ] = None,
    out: Annotated[
        Path | None, typer.Option(help="a .png file for one frame, else a folder; by default ID.png or RUN/pictures")
    ] = None,
    truth: Annotated[bool, typer.Option(help="also draw the ground truth, thin and white")] = True,
    limit: Annotated[int | None, typer.Option(min=1, help="draw at most so many frames")] = None,
    min_score: Annotated[float, typer.Option(help="leave out boxes of a lower score")] = float("-inf"),
) -> None:
    """Draw frames: images with boxes coloured by stage, and the bird's-eye view.

    Examples:

    lcf3d view fused/

    lcf3d view fused/ --frame 000008 --out picture.png

    lcf3d view kitti:KITTI --frame 000008 --results fused/
    """
    from rich.progress import Progress

    from lcf3d.visualization.png import draw_frame, save_png

    run_folder = _run_folder(source)
    if run_folder and results:
        raise ConfigError(f"{source} is a run folder and holds its own results; leave --results out")
    dataset = _open_run(run_folder) if run_folder else _open(source)
    shown = run_folder or results
    ids = _frame_ids(dataset, frame or [], shown, limit)
    scene_of = _scenes(dataset, shown, truth, min_score)
    paths = _paths(ids, out, run_folder)
    with Progress(disable=len(ids) < 2) as progress:
        for frame_id in progress.track(ids, description="drawing"):
            item = dataset.frame(frame_id)
            save_png(draw_frame(item, scene_of(item)), paths[frame_id])
    typer.echo(str(paths[ids[0]] if len(ids) == 1 else f"{len(ids)} pictures in {paths[ids[0]].parent}"))


def _run_folder(source: str) -> Path | None:
    """The path, if it is a folder written by ``lcf3d run``."""
    path = Path(source)
    if _is_run(path):
        return path
    if ":" not in source and not path.is_dir():
        raise ConfigError(f"{source} does not exist; view takes kitti:ROOT, nuscenes:ROOT or a folder of lcf3d run")
    return None


def _is_run(path: Path) -> bool:
    return (path / "run.json").is_file() and (path / "provenance").is_dir()


def _open_run(run_folder: Path) -> KittiDataset | NuscenesDataset:
    """The dataset that a run was made from."""
    from lcf3d.files import read_json

    run = read_json(run_folder / "run.json")
    dataset = run.get("dataset") if isinstance(run, dict) else None
    instead = f"name it: lcf3d view kitti:ROOT --results {run_folder}"
    if not isinstance(dataset, str):
        raise ConfigError(f"{run_folder / 'run.json'} does not say what dataset was run; {instead}")
    try:
        return _open(dataset)
    except DatasetError as error:
        raise ConfigError(f"the dataset of this run is not there ({error}); {instead}") from None


def _open(text: str) -> KittiDataset | NuscenesDataset:
    from lcf3d.datasets.opening import parse_dataset

    kind, root = parse_dataset(text)
    if kind == "kitti":
        from lcf3d.datasets.kitti import KittiDataset

        return KittiDataset(root)
    from lcf3d.datasets.nuscenes import NuscenesDataset

    return NuscenesDataset(root, late_cameras="drop")


def _frame_ids(
    dataset: KittiDataset | NuscenesDataset, chosen: Sequence[str], shown: Path | None, limit: int | None
) -> list[str]:
    """The frames to draw: those chosen, else those of the run."""
    if not chosen:
        if shown is None or not _is_run(shown):
            raise ConfigError(
                f"name the frames to draw with --frame, for example --frame {dataset.ids[0]}; "
                "without it, view draws the frames of a run folder"
            )
        chosen = sorted(path.stem for path in (shown / "provenance").glob("*.json"))
        if not chosen:
            raise ConfigError(f"{shown} holds no finished frames yet")
    known = set(dataset.ids)
    for frame_id in chosen:
        if frame_id not in known:
            raise ConfigError(f"the dataset has no frame {frame_id!r}; its first is {dataset.ids[0]}")
    return list(dict.fromkeys(chosen))[:limit]


def _scenes(
    dataset: KittiDataset | NuscenesDataset, shown: Path | None, truth: bool, min_score: float
) -> Callable[[Frame], Scene]:
    """What to draw over a frame."""
    from lcf3d.datasets.kitti import KittiDataset
    from lcf3d.structures import Detections3D
    from lcf3d.visualization.scene import Scene

    if shown is not None and not shown.exists():
        raise ConfigError(f"{shown} does not exist; --results takes a run folder, KITTI result files or nuScenes JSON")
    if shown is None:
        return lambda frame: Scene.from_detections(Detections3D.empty(()), truth=frame.labels if truth else None)
    if _is_run(shown):
        from lcf3d.run.folder import RunFolder

        folder = RunFolder(shown)
        return lambda frame: Scene.from_fused(folder.read(frame.id), frame.labels if truth else None, min_score)
    if isinstance(dataset, KittiDataset):
        return _kitti_scenes(dataset, shown, truth, min_score)
    return _nuscenes_scenes(dataset, shown, truth, min_score)


def _kitti_scenes(dataset: KittiDataset, folder: Path, truth: bool, min_score: float) -> Callable[[Frame], Scene]:
    """KITTI result files: 3D boxes where they have them, else 2D boxes in the left camera."""
    from lcf3d.formats.kitti import detections_2d, detections_3d, read_objects
    from lcf3d.visualization.scene import Scene

    folder = folder / "data" if (folder / "data").is_dir() else folder

    def scene(frame: Frame) -> Scene:
        objects = read_objects(folder / f"{frame.id}.txt", results=True)
        camera = frame.cameras[0]
        flat = objects[~objects.has_box3d]
        return Scene.from_detections(
            detections_3d(objects, camera.camera_from_lidar, dataset.class_names),
            {camera.name: detections_2d(flat, dataset.class_names)} if len(flat) else {},
            frame.labels if truth else None,
            min_score,
        )

    return scene


def _nuscenes_scenes(dataset: NuscenesDataset, path: Path, truth: bool, min_score: float) -> Callable[[Frame], Scene]:
    """A nuScenes submission file."""
    from lcf3d.formats.nuscenes import read_submission
    from lcf3d.formats.nuscenes_boxes import detections_from_global, split_by_sample
    from lcf3d.visualization.scene import Scene

    boxes = split_by_sample(read_submission(path)[0])

    def scene(frame: Frame) -> Scene:
        if frame.id not in boxes:
            raise ConfigError(f"{path} has no results for sample {frame.id}")
        found = detections_from_global(boxes[frame.id], dataset.lidar_from_global(frame.id))
        return Scene.from_detections(found, truth=frame.labels if truth else None, least_score=min_score)

    return scene


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
