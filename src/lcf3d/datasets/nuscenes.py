"""nuScenes: frames with six cameras, LIDAR_TOP and annotations, read from the tables without the devkit.

The raw LIDAR_TOP frame is x right, y forward, z up. Everything here is in the canonical frame of lcf3d, x forward,
y left, z up, with the same origin: ``(x, y, z) = (y_raw, -x_raw, z_raw)``.

Cameras and LiDAR of a sample are recorded at different times while the vehicle moves: each camera's
``camera_from_lidar`` leads through both ego poses.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from lcf3d.datasets.base import BaseDataset, CameraSource, LidarSource, ResultWriter, require_folder
from lcf3d.datasets.check import Finding
from lcf3d.datasets.images import ImageFiles
from lcf3d.datasets.nuscenes_annotations import ground_truth_boxes
from lcf3d.datasets.nuscenes_loading import find_version, load_tables
from lcf3d.datasets.nuscenes_splits import scenes_of_split
from lcf3d.datasets.nuscenes_tables import CAMERAS, MAX_CAMERA_DELAY_S, NuscenesTables
from lcf3d.detectors.lidar.sweeps import accumulate_sweeps
from lcf3d.errors import ConfigError, DatasetError, Lcf3dError
from lcf3d.files import inside
from lcf3d.formats.nuscenes import read_submission, write_submission
from lcf3d.formats.nuscenes_boxes import (
    GlobalBoxes,
    detections_from_global,
    global_from_detections,
    split_by_sample,
)
from lcf3d.formats.nuscenes_tracking import write_tracking
from lcf3d.formats.scans import read_scan
from lcf3d.frame import Frame, Sweep
from lcf3d.geometry.rotation import invert_rigid, rigid_transforms
from lcf3d.structures import NUSCENES_CLASSES, Camera, Detections3D, FloatArray, IntArray

RAW_FROM_CANONICAL: FloatArray = np.array([[0, -1, 0, 0], [1, 0, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]], dtype=np.float64)
"""(4, 4) raw LIDAR_TOP coordinates from canonical ones."""

SWEEP_PERIOD_S = 0.05
"""Time between LIDAR_TOP sweeps in seconds."""


def read_lidar(path: Path) -> NDArray[np.float32]:
    """(N, 4) float32 ``x, y, z, intensity`` (0 to 255) of a LIDAR_TOP ``.pcd.bin`` file in the canonical frame.

    Points that hold NaN or infinite values are left out.

    Raises:
        DatasetError: the file does not exist.
        FormatError: it is cut off or no scan.
    """
    points = read_scan(path, columns=5)
    points = points[np.isfinite(points[:, :4]).all(axis=1)]
    return np.stack([points[:, 1], -points[:, 0], points[:, 2], points[:, 3]], axis=1)


class NuscenesDataset(BaseDataset):
    """Samples of nuScenes tables as frames; the frame id is the sample token.

    Sensor files are opened only when a frame's points or images are asked for; files that are not there are left out.

    Args:
        root: folder that holds ``samples``, ``sweeps`` and the folder of tables.
        version: name of the folder of tables; None for the only one there.
        split: official split name or text file of scene names (`scenes_of_split`); None for every sample.
        sweeps: how many earlier sweeps to add to the key frame's points; they gain a fifth column, the age in seconds.
            Sweeps whose file is absent or that are older than twice the nominal time are left out.
        max_camera_delay_s: longest accepted time between an image and the sample's LiDAR sweep.
        late_cameras: what to do beyond that: ``error``, or ``drop`` the camera from the frame.
        min_points: annotations with fewer LiDAR and radar points are no labels (official evaluation: 1).
        tables: tables already read, instead of those in ``root``.

    Raises:
        DatasetError: tables absent or inconsistent (`load_tables`), or none of the split's scenes is there.
        ConfigError: an argument out of range.
    """

    class_names = NUSCENES_CLASSES
    camera_names = CAMERAS
    preset = "nuscenes"
    evaluation = "lcf3d.evaluation.nuscenes_task:NuscenesEvaluation"
    tracking = "lcf3d.evaluation.nuscenes_tracking_task:NuscenesTracking"
    native_from_canonical = RAW_FROM_CANONICAL

    def __init__(
        self,
        root: Path | str,
        version: str | None = None,
        split: str | None = None,
        *,
        sweeps: int = 0,
        max_camera_delay_s: float = MAX_CAMERA_DELAY_S,
        late_cameras: Literal["error", "drop"] = "error",
        min_points: int = 1,
        tables: NuscenesTables | None = None,
    ) -> None:
        self.root = require_folder(Path(root).expanduser())
        if sweeps < 0 or late_cameras not in ("error", "drop"):
            raise ConfigError(
                f"sweeps must be 0 or more and late_cameras 'error' or 'drop', got {sweeps} and {late_cameras!r}"
            )
        self.tables = load_tables(self.root, version or find_version(self.root)) if tables is None else tables
        self.version = self.tables.version
        self.split = split
        self.sweeps = sweeps
        self.max_camera_delay_s = max_camera_delay_s
        self.late_cameras = late_cameras
        self.min_points = min_points
        wanted = self.tables.scene_names if split is None else scenes_of_split(split)
        self.sample_rows: IntArray = self.tables.rows_of_scenes(wanted)
        if not len(self.sample_rows):
            raise DatasetError(
                f"{self.root / self.version} holds no sample of split {split!r}; "
                f"its scenes are {', '.join(self.tables.scene_names[:5]) or 'none'} ..."
            )
        self.ids = tuple(token.decode() for token in self.tables.samples.tokens[self.sample_rows].tolist())
        self._position = {token: i for i, token in enumerate(self.ids)}
        self._ground_truth: dict[str, GlobalBoxes] | None = None

    @staticmethod
    def recognizes(root: Path) -> bool:
        """Whether a folder looks like this layout."""
        return any(root.glob("v1.0-*"))

    def frame(self, frame_id: str) -> Frame:
        """The sample of that token; points, images and labels are read when first asked for.

        Raises:
            DatasetError: no such sample, or a camera too far off in time.
        """
        token, row = frame_id, self._sample_row(frame_id)
        data = self.tables.sensor_data
        cameras, images = [], {}
        global_from_lidar = self.global_from_lidar(token)
        for name, camera_row in zip(CAMERAS, self.tables.samples.cameras[row].tolist(), strict=True):
            if camera_row < 0 or self._is_late(token, name, camera_row):
                continue
            projection = np.concatenate([data.intrinsics[camera_row], np.zeros((3, 1))], axis=1)
            camera_from_lidar = invert_rigid(self._global_from_sensor(camera_row)) @ global_from_lidar
            width, height = data.sizes[camera_row].tolist()
            cameras.append(Camera(name, projection, camera_from_lidar, width, height))
            path = self._path(camera_row)
            if path.is_file():
                images[name] = path
        return Frame(
            token,
            points=(lambda: self.points(token)) if self._path(self._lidar_row(token)).is_file() else None,
            cameras=cameras,
            images=ImageFiles(images),
            labels=(lambda: self.labels(token)) if len(self.tables.annotations.tokens) else None,
            timestamp=1e-6 * float(data.timestamps_us[self._lidar_row(token)]),
            world_from_lidar=global_from_lidar,
            sequence=self.tables.scene_names[int(self.tables.samples.scenes[row])],
            sweeps=None if self.sweeps else lambda count: self.earlier_sweeps(token, count),
        )

    def has_image(self, frame_id: str, camera: str) -> bool:
        """Whether there is an image, without reading it."""
        row = int(self.tables.samples.cameras[self._sample_row(frame_id), CAMERAS.index(camera)])
        return row >= 0 and self._path(row).is_file()

    def lidar_results(self, path: Path, class_names: Sequence[str], missing: str = "error") -> LidarSource:
        """3D detections of a submission, or of a run folder."""
        from lcf3d.datasets.nuscenes_results import NuscenesLidarResults

        file = result_file(path)
        return NuscenesLidarResults(file, self.read_results(file), class_names, missing)

    def camera_results(self, path: Path, class_names: Sequence[str], missing: str = "error") -> CameraSource:
        """2D detections of a list by sample and camera (`lcf3d.formats.coco`)."""
        from lcf3d.datasets.nuscenes_results import NuscenesCameraResults

        return NuscenesCameraResults(path, class_names, self.camera_names, self.image_sizes())

    def writer(self, folder: Path) -> ResultWriter:
        """One submission of all samples."""
        from lcf3d.datasets.nuscenes_results import NuscenesWriter

        return NuscenesWriter(folder, self.write_results, self.write_tracks)

    @staticmethod
    def check_unreadable(root: str, version: str | None = None) -> list[Finding]:
        """What is wrong with tables that cannot be opened."""
        from lcf3d.datasets.nuscenes_check import check_nuscenes

        return check_nuscenes(Path(root).expanduser(), version)

    def check(self, results: Path | None = None, progress: Callable[[], None] = lambda: None) -> list[Finding]:
        """The rules ``NUS``."""
        from lcf3d.datasets.nuscenes_check import check_nuscenes

        findings = check_nuscenes(self.root, self.version)
        if results is None:
            return findings
        try:
            found = self.lidar_results(results, self.class_names)
            found.load(self.ids)  # type: ignore[attr-defined]
        except Lcf3dError as error:
            return [*findings, Finding("NUS13", "error", str(error))]
        notes = found.left_out.notes()  # type: ignore[attr-defined]
        return [*findings, *(Finding("NUS14", "warning", note) for note in notes)]

    def points(self, token: str) -> NDArray[np.float32]:
        """(N, 4) ``x, y, z, intensity`` of a sample in the canonical frame; with sweeps (N, 5), last the age in s.

        Earlier sweeps are moved by the vehicle's motion since then.

        Raises:
            DatasetError: no such sample, or its scan is not there.
            FormatError: a scan is cut off.
        """
        points = read_lidar(self._path(self._lidar_row(token)))
        return accumulate_sweeps(points, self.earlier_sweeps(token, self.sweeps)) if self.sweeps else points

    def earlier_sweeps(self, token: str, count: int) -> list[Sweep]:
        """At most ``count`` LIDAR_TOP sweeps before a sample's scan, the latest first, each in its canonical frame.

        Sweeps whose file is absent, or that are older than twice the nominal time of so many, are left out.

        Raises:
            DatasetError: no such sample.
            FormatError: a sweep is cut off.
        """
        row = self._lidar_row(token)
        data = self.tables.sensor_data
        lidar_from_global = self.lidar_from_global(token)
        found: list[Sweep] = []
        earlier = row
        for _ in range(count):
            earlier = int(data.previous[earlier])
            if earlier < 0:
                break
            age = 1e-6 * float(data.timestamps_us[row] - data.timestamps_us[earlier])
            if age > 2 * SWEEP_PERIOD_S * count:
                break
            path = self._path(earlier)
            if path.is_file():
                motion = lidar_from_global @ self._global_from_sensor(earlier) @ RAW_FROM_CANONICAL
                found.append(Sweep(read_lidar(path), motion, age))
        return found

    def labels(self, token: str) -> Detections3D:
        """Annotations of a sample in its canonical LiDAR frame, with velocities and attributes; scores are 1."""
        boxes = self.annotations(token)
        labels = detections_from_global(boxes[boxes.point_counts >= self.min_points], self.lidar_from_global(token))
        return replace(labels, scores=np.ones(len(labels)))

    def annotations(self, token: str) -> GlobalBoxes:
        """All annotations of a sample's detection classes in the global frame, with point counts."""
        self._sample_row(token)
        if self._ground_truth is None:
            self._ground_truth = split_by_sample(self.ground_truth())
        return self._ground_truth[token]

    def ground_truth(self) -> GlobalBoxes:
        """All annotations of the detection classes in this dataset's samples, in the global frame."""
        return ground_truth_boxes(self.tables, self.sample_rows)

    def global_from_lidar(self, token: str) -> FloatArray:
        """(4, 4) global coordinates from a sample's canonical LiDAR coordinates."""
        transform: FloatArray = self._global_from_sensor(self._lidar_row(token)) @ RAW_FROM_CANONICAL
        return transform

    def lidar_from_global(self, token: str) -> FloatArray:
        """(4, 4) a sample's canonical LiDAR coordinates from global ones."""
        return invert_rigid(self.global_from_lidar(token))

    def image_files(self) -> dict[str, tuple[str, str]]:
        """(sample token, camera) of every key-frame image by its path in the tables, for `read_coco_index`."""
        data, samples = self.tables.sensor_data, self.tables.samples
        return {
            data.filenames[row].decode(): (token, name)
            for token, sample in zip(self.ids, self.sample_rows, strict=True)
            for name, row in zip(CAMERAS, samples.cameras[sample].tolist(), strict=True)
            if row >= 0
        }

    def read_results(self, path: str | Path) -> dict[str, Detections3D]:
        """Detections of a submission file by sample token, each in its sample's canonical LiDAR frame.

        Samples outside this dataset are left out.

        Raises:
            FormatError: not a submission (`read_submission`).
        """
        boxes = split_by_sample(read_submission(Path(path))[0])
        return {t: detections_from_global(boxes[t], self.lidar_from_global(t)) for t in self.ids if t in boxes}

    def write_results(
        self, path: str | Path, detections: Mapping[str, Detections3D], meta: Mapping[str, Any] | None = None
    ) -> None:
        """Write detections, given in canonical LiDAR frames by sample token, as a submission of all samples here.

        Raises:
            FormatError: detections of other samples, or values that are not finite.
        """
        transforms = {token: self.global_from_lidar(token) for token in detections if token in self._position}
        write_submission(Path(path), global_from_detections(detections, transforms, self.ids), meta)

    def write_tracks(self, path: Path, detections: Mapping[str, Detections3D], ids: Mapping[str, IntArray]) -> None:
        """Write tracked detections, given in canonical LiDAR frames by sample token, as a tracking submission.

        Raises:
            FormatError: values that are not finite.
        """
        transforms = {token: self.global_from_lidar(token) for token in detections}
        names, scenes = self.tables.scene_names, self.tables.samples.scenes
        of = {token: names[int(scenes[self._sample_row(token)])] for token in detections}
        write_tracking(path, detections, ids, of, transforms, self.ids)

    def _sample_row(self, token: str) -> int:
        if token not in self._position:
            raise DatasetError(f"sample {token!r} is not in split {self.split!r} of {self.root / self.version}")
        return int(self.sample_rows[self._position[token]])

    def _lidar_row(self, token: str) -> int:
        return int(self.tables.samples.lidar[self._sample_row(token)])

    def _path(self, data_row: int) -> Path:
        name: bytes = self.tables.sensor_data.filenames[data_row]
        return inside(self.root, name.decode())

    def _global_from_sensor(self, data_row: int) -> FloatArray:
        """(4, 4) global coordinates from raw sensor coordinates at the time of a recording."""
        data, rows = self.tables.sensor_data, [data_row]
        pose = rigid_transforms(data.pose_rotations[rows], data.pose_translations[rows])[0]
        sensor = rigid_transforms(data.sensor_rotations[rows], data.sensor_translations[rows])[0]
        transform: FloatArray = pose @ sensor
        return transform

    def _is_late(self, token: str, name: str, camera_row: int) -> bool:
        """Whether a camera is to be dropped because it is too far off in time."""
        times = self.tables.sensor_data.timestamps_us
        delay = 1e-6 * abs(int(times[camera_row]) - int(times[self._lidar_row(token)]))
        if delay <= self.max_camera_delay_s:
            return False
        if self.late_cameras == "error":
            raise DatasetError(
                f"sample {token}: {name} is {delay:.3f} s away from the LiDAR sweep, the limit is "
                f"{self.max_camera_delay_s} s; raise max_camera_delay_s or leave it out with late_cameras='drop'"
            )
        return True


def result_file(path: Path) -> Path:
    """The submission file of a run folder, or the file itself."""
    return path / "results.json" if path.is_dir() else path
