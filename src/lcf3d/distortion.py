"""Lens distortion of a camera: its coefficients, and where its model holds.

Both models are OpenCV's, with its order of coefficients. Directions are those of camera coordinates (x right, y down,
z forward); an image position is ``K (x', y', 1)`` with the camera matrix ``K`` and the distorted ``(x', y')``:

- ``brown_conrady`` (``cv2.projectPoints``): ``k1 k2 p1 p2 [k3 [k4 k5 k6]]``. With ``(a, b) = (x, y) / z`` and
  ``r^2 = a^2 + b^2``: ``x' = a g + 2 p1 a b + p2 (r^2 + 2 a^2)``, ``y' = b g + p1 (r^2 + 2 b^2) + 2 p2 a b``,
  ``g = (1 + k1 r^2 + k2 r^4 + k3 r^6) / (1 + k4 r^2 + k5 r^4 + k6 r^6)``.
- ``fisheye`` (Kannala-Brandt, ``cv2.fisheye``): ``k1 k2 k3 k4``. A direction at the angle ``t`` from the optical axis
  is at the distance ``t (1 + k1 t^2 + k2 t^4 + k3 t^6 + k4 t^8)`` from the principal point, t up to 95 degrees.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Literal, get_args

import numpy as np
from numpy.typing import NDArray

from lcf3d.errors import ConfigError

LensModel = Literal["brown_conrady", "fisheye"]

COUNTS: dict[str, tuple[int, ...]] = {"brown_conrady": (4, 5, 8), "fisheye": (4,)}
ORDER = {"brown_conrady": "k1 k2 p1 p2 [k3 [k4 k5 k6]]", "fisheye": "k1 k2 k3 k4"}

# half of the widest field of view that each model is used for: 190 degrees, and what a plane image can still show
WIDEST = {"brown_conrady": np.deg2rad(88.0), "fisheye": np.deg2rad(95.0)}
# a field ends where the image is left behind by this factor, if the model holds that far
BEYOND_IMAGE = 1.5
# how far a model must hold, as a share of the way to the border: resized images have rounded sizes
ROUNDING = 0.98
_STEPS = 2048


@dataclass(frozen=True)
class Distortion:
    """How a lens bends what a pinhole would see.

    Attributes:
        model: see the module.
        coefficients: in OpenCV's order.

    Raises:
        ConfigError: an unknown model, or coefficients of a wrong number or not finite.

    Example:
        >>> Distortion("fisheye", (0.02, -0.004, 0.0, 0.0)).coefficients
        (0.02, -0.004, 0.0, 0.0)
    """

    model: LensModel
    coefficients: tuple[float, ...]

    def __post_init__(self) -> None:
        if self.model not in get_args(LensModel):
            raise ConfigError(
                f"a distortion's model must be one of {', '.join(get_args(LensModel))}, got {self.model!r}; "
                "leave the distortion out for a pinhole camera"
            )
        values = np.asarray(self.coefficients, dtype=np.float64).ravel()
        if len(values) not in COUNTS[self.model]:
            counts = " or ".join(str(n) for n in COUNTS[self.model])
            raise ConfigError(
                f"a {self.model} distortion needs {counts} coefficients ({ORDER[self.model]}), got {len(values)}"
            )
        if not np.isfinite(values).all():
            raise ConfigError(f"the coefficients of a {self.model} distortion must be finite, got {values.tolist()}")
        object.__setattr__(self, "coefficients", tuple(float(v) for v in values))

    @property
    def is_pinhole(self) -> bool:
        """Whether it bends nothing: a Brown-Conrady lens of zeros."""
        return self.model == "brown_conrady" and not any(self.coefficients)

    @property
    def padded(self) -> NDArray[np.float64]:
        """(8,) coefficients, zeros where there are fewer."""
        values = np.zeros(8)
        values[: len(self.coefficients)] = self.coefficients
        return values

    def radii(self, angles: NDArray[np.float64]) -> NDArray[np.float64]:
        """Distances from the principal point, in focal lengths, of directions at angles (radians) from the axis.

        The tangential coefficients, which shift the image a little, are left out. NaN beyond a pole.
        """
        k = self.padded
        if self.model == "fisheye":
            t = angles * angles
            return np.asarray(angles * (1 + t * (k[0] + t * (k[1] + t * (k[2] + t * k[3])))))
        r = np.tan(angles)
        s = r * r
        below = 1 + s * (k[5] + s * (k[6] + s * k[7]))
        poles = np.flatnonzero(below <= 0)
        radii = r * (1 + s * (k[0] + s * (k[1] + s * k[4]))) / np.where(below > 0, below, np.nan)
        if len(poles):
            radii[poles[0] :] = np.nan
        return np.asarray(radii)


@dataclass(frozen=True)
class Field:
    """Where a lens sees: the cone of directions around its optical axis for which the model is used.

    Attributes:
        half_angle: of the cone, radians.
        angles: (S,) rising from 0 to ``half_angle``.
        radii: (S,) `Distortion.radii` of them, rising.
    """

    half_angle: float
    angles: NDArray[np.float64]
    radii: NDArray[np.float64]


def field_of(
    distortion: Distortion, intrinsics: NDArray[np.float64], width: int, height: int, camera: str = "a camera"
) -> Field:
    """The field of a lens behind an image.

    Args:
        distortion: the lens.
        intrinsics: (3, 3) camera matrix, upper triangular with a last row 0 0 1.
        width: of the image in pixels.
        height: of the image in pixels.
        camera: its name, for the message.

    Raises:
        ConfigError: the model folds back (farther directions nearer to the middle) inside the image; of a fisheye lens
            inside the largest circle in the image, since its corners are often black.
    """
    borders = np.array([[0, 0], [width, 0], [0, height], [width, height]], dtype=np.float64)
    y = (borders[:, 1] - intrinsics[1, 2]) / intrinsics[1, 1]
    x = (borders[:, 0] - intrinsics[0, 2] - intrinsics[0, 1] * y) / intrinsics[0, 0]
    corner = float(np.hypot(x, y).max())
    side = max(float(min(np.abs(x).min(), np.abs(y).min())), 0.0)
    return _field(distortion, corner, side if distortion.model == "fisheye" else corner, camera)


@lru_cache(maxsize=256)
def _field(distortion: Distortion, corner: float, needed: float, camera: str) -> Field:
    angles = np.linspace(0.0, WIDEST[distortion.model], _STEPS)
    radii = distortion.radii(angles)
    # NaN, beyond a pole, does not rise either
    falls = np.flatnonzero(~(np.diff(radii) > 0))
    end = int(falls[0]) if len(falls) else _STEPS - 1
    if len(falls) and radii[end] < ROUNDING * needed:
        raise ConfigError(
            f"camera {camera!r}: its {distortion.model} distortion folds back inside the image, "
            f"{np.rad2deg(angles[end]):.1f} degrees from the optical axis, where only {radii[end]:.2f} of the "
            f"{needed:.2f} focal lengths to the image's border are reached; check the coefficients, their order "
            f"({ORDER[distortion.model]}) and the image size"
        )
    past = np.flatnonzero(radii[: end + 1] > BEYOND_IMAGE * corner)
    if len(past):
        end = int(past[0])
    elif len(falls):
        end = max(end - 1, 1)  # at the fold itself the inverse is not defined
    return Field(float(angles[end]), angles[: end + 1], radii[: end + 1])


def checked_lens(
    distortion: Distortion | None, intrinsics: NDArray[np.float64], width: int, height: int, camera: str
) -> Distortion | None:
    """The distortion if it fits a camera (see `field_of`), None if it bends nothing.

    Raises:
        ConfigError: no `Distortion`, a camera matrix that holds more than intrinsics, or a model that folds back.
    """
    if distortion is None:
        return None
    if not isinstance(distortion, Distortion):
        raise ConfigError(
            f"camera {camera!r}: distortion must be a Distortion(model, coefficients), got "
            f"{type(distortion).__name__}; the model says whether coefficients are brown_conrady or fisheye"
        )
    if distortion.is_pinhole:
        return None
    k = intrinsics
    if k[1, 0] or k[2, 0] or k[2, 1] or k[2, 2] != 1 or k[0, 0] <= 0 or k[1, 1] <= 0:
        raise ConfigError(
            f"camera {camera!r}: with a distortion, the left part of projection must be a camera matrix "
            "[[fx, s, cx], [0, fy, cy], [0, 0, 1]] with positive focal lengths; give the pose in camera_from_lidar"
        )
    field_of(distortion, k, width, height, camera)
    return distortion
