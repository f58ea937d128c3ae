"""Results in Argoverse 2's submission form: read as a branch of a run, written beside its provenance."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

from lcf3d.datasets.argoverse2_frames import detections_by_frame, id_of, results_of_frames, split_id
from lcf3d.detectors.joins import LeftOut, join_classes
from lcf3d.errors import DatasetError
from lcf3d.formats.argoverse import read_submission, write_submission
from lcf3d.frame import Frame
from lcf3d.provenance import FusedDetections
from lcf3d.structures import ARGOVERSE_CLASSES, Detections3D

FILE_NAME = "results.feather"


def result_file(path: str | Path) -> Path:
    """The feather file that ``path`` is, or that a run folder holds."""
    path = Path(path).expanduser()
    return path / FILE_NAME if path.is_dir() else path


class ArgoverseLidarResults:
    """3D detections of a feather file. A sweep without a line in it has no detections.

    Args:
        path: the file, or a run folder.
        frame_ids: the frames; boxes of other sweeps are left out.
        class_names: classes to take.
        missing: ``error`` refuses a file that lacks a whole log, ``empty`` takes it as one without detections.

    Raises:
        FormatError: not such a file.
        DatasetError: it holds none of the frames, or lacks a log.
    """

    def __init__(self, path: Path, frame_ids: Sequence[str], class_names: Sequence[str], missing: str) -> None:
        path = result_file(path)
        found = read_submission(path)
        self.class_names = tuple(class_names)
        self._empty = Detections3D.empty(class_names)
        self._frames = detections_by_frame(found)
        if frame_ids and len(found) and not self._frames.keys() & set(frame_ids):
            first = id_of(found.log_ids[found.logs[0]], int(found.timestamps_ns[0]))
            raise DatasetError(
                f"{path} holds boxes of {len(self._frames)} sweeps, but of none of the {len(frame_ids)} frames; "
                f"the first there is {first}, the first frame {frame_ids[0]}"
            )
        self.left_out = LeftOut(path)
        known = set(frame_ids)
        for frame_id, one in self._frames.items():
            joined = join_classes(one.class_names, self.class_names)
            for label, count in Counter(one.labels.tolist()).items():
                name = one.class_names[label]
                if frame_id not in known:
                    self.left_out.frames[frame_id] += count
                elif name in joined:
                    self.left_out.taken += count
                else:
                    self.left_out.classes[name] += count
        logs = list(dict.fromkeys(split_id(id)[0] for id in frame_ids))
        absent = [log for log in logs if log not in found.log_ids]
        if absent and missing == "error":
            raise DatasetError(
                f"{path} lacks {len(absent)} of {len(logs)} logs, first {absent[0]}; "
                "add them, or ask for missing results to be taken as empty"
            )

    def detect(self, frame: Frame) -> Detections3D:
        """The detections of one frame in its LiDAR frame."""
        found = self._frames.get(frame.id)
        return (
            self._empty
            if found is None
            else found.with_classes(self.class_names, join_classes(found.class_names, self.class_names))
        )


class ArgoverseWriter:
    """Writes ``results.feather``, all frames in the submission form.

    Args:
        folder: of the run.
    """

    def __init__(self, folder: Path) -> None:
        self.path = folder / FILE_NAME

    def write(self, frame: Frame, fused: FusedDetections) -> None:
        """Nothing belongs to a single frame."""

    def is_done(self, frame_id: str) -> bool:
        """Always: nothing belongs to a single frame."""
        return True

    def finish(self, frame_ids: Sequence[str], read: Callable[[str], FusedDetections]) -> None:
        """Write the file.

        Raises:
            DatasetError: boxes of classes that the submission form does not know; names one.
        """
        results = results_of_frames({id: read(id).detections for id in frame_ids})
        if results.left_out:
            name = next(iter(results.left_out))
            raise DatasetError(
                f"cannot write {self.path}: class {name!r} is none of Argoverse 2; map it to one of "
                f"{', '.join(ARGOVERSE_CLASSES[:4])} ..."
            )
        write_submission(self.path, results)

    def written(self) -> Iterator[Path]:
        """The file."""
        if self.path.is_file():
            yield self.path
