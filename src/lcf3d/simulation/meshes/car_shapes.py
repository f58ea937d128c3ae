"""Side profiles and proportions of cars and vans."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final


@dataclass(frozen=True)
class CarShape:
    """The side view of a car, from the front bumper (0) to the rear (1).

    Attributes:
        size: (length, width, height) in metres at which the template is built.
        profile: (position, height) pairs of the outline on the centre line, as shares of length and height.
        screen: positions of the lower and upper edge of the windscreen.
        rear: positions of the upper and lower edge of the rear window.
        side_glass: positions where the side windows begin and end.
        belt: height of the lower edge of the side windows, front and rear.
        axles: positions of front and rear axle.
        wheel_radius: metres.
    """

    size: tuple[float, float, float]
    profile: tuple[tuple[float, float], ...]
    screen: tuple[float, float]
    rear: tuple[float, float]
    side_glass: tuple[float, float]
    belt: tuple[float, float] = (0.61, 0.65)
    axles: tuple[float, float] = (0.19, 0.81)
    wheel_radius: float = 0.31


_FRONT: Final = ((0.0, 0.36), (0.006, 0.45), (0.02, 0.52), (0.05, 0.565))
SHAPES: Final[dict[str, CarShape]] = {
    "hatchback": CarShape(
        (3.9, 1.66, 1.47),
        (
            *_FRONT,
            (0.14, 0.61),
            (0.25, 0.67),
            (0.41, 0.94),
            (0.50, 1.0),
            (0.72, 0.985),
            (0.88, 0.93),
            (0.965, 0.68),
            (0.985, 0.58),
            (1.0, 0.40),
        ),
        (0.25, 0.41),
        (0.885, 0.965),
        (0.36, 0.86),
    ),
    "small": CarShape(
        (3.5, 1.6, 1.5),
        (
            *_FRONT,
            (0.11, 0.62),
            (0.19, 0.69),
            (0.36, 0.95),
            (0.46, 1.0),
            (0.75, 0.99),
            (0.91, 0.94),
            (0.975, 0.66),
            (0.99, 0.56),
            (1.0, 0.42),
        ),
        (0.19, 0.36),
        (0.915, 0.97),
        (0.31, 0.88),
        axles=(0.17, 0.83),
        wheel_radius=0.28,
    ),
    "saloon": CarShape(
        (4.5, 1.75, 1.42),
        (
            *_FRONT,
            (0.15, 0.62),
            (0.275, 0.67),
            (0.42, 0.95),
            (0.50, 1.0),
            (0.62, 0.99),
            (0.69, 0.95),
            (0.83, 0.715),
            (0.965, 0.675),
            (0.988, 0.60),
            (1.0, 0.40),
        ),
        (0.275, 0.42),
        (0.69, 0.825),
        (0.38, 0.76),
    ),
    "estate": CarShape(
        (4.5, 1.74, 1.46),
        (
            *_FRONT,
            (0.15, 0.61),
            (0.265, 0.665),
            (0.41, 0.95),
            (0.50, 1.0),
            (0.80, 0.985),
            (0.915, 0.94),
            (0.975, 0.67),
            (0.988, 0.58),
            (1.0, 0.40),
        ),
        (0.265, 0.41),
        (0.92, 0.972),
        (0.37, 0.90),
    ),
    "suv": CarShape(
        (4.4, 1.82, 1.68),
        (
            (0.0, 0.36),
            (0.006, 0.47),
            (0.02, 0.57),
            (0.05, 0.60),
            (0.15, 0.635),
            (0.255, 0.68),
            (0.39, 0.95),
            (0.48, 1.0),
            (0.80, 0.985),
            (0.91, 0.94),
            (0.97, 0.68),
            (0.988, 0.60),
            (1.0, 0.40),
        ),
        (0.255, 0.39),
        (0.915, 0.967),
        (0.35, 0.89),
        (0.63, 0.66),
        wheel_radius=0.36,
    ),
    "minivan": CarShape(
        (4.3, 1.78, 1.66),
        (
            (0.0, 0.34),
            (0.006, 0.42),
            (0.02, 0.50),
            (0.06, 0.56),
            (0.16, 0.64),
            (0.21, 0.67),
            (0.38, 0.95),
            (0.48, 1.0),
            (0.82, 0.99),
            (0.925, 0.95),
            (0.978, 0.62),
            (0.99, 0.55),
            (1.0, 0.38),
        ),
        (0.20, 0.38),
        (0.93, 0.976),
        (0.30, 0.91),
        (0.58, 0.62),
    ),
    "van": CarShape(
        (5.0, 1.92, 2.15),
        (
            (0.0, 0.27),
            (0.006, 0.36),
            (0.02, 0.42),
            (0.06, 0.46),
            (0.14, 0.52),
            (0.17, 0.55),
            (0.285, 0.90),
            (0.34, 0.99),
            (0.45, 1.0),
            (0.93, 1.0),
            (0.985, 0.985),
            (0.996, 0.7),
            (1.0, 0.30),
        ),
        (0.165, 0.285),
        (0.986, 0.996),
        (0.22, 0.38),
        (0.52, 0.53),
        axles=(0.17, 0.79),
        wheel_radius=0.34,
    ),
    "bus_van": CarShape(
        (5.2, 1.95, 2.05),
        (
            (0.0, 0.28),
            (0.006, 0.37),
            (0.02, 0.43),
            (0.06, 0.47),
            (0.14, 0.53),
            (0.17, 0.56),
            (0.285, 0.91),
            (0.34, 0.99),
            (0.45, 1.0),
            (0.93, 1.0),
            (0.975, 0.975),
            (0.992, 0.62),
            (1.0, 0.30),
        ),
        (0.165, 0.285),
        (0.975, 0.992),
        (0.22, 0.95),
        (0.54, 0.55),
        axles=(0.17, 0.79),
        wheel_radius=0.34,
    ),
}
