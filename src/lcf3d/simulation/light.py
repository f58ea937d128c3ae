"""Sun, sky, haze and lamps of a scene, as the numbers that the shaders read."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from lcf3d.simulation.textures import SIZE, cloud_noise

SKY_HEIGHT: Final = 96
SKY_WIDTH: Final = 384
MAX_LAMPS: Final = 12


@dataclass(frozen=True, eq=False)
class Light:
    """Everything that shines.

    Attributes:
        sun: (3,) unit vector towards the sun (or moon).
        sun_colour: (3,) linear RGB irradiance from it on a facing surface, in units of pi.
        sky_ambient: (3,) light from above on an open horizontal surface.
        ground_ambient: (3,) light from below on a surface that looks down.
        haze_colour: (3,) what far things fade to.
        haze_m: distance of fading.
        wet: 0 dry to 1 wet road.
        night: 0 day, 1 night (lamps are lit).
        lamps: (L, 4) world positions and power of street lamps.
        sky: (SKY_HEIGHT, SKY_WIDTH, 3) float32 radiance by elevation (row 0 is the horizon) and azimuth.
    """

    sun: NDArray[np.float64]
    sun_colour: NDArray[np.float64]
    sky_ambient: NDArray[np.float64]
    ground_ambient: NDArray[np.float64]
    haze_colour: NDArray[np.float64]
    haze_m: float
    wet: float
    night: float
    lamps: NDArray[np.float64]
    sky: NDArray[np.float32]

    def numbers(self, eye: NDArray[np.float64], forward: NDArray[np.float64]) -> NDArray[np.float32]:
        """(26 + 4 L,) float32: what the shader reads, with the position and direction of the car's headlamps."""
        head = [
            *self.sun,
            *self.sun_colour,
            *self.sky_ambient,
            *self.ground_ambient,
            *self.haze_colour,
            self.haze_m,
            self.wet,
            self.night,
            *eye,
            *forward,
            len(self.lamps),
            0.0,
        ]
        return np.array([*head, *self.lamps.reshape(-1)], dtype=np.float32)


def make_light(
    sun: NDArray[np.float64],
    cloudiness: float,
    haze_m: float,
    look: int,
    rain: float = 0.0,
    night: bool = False,
    lamps: NDArray[np.float64] | None = None,
) -> Light:
    """The light of a scene by day or night, dry or in ``rain`` (0 to 1)."""
    cloudiness = max(cloudiness, min(1.0, 1.5 * rain))
    warm = np.clip(1.35 - 1.1 * sun[2], 0, 1)
    clear = 1.0 - 0.93 * np.clip((cloudiness - 0.45) / 0.45, 0, 1)
    sun_colour = np.array([1.0, 0.93 - 0.13 * warm, 0.82 - 0.25 * warm]) * 3.1 * clear
    blue = np.array([0.30, 0.44, 0.68])
    grey = np.array([0.60, 0.63, 0.68])
    cover = np.clip(cloudiness * 1.2, 0, 1)
    ambient = blue * 0.55 * (1 - cover) + grey * 0.85 * cover
    if night:
        sun_colour, ambient = sun_colour * 0.008, np.array([0.010, 0.013, 0.022])
    lit_ground = 0.13 * (sun_colour * max(sun[2], 0.1) + ambient)
    haze = (np.array([0.62, 0.70, 0.80]) * (1 - cover) + np.array([0.70, 0.72, 0.75]) * cover) * (
        0.012 if night else 1.0
    )
    sky = _sky(sun, cloudiness, haze, look, night)
    if rain:
        haze_m = min(haze_m, 320.0 * (1.2 - rain))
    no_lamps = np.zeros((0, 4))
    return Light(
        sun,
        sun_colour,
        ambient,
        lit_ground,
        haze,
        haze_m,
        float(min(1.0, rain * 1.3)),
        float(night),
        no_lamps if lamps is None or not night else lamps[:MAX_LAMPS],
        sky,
    )


def _sky(
    sun: NDArray[np.float64], cloudiness: float, haze: NDArray[np.float64], look: int, night: bool
) -> NDArray[np.float32]:
    elevation = (np.arange(SKY_HEIGHT) + 0.5) / SKY_HEIGHT * np.pi / 2
    azimuth = (np.arange(SKY_WIDTH) + 0.5) / SKY_WIDTH * 2 * np.pi - np.pi
    e, a = np.meshgrid(elevation, azimuth, indexing="ij")
    x, y, z = np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)
    zenith = np.array([0.13, 0.27, 0.62])
    fade = np.exp(-z * 4.2)[:, :, None]
    base = zenith * (1 - fade) + haze * 1.05 * fade
    towards = np.clip(x * sun[0] + y * sun[1] + z * sun[2], 0, 1)
    glow = 0.5 * towards**8 + 1.2 * towards**64 + 6.0 * towards**900
    base = base + glow[:, :, None] * np.array([1.0, 0.92, 0.78])
    shift = np.random.default_rng(look).uniform(0, SIZE, 4)
    noise = cloud_noise()
    density = np.zeros_like(z)
    for scale, weight, k in ((34.0, 0.75, 0), (110.0, 0.35, 2)):
        u = (x / (z + 0.12) * scale + shift[k]).astype(np.int64) % SIZE
        v = (y / (z + 0.12) * scale + shift[k + 1]).astype(np.int64) % SIZE
        density += weight * noise[v, u]
    cover = np.clip((density + 3.6 * (cloudiness - 0.55)) * 1.3, 0, 1) * np.clip(z * 9, 0.15, 1)
    bright = np.clip(1.05 - 0.45 * cover + 0.35 * towards, 0.3, 1.6)
    colour = np.array([0.95, 0.96, 1.0]) * (1.05 - 0.25 * cloudiness)
    result = base * (1 - cover[:, :, None]) + (bright * cover)[:, :, None] * colour
    if night:
        result = result * 0.010 + np.array([0.004, 0.004, 0.006])
    sky: NDArray[np.float32] = result.astype(np.float32)
    return sky
