"""How a camera turns light into an image, frame by frame: exposure, contrast, colour and sharpness that vary."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float32]


@dataclass(frozen=True)
class Photo:
    """The look of one frame; the defaults change nothing.

    Attributes:
        exposure: factor on the metered exposure.
        contrast: exponent around middle grey (0.18), above 1 for deep shadows and burnt lights.
        saturation: factor on the distance from grey.
        balance: (3,) factors on red, green and blue.
        blur_px: standard deviation of the lens blur in pixels.
        fringe_px: sideways shift of red against blue, as lenses and colour filters leave at edges.
        burn: how far bright things (skies, sunlit walls) are driven beyond white.
        noise: factor on the sensor noise.
        shade: factor on the light that reaches places in the shade.
    """

    exposure: float = 1.0
    contrast: float = 1.0
    saturation: float = 1.0
    balance: tuple[float, float, float] = (1.0, 1.0, 1.0)
    blur_px: float = 0.0
    fringe_px: float = 0.0
    burn: float = 0.0
    noise: float = 1.0
    shade: float = 1.0

    def apply(self, radiance: Floats) -> Floats:
        """(H, W, 3) exposed linear radiance with everything but exposure, noise and shade."""
        x = radiance
        if self.blur_px or self.fringe_px:
            x = np.stack([_softened(x[..., k], self.blur_px, (1 - k) * self.fringe_px) for k in range(3)], axis=-1)
        grey = x.mean(axis=2, keepdims=True)
        x = np.maximum(grey + (x - grey) * np.float32(self.saturation), 0) * np.array(self.balance, np.float32)
        if self.contrast != 1:
            x = np.float32(_GREY) * (x / np.float32(_GREY)) ** np.float32(self.contrast)
        if self.burn:
            x = x * (1 + np.float32(self.burn) * np.clip(x - np.float32(0.35), 0, 1))
        return np.asarray(x, dtype=np.float32)


_GREY: Final = 0.18
NEUTRAL: Final = Photo()


def draw_photo(rng: np.random.Generator, scale: float = 1.0) -> Photo:
    """A look at random, from faint and grey to harsh and gaudy; ``scale`` is the size of the images, for the blur."""
    warm = float(rng.normal(0, 0.05))
    tint = float(rng.normal(0, 0.025))
    return Photo(
        float(np.exp(rng.normal(-0.28, 0.33))),
        float(np.clip(rng.normal(1.06, 0.15), 0.8, 1.5)),
        float(np.clip(rng.normal(0.75, 0.2), 0.2, 1.3)),
        (1 + warm, 1 + tint, 1 - warm),
        scale * float(rng.uniform(0.35, 0.85)),
        scale * float(rng.choice([0.0, rng.uniform(0.2, 0.9)])),
        float(rng.uniform(0.0, 4.0)),
        float(rng.uniform(0.4, 1.5)),
        float(rng.uniform(0.5, 1.1)),
    )


def _softened(channel: Floats, blur_px: float, shift_px: float) -> Floats:
    """An (H, W) channel blurred and shifted sideways, by a small separable kernel."""
    reach = 3
    offsets = np.arange(-reach, reach + 1)
    across = np.exp(-0.5 * ((offsets + shift_px) / max(blur_px, 0.3)) ** 2)
    down = np.exp(-0.5 * (offsets / max(blur_px, 0.3)) ** 2)
    result = channel
    for axis, kernel in ((0, down), (1, across)):
        kernel = np.where(kernel > 2e-3 * kernel.sum(), kernel, 0.0)
        weights = (kernel / kernel.sum()).astype(np.float32)
        pad = [(reach, reach) if a == axis else (0, 0) for a in (0, 1)]
        padded, length = np.pad(result, pad, mode="edge"), channel.shape[axis]
        total = np.zeros_like(channel)
        for k in np.flatnonzero(weights).tolist():
            total += weights[k] * (padded[k : k + length] if axis == 0 else padded[:, k : k + length])
        result = total
    return result
