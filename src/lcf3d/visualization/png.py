"""One PNG a frame: the cameras' images above, the bird's-eye view below, a legend on top. No display needed."""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np
import PIL.Image
import PIL.ImageOps
from isal import isal_zlib
from numpy.typing import NDArray

from lcf3d.files import atomic_path
from lcf3d.frame import Frame
from lcf3d.structures import Camera
from lcf3d.visualization.bev import BevView, bev_canvas
from lcf3d.visualization.camera_view import camera_canvas
from lcf3d.visualization.canvas import Canvas, Colour, plain, text_size
from lcf3d.visualization.scene import CAMERA_COLOUR, COLOURS, TRUTH_COLOUR, Scene
from lcf3d.visualization.scratch import scratch

_BAR = (28, 31, 36)
_TEXT = (232, 234, 237)
_BAR_HEIGHT = 26
GRID_COLUMNS = 3
GRID_WIDTH = 1680
BEV_HEIGHT = 640
SURROUND_BEV_HEIGHT = 840
# level of ISA-L: a fifth of the time of zlib's lowest, and as small
_FAST = 1
# of a moving picture whose frames tell no time
GIF_MS = 200


def draw_frame(frame: Frame, scene: Scene, cameras: Sequence[str] | None = None, bev: bool = True) -> PIL.Image.Image:
    """A frame with everything of a scene.

    One camera keeps its own resolution; several are put side by side, three in a row.

    Args:
        frame: images and points; either may be missing.
        scene: what to draw over them, see `Scene.from_fused`.
        cameras: names of those to show; all that have an image if None. Where none has, a single camera (or the first
            of a pair) is drawn without its image, and of several cameras only the bird's-eye view.
        bev: whether the bird's-eye view is drawn.

    Returns:
        RGB picture.
    """
    return PIL.Image.fromarray(frame_pixels(frame, scene, cameras, bev))


def frame_pixels(
    frame: Frame, scene: Scene, cameras: Sequence[str] | None = None, bev: bool = True
) -> NDArray[np.uint8]:
    """(H, W, 3) uint8 the picture of `draw_frame`."""
    shown = _shown_cameras(frame, cameras)
    around = shown or frame.cameras
    panels = _camera_panels(frame, shown, scene)
    width = max((sum(panel.shape[1] for panel in row) for row in panels), default=GRID_WIDTH)
    if bev:
        height = BEV_HEIGHT if len(around) < 3 else SURROUND_BEV_HEIGHT
        everything = scene.boxes if scene.truth is None else np.concatenate([scene.boxes, scene.truth])
        view = BevView.fit(everything, around, width, height)
        panels.append([bev_canvas(frame.points, around, scene, view).pixels()])
    return _joined([[_legend(frame.id, scene, width)], *panels])


def save_png(picture: PIL.Image.Image | NDArray[np.uint8], path: Path) -> None:
    """Write a picture, or its (H, W, 3) uint8 pixels, as PNG, whole or not at all."""
    if isinstance(picture, PIL.Image.Image):
        picture = np.asarray(picture.convert("RGB"))
    with atomic_path(Path(path)) as temporary:
        temporary.write_bytes(png_bytes(picture))


def save_gif(pictures: Iterable[tuple[float | None, PIL.Image.Image]], path: Path) -> None:
    """Write a picture that moves, half as large, whole or not at all.

    Args:
        pictures: at least one, each with its time in seconds; those without stay for a fifth of a second.
        path: the ``.gif`` file.
    """
    times, small = [], []
    for time, picture in pictures:
        times.append(time)
        # a palette found by median cut takes longer than all the rest
        small.append(picture.reduce(2).quantize(method=PIL.Image.Quantize.FASTOCTREE))
    milliseconds = []
    for now, then in zip(times, [*times[1:], None], strict=True):
        seconds = then - now if now is not None and then is not None else 0.0
        milliseconds.append(round(seconds * 1e3) if 0 < seconds <= 2 else GIF_MS)
    # all the same size: pictures of frames with fewer cameras are smaller
    size = (max(p.width for p in small), max(p.height for p in small))
    same = [p if p.size == size else PIL.ImageOps.pad(p.convert("RGB"), size) for p in small]
    path.parent.mkdir(parents=True, exist_ok=True)
    with atomic_path(path) as temporary:
        same[0].save(temporary, "GIF", save_all=True, append_images=same[1:], duration=milliseconds, loop=0)


