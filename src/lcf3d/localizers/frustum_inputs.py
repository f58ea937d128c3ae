"""From frustum proposals to the input arrays of a network; numpy only, used in training and inference alike."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lcf3d.fusion.frustum import FrustumProposals
from lcf3d.geometry.camera import pixel_rays
from lcf3d.localizers.spec import LocalizerSpec
from lcf3d.structures import BoolArray, Camera, FloatArray, IntArray

POINT_CHANNELS = 6
"""x, y, z relative to the reference, intensity, Gaussian, instance mask (1 everywhere where there is none)."""
CONTEXT = 9
"""What is known of a frustum beside its points and class: see `reference_of`."""
FARTHEST_M = 12.0
"""Points farther before or behind the reference than this are brought to that distance: background is background."""


@dataclass(frozen=True, eq=False)
class FrustumInputs:
    """Input arrays of a network, one row a frustum.

    Attributes:
        points: (K, C, N) float32; of ``v1`` see `POINT_CHANNELS`, of ``v2`` x, y, z, intensity, Gaussian.
        context: (K, D) float32 class one-hot, and for ``v1`` the `CONTEXT`.
        reference: (K, 3) what was subtracted from x, y, z in the frustum frames.
    """

    points: NDArray[np.float32]
    context: NDArray[np.float32]
    reference: FloatArray


def network_inputs(proposals: FrustumProposals, classes: IntArray, spec: LocalizerSpec) -> FrustumInputs:
    """Inputs of all proposals of a frame.

    Args:
        proposals: at least one point each.
        classes: (K,) class of each, an index into ``spec.class_names``.
        spec: the network.
    """
    count = len(proposals)
    one_hot = np.zeros((count, len(spec.class_names)), dtype=np.float32)
    one_hot[np.arange(count), classes] = 1
    mask = proposals.mask if proposals.mask is not None else np.ones(len(proposals.gaussian), np.float32)
    if spec.form == "v2":
        chosen = first_points(np.diff(proposals.offsets), spec.points) + proposals.offsets[:-1, None]
        columns = np.concatenate([proposals.points[:, :4], proposals.gaussian[:, None]], axis=1)
        points = np.ascontiguousarray(columns[chosen].transpose(0, 2, 1), dtype=np.float32)
        return FrustumInputs(points, one_hot, np.zeros((count, 3)))
    rays = frustum_rays(proposals)
    heights = spec.template_array[classes, 2]
    sizes = np.array([(c.width, c.height) for c in proposals.cameras], dtype=np.float64)[proposals.camera_index]
    cut = border_touched(proposals.boxes2d, sizes)
    reference, context = reference_of(rays, heights, np.diff(proposals.offsets), cut)
    chosen = spread_points(np.diff(proposals.offsets), spec.points) + proposals.offsets[:-1, None]
    points = point_channels(proposals.points, proposals.gaussian, mask, chosen, reference, spec)
    return FrustumInputs(points, np.concatenate([one_hot, context], axis=1), reference)


def frustum_rays(proposals: FrustumProposals) -> FloatArray:
    """(K, 4) slopes of each frustum's border in its frame: z over x at the top and bottom, y over x left and right."""
    rays = np.empty((len(proposals), 4))
    for c, camera in enumerate(proposals.cameras):
        rows = np.flatnonzero(proposals.camera_index == c)
        rays[rows] = box_rays(proposals.boxes2d[rows], proposals.axis_yaw[rows], camera)
    return rays


