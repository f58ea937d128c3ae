"""Frustum proposals: the LiDAR points behind a 2D box (paper section 4.1.4; docs/method.md, recovery 1-4)."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from lcf3d.geometry.boxes import YAW, wrap_angle
from lcf3d.geometry.camera import pixel_rays
from lcf3d.geometry.lens import NEAR, lens_numbers, project_through_lens
from lcf3d.kernels import kernel
from lcf3d.structures import BoolArray, Camera, Detections2D, FloatArray, IntArray

MaskMode = Literal["box", "mask", "box+mask"]


class SecondViews(NamedTuple):
    """The other 2D boxes of proposals that two views of one object make (paper section 4.2.3).

    Attributes:
        camera: (K,) index of the second camera, -1 for proposals of a single view.
        detection: (K,) index of the 2D detection in that camera's detections, or -1.
        boxes2d: (K, 4) its pixel box, NaN for proposals of a single view.
    """

    camera: IntArray
    detection: IntArray
    boxes2d: FloatArray


@dataclass(frozen=True, eq=False)
class FrustumProposals:
    """The frustums of one frame, their points one after the other: proposal k owns ``offsets[k]:offsets[k + 1]``.

    The frustum frame is the LiDAR frame turned about its vertical axis (about the LiDAR's origin) so that the frustum's
    axis, the ray through the centre of its 2D box, points along +x.

    Attributes:
        points: (M, C) float32 ``x, y, z, intensity, ...``, x y z in each proposal's frustum frame.
        gaussian: (M,) float32 the Gaussian mask G of the paper, 1 at the centre of the 2D box; of two views the larger
            value.
        mask: (M,) float32, 1 for points on the instance mask; None unless the mode is ``box+mask``.
        offsets: (K + 1,) where each proposal's points begin.
        axis_yaw: (K,) heading of each frustum's axis in the LiDAR frame.
        boxes2d: (K, 4) the 2D boxes in pixels, not enlarged.
        scores: (K,) scores of the 2D detections.
        labels: (K,) labels of the 2D detections, indices into ``class_names``.
        camera_index: (K,) index into ``cameras``.
        detection_index: (K,) index of the 2D detection in its camera's detections.
        class_names: the class list of ``labels``.
        cameras: the cameras of the frame.
        cloud: (N, C) the whole scan in the LiDAR frame, for what needs the surroundings (such as the ground).
        second: the second views of stereo proposals; None where all have a single view.
    """

    points: NDArray[np.float32]
    gaussian: NDArray[np.float32]
    mask: NDArray[np.float32] | None
    offsets: IntArray
    axis_yaw: FloatArray
    boxes2d: FloatArray
    scores: FloatArray
    labels: IntArray
    camera_index: IntArray
    detection_index: IntArray
    class_names: tuple[str, ...]
    cameras: tuple[Camera, ...]
    cloud: NDArray[np.float32]
    second: SecondViews | None = None

    def __len__(self) -> int:
        return len(self.offsets) - 1

    def part(self, k: int) -> slice:
        """Where proposal ``k``'s points lie in ``points``, ``gaussian`` and ``mask``."""
        return slice(int(self.offsets[k]), int(self.offsets[k + 1]))

    def select(self, chosen: IntArray) -> FrustumProposals:
        """The proposals of those indices, in that order."""
        index = np.concatenate([np.arange(self.offsets[k], self.offsets[k + 1]) for k in chosen] or [chosen[:0]])
        second = self.second
        if second is not None:
            second = SecondViews(second.camera[chosen], second.detection[chosen], second.boxes2d[chosen])
        return replace(
            self,
            points=self.points[index],
            gaussian=self.gaussian[index],
            mask=None if self.mask is None else self.mask[index],
            offsets=np.cumsum([0, *np.diff(self.offsets)[chosen]]).astype(np.int64),
            axis_yaw=self.axis_yaw[chosen],
            boxes2d=self.boxes2d[chosen],
            scores=self.scores[chosen],
            labels=self.labels[chosen],
            camera_index=self.camera_index[chosen],
            detection_index=self.detection_index[chosen],
            second=second,
        )

    def lidar_from_frustum(self, boxes: FloatArray) -> FloatArray:
        """(K, 7) boxes, one a proposal in its frustum frame, turned back into the LiDAR frame."""
        result = np.array(boxes, dtype=np.float64)
        cos, sin = np.cos(self.axis_yaw), np.sin(self.axis_yaw)
        result[:, 0] = cos * boxes[:, 0] - sin * boxes[:, 1]
        result[:, 1] = sin * boxes[:, 0] + cos * boxes[:, 1]
        result[:, YAW] = wrap_angle(boxes[:, YAW] + self.axis_yaw)
        return result

    def frustum_from_lidar(self, boxes: FloatArray) -> FloatArray:
        """(K, 7) boxes, one a proposal in the LiDAR frame, turned into the frustum frames."""
        result = np.array(boxes, dtype=np.float64)
        cos, sin = np.cos(self.axis_yaw), np.sin(self.axis_yaw)
        result[:, 0] = cos * boxes[:, 0] + sin * boxes[:, 1]
        result[:, 1] = cos * boxes[:, 1] - sin * boxes[:, 0]
        result[:, YAW] = wrap_angle(boxes[:, YAW] - self.axis_yaw)
        return result


def points_in_image_boxes(
    points: NDArray[np.floating], camera: Camera, boxes: FloatArray
) -> tuple[IntArray, FloatArray, IntArray]:
    """Points whose projection falls in image boxes.

    Args:
        points: (N, 3 or more) LiDAR-frame points; NaN ones are in no box.
        camera: of the image.
        boxes: (K, 4) pixel boxes.

    Returns:
        (P,) point indices ordered by box then point, (P, 2) their pixels, (K + 1,) where each box's points begin.
    """
    if camera.distortion is None:
        candidates, pixels = _project_into(points, np.array(camera.pixels_from_lidar), NEAR, boxes)
    else:
        candidates, pixels = _bend_into(points, lens_numbers(camera), boxes)
    hits, offsets = _by_box(pixels, boxes)
    return candidates[hits], pixels[hits], offsets


@kernel
def _bend_into(points, numbers, boxes):  # type: ignore[no-untyped-def]
    """`_project_into` for a lens, whose numbers are those of `lens_numbers`."""
    u1, v1, u2, v2 = _around(boxes)
    pixels, depths = np.empty((len(points), 2)), np.empty(len(points))
    project_through_lens(points, numbers, pixels, depths)
    found = np.empty(len(points), np.int64)
    count = 0
    for n in range(len(points)):
        u, v = pixels[n, 0], pixels[n, 1]
        if (u >= u1) & (u <= u2) & (v >= v1) & (v <= v2):
            found[count] = n
            count += 1
    return found[:count], pixels[found[:count]]


@kernel
def _around(boxes):  # type: ignore[no-untyped-def]
    """The rectangle around all boxes."""
    u1, v1, u2, v2 = np.inf, np.inf, -np.inf, -np.inf
    for k in range(len(boxes)):
        u1, v1 = min(u1, boxes[k, 0]), min(v1, boxes[k, 1])
        u2, v2 = max(u2, boxes[k, 2]), max(v2, boxes[k, 3])
    return u1, v1, u2, v2


@kernel
def _by_box(pixels, boxes):  # type: ignore[no-untyped-def]
    """Which pixels lie in each box, one box after the other, and where each box's begin."""
    offsets, hits = np.empty(len(boxes) + 1, np.int64), np.empty(len(pixels) + 1, np.int64)
    offsets[0] = 0
    for k in range(len(boxes)):
        x1, y1, x2, y2 = boxes[k, 0], boxes[k, 1], boxes[k, 2], boxes[k, 3]
        first = offsets[k]
        if len(hits) < first + len(pixels) + 1:
            longer = np.empty(2 * len(hits) + len(pixels), np.int64)
            for n in range(first):
                longer[n] = hits[n]
            hits = longer
        at = first
        for n in range(len(pixels)):  # without branches, which would be guessed wrongly half of the time
            u, v = pixels[n, 0], pixels[n, 1]
            hits[at] = n
            at += (x1 <= u) & (u <= x2) & (y1 <= v) & (v <= y2)
        offsets[k + 1] = at
    return hits[: offsets[len(boxes)]], offsets


@kernel
def _project_into(points, projection, near, boxes):  # type: ignore[no-untyped-def]
    """Indices and pixels of the points in the rectangle around all boxes.

    One pass over the scan without branches or divisions: it is the most expensive step of recovery.
    """
    a0, a1, a2, a3 = projection[0, 0], projection[0, 1], projection[0, 2], projection[0, 3]
    b0, b1, b2, b3 = projection[1, 0], projection[1, 1], projection[1, 2], projection[1, 3]
    c0, c1, c2, c3 = projection[2, 0], projection[2, 1], projection[2, 2], projection[2, 3]
    u1, v1, u2, v2 = _around(boxes)
    found = np.empty(len(points) + 1, np.int64)
    count = 0
    for n in range(len(points)):
        x, y, z = np.float64(points[n, 0]), np.float64(points[n, 1]), np.float64(points[n, 2])
        w = c0 * x + c1 * y + c2 * z + c3
        u = a0 * x + a1 * y + a2 * z + a3
        v = b0 * x + b1 * y + b2 * z + b3
        found[count] = n
        count += (w > near) & (u >= u1 * w) & (u <= u2 * w) & (v >= v1 * w) & (v <= v2 * w)
    pixels = np.empty((count, 2))
    for i in range(count):
        x, y, z = points[found[i], 0], points[found[i], 1], points[found[i], 2]
        w = c0 * x + c1 * y + c2 * z + c3
        pixels[i, 0] = (a0 * x + a1 * y + a2 * z + a3) / w
        pixels[i, 1] = (b0 * x + b1 * y + b2 * z + b3) / w
    return found[:count], pixels


def enlarge_boxes(boxes: FloatArray, enlargement: float) -> FloatArray:
    """(K, 4) pixel boxes with width and height multiplied by ``1 + enlargement`` about their centres."""
    centres, sides = (boxes[:, :2] + boxes[:, 2:]) / 2, boxes[:, 2:] - boxes[:, :2]
    half = sides * (1 + enlargement) / 2
    return np.concatenate([centres - half, centres + half], axis=1)


def gaussian_mask(pixels: FloatArray, box: FloatArray) -> NDArray[np.float32]:
    """(N,) G of the paper (section 4.1.4) at (N, 2) pixels: sigma is the width and height of the (4,) 2D box."""
    mask: NDArray[np.float32] = _gaussian(pixels, *box.tolist())
    return mask


@kernel
def _gaussian(pixels, x1, y1, x2, y2):  # type: ignore[no-untyped-def]
    u, v, width, height = (x1 + x2) / 2, (y1 + y2) / 2, max(x2 - x1, 1e-6), max(y2 - y1, 1e-6)
    mask = np.empty(len(pixels), np.float32)
    for n in range(len(pixels)):
        a, b = (pixels[n, 0] - u) / width, (pixels[n, 1] - v) / height
        mask[n] = math.exp(-0.5 * (a * a + b * b))
    return mask


def axis_yaws(boxes: FloatArray, camera: Camera) -> FloatArray:
    """(K,) headings in the LiDAR frame of the rays through the centres of (K, 4) pixel boxes."""
    rays = pixel_rays((boxes[:, :2] + boxes[:, 2:]) / 2, camera)
    yaws: FloatArray = np.arctan2(rays[:, 1], rays[:, 0])
    return yaws


def extract_frustums(
    points: NDArray[np.float32],
    cameras: Sequence[Camera],
    detections: Sequence[Detections2D],
    selected: Sequence[IntArray],
    *,
    enlargement: float = 0.05,
    min_points: int = 10,
    mask_mode: MaskMode = "box",
    pairs: IntArray | None = None,
) -> FrustumProposals:
    """Frustum proposals of the selected 2D detections of all cameras, those with too few points left out.

    Args:
        points: (N, 4 or more) float32 scan in the LiDAR frame; non-finite points are in no frustum.
        cameras: the cameras.
        detections: for each camera its 2D detections.
        selected: for each camera the indices of the detections to lift.
        enlargement: ``e``, by which width and height of the 2D boxes grow before points are taken.
        min_points: ``p_min``, fewest points of a proposal.
        mask_mode: ``box`` takes all points in the box; ``mask`` only those on the instance mask, or the box where the
            mask keeps fewer than ``min_points``; ``box+mask`` takes the box and marks the points on the mask.
        pairs: (P, 4) stereo pairs ``camera, detection, second camera, second detection``: a selected detection that
            is the first of a pair gives the points that lie in both boxes (paper section 4.2.3), or on both masks.
    """
    second = {} if pairs is None else {(c, d): (c2, d2) for c, d, c2, d2 in pairs.tolist()}
    parts: list[tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]]] = []
    rows: list[tuple[int, int, float]] = []
    for c, (camera, found, chosen) in enumerate(zip(cameras, detections, selected, strict=True)):
        if not len(chosen):
            continue
        boxes = found.boxes[chosen]
        index, pixels, offsets = points_in_image_boxes(points, camera, enlarge_boxes(boxes, enlargement))
        yaws = axis_yaws(boxes, camera)
        for k, d in enumerate(chosen):
            inside, at = index[offsets[k] : offsets[k + 1]], pixels[offsets[k] : offsets[k + 1]]
            weight = gaussian_mask(at, boxes[k])
            on_mask = _on_mask(found, int(d), at, mask_mode)
            other = second.get((c, int(d)))
            if other is not None:
                view, found2, d2 = cameras[other[0]], detections[other[0]], other[1]
                both, at2, _ = points_in_image_boxes(
                    points[inside], view, enlarge_boxes(found2.boxes[[d2]], enlargement)
                )
                on_mask = on_mask[both] & _on_mask(found2, d2, at2, mask_mode)
                inside, weight = inside[both], np.maximum(weight[both], gaussian_mask(at2, found2.boxes[d2]))
            if mask_mode == "mask" and on_mask.sum() >= min_points:
                inside, weight, on_mask = inside[on_mask], weight[on_mask], on_mask[on_mask]
            if len(inside) >= min_points:
                parts.append(
                    (_turned(points, inside, np.cos(yaws[k]), -np.sin(yaws[k])), weight, on_mask.astype(np.float32))
                )
                rows.append((c, int(d), float(yaws[k])))
    return _assemble(points, cameras, detections, parts, rows, second, mask_mode)


