"""A run in the forms that other tools load."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from lcf3d.datasets.base import Dataset
from lcf3d.errors import ConfigError, DatasetError
from lcf3d.files import write_json
from lcf3d.formats.labelling import ImageDetections, to_coco, to_fiftyone, to_label_studio
from lcf3d.geometry.camera import project_boxes
from lcf3d.remote.places import name_of
from lcf3d.run.conversion import convert_run
from lcf3d.run.folder import RunFolder
from lcf3d.run.table_folder import FORMS, open_run_folder
from lcf3d.structures import NUSCENES_CLASSES

IMAGE_FORMS = ("coco", "fiftyone", "label-studio")
SPACE_FORMS = ("nuscenes", "argoverse")
EXPORTS = (*FORMS, *IMAGE_FORMS, *SPACE_FORMS)
"""Forms that a run can be exported to: run folders, labels in images, submissions in space."""


def export_run(source: Path, dataset: Dataset, form: str, out: Path) -> int:
    """Write a run in another form; gives the number of frames.

    Args:
        source: run folder of either form.
        dataset: that it was made from.
        form: one of `EXPORTS`.
        out: a folder for run folders, else a file.

    Raises:
        ConfigError: an unknown form, or one that the run has not what it takes for.
        FormatError: the run cannot be read.
    """
    if form not in EXPORTS:
        raise ConfigError(f"--to takes {', '.join(EXPORTS)}, got {form!r}")
    if form in FORMS:
        return convert_run(source, dataset, out, form)
    if out.is_dir():
        raise ConfigError(f"--out {out} is a folder; {form} is one file")
    run = open_run_folder(source)
    frame_ids = _frames(run, dataset)
    if form in SPACE_FORMS:
        _write_space(run, dataset, frame_ids, form, out)
        return len(frame_ids)
    names = Classes()
    images = list(images_of_run(run, dataset, frame_ids, names))
    if form == "coco":
        write_json(out, to_coco(images, names.names))
    elif form == "fiftyone":
        write_json(out, to_fiftyone([_labelled(image) for image in images], names.names))
    else:
        write_json(out, to_label_studio([_labelled(image) for image in images], names.names, source.resolve().name))
    return len(frame_ids)


class Classes:
    """Class names of all frames, in the order in which they come."""

    def __init__(self) -> None:
        self.names: list[str] = []

    def numbers(self, names: Sequence[str]) -> np.ndarray:
        """(C,) number of each name."""
        self.names += [name for name in names if name not in self.names]
        return np.array([self.names.index(name) for name in names], dtype=np.int64)


def images_of_run(
    run: RunFolder, dataset: Dataset, frame_ids: Sequence[str], names: Classes
) -> Iterator[ImageDetections]:
    """The fused detections in every image of the cameras that the run used, frame after frame.

    A box is the 2D detection where one of that camera led to the output, else the projection of the 3D box.
    """
    for frame_id in frame_ids:
        frame, fused = dataset.frame(frame_id), run.read(frame_id)
        found = fused.detections
        labels = names.numbers(found.class_names)[found.labels] if len(found) else found.labels
        sentences = [fused.explain(i) for i in range(len(found))]
        for number, name in enumerate(fused.camera_names):
            camera = frame.camera(name)
            boxes, visible = project_boxes(found.boxes, camera)
            rows = np.flatnonzero((fused.camera.camera == number) & (fused.camera.output >= 0))
            outputs = fused.camera.output[rows]
            boxes[outputs] = fused.camera_inputs[number].boxes[fused.camera.detection[rows]]
            visible[outputs] = True
            kept = np.flatnonzero(visible)
            path = getattr(frame.images, "path", lambda name: None)(name)
            yield ImageDetections(
                f"{frame_id}/{name}",
                "" if path is None else name_of(path),
                (camera.width, camera.height),
                boxes[kept],
                labels[kept],
                np.clip(found.scores[kept], 0, 1),
                [sentences[i] for i in kept],
            )


def _frames(run: RunFolder, dataset: Dataset) -> list[str]:
    done = set(run.frame_ids())
    frame_ids = [frame_id for frame_id in dataset.ids if frame_id in done]
    if not frame_ids:
        raise ConfigError(f"{run.path} holds no finished frames of its dataset")
    return frame_ids


def _labelled(image: ImageDetections) -> ImageDetections:
    if not all(image.size):
        raise ConfigError(f"image {image.name} has no size, so boxes cannot be given as parts of it; export coco")
    return image


def _write_space(run: RunFolder, dataset: Dataset, frame_ids: Sequence[str], form: str, out: Path) -> None:
    """A submission of nuScenes or Argoverse 2."""
    found = {frame_id: run.read(frame_id).detections for frame_id in frame_ids}
    if form == "argoverse":
        from lcf3d.datasets.argoverse2_frames import results_of_frames
        from lcf3d.formats.argoverse import write_submission

        results = results_of_frames(found)
        if results.left_out:
            raise ConfigError(f"class {next(iter(results.left_out))!r} is none of Argoverse 2: not exported")
        write_submission(out, results)
        return
    from lcf3d.formats.nuscenes import write_submission as write_nuscenes
    from lcf3d.formats.nuscenes_boxes import global_from_detections

    for name in dict.fromkeys(name for one in found.values() for name in np.array(one.class_names)[one.labels]):
        if name not in NUSCENES_CLASSES:
            raise ConfigError(f"class {str(name)!r} is none of nuScenes: not exported")
    poses = {}
    for frame_id in frame_ids:
        pose = dataset.frame(frame_id).world_from_lidar
        if pose is None:
            raise DatasetError(f"frame {frame_id} has no pose, and nuScenes' form is in world coordinates")
        poses[frame_id] = pose
    write_nuscenes(out, global_from_detections(found, poses, frame_ids), {"use_camera": True, "use_lidar": True})
