"""Results in nuScenes' JSON form: read as a branch of a run, written beside its provenance."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from lcf3d.detectors.joins import LeftOut, join_cameras, join_classes, require_pixels
from lcf3d.errors import FormatError
from lcf3d.formats.coco import read_camera_detections
from lcf3d.frame import Frame
from lcf3d.fusion.memory_identity import tracked
from lcf3d.provenance import FusedDetections
from lcf3d.structures import Detections2D, Detections3D, IntArray


class NuscenesLidarResults:
    """3D detections of a nuScenes submission file.

    The format wants a velocity of every box, and detectors that measure none write zeros. Where all of a file's boxes
    stand perfectly still, their velocities are taken as unknown, so that a memory may fill them in.

    Args:
        path: of the file, for messages.
        frames: by sample token, in canonical LiDAR frames.
        class_names: classes to take.
        missing: ``error`` refuses samples that the file lacks, ``empty`` takes them as samples without detections.
    """

    def __init__(
        self, path: Path, frames: Mapping[str, Detections3D], class_names: Sequence[str], missing: str = "error"
    ) -> None:
        self.path, self._frames, self.missing = path, _without_zero_velocities(frames), missing
        self.class_names = tuple(class_names)
        self.left_out = LeftOut(path)

    def load(self, frame_ids: Sequence[str]) -> None:
        """See that the file has these samples.

        Raises:
            FormatError: some are missing; says how many and which first.
        """
        absent = [token for token in frame_ids if token not in self._frames]
        if absent and (self.missing == "error" or len(absent) == len(frame_ids)):
            raise FormatError(
                f"{self.path} lacks {len(absent)} of {len(frame_ids)} samples, the first is {absent[0]}"
                + ("; --missing empty takes them as samples without detections" if self.missing == "error" else "")
            )
        if len(frame_ids) > 1:
            self._count(set(frame_ids))

    def _count(self, frame_ids: set[str]) -> None:
        """Note which detections are taken."""
        self.left_out = LeftOut(self.path)
        for token, found in self._frames.items():
            joined = join_classes(found.class_names, self.class_names)
            if token not in frame_ids:
                self.left_out.frames[token] += len(found)
                continue
            for label, count in Counter(found.labels.tolist()).items():
                name = found.class_names[label]
                if name in joined:
                    self.left_out.taken += count
                else:
                    self.left_out.classes[name] += count
        self.left_out.require_some(self.class_names)

    def detect(self, frame: Frame) -> Detections3D:
        """The detections of one sample in its LiDAR frame."""
        self.load([frame.id] if self.missing == "error" else [])
        found = self._frames.get(frame.id)
        if found is None:
            return Detections3D.empty(self.class_names)
        return found.with_classes(self.class_names, join_classes(found.class_names, self.class_names))


def _without_zero_velocities(frames: Mapping[str, Detections3D]) -> Mapping[str, Detections3D]:
    """The same frames, without velocities where all of them are exactly zero."""
    if any(found.velocities is not None and found.velocities.any() for found in frames.values()):
        return frames
    return {token: replace(found, velocities=None) for token, found in frames.items()}


class NuscenesCameraResults:
    """2D detections of a JSON list by sample and camera (see ``lcf3d.formats.coco``), with masks where it has some.

    Args:
        path: the JSON file.
        class_names: classes to take.
        camera_names: the dataset's cameras.
        sizes: (width, height) of the images by camera, to tell boxes of another form.

    Raises:
        FormatError: not such a list; names the record.
    """

    def __init__(
        self,
        path: str | Path,
        class_names: Sequence[str],
        camera_names: Sequence[str],
        sizes: Mapping[str, tuple[int, int]] | None = None,
    ) -> None:
        self.left_out = LeftOut(Path(path))
        self._class_names, self._camera_names = tuple(class_names), tuple(camera_names)
        found = read_camera_detections(Path(path), class_names, self.left_out)
        joined = join_cameras({camera for _, camera in found}, camera_names)
        self._found = {(token, joined[camera]): one for (token, camera), one in found.items() if camera in joined}
        for camera in camera_names:
            boxes = [one.boxes for (_, name), one in self._found.items() if name == camera]
            if boxes:
                require_pixels(np.concatenate(boxes), path, (sizes or {}).get(camera))
        for (_, camera), one in found.items():
            if camera not in joined:
                self.left_out.cameras[camera] += len(one)
        self._empty = Detections2D.empty(class_names)

    def load(self, frame_ids: Sequence[str]) -> None:
        """See that there are detections of these samples.

        Raises:
            DatasetError: all are of other samples, cameras or classes.
        """
        known = set(frame_ids)
        out = self.left_out
        out.frames = Counter()
        out.taken = 0
        for (token, _), one in self._found.items():
            if token in known:
                out.taken += len(one)
            else:
                out.frames[token] += len(one)
        out.require_some(self._class_names, self._camera_names)

    def sees(self, frame: Frame, camera: str) -> bool:
        """Always: a camera without detections looked and saw nothing."""
        return True

    def detect(self, frame: Frame, camera: str) -> Detections2D:
        """The detections of one camera of one sample, clipped to its image."""
        return self._found.get((frame.id, camera), self._empty).clipped(frame.camera(camera))


class NuscenesWriter:
    """Writes ``results.json``, one submission of all samples; samples that were not run have no boxes in it.

    A run with memory also gets ``tracking.json``, a tracking submission.

    Args:
        folder: of the run.
        write_results: writes detections by sample token, in canonical LiDAR frames, to a file.
        write_tracks: the same for detections and the track of each.
    """

    def __init__(
        self,
        folder: Path,
        write_results: Callable[[Path, Mapping[str, Detections3D]], None],
        write_tracks: Callable[[Path, Mapping[str, Detections3D], Mapping[str, IntArray]], None],
    ) -> None:
        self.path = folder / "results.json"
        self.tracking_path = folder / "tracking.json"
        self._write_results = write_results
        self._write_tracks = write_tracks

    def write(self, frame: Frame, fused: FusedDetections) -> None:
        """Nothing belongs to a single frame."""

    def is_done(self, frame_id: str) -> bool:
        """Always: nothing belongs to a single frame."""
        return True

    def finish(self, frame_ids: Sequence[str], read: Callable[[str], FusedDetections]) -> None:
        """Write the submission, and the tracks where there are any."""
        detections, boxes, ids = {}, {}, {}
        for frame_id in frame_ids:
            fused = read(frame_id)
            detections[frame_id] = fused.detections
            own = tracked(fused)
            if own is not None:
                boxes[frame_id], ids[frame_id] = fused.detections[own.rows], own.ids
        self._write_results(self.path, detections)
        if ids:
            self._write_tracks(self.tracking_path, boxes, ids)

    def written(self) -> Iterator[Path]:
        """The submissions."""
        yield from (path for path in (self.path, self.tracking_path) if path.is_file())
