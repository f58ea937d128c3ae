"""The official nuScenes tracking metrics: AMOTA and AMOTP over recall, CLEAR MOT and track lives at the best MOTA.

Boxes match within 2 m of horizontal centre distance; class ranges, bicycle racks and boxes without points are filtered
as for detection. Holes in a track are filled in between, in truth and output alike, and a track's score is the mean of
its boxes'. The numbers agree with those of the official devkit (configuration ``tracking_nips_2019``).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from lcf3d.datasets.nuscenes_annotations import ground_truth_boxes, ground_truth_instances
from lcf3d.datasets.nuscenes_tables import NuscenesTables
from lcf3d.errors import DatasetError
from lcf3d.evaluation.nuscenes import aligned, boxes_in_range, rack_filter
from lcf3d.evaluation.tracking import Clear, TrackedFrames, matches
from lcf3d.formats.nuscenes import TRACKING_CLASSES
from lcf3d.formats.nuscenes_boxes import GlobalBoxes
from lcf3d.structures import NUSCENES_CLASSES, FloatArray, IntArray

MATCH_M = 2.0
MIN_RECALL = 0.1
THRESHOLDS = 40
SAMPLE_S = 0.5
MOSTLY_TRACKED, MOSTLY_LOST = 0.8, 0.2
WORST_MOTP_M = 2.0
WORST_S = 20.0
WORST_FAF = 500.0
MEASURES = (
    *("amota", "amotp", "recall", "motar", "gt", "mota", "motp", "mt", "ml", "faf"),
    *("tp", "fp", "fn", "ids", "frag", "tid", "lgd"),
)
"""Official names; fractions, metres, counts, false alarms by 100 frames, seconds."""
SUMMED = ("mt", "ml", "tp", "fp", "fn", "ids", "frag")
"""Measures that are added up over the classes; of the others it is the mean."""
# closeness of a pair d metres apart is 1 - d / SCALE_M: one pair more is worth any distances, as in the devkit
_SCALE_M = 2 * MATCH_M + 1
_MATCH_CLOSENESS = 0.5


class _Boxes(NamedTuple):
    """Boxes of one scene: (N,) frame, (N,) track, (N,) class, (N, 2) centre, (N,) score."""

    frames: IntArray
    tracks: IntArray
    labels: IntArray
    centers: FloatArray
    scores: FloatArray

    def rows(self, index: Any) -> _Boxes:
        """Those selected."""
        return _Boxes(*(column[index] for column in self))


@dataclass(frozen=True, eq=False)
class NuscenesTrackingMetrics:
    """Results of the nuScenes tracking metrics.

    Attributes:
        classes: by class the `MEASURES`; NaN where there is no object of it.
        samples: number of samples evaluated.
        meta: what the submission says of its inputs.
    """

    classes: Mapping[str, Mapping[str, float]]
    samples: int
    meta: Mapping[str, Any]

    def overall(self, measure: str) -> float:
        """A measure over all classes that have objects: mean or sum."""
        values = np.array([own[measure] for own in self.classes.values()])
        values = values[~np.isnan(values)]
        if measure in SUMMED:
            return float(values.sum())
        return float(values.mean()) if len(values) else float("nan")

    def to_json(self) -> dict[str, Any]:
        """The dictionary that the devkit writes as ``metrics_summary.json``."""
        return {
            "label_metrics": {m: {name: own[m] for name, own in self.classes.items()} for m in MEASURES},
            **{measure: self.overall(measure) for measure in MEASURES},
            "samples": self.samples,
            "meta": dict(self.meta),
        }


def evaluate_nuscenes_tracking(
    tables: NuscenesTables,
    sample_rows: IntArray,
    predictions: GlobalBoxes,
    ids: NDArray[np.str_],
    classes: Sequence[str] = TRACKING_CLASSES,
    meta: Mapping[str, Any] | None = None,
) -> NuscenesTrackingMetrics:
    """Official metrics of tracked boxes against the annotated objects of the given samples.

    Args:
        tables: the tables with annotations.
        sample_rows: (S,) rows of the samples to evaluate.
        predictions: boxes in the global frame for exactly these samples.
        ids: (N,) track of each of them, unique within a scene.
        classes: of `TRACKING_CLASSES`.
        meta: what to carry over into the result.

    Raises:
        DatasetError: the samples have no annotations, or these do not tell which boxes are of one object.
        FormatError: predictions of other samples than these, or none for some of them.
    """
    truth, instances = ground_truth_boxes(tables, sample_rows), ground_truth_instances(tables, sample_rows)
    scenes = tables.samples.scenes[sample_rows]
    _require_tracks(tables, truth, instances, scenes)
    found = aligned(predictions, truth.sample_tokens)
    times = tables.samples.timestamps_us[sample_rows]
    ego = tables.sensor_data.pose_translations[tables.samples.lidar[sample_rows]]
    in_rack = rack_filter(tables, sample_rows)
    numbers = np.unique(ids, return_inverse=True)[1].reshape(-1)
    sides = []
    for boxes, tracks in ((truth, instances), (found, numbers)):
        kept = boxes_in_range(boxes, ego) & (boxes.point_counts != 0) & ~in_rack(boxes)
        kept &= np.isin(boxes.labels, [NUSCENES_CLASSES.index(name) for name in TRACKING_CLASSES])
        own = boxes[kept]
        sides.append(_Boxes(own.samples, tracks[kept], own.labels, own.translations[:, :2], own.scores))
    parts = []
    for scene in dict.fromkeys(scenes.tolist()):
        rows = np.flatnonzero(scenes == scene)
        rows = rows[np.argsort(times[rows], kind="stable")]
        objects, output = (_of_scene(side, rows, times[rows]) for side in sides)
        parts.append((objects, output, len(rows)))
    results = {}
    for name in classes:
        label = NUSCENES_CLASSES.index(name)
        results[name] = class_metrics([_frames(own, output, label, n) for own, output, n in parts])
    return NuscenesTrackingMetrics(results, len(sample_rows), meta or {})


def _require_tracks(tables: NuscenesTables, truth: GlobalBoxes, instances: IntArray, scenes: IntArray) -> None:
    """See that the annotations tell which boxes are of one object."""
    where = tables.root / tables.version
    if not len(truth):
        raise DatasetError(f"{where} holds no annotations of these samples, so that no tracks can be evaluated")
    in_order = len(np.unique(scenes)) < len(scenes)
    if in_order and len(np.unique(instances)) == len(instances):
        raise DatasetError(
            f"{where} gives each of its {len(instances)} annotations an instance of its own; tracks need annotations "
            "that share the instance of their object"
        )


def _of_scene(boxes: _Boxes, rows: IntArray, times: IntArray) -> _Boxes:
    """The boxes of the samples ``rows``, numbered in order of time, with tracks' mean scores and without holes."""
    position = np.full(int(max(boxes.frames.max(initial=-1), rows.max(initial=-1))) + 1, -1, dtype=np.int64)
    position[rows] = np.arange(len(rows))
    own = boxes.rows(np.flatnonzero(position[boxes.frames] >= 0)) if len(boxes.frames) else boxes
    frames = position[own.frames]
    scores = own.scores.copy()
    order = np.lexsort((frames, own.tracks))
    for rows_of_track in np.split(order, np.flatnonzero(np.diff(own.tracks[order])) + 1):
        if len(rows_of_track):
            scores[rows_of_track] = scores[rows_of_track].mean()
    return _filled(own._replace(frames=frames, scores=scores), times)


