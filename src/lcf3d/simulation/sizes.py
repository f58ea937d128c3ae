"""Sizes and frequencies of road users, as measured on the real datasets.

KITTI: mean and standard deviation of (length, width, height) over the 3,712 label files of the training split, measured
with ``lcf3d.simulation.comparison.label_statistics``. nuScenes: class means of the published CenterPoint / CBGS anchor
configuration (Zhu et al. 2019, table of anchor sizes), with KITTI's relative spread.
"""

from __future__ import annotations

from typing import Final

import numpy as np

from lcf3d.errors import ConfigError

KITTI_SIZES: Final[dict[str, tuple[tuple[float, float, float], tuple[float, float, float]]]] = {
    "Car": ((3.892, 1.619, 1.530), (0.440, 0.106, 0.138)),
    "Van": ((5.147, 1.913, 2.187), (0.850, 0.177, 0.318)),
    "Truck": ((9.205, 2.609, 3.362), (2.227, 0.232, 0.358)),
    "Pedestrian": ((0.818, 0.628, 1.768), (0.245, 0.122, 0.130)),
    "Person_sitting": ((1.064, 0.544, 1.279), (0.273, 0.071, 0.080)),
    "Cyclist": ((1.771, 0.570, 1.723), (0.153, 0.143, 0.104)),
    "Tram": ((15.558, 2.360, 3.529), (4.506, 0.123, 0.129)),
    "Misc": ((2.501, 1.242, 1.617), (1.285, 0.563, 0.487)),
}
"""KITTI class -> mean and deviation of (length, width, height) in metres."""

NUSCENES_SIZES: Final[dict[str, tuple[tuple[float, float, float], tuple[float, float, float]]]] = {
    "car": ((4.63, 1.97, 1.74), (0.45, 0.13, 0.16)),
    "truck": ((6.93, 2.51, 2.84), (1.40, 0.22, 0.40)),
    "bus": ((10.5, 2.94, 3.47), (1.30, 0.15, 0.25)),
    "trailer": ((12.29, 2.90, 3.87), (1.80, 0.20, 0.30)),
    "construction_vehicle": ((6.37, 2.85, 3.19), (0.80, 0.25, 0.30)),
    "pedestrian": ((0.73, 0.67, 1.77), (0.17, 0.11, 0.13)),
    "motorcycle": ((2.11, 0.77, 1.47), (0.16, 0.10, 0.13)),
    "bicycle": ((1.70, 0.60, 1.28), (0.15, 0.10, 0.13)),
    "traffic_cone": ((0.41, 0.41, 1.07), (0.05, 0.05, 0.14)),
    "barrier": ((0.50, 2.53, 0.98), (0.06, 0.25, 0.07)),
}
"""nuScenes class -> mean and deviation of (length, width, height) in metres."""


def draw_size(name: str, rng: np.random.Generator) -> tuple[float, float, float]:
    """(length, width, height) of an object of a KITTI or nuScenes class, within two deviations of the mean.

    Raises:
        ConfigError: there is no such class.
    """
    table = KITTI_SIZES if name in KITTI_SIZES else NUSCENES_SIZES
    if name not in table:
        raise ConfigError(f"no sizes for class {name!r}; known are {sorted({*KITTI_SIZES, *NUSCENES_SIZES})}")
    mean, deviation = (np.array(v) for v in table[name])
    common = rng.normal()
    drawn = 0.6 * common + 0.8 * rng.normal(size=3)
    low = np.maximum(mean * 0.55, mean - 2 * deviation)
    length, width, height = np.clip(mean + deviation * drawn, low, mean + 2 * deviation)
    return round(float(length), 2), round(float(width), 2), round(float(height), 2)
