"""Which LiDAR box and which 2D detection show the same object, while the camera may have turned by some degrees."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from lcf3d.fusion.alignment import BORDER_PX, MOVING_SPREAD, STANDING, BoxPairs, realigned
from lcf3d.fusion.clustering import cluster_boxes
from lcf3d.fusion.matching import assign
from lcf3d.geometry.camera import pixel_rays, project_boxes
from lcf3d.geometry.iou import image_iou
from lcf3d.structures import BoolArray, Camera, Detections2D, Detections3D, FloatArray, IntArray

# 2D detections above this score, and so many 3D boxes of highest score for each of them, take part
CONFIDENT = 0.5
BOXES_PER_DETECTION = 3
# how far a camera may have turned, and how finely votes are counted (radians)
REACH, BIN = np.deg2rad(8.0), np.deg2rad(0.25)
# two boxes may be the same object when their sides differ by less than these factors (logarithms): width, height
SIDES = np.array([0.5, 0.2])
# states of `lcf3d.fusion.alignment` this near to each other match the same boxes but for a few
NEARLY = np.array([np.deg2rad(0.15)] * 3 + [0.06] * 3 + [np.inf] * 2 + [0.01])


@dataclass(frozen=True, eq=False)
class Sighting:
    """What one camera and the LiDAR saw at one moment.

    Attributes:
        camera: the camera as its calibration says.
        boxes: (N, 7) one 3D box an object, the surest only.
        labels: (N,) their classes.
        velocities: (N, 3) m/s relative to the camera in the LiDAR frame, NaN where not known; or None.
        unsure: (N,) m/s that those may be off by; or None.
        boxes2d: (M, 4) confident 2D detections.
        labels2d: (M,) their classes.
        votes: (V, 2) pitch and yaw of the camera that each pair of a 3D and a 2D box of like size and class asks for.
        group: sightings of equal number are not independent.
    """

    camera: Camera
    boxes: FloatArray
    labels: IntArray
    velocities: FloatArray | None
    unsure: FloatArray | None
    boxes2d: FloatArray
    labels2d: IntArray
    votes: FloatArray
    group: int = 0

    @classmethod
    def of(
        cls,
        camera: Camera,
        lidar: Detections3D,
        found: Detections2D,
        velocities: FloatArray | None = None,
        group: int = 0,
    ) -> Sighting:
        """From the detections of one frame; both must share their class names.

        Suppression leaves one 3D box an object; those of them that may be in view (with the camera turned either way)
        and have the highest scores take part, three for every confident 2D detection.
        """
        sure = found[found.scores > CONFIDENT]
        chosen, votes = np.zeros(0, dtype=np.int64), np.zeros((0, 2))
        if len(sure) and len(lidar):
            chosen, projected, margin = _surest(camera, lidar, BOXES_PER_DETECTION * len(sure))
            votes = _votes(camera, projected - margin, lidar.labels[chosen], sure)
        return cls(
            camera,
            lidar.boxes[chosen],
            lidar.labels[chosen],
            None if velocities is None else velocities[chosen],
            None if velocities is None or lidar.velocities is None else _unsure(lidar.velocities[chosen]),
            sure.boxes,
            sure.labels,
            votes,
            group,
        )


def _unsure(velocities: FloatArray) -> FloatArray:
    """(N,) m/s that (N, 2) velocities over ground may be off by: what stands is sure to."""
    return np.where(np.hypot(*np.nan_to_num(velocities).T) > STANDING, MOVING_SPREAD, 0.0)


def _surest(camera: Camera, lidar: Detections3D, count: int) -> tuple[IntArray, FloatArray, float]:
    """The boxes of highest score that may be in view, one an object; their projections into a wider image; its margin.

    In view means within `REACH` of the image's borders.
    """
    # a lens may not be known beyond its image
    margin = float(np.tan(REACH) * np.abs(camera.intrinsics[0]).max()) if camera.distortion is None else 0.0
    projected, visible = project_boxes(lidar.boxes, _wider(camera, margin))
    seen = np.flatnonzero(visible & np.isfinite(lidar.boxes).all(axis=1) & np.isfinite(lidar.scores))
    some = lidar[seen]
    single = cluster_boxes(some.boxes, some.scores, some.labels, method="nms", iou_threshold=0.2, class_aware=True)
    rows = seen[single.representative]
    rows = rows[np.argsort(-lidar.scores[rows], kind="stable")][:count]
    return rows, projected[rows], margin


def match_sighting(sighting: Sighting, state: FloatArray, iou_threshold: float) -> tuple[BoxPairs, float]:
    """Pairs of one moment with the camera aligned by a state of `lcf3d.fusion.alignment`, and their summed IoU."""
    camera = realigned(sighting.camera, state[:3], state[3:6])
    boxes = sighting.boxes
    if sighting.velocities is not None and state[8]:
        boxes = boxes.copy()
        boxes[:, :3] += state[8] * np.nan_to_num(sighting.velocities)
    projected, visible = project_boxes(boxes, camera)
    overlap = image_iou(projected, sighting.boxes2d)
    overlap[(sighting.labels[:, None] != sighting.labels2d[None]) | ~visible[:, None]] = 0
    match = assign(overlap, iou_threshold) if overlap.size else np.full(len(boxes), -1, dtype=np.int64)
    rows = np.flatnonzero(match >= 0)
    velocities = None if sighting.velocities is None else sighting.velocities[rows]
    unsure = None if sighting.unsure is None else sighting.unsure[rows]
    pairs = BoxPairs.of(
        sighting.boxes[rows], sighting.boxes2d[match[rows]], sighting.camera, velocities, sighting.group, unsure
    )
    return pairs, float(overlap[rows, match[rows]].sum())


class Matcher:
    """One sighting with its last match, which serves again for a state that is nearly the same."""

    def __init__(self, sighting: Sighting) -> None:
        self.sighting = sighting
        self._key: tuple[FloatArray, float] | None = None
        self._pairs: BoxPairs | None = None

    def pairs(self, state: FloatArray, iou_threshold: float) -> BoxPairs:
        """As `match_sighting`, for this state or one within `NEARLY` of it."""
        if self._pairs is None or self._key is None or not self._serves(state, iou_threshold):
            self._pairs, _ = match_sighting(self.sighting, state, iou_threshold)
            self._key = state, iou_threshold
        return self._pairs

    def _serves(self, state: FloatArray, iou_threshold: float) -> bool:
        assert self._key is not None
        return iou_threshold == self._key[1] and bool((np.abs(state - self._key[0]) <= NEARLY).all())


def vote_rotation(sightings: list[Sighting]) -> FloatArray:
    """(3,) the rotation, roll aside, that most pairs of a 3D box and a 2D box of like size and class agree on.

    Every such pair votes for the pitch and yaw between its two centres; the densest place of the smoothed histogram
    wins. Zero without votes.
    """
    from scipy.ndimage import gaussian_filter

    turns = np.concatenate([np.zeros((0, 2)), *(sighting.votes for sighting in sightings)])
    if not len(turns):
        return np.zeros(3)
    bins = round(2 * REACH / BIN)
    limits = (-REACH, REACH)
    counts, pitches, yaws = np.histogram2d(turns[:, 0], turns[:, 1], bins=bins, range=[limits, limits])
    smooth = gaussian_filter(counts, 1.5, mode="constant")
    i, j = np.unravel_index(int(smooth.argmax()), smooth.shape)
    return np.array([pitches[i] + BIN / 2, yaws[j] + BIN / 2, 0.0])


def _votes(camera: Camera, projected: FloatArray, labels: IntArray, sure: Detections2D) -> FloatArray:
    """(V, 2) pitch and yaw of the camera that each likely pair of (N, 4) projected boxes and 2D boxes asks for."""
    found = sure.boxes
    sides = np.log(np.maximum(projected[:, 2:] - projected[:, :2], 1e-3))
    sides2d = np.log(np.maximum(found[:, 2:] - found[:, :2], 1e-3))
    limits = np.array([camera.width, camera.height])
    whole: BoolArray = np.all([found[:, :2] > BORDER_PX, found[:, 2:] < limits - BORDER_PX], axis=(0, 2))
    alike: BoolArray = np.all(np.abs(sides[:, None] - sides2d[None]) < SIDES, axis=2)
    i, j = np.nonzero(alike & (labels[:, None] == sure.labels[None]) & whole[None])
    votes: FloatArray = _angles(found, camera)[j] - _angles(projected, camera)[i]
    return votes


def _angles(boxes: FloatArray, camera: Camera) -> FloatArray:
    """(N, 2) pitch and yaw of the rays through the centres of (N, 4) pixel boxes, camera axes."""
    rays = pixel_rays((boxes[:, :2] + boxes[:, 2:]) / 2, camera) @ camera.camera_from_lidar[:3, :3].T
    yaw = np.arctan2(rays[:, 0], rays[:, 2])
    pitch = np.arctan2(-rays[:, 1], np.hypot(rays[:, 0], rays[:, 2]))
    return np.stack([pitch, yaw], axis=1)


def _wider(camera: Camera, margin: float) -> Camera:
    """The camera with an image that is larger by ``margin`` pixels on every side."""
    shift = np.array([[1, 0, margin], [0, 1, margin], [0, 0, 1]])
    size = int(camera.width + 2 * margin), int(camera.height + 2 * margin)
    return replace(camera, projection=shift @ camera.projection, width=size[0], height=size[1])
