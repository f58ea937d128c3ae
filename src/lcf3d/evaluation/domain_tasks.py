"""The tasks of a domain-shift experiment: a detector of one dataset on the frames of another (paper section 5.8)."""

from __future__ import annotations

import shlex
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

from lcf3d.datasets.base import CameraSource, LidarSource
from lcf3d.datasets.opening import named, open_dataset
from lcf3d.errors import ConfigError, DatasetError
from lcf3d.evaluation.domain_shift import (
    LABEL_CLASSES,
    AdaptedFrames,
    AdaptedLidar,
    ShiftMetrics,
    Truth,
    camera_in_kitti_classes,
    evaluate_shift,
    find_domain,
    in_kitti_classes,
    split_truth,
)
from lcf3d.frame import Frame
from lcf3d.fusion.config import FusionConfig
from lcf3d.fusion.pipeline import LateCascadeFusion
from lcf3d.run.sources import DetectorOnFrames, LidarOnScans, open_cameras, open_lidar
from lcf3d.run.teaching import find_calibration
from lcf3d.structures import KITTI_CLASSES, NUSCENES_CLASSES, Camera, Detections2D, Detections3D

FRONT = {"kitti": "left", "nuscenes": "CAM_FRONT"}
"""Front camera by kind of dataset."""

LIDAR_ALONE, FUSED = "LiDAR", "fused"
_KEYS = ("lidar", "camera", "fused", "split", "calibration")
_EXAMPLE = "'kitti->nuscenes nuscenes:ROOT lidar=results:FILE camera=results:FILE split=mini_val'"


@dataclass(frozen=True)
class DomainTask:
    """One task ``trained -> tested``.

    Attributes:
        trained: domain that the LiDAR detector was trained on; its beginning says what kind, see `find_domain`.
        tested: name of the test data; tasks of equal name share their charts.
        dataset: ``kitti:ROOT`` or ``nuscenes:ROOT``.
        lidar: LiDAR detector, ``kind:argument``.
        camera: camera detector, or None where only ``lidar`` and ``fused`` are evaluated.
        fused: results of another fusion, ``results:PATH``, evaluated instead of fusing here.
        split: split of the dataset.
        calibration: score calibration: a file, ``auto`` (without labels, where LiDAR scores leave [0, 1]) or ``none``.
    """

    trained: str
    tested: str
    dataset: str
    lidar: str
    camera: str | None = None
    fused: str | None = None
    split: str | None = None
    calibration: str = "auto"

    @property
    def name(self) -> str:
        """``trained -> tested``."""
        return f"{self.trained} -> {self.tested}"


def parse_task(text: str) -> DomainTask:
    """A task from ``TRAINED->TESTED DATASET lidar=SPEC [camera=SPEC] [split=NAME] ...``, words quoted as in a shell.

    Raises:
        ConfigError: a part is missing, unknown or given twice.
    """
    try:
        words = shlex.split(text)
    except ValueError as error:
        raise ConfigError(f"task {text!r} cannot be read ({error})") from None
    trained, arrow, tested = words[0].partition("->") if words else ("", "", "")
    if not (trained and arrow and tested) or len(words) < 2 or words[1].partition("=")[0] in _KEYS:
        raise ConfigError(f"a task begins with TRAINED->TESTED and a dataset, for example {_EXAMPLE}; got {text!r}")
    values: dict[str, str] = {}
    for word in words[2:]:
        key, equals, value = word.partition("=")
        if key not in _KEYS or not equals or not value or key in values:
            raise ConfigError(f"task {text!r}: expected each of {', '.join(_KEYS)} once as name=value, got {word!r}")
        values[key] = value
    if "lidar" not in values:
        raise ConfigError(f"task {text!r} names no LiDAR detector; add lidar=SPEC, as in {_EXAMPLE}")
    if "camera" in values and "fused" in values:
        raise ConfigError(f"task {text!r}: give camera= to fuse here, or fused= for results that are fused, not both")
    if values.get("fused", "results:").partition(":")[0] != "results":
        raise ConfigError(f"task {text!r}: fused= takes results:PATH, got {values['fused']!r}")
    find_domain(trained)
    return DomainTask(trained, tested, words[1], **values)


@dataclass(frozen=True)
class _InKittiClasses:
    """A LiDAR branch in KITTI's classes."""

    source: LidarSource

    def detect(self, frame: Frame) -> Detections3D:
        """3D detections of one frame."""
        return in_kitti_classes(self.source.detect(frame))


@dataclass(frozen=True)
class _CameraInKittiClasses:
    """A camera branch in KITTI's classes."""

    source: CameraSource

    def sees(self, frame: Frame, camera: str) -> bool:
        """Whether there is anything to detect from."""
        return self.source.sees(frame, camera)

    def detect(self, frame: Frame, camera: str) -> Detections2D:
        """2D detections of one camera of one frame."""
        return camera_in_kitti_classes(self.source.detect(frame, camera))


