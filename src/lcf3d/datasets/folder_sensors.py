"""``sensors.yaml``: what the sensors of a plain folder are, where their files lie and how they stand to each other.

Axes are named by where they point: ``forward-left-up`` (ROS vehicles and most scanners, lcf3d's own),
``right-forward-up`` (nuScenes' LiDAR), ``right-down-forward`` (cameras), ``forward-right-down`` (aircraft). A pose is
16 or 12 numbers of a matrix, rows of it, or ``{rotation: [w, x, y, z], translation: [x, y, z]}``.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import yaml
from pydantic import AfterValidator, BaseModel, BeforeValidator, ConfigDict, Field, ValidationError

from lcf3d.distortion import Distortion, LensModel
from lcf3d.errors import ConfigError, DatasetError, FormatError, Lcf3dError
from lcf3d.files import write_text
from lcf3d.geometry.rotation import invert_rigid, rotation_matrices
from lcf3d.structures import KITTI_CLASSES, Camera, FloatArray

FILE = "sensors.yaml"
CANONICAL_AXES = "forward-left-up"
CAMERA_AXES = "right-down-forward"
_DIRECTIONS = {
    "forward": (1, 0, 0), "back": (-1, 0, 0), "left": (0, 1, 0), "right": (0, -1, 0), "up": (0, 0, 1),
    "down": (0, 0, -1),
}  # fmt: skip
# a rotation written with few digits is still one
_RIGID_TOLERANCE = 1e-2


def canonical_from_axes(axes: str) -> FloatArray:
    """(3, 3) forward-left-up coordinates from those of the named axes.

    Raises:
        ValueError: not three directions at right angles.
    """
    words = axes.split("-")
    if len(words) != 3 or any(word not in _DIRECTIONS for word in words):
        raise ValueError(f"axes must be three of {', '.join(_DIRECTIONS)}, as in {CANONICAL_AXES}, got {axes!r}")
    matrix = np.array([_DIRECTIONS[word] for word in words], dtype=np.float64).T
    if abs(np.linalg.det(matrix)) < 0.5:
        raise ValueError(f"axes must point along three different lines, got {axes!r}")
    return matrix


def _checked_axes(axes: str) -> str:
    canonical_from_axes(axes)
    return axes


def _pose(value: Any) -> list[list[float]]:
    """Rows of a (4, 4) rigid transform from any of the forms."""
    try:
        if isinstance(value, dict):
            if set(value) != {"rotation", "translation"}:
                raise ValueError("a pose must have rotation and translation, nothing else")
            matrix = np.eye(4)
            rotation = np.asarray(value["rotation"], dtype=np.float64)
            matrix[:3, :3] = rotation_matrices(rotation[None])[0] if rotation.shape == (4,) else rotation.reshape(3, 3)
            matrix[:3, 3] = np.asarray(value["translation"], dtype=np.float64)
        else:
            numbers = np.asarray(value, dtype=np.float64).ravel()
            if len(numbers) not in (12, 16):
                raise ValueError(f"a pose must be 12 or 16 numbers, got {len(numbers)}")
            matrix = np.vstack([numbers.reshape(-1, 4), np.eye(4)[3:]])[:4]
    except TypeError:
        raise ValueError("a pose must be numbers") from None
    rotation = matrix[:3, :3]
    off = np.abs(rotation @ rotation.T - np.eye(3)).max() if np.isfinite(matrix).all() else np.inf
    if off > _RIGID_TOLERANCE or np.abs(matrix[3] - [0, 0, 0, 1]).max() > 1e-6:
        raise ValueError("a pose must be a rotation and a translation; the rows of this one are not at right angles")
    return [[float(v) for v in row] for row in matrix]


def _matrix(value: Any) -> list[list[float]]:
    """Rows of a (3, 3) camera matrix from itself or from fx, fy, cx, cy."""
    try:
        numbers = np.asarray(value, dtype=np.float64).ravel()
    except (TypeError, ValueError):
        raise ValueError("intrinsics must be numbers") from None
    if len(numbers) == 4:
        fx, fy, cx, cy = numbers
        numbers = np.array([fx, 0, cx, 0, fy, cy, 0, 0, 1])
    if len(numbers) != 9:
        raise ValueError(f"intrinsics must be fx, fy, cx, cy or the 9 numbers of K, got {len(numbers)} numbers")
    if not (numbers[0] > 0 and numbers[4] > 0 and numbers[8] == 1 and not numbers[6:8].any()):
        raise ValueError("intrinsics must have positive focal lengths and the last row 0 0 1")
    return [[float(v) for v in row] for row in numbers.reshape(3, 3)]


Axes = Annotated[str, AfterValidator(_checked_axes)]
Pose = Annotated[list[list[float]], BeforeValidator(_pose)]


class _Model(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid")


class Lens(_Model):
    """Lens distortion, see `lcf3d.distortion`."""

    model: LensModel
    coefficients: list[float]


class CameraSetup(_Model):
    """A camera.

    Attributes:
        images: folder of the images.
        intrinsics: fx, fy, cx, cy or K.
        size: width and height; that of the first image without it.
        distortion: of the lens; none for a pinhole camera.
        camera_from_lidar: camera coordinates from those of the first LiDAR.
        ego_from_sensor: coordinates of the vehicle from those of the camera; instead.
        axes: of the camera coordinates in those poses.
    """

    images: str
    intrinsics: Annotated[list[list[float]], BeforeValidator(_matrix)]
    size: tuple[int, int] | None = None
    distortion: Lens | None = None
    camera_from_lidar: Pose | None = None
    ego_from_sensor: Pose | None = None
    axes: Axes = CAMERA_AXES


class LidarSetup(_Model):
    """A LiDAR.

    Attributes:
        scans: folder of the scans.
        columns: of ``.bin`` and plain ``.npy`` files.
        intensity_scale: factor that brings intensities to 0 to 1.
        axes: of the scans.
        ego_from_sensor: coordinates of the vehicle from those of the LiDAR, both as they are; equal without it.
    """

    scans: str
    columns: list[str] = ["x", "y", "z", "intensity"]
    intensity_scale: float = 1.0
    axes: Axes = CANONICAL_AXES
    ego_from_sensor: Pose | None = None


class Sensors(_Model):
    """All of ``sensors.yaml``.

    Attributes:
        cameras: by name.
        lidars: by name; boxes and results are in the frame of the first, turned to forward-left-up.
        classes: names of the classes.
        ego_axes: of the vehicle's coordinates.
        labels: folder or file of 3D labels.
        label_axes: of the labels, in the first LiDAR's frame; not of KITTI's text, which is in the first camera's.
        labels_2d: folder or file of 2D labels, for the check.
        coco_index: COCO file with the ``images`` and ``categories`` of COCO result lists.
        timestamps: file with the time of every frame, seconds.
        poses: file with the pose of every frame.
        poses_of: what the poses are of, the first LiDAR or the vehicle.
        match: how files of different sensors come together: equal names, or the nearest time.
        max_delay_s: with ``match: time``, the longest accepted time between a scan and an image.
    """

    cameras: dict[str, CameraSetup] = {}
    lidars: dict[str, LidarSetup] = {}
    classes: Annotated[list[str], Field(min_length=1)] = list(KITTI_CLASSES)
    ego_axes: Axes = CANONICAL_AXES
    labels: str | None = None
    label_axes: Axes = CANONICAL_AXES
    labels_2d: str | None = None
    coco_index: str | None = None
    timestamps: str | None = None
    poses: str | None = None
    poses_of: Literal["lidar", "ego"] = "lidar"
    match: Literal["name", "time"] = "name"
    max_delay_s: Annotated[float, Field(gt=0)] = 0.05

    @classmethod
    def load(cls, root: Path) -> Sensors:
        """From ``ROOT/sensors.yaml``.

        Raises:
            DatasetError: there is none.
            ConfigError: it is no YAML, has an unknown key, lacks one, or a value makes no sense; one sentence.
        """
        path = root / FILE
        try:
            values = yaml.safe_load(path.read_text(encoding="utf-8"))
        except FileNotFoundError:
            raise DatasetError(f"{path} does not exist; 'lcf3d init {root}' writes a first one") from None
        except (yaml.YAMLError, UnicodeDecodeError) as error:
            raise ConfigError(f"{path} is no YAML file ({' '.join(str(error).split())[:200]})") from None
        if not isinstance(values, dict):
            raise ConfigError(f"{path} must hold cameras and lidars, got {type(values).__name__}")
        try:
            sensors = cls.model_validate(values)
        except ValidationError as error:
            raise ConfigError(f"{path}: {_sentence(error)}") from None
        sensors._require_whole(path)
        return sensors

    def _require_whole(self, path: Path) -> None:
        if not self.cameras and not self.lidars:
            raise ConfigError(f"{path} names neither cameras nor lidars")
        for name, camera in self.cameras.items():
            if (camera.camera_from_lidar is None) == (camera.ego_from_sensor is None):
                raise ConfigError(f"{path}: camera {name} needs one of camera_from_lidar and ego_from_sensor")
            if np.linalg.det(self.camera_from_lidar(name)[:3, :3]) < 0:
                raise ConfigError(
                    f"{path}: the pose of camera {name} mirrors the scene; one of axes, ego_axes and the pose is wrong"
                )

    @property
    def lidar_axes(self) -> str:
        """Axes of the first LiDAR."""
        return next((lidar.axes for lidar in self.lidars.values()), CANONICAL_AXES)

    def ego_from_lidar(self, name: str | None = None) -> FloatArray:
        """(4, 4) vehicle coordinates from forward-left-up coordinates of a LiDAR, the first without a name."""
        lidar = self.lidars[name] if name else next(iter(self.lidars.values()), None)
        pose = np.eye(4)
        if lidar is None:
            return pose
        if lidar.ego_from_sensor is None:
            return pose
        turned = turn(self.ego_axes) @ np.array(lidar.ego_from_sensor)
        return np.asarray(turned @ invert_rigid(turn(lidar.axes)))

    def lidar_from_own(self, name: str) -> FloatArray:
        """(4, 4) the common LiDAR frame (the first's, forward-left-up) from the coordinates of a LiDAR's files."""
        common_from_lidar = invert_rigid(self.ego_from_lidar()) @ self.ego_from_lidar(name)
        return np.asarray(common_from_lidar @ turn(self.lidars[name].axes))

    def camera_from_lidar(self, name: str, pose: FloatArray | None = None, axes: str | None = None) -> FloatArray:
        """(4, 4) right-down-forward camera coordinates from the common LiDAR frame.

        Args:
            name: of the camera.
            pose: instead of what the file gives, of the same kind.
            axes: instead of the camera's.
        """
        camera = self.cameras[name]
        own_axes = invert_rigid(turn(CAMERA_AXES)) @ turn(axes or camera.axes)
        if camera.camera_from_lidar is not None:
            given = np.array(camera.camera_from_lidar) if pose is None else pose
            return np.asarray(own_axes @ given @ invert_rigid(turn(self.lidar_axes)))
        given = np.array(camera.ego_from_sensor) if pose is None else pose
        camera_from_ego = own_axes @ invert_rigid(given) @ invert_rigid(turn(self.ego_axes))
        return np.asarray(camera_from_ego @ self.ego_from_lidar())

    def camera(self, name: str, size: tuple[int, int]) -> Camera:
        """A camera of an image size.

        Raises:
            ConfigError: its lens is none.
        """
        setup = self.cameras[name]
        lens = setup.distortion
        distortion = None if lens is None else Distortion(lens.model, tuple(lens.coefficients))
        projection = np.hstack([np.array(setup.intrinsics), np.zeros((3, 1))])
        return Camera(name, projection, self.camera_from_lidar(name), *size, distortion=distortion)

    def lidar_from_labels(self) -> FloatArray:
        """(4, 4) the common LiDAR frame from the coordinates of the labels."""
        return turn(self.label_axes)

    def dump(self, path: Path, heading: str = "") -> None:
        """Write the file: what differs from the defaults, under a comment."""
        values = self.model_dump(mode="json", exclude_defaults=True, exclude_none=True)
        write_text(path, heading + yaml.safe_dump(values, sort_keys=False, default_flow_style=None, width=118))


def turn(axes: str) -> FloatArray:
    """(4, 4) forward-left-up coordinates from those of the named axes."""
    matrix = np.eye(4)
    matrix[:3, :3] = canonical_from_axes(axes)
    return matrix


def _model_at(place: Sequence[int | str]) -> type[BaseModel]:
    """What is described at a place of ``sensors.yaml``."""
    models: Mapping[str, type[BaseModel]] = {"cameras": CameraSetup, "lidars": LidarSetup, "distortion": Lens}
    return next((models[str(part)] for part in reversed(place) if part in models), Sensors)


def _sentence(error: ValidationError) -> str:
    """The first of pydantic's complaints."""
    first = error.errors()[0]
    place = ".".join(str(part) for part in first["loc"])
    kind = first["type"]
    if kind == "extra_forbidden":
        return f"unknown key {place!r}; the keys there are {', '.join(_model_at(first['loc'][:-1]).model_fields)}"
    if kind == "missing":
        return f"{place} is missing"
    if kind == "model_type":
        return f"{place} takes keys ({', '.join(_model_at(first['loc']).model_fields)}), got {first['input']!r}"
    return f"{place}: {first['msg'].removeprefix('Value error, ')}"


def read_rows(path: Path) -> list[list[str]]:
    """Cells of a text file with commas or spaces, without empty lines and comments.

    Raises:
        DatasetError: it does not exist.
        FormatError: it is no text.
    """
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
    except FileNotFoundError:
        raise DatasetError(f"{path} does not exist") from None
    except UnicodeDecodeError:
        raise FormatError(f"{path} is not a text file in UTF-8") from None
    return [line.replace(",", " ").split() for line in lines if line.strip() and not line.lstrip().startswith("#")]


def read_by_frame(path: Path, ids: tuple[str, ...], widths: tuple[int, ...], what: str) -> dict[str, FloatArray]:
    """Numbers by frame of a text file: a line a frame in order, or lines that begin with the frame's name.

    Args:
        path: the file; a first line of words is taken for a heading.
        ids: the frames.
        widths: how many numbers a line may have, without the name.
        what: they are, for the message.

    Raises:
        FormatError: other lines, or lines in order whose number is not that of the frames.
        DatasetError: the lines name frames, none of which is of the dataset.
    """
    rows = read_rows(path)
    if rows and not _is_number(rows[0][-1]):
        rows = rows[1:]
    named = all(len(row) - 1 in widths for row in rows) and bool(rows)
    plain = all(len(row) in widths for row in rows)
    known = set(ids)
    try:
        if named and (not plain or any(row[0] in known for row in rows)):
            found = {row[0]: np.array(row[1:], dtype=np.float64) for row in rows if row[0] in known}
            if not found:
                raise DatasetError(f"{path} has {what} of {rows[0][0]!r} and others, none of which is a frame")
            return found
        if plain:
            if len(rows) != len(ids):
                raise FormatError(f"{path} has {len(rows)} {what} for {len(ids)} frames; name the frame in each line")
            return dict(zip(ids, np.array(rows, dtype=np.float64), strict=True))
    except Lcf3dError:
        raise
    except ValueError:
        raise FormatError(f"{path} must hold numbers") from None
    numbers = " or ".join(str(n) for n in widths)
    raise FormatError(f"{path}: a line must hold {numbers} numbers, with or without the frame's name before them")


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True
