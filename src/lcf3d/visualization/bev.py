"""The bird's-eye view: points, boxes, fields of view and range rings, seen from above."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import PIL.Image
from numpy.typing import NDArray

from lcf3d.geometry.boxes import LENGTH, YAW, bev_corners
from lcf3d.geometry.camera import pixel_rays
from lcf3d.geometry.epipolar import camera_centre
from lcf3d.kernels import kernel
from lcf3d.structures import Camera, FloatArray
from lcf3d.visualization.canvas import Canvas, Colour, plain
from lcf3d.visualization.scene import COLOURS, TRUTH_COLOUR, Scene

_GROUND = (16, 18, 22)
_RING = (70, 76, 84)
_RING_TEXT = (140, 148, 158)
_VIEW = (110, 118, 128)
# heights between which points go from dark to bright, metres in the LiDAR frame
_HEIGHTS = (-2.0, 2.0)
_LOW, _HIGH = np.array([58.0, 66.0, 82.0]), np.array([165.0, 178.0, 190.0])
RING_STEP = 10.0
# metres: around the outermost box centres; behind the LiDAR where cameras only look ahead; most in any direction
MARGIN, BEHIND, FARTHEST = 6.0, 4.0, 80.0


@dataclass(frozen=True)
class BevView:
    """Which part of the ground a picture shows, and at what scale. Forward (x) is right, left (y) is up.

    Attributes:
        width: of the picture in pixels.
        height: of the picture in pixels.
        pixels_per_metre: scale.
        origin: pixel (column, row) of the LiDAR.
        reach: metres from the LiDAR to the farthest thing that is drawn: rings end there.
    """

    width: int
    height: int
    pixels_per_metre: float
    origin: tuple[float, float]
    reach: float = FARTHEST

    @classmethod
    def fit(cls, boxes: FloatArray, cameras: Sequence[Camera], width: int, height: int) -> BevView:
        """A view in which (N, 7) ``boxes`` fit, up to `FARTHEST` metres.

        The LiDAR is near the left edge where all cameras look ahead, else where the boxes leave it.
        """
        ahead = bool(cameras) and all(camera.camera_from_lidar[2, 0] > 0.5 for camera in cameras)
        low = boxes[:, :2].min(axis=0, initial=0) - MARGIN
        high = boxes[:, :2].max(axis=0, initial=0) + MARGIN
        low = np.clip(low, -FARTHEST, [-BEHIND if ahead else -15, -10])
        high = np.clip(high, [30, 10], FARTHEST)
        if ahead:
            low[0] = -BEHIND
        scale = float(min(np.array([width, height]) / (high - low)))
        # what a side has too much is shared by both ends, but ahead goes to the front
        spare = np.array([width, height]) - scale * (high - low)
        column = -low[0] * scale + (0 if ahead else spare[0] / 2)
        away = np.hypot(boxes[:, 0], boxes[:, 1]).max(initial=20.0) + MARGIN
        reach = float(min(away, np.hypot(FARTHEST, FARTHEST)))
        return cls(width, height, scale, (float(column), float(high[1] * scale + spare[1] / 2)), reach)

    def pixels(self, points: FloatArray) -> FloatArray:
        """(..., 2) pixels of (..., 2) ground positions x, y."""
        columns = self.origin[0] + points[..., 0] * self.pixels_per_metre
        rows = self.origin[1] - points[..., 1] * self.pixels_per_metre
        return np.stack([columns, rows], axis=-1)


def draw_bev(
    points: NDArray[np.float32] | None, cameras: Sequence[Camera], scene: Scene, view: BevView
) -> PIL.Image.Image:
    """The scene from above.

    Args:
        points: (N, 4 or more) LiDAR points, or None.
        cameras: whose fields of view are drawn.
        scene: what to draw.
        view: where and how large.

    Returns:
        RGB picture.
    """
    return bev_canvas(points, cameras, scene, view).image()


def bev_canvas(points: NDArray[np.float32] | None, cameras: Sequence[Camera], scene: Scene, view: BevView) -> Canvas:
    """What `draw_bev` draws on, all drawn."""
    canvas = Canvas(_point_picture(points, view))
    if points is None:
        canvas.text(6, 4, "no scan", _RING_TEXT)
    seen = 0.0 if points is None or not len(points) else float(np.hypot(points[:, 0], points[:, 1]).max())
    _draw_rings(canvas, view, max(view.reach, min(seen, FARTHEST)))
    for camera in cameras:
        canvas.lines(_field_of_view(camera, view), _VIEW, width=1.0)
    if scene.truth is not None:
        for box in scene.truth:
            canvas.lines(_outline(box, view), TRUTH_COLOUR, width=1.0, opacity=0.85)
    for i, way in enumerate(scene.trails):
        _draw_trail(canvas, view.pixels(way[:, :2]), COLOURS[scene.outcomes[i]])
    for i in scene.drawing_order:
        colour, outline = COLOURS[scene.outcomes[i]], _outline(scene.boxes[i], view)
        if scene.outcomes[i] == "dropped":
            canvas.lines(outline, colour, width=1.0, opacity=0.75, dashed=True)
        else:
            canvas.lines(outline, colour, width=2.0)
    for i, text in enumerate(scene.texts):
        corners = view.pixels(bev_corners(scene.boxes[i : i + 1])[0])
        around = [*corners.min(axis=0).tolist(), *corners.max(axis=0).tolist()]
        shown = around[0] >= 0 and around[2] <= view.width and around[1] >= 0 and around[3] <= view.height
        if text and shown:
            canvas.label(around, text, COLOURS[scene.outcomes[i]], size=11, filled=False)
    return canvas


def _draw_trail(canvas: Canvas, way: FloatArray, colour: Colour) -> None:
    """A way of (K, 2) pixels, fainter the longer ago."""
    for k in range(1, len(way)):
        opacity = 0.15 + 0.65 * k / (len(way) - 1)
        canvas.lines(np.concatenate([way[k - 1], way[k]])[None], colour, width=1.6, opacity=opacity)


def _point_picture(points: NDArray[np.float32] | None, view: BevView) -> NDArray[np.uint8]:
    """Points as dots, brighter with height; the highest point of a pixel shows."""
    levels = np.zeros((view.height, view.width), np.uint8)
    picture = plain(view.height, view.width, _GROUND)
    if points is not None and len(points):
        _highest(np.asarray(points)[:, :3], view.pixels_per_metre, *view.origin, *_HEIGHTS, levels)
        shades = _LOW + np.linspace(0, 1, 255)[:, None] * (_HIGH - _LOW)
        _paint(levels, shades.astype(np.uint8), picture)
    return picture


@kernel
def _highest(points, scale, column, row, low, high, levels):  # type: ignore[no-untyped-def]
    """Raise each pixel of uint8 ``levels`` to that of its highest point: 1 at ``low`` metres, 255 at ``high``."""
    for n in range(len(points)):
        x, y = column + points[n, 0] * scale, row - points[n, 1] * scale
        if x >= 0 and x < levels.shape[1] and y >= 0 and y < levels.shape[0]:
            level = 1 + 254 * min(max((points[n, 2] - low) / (high - low), 0.0), 1.0)
            # a height that is no number counts as none
            if level > levels[int(y), int(x)]:
                levels[int(y), int(x)] = np.uint8(level)


@kernel
def _paint(levels, shades, picture):  # type: ignore[no-untyped-def]
    """Pixels of a level above 0 in the colour of that level."""
    for row in range(levels.shape[0]):
        for column in range(levels.shape[1]):
            if levels[row, column]:
                for c in range(3):
                    picture[row, column, c] = shades[levels[row, column] - 1, c]


def _draw_rings(canvas: Canvas, view: BevView, reach: float) -> None:
    """Rings as far as there is something, and the LiDAR in their middle."""
    corners = np.array([[0, 0], [view.width, 0], [0, view.height], [view.width, view.height]]) - view.origin
    farthest = float(np.hypot(*corners.T).max()) / view.pixels_per_metre
    angles = np.linspace(0, 2 * np.pi, 181)
    circle = np.stack([np.cos(angles), np.sin(angles)], axis=1)
    for radius in np.arange(RING_STEP, min(farthest, reach + RING_STEP), RING_STEP):
        ring = view.pixels(radius * circle)
        canvas.lines(np.concatenate([ring[:-1], ring[1:]], axis=1), _RING, width=1.0, opacity=0.7)
        canvas.text(*_ring_label(radius, view), f"{radius:.0f} m", _RING_TEXT, size=10)
    # an arrow head where the LiDAR is, pointing forward
    tip = np.array([[0.0, 1.0], [1.8, 0.0], [0.0, -1.0], [0.0, 1.0]]) * 6 / view.pixels_per_metre
    arrow = view.pixels(tip)
    canvas.lines(np.concatenate([arrow[:-1], arrow[1:]], axis=1), (220, 220, 220), width=1.5)


def _ring_label(radius: float, view: BevView) -> tuple[float, float]:
    """Top left pixel of a ring's label: on the lower edge where the ring gets there, else on the forward axis."""
    pixels = radius * view.pixels_per_metre
    below = view.height - 9 - view.origin[1]
    if pixels < below + 30:
        return view.origin[0] + pixels + 3, view.origin[1] - 7
    return view.origin[0] + float(np.sqrt(pixels**2 - below**2)) - 12, view.height - 15


