"""Labelled images that the camera detector learns from, made of simulated samples or of a KITTI folder."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import PIL.Image
from numpy.typing import NDArray

from lcf3d.datasets.images import read_image as read_image_file
from lcf3d.datasets.kitti import KittiDataset
from lcf3d.errors import DatasetError
from lcf3d.formats.kitti import read_objects
from lcf3d.structures import KITTI_CLASSES, FloatArray, IntArray
from lcf3d.training.samples import ImageSample, read_image

IGNORED, ABSENT = -1, -2
"""Label of objects that are neither to be found nor background, and of rows without an object."""
# objects of which more is covered are neither demanded nor forbidden
MOST_HIDDEN = 0.85
# vans are cars; who sits may be found or not; trucks, trams and the rest are background that must not be found
LABELS = {"Car": 0, "Van": 0, "Pedestrian": 1, "Cyclist": 2, "Person_sitting": IGNORED, "DontCare": IGNORED}
# KITTI's level of occlusion for what cannot be told, and the simulation's for what is almost hidden
UNKNOWN_OCCLUSION = 3


@dataclass(frozen=True, eq=False)
class LabelledImage:
    """An image with the objects to find in it.

    Attributes:
        image: (H, W, 3) uint8 RGB.
        boxes: (A, 4) pixel bounds of whole objects, whatever hides them, clipped to the image.
        visible: (A, 4) pixel bounds of what can be seen; equal to ``boxes`` where it is not known.
        labels: (A,) indices into `KITTI_CLASSES`, or `IGNORED`.
        owner: (H, W) uint8 number of the object in each pixel, or None without masks.
        numbers: (A,) uint8 the objects' numbers in ``owner``.
    """

    image: NDArray[np.uint8]
    boxes: FloatArray
    visible: FloatArray
    labels: IntArray
    owner: NDArray[np.uint8] | None
    numbers: NDArray[np.uint8]


def from_sample(sample: ImageSample, masks: bool = True) -> LabelledImage:
    """A simulated sample as a labelled image; too much hidden objects are ignored."""
    known = np.array([str(name) in LABELS for name in sample.names], dtype=bool)
    labels = np.array([LABELS.get(str(name), IGNORED) for name in sample.names], dtype=np.int64)
    labels[sample.hidden > MOST_HIDDEN] = IGNORED
    numbers = np.arange(1, len(labels) + 1, dtype=np.uint8)
    return LabelledImage(
        sample.image,
        sample.boxes[known],
        sample.visible[known],
        labels[known],
        sample.owner if masks else None,
        numbers[known],
    )


def read_samples(paths: Sequence[Path], masks: bool = True) -> list[LabelledImage]:
    """Labelled images of simulated samples.

    Raises:
        FormatError: a file is no sample with an image.
    """
    return [from_sample(read_image(path), masks) for path in paths]


def read_kitti(root: Path, split: str | None, size: tuple[int, int]) -> list[LabelledImage]:
    """Labelled images (without masks) of the left camera of a KITTI folder, shrunk to fit into ``size``.

    Args:
        root: the folder.
        split: of ``ImageSets``; None for all frames.
        size: (height, width) that images shall not exceed.

    Raises:
        DatasetError: no frame of the split has both an image and labels.
    """
    dataset = KittiDataset(root, split)
    images = []
    for frame_id in dataset.ids:
        path, label = dataset.image_paths(frame_id).get("left"), dataset.folder / "label_2" / f"{frame_id}.txt"
        if path is None or not label.is_file():
            continue
        objects = read_objects(label, results=False)
        known = np.array([str(name) in LABELS for name in objects.class_names], dtype=bool)
        labels = np.array([LABELS.get(str(name), IGNORED) for name in objects.class_names], dtype=np.int64)
        labels[objects.occluded >= UNKNOWN_OCCLUSION] = IGNORED
        image = read_image_file(path)
        scale = min(1.0, size[0] / image.shape[0], size[1] / image.shape[1])
        if scale < 1:
            shrunk = (max(1, round(image.shape[1] * scale)), max(1, round(image.shape[0] * scale)))
            image = np.asarray(PIL.Image.fromarray(image).resize(shrunk, PIL.Image.Resampling.BILINEAR))
        boxes = objects.boxes2d[known] * scale
        images.append(LabelledImage(image, boxes, boxes, labels[known], None, np.zeros(len(boxes), dtype=np.uint8)))
    if not images:
        raise DatasetError(f"no frame of {root} (split {split}) has both an image in image_2 and labels in label_2")
    return images


def drive_images() -> list[LabelledImage]:
    """The images of the drive that comes with the package (without masks), boxes projected from the 3D labels."""
    from lcf3d.datasets.drive import read_drive
    from lcf3d.geometry.camera import project_boxes

    images = []
    for frame in read_drive():
        objects = frame.objects
        boxes, seen = project_boxes(objects.boxes, frame.camera)
        kept = seen & np.array([str(name) in LABELS for name in objects.class_names], dtype=bool)
        labels = np.array([LABELS.get(str(name), IGNORED) for name in objects.class_names], dtype=np.int64)
        labels[objects.occluded >= UNKNOWN_OCCLUSION] = IGNORED
        numbers = np.zeros(int(kept.sum()), dtype=np.uint8)
        images.append(LabelledImage(frame.image, boxes[kept], objects.boxes2d[kept], labels[kept], None, numbers))
    return images


def class_counts(images: Sequence[LabelledImage]) -> dict[str, int]:
    """Number of objects to find, by class."""
    labels = np.concatenate([np.zeros(0, np.int64), *(image.labels for image in images)])
    return {name: int((labels == index).sum()) for index, name in enumerate(KITTI_CLASSES)}