def _filled(boxes: _Boxes, times: IntArray) -> _Boxes:
    """The boxes, and those between two of a track that are not next to each other in time, on the line between them.

    As in the devkit, which gives the later box the share of the time that is still left to it, and rounds scores alike.
    """
    order = np.lexsort((boxes.frames, boxes.tracks))
    extra = []
    for left, right in zip(order[:-1].tolist(), order[1:].tolist(), strict=True):
        first, last = int(boxes.frames[left]), int(boxes.frames[right])
        if boxes.tracks[left] != boxes.tracks[right] or last - first < 2:
            continue
        between = np.arange(first + 1, last)
        share = (times[last] - times[between]) / (times[last] - times[first])
        centers = (1 - share)[:, None] * boxes.centers[left] + share[:, None] * boxes.centers[right]
        later = boxes.rows(np.full(len(between), right))
        scores = (1 - share) * boxes.scores[left] + share * boxes.scores[right]
        extra.append(later._replace(frames=between, centers=centers, scores=scores))
    if not extra:
        return boxes
    return _Boxes(*(np.concatenate(columns) for columns in zip(boxes, *extra, strict=True)))


def _frames(truth: _Boxes, found: _Boxes, label: int, n: int) -> TrackedFrames:
    """One class of one scene of ``n`` frames; overlaps are closeness, see `_SCALE_M`."""
    columns: tuple[list[Any], ...] = ([], [], [], [])
    for frame in range(n):
        own = np.flatnonzero((truth.frames == frame) & (truth.labels == label))
        output = np.flatnonzero((found.frames == frame) & (found.labels == label))
        offset = truth.centers[own][:, None] - found.centers[output][None]
        distance = np.sqrt((offset**2).sum(axis=2))
        closeness = np.where(distance < MATCH_M, 1 - distance / _SCALE_M, 0.0)
        for column, values in zip(
            columns, (truth.tracks[own], found.tracks[output], found.scores[output], closeness), strict=True
        ):
            column.append(values)
    return TrackedFrames(*columns)


