"""The official nuScenes detection metrics: mAP over centre distances, five true-positive errors, NDS.

Works on boxes in the global frame as they stand in a submission file. The numbers agree with those of the official
devkit (configuration ``detection_cvpr_2019``) to 1e-6.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np

from lcf3d.datasets.nuscenes_annotations import bicycle_racks, ground_truth_boxes
from lcf3d.datasets.nuscenes_tables import NuscenesTables
from lcf3d.errors import DatasetError, FormatError
from lcf3d.evaluation.center_distance import ERRORS, Curve, EvaluationBoxes, class_curves
from lcf3d.formats.nuscenes_boxes import GlobalBoxes
from lcf3d.geometry.rotation import invert_rigid, rigid_transforms, rotation_matrices, yaws_from_quaternions
from lcf3d.structures import NUSCENES_CLASSES, BoolArray, FloatArray, IntArray

_DETAIL_ERRORS = ("trans_err", "vel_err", "scale_err", "orient_err", "attr_err")
_CYCLES = (NUSCENES_CLASSES.index("bicycle"), NUSCENES_CLASSES.index("motorcycle"))


@dataclass(frozen=True)
class NuscenesMetricsConfig:
    """The official numbers of ``detection_cvpr_2019``.

    Attributes:
        class_range: largest horizontal distance from the ego vehicle in metres at which a class is evaluated.
        dist_ths: matching distances in metres over which AP is averaged.
        dist_th_tp: matching distance in metres for the true-positive errors.
        min_recall: recall below which nothing counts.
        min_precision: precision below which nothing counts.
        max_boxes_per_sample: most predictions a sample may hold.
        mean_ap_weight: weight of mAP in NDS, against 1 of each true-positive score.
        undefined: true-positive errors that a class does not have.
        half_turn: classes whose front and rear look alike.
    """

    class_range: Mapping[str, float] = field(
        default_factory=lambda: {
            "car": 50,
            "truck": 50,
            "bus": 50,
            "trailer": 50,
            "construction_vehicle": 50,
            "pedestrian": 40,
            "motorcycle": 40,
            "bicycle": 40,
            "traffic_cone": 30,
            "barrier": 30,
        }
    )
    dist_ths: tuple[float, ...] = (0.5, 1.0, 2.0, 4.0)
    dist_th_tp: float = 2.0
    min_recall: float = 0.1
    min_precision: float = 0.1
    max_boxes_per_sample: int = 500
    mean_ap_weight: int = 5
    undefined: Mapping[str, tuple[str, ...]] = field(
        default_factory=lambda: {
            "traffic_cone": ("orient_err", "vel_err", "attr_err"),
            "barrier": ("vel_err", "attr_err"),
        }
    )
    half_turn: tuple[str, ...] = ("barrier",)


OFFICIAL = NuscenesMetricsConfig()


@dataclass(frozen=True, eq=False)
class FilterCounts:
    """How many boxes are left after each of the official filters.

    Attributes:
        original: all boxes.
        in_range: within the class range.
        with_points: with at least one LiDAR or radar point (predictions: all).
        outside_racks: not a bicycle or motorcycle inside a bicycle rack.
        in_view: in the front camera's view, when that restriction is asked for.
    """

    original: int
    in_range: int
    with_points: int
    outside_racks: int
    in_view: int


@dataclass(frozen=True, eq=False)
class NuscenesMetrics:
    """Results of the nuScenes detection metrics.

    Attributes:
        class_names: evaluated classes.
        config: the numbers used.
        aps: (C, T) average precision by class and matching distance.
        class_errors: (C, 5) errors (`ERRORS`) by class, NaN where a class has none.
        curves: curves by class and matching distance.
        ground_truth_counts: (C,) annotated boxes by class after the filters.
        counts: filter counts of ``predictions`` and ``ground_truth``.
        meta: what the submission says of its inputs.
    """

    class_names: tuple[str, ...]
    config: NuscenesMetricsConfig
    aps: FloatArray
    class_errors: FloatArray
    ground_truth_counts: tuple[int, ...]
    curves: list[list[Curve]] = field(repr=False)
    counts: Mapping[str, FilterCounts]
    meta: Mapping[str, Any] = field(default_factory=dict)

    @property
    def mean_ap(self) -> float:
        """mAP: mean over classes and matching distances."""
        return float(self.aps.mean(axis=1).mean())

    @property
    def errors(self) -> dict[str, float]:
        """mATE, mASE, mAOE, mAVE, mAAE by their names in `ERRORS`: means over the classes that have them."""
        return {name: float(np.nanmean(self.class_errors[:, i])) for i, name in enumerate(ERRORS)}

    @property
    def scores(self) -> dict[str, float]:
        """The errors turned into scores: 1 - error, at least 0."""
        return {name: max(0.0, 1.0 - error) for name, error in self.errors.items()}

    @property
    def nd_score(self) -> float:
        """NDS, the nuScenes detection score."""
        weight = self.config.mean_ap_weight
        return (weight * self.mean_ap + sum(self.scores.values())) / (weight + len(ERRORS))

    @property
    def nds_hat(self) -> float:
        """NDS^, without velocity and attribute (paper section 5.2, equation for NDS^)."""
        kept = sum(self.scores[name] for name in ("trans_err", "scale_err", "orient_err"))
        return (3 * self.mean_ap + kept) / 6

    def to_json(self) -> dict[str, Any]:
        """The dictionary that the devkit writes as ``metrics_summary.json``, with ``nds_hat`` and filter counts."""
        config = asdict(self.config)
        return {
            "label_aps": {
                name: {str(th): float(ap) for th, ap in zip(self.config.dist_ths, row, strict=True)}
                for name, row in zip(self.class_names, self.aps, strict=True)
            },
            "mean_dist_aps": {name: float(row.mean()) for name, row in zip(self.class_names, self.aps, strict=True)},
            "mean_ap": self.mean_ap,
            "label_tp_errors": {
                name: dict(zip(ERRORS, row.tolist(), strict=True))
                for name, row in zip(self.class_names, self.class_errors, strict=True)
            },
            "tp_errors": self.errors,
            "tp_scores": self.scores,
            "nd_score": self.nd_score,
            "nds_hat": self.nds_hat,
            "cfg": {
                "class_range": dict(self.config.class_range),
                "dist_fcn": "center_distance",
                **{
                    key: config[key]
                    for key in ("dist_ths", "dist_th_tp", "min_recall", "min_precision", "max_boxes_per_sample")
                },
                "mean_ap_weight": self.config.mean_ap_weight,
            },
            "meta": dict(self.meta),
            "filter_counts": {name: asdict(counts) for name, counts in self.counts.items()},
        }

    def details_json(self) -> dict[str, dict[str, list[float]]]:
        """The curves as the devkit writes them to ``metrics_details.json``, by ``class:distance``."""
        details = {}
        for name, row in zip(self.class_names, self.curves, strict=True):
            for threshold, curve in zip(self.config.dist_ths, row, strict=True):
                details[f"{name}:{threshold}"] = {
                    "recall": np.linspace(0, 1, 101).tolist(),
                    "precision": curve.precision.tolist(),
                    "confidence": curve.confidence.tolist(),
                    **{error: curve.errors[ERRORS.index(error)].tolist() for error in _DETAIL_ERRORS},
                }
        return details


def evaluate_nuscenes(
    tables: NuscenesTables,
    sample_rows: IntArray,
    predictions: GlobalBoxes,
    config: NuscenesMetricsConfig = OFFICIAL,
    camera: str | None = None,
    meta: Mapping[str, Any] | None = None,
) -> NuscenesMetrics:
    """Official metrics of ``predictions`` against the annotations of the given samples.

    Args:
        tables: the tables with annotations.
        sample_rows: (S,) rows of the samples to evaluate.
        predictions: boxes in the global frame for exactly these samples.
        config: the official numbers.
        camera: count only ground truth and predictions whose centre this camera sees (paper section 5.8:
            ``CAM_FRONT``); None for all around.
        meta: what to carry over into the result.

    Raises:
        DatasetError: the samples have no annotations.
        FormatError: predictions of other samples than these, or none for some of them.
    """
    truth = ground_truth_boxes(tables, sample_rows)
    if not len(tables.annotations.tokens):
        raise DatasetError(f"{tables.root / tables.version} holds no annotations, so that nothing can be evaluated")
    found = aligned(predictions, truth.sample_tokens)
    lidar = tables.samples.lidar[sample_rows]
    ego = tables.sensor_data.pose_translations[lidar]
    racks = rack_filter(tables, sample_rows)
    counts, kept = {}, {}
    for name, boxes in (("predictions", found), ("ground_truth", truth)):
        in_range = boxes_in_range(boxes, ego, config)
        with_points = in_range & (boxes.point_counts != 0)
        outside = with_points & ~racks(boxes)
        in_view = outside if camera is None else outside & _seen(tables, sample_rows, boxes, camera)
        counts[name] = FilterCounts(len(boxes), *(int(m.sum()) for m in (in_range, with_points, outside, in_view)))
        kept[name] = boxes[in_view]
    return metrics_of_boxes(
        _evaluation_boxes(kept["ground_truth"]),
        _evaluation_boxes(kept["predictions"]),
        NUSCENES_CLASSES,
        config,
        counts,
        meta or {},
    )


def metrics_of_boxes(
    ground_truth: EvaluationBoxes,
    predictions: EvaluationBoxes,
    class_names: tuple[str, ...],
    config: NuscenesMetricsConfig,
    counts: Mapping[str, FilterCounts],
    meta: Mapping[str, Any],
) -> NuscenesMetrics:
    """The metrics of boxes that have passed the filters."""
    half_turn = frozenset(class_names.index(name) for name in config.half_turn if name in class_names)
    curves = class_curves(ground_truth, predictions, len(class_names), config.dist_ths, half_turn)
    aps = np.array([[c.average_precision(config.min_recall, config.min_precision) for c in row] for row in curves])
    tp = config.dist_ths.index(config.dist_th_tp)
    errors = np.stack([row[tp].mean_errors(config.min_recall) for row in curves])
    for name, undefined in config.undefined.items():
        if name in class_names:
            errors[class_names.index(name), [ERRORS.index(error) for error in undefined]] = np.nan
    annotated = tuple(np.bincount(ground_truth.labels, minlength=len(class_names)).tolist())
    return NuscenesMetrics(class_names, config, aps, errors, annotated, curves, counts, meta)


def boxes_in_range(boxes: GlobalBoxes, ego: FloatArray, config: NuscenesMetricsConfig = OFFICIAL) -> BoolArray:
    """(N,) whether each box lies within its class range of the ego vehicle's (S, 3) position in its sample."""
    offset = boxes.translations[:, :2] - ego[boxes.samples, :2]
    limits = np.array([config.class_range[name] for name in NUSCENES_CLASSES], dtype=np.float64)
    inside: BoolArray = np.sqrt((offset**2).sum(axis=1)) < limits[boxes.labels]
    return inside