class DomainTaskRunner:
    """A task with its dataset and detectors opened, ready to be run.

    Args:
        task: what to run.
        config: fusion settings, in KITTI's classes.

    Raises:
        Lcf3dError: dataset, result files or detectors are wrong.
    """

    def __init__(self, task: DomainTask, config: FusionConfig) -> None:
        if set(config.class_names) != set(KITTI_CLASSES):
            raise ConfigError(
                f"domain shift is evaluated in the classes {', '.join(KITTI_CLASSES)}; the settings have "
                f"{', '.join(config.class_names)}"
            )
        self.task = task
        self.config = config
        self.kind = named(task.dataset).kind
        self.dataset = open_dataset(task.dataset, split=task.split)
        self.dataset.class_names = LABEL_CLASSES if self.kind == "kitti" else self.dataset.class_names
        self.dataset.require_complete(self.dataset.ids)
        self.front = FRONT.get(self.kind, self.dataset.used_cameras[0])
        self.lidar = self._lidar(task.lidar)
        self.camera = self._camera(task.camera) if task.camera else None
        self.fused = self._lidar(task.fused) if task.fused else None

    def __len__(self) -> int:
        return len(self.dataset)

    def __call__(
        self, class_names: Sequence[str] = KITTI_CLASSES, advance: Callable[[], None] = lambda: None
    ) -> dict[str, ShiftMetrics]:
        """Metrics of each method, ``LiDAR`` and, where there is a camera branch or a fused result, ``fused``.

        Args:
            class_names: which of KITTI's classes to evaluate.
            advance: called after each frame.

        Raises:
            DatasetError: frames without labels or without the front camera.
        """
        truths: list[Truth] = []
        cameras: list[Camera] = []
        found: dict[str, list[Detections3D]] = {LIDAR_ALONE: []}
        adapted = isinstance(self.lidar, AdaptedLidar | AdaptedFrames)
        fusion = (
            LateCascadeFusion(
                self.config,
                calibration=find_calibration(
                    # a detector that runs here gives probabilities
                    "none" if adapted and self.task.calibration == "auto" else self.task.calibration,
                    self.dataset,
                    self.dataset.ids,
                    _InKittiClasses(self.lidar),
                    {self.front: _CameraInKittiClasses(self.camera)},
                    self.config,
                ),
            )
            if self.camera
            else None
        )
        for frame in self._frames():
            if frame.labels is None:
                raise DatasetError(f"{self.task.dataset}: frame {frame.id} has no labels; evaluation needs them")
            truths.append(split_truth(frame.labels))
            cameras.append(frame.camera(self.front))
            lidar = in_kitti_classes(self.lidar.detect(frame))
            found[LIDAR_ALONE].append(lidar)
            if fusion is not None:
                fused = fusion(frame, lidar, self._seen(frame))
                found.setdefault(FUSED, []).append(fused.detections.with_classes(KITTI_CLASSES))
            elif self.fused is not None:
                found.setdefault(FUSED, []).append(in_kitti_classes(self.fused.detect(frame)))
            advance()
        return {method: evaluate_shift(truths, frames, cameras, class_names) for method, frames in found.items()}

    def _frames(self, step: int = 1) -> Iterator[Frame]:
        for frame_id in self.dataset.ids[::step]:
            yield self.dataset.frame(frame_id)

    def _seen(self, frame: Frame) -> dict[str, Detections2D]:
        """2D detections of the front camera; none where it has no image."""
        if self.camera is None or not self.camera.sees(frame, self.front):
            return {}
        return {self.front: camera_in_kitti_classes(self.camera.detect(frame, self.front))}

    def _lidar(self, text: str) -> LidarSource:
        source = open_lidar(text, self.dataset, self._names(text.partition(":")[0]))
        domains = find_domain(self.kind), find_domain(self.task.trained)
        if isinstance(source, LidarOnScans):
            return AdaptedLidar(source.detector, *domains, self.front)
        if isinstance(source, DetectorOnFrames):
            return AdaptedFrames(source.detector, *domains, self.front)
        return source

    def _camera(self, text: str) -> CameraSource:
        names = (*KITTI_CLASSES, *NUSCENES_CLASSES) if text.startswith("results:") else KITTI_CLASSES
        return open_cameras({self.front: text}, self.dataset, names)[self.front]

    def _names(self, kind: str) -> Sequence[str]:
        """Class names to ask of a LiDAR detector: those it was trained with, or of files of either vocabulary."""
        if kind == "results":
            return (*KITTI_CLASSES, *NUSCENES_CLASSES)
        return KITTI_CLASSES if find_domain(self.task.trained).name == "kitti" else NUSCENES_CLASSES
