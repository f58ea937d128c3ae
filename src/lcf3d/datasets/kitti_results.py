"""Results in KITTI's text form: read as a branch of a run, written beside its provenance."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np

from lcf3d.datasets.kitti_sequences import sequence_of
from lcf3d.detectors.joins import LeftOut, join_classes, require_pixels
from lcf3d.errors import ConfigError, DatasetError
from lcf3d.files import inside, list_files
from lcf3d.formats.kitti import (
    KittiObjects,
    labels_of,
    objects_from_detections,
    read_folder,
    read_objects,
    renamed,
    write_objects,
)
from lcf3d.formats.kitti_tracking import write_tracks
from lcf3d.frame import Frame
from lcf3d.fusion.memory_identity import tracked
from lcf3d.geometry.boxes import lidar_from_kitti
from lcf3d.geometry.camera import project_boxes
from lcf3d.provenance import FusedDetections
from lcf3d.structures import BoolArray, Detections2D, Detections3D, FloatArray, IntArray


class _Table(NamedTuple):
    """Lines of many files: the objects, (N,) their labels (-1 for other classes), (N,) whether they have a 3D box."""

    objects: KittiObjects
    labels: IntArray
    boxed: BoolArray


class _Rows(NamedTuple):
    """The lines of one frame."""

    table: _Table
    rows: slice


class KittiResults:
    """A folder of KITTI result files, one a frame, read whole so that a bad line stops a run before it starts.

    Args:
        folder: holds ``ID.txt`` for every frame; a folder written by ``lcf3d run`` (with ``data/``) will do.
        class_names: classes to take; detections of others are left out.
        missing: ``error`` refuses a folder that lacks frames, ``empty`` takes them as frames without detections.

    Attributes:
        reads_frames: `load` reads the files of the frames that it is given, and no others.
    """

    reads_frames = True

    def __init__(self, folder: str | Path, class_names: Sequence[str], missing: str = "error") -> None:
        path = Path(folder)
        self.folder = path / "data" if (path / "data").is_dir() else path
        self.class_names = tuple(class_names)
        self.missing: Literal["error", "empty"] = "empty" if missing == "empty" else "error"
        self._rows: dict[str, _Rows] = {}
        self.left_out = LeftOut(self.folder)

    def load(self, frame_ids: Sequence[str]) -> None:
        """Read the files of these frames.

        Raises:
            DatasetError: the folder misses some of them; says how many and which first. Or all that was read so far is
                of other classes.
            FormatError: a line is malformed; names file and line.
        """
        frames = read_folder(self.folder, frame_ids, results=True, missing=self.missing)
        names = sorted(set(frames.objects.class_names.tolist()))
        joined = join_classes(names, self.class_names)
        for name, target in joined.items():
            if name != target:
                frames = replace(frames, objects=renamed(frames.objects, name, target))
        labels = labels_of(frames.objects, self.class_names)
        table = _Table(frames.objects, labels, frames.objects.has_box3d)
        bounds = frames.starts.tolist()
        self._rows.update((i, _Rows(table, slice(*pair))) for i, pair in zip(frame_ids, pairwise(bounds), strict=True))
        if len(frame_ids) > 1 or not self.left_out.taken:
            self._count(frames.objects)

    def _count(self, objects: KittiObjects) -> None:
        """Note what of the objects is taken, and what is not.

        Raises:
            DatasetError: none of them is of a class of the run.
        """
        before, self.left_out = self.left_out, LeftOut(self.folder)
        for name, count in Counter(objects.class_names.tolist()).items():
            if name in self.class_names:
                self.left_out.taken += count
            elif name != "DontCare":
                self.left_out.classes[name] += count
        if not before.taken:
            self.left_out.require_some(self.class_names)

    def require_probabilities(self, calibrated: Collection[str]) -> None:
        """See that the scores that `load` has read lie in [0, 1], but for those of classes that are ``calibrated``.

        Raises:
            ConfigError: some do not; names the file.
        """
        asked = np.array([name not in calibrated for name in self.class_names], dtype=bool)
        for table in self._tables():
            scores = table.objects.scores
            if scores is None:
                continue
            wrong = (table.labels >= 0) & asked[table.labels] & ~((scores >= 0) & (scores <= 1))
            if wrong.any():
                first = int(wrong.argmax())
                frame_id = next(i for i, rows in self._rows.items() if rows.table is table and rows.rows.stop > first)
                raise ConfigError(
                    f"{self.folder / frame_id}.txt: scores must lie in [0, 1], got {scores[first]:.4g} for a "
                    f"{table.objects.class_names[first]}; fit a calibration with 'lcf3d calibrate' and pass "
                    "--calibration FILE"
                )

    def _tables(self) -> Iterator[_Table]:
        """What `load` has read, each table once."""
        yield from {id(rows.table): rows.table for rows in self._rows.values()}.values()

    def objects(self, frame: Frame) -> KittiObjects:
        """The result lines of one frame, read now unless `load` has read them."""
        table, rows = self._of(frame.id)
        return table.objects[rows]

    def _of(self, frame_id: str) -> _Rows:
        """Where the lines of one frame are."""
        if frame_id not in self._rows:
            self.load([frame_id])
        return self._rows[frame_id]


class KittiLidarResults(KittiResults):
    """3D detections of a LiDAR detector."""

    def detect(self, frame: Frame) -> Detections3D:
        """The detections of one frame in its LiDAR frame.

        Raises:
            DatasetError: the files hold detections, but none with a 3D box.
        """
        table, rows = self._of(frame.id)
        boxed = table.boxed[rows]
        self._require_boxes(frame.id, boxed)
        kept = _narrowed(rows, boxed & (table.labels[rows] >= 0))
        objects = table.objects
        boxes = lidar_from_kitti(
            objects.locations[kept],
            objects.dimensions[kept],
            objects.rotation_y[kept],
            frame.cameras[0].camera_from_lidar,
        )
        assert objects.scores is not None  # of results
        return Detections3D.trusted(boxes, objects.scores[kept], table.labels[kept], self.class_names)

    def _require_boxes(self, frame_id: str, boxed: BoolArray) -> None:
        """See that some object of a frame has a 3D box, if there are any."""
        if len(boxed) and not boxed.any():
            raise DatasetError(
                f"{self.folder / frame_id}.txt holds no 3D boxes: these are 2D results, pass them as the camera branch"
            )


class KittiCameraResults(KittiResults):
    """2D detections of a camera detector."""

    def load(self, frame_ids: Sequence[str]) -> None:
        """Read the files of these frames, see `KittiResults.load`.

        Raises:
            FormatError: also where the boxes are no pixels.
        """
        super().load(frame_ids)
        boxes = [rows.table.objects.boxes2d[rows.rows] for rows in map(self._of, frame_ids)]
        if len(boxes) > 1 or len(self._rows) == 1:
            require_pixels(np.concatenate(boxes), self.folder)

    def sees(self, frame: Frame, camera: str) -> bool:
        """Always: a frame without detections was looked at."""
        return True

    def detect(self, frame: Frame, camera: str) -> Detections2D:
        """The detections of one frame, clipped to the image of ``camera``."""
        table, rows = self._of(frame.id)
        kept, objects = _narrowed(rows, table.labels[rows] >= 0), table.objects
        assert objects.scores is not None  # of results
        found = Detections2D.trusted(objects.boxes2d[kept], objects.scores[kept], table.labels[kept], self.class_names)
        return found.clipped(frame.camera(camera))


def _narrowed(rows: slice, kept: BoolArray) -> slice | IntArray:
    """Those of the rows that are kept; the slice itself where all are, which copies nothing."""
    return rows if kept.all() else rows.start + kept.nonzero()[0]


class KittiWriter:
    """Writes ``data/ID.txt``, a KITTI result file, for every frame.

    A run with memory also gets ``tracks/SEQUENCE.txt``, KITTI tracking results.

    Args:
        folder: of the run.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder / "data"
        self.tracks = folder / "tracks"

    def write(self, frame: Frame, fused: FusedDetections) -> None:
        """Write the result file of a frame."""
        camera_from_lidar = frame.cameras[0].camera_from_lidar
        objects = objects_from_detections(fused.detections, image_boxes(frame, fused), camera_from_lidar)
        write_objects(inside(self.folder, frame.id, ".txt"), objects)

    def is_done(self, frame_id: str) -> bool:
        """Whether the file of a frame is there."""
        return (self.folder / f"{frame_id}.txt").is_file()

    def finish(self, frame_ids: Sequence[str], read: Callable[[str], FusedDetections]) -> None:
        """Write the tracks, where there are any, of the frames whose ids tell sequence and number."""
        sequences: dict[str, list[tuple[int, str]]] = {}
        for frame_id in frame_ids:
            sequence, number = sequence_of(frame_id)
            if sequence is not None:
                sequences.setdefault(sequence, []).append((number, frame_id))
        for sequence, frames in sequences.items():
            numbers, names = zip(*sorted(frames), strict=True)
            kept = [own for own in (tracked(read(name)) for name in names) if own is not None]
            if len(kept) == len(names):
                objects = [
                    read_objects(self.folder / f"{name}.txt", results=True)[own.rows]
                    for name, own in zip(names, kept, strict=True)
                ]
                write_tracks(self.tracks / f"{sequence}.txt", numbers, [own.ids for own in kept], objects)

    def written(self) -> Iterator[Path]:
        """The files of all frames, and the tracks."""
        yield from list_files(self.folder, ".txt")
        yield from list_files(self.tracks, ".txt")


def image_boxes(frame: Frame, fused: FusedDetections) -> FloatArray:
    """(N, 4) boxes of the outputs in the frame's first camera.

    The 2D detection where one led to the output, since a detector draws what is visible; else the 3D box's projection,
    clipped to the image (zeros where it is not in view).
    """
    camera = frame.cameras[0]
    boxes, _ = project_boxes(fused.detections.boxes, camera)
    if camera.name in fused.camera_names:
        c = fused.camera_names.index(camera.name)
        rows = np.flatnonzero((fused.camera.camera == c) & (fused.camera.output >= 0))
        boxes[fused.camera.output[rows]] = fused.camera_inputs[c].boxes[fused.camera.detection[rows]]
    return boxes
