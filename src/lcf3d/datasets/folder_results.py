"""Labels and detections of a plain folder: KITTI text, parquet, COCO JSON or our JSON, told by what lies there."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

from lcf3d.datasets.base import CameraSource, LidarSource
from lcf3d.datasets.kitti_results import KittiCameraResults, KittiLidarResults
from lcf3d.datasets.plain_results import PlainCameraResults, PlainLidarResults
from lcf3d.detectors.joins import LeftOut, join_cameras
from lcf3d.errors import DatasetError, FormatError
from lcf3d.files import is_hidden, list_files, read_json
from lcf3d.formats.coco import (
    CameraDetections,
    read_camera_detections,
    read_coco_annotations,
    read_coco_index,
    read_coco_results,
)
from lcf3d.formats.kitti import detections_3d, read_objects
from lcf3d.formats.plain import read_detections_3d
from lcf3d.formats.tables import read_table_2d, read_table_3d, table_classes
from lcf3d.frame import Frame
from lcf3d.geometry.boxes import transform_boxes
from lcf3d.structures import Camera, Detections2D, Detections3D, FloatArray

KITTI, PLAIN, TABLE, COCO, CAMERAS = "KITTI text", "JSON of our own", "parquet", "COCO JSON", "KITTI text by camera"


def form_of(path: Path) -> str:
    """In which form the results or labels at a path are.

    Raises:
        DatasetError: it does not exist, or holds none of the forms.
    """
    if path.is_file() and path.suffix in (".parquet", ".json"):
        return TABLE if path.suffix == ".parquet" else COCO
    if not path.is_dir():
        raise DatasetError(f"{path} is neither a folder of .txt or .json files nor a .parquet or .json file")
    inner = path / "data" if (path / "data").is_dir() else path
    for suffix, form in ((".txt", KITTI), (".json", PLAIN)):
        if any(child.suffix == suffix for child in inner.iterdir()):
            return form
    if any(child.is_dir() and any(child.glob("*.txt")) for child in path.iterdir()):
        return CAMERAS
    raise DatasetError(f"{path} holds neither .txt nor .json files")


class FolderLabels:
    """3D labels by frame.

    Args:
        path: folder of KITTI text or JSON of our own, or a parquet table.
        class_names: classes to take.
        lidar_from_labels: (4, 4) the LiDAR frame from the labels' coordinates; not for KITTI's text, which is in the
            first camera's.

    Raises:
        DatasetError: there are none.
    """

    def __init__(self, path: Path, class_names: Sequence[str], lidar_from_labels: FloatArray) -> None:
        self.path = path
        self.form = form_of(path)
        if self.form not in (KITTI, PLAIN, TABLE):
            raise DatasetError(f"{path} holds {self.form}, which has no 3D boxes; give it as labels_2d")
        self.class_names = tuple(class_names)
        self.lidar_from_labels = lidar_from_labels
        self._table = read_table_3d(path, class_names) if self.form == TABLE else None

    def has(self, frame_id: str) -> bool:
        """Whether a frame is labelled; of a table, all are: one without rows has no objects."""
        return self._table is not None or self._file(frame_id).is_file()

    def detections(self, frame_id: str, cameras: Sequence[Camera]) -> Detections3D:
        """Labels of a frame in its LiDAR frame.

        Raises:
            FormatError: the file is malformed.
        """
        if self.form == KITTI:
            if not cameras:
                raise DatasetError(f"{self.path}: labels as KITTI text are in the first camera's frame: there is none")
            objects = read_objects(self._file(frame_id), results=False)
            return detections_3d(objects, cameras[0].camera_from_lidar, self.class_names)
        if self._table is not None:
            found = self._table.get(frame_id, Detections3D.empty(self.class_names))
        else:
            found = read_detections_3d(self._file(frame_id)).with_classes(self.class_names)
        return replace(found, boxes=transform_boxes(found.boxes, self.lidar_from_labels))

    def class_counts(self, frame_ids: Sequence[str]) -> dict[str, int]:
        """Labels by class, those of classes that are not taken too.

        Raises:
            FormatError: a file is malformed.
        """
        if self.form == TABLE:
            return table_classes(self.path)
        found: Counter[str] = Counter()
        for path in map(self._file, frame_ids):
            if not path.is_file():
                continue
            if self.form == KITTI:
                found.update(read_objects(path, results=False).class_names.tolist())
            else:
                own = read_detections_3d(path)
                found.update(own.class_names[label] for label in own.labels)
        return dict(found)

    def _file(self, frame_id: str) -> Path:
        return self.path / f"{frame_id}{'.txt' if self.form == KITTI else '.json'}"


class _Counted:
    """Detections of one file, of which is counted what is left out.

    Args:
        path: the file.
        class_names: classes that were asked for.
        left_out: what reading the file left out.
    """

    def __init__(self, path: Path, class_names: Sequence[str], left_out: LeftOut) -> None:
        self.path = path
        self.class_names = tuple(class_names)
        self.camera_names: tuple[str, ...] = ()
        self.left_out = self._read = left_out

    def _count(self, frame_ids: Sequence[str], found: Iterable[tuple[str, str, Detections2D | Detections3D]]) -> None:
        """Take stock of (frame id, camera or empty, detections).

        Raises:
            DatasetError: the file has none of the frames, or nothing in it fits.
        """
        wanted = set(frame_ids)
        counted = LeftOut(self.path, classes=Counter(self._read.classes), frames=Counter(self._read.frames))
        first, met = None, False
        for frame_id, camera, one in found:
            first, met = first or frame_id, met or frame_id in wanted
            if frame_id not in wanted:
                counted.frames[frame_id] += len(one)
            elif camera and self.camera_names and camera not in self.camera_names:
                counted.cameras[camera] += len(one)
            else:
                counted.taken += len(one)
        if frame_ids and not met:
            raise DatasetError(f"{self.path} has none of the {len(frame_ids)} frames; its first is {first!r}")
        counted.frames = +counted.frames
        self.left_out = counted
        counted.require_some(self.class_names, self.camera_names)


class _Table3D(_Counted):
    """3D detections of a parquet table; a frame without a row is one without detections."""

    def __init__(self, path: Path, class_names: Sequence[str]) -> None:
        super().__init__(path, class_names, LeftOut(path))
        self._found = read_table_3d(path, class_names, self.left_out)

    def load(self, frame_ids: Sequence[str]) -> None:
        """See that the table has some of these frames, and count the rest.

        Raises:
            DatasetError: it has none of them, or nothing in it fits.
        """
        self._count(frame_ids, ((frame_id, "", found) for frame_id, found in self._found.items()))

    def detect(self, frame: Frame) -> Detections3D:
        """The detections of one frame."""
        return self._found.get(frame.id, Detections3D.empty(self.class_names))


class _ByCamera(_Counted):
    """2D detections by (frame, camera)."""

    def __init__(
        self,
        path: Path,
        found: CameraDetections,
        class_names: Sequence[str],
        camera_names: Sequence[str],
        left_out: LeftOut,
    ) -> None:
        super().__init__(path, class_names, left_out)
        self.camera_names = tuple(camera_names)
        own = {camera for _, camera in found}
        joined = {name: name for name in own} | join_cameras(own, camera_names)
        self._found = {(frame_id, joined[camera]): one for (frame_id, camera), one in found.items()}
        self._empty = Detections2D.empty(class_names)

    def load(self, frame_ids: Sequence[str]) -> None:
        """See that there are results of these frames, and count the rest.

        Raises:
            DatasetError: there are none of any, or nothing fits.
        """
        self._count(frame_ids, ((frame_id, camera, one) for (frame_id, camera), one in self._found.items()))

    def sees(self, frame: Frame, camera: str) -> bool:
        """Always: a camera without detections looked and saw nothing."""
        return True

    def detect(self, frame: Frame, camera: str) -> Detections2D:
        """The detections of one camera of one frame, clipped to its image."""
        return self._found.get((frame.id, camera), self._empty).clipped(frame.camera(camera))


class _Cameras:
    """A folder of KITTI text a camera; folders of no camera are counted by their files."""

    def __init__(self, path: Path, class_names: Sequence[str], missing: str, camera_names: Sequence[str]) -> None:
        folders = {child.name: child for child in path.iterdir() if child.is_dir() and not is_hidden(child)}
        joined = join_cameras(folders, camera_names) if camera_names else {name: name for name in folders}
        if not joined:
            raise DatasetError(
                f"{path} holds folders {', '.join(sorted(folders))}, of which none is a camera; expected "
                f"{', '.join(camera_names)}"
            )
        self.path = path
        self._sources = {joined[n]: KittiCameraResults(folders[n], class_names, missing) for n in joined}
        self._others = Counter({n: len(list_files(folder, ".txt")) for n, folder in folders.items() if n not in joined})
        self._empty = Detections2D.empty(class_names)

    @property
    def left_out(self) -> LeftOut:
        """What the folders of all cameras hold that is not taken."""
        whole = LeftOut(self.path, cameras=Counter(self._others))
        for source in self._sources.values():
            whole.taken += source.left_out.taken
            whole.classes += source.left_out.classes
            whole.frames += source.left_out.frames
        return whole

    reads_frames = True
    """Whether `load` reads the files of the frames that it is given, and no others."""

    def load(self, frame_ids: Sequence[str]) -> None:
        """Read the files of these frames."""
        for source in self._sources.values():
            source.load(frame_ids)

    def sees(self, frame: Frame, camera: str) -> bool:
        """Whether there is a folder of that camera."""
        return camera in self._sources

    def detect(self, frame: Frame, camera: str) -> Detections2D:
        """The detections of one camera of one frame, clipped to its image."""
        return self._sources[camera].detect(frame, camera) if camera in self._sources else self._empty


def folder_lidar_results(path: Path, class_names: Sequence[str], missing: str = "error") -> LidarSource:
    """3D detections of a plain folder, in the LiDAR frame (KITTI's text: in the first camera's).

    Raises:
        DatasetError: there are none.
        FormatError: malformed; names the file.
    """
    form = form_of(path)
    if form == KITTI:
        return KittiLidarResults(path, class_names, missing)
    if form == TABLE:
        return _Table3D(path, class_names)
    if form == PLAIN:
        return PlainLidarResults(path, class_names, missing)
    raise DatasetError(f"{path} holds {form}, which has no 3D boxes: pass it as the camera branch")


def folder_camera_results(
    path: Path,
    class_names: Sequence[str],
    missing: str,
    coco_index: Path | None,
    images: Mapping[str, tuple[str, str]],
) -> CameraSource:
    """2D detections of a plain folder.

    Args:
        path: file or folder.
        class_names: classes to take.
        missing: ``error`` or ``empty``.
        coco_index: file with the images and categories of a COCO result list.
        images: (frame id, camera) by image path.

    Raises:
        DatasetError: there are none, or text without cameras for several of them.
        FormatError: malformed; names the file.
    """
    form = form_of(path)
    names = sorted({camera for _, camera in images.values()})
    if form == CAMERAS:
        return _Cameras(path, class_names, missing, names)
    if form == PLAIN:
        return PlainCameraResults(path, class_names, missing, names)
    if form == KITTI:
        if len(names) > 1:
            raise DatasetError(
                f"{path} does not say of which camera its .txt files are; put those of {', '.join(names)} each into a "
                "folder of that name in it"
            )
        return KittiCameraResults(path, class_names, missing)
    left_out = LeftOut(path)
    if form == TABLE:
        found = read_table_2d(path, class_names, left_out)
    else:
        found = _read_coco(path, class_names, coco_index, images, left_out)
    return _ByCamera(path, found, class_names, names, left_out)


def _read_coco(
    path: Path,
    class_names: Sequence[str],
    index: Path | None,
    images: Mapping[str, tuple[str, str]],
    left_out: LeftOut,
) -> CameraDetections:
    content = read_json(path)
    if isinstance(content, dict):
        return read_coco_annotations(path, class_names, images, left_out, content)
    if isinstance(content, list) and content and isinstance(content[0], dict) and "sample_token" in content[0]:
        return read_camera_detections(path, class_names, left_out, content)
    if index is None:
        raise FormatError(
            f"{path} is a list of COCO results; name the file with its images and categories as coco_index in "
            "sensors.yaml"
        )
    categories, known = read_coco_index(index, images)
    return read_coco_results(path, class_names, categories, known, left_out, content)
