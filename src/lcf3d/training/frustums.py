"""Training frustums: what lies behind the 2D boxes of labelled objects, kept wide enough to jitter the boxes later."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from lcf3d.datasets.kitti import KittiDataset
from lcf3d.datasets.nuscenes import NuscenesDataset
from lcf3d.datasets.opening import root_of
from lcf3d.errors import DatasetError
from lcf3d.formats.kitti import read_objects
from lcf3d.fusion.frustum import enlarge_boxes, points_in_image_boxes
from lcf3d.geometry.boxes import lidar_from_kitti, points_in_boxes, transform_boxes
from lcf3d.geometry.camera import pixel_rays, project_boxes, project_points
from lcf3d.geometry.iou import image_cover, image_iou
from lcf3d.structures import BoolArray, Camera, Detections3D, FloatArray, IntArray
from lcf3d.training.samples import ScanSample, read_scan

WIDE = 0.45
"""Growth of the boxes for the pool: room for jitter and for the enlargement of proposals."""
MOST_POINTS = 2048
FEWEST_ON_OBJECT = 5
LOWEST_PX = 12.0
NEGATIVE_SHARE = 0.2
FREE_IOU = 0.1
EDGE_EVERY = 3
"""Of so many headings of a simulated scan one has a near object at the image's edge."""
NEAREST_AT_EDGE_M, FARTHEST_AT_EDGE_M = 3.0, 25.0


@dataclass(frozen=True, eq=False)
class LabelledScene:
    """A labelled scan with the camera that looks at it.

    Attributes:
        points: (N, 4 or more) float32, LiDAR frame.
        boxes: (A, 7) of all labelled objects, LiDAR frame.
        names: (A,) class names.
        camera: the camera.
        right: the second camera of a stereo pair, if there is one.
        boxes2d: (A, 4) annotated 2D boxes; those of the projected 3D boxes without them.
        unknown2d: (D, 4) regions of which nobody says what they hold, if there are any.
    """

    points: NDArray[np.float32]
    boxes: FloatArray
    names: NDArray[np.str_]
    camera: Camera
    right: Camera | None = None
    boxes2d: FloatArray | None = None
    unknown2d: FloatArray | None = None


@dataclass(frozen=True, eq=False)
class PooledFrustum:
    """One object, or none, behind a 2D box.

    Attributes:
        points: (n, 4) float32, LiDAR frame.
        pixels: (n, 2) float32 where they fall in the image.
        right_pixels: (n, 2) float32 where they fall in the second image, NaN without one.
        inside: (n,) whether they lie in the object's box.
        gap: (n,) float32 pixels to the nearest point of the object in the image, as a share of the 2D box's height.
        box2d: (4,).
        right_box2d: (4,) in the second image, NaN without one.
        label: index of the class.
        box: (7,) of the object, LiDAR frame; NaN where there is none.
        camera: the camera.
    """

    points: NDArray[np.float32]
    pixels: NDArray[np.float32]
    right_pixels: NDArray[np.float32]
    inside: BoolArray
    gap: NDArray[np.float32]
    box2d: FloatArray
    right_box2d: FloatArray
    label: int
    box: FloatArray
    camera: Camera

    @property
    def empty(self) -> bool:
        """Whether there is no object."""
        return bool(np.isnan(self.box[0]))


def turned_scene(scene: LabelledScene, angle: float) -> LabelledScene:
    """The same street with the car turned by an angle about the vertical axis; 2D annotations are left behind."""
    rotation = np.eye(4)
    rotation[:2, :2] = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
    points = scene.points.copy()
    points[:, :2] = (scene.points[:, :2] @ rotation[:2, :2].T).astype(np.float32)
    boxes = transform_boxes(scene.boxes, rotation)
    return LabelledScene(points, boxes, scene.names, scene.camera, scene.right)


