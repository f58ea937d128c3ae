"""Images and scans as text to embed in a page."""

from __future__ import annotations

import base64
import io

import numpy as np
from numpy.typing import NDArray
from PIL import Image

# images are embedded this wide: sharp enough to judge a miss, about 80 kB a frame
PICTURE_WIDTH_PX = 1040
SCAN_POINTS = 12_000
"""Points of an embedded scan, 96 kB."""


def embedded_image(image: NDArray[np.uint8]) -> str:
    """A ``data:`` address of an (H, W, 3) image as JPEG."""
    small = Image.fromarray(image)
    small.thumbnail((PICTURE_WIDTH_PX, PICTURE_WIDTH_PX))
    buffer = io.BytesIO()
    small.save(buffer, "JPEG", quality=82)
    return f"data:image/jpeg;base64,{base64.b64encode(buffer.getvalue()).decode('ascii')}"


def embedded_scan(points: NDArray[np.float32], count: int = SCAN_POINTS) -> str:
    """At most ``count`` of (N, 3 or more) points, evenly through the scan, as base64 of int16 centimetres x, y, z."""
    step = max(1, -(-len(points) // count))
    centimetres = np.clip(np.round(points[::step, :3] * 100.0), -32768, 32767).astype("<i2")
    return base64.b64encode(centimetres.tobytes()).decode("ascii")