def box_rays(boxes: FloatArray, axis_yaw: FloatArray, camera: Camera) -> FloatArray:
    """(K, 4) slopes, see `frustum_rays`, of (K, 4) pixel boxes with their axes' (K,) headings."""
    middle = (boxes[:, :2] + boxes[:, 2:]) / 2
    pixels = np.empty((4, len(boxes), 2))
    pixels[:2, :, 0], pixels[0, :, 1], pixels[1, :, 1] = middle[:, 0], boxes[:, 1], boxes[:, 3]
    pixels[2:, :, 1], pixels[2, :, 0], pixels[3, :, 0] = middle[:, 1], boxes[:, 0], boxes[:, 2]
    directions = pixel_rays(pixels.reshape(-1, 2), camera).reshape(4, len(boxes), 3)
    cos, sin = np.cos(axis_yaw), np.sin(axis_yaw)
    along = cos * directions[..., 0] + sin * directions[..., 1]
    across = cos * directions[..., 1] - sin * directions[..., 0]
    along = np.maximum(along, 1e-3 * np.abs(directions).max(axis=-1))
    slopes = np.empty((len(boxes), 4))
    slopes[:, :2] = (directions[:2, :, 2] / along[:2]).T
    slopes[:, 2:] = (across[2:] / along[2:]).T
    return slopes


def border_touched(boxes: FloatArray, sizes: FloatArray) -> BoolArray:
    """(K, 4) whether (K, 4) 2D boxes touch the left, top, right, bottom border of (K, 2) wide and high images.

    Within two pixels counts as touching.
    """
    flags: BoolArray = np.concatenate([boxes[:, :2] < 2, boxes[:, 2:] > sizes - 2], axis=1)
    return flags


def reference_of(
    rays: FloatArray, heights: FloatArray, counts: IntArray, cut: BoolArray
) -> tuple[FloatArray, NDArray[np.float32]]:
    """Where an object as high as its class fills the 2D box, and what else is known of the frustums.

    Args:
        rays: (K, 4) see `frustum_rays`.
        heights: (K,) height of the class in metres.
        counts: (K,) points of each frustum.
        cut: (K, 4) see `border_touched`.

    Returns:
        (K, 3) that place in the frustum frame; (K, `CONTEXT`) its distance and height, the frustum's width there, the
        flags, the logarithm of the number of points and the height of the lower border there, all near 1.
    """
    distance = np.clip(heights / np.maximum(rays[:, 0] - rays[:, 1], 1e-3), 1.5, 90.0)
    z = distance * (rays[:, 0] + rays[:, 1]) / 2
    reference = np.stack([distance, np.zeros_like(distance), z], axis=1)
    width = distance * (rays[:, 2] - rays[:, 3])
    columns = [distance / 40, z / 2, width / 4, np.log1p(counts) / 6, distance * rays[:, 1] / 2]
    return reference, np.concatenate([np.stack(columns, axis=1), cut], axis=1).astype(np.float32)


def first_points(counts: IntArray, wanted: int) -> IntArray:
    """(K, wanted) indices 0, 1, 2, ...; of fewer points, all and then again from the first."""
    index: IntArray = np.arange(wanted)[None] % np.maximum(counts, 1)[:, None]
    return index


def spread_points(counts: IntArray, wanted: int) -> IntArray:
    """(K, wanted) indices evenly spread over each frustum's points; of fewer points, all and then again."""
    index: IntArray = np.arange(wanted)[None] * counts[:, None] // wanted
    return np.where(counts[:, None] > wanted, index, first_points(counts, wanted))


def point_channels(
    points: NDArray[np.float32],
    gaussian: NDArray[np.float32],
    mask: NDArray[np.float32],
    chosen: IntArray,
    reference: FloatArray,
    spec: LocalizerSpec,
) -> NDArray[np.float32]:
    """(K, `POINT_CHANNELS`, N) input of ``v1``.

    Args:
        points: (M, 4 or more) in the frustum frames.
        gaussian: (M,).
        mask: (M,).
        chosen: (K, N) indices of points.
        reference: (K, 3).
        spec: the network.
    """
    filled = np.empty((len(chosen), POINT_CHANNELS, chosen.shape[1]), np.float32)
    for axis in range(3):
        filled[:, axis] = points[chosen, axis] - reference[:, axis, None]
    np.clip(filled[:, 0], -FARTHEST_M, FARTHEST_M, out=filled[:, 0])
    filled[:, 3] = points[chosen, 3] / spec.intensity_scale
    filled[:, 4], filled[:, 5] = gaussian[chosen], mask[chosen]
    return filled
