"""The KITTI object benchmark: 2D, orientation (AOS), bird's-eye-view and 3D average precision, as the official program.

``evaluate_folder(root, results)`` does everything from files; `KittiEvaluator` keeps the overlaps for more questions:
other IoU thresholds, distance ranges, resampled frames, the fate of every detection.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any, Literal

import numpy as np

from lcf3d.errors import ConfigError, DatasetError, FormatError
from lcf3d.evaluation.curves import SAMPLES, PrecisionCurve, Sampling, ScoreEvents, precision_curve
from lcf3d.evaluation.kitti_matching import COUNTS, IGNORED, OTHER, match_at, overlaps, score_events
from lcf3d.files import list_files
from lcf3d.formats.kitti import KittiFrames, read_folder, read_frame_ids
from lcf3d.structures import FloatArray, IntArray

DIFFICULTIES = ("easy", "moderate", "hard")
MEASURES = ("bbox", "aos", "bev", "3d")
MEASURE_NAMES = {"bbox": "2D", "aos": "AOS", "bev": "BEV", "3d": "3D"}

# every class that KITTI annotates; results may hold them, though only three are evaluated
KNOWN_CLASSES = (
    "Car",
    "Van",
    "Truck",
    "Pedestrian",
    "Person_sitting",
    "Person",
    "Cyclist",
    "Tram",
    "Misc",
    "DontCare",
)


@dataclass(frozen=True)
class KittiEvaluationConfig:
    """The official numbers of the benchmark.

    Attributes:
        classes: classes to evaluate.
        neighbours: classes so alike that finding them as the evaluated class is no error, by evaluated class.
        min_overlap: a detection matches an object when their overlap is greater, by class and measure.
        min_height_px: objects and detections less high in the image do not count, by difficulty.
        max_occlusion: objects of a higher occlusion level do not count, by difficulty.
        max_truncation: objects of which a greater share is outside the image do not count, by difficulty.
    """

    classes: tuple[str, ...] = ("Car", "Pedestrian", "Cyclist")
    neighbours: Mapping[str, str] = field(default_factory=lambda: {"Car": "Van", "Pedestrian": "Person_sitting"})
    min_overlap: Mapping[str, Mapping[str, float]] = field(
        default_factory=lambda: {
            name: dict.fromkeys(("bbox", "bev", "3d"), value)
            for name, value in (("Car", 0.7), ("Pedestrian", 0.5), ("Cyclist", 0.5))
        }
    )
    min_height_px: tuple[float, float, float] = (40, 25, 25)
    max_occlusion: tuple[int, int, int] = (0, 1, 2)
    max_truncation: tuple[float, float, float] = (0.15, 0.3, 0.5)

    def __post_init__(self) -> None:
        for name in self.classes:
            if name not in self.min_overlap:
                raise ConfigError(
                    f"the KITTI metric does not know class {name!r}; it evaluates {', '.join(self.min_overlap)}"
                )
            for measure, value in self.min_overlap[name].items():
                if not 0 <= value < 1:
                    raise ConfigError(f"the {measure} IoU threshold of {name} must be in [0, 1), got {value:g}")

    def with_min_overlap(self, class_name: str, value: float, measure: str | None = None) -> KittiEvaluationConfig:
        """The same with another IoU threshold for a class, in one measure or (None) in all of them.

        Raises:
            ConfigError: the class or measure is not one of the benchmark, or the value not in [0, 1).
        """
        if class_name not in self.min_overlap:
            raise ConfigError(
                f"the KITTI metric does not know class {class_name!r}; it evaluates {', '.join(self.min_overlap)}"
            )
        own = self.min_overlap[class_name]
        if measure is not None and measure not in own:
            raise ConfigError(f"no IoU threshold for measure {measure!r}; expected one of {', '.join(own)}")
        changed = {name: value if measure in (None, name) else old for name, old in own.items()}
        return replace(self, min_overlap={**self.min_overlap, class_name: changed})


@dataclass(frozen=True)
class KittiMetrics:
    """The precision curves of one result set.

    Attributes:
        curves: by (class, measure, difficulty); classes and measures that the results do not cover are absent, as in
            the official program: no detection of the class, no 3D boxes, an unknown alpha (-10) for AOS. AOS is absent
            too where all detections have one and the same alpha and the objects have not.
        frame_count: number of frames evaluated.
        config: the numbers used.
    """

    curves: Mapping[tuple[str, str, str], PrecisionCurve]
    frame_count: int
    config: KittiEvaluationConfig

    @property
    def class_names(self) -> tuple[str, ...]:
        """The classes that the results cover."""
        return tuple(dict.fromkeys(name for name, _, _ in self.curves))

    def measures(self, class_name: str) -> tuple[str, ...]:
        """The measures that the results cover for a class."""
        return tuple(measure for measure in MEASURES if (class_name, measure, DIFFICULTIES[0]) in self.curves)

    def ap(
        self, class_name: str, measure: str = "3d", difficulty: str = "moderate", sampling: Sampling = "R40"
    ) -> float:
        """Average precision in percent; NaN where the results do not cover the class or measure."""
        curve = self.curves.get((class_name, measure, difficulty))
        return float("nan") if curve is None else curve.average_precision(sampling)

    def to_json(self) -> dict[str, Any]:
        """class -> measure -> difficulty -> AP_R11, AP_R40, precision_41 (for aos: similarity), objects."""
        tree: dict[str, Any] = {}
        for (class_name, measure, difficulty), curve in self.curves.items():
            tree.setdefault(class_name, {}).setdefault(measure, {})[difficulty] = {
                "AP_R11": curve.average_precision("R11"),
                "AP_R40": curve.average_precision("R40"),
                "precision_41": curve.precision.tolist(),
                "objects": curve.object_count,
            }
        return tree


@dataclass(frozen=True)
class Selection:
    """What one number is about: a class, a measure, a difficulty, and optionally a range of distances.

    Attributes:
        class_name: evaluated class.
        measure: ``bbox``, ``bev`` or ``3d`` (``aos`` is the similarity of ``bbox``).
        difficulty: ``easy``, ``moderate`` or ``hard``.
        distance_range: metres on the ground from the camera, ``near <= distance < far``; objects and detections
            outside are ignored.
    """

    class_name: str
    measure: Literal["bbox", "bev", "3d"]
    difficulty: str
    distance_range: tuple[float, float] | None = None


class KittiEvaluator:
    """Ground truth and results side by side, their overlaps computed once.

    Args:
        truth: labels of F frames.
        results: detections, with scores, of the same frames in the same order.
        config: the numbers of the benchmark.

    Raises:
        DatasetError: the two are not of the same frames.
        FormatError: the results have no scores, a NaN score, or a class unknown to the benchmark.
    """

    def __init__(
        self, truth: KittiFrames, results: KittiFrames, config: KittiEvaluationConfig = KittiEvaluationConfig()
    ) -> None:
        _check_frames(truth, results)
        self.truth, self.results, self.config = truth, results, config
        self._truth_classes = np.char.lower(truth.objects.class_names)
        self._result_classes = np.char.lower(results.objects.class_names)
        self._height = _heights(truth)
        self._result_height = _heights(results)
        known = {name.lower() for name in (*KNOWN_CLASSES, *config.min_overlap)}
        names, first, counts = np.unique(self._result_classes, return_index=True, return_counts=True)
        for name, row, count in zip(names, first, counts, strict=True):
            if name not in known:
                raise FormatError(
                    f"results hold {count} objects of class {str(results.objects.class_names[row])!r} (first in frame "
                    f"{results.frame_ids[results.frame_of_object[row]]}), which the KITTI metric does not know; "
                    f"rename or remove them, it knows {', '.join(KNOWN_CLASSES)}"
                )

    @cached_property
    def overlap(self) -> dict[str, FloatArray]:
        """Overlap of every object with every detection of its frame, flat, by measure."""
        return overlaps(self.truth, self.results)

    @cached_property
    def covered(self) -> dict[str, tuple[str, ...]]:
        """The measures that can be evaluated, by class, after the official program's rules."""
        objects = self.results.objects
        oriented = bool((objects.alpha != -10).all()) and not self._same_alpha_everywhere()
        located = (objects.locations[:, ::2] != -1000).all(axis=1) & (objects.dimensions[:, 1:] > 0).all(axis=1)
        upright = located & (objects.locations[:, 1] != -1000) & (objects.dimensions[:, 0] > 0)
        covered = {}
        for name in self.config.classes:
            own = self._result_classes == name.lower()
            has = {
                "bbox": (objects.boxes2d[own, 0] >= 0).any(),
                "bev": located[own].any(),
                "3d": upright[own].any(),
            }
            has["aos"] = has["bbox"] and oriented
            covered[name] = tuple(measure for measure in MEASURES if has[measure])
        return covered

    def _same_alpha_everywhere(self) -> bool:
        """Whether the detector writes one alpha for all it finds, while the objects have many: it estimates none."""
        found, real = self.results.objects.alpha, self.truth.objects.alpha
        return len(found) >= SAMPLES and len(np.unique(found)) == 1 and len(np.unique(real[real != -10])) > 1

    def codes(self, selection: Selection) -> tuple[IntArray, IntArray]:
        """What each object (N,) and each detection (M,) is to the selection: `COUNTS`, `IGNORED` or `OTHER`."""
        level = DIFFICULTIES.index(selection.difficulty)
        objects, config = self.truth.objects, self.config
        own = self._truth_classes == selection.class_name.lower()
        alike = self._truth_classes == config.neighbours.get(selection.class_name, "").lower()
        too_hard = objects.occluded > config.max_occlusion[level]
        too_hard |= objects.truncated > config.max_truncation[level]
        too_hard |= self._height < config.min_height_px[level]
        object_codes = np.where(own & ~too_hard, COUNTS, np.where(own | alike, IGNORED, OTHER))
        detection_codes = np.where(self._result_classes == selection.class_name.lower(), COUNTS, OTHER)
        # as in the official program, a detection that is too small is ignored whatever its class
        detection_codes[self._result_height < config.min_height_px[level]] = IGNORED
        if selection.distance_range is not None:
            for codes, frames in ((object_codes, self.truth), (detection_codes, self.results)):
                distance = np.hypot(frames.objects.locations[:, 0], frames.objects.locations[:, 2])
                outside = (distance < selection.distance_range[0]) | (distance >= selection.distance_range[1])
                codes[outside & (codes == COUNTS)] = IGNORED
        return object_codes, detection_codes

    def events(self, selection: Selection, min_overlap: float | None = None) -> ScoreEvents:
        """Every change of the counts as the score threshold falls, at the configured or another IoU threshold."""
        return score_events(
            self.truth,
            self.results,
            self.overlap[selection.measure],
            self._min_overlap(selection) if min_overlap is None else min_overlap,
            *self.codes(selection),
        )

    def match_at(self, selection: Selection, threshold: float) -> tuple[IntArray, IntArray]:
        """The fate of every object and detection at one score threshold, see `kitti_matching.match_at`."""
        return match_at(
            self.truth,
            self.results,
            self.overlap[selection.measure],
            self._min_overlap(selection),
            *self.codes(selection),
            threshold,
        )

    def selections(self) -> Iterator[Selection]:
        """Every class, measure (without ``aos``) and difficulty that the results cover."""
        for name in self.config.classes:
            for measure in ("bbox", "bev", "3d"):
                if measure in self.covered[name]:
                    for difficulty in DIFFICULTIES:
                        yield Selection(name, measure, difficulty)

    def metrics(self) -> KittiMetrics:
        """All curves; two threads share the work."""
        selections = list(self.selections())
        _ = self.overlap  # computed once, before the threads start
        with ThreadPoolExecutor(2) as pool:
            pairs = list(pool.map(lambda selection: precision_curve(self.events(selection)), selections))
        curves: dict[tuple[str, str, str], PrecisionCurve] = {}
        for selection, (precision, similarity) in zip(selections, pairs, strict=True):
            curves[selection.class_name, selection.measure, selection.difficulty] = precision
            if selection.measure == "bbox" and "aos" in self.covered[selection.class_name]:
                curves[selection.class_name, "aos", selection.difficulty] = similarity
        return KittiMetrics(curves, len(self.truth), self.config)

    def _min_overlap(self, selection: Selection) -> float:
        return self.config.min_overlap[selection.class_name][selection.measure]


