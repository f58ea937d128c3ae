"""What a frustum network needs to know beside its weights, and how boxes are written as its outputs.

The two forms of the Frustum PointNet share this: 3 values of the centre, size scores and residuals of every
class template, scores and residuals of 12 headings (Qi et al. 2018, section 4.3).
"""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from lcf3d.errors import ConfigError
from lcf3d.files import shortened
from lcf3d.geometry.boxes import wrap_angle
from lcf3d.structures import FloatArray, IntArray

HEADINGS = 12
HEADING_UNIT_RAD = np.pi / HEADINGS
"""Residuals of the heading are counted in half bins."""
HEADINGS_V1_RAD = tuple((-3.14 + 2 * HEADING_UNIT_RAD * np.arange(HEADINGS)).tolist())
HEADINGS_V2_RAD = (-3.14, -2.617, -2.094, -1.57, -1.046, -0.523, 0.0, 0.523, 1.046, 1.57, 2.094, 2.617)
"""The LCF3D authors' bins, as the golden data shows them: three of the values to 1e-5, the others by symmetry."""

KITTI_TEMPLATES = {"Pedestrian": (0.8, 0.6, 1.73), "Cyclist": (1.76, 0.6, 1.73), "Car": (3.9, 1.6, 1.56)}
"""Length, width, height in metres, in the class order of the LCF3D authors' KITTI network."""
NUSCENES_TEMPLATES = {
    "car": (4.60718145, 1.95017717, 1.72270761),
    "truck": (6.73778078, 2.4560939, 2.73004906),
    "trailer": (12.01320693, 2.87427237, 3.81509561),
    "bus": (11.1885991, 2.94046906, 3.47030982),
    "construction_vehicle": (6.38352896, 2.73050468, 3.13312415),
    "bicycle": (1.68452161, 0.60058911, 1.27192197),
    "motorcycle": (2.09973778, 0.76279481, 1.44403034),
    "pedestrian": (0.7256437, 0.66344886, 1.75748069),
    "traffic_cone": (0.40359262, 0.39694519, 1.06232151),
    "barrier": (0.48578221, 2.49008838, 0.98297065),
}
"""Likewise for the authors' nuScenes network."""
TEMPLATES = {"kitti": KITTI_TEMPLATES, "nuscenes": NUSCENES_TEMPLATES}
POINTS = {"v1": 256, "v2": 128}


@dataclass(frozen=True)
class LocalizerSpec:
    """A frustum network's configuration; it travels in the metadata of ONNX files.

    Attributes:
        form: ``v1``, our PointNet; ``v2``, the PointNet++ of the LCF3D authors.
        class_names: classes of the one-hot vector and of the size templates, in order.
        templates: (length, width, height) in metres of each class.
        points: points a frustum is brought to.
        intensity_scale: intensities are divided by it: 1 for KITTI, 255 for nuScenes.
        version: of the meaning of inputs and outputs.
    """

    form: Literal["v1", "v2"]
    class_names: tuple[str, ...]
    templates: tuple[tuple[float, float, float], ...]
    points: int
    intensity_scale: float = 1.0
    version: int = 1

    @classmethod
    def of(cls, form: Literal["v1", "v2"], dataset: str) -> LocalizerSpec:
        """The form's specification for the classes of ``kitti`` or ``nuscenes``.

        Raises:
            ConfigError: another dataset.
        """
        if dataset not in TEMPLATES:
            raise ConfigError(f"frustum networks have class templates for {' and '.join(TEMPLATES)}, not {dataset!r}")
        templates = TEMPLATES[dataset]
        # the authors' networks take intensities as they are
        scale = 255.0 if dataset == "nuscenes" and form == "v1" else 1.0
        return cls(form, tuple(templates), tuple(templates.values()), POINTS[form], scale)

    def to_json(self) -> str:
        """As text for a file's metadata."""
        return json.dumps(asdict(self))

    @classmethod
    def from_json(cls, text: str) -> LocalizerSpec:
        """What `to_json` wrote.

        Raises:
            ConfigError: it is something else.
        """
        try:
            values = json.loads(text)
            templates = tuple(tuple(float(v) for v in row) for row in values.pop("templates"))
            spec = cls(class_names=tuple(values.pop("class_names")), templates=templates, **values)  # type: ignore[arg-type]
        except (ValueError, TypeError, KeyError, AttributeError, OverflowError, RecursionError) as error:
            raise ConfigError(f"not the configuration of a frustum network: {shortened(error)}") from None
        if spec.version != 1:
            raise ConfigError(f"a frustum network of version {spec.version}; this lcf3d reads version 1: update lcf3d")
        return spec

    @property
    def template_array(self) -> FloatArray:
        """(NS, 3) templates."""
        return np.array(self.templates, dtype=np.float64)

    @property
    def headings(self) -> FloatArray:
        """(12,) heading of each bin in radians."""
        return np.array(HEADINGS_V2_RAD if self.form == "v2" else HEADINGS_V1_RAD)

    @property
    def outputs(self) -> int:
        """Values of the box head: 3 centre, 3 NS size residuals, NS size scores, 12 heading residuals, 12 scores."""
        return 3 + 4 * len(self.class_names) + 2 * HEADINGS


def split_outputs(values: NDArray[np.floating], classes: int) -> tuple[NDArray[np.floating], ...]:
    """Parts of (K, outputs): centre (K, 3), size residuals (K, NS, 3) and scores (K, NS), heading residuals and scores.

    Works on torch tensors too.
    """
    ends = np.cumsum([3, 3 * classes, classes, HEADINGS, HEADINGS]).tolist()
    parts = [values[:, a:b] for a, b in zip([0, *ends[:-1]], ends, strict=True)]
    parts[1] = parts[1].reshape(-1, classes, 3)
    return tuple(parts)


def decode_boxes(centres: FloatArray, outputs: NDArray[np.floating], spec: LocalizerSpec) -> FloatArray:
    """(K, 7) boxes in the frustum frames.

    Args:
        centres: (K, 3) final centres (mask mean, T-Net and residual summed).
        outputs: (K, spec.outputs) of the box head.
        spec: the network's configuration.
    """
    _, size_residual, size_score, heading_residual, heading_score = split_outputs(outputs, len(spec.class_names))
    rows = np.arange(len(centres))
    size, heading = size_score.argmax(axis=1), heading_score.argmax(axis=1)
    boxes = np.empty((len(centres), 7))
    boxes[:, :3] = centres
    boxes[:, 3:6] = spec.template_array[size] * (1 + size_residual[rows, size])
    if spec.form == "v2":
        # the authors' networks give the centre of the bottom face
        boxes[:, 2] += boxes[:, 5] / 2
    boxes[:, 6] = wrap_angle(
        spec.headings[heading] + heading_residual[rows, heading].astype(np.float64) * HEADING_UNIT_RAD
    )
    return boxes


def encode_headings(yaws: FloatArray, spec: LocalizerSpec) -> tuple[IntArray, FloatArray]:
    """(K,) nearest heading bins, and residuals in half bins, of (K,) yaws; the inverse of `decode_boxes`."""
    difference = wrap_angle(yaws[:, None] - spec.headings[None])
    bins = np.abs(difference).argmin(axis=1)
    return bins, difference[np.arange(len(yaws)), bins] / HEADING_UNIT_RAD
