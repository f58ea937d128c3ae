"""Simulated frames as files in the KITTI object layout."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from lcf3d.files import atomic_path, write_text
from lcf3d.formats.kitti import write_objects
from lcf3d.geometry.rotation import invert_rigid
from lcf3d.simulation.frames import SimulatedFrame
from lcf3d.simulation.labels import label_order
from lcf3d.simulation.presets import KITTI_FOCAL, Preset, kitti_calibration
from lcf3d.structures import FloatArray

IMAGE_FOLDERS: Final = {"left": "image_2", "right": "image_3"}
VAL_EVERY: Final = 5
"""Every fifth frame (or drive) belongs to the split ``val``."""


def frame_paths(root: Path, id: str) -> dict[str, Path]:
    """The files of a frame by folder name; ``label_2`` is the one written last."""
    suffixes = {
        "calib": "txt",
        "velodyne": "bin",
        "image_2": "png",
        "image_3": "png",
        "instance_2": "png",
        "tracks": "txt",
        "label_2": "txt",
    }
    return {folder: root / "training" / folder / f"{id}.{suffix}" for folder, suffix in suffixes.items()}


def is_complete(root: Path, id: str) -> bool:
    """Whether all files of a frame are there (each is written whole or not at all).

    A data set without a right camera has no folder of its images.
    """
    paths = frame_paths(root, id)
    return all(path.exists() for path in paths.values() if path.parent.name != "image_3" or path.parent.is_dir())


def write_frame(root: Path, id: str, simulated: SimulatedFrame) -> None:
    """Write scan, images, calibration, instance ids, track numbers and labels of a frame.

    ``instance_2`` is a 16-bit PNG of the size of the left image whose values are track numbers (0 for
    everything that is no object); line ``k`` of ``tracks`` is the track number of line ``k`` of ``label_2``.
    """
    paths = frame_paths(root, id)
    write_text(paths["calib"], calibration_text(simulated.preset))
    write_bytes(paths["velodyne"], np.ascontiguousarray(simulated.scan.points, dtype="<f4").tobytes())
    for camera, render in simulated.renders.items():
        write_png(paths[IMAGE_FOLDERS[camera]], render.image)
    write_png(paths["instance_2"], simulated.renders["left"].owner.astype(np.uint16))
    order = label_order(
        simulated.actors, simulated.boxes, simulated.sightings["left"], simulated.points_on, simulated.preset.cameras[0]
    )[0]
    write_text(paths["tracks"], "".join(f"{simulated.actors[k].id}\n" for k in order))
    write_objects(paths["label_2"], simulated.kitti)


def write_bytes(path: Path, data: bytes) -> None:
    """Write ``data`` to ``path``, whole or not at all."""
    with atomic_path(path) as temporary:
        temporary.write_bytes(data)


def write_png(path: Path, image: NDArray[np.uint8] | NDArray[np.uint16]) -> None:
    """Write an (H, W, 3) uint8 or (H, W) uint16 image as PNG with light compression."""
    from PIL import Image

    with atomic_path(path) as temporary:
        Image.fromarray(image).save(temporary, format="PNG", compress_level=1)


def calibration_text(preset: Preset) -> str:
    """The calibration file of a preset's frames, with the entries of a real one."""
    scale = np.diag([*(preset.cameras[0].intrinsics.diagonal()[:2] / KITTI_FOCAL), 1.0])
    entries = {n: scale @ m if n.startswith("P") else m for n, m in kitti_calibration().items()}
    lines = [f"{name}: " + " ".join(f"{v:.12e}" for v in matrix.ravel()) for name, matrix in entries.items()]
    return "\n".join(lines) + "\n"


def write_poses(root: Path, drive: str, world_from_lidar: FloatArray, preset: Preset) -> None:
    """Write ``poses/DRIVE.txt``: first camera from the left camera of each of the (F, 4, 4) poses of the LiDAR."""
    camera_from_lidar = preset.cameras[0].camera_from_lidar
    world_from_camera = world_from_lidar @ invert_rigid(camera_from_lidar)
    poses = invert_rigid(world_from_camera[0]) @ world_from_camera
    rows = (" ".join(f"{value:.9e}" for value in pose[:3].ravel()) for pose in poses)
    write_text(root / "poses" / f"{drive}.txt", "".join(f"{row}\n" for row in rows))


def write_splits(root: Path, ids: Sequence[str], frames_per_drive: int) -> None:
    """Write ``ImageSets/train.txt`` and ``val.txt``; no drive is divided unless it is the only one."""
    groups = [list(ids[k : k + frames_per_drive]) for k in range(0, len(ids), frames_per_drive)]
    if len(groups) == 1:
        groups = [[id] for id in ids]
    for name, members in zip(("train", "val"), split_groups(groups), strict=True):
        write_text(root / "ImageSets" / f"{name}.txt", "".join(f"{id}\n" for id in members))


def split_groups(groups: Sequence[list[str]]) -> tuple[list[str], list[str]]:
    """Members of ``train`` and of ``val``: every `VAL_EVERY`-th group is ``val``; of two to four the last.

    A single group is both: a list without members is of no use to anybody.
    """
    every = min(VAL_EVERY, max(1, len(groups)))
    val = [k for k in range(len(groups)) if k % every == every - 1]
    train = [k for k in range(len(groups)) if k not in val] or val
    return [id for k in train for id in groups[k]], [id for k in val for id in groups[k]]
