"""From pooled frustums to a batch: jittered 2D boxes, the variants of proposals, augmentation, targets."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from lcf3d.fusion.frustum import axis_yaws, enlarge_boxes, gaussian_mask
from lcf3d.geometry.boxes import YAW
from lcf3d.localizers.frustum_inputs import (
    border_touched,
    box_rays,
    first_points,
    point_channels,
    reference_of,
    spread_points,
)
from lcf3d.localizers.spec import LocalizerSpec, encode_headings
from lcf3d.structures import BoolArray, FloatArray
from lcf3d.training.frustums import PooledFrustum

NO_GAP = 0.02
"""Points nearer in the image to a point of the object, in box heights, are on its instance mask at least."""


@dataclass(frozen=True)
class Augmentation:
    """How far a training frustum may differ from the labelled one.

    Attributes:
        jitter: largest shift of an edge of the 2D box, as a share of its side.
        narrow: least share of the width that the 2D box of an open shape (a person) keeps: 3D boxes of people are
            wider than what is drawn around them.
        enlargement: of the 2D box when its points are taken, as in inference.
        scale: largest change of size, as a share.
        pitch_deg: standard deviation of the sensor's pitch.
        intensity: largest factor on intensities, and its inverse the least.
        drop: largest share of the points that is left out.
        stereo: chance of a proposal of two views, where there is a second camera.
        mask: chance of a proposal with an instance mask as channel.
        on_mask: chance of a proposal of the points on the mask alone.
    """

    jitter: float = 0.1
    narrow: float = 0.7
    enlargement: float = 0.05
    scale: float = 0.08
    pitch_deg: float = 0.5
    intensity: float = 3.0
    drop: float = 0.6
    stereo: float = 0.15
    mask: float = 0.35
    on_mask: float = 0.1


NO_AUGMENTATION = Augmentation(0.0, 1.0, 0.05, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0)
"""A frustum of the labelled 2D box as it is."""


@dataclass(frozen=True, eq=False)
class FrustumSample:
    """A proposal for the network with its target.

    Attributes:
        points: (n, 4) float32 in the frustum frame.
        gaussian: (n,) float32.
        mask: (n,) float32.
        inside: (n,) bool.
        rays: (4,) see `lcf3d.localizers.frustum_inputs.frustum_rays`.
        cut: (4,) whether the 2D box touches the image's left, top, right, bottom border.
        label: class.
        box: (7,) target in the frustum frame, NaN for none.
    """

    points: NDArray[np.float32]
    gaussian: NDArray[np.float32]
    mask: NDArray[np.float32]
    inside: BoolArray
    rays: FloatArray
    cut: BoolArray
    label: int
    box: FloatArray


def draw(frustum: PooledFrustum, open_shape: bool, how: Augmentation, rng: np.random.Generator) -> FrustumSample:
    """One proposal from a pooled frustum.

    Args:
        frustum: what lies behind the labelled 2D box.
        open_shape: whether its class is one of people.
        how: what may be changed.
        rng: all that is random.
    """
    box2d = _jittered(frustum.box2d, open_shape, how, rng, frustum.camera.width, frustum.camera.height)
    kept = _inside_box(frustum.pixels, box2d, how.enlargement)
    gaussian = gaussian_mask(frustum.pixels.astype(np.float64), box2d)
    on_mask = frustum.gap <= NO_GAP + rng.uniform(0, 0.05)
    variant = rng.uniform()
    if how.stereo and variant < how.stereo and not np.isnan(frustum.right_box2d[0]) and frustum.right_box2d.any():
        right = _jittered(frustum.right_box2d, open_shape, how, rng, frustum.camera.width, frustum.camera.height)
        kept &= _inside_box(frustum.right_pixels, right, how.enlargement)
        gaussian = np.maximum(gaussian, gaussian_mask(frustum.right_pixels.astype(np.float64), right))
    mask = np.ones(len(kept), np.float32)
    if variant > 1 - how.mask - how.on_mask and not frustum.empty:
        mask = on_mask.astype(np.float32)
        if variant > 1 - how.on_mask:
            kept &= on_mask
            mask[:] = 1
    rows = np.flatnonzero(kept)
    if how.drop:
        fewer = rows[rng.uniform(size=len(rows)) >= rng.choice([0.0, how.drop]) * rng.uniform()]
        rows = fewer if len(fewer) >= 5 else rows
    if not len(rows):
        rows = np.arange(len(kept))
    yaw = float(axis_yaws(box2d[None], frustum.camera)[0])
    sample = FrustumSample(
        _turned(frustum.points[rows], -yaw),
        gaussian[rows],
        mask[rows],
        frustum.inside[rows],
        box_rays(box2d[None], np.array([yaw]), frustum.camera)[0],
        border_touched(box2d[None], np.array([[frustum.camera.width, frustum.camera.height]]))[0],
        frustum.label,
        _turned_box(frustum.box, -yaw),
    )
    return _augmented(sample, how, rng) if how is not NO_AUGMENTATION else sample


def _jittered(
    box: FloatArray, open_shape: bool, how: Augmentation, rng: np.random.Generator, width: int, height: int
) -> FloatArray:
    """A 2D box with moved edges, inside the image."""
    sides = np.tile(box[2:] - box[:2], 2)
    moved = box + rng.uniform(-how.jitter, how.jitter, 4) * rng.uniform() * sides
    if open_shape and how.narrow < 1:
        middle, half = (moved[0] + moved[2]) / 2, (moved[2] - moved[0]) / 2
        half *= rng.uniform(how.narrow, 1.05)
        moved[0], moved[2] = middle - half, middle + half
    moved[0::2] = np.clip(moved[0::2], 0, width)
    moved[1::2] = np.clip(moved[1::2], 0, height)
    return moved if moved[2] - moved[0] > 1 and moved[3] - moved[1] > 1 else box.copy()


def _inside_box(pixels: NDArray[np.float32], box: FloatArray, enlargement: float) -> BoolArray:
    x1, y1, x2, y2 = enlarge_boxes(box[None], enlargement)[0]
    u, v = pixels[:, 0], pixels[:, 1]
    inside: BoolArray = (u >= x1) & (u <= x2) & (v >= y1) & (v <= y2)
    return inside


def _turned(points: NDArray[np.float32], angle: float) -> NDArray[np.float32]:
    cos, sin = np.cos(angle), np.sin(angle)
    turned = points.copy()
    turned[:, 0] = cos * points[:, 0] - sin * points[:, 1]
    turned[:, 1] = sin * points[:, 0] + cos * points[:, 1]
    return turned


def _turned_box(box: FloatArray, angle: float) -> FloatArray:
    turned = box.copy()
    turned[0] = np.cos(angle) * box[0] - np.sin(angle) * box[1]
    turned[1] = np.sin(angle) * box[0] + np.cos(angle) * box[1]
    turned[YAW] = box[YAW] + angle
    return turned


def _augmented(sample: FrustumSample, how: Augmentation, rng: np.random.Generator) -> FrustumSample:
    """Mirrored, scaled about the sensor, tilted, with other intensities."""
    points, box, rays, cut = sample.points.copy(), sample.box.copy(), sample.rays.copy(), sample.cut.copy()
    if rng.uniform() < 0.5:
        points[:, 1], box[1], box[YAW] = -points[:, 1], -box[1], -box[YAW]
        rays[2], rays[3] = -rays[3], -rays[2]
        cut = cut[[2, 1, 0, 3]]
    # seen from the sensor an object that grows with its distance looks the same: the 2D box stays
    factor = 1 + rng.uniform(-how.scale, how.scale)
    points[:, :3] *= np.float32(factor)
    box[:6] *= factor
    tilt = np.tan(np.radians(how.pitch_deg * rng.normal()))
    points[:, 2] += (tilt * points[:, 0]).astype(np.float32)
    box[2] += tilt * box[0]
    rays[:2] += tilt
    gain = how.intensity ** rng.uniform(-1, 1)
    points[:, 3] = np.clip(points[:, 3] * gain, 0, max(1.0, float(points[:, 3].max(initial=0))))
    if rng.uniform() < 0.1:
        points[:, 3] = 0
    return replace(sample, points=points, box=box, rays=rays, cut=cut)


def assemble(samples: Sequence[FrustumSample], spec: LocalizerSpec, rng: np.random.Generator) -> dict[str, FloatArray]:
    """Input and target arrays of a batch, float32 and int64.

    Returns:
        ``points``, ``context`` as in `lcf3d.localizers.frustum_inputs`; ``mask`` (K, N) 1 for points of the object;
        ``centre`` (K, 3) in input coordinates; ``size`` (K, 3); ``yaw`` (K,), ``heading`` (K,) bins and
        ``heading_residual`` (K,); ``label`` (K,); ``real`` (K,) 0 for frustums of nothing.
    """
    counts = np.array([len(s.points) for s in samples], dtype=np.int64)
    labels = np.array([s.label for s in samples], dtype=np.int64)
    starts = np.concatenate([[0], np.cumsum(counts)[:-1]])
    one_hot = np.eye(len(spec.class_names), dtype=np.float32)[labels]
    # the order in which points are taken must not matter
    order = np.concatenate([start + rng.permutation(n) for start, n in zip(starts, counts, strict=True)])
    points = np.concatenate([s.points for s in samples])[order]
    gaussian = np.concatenate([s.gaussian for s in samples])[order]
    inside = np.concatenate([s.inside for s in samples])[order]
    mask = np.concatenate([s.mask for s in samples])[order]
    if spec.form == "v2":
        chosen = first_points(counts, spec.points) + starts[:, None]
        reference, context = np.zeros((len(samples), 3)), one_hot
        columns = np.concatenate([points, gaussian[:, None]], axis=1)[chosen].transpose(0, 2, 1)
    else:
        heights = spec.template_array[labels, 2]
        reference, known = reference_of(
            np.array([s.rays for s in samples]), heights, counts, np.array([s.cut for s in samples])
        )
        chosen = spread_points(counts, spec.points) + starts[:, None]
        context = np.concatenate([one_hot, known], axis=1)
        columns = point_channels(points, gaussian, mask, chosen, reference, spec)
    boxes = np.array([s.box for s in samples])
    real = ~np.isnan(boxes[:, 0])
    boxes[~real] = [*[0.0] * 3, *[1.0] * 3, 0.0]
    centres = boxes[:, :3].copy()
    if spec.form == "v2":
        centres[:, 2] -= boxes[:, 5] / 2
    bins, residual = encode_headings(boxes[:, YAW], spec)
    return {
        "points": np.ascontiguousarray(columns, dtype=np.float32),
        "context": context,
        "mask": inside[chosen].astype(np.float32),
        "centre": (centres - reference).astype(np.float32),
        "size": boxes[:, 3:6].astype(np.float32),
        "yaw": boxes[:, YAW].astype(np.float32),
        "heading": bins,
        "heading_residual": residual.astype(np.float32),
        "label": labels,
        "real": real.astype(np.float32),
        "reference": reference.astype(np.float32),
    }
