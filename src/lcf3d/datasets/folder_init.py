"""A first ``sensors.yaml`` from what lies in a folder; what cannot be seen in files is left as a value to correct."""

from __future__ import annotations

from collections import Counter
from pathlib import Path

import numpy as np

from lcf3d.datasets.folder_files import IMAGE_SUFFIXES, times_of
from lcf3d.datasets.folder_poses import AXES, ground_of
from lcf3d.datasets.folder_results import CAMERAS, COCO, KITTI, FolderLabels, form_of
from lcf3d.datasets.folder_sensors import CANONICAL_AXES, FILE, CameraSetup, LidarSetup, Sensors, canonical_from_axes
from lcf3d.datasets.images import image_size
from lcf3d.errors import ConfigError, DatasetError, Lcf3dError
from lcf3d.formats.point_files import SUFFIXES, column_count, read_scan

_FORWARD_CAMERA = ((0.0, -1.0, 0.0, 0.0), (0.0, 0.0, -1.0, 0.0), (1.0, 0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0))
_FIELD_OF_VIEW = np.deg2rad(70.0)
_COLUMNS = ("x", "y", "z", "intensity", "ring", "time")
_HEADING = """\
# Written by 'lcf3d init'. What no file tells was guessed and must be corrected:
{guessed}# Then look: lcf3d check folder:{root} --picture check.png
"""


def init_folder(root: Path, overwrite: bool = False) -> tuple[Sensors, list[str]]:
    """Write ``ROOT/sensors.yaml``.

    Args:
        root: the folder.
        overwrite: whether one that is there is replaced.

    Returns:
        What was written, and what in it was guessed.

    Raises:
        ConfigError: there is one already.
        DatasetError: the folder does not exist or holds neither images nor scans.
    """
    if not root.is_dir():
        raise DatasetError(f"{root} is no folder")
    if (root / FILE).exists() and not overwrite:
        raise ConfigError(f"{root / FILE} exists; pass --overwrite to replace it")
    folders = [path for path in sorted(root.rglob("*")) if path.is_dir() and not _hidden(path.relative_to(root))]
    folders.append(root)
    labels = [path for path in folders if _is_labels(path)]
    guessed: list[str] = []
    lidars = {
        _name(path, root, "lidar"): _lidar(path, root, guessed)
        for path in folders
        if path not in labels and _count(path, SUFFIXES)
    }
    cameras = {
        _name(path, root, "camera"): _camera(path, root, guessed) for path in folders if _count(path, IMAGE_SUFFIXES)
    }
    if not lidars and not cameras:
        raise DatasetError(
            f"{root} holds neither images ({', '.join(IMAGE_SUFFIXES)}) nor scans ({', '.join(SUFFIXES)})"
        )
    values: dict[str, object] = {"lidars": lidars, "cameras": cameras}
    tables = [path for path in sorted(root.glob("*.parquet")) if path.stem.startswith("label")]
    for path in (*labels, *tables):
        kind = "labels_2d" if form_of(path) in (COCO, CAMERAS) else "labels"
        values.setdefault(kind, str(path.relative_to(root)))
    if "labels" in values:
        values["classes"] = _classes(root / str(values["labels"]))
    values["match"] = _match(root, lidars, cameras)
    for name in ("timestamps", "poses"):
        found = next((p for p in sorted(root.glob(f"{name}.*")) if p.suffix in (".txt", ".csv")), None)
        if found is not None:
            values[name] = found.name
    sensors = Sensors.model_validate({name: value for name, value in values.items() if value})
    heading = _HEADING.format(guessed="".join(f"#   - {what}\n" for what in guessed), root=root)
    sensors.dump(root / FILE, heading)
    return sensors, guessed


def _hidden(path: Path) -> bool:
    return any(part.startswith(".") for part in path.parts)


def _count(folder: Path, suffixes: tuple[str, ...]) -> int:
    return sum(path.suffix.lower() in suffixes for path in folder.iterdir() if path.is_file())


def _is_labels(folder: Path) -> bool:
    return folder.name.lower().startswith(("label", "annotation")) and bool(_count(folder, (".txt", ".json")))


def _name(folder: Path, root: Path, usual: str) -> str:
    """Of a sensor: the path of its folder without what is in the way."""
    parts = [
        part for part in folder.relative_to(root).parts if part.lower() not in ("data", "images", "scans", "image")
    ]
    return "_".join(parts) or usual


def _lidar(folder: Path, root: Path, guessed: list[str]) -> LidarSetup:
    first = next(path for path in sorted(folder.iterdir()) if path.suffix.lower() in SUFFIXES)
    columns = list(_COLUMNS[:4])
    name = _name(folder, root, "lidar")
    if first.suffix.lower() == ".bin":
        columns = list(_COLUMNS[: column_count(first)])
        guessed.append(f"{name}: columns of the .bin files, from their numbers")
    points = read_scan(first, columns)
    most = float(points[:, 3].max()) if len(points) else 0.0
    scale = 1.0 if most <= 1.5 else round(1 / 255, 7) if most <= 256 else round(1 / 65535, 9)
    axes = CANONICAL_AXES
    ground = ground_of(points)
    if ground is not None:
        normal = np.zeros(3)
        normal[ground[0]] = -np.sign(ground[1])
        axes = next((a for a in AXES if (canonical_from_axes(a) @ normal)[2] > 0.5), CANONICAL_AXES)
    guessed.append(f"{name}: axes {axes}" + (", of which the ground tells which is up" if ground is not None else ""))
    return LidarSetup(scans=str(folder.relative_to(root)), columns=columns, intensity_scale=scale, axes=axes)


def _camera(folder: Path, root: Path, guessed: list[str]) -> CameraSetup:
    first = next(path for path in sorted(folder.iterdir()) if path.suffix.lower() in IMAGE_SUFFIXES)
    width, height = image_size(first)
    focal = round(width / 2 / np.tan(_FIELD_OF_VIEW / 2), 1)
    name = _name(folder, root, "camera")
    guessed.append(f"{name}: intrinsics (70 degrees of view), no distortion, camera_from_lidar (looks forward)")
    return CameraSetup.model_validate(
        {
            "images": str(folder.relative_to(root)),
            "size": (width, height),
            "intrinsics": [focal, focal, width / 2, height / 2],
            "camera_from_lidar": _FORWARD_CAMERA,
        }
    )


def _classes(path: Path) -> list[str]:
    """Classes of the labels, the most frequent first."""
    source = FolderLabels(path, (), np.eye(4))
    ids = sorted(file.stem for file in path.iterdir()) if path.is_dir() else []
    counts = Counter(source.class_counts(ids))
    names = [name for name, _ in counts.most_common() if name not in ("DontCare", "Misc")]
    if source.form == KITTI and names:
        # what KITTI's tools evaluate, if it is there
        names = [name for name in ("Car", "Pedestrian", "Cyclist") if name in names] or names
    return names


def _match(root: Path, lidars: dict[str, LidarSetup], cameras: dict[str, CameraSetup]) -> str:
    """``time`` where names are times that differ from sensor to sensor, else ``name``."""
    names = [
        {path.stem for path in (root / folder).iterdir() if path.suffix.lower() in (*SUFFIXES, *IMAGE_SUFFIXES)}
        for folder in (*(s.scans for s in lidars.values()), *(s.images for s in cameras.values()))
    ]
    shared = all(len(names[0] & other) * 2 > min(len(names[0]), len(other)) for other in names)
    if shared:
        return "name"
    try:
        return "time" if all(times_of(other) is not None for other in names) else "name"
    except Lcf3dError:
        return "name"
