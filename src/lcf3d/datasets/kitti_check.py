"""Sanity rules of a KITTI-layout folder, and of result files that belong to it."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Protocol

import numpy as np

from lcf3d.datasets.check import Finding
from lcf3d.datasets.images import read_image
from lcf3d.detectors.joins import join_classes
from lcf3d.errors import Lcf3dError
from lcf3d.formats.kitti import KittiObjects, read_objects
from lcf3d.frame import Frame
from lcf3d.geometry.boxes import points_in_boxes
from lcf3d.geometry.camera import project_boxes
from lcf3d.geometry.iou import image_iou

RULES = {
    "KIT01": "every frame of the split has a readable calibration",
    "KIT02": "images, where there are any, can be read and fit their calibration",
    "KIT03": "scans, where there are any, are whole and hold finite points",
    "KIT04": "labels, where there are any, are well-formed",
    "KIT05": "label classes are KITTI's",
    "KIT06": "visible labels: the projected 3D box lies on the 2D box (else calibration and labels disagree)",
    "KIT07": "near, visible labels hold points of the scan (else scan and calibration disagree)",
    "KIT08": "every frame has a scan, an image and a label",
    "KIT09": "left and right image of a frame are of one size",
    "KIT10": "the result folder has a file for every frame",
    "KIT11": "result files are well-formed",
    "KIT12": "scores lie in [0, 1] (else a calibration is needed)",
    "KIT13": "classes of results are KITTI's, without regard to case and with common other names",
}
LABEL_CLASSES = ("Car", "Van", "Truck", "Pedestrian", "Person_sitting", "Cyclist", "Tram", "Misc", "DontCare")
# a label that is easy to see: at least so many pixels high, not truncated, not occluded
CLEAR_HEIGHT = 40
NEAR_METRES = 30
LEAST_IOU = 0.3


class KittiFrames(Protocol):
    """What the rules ask of a KITTI dataset."""

    @property
    def ids(self) -> tuple[str, ...]:
        """The frames."""
        ...

    folder: Path

    def __len__(self) -> int: ...

    def calibration(self, frame_id: str) -> object:
        """The calibration of a frame."""
        ...

    def frame(self, frame_id: str) -> Frame:
        """The frame of that id."""
        ...

    def image_paths(self, frame_id: str) -> dict[str, Path]:
        """The image files of a frame, by camera name."""
        ...


def check_kitti(
    dataset: KittiFrames, results: Path | None = None, progress: Callable[[], None] = lambda: None
) -> list[Finding]:
    """Everything that the rules find wrong with a dataset and, if given, with a folder of results for it.

    Args:
        dataset: the frames to look at; scans and images are read.
        results: folder of KITTI result files, or None.
        progress: called after every frame.
    """
    findings: list[Finding] = []
    absent: dict[str, list[str]] = {"scan": [], "image": [], "label": []}
    for frame_id in dataset.ids:
        rule = "KIT01"
        try:
            dataset.calibration(frame_id)
            rule = "KIT02"  # with a calibration, only an image can be wrong
            frame = dataset.frame(frame_id)
        except Lcf3dError as error:
            findings.append(Finding(rule, "error", str(error)))
        else:
            findings += _check_frame(dataset, frame, absent)
        progress()
    for what, frame_ids in absent.items():
        if frame_ids:
            first = f"first {frame_ids[0]}"
            findings.append(
                Finding("KIT08", "warning", f"{len(frame_ids)} of {len(dataset)} frames have no {what}, {first}")
            )
    if results is not None:
        findings += check_results(dataset.ids, results)
    return findings


def _check_frame(dataset: KittiFrames, frame: Frame, absent: dict[str, list[str]]) -> Iterator[Finding]:
    """Findings of one frame whose calibration is readable; notes what it lacks in ``absent``."""
    yield from _check_images(dataset, frame, absent)
    label = dataset.folder / "label_2" / f"{frame.id}.txt"
    objects = None
    if label.is_file():
        try:
            objects = read_objects(label, results=False)
        except Lcf3dError as error:
            yield Finding("KIT04", "error", str(error))
    else:
        absent["label"].append(frame.id)
    if objects is not None:
        yield from _check_labels(frame, label, objects)
    try:
        points = frame.points
    except Lcf3dError as error:
        yield Finding("KIT03", "error", str(error))
        return
    if points is None:
        absent["scan"].append(frame.id)
    elif objects is not None and frame.labels is not None:
        yield from _check_points(frame, label, objects)


def _check_images(dataset: KittiFrames, frame: Frame, absent: dict[str, list[str]]) -> Iterator[Finding]:
    paths = dataset.image_paths(frame.id)
    if "left" not in paths:
        absent["image"].append(frame.id)
    sizes = set()
    for name, path in paths.items():
        try:
            read_image(path)
            view = frame.camera(name)
            sizes.add((view.width, view.height))
        except Lcf3dError as error:
            yield Finding("KIT02", "error", str(error))
    if len(sizes) > 1:
        yield Finding("KIT09", "warning", f"frame {frame.id}: left and right image differ in size: {sorted(sizes)}")


def _check_labels(frame: Frame, path: Path, objects: KittiObjects) -> Iterator[Finding]:
    """Classes, and whether 3D and 2D boxes of labels that are easy to see agree."""
    unknown = sorted(set(objects.class_names.tolist()) - set(LABEL_CLASSES))
    if unknown:
        yield Finding("KIT05", "error", f"{path} holds unknown classes {unknown}; KITTI's are {list(LABEL_CLASSES)}")
    if frame.labels is None or not len(frame.labels):
        return
    clear = _clear(objects, frame)
    projected, visible = project_boxes(frame.labels.boxes[clear], frame.cameras[0])
    overlap = np.diag(image_iou(projected, objects.boxes2d[_labelled(objects, frame)][clear]))
    wrong = int((~visible | (overlap < LEAST_IOU)).sum())
    if wrong:
        yield Finding(
            "KIT06",
            "error",
            f"{path}: {wrong} of {len(clear)} clear objects project away from their 2D boxes; "
            "does the calibration belong to these labels?",
        )


def _check_points(frame: Frame, path: Path, objects: KittiObjects) -> Iterator[Finding]:
    """Whether near labels that are easy to see hold points."""
    assert frame.labels is not None
    assert frame.points is not None
    clear = _clear(objects, frame)
    near = clear[np.hypot(*frame.labels.boxes[clear, :2].T) < NEAR_METRES]
    empty = int((~points_in_boxes(frame.points, frame.labels.boxes[near]).any(axis=1)).sum())
    if empty:
        yield Finding(
            "KIT07",
            "error",
            f"{path}: {empty} of {len(near)} near, visible objects hold no points of the scan; "
            "does the scan belong to this frame, in the Velodyne's frame?",
        )


def _labelled(objects: KittiObjects, frame: Frame) -> np.ndarray:
    """Rows of ``objects`` that ``frame.labels`` holds, in its order."""
    assert frame.labels is not None
    return np.flatnonzero(np.isin(objects.class_names, frame.labels.class_names) & objects.has_box3d)


def _clear(objects: KittiObjects, frame: Frame) -> np.ndarray:
    """Indices into ``frame.labels`` of the objects that are easy to see."""
    chosen = objects[_labelled(objects, frame)]
    tall = chosen.boxes2d[:, 3] - chosen.boxes2d[:, 1] >= CLEAR_HEIGHT
    return np.flatnonzero(tall & (chosen.truncated == 0) & (chosen.occluded == 0))


def check_results(frame_ids: Sequence[str], folder: Path) -> Iterator[Finding]:
    """What is wrong with a folder of KITTI result files for these frames."""
    if (folder / "data").is_dir():
        folder = folder / "data"
    missing = [frame_id for frame_id in frame_ids if not (folder / f"{frame_id}.txt").is_file()]
    if missing:
        yield Finding(
            "KIT10", "error", f"{folder} lacks {len(missing)} of {len(frame_ids)} frames, first {missing[0]}.txt"
        )
    low, high = np.inf, -np.inf
    classes: Counter[str] = Counter()
    for frame_id in sorted(set(frame_ids) - set(missing)):
        try:
            objects = read_objects(folder / f"{frame_id}.txt", results=True)
            scores = objects.scores
            classes.update(objects.class_names.tolist())
        except Lcf3dError as error:
            yield Finding("KIT11", "error", str(error))
            continue
        if scores is not None and len(scores):
            low, high = min(low, float(scores.min())), max(high, float(scores.max()))
    joined = join_classes(classes, LABEL_CLASSES)
    unknown = {name: count for name, count in classes.items() if name not in joined}
    if unknown:
        listed = ", ".join(f"{name} {count}" for name, count in unknown.items())
        yield Finding("KIT13", "warning", f"{folder}: detections of classes that KITTI does not have: {listed}")
    if low < 0 or high > 1:
        yield Finding(
            "KIT12", "warning", f"{folder}: scores go from {low:.4g} to {high:.4g}; fit one with 'lcf3d calibrate'"
        )
