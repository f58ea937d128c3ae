"""What the rest of lcf3d expects of a dataset: a protocol, and a base class with everything that most have in common.

A new dataset is one class and one line of ``pyproject.toml``::

    [project.entry-points."lcf3d.datasets"]
    mine = "my_package.dataset:MyDataset"     # then lcf3d run mine:ARGUMENT ...

`BaseDataset` needs ``ids``, ``class_names``, ``camera_names`` and ``frame``; what differs from the plain forms is
overridden. No verb of the command line asks which dataset it has.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Protocol

from lcf3d.datasets.check import Finding, check_frames
from lcf3d.errors import ConfigError, DatasetError
from lcf3d.frame import Frame
from lcf3d.provenance import FusedDetections
from lcf3d.structures import Detections2D, Detections3D, FloatArray

MISSING = ("error", "empty")
"""What may be done about result files that are not there: refuse them, or take them as frames without detections."""


class LidarSource(Protocol):
    """The LiDAR branch of a run."""

    def detect(self, frame: Frame) -> Detections3D:
        """3D detections of one frame in its LiDAR frame."""
        ...


class CameraSource(Protocol):
    """The camera branch of a run."""

    def sees(self, frame: Frame, camera: str) -> bool:
        """Whether there is anything to detect from: a camera without it is not used in that frame."""
        ...

    def detect(self, frame: Frame, camera: str) -> Detections2D:
        """2D detections of one camera of one frame."""
        ...


class ResultWriter(Protocol):
    """How the fused detections of a run are written for a dataset's own tools, beside the run's provenance."""

    def write(self, frame: Frame, fused: FusedDetections) -> None:
        """Write what belongs to one frame."""
        ...

    def is_done(self, frame_id: str) -> bool:
        """Whether what belongs to a frame is there."""
        ...

    def finish(self, frame_ids: Sequence[str], read: Callable[[str], FusedDetections]) -> None:
        """Write what belongs to all frames together, each of which ``read`` gives."""
        ...

    def written(self) -> Iterator[Path]:
        """The files that a run has written, to be removed when it is made anew."""
        ...


class Dataset(Protocol):
    """Frames by id, and everything that is different from one dataset to the next.

    Attributes:
        ids: names of the frames, in order.
        class_names: classes of the labels.
        camera_names: all cameras that a frame may have.
        used_cameras: the cameras that a single ``--camera`` stands for.
        stereo_pair: names of the left and the right camera of a stereo pair; None where there is none.
        preset: the settings that a run takes unless told otherwise, see `lcf3d.fusion.config.FusionConfig.load`.
        evaluation: ``module:name`` of its `lcf3d.evaluation.protocol.Evaluation`.
        native_from_canonical: (4, 4) the LiDAR frame that other tools use for it, from ours; None if they are equal.
    """

    ids: tuple[str, ...]
    class_names: tuple[str, ...]
    camera_names: tuple[str, ...]
    used_cameras: tuple[str, ...]
    stereo_pair: tuple[str, str] | None
    preset: str
    evaluation: str
    native_from_canonical: FloatArray | None

    def __len__(self) -> int: ...

    def frame(self, frame_id: str) -> Frame:
        """The frame of that id; its scan, images and labels are read when first asked for."""
        ...

    def require_complete(self, frame_ids: Sequence[str]) -> None:
        """See that everything that a run cannot do without is there, before any work begins."""
        ...

    def has_image(self, frame_id: str, camera: str) -> bool:
        """Whether there is an image, without reading it."""
        ...

    def lidar_results(self, path: Path, class_names: Sequence[str], missing: str = "error") -> LidarSource:
        """3D detections of another tool, from result files in the dataset's form or of a run folder."""
        ...

    def camera_results(self, path: Path, class_names: Sequence[str], missing: str = "error") -> CameraSource:
        """2D detections of another tool, from result files in the dataset's form."""
        ...

    def writer(self, folder: Path) -> ResultWriter:
        """What writes a run's results into a folder."""
        ...

    def describe(self) -> list[str]:
        """What was understood of the dataset, line by line, for people."""
        ...

    def check(self, results: Path | None = None, progress: Callable[[], None] = lambda: None) -> list[Finding]:
        """What is wrong with the dataset and, if given, with result files for it; ``progress`` is called a frame."""
        ...