def collect(scenes: Iterable[LabelledScene], classes: Mapping[str, int], seed: int) -> list[PooledFrustum]:
    """Frustums of all scenes: one an object that can be seen, and some of nothing.

    Args:
        scenes: labelled scans.
        classes: label by class name; objects of other names are only in the way.
        seed: of the frustums of nothing.

    Raises:
        DatasetError: there is not a single one with an object.
    """
    pool: list[PooledFrustum] = []
    for number, scene in enumerate(scenes):
        pool += frustums_of(scene, classes, np.random.default_rng([seed, number]))
    if all(frustum.empty for frustum in pool):
        raise DatasetError(
            f"no frustum to train on: no object of {', '.join(classes)} is in view of a camera with "
            f"{FEWEST_ON_OBJECT} returns or more"
        )
    return pool


def frustums_of(scene: LabelledScene, classes: Mapping[str, int], rng: np.random.Generator) -> list[PooledFrustum]:
    """The frustums of one scene, see `collect`."""
    projected, visible = project_boxes(scene.boxes, scene.camera)
    boxes2d = projected if scene.boxes2d is None else scene.boxes2d
    labels = np.array([classes.get(str(name), -1) for name in scene.names], dtype=np.int64)
    tall = boxes2d[:, 3] - boxes2d[:, 1] >= LOWEST_PX
    rows = np.flatnonzero(visible & tall & (labels >= 0))
    right_boxes = np.full((len(boxes2d), 4), np.nan)
    if scene.right is not None:
        right_boxes = project_boxes(scene.boxes, scene.right)[0]
    objects = [_cut(scene, boxes2d[k], right_boxes[k], int(labels[k]), scene.boxes[k]) for k in rows]
    kept = [f for f in objects if f.inside.sum() >= FEWEST_ON_OBJECT]
    nothing = np.full(7, np.nan)
    unknown = np.zeros((0, 4)) if scene.unknown2d is None else scene.unknown2d
    for _ in range(rng.binomial(len(kept), NEGATIVE_SHARE)):
        box, label = _free_box(boxes2d[visible], unknown, kept[rng.integers(len(kept))], scene.camera, rng)
        if box is not None:
            empty = _cut(scene, box, np.full(4, np.nan), label, nothing)
            if len(empty.points) >= 2 * FEWEST_ON_OBJECT:
                kept.append(empty)
    return kept


def _free_box(
    taken: FloatArray, unknown: FloatArray, like: PooledFrustum, camera: Camera, rng: np.random.Generator
) -> tuple[FloatArray | None, int]:
    """A 2D box like another's, moved sideways to where no object is and nothing unknown; None without room for it."""
    for _ in range(5):
        width = float(like.box2d[2] - like.box2d[0])
        x = rng.uniform(0, max(camera.width - width, 1.0))
        y = float(rng.normal(0, 0.1)) * float(like.box2d[3] - like.box2d[1])
        box = np.array([x, like.box2d[1] + y, x + width, like.box2d[3] + y])
        box[1::2] = np.clip(box[1::2], 0, camera.height)
        free = (image_iou(box[None], taken) < FREE_IOU).all() and (image_cover(box[None], unknown) < FREE_IOU).all()
        if box[3] - box[1] >= LOWEST_PX and free:
            return box, like.label
    return None, like.label


def _cut(
    scene: LabelledScene, box2d: FloatArray, right_box2d: FloatArray, label: int, box: FloatArray
) -> PooledFrustum:
    """The points behind a 2D box, with what is known of them."""
    index, pixels, _ = points_in_image_boxes(scene.points, scene.camera, enlarge_boxes(box2d[None], WIDE))
    if len(index) > MOST_POINTS:
        spread = np.arange(MOST_POINTS) * len(index) // MOST_POINTS
        index, pixels = index[spread], pixels[spread]
    points = scene.points[index, :4]
    inside = np.zeros(len(points), dtype=bool)
    gap = np.full(len(points), np.inf, dtype=np.float32)
    if not np.isnan(box[0]) and len(points):
        inside = points_in_boxes(points, box[None])[0]
        if inside.any():
            gap = (cKDTree(pixels[inside]).query(pixels)[0] / (box2d[3] - box2d[1])).astype(np.float32)
    right_pixels = np.full((len(points), 2), np.nan, dtype=np.float32)
    if scene.right is not None:
        right_pixels = project_points(points, scene.right)[0].astype(np.float32)
    return PooledFrustum(
        points, pixels.astype(np.float32), right_pixels, inside, gap, box2d, right_box2d, label, box, scene.camera
    )