def aligned(predictions: GlobalBoxes, tokens: tuple[str, ...]) -> GlobalBoxes:
    """``predictions`` with sample numbers of ``tokens``, box order kept.

    Raises:
        FormatError: predictions of other samples than these, or none for some of them.
    """
    missing = set(tokens) - set(predictions.sample_tokens)
    if missing and len(missing) == len(tokens):
        raise FormatError(
            f"the results hold none of the {len(tokens)} samples of this split, the first of which is {tokens[0]}; "
            "check version and split"
        )
    if missing:
        first = next(token for token in tokens if token in missing)
        raise FormatError(
            f"the results lack {len(missing)} of {len(tokens)} samples, the first is {first}; "
            "list every sample of the split, with an empty list where nothing was detected"
        )
    # a run on a part of the samples lists the others without boxes
    filled = {predictions.sample_tokens[i] for i in np.unique(predictions.samples).tolist()}
    strange = filled.difference(tokens)
    unknown = [token for token in predictions.sample_tokens if token in strange]
    if unknown:
        raise FormatError(
            f"the results hold boxes of {len(unknown)} samples that are not in this split, the first is {unknown[0]}; "
            "check version and split"
        )
    return predictions.numbered(tokens)


def rack_filter(tables: NuscenesTables, sample_rows: IntArray) -> Any:
    """A function that tells (N,) which bicycles and motorcycles have their centre in (or on) a bicycle rack."""
    rows, samples = bicycle_racks(tables, sample_rows)
    centers, half = tables.annotations.translations[rows], tables.annotations.sizes[rows][:, [1, 0, 2]] / 2
    rotations = rotation_matrices(tables.annotations.rotations[rows])

    def in_rack(boxes: GlobalBoxes) -> BoolArray:
        result = np.zeros(len(boxes), dtype=bool)
        cycles = np.flatnonzero(np.isin(boxes.labels, _CYCLES))
        cycles = cycles[np.argsort(boxes.samples[cycles], kind="stable")]
        starts = np.searchsorted(boxes.samples[cycles], samples, side="left")
        ends = np.searchsorted(boxes.samples[cycles], samples, side="right")
        for r in np.flatnonzero(ends > starts):
            candidates = cycles[starts[r] : ends[r]]
            local = (boxes.translations[candidates] - centers[r]) @ rotations[r]
            result[candidates] |= (np.abs(local) <= half[r]).all(axis=1)
        return result

    return in_rack