def _field_of_view(camera: Camera, view: BevView) -> FloatArray:
    """(2, 4) lines from a camera along the left and right border of its image, on the ground plan."""
    # of the whole projection: one with a baseline (KITTI's P2) has its centre beside the reference camera's
    centre = camera_centre(camera)
    reach = 2 * max(view.width, view.height) / view.pixels_per_metre
    sides = pixel_rays(np.array([[0, camera.height / 2], [camera.width, camera.height / 2]]), camera)
    sides /= np.linalg.norm(sides, axis=1, keepdims=True)
    return np.array([view.pixels(np.stack([centre, centre + reach * side])[:, :2]).ravel() for side in sides])


def _outline(box: FloatArray, view: BevView) -> FloatArray:
    """(5, 4) sides of a box on the ground and a tick from its centre out over its front."""
    corners = bev_corners(box[None])[0]
    heading = np.array([np.cos(box[YAW]), np.sin(box[YAW])])
    tick = np.stack([box[:2], box[:2] + heading * (box[LENGTH] / 2 + 0.6)])
    loop = view.pixels(np.concatenate([corners, corners[:1]]))
    sides = np.concatenate([loop[:-1], loop[1:]], axis=1)
    return np.concatenate([sides, view.pixels(tick).reshape(1, 4)])
