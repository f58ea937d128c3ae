"""The folder that ``lcf3d run`` writes: results, provenance and the settings that made them.

OUT/config.yaml          the settings used
OUT/run.json             what was run: dataset, detectors, version
OUT/calibration.json     the score calibration used, if any
OUT/provenance/ID.json   why each input and output of the frame is there or not
OUT/data/ID.txt          KITTI: result file of a frame
OUT/results.json         nuScenes: submission of all samples
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from lcf3d.errors import ConfigError
from lcf3d.files import read_json, write_json
from lcf3d.formats.kitti import objects_from_detections, write_objects
from lcf3d.fusion.config import FusionConfig
from lcf3d.geometry.camera import project_boxes
from lcf3d.provenance import FusedDetections
from lcf3d.structures import FloatArray, Frame

if TYPE_CHECKING:
    from lcf3d.datasets.nuscenes import NuscenesDataset


class RunFolder:
    """Reads and writes one run folder; every file appears whole or not at all.

    Args:
        path: the folder.
    """

    def __init__(self, path: Path | str) -> None:
        self.path = Path(path)

    @property
    def calibration_path(self) -> Path:
        """The score calibration used."""
        return self.path / "calibration.json"

    def provenance_path(self, frame_id: str) -> Path:
        """The provenance file of a frame."""
        return self.path / "provenance" / f"{frame_id}.json"

    def begin(self, config: FusionConfig, run: dict[str, Any], *, resume: bool, overwrite: bool) -> None:
        """Write the settings, unless the folder already holds a run.

        Raises:
            ConfigError: it holds one and neither ``resume`` nor ``overwrite`` is set, or ``resume`` is and that run had
                other settings or inputs.
        """
        settings, inputs = self.path / "config.yaml", self.path / "run.json"
        if self.path.is_file():
            raise ConfigError(f"{self.path} is a file; choose a folder for --out")
        occupied = self.path.is_dir() and any(self.path.iterdir())
        if occupied and not overwrite:
            if not resume:
                raise ConfigError(f"{self.path} is not empty; pass --resume, --overwrite or another --out")
            same = settings.is_file() and settings.read_text(encoding="utf-8") == config.to_yaml()
            if not same or not inputs.is_file() or read_json(inputs) != run:
                raise ConfigError(
                    f"{self.path} holds a run with other settings or inputs, so it cannot be resumed; "
                    "pass --overwrite or another --out"
                )
        elif occupied:
            if not inputs.is_file():
                raise ConfigError(f"{self.path} holds files of something else; choose another --out")
            for file in (*self.path.glob("data/*.txt"), *self.path.glob("provenance/*.json"), self.calibration_path):
                file.unlink(missing_ok=True)
        write_json(inputs, run)
        config.dump(settings)

    def is_done(self, frame_id: str) -> bool:
        """Whether the files of a frame are there."""
        return self.provenance_path(frame_id).is_file()

    def write(self, frame: Frame, fused: FusedDetections) -> None:
        """Write the files of a frame."""
        write_json(self.provenance_path(frame.id), fused.to_json(), indent=None)

    def finish(self, frame_ids: Sequence[str]) -> None:
        """Write what belongs to all frames together; nothing here."""

    def read(self, frame_id: str) -> FusedDetections:
        """The result of a frame with its provenance.

        Raises:
            FormatError: it is not there or not readable.
        """
        return FusedDetections.from_json(read_json(self.provenance_path(frame_id)))


class KittiRunFolder(RunFolder):
    """A run on KITTI layout, with a result file a frame."""

    def result_path(self, frame_id: str) -> Path:
        """The KITTI result file of a frame."""
        return self.path / "data" / f"{frame_id}.txt"

    def is_done(self, frame_id: str) -> bool:
        """Whether both files of a frame are there."""
        return self.result_path(frame_id).is_file() and super().is_done(frame_id)

    def write(self, frame: Frame, fused: FusedDetections) -> None:
        """Write the two files of a frame, the result last."""
        super().write(frame, fused)
        camera_from_lidar = frame.cameras[0].camera_from_lidar
        objects = objects_from_detections(fused.detections, image_boxes(frame, fused), camera_from_lidar)
        write_objects(self.result_path(frame.id), objects)


class NuscenesRunFolder(RunFolder):
    """A run on nuScenes, with one submission file of all samples.

    Args:
        path: the folder.
        dataset: the samples.
    """

    def __init__(self, path: Path | str, dataset: NuscenesDataset) -> None:
        super().__init__(path)
        self.dataset = dataset

    @property
    def result_path(self) -> Path:
        """The submission file."""
        return self.path / "results.json"

    def finish(self, frame_ids: Sequence[str]) -> None:
        """Write the submission from the samples' provenance files; samples not run have no boxes in it."""
        detections = {frame_id: self.read(frame_id).detections for frame_id in frame_ids}
        self.dataset.write_results(self.result_path, detections)


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
