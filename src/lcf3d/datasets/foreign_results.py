"""3D detections in the files of other tools: OpenPCDet's ``result.pkl``, mmdet3d's ``pred_instances_3d``.

- OpenPCDet: a pickled list of records, ``boxes_lidar``, ``score``, ``name``, ``frame_id`` (and, of nuScenes,
  ``metadata`` with the token of the sample).
- mmdet3d: a folder of JSON files ``ID.json`` with ``bboxes_3d``, ``scores_3d``, ``labels_3d`` (what its inferencers
  write into ``preds``), or a pickled or JSON list of such records, each with its ``sample_idx`` or ``frame_id``.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from lcf3d.detectors.classes import class_mapping, read_class_names, to_classes
from lcf3d.detectors.joins import LeftOut
from lcf3d.errors import ConfigError, DatasetError, FormatError, Lcf3dError
from lcf3d.files import list_files, read_json, reading
from lcf3d.formats.objects3d import from_mmdet3d, from_openpcdet
from lcf3d.formats.pickles import read_arrays
from lcf3d.frame import Frame
from lcf3d.geometry.boxes import transform_boxes
from lcf3d.structures import Detections3D, FloatArray

_NAMES = ("sample_idx", "frame_id", "token", "sample_token")


def is_foreign(path: Path) -> bool:
    """Whether a path holds results of OpenPCDet or mmdet3d, by its ending or by what its first file has in it."""
    if path.suffix in (".pkl", ".pickle"):
        return True
    if path.is_dir():
        first = next(iter(list_files(path, ".json")), None)
        return first is not None and _has_boxes(first)
    return path.suffix == ".json" and path.is_file() and _has_boxes(path)


def _has_boxes(path: Path) -> bool:
    with path.open("rb") as file:
        return b'"bboxes_3d"' in file.read(1 << 16)


class ForeignLidarResults:
    """3D detections of OpenPCDet or mmdet3d as a LiDAR branch.

    Args:
        path: file or folder, see the module.
        frame_ids: the dataset's frames.
        class_names: classes to take; those of the file are mapped to them by name.
        missing: ``error`` refuses results that lack frames, ``empty`` takes them as frames without detections.
        classes: what the numbers of mmdet3d's labels stand for: names with commas, or a file of them.
        native_from_canonical: (4, 4) the LiDAR frame that other tools use for the dataset, from ours; None if equal.

    Raises:
        ConfigError: mmdet3d's numbers without ``classes``.
        DatasetError: frames are missing, records belong to no frame, or no class of theirs is wanted.
        FormatError: a file that cannot be read as such results; names file and record.
    """

    def __init__(
        self,
        path: Path,
        frame_ids: Sequence[str],
        class_names: Sequence[str],
        missing: str = "error",
        classes: str | Sequence[str] = "",
        native_from_canonical: FloatArray | None = None,
    ) -> None:
        self.class_names = tuple(class_names)
        own = read_class_names(classes)
        records = _read_records(path, set(frame_ids))
        self._check_join(path, list(frame_ids), records, missing)
        turn: FloatArray | None = None
        if native_from_canonical is not None:
            turn = np.asarray(np.linalg.inv(native_from_canonical), dtype=np.float64)
        self._frames: dict[str, Detections3D] = {}
        names: set[str] = set()
        self.left_out = LeftOut(path)
        known = set(frame_ids)
        with reading(path, "detections"):
            for frame_id, record in records.items():
                found = _convert(record, own, path, frame_id)
                names |= {found.class_names[i] for i in np.unique(found.labels)}
                if turn is not None:
                    velocities = found.velocities
                    found = Detections3D(
                        transform_boxes(found.boxes, turn),
                        found.scores,
                        found.labels,
                        found.class_names,
                        None if velocities is None else velocities @ turn[:2, :2].T,
                    )
                self._frames[frame_id] = to_classes(found, self.class_names)
                if frame_id not in known:
                    self.left_out.frames[frame_id] += len(found)
                    continue
                taken = class_mapping(found.class_names, self.class_names)
                for label in found.labels.tolist():
                    name = found.class_names[label]
                    if name not in taken:
                        self.left_out.classes[name] += 1
                self.left_out.taken += len(self._frames[frame_id])
        if names and not any(len(found) for found in self._frames.values()):
            raise DatasetError(
                f"{path} has detections of {', '.join(sorted(names))}, none of the classes {', '.join(class_names)}"
            )

    @staticmethod
    def _check_join(path: Path, frame_ids: Sequence[str], records: Mapping[str, Any], missing: str) -> None:
        known = set(frame_ids)
        strange = [frame_id for frame_id in records if frame_id not in known]
        absent = [frame_id for frame_id in frame_ids if frame_id not in records]
        if records and len(strange) == len(records):
            raise DatasetError(
                f"{path} has results of {len(records)} frames, first {strange[0]!r}, none of them of the dataset, "
                f"whose first is {frame_ids[0]!r}"
            )
        if absent and (missing == "error" or not records):
            raise DatasetError(
                f"{path} lacks the results of {len(absent)} of {len(frame_ids)} frames, first {absent[0]}"
            )

    def detect(self, frame: Frame) -> Detections3D:
        """The detections of one frame in its LiDAR frame."""
        return self._frames.get(frame.id, Detections3D.empty(self.class_names))


def _read_records(path: Path, known: set[str]) -> dict[str, Mapping[str, Any]]:
    """Record by frame."""
    if path.is_dir():
        return {file.stem: read_json(file) for file in list_files(path, ".json")}
    content = read_json(path) if path.suffix == ".json" else read_arrays(path)
    if isinstance(content, Mapping) and "bboxes_3d" in content:
        return {path.stem: content}
    if not isinstance(content, list) or not all(isinstance(record, Mapping) for record in content):
        raise FormatError(f"{path} must hold a list of records, one a frame, got {type(content).__name__}")
    records: dict[str, Mapping[str, Any]] = {}
    for number, record in enumerate(content):
        frame_id = _frame_of(record, known)
        if frame_id is None:
            raise FormatError(f"{path}: record {number} names no frame; expected one of {', '.join(_NAMES)}")
        if frame_id in records:
            raise FormatError(f"{path}: record {number} is a second one of frame {frame_id}")
        records[frame_id] = record
    return records


def _frame_of(record: Mapping[str, Any], known: set[str]) -> str | None:
    """The frame of a record: of its names the one that the dataset knows, else the first; numbers as KITTI has them."""
    metadata = record.get("metadata")
    sources = [metadata if isinstance(metadata, Mapping) else {}, record]
    names = [str(source[name]) for source in sources for name in _NAMES if name in source]
    names += [name.zfill(6) for name in names if name.isdigit()]
    return next((name for name in names if name in known), names[0] if names else None)


def _convert(record: Mapping[str, Any], classes: Sequence[str], path: Path, frame_id: str) -> Detections3D:
    with np.errstate(invalid="raise", over="raise"), reading(f"{path}: frame {frame_id}", "detections"):
        return _converted(record, classes, path, frame_id)


def _converted(record: Mapping[str, Any], classes: Sequence[str], path: Path, frame_id: str) -> Detections3D:
    try:
        if "boxes_lidar" in record:
            return from_openpcdet(record)
        if not classes:
            raise ConfigError(
                f"{path} has numbers for classes: say what they stand for, results:{path}?classes=NAME,NAME,... "
                "in the order of the model's dataset_meta['classes']"
            )
        return from_mmdet3d(record, classes)
    except ConfigError:
        raise
    except (Lcf3dError, ValueError, TypeError, IndexError) as error:
        raise FormatError(f"{path}: the record of frame {frame_id} is malformed: {error}") from None