def evaluate(
    truth: KittiFrames, results: KittiFrames, config: KittiEvaluationConfig = KittiEvaluationConfig()
) -> KittiMetrics:
    """All curves of ``results`` against ``truth``, see `KittiEvaluator`."""
    return KittiEvaluator(truth, results, config).metrics()


def evaluate_folder(
    root: Path,
    results: Path,
    split: str | None = None,
    config: KittiEvaluationConfig = KittiEvaluationConfig(),
    missing: Literal["error", "empty"] = "error",
) -> KittiMetrics:
    """Read a KITTI tree and a folder of results, and evaluate them, see `read_evaluator`."""
    return read_evaluator(root, results, split, config, missing).metrics()


def read_evaluator(
    root: Path,
    results: Path,
    split: str | None = None,
    config: KittiEvaluationConfig = KittiEvaluationConfig(),
    missing: Literal["error", "empty"] = "error",
) -> KittiEvaluator:
    """Read ground truth and results from files.

    Args:
        root: the folder that holds ``training/label_2`` and, for splits, ``ImageSets/SPLIT.txt``.
        results: folder of one text file a frame, or one that holds such a folder named ``data``.
        split: name of the list of frames; None for ``val`` where there is such a list, else all labelled frames.
        config: the numbers of the benchmark.
        missing: what to do about frames without a result file: ``error`` or take them as ``empty``.

    Raises:
        DatasetError: a file or folder is absent; for frames, says how many and which first.
        FormatError: a file is malformed; names file and line.
    """
    frame_ids = split_frame_ids(root, split)
    truth = read_folder(Path(root) / "training" / "label_2", frame_ids, results=False)
    return KittiEvaluator(truth, read_folder(result_folder(results), frame_ids, results=True, missing=missing), config)