def class_metrics(scenes: Sequence[TrackedFrames]) -> dict[str, float]:
    """The `MEASURES` of one class; NaN without objects, the worst values where nothing is found."""
    objects = sum(len(own) for scene in scenes for own in scene.truth)
    if not objects:
        return dict.fromkeys(MEASURES, float("nan"))
    thresholds = _thresholds(np.sort(np.concatenate([_hit_scores(scene) for scene in scenes]))[::-1], objects)
    curve: dict[float, dict[str, float]] = {}
    for threshold in thresholds[~np.isnan(thresholds)].tolist():
        if threshold not in curve:
            curve[threshold] = _at([scene.above(threshold) for scene in scenes], objects)
    if not curve:
        tracks = sum(len(np.unique(np.concatenate(scene.truth))) for scene in scenes if len(scene.truth))
        return _nothing_found(objects, tracks)
    # of equal MOTA the one of the highest recall, whose threshold is lowest
    best = max(curve, key=lambda threshold: (curve[threshold]["mota"], -threshold))
    points = [curve.get(threshold, {}) for threshold in thresholds.tolist()]
    amota = np.mean([np.nan_to_num(point.get("motar", 0.0)) for point in points])
    motp = np.array([point.get("motp", np.nan) for point in points])
    amotp = np.where(np.isnan(motp), WORST_MOTP_M, motp).mean()
    return {"amota": float(amota), "amotp": float(amotp), **curve[best]}


def _nothing_found(objects: int, tracks: int) -> dict[str, float]:
    """The worst values, which count where no recall is reached."""
    worst = dict.fromkeys(MEASURES, 0.0)
    nan = float("nan")
    worst.update(amotp=WORST_MOTP_M, motp=WORST_MOTP_M, ml=tracks, gt=objects, fn=objects, faf=WORST_FAF)
    worst.update(fp=nan, ids=nan, frag=nan, tid=WORST_S, lgd=WORST_S)
    return worst


def _hit_scores(scene: TrackedFrames) -> FloatArray:
    """Scores of the outputs that are hits, but no switches, when nothing is left out."""
    scores = [np.zeros(0)]
    for match, own in zip(matches(scene, _MATCH_CLOSENESS, "ever"), scene.scores, strict=True):
        scores.append(own[match.columns[~match.switched]])
    return np.concatenate(scores)


def _thresholds(scores: FloatArray, objects: int) -> FloatArray:
    """(40,) scores that reach the recalls from 1 down to 0.1; NaN for those that are not reached."""
    recalls = np.linspace(MIN_RECALL, 1, THRESHOLDS).round(12)
    if not len(scores):
        return np.full(THRESHOLDS, np.nan)
    reached = np.arange(1, len(scores) + 1) / objects
    thresholds = np.interp(recalls, reached, scores, right=0)
    thresholds[recalls > reached[-1]] = np.nan
    return thresholds[::-1]


def _at(scenes: Sequence[TrackedFrames], objects: int) -> dict[str, float]:
    """Measures of the outputs that are left at one threshold."""
    lives: list[list[bool]] = []
    hits = switches = outputs = frames = 0
    closeness = 0.0
    for scene in scenes:
        own: dict[int, list[bool]] = {}
        matched = matches(scene, _MATCH_CLOSENESS, "ever")
        for match, truth, found, close in zip(matched, scene.truth, scene.found, scene.overlaps, strict=True):
            hits, switches, outputs = hits + len(match.rows), switches + int(match.switched.sum()), outputs + len(found)
            closeness += float(close[match.rows, match.columns].sum())
            frames += bool(len(truth) or len(found))
            seen = set(match.rows.tolist())
            for row, track in enumerate(truth.tolist()):
                own.setdefault(track, []).append(row in seen)
        lives += own.values()
    false_alarms, misses = outputs - hits, objects - hits
    counts = Clear(objects, hits, misses, false_alarms, switches, 0, closeness)
    right = hits - switches
    followed = [life for life in lives if any(life)]
    shares = np.array([np.mean(life) for life in lives])
    nan = float("nan")
    return {
        "recall": hits / objects,
        "motar": counts.smoothed_mota(right / objects) / 100 if right else nan,
        "gt": float(objects),
        "mota": max(counts.mota / 100, 0.0),
        "motp": _SCALE_M * (1 - closeness / hits) if hits else nan,
        "mt": float((shares >= MOSTLY_TRACKED).sum()),
        "ml": float((shares < MOSTLY_LOST).sum()),
        "faf": 100 * false_alarms / frames,
        "tp": float(right),
        "fp": float(false_alarms),
        "fn": float(misses),
        "ids": float(switches),
        "frag": float(sum(_fragments(own) for own in followed)),
        "tid": SAMPLE_S * float(np.mean([own.index(True) for own in followed])) if followed else nan,
        "lgd": SAMPLE_S * float(np.mean([_longest_gap(own) for own in followed])) if followed else nan,
    }


def _runs(life: Sequence[bool]) -> list[int]:
    """Lengths of an object's runs of frames in which it was not found, in order."""
    return [len(run) for run in "".join("x" if found else "." for found in life).split("x") if run]


def _fragments(life: Sequence[bool]) -> int:
    """How often an object was lost and found again."""
    first, last = life.index(True), len(life) - list(reversed(life)).index(True)
    return len(_runs(life[first:last]))


def _longest_gap(life: Sequence[bool]) -> int:
    """Frames of the longest time in which an object was not found."""
    return max(_runs(life), default=0)