def _seen(tables: NuscenesTables, sample_rows: IntArray, boxes: GlobalBoxes, camera: str) -> BoolArray:
    """(N,) whether each box's centre projects into the image that ``camera`` took of its sample."""
    rows = tables.camera_rows(sample_rows, camera)
    data = tables.sensor_data
    camera_from_global = invert_rigid(
        rigid_transforms(data.pose_rotations[rows], data.pose_translations[rows])
        @ rigid_transforms(data.sensor_rotations[rows], data.sensor_translations[rows])
    )[boxes.samples]
    points = np.einsum("nij,nj->ni", camera_from_global[:, :3, :3], boxes.translations) + camera_from_global[:, :3, 3]
    pixels = np.einsum("nij,nj->ni", data.intrinsics[rows][boxes.samples], points)
    front = points[:, 2] > 0
    position = pixels[:, :2] / np.where(front, pixels[:, 2], 1)[:, None]
    inside = (position >= 0).all(axis=1) & (position < data.sizes[rows][boxes.samples]).all(axis=1)
    seen: BoolArray = front & inside & (rows[boxes.samples] >= 0)
    return seen


def _evaluation_boxes(boxes: GlobalBoxes) -> EvaluationBoxes:
    return EvaluationBoxes(
        boxes.samples,
        boxes.labels,
        boxes.translations[:, :2],
        boxes.sizes,
        yaws_from_quaternions(boxes.rotations),
        boxes.scores,
        boxes.velocities,
        boxes.attributes,
    )
