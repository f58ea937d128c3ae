"""The drive that is shipped with the package: its archive, written by `lcf3d.demo.pack`, read without any extra.

``data/drive.zip`` holds ``drive.json`` (how it was made, the camera's calibration, the names of the frames) and three
members a frame: ``left.webp``; ``points.xz``, the scan as int16 centimetres and uint8 hundredths of intensity, as
differences from point to point, byte planes apart, LZMA; and ``objects.json``, labels and distractors.
"""

from __future__ import annotations

import io
import json
import lzma
import zipfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from lcf3d.errors import FormatError
from lcf3d.structures import Camera, FloatArray, IntArray

DRIVE = Path(__file__).parents[1] / "demo" / "data" / "drive.zip"
BEAM_JUMP_RAD = 0.5


@dataclass(frozen=True, eq=False)
class Objects:
    """Labelled objects of a frame, as parallel arrays.

    Attributes:
        boxes: (N, 7) LiDAR frame.
        class_names: (N,) KITTI's names, ``Van`` and ``Truck`` included.
        tracks: (N,) numbers that an object keeps through the drive.
        boxes2d: (N, 4) bounds of the visible pixels in the left image.
        occluded: (N,) KITTI's levels, 0 visible to 3 almost hidden.
        truncated: (N,) share of the silhouette outside the image.
    """

    boxes: FloatArray
    class_names: NDArray[np.str_]
    tracks: IntArray
    boxes2d: FloatArray
    occluded: IntArray
    truncated: FloatArray


@dataclass(frozen=True, eq=False)
class Distractors:
    """Slim things without a label that a LiDAR detector takes for people: posts, trunks, bushes.

    Attributes:
        boxes: (M, 7) upright boxes around them, LiDAR frame.
        kinds: (M,) ``pole`` or ``bush``.
        ids: (M,) numbers that a thing keeps through the drive.
    """

    boxes: FloatArray
    kinds: NDArray[np.str_]
    ids: IntArray


@dataclass(frozen=True, eq=False)
class ShippedFrame:
    """One moment of the drive.

    Attributes:
        id: name of the frame.
        points: (N, 4) float32 x, y, z and intensity, to the centimetre and hundredth.
        camera: the left camera.
        image: (H, W, 3) uint8.
        objects: labels.
        distractors: what is easily mistaken for them.
    """

    id: str
    points: NDArray[np.float32]
    camera: Camera
    image: NDArray[np.uint8]
    objects: Objects
    distractors: Distractors


def write_drive(path: Path, frames: Sequence[ShippedFrame], made_by: str, quality: int = 80) -> None:
    """Write frames (of one camera) as an archive; equal frames give equal bytes with the same Pillow.

    Args:
        path: of the archive.
        frames: the drive.
        made_by: the command that makes the archive, kept in it.
        quality: of the WebP images.
    """
    from lcf3d.files import atomic_path
    from lcf3d.geometry.camera import require_pinhole

    camera = frames[0].camera
    require_pinhole(camera, "the demo's archive")
    about = {
        "made_by": made_by,
        "camera": {
            "name": camera.name,
            "projection": camera.projection.tolist(),
            "camera_from_lidar": camera.camera_from_lidar.tolist(),
            "size": [camera.width, camera.height],
        },
        "frames": [frame.id for frame in frames],
    }
    with atomic_path(path) as temporary, zipfile.ZipFile(temporary, "w") as archive:
        _add(archive, "drive.json", json.dumps(about, indent=1).encode())
        for frame in frames:
            picture = io.BytesIO()
            Image.fromarray(frame.image).save(picture, format="WEBP", quality=quality, method=6)
            _add(archive, f"{frame.id}/left.webp", picture.getvalue())
            _add(archive, f"{frame.id}/points.xz", encode_points(frame.points))
            _add(archive, f"{frame.id}/objects.json", _encode_objects(frame))


def read_drive(path: Path = DRIVE, count: int | None = None) -> list[ShippedFrame]:
    """The frames of an archive, the first ``count`` of them only if given.

    Raises:
        FormatError: the archive is absent, damaged or incomplete.
    """
    try:
        with zipfile.ZipFile(path) as archive:
            about = json.loads(archive.read("drive.json"))
            made = about["camera"]
            camera = Camera(
                made["name"], np.array(made["projection"]), np.array(made["camera_from_lidar"]), *made["size"]
            )
            return [_read_frame(archive, name, camera) for name in about["frames"][:count]]
    except (OSError, zipfile.BadZipFile, lzma.LZMAError, EOFError, KeyError, TypeError, ValueError) as error:
        raise FormatError(
            f"the demo's drive {path} is missing or damaged ({error}); install lcf3d again to restore it"
        ) from error