def png_bytes(pixels: NDArray[np.uint8]) -> bytes:
    """(H, W, 3) uint8 RGB as a PNG file: each row as differences to the pixel before, weakly compressed.

    For pictures with much photograph in them that is a tenth larger than trying all filters, in a tenth of the time.
    """
    height, width, _ = pixels.shape
    rows = pixels.reshape(height, 3 * width)
    filtered = scratch("filtered", height * (1 + 3 * width), np.uint8).reshape(height, -1)
    filtered[:, 0] = 1
    filtered[:, 1:4] = rows[:, :3]
    np.subtract(rows[:, 3:], rows[:, :-3], out=filtered[:, 4:])
    packed = isal_zlib.compress(filtered.data, _FAST)
    header = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    chunks = ((b"IHDR", header), (b"IDAT", packed), (b"IEND", b""))
    return b"\x89PNG\r\n\x1a\n" + b"".join(
        struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data)) for kind, data in chunks
    )


def _shown_cameras(frame: Frame, names: Sequence[str] | None) -> list[Camera]:
    if names is not None:
        return [frame.camera(name) for name in names]
    with_image = [camera for camera in frame.cameras if camera.name in frame.images]
    return with_image or (list(frame.cameras[:1]) if len(frame.cameras) < 3 else [])


def _camera_panels(frame: Frame, cameras: Sequence[Camera], scene: Scene) -> list[list[NDArray[np.uint8]]]:
    """Pictures of the cameras, in rows."""
    columns = min(len(cameras), GRID_COLUMNS)
    width = None if columns < 2 else GRID_WIDTH // columns
    panels = [
        camera_canvas(frame.images.get(camera.name), camera, scene, width, camera.name if columns > 1 else "").pixels()
        for camera in cameras
    ]
    return [panels[i : i + columns] for i in range(0, len(panels), max(columns, 1))]


def _legend(title: str, scene: Scene, width: int) -> NDArray[np.uint8]:
    """A bar with the frame's id and what the colours mean, with counts; wrapped where it is too long."""
    entries: list[tuple[str, Colour, bool]] = [
        (f"{outcome} {count}", COLOURS[outcome], outcome == "dropped") for outcome, count in scene.counts.items()
    ]
    if scene.image_boxes:
        used = sum(int(found.used.sum()) for found in scene.image_boxes.values())
        unused = sum(len(found.used) for found in scene.image_boxes.values()) - used
        entries.append((f"camera detection {used}", CAMERA_COLOUR, False))
        if unused:
            entries.append((f"camera detection without a box {unused}", CAMERA_COLOUR, True))
    if scene.truth is not None:
        entries.append((f"ground truth {len(scene.truth)}", TRUTH_COLOUR, False))
    start = text_size(title, 14)[0] + 28
    places, x, row = [], start, 0
    for text, _, _ in entries:
        length = 26 + text_size(text, 13)[0] + 18
        if x + length > width and x > start:
            x, row = start, row + 1
        places.append((x, row))
        x += length
    canvas = Canvas(plain(_BAR_HEIGHT * (row + 1), width, _BAR))
    canvas.text(8, 4, title, _TEXT, size=14)
    for (text, colour, dashed), (left, line) in zip(entries, places, strict=True):
        middle = _BAR_HEIGHT * (line + 0.5)
        canvas.lines(np.array([[left, middle, left + 20.0, middle]]), colour, width=3.0, dashed=dashed)
        canvas.text(left + 26, middle - 8, text, _TEXT, size=13)
    return canvas.pixels()


def _joined(rows: Sequence[Sequence[NDArray[np.uint8]]]) -> NDArray[np.uint8]:
    """Rows of pictures side by side, one below the other."""
    width = max(sum(picture.shape[1] for picture in row) for row in rows)
    heights = [max(picture.shape[0] for picture in row) for row in rows]
    joined = plain(sum(heights), width, _BAR)
    y = 0
    for row, height in zip(rows, heights, strict=True):
        x = 0
        for picture in row:
            joined[y : y + picture.shape[0], x : x + picture.shape[1]] = picture
            x += picture.shape[1]
        y += height
    return joined
