"""KITTI's raw, tracking and odometry layouts as datasets: ordered frames of sequences, with time and ego pose."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import cached_property
from pathlib import Path

from lcf3d.datasets.base import require_folder
from lcf3d.datasets.check import Finding, check_frames
from lcf3d.datasets.images import ImageFiles
from lcf3d.datasets.kitti import PARTS, KittiLikeDataset, is_tracking, read_points
from lcf3d.datasets.kitti_calibration import KittiCalibration, cameras_of
from lcf3d.datasets.kitti_check import check_results
from lcf3d.datasets.kitti_drives import Drive, odometry_drives, raw_drives, tracking_drives
from lcf3d.errors import ConfigError, DatasetError
from lcf3d.files import list_files
from lcf3d.formats.kitti import read_frame_ids
from lcf3d.frame import Frame
from lcf3d.structures import KITTI_CLASSES


class KittiSequences(KittiLikeDataset):
    """Frames of several drives, one drive after the other.

    Args:
        root: folder of the dataset.
        drives: all that there are.
        split: name of a file in ``ROOT/ImageSets`` that names sequences or frames, one a line; None for all.
        sequence: only this sequence.
        class_names: classes of the ground truth that frames give.

    Raises:
        DatasetError: there is no drive, no such split or no such sequence.
    """

    layout = "KITTI's drives"

    def __init__(
        self,
        root: Path,
        drives: Sequence[Drive],
        split: str | None = None,
        sequence: str | None = None,
        class_names: Sequence[str] = KITTI_CLASSES,
    ) -> None:
        self.root = root
        self.split = split
        self.class_names = tuple(class_names)
        if not drives:
            raise DatasetError(f"{root} holds no sequence of {self.layout}")
        self.drives = {drive.name: drive for drive in drives}
        if len(self.drives) < len(drives):
            raise DatasetError(f"{root} holds two sequences of one name; pass a folder that holds one of them")
        if sequence is not None:
            # a name of digits may have lost its leading zeros on the command line
            chosen = [name for name in self.drives if name.lstrip("0") == sequence.lstrip("0")]
            if not chosen:
                first = ", ".join(list(self.drives)[:5])
                raise DatasetError(f"{root} has no sequence {sequence!r} among its {len(drives)}: {first} ...")
            self.drives = {name: self.drives[name] for name in chosen}
        self._listed = None if split is None else set(read_frame_ids(self._split_path(split)))
        # sequence by sequence in order of time
        self.ids = tuple(self._places)
        if self._listed is not None and not self.ids:
            raise DatasetError(f"{self._split_path(split or '')} names no sequence and no frame that is there")

    def _split_path(self, split: str) -> Path:
        path = self.root / "ImageSets" / f"{split}.txt"
        if not path.is_file():
            known = ", ".join(p.stem for p in list_files(path.parent, ".txt")) or "none"
            raise DatasetError(f"{path} does not exist; the splits there are: {known}")
        return path

    @cached_property
    def _places(self) -> dict[str, tuple[Drive, int]]:
        """Drive and number of each frame by id."""
        found = {}
        for name, drive in self.drives.items():
            whole = self._listed is None or name in self._listed
            for number in drive.numbers:
                frame_id = f"{name}_{number:0{drive.digits}d}"
                if whole or frame_id in (self._listed or ()):
                    found[frame_id] = drive, number
        return found

    def place(self, frame_id: str) -> tuple[Drive, int]:
        """Drive and number of a frame.

        Raises:
            ConfigError: there is no such frame.
        """
        if frame_id not in self._places:
            raise ConfigError(f"{self.root} has no frame {frame_id!r}; its first is {self.ids[0]!r}")
        return self._places[frame_id]

    def calibration(self, frame_id: str) -> KittiCalibration:
        """The calibration of a frame."""
        return self.place(frame_id)[0].calibration

    def image_paths(self, frame_id: str) -> dict[str, Path]:
        """The image files of a frame that are there, by camera name."""
        drive, number = self.place(frame_id)
        return {name: paths[number] for name, paths in drive.images.items() if number in paths}

    def check(self, results: Path | None = None, progress: Callable[[], None] = lambda: None) -> list[Finding]:
        """The rules of every dataset, and those of KITTI result files."""
        findings = check_frames(self, progress=progress)
        return findings if results is None else [*findings, *check_results(self.ids, results)]

    def frame(self, frame_id: str) -> Frame:
        """The frame of that id; scan, images and labels are read when first asked for.

        Raises:
            DatasetError: a calibration file of its drive is missing.
            FormatError: a file of its drive is malformed.
        """
        drive, number = self.place(frame_id)
        images = self.image_paths(frame_id)
        scan = drive.scans.get(number)
        return Frame(
            frame_id,
            points=None if scan is None else lambda: read_points(scan),
            cameras=cameras_of(drive.calibration, images, drive.image_sizes),
            images=ImageFiles(images),
            labels=(lambda: drive.labels(number, self.class_names)) if drive.has_labels else None,
            timestamp=drive.time(number),
            world_from_lidar=drive.world_from_lidar(number),
            sequence=drive.name,
        )


class KittiRawDataset(KittiSequences):
    """Raw drives, rectified and synchronised, with their GPS/IMU poses and, where there are any, tracklets as labels.

    Args:
        root: one drive, or a folder of drives, or of days (``2011_09_26``) with drives; the calibration files lie in
            the folder of the day.
        split: see `KittiSequences`.
        sequence: only this drive, for example ``2011_09_26_drive_0001_sync``.
        class_names: classes of the ground truth that frames give.
    """

    layout = "KITTI's raw data (DATE/DRIVE_sync with image_02/data, velodyne_points/data)"

    def __init__(
        self,
        root: Path | str,
        split: str | None = None,
        *,
        sequence: str | None = None,
        class_names: Sequence[str] = KITTI_CLASSES,
    ) -> None:
        folder = require_folder(Path(root).expanduser())
        super().__init__(folder, raw_drives(folder), split, sequence, class_names)

    @staticmethod
    def recognizes(root: Path) -> bool:
        """Whether a folder looks like this layout."""
        return any(True for depth in ("", "*/", "*/*/") for _ in root.glob(depth + "velodyne_points"))


class KittiTrackingDataset(KittiSequences):
    """The tracking benchmark: ``ROOT/training/{calib,velodyne,image_02,image_03,label_02,oxts}``.

    Args:
        root: folder that holds ``training`` or ``testing``.
        split: see `KittiSequences`.
        part: ``training`` or ``testing``.
        sequence: only this sequence, for example ``"0003"``.
        class_names: classes of the ground truth that frames give.
    """

    layout = "KITTI's tracking benchmark (training/calib/SEQUENCE.txt)"
    evaluation = "lcf3d.evaluation.kitti_task:KittiTrackingEvaluation"
    tracking = "lcf3d.evaluation.kitti_tracking:KittiTracking"

    def __init__(
        self,
        root: Path | str,
        split: str | None = None,
        *,
        part: str | None = None,
        sequence: str | None = None,
        class_names: Sequence[str] = KITTI_CLASSES,
    ) -> None:
        folder = require_folder(Path(root).expanduser())
        there = [name for name in PARTS if (folder / name).is_dir()]
        self.part = part or (there or [PARTS[0]])[0]
        super().__init__(folder, tracking_drives(folder / self.part), split, sequence, class_names)

    @staticmethod
    def recognizes(root: Path) -> bool:
        """Whether a folder looks like this layout."""
        return is_tracking(root)


class KittiOdometryDataset(KittiSequences):
    """The odometry benchmark: ``ROOT/sequences/NAME/{calib.txt,times.txt,velodyne,image_2}`` and ``ROOT/poses``.

    Args:
        root: folder that holds ``sequences``.
        split: see `KittiSequences`.
        sequence: only this sequence, for example ``"07"``.
        class_names: classes that detections are taken of; there is no ground truth.
    """

    layout = "KITTI's odometry benchmark (sequences/NAME/calib.txt)"

    def __init__(
        self,
        root: Path | str,
        split: str | None = None,
        *,
        sequence: str | None = None,
        class_names: Sequence[str] = KITTI_CLASSES,
    ) -> None:
        folder = require_folder(Path(root).expanduser())
        super().__init__(folder, odometry_drives(folder), split, sequence, class_names)

    @staticmethod
    def recognizes(root: Path) -> bool:
        """Whether a folder looks like this layout."""
        return any(True for _ in (root / "sequences").glob("*/calib.txt"))