def encode_points(points: NDArray[np.float32]) -> bytes:
    """(N, 4) points as compressed bytes; the inverse of `decode_points` but for rounding."""
    rounded = np.concatenate([np.zeros((1, 4)), np.round(points * 100)]).astype(np.int16)
    steps = rounded[1:] - rounded[:-1]
    planes = np.concatenate([(steps & 255).T, (steps[:, :3] >> 8).T & 255]).astype(np.uint8)
    return lzma.compress(planes.tobytes(), preset=9 | lzma.PRESET_EXTREME)


def decode_points(data: bytes) -> NDArray[np.float32]:
    """(N, 4) float32 points from compressed bytes.

    Raises:
        ValueError: the bytes are not those of a whole number of points.
        lzma.LZMAError: they cannot be decompressed.
    """
    planes = np.frombuffer(lzma.decompress(data), dtype=np.uint8).reshape(7, -1).astype(np.uint16)
    steps = planes[:4].T.copy()
    steps[:, :3] |= planes[4:].T << 8
    total = np.cumsum(steps, axis=0, dtype=np.uint16)
    total[:, 3] &= 255  # intensity has one byte only
    return (total.view(np.int16) / np.float32(100)).astype(np.float32)


def beam_numbers(points: NDArray[np.float32]) -> IntArray:
    """(N,) beam of each point of a drive's scan, 0 the highest.

    Scans are kept beam after beam, each from left to right; where the azimuth jumps back to the left, a beam begins.
    """
    azimuth = np.arctan2(points[:, 1], points[:, 0])
    begins = np.diff(azimuth, prepend=azimuth[:1]) > BEAM_JUMP_RAD
    return np.cumsum(begins).astype(np.int64)


def every_beam(points: NDArray[np.float32], step: int) -> NDArray[np.float32]:
    """What a LiDAR with one in ``step`` of the beams sees of the same street: the points of those beams."""
    return points if step == 1 else points[beam_numbers(points) % step == 0]


def _add(archive: zipfile.ZipFile, name: str, data: bytes) -> None:
    # the default date of a ZipInfo is fixed, so that equal content gives equal archives
    archive.writestr(zipfile.ZipInfo(name), data, zipfile.ZIP_STORED)


def _encode_objects(frame: ShippedFrame) -> bytes:
    o, d = frame.objects, frame.distractors
    values: dict[str, Any] = {
        "boxes": np.round(o.boxes, 3).tolist(),
        "class_names": o.class_names.tolist(),
        "tracks": o.tracks.tolist(),
        "boxes2d": np.round(o.boxes2d, 1).tolist(),
        "occluded": o.occluded.tolist(),
        "truncated": np.round(o.truncated, 2).tolist(),
    }
    things = {"boxes": np.round(d.boxes, 2).tolist(), "kinds": d.kinds.tolist(), "ids": d.ids.tolist()}
    return json.dumps({"objects": values, "distractors": things}).encode()


def _read_frame(archive: zipfile.ZipFile, name: str, camera: Camera) -> ShippedFrame:
    image = np.asarray(Image.open(io.BytesIO(archive.read(f"{name}/left.webp"))).convert("RGB"))
    told = json.loads(archive.read(f"{name}/objects.json"))
    o, d = told["objects"], told["distractors"]
    objects = Objects(
        np.array(o["boxes"], dtype=np.float64).reshape(-1, 7),
        np.array(o["class_names"], dtype=np.str_),
        np.array(o["tracks"], dtype=np.int64),
        np.array(o["boxes2d"], dtype=np.float64).reshape(-1, 4),
        np.array(o["occluded"], dtype=np.int64),
        np.array(o["truncated"], dtype=np.float64),
    )
    things = Distractors(
        np.array(d["boxes"], dtype=np.float64).reshape(-1, 7),
        np.array(d["kinds"], dtype=np.str_),
        np.array(d["ids"], dtype=np.int64),
    )
    return ShippedFrame(name, decode_points(archive.read(f"{name}/points.xz")), camera, image, objects, things)