class BaseDataset(Sequence[Frame]):
    """What most datasets have in common; see `Dataset` for each member.

    Without overriding, results are read and written as JSON files of our own, one a frame (`lcf3d.formats.plain`), and
    evaluated by centre distance (`lcf3d.evaluation.distance`).
    """

    ids: tuple[str, ...]
    class_names: tuple[str, ...]
    camera_names: tuple[str, ...]
    stereo_pair: tuple[str, str] | None = None
    preset: str = "default"
    evaluation: str = "lcf3d.evaluation.distance:DistanceEvaluation"
    # ``module:name`` of a `lcf3d.evaluation.protocol.TrackingEvaluation`, where labels have track numbers
    tracking: str | None = None
    native_from_canonical: FloatArray | None = None

    @abstractmethod
    def frame(self, frame_id: str) -> Frame:
        """The frame of that id."""

    @property
    def used_cameras(self) -> tuple[str, ...]:
        """The cameras that a single ``--camera`` stands for: all."""
        return self.camera_names

    def __len__(self) -> int:
        return len(self.ids)

    def __getitem__(self, index: int) -> Frame:  # type: ignore[override]
        return self.frame(self.ids[index])

    def require_complete(self, frame_ids: Sequence[str]) -> None:
        """Nothing is indispensable by itself."""

    def has_image(self, frame_id: str, camera: str) -> bool:
        """Whether the frame offers an image of that camera."""
        return camera in self.frame(frame_id).images

    def image_sizes(self) -> dict[str, tuple[int, int]]:
        """(width, height) by camera of the first frame."""
        cameras = self.frame(self.ids[0]).cameras if self.ids else ()
        return {camera.name: (camera.width, camera.height) for camera in cameras}

    def lidar_results(self, path: Path, class_names: Sequence[str], missing: str = "error") -> LidarSource:
        """3D detections in JSON files of our own."""
        from lcf3d.datasets.plain_results import PlainLidarResults

        return PlainLidarResults(path, class_names, missing)

    def camera_results(self, path: Path, class_names: Sequence[str], missing: str = "error") -> CameraSource:
        """2D detections in JSON files of our own."""
        from lcf3d.datasets.plain_results import PlainCameraResults

        return PlainCameraResults(path, class_names, missing, self.camera_names)

    def writer(self, folder: Path) -> ResultWriter:
        """One JSON file a frame."""
        from lcf3d.datasets.plain_results import PlainWriter

        return PlainWriter(folder)

    def describe(self) -> list[str]:
        """How many frames and which cameras there are."""
        return [f"{len(self)} frames, cameras {', '.join(self.camera_names)}, classes {', '.join(self.class_names)}"]

    def check(self, results: Path | None = None, progress: Callable[[], None] = lambda: None) -> list[Finding]:
        """The rules that hold for every dataset."""
        return check_frames(self, results, progress)


def require_missing(missing: str) -> str:
    """``missing``, if it is one of `MISSING`.

    Raises:
        ConfigError: it is not.
    """
    if missing not in MISSING:
        raise ConfigError(f"--missing takes error or empty, got {missing!r}")
    return missing


def require_folder(root: Path) -> Path:
    """``root``, if it is a folder.

    Raises:
        DatasetError: it is not.
    """
    if not root.is_dir():
        raise DatasetError(
            f"{root} is a file; name the folder of the dataset"
            if root.exists()
            else f"dataset folder {root} does not exist"
        )
    return root


def require_frames(dataset: Dataset, frame_ids: Sequence[str], name: str) -> tuple[str, ...]:
    """``frame_ids`` without doubles, if the dataset has them all; all of its frames if none are given.

    Raises:
        ConfigError: it lacks one; says which and what its first is.
    """
    known = set(dataset.ids)
    for frame_id in frame_ids:
        if frame_id not in known:
            first = f"; its first is {dataset.ids[0]!r}" if dataset.ids else ""
            raise ConfigError(f"{name} has no frame {frame_id!r} among its {len(dataset.ids)} frames{first}")
    return tuple(dict.fromkeys(frame_ids)) or dataset.ids


def by_camera(dataset: Dataset, sources: Mapping[str, CameraSource]) -> dict[str, CameraSource]:
    """Sources by camera name, checked against the dataset's cameras.

    Raises:
        ConfigError: there is no such camera.
    """
    for name in sources:
        if name not in dataset.camera_names:
            raise ConfigError(f"there is no camera {name!r}; the dataset has {', '.join(dataset.camera_names)}")
    return dict(sources)