def split_frame_ids(root: Path, split: str | None = None) -> tuple[str, ...]:
    """The frames of a split; None means ``val`` where there is such a list, else all labelled frames.

    Raises:
        DatasetError: the folder is not a KITTI tree, or has no such split; names those it has.
    """
    root = Path(root)
    labels = root / "training" / "label_2"
    if not labels.is_dir():
        raise DatasetError(f"{labels} is not a folder; expected a KITTI tree with training/label_2 in {root}")
    known = [path.stem for path in list_files(root / "ImageSets", ".txt")]
    if split is None and "val" not in known:
        frame_ids = tuple(path.stem for path in list_files(labels, ".txt"))
        if not frame_ids:
            raise DatasetError(f"{labels} holds no label files")
        return frame_ids
    name = split or "val"
    if name not in known:
        raise DatasetError(
            f"{root} has no split {name!r}; the lists in its ImageSets are: {', '.join(known) or 'none'}"
        )
    return read_frame_ids(root / "ImageSets" / f"{name}.txt")


def result_folder(results: Path) -> Path:
    """The folder with the text files: ``results/data`` where there is one, as ``lcf3d run`` writes, else ``results``.

    Raises:
        DatasetError: there is no such folder.
    """
    results = Path(results)
    if not results.is_dir():
        raise DatasetError(f"{results} is not a folder; expected KITTI result files in it or in its folder data")
    return results / "data" if (results / "data").is_dir() else results


def _heights(frames: KittiFrames) -> FloatArray:
    boxes = frames.objects.boxes2d
    return boxes[:, 3] - boxes[:, 1]


def _check_frames(truth: KittiFrames, results: KittiFrames) -> None:
    if truth.frame_ids != results.frame_ids:
        odd = sorted(set(truth.frame_ids) ^ set(results.frame_ids))
        detail = f"{len(odd)} frames are in one only, first {odd[0]}" if odd else "the order differs"
        raise DatasetError(
            f"ground truth has {len(truth)} frames and results {len(results)}; "
            f"they must be the same frames in the same order, but {detail}"
        )
    scores = results.objects.scores
    if scores is None:
        raise FormatError("results have no scores; read them as results, with 16 columns a line")
    if np.isnan(scores).any():
        row = int(np.flatnonzero(np.isnan(scores))[0])
        frame = results.frame_ids[results.frame_of_object[row]]
        raise FormatError(
            f"{int(np.isnan(scores).sum())} scores are NaN, first in frame {frame}; every score must be a number"
        )