def _on_mask(found: Detections2D, detection: int, pixels: FloatArray, mask_mode: MaskMode) -> BoolArray:
    """(N,) whether pixels fall on a detection's instance mask; all do where there is none or none is wanted."""
    instance = found.masks[detection] if found.masks is not None else None
    if mask_mode == "box" or instance is None:
        return np.ones(len(pixels), dtype=bool)
    return instance.contains(pixels)


@kernel
def _turned(points, index, cos, sin):  # type: ignore[no-untyped-def]
    """Chosen points, turned counter-clockwise about the vertical axis by the angle of that cosine and sine."""
    turned = np.empty((len(index), points.shape[1]), np.float32)
    for n in range(len(index)):
        x, y = points[index[n], 0], points[index[n], 1]
        turned[n, 0], turned[n, 1] = cos * x - sin * y, sin * x + cos * y
        for c in range(2, points.shape[1]):
            turned[n, c] = points[index[n], c]
    return turned


def _assemble(
    points: NDArray[np.float32],
    cameras: Sequence[Camera],
    detections: Sequence[Detections2D],
    parts: list[tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]]],
    rows: list[tuple[int, int, float]],
    second: Mapping[tuple[int, int], tuple[int, int]],
    mask_mode: MaskMode,
) -> FrustumProposals:
    """The proposals' parts laid one after the other."""
    chosen = [detections[c][[d]] for c, d, _ in rows]
    gaussian = [p[1] for p in parts]
    mask = [p[2] for p in parts]
    nothing = np.zeros(0, np.float32)
    return FrustumProposals(
        points=np.concatenate([p[0] for p in parts]) if parts else points[:0],
        gaussian=np.concatenate(gaussian) if parts else nothing,
        mask=(np.concatenate(mask) if parts else nothing) if mask_mode == "box+mask" else None,
        offsets=np.cumsum([0, *(len(p[0]) for p in parts)]).astype(np.int64),
        axis_yaw=np.array([yaw for _, _, yaw in rows], dtype=np.float64),
        boxes2d=np.concatenate([d.boxes for d in chosen]) if chosen else np.zeros((0, 4)),
        scores=np.array([d.scores[0] for d in chosen], dtype=np.float64),
        labels=np.array([d.labels[0] for d in chosen], dtype=np.int64),
        camera_index=np.array([c for c, _, _ in rows], dtype=np.int64),
        detection_index=np.array([d for _, d, _ in rows], dtype=np.int64),
        class_names=detections[0].class_names if detections else (),
        cameras=tuple(cameras),
        cloud=points,
        second=_second_views(detections, [second.get((c, d), (-1, -1)) for c, d, _ in rows]) if second else None,
    )


def _second_views(detections: Sequence[Detections2D], rows: list[tuple[int, int]]) -> SecondViews:
    """Camera and detection of each proposal's second view with its box; -1 for none."""
    boxes = [detections[c].boxes[d] if c >= 0 else np.full(4, np.nan) for c, d in rows]
    index = np.array(rows, dtype=np.int64).reshape(-1, 2)
    return SecondViews(index[:, 0], index[:, 1], np.array(boxes).reshape(-1, 4))