def scenes_of_samples(
    paths: Sequence[Path], cameras: Sequence[tuple[Camera, Camera | None]], views: int, seed: int
) -> Iterator[LabelledScene]:
    """Simulated scans (`lcf3d.training.samples.read_scan`), each seen with the car turned to several headings.

    Args:
        paths: of the samples.
        cameras: cameras to look through in turn, each with the second one of its stereo pair if there is one.
        views: headings of each scan.
        seed: of the headings.
    """
    for number, path in enumerate(paths):
        sample = read_scan(path)
        rng = np.random.default_rng([seed, number])
        for k, angle in enumerate(rng.uniform(0, 2 * np.pi) + np.arange(views) * 2 * np.pi / views):
            left, right = cameras[(number + k) % len(cameras)]
            if k % EDGE_EVERY == EDGE_EVERY - 1:
                angle = _edge_angle(sample, left, rng, float(angle))
            yield turned_scene(LabelledScene(sample.points, sample.boxes, sample.names, left, right), float(angle))


def _edge_angle(sample: ScanSample, camera: Camera, rng: np.random.Generator, otherwise: float) -> float:
    """A turn that brings the edge of the image across a near object; ``otherwise`` where nothing is near."""
    distance = np.hypot(sample.boxes[:, 0], sample.boxes[:, 1])
    near = np.flatnonzero((distance > NEAREST_AT_EDGE_M) & (distance < FARTHEST_AT_EDGE_M))
    if not len(near):
        return otherwise
    chosen = rng.choice(near)
    x, y = sample.boxes[chosen, :2]
    column = float(rng.choice([0, camera.width]))
    (ray,) = pixel_rays(np.array([[column, camera.height / 2]]), camera)
    half = np.arctan2(0.5 * np.hypot(*sample.boxes[chosen, 3:5]), distance[chosen])
    return float(np.arctan2(ray[1], ray[0]) - np.arctan2(y, x) + rng.uniform(-0.8, 0.8) * half)


def scenes_of_dataset(text: str, split: str | None) -> Iterator[LabelledScene]:
    """Labelled scans of ``kitti:ROOT`` (the annotated 2D boxes of the left camera) or ``nuscenes:ROOT`` (all cameras).

    Raises:
        DatasetError: a frame without scan or labels, or a folder that is no such dataset.
    """
    kind, root = root_of(text, ("kitti", "nuscenes"), "the training")
    if kind == "nuscenes":
        dataset = NuscenesDataset(root, split=split, late_cameras="drop")
        for token in dataset.ids:
            frame = dataset.frame(token)
            points, labels = _labelled(frame.points, frame.labels, token)
            names = np.array(labels.class_names)[labels.labels]
            for camera in frame.cameras:
                yield LabelledScene(points, labels.boxes, names, camera)
        return
    kitti = KittiDataset(root, split)
    for frame_id in kitti.ids:
        frame = kitti.frame(frame_id)
        points, _ = _labelled(frame.points, frame.labels, frame_id)
        objects = read_objects(kitti.folder / "label_2" / f"{frame_id}.txt", results=False)
        unknown = objects.boxes2d[objects.class_names == "DontCare"]
        objects = objects[objects.has_box3d]
        camera = frame.camera("left")
        right = next((c for c in frame.cameras if c.name == "right"), None)
        boxes = lidar_from_kitti(objects.locations, objects.dimensions, objects.rotation_y, camera.camera_from_lidar)
        yield LabelledScene(points, boxes, objects.class_names, camera, right, objects.boxes2d, unknown)


def _labelled(
    points: NDArray[np.float32] | None, labels: Detections3D | None, frame_id: str
) -> tuple[NDArray[np.float32], Detections3D]:
    if points is None or labels is None:
        what = "scan" if points is None else "labels"
        raise DatasetError(f"frame {frame_id} has no {what} to train on; choose a split that has, with --split")
    return points, labels


def labels_of(pool: Sequence[PooledFrustum]) -> IntArray:
    """(F,) class of every frustum."""
    return np.array([frustum.label for frustum in pool], dtype=np.int64)
