"""A camera's image with projected 3D boxes and 2D detections."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache

import numpy as np
import PIL.Image
from numpy.typing import NDArray

from lcf3d.geometry.boxes import EDGES, box_corners
from lcf3d.geometry.camera import project_boxes, project_points
from lcf3d.geometry.lens import NEAR, edges_through_lens, polygon_through_lens
from lcf3d.kernels import kernel
from lcf3d.structures import Camera, FloatArray, IntArray
from lcf3d.visualization.canvas import Canvas, plain
from lcf3d.visualization.scene import CAMERA_COLOUR, COLOURS, TRUTH_COLOUR, Scene

# pixels: height of the least thing with a label, and width up to which a picture has smaller labels
LEAST_LABELLED, SMALL_PANEL = 14.0, 700
_NO_IMAGE = (40, 43, 48)
# corners of the front face, around it (`geometry.boxes.CORNER_SIGNS`)
_FRONT = [0, 1, 5, 4]


def projected_edges(boxes: FloatArray, camera: Camera) -> FloatArray:
    """(N, 12, 4) pixel segments ``x1, y1, x2, y2`` of the edges of (N, 7) boxes, cut at the near plane.

    Edges wholly behind the near plane are NaN. Order: `lcf3d.geometry.boxes.EDGES`. Through a lens the edges bend:
    (N, S, 4) segments of all of them, NaN where there is nothing.
    """
    if camera.distortion is not None:
        bent = edges_through_lens(boxes, camera)
        return np.concatenate([bent[:, :, :-1], bent[:, :, 1:]], axis=-1).reshape(len(boxes), -1, 4)
    corners = box_corners(boxes)
    homogeneous = corners @ camera.pixels_from_lidar[:, :3].T + camera.pixels_from_lidar[:, 3]
    a, b = homogeneous[:, EDGES[:, 0]], homogeneous[:, EDGES[:, 1]]
    depth_a, depth_b = a[..., 2] - NEAR, b[..., 2] - NEAR
    crossing = (depth_a >= 0) != (depth_b >= 0)
    t = np.divide(depth_a, depth_a - depth_b, out=np.zeros_like(depth_a), where=crossing)
    cut = a + t[..., None] * (b - a)
    start = np.where((crossing & (depth_a < 0))[..., None], cut, a)
    end = np.where((crossing & (depth_b < 0))[..., None], cut, b)
    behind = (depth_a < 0) & (depth_b < 0)
    with np.errstate(divide="ignore", invalid="ignore"):
        segments = np.concatenate([start[..., :2] / start[..., 2:], end[..., :2] / end[..., 2:]], axis=-1)
    segments[behind] = np.nan
    return segments


def _front_face(corners: FloatArray, camera: Camera) -> FloatArray:
    """Pixels around a face of (4, 3) corners; empty unless all of it is in front of the camera."""
    if camera.distortion is not None:
        return polygon_through_lens(corners, camera)
    pixels, depths = project_points(corners, camera)
    return pixels if (depths > NEAR).all() else pixels[:0]


def scaled_camera(camera: Camera, scale: float) -> Camera:
    """The camera of the image shrunk or enlarged by ``scale``."""
    projection = np.array(camera.projection)
    projection[:2] *= scale
    return replace(
        camera, projection=projection, width=round(camera.width * scale), height=round(camera.height * scale)
    )


def draw_camera(
    image: NDArray[np.uint8] | None, camera: Camera, scene: Scene, width: int | None = None, title: str = ""
) -> PIL.Image.Image:
    """An image with everything of the scene that the camera sees.

    Args:
        image: (H, W, 3) uint8 RGB, or None for a plain ground.
        camera: its calibration.
        scene: what to draw.
        width: of the picture in pixels; that of the camera if None.
        title: written into the upper left corner.

    Returns:
        RGB picture.
    """
    return camera_canvas(image, camera, scene, width, title).image()


def camera_canvas(
    image: NDArray[np.uint8] | None, camera: Camera, scene: Scene, width: int | None = None, title: str = ""
) -> Canvas:
    """What `draw_camera` draws on, all drawn."""
    scale = 1.0 if width is None else width / camera.width
    camera = scaled_camera(camera, scale)
    if image is None:
        background = plain(camera.height, camera.width, _NO_IMAGE)
        title = f"{camera.name}: no image"
    else:
        background = resized(image, camera.width, camera.height)
    canvas = Canvas(background)
    if title:
        canvas.text(6, 4, title, (255, 255, 255), plate=True)
    _draw_truth(canvas, camera, scene)
    _draw_boxes(canvas, camera, scene)
    _draw_image_boxes(canvas, camera, scene, scale)
    return canvas


def resized(image: NDArray[np.uint8], width: int, height: int) -> NDArray[np.uint8]:
    """A new (height, width, 3) picture of an (H, W, 3) one; where it is made much smaller, by the mean of each area."""
    if image.shape[:2] == (height, width):
        return np.array(image)
    if min(image.shape[1] / width, image.shape[0] / height) < 2:
        picture = PIL.Image.fromarray(image).resize((width, height), PIL.Image.Resampling.LANCZOS)
        return np.array(picture)
    small = np.empty((height, width, 3), np.uint8)
    rows = np.ascontiguousarray(image).reshape(image.shape[0], -1)
    _average(rows, *_shares(image.shape[0], height), *_shares(image.shape[1], width), small)
    return small


@lru_cache(maxsize=32)
def _shares(many: int, few: int) -> tuple[IntArray, NDArray[np.uint32]]:
    """Of ``few`` equal parts of ``many`` pixels: where each begins, and (few, K) 1024ths of pixels from there on."""
    size = many / few
    edges = np.arange(few + 1) * size
    most = int(np.ceil(size)) + 1
    first = np.clip(np.floor(edges[:-1]).astype(np.int64), 0, many - most)
    pixels = first[:, None] + np.arange(most)
    within = np.minimum(pixels + 1, edges[1:, None]) - np.maximum(pixels, edges[:-1, None])
    shares = np.round(np.maximum(within, 0) / size * 1024).astype(np.int64)
    # together they are one
    shares[np.arange(few), shares.argmax(axis=1)] += 1024 - shares.sum(axis=1)
    return first, shares.astype(np.uint32)


@kernel
def _average(rows, top, row_shares, left, column_shares, small):  # type: ignore[no-untyped-def]
    """The mean of each area of an image whose rows are ``r, g, b, r, ...``, in whole numbers of 1024 * 1024ths."""
    sums = np.empty(rows.shape[1], np.uint32)
    for row in range(small.shape[0]):
        sums[:] = 0
        for k in range(row_shares.shape[1]):
            share, pixels = row_shares[row, k], rows[top[row] + k]
            if share:
                for n in range(len(sums)):
                    sums[n] += share * pixels[n]
        for column in range(small.shape[1]):
            red, green, blue = np.uint32(1 << 15), np.uint32(1 << 15), np.uint32(1 << 15)
            place = 3 * left[column]
            for k in range(column_shares.shape[1]):
                share = column_shares[column, k]
                red += share * (sums[place] >> np.uint32(4))
                green += share * (sums[place + 1] >> np.uint32(4))
                blue += share * (sums[place + 2] >> np.uint32(4))
                place += 3
            small[row, column, 0] = np.uint8(red >> np.uint32(16))
            small[row, column, 1] = np.uint8(green >> np.uint32(16))
            small[row, column, 2] = np.uint8(blue >> np.uint32(16))


def _draw_truth(canvas: Canvas, camera: Camera, scene: Scene) -> None:
    if scene.truth is None:
        return
    _, visible = project_boxes(scene.truth, camera)
    for edges in projected_edges(scene.truth[visible], camera):
        canvas.lines(edges, TRUTH_COLOUR, width=1.0, opacity=0.8)


def _draw_boxes(canvas: Canvas, camera: Camera, scene: Scene) -> None:
    """Fused boxes with a tinted front, dropped ones dashed and dim beneath them; then the labels."""
    extents, visible = project_boxes(scene.boxes, camera)
    edges = projected_edges(scene.boxes, camera)
    order = [i for i in scene.drawing_order if visible[i]]
    fronts = box_corners(scene.boxes)[:, _FRONT]
    for i in order:
        front = _front_face(fronts[i], camera)
        if scene.outcomes[i] != "dropped" and len(front):
            canvas.polygon(front, COLOURS[scene.outcomes[i]], 0.16)
    for i in order:
        if scene.outcomes[i] == "dropped":
            canvas.lines(edges[i], COLOURS["dropped"], width=1.0, opacity=0.65, dashed=True)
        else:
            canvas.lines(edges[i], COLOURS[scene.outcomes[i]], width=1.8, halo=True)
    size = 12.0 if canvas.width > SMALL_PANEL else 10.0
    for i in range(len(scene.texts)):
        if visible[i] and scene.texts[i] and _is_legible(extents[i]):
            canvas.label(extents[i].tolist(), scene.texts[i], COLOURS[scene.outcomes[i]], size)


def _draw_image_boxes(canvas: Canvas, camera: Camera, scene: Scene, scale: float) -> None:
    found = scene.image_boxes.get(camera.name)
    if found is None:
        return
    for box, used, text in zip(found.boxes * scale, found.used, found.texts, strict=True):
        canvas.lines(rectangle(box), CAMERA_COLOUR, width=1.0, opacity=0.9, dashed=not used)
        if text and _is_legible(box):
            canvas.label(box.tolist(), text, CAMERA_COLOUR, size=10, filled=False)


def _is_legible(extent: FloatArray) -> bool:
    """Whether something is tall enough for a label; around smaller things labels hide more than they say."""
    return bool(extent[3] - extent[1] >= LEAST_LABELLED)


def rectangle(box: FloatArray) -> FloatArray:
    """(4, 4) segments around a box ``x1, y1, x2, y2``."""
    x1, y1, x2, y2 = box
    return np.array([[x1, y1, x2, y1], [x2, y1, x2, y2], [x2, y2, x1, y2], [x1, y2, x1, y1]])
