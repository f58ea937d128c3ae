"""How well tracks follow objects: CLEAR MOT, the 3D measures over recall (sAMOTA, AMOTA, AMOTP), and HOTA.

All of them work on overlaps: what overlaps how much is decided beforehand, once, by whoever knows the data
(`lcf3d.evaluation.kitti_tracking`).
"""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np
from scipy.optimize import linear_sum_assignment

from lcf3d.structures import BoolArray, FloatArray, IntArray

Keep = Literal["previous", "ever", "never"]

# recall positions of the averaged measures: 1/40, 2/40, ..., 1
RECALLS = 40
# overlaps at which HOTA is computed and averaged
ALPHAS = np.arange(0.05, 0.99, 0.05)


@dataclass(frozen=True, eq=False)
class TrackedFrames:
    """Truth and output of one class over one sequence, one entry a frame.

    Attributes:
        truth: (G,) track of each object that counts.
        found: (P,) track of each output that counts.
        scores: (P,) score of each output's whole track.
        overlaps: (G, P) overlap of objects and outputs, 0 to 1.
    """

    truth: Sequence[IntArray]
    found: Sequence[IntArray]
    scores: Sequence[FloatArray]
    overlaps: Sequence[FloatArray]

    def above(self, score: float) -> TrackedFrames:
        """The same without the tracks of a lower score."""
        kept = [scores >= score for scores in self.scores]
        return TrackedFrames(
            self.truth,
            [own[k] for own, k in zip(self.found, kept, strict=True)],
            [own[k] for own, k in zip(self.scores, kept, strict=True)],
            [own[:, k] for own, k in zip(self.overlaps, kept, strict=True)],
        )


class Clear(NamedTuple):
    """CLEAR MOT counts over some sequences.

    Attributes:
        objects: ground-truth boxes.
        hits: of them, those found.
        misses: those not found.
        false_alarms: outputs that are no object.
        switches: times that an object's track changed its number.
        fragments: times that an object was found again after it was lost.
        overlap: summed over the hits.
    """

    objects: int
    hits: int
    misses: int
    false_alarms: int
    switches: int
    fragments: int
    overlap: float

    @property
    def mota(self) -> float:
        """Accuracy, percent: 1 minus errors by object; NaN without objects."""
        errors = self.misses + self.false_alarms + self.switches
        return 100 * (1 - errors / self.objects) if self.objects else float("nan")

    @property
    def motp(self) -> float:
        """Precision, percent: mean overlap of the hits; NaN without any."""
        return 100 * self.overlap / self.hits if self.hits else float("nan")

    def smoothed_mota(self, recall: float) -> float:
        """sMOTA at a recall (AB3DMOT, equation 4), percent, 0 to 100: misses that the recall implies are no errors."""
        errors = self.misses + self.false_alarms + self.switches - (1 - recall) * self.objects
        return 100 * float(np.clip(1 - errors / (recall * self.objects), 0, 1))


class Averaged(NamedTuple):
    """Measures averaged over the recall, percent, and the operating point of the best MOTA.

    Attributes:
        samota: mean sMOTA.
        amota: mean MOTA, recall positions that are not reached count 0.
        amotp: mean MOTP, likewise.
        best: counts at the threshold of the best MOTA.
        threshold: that threshold, on the tracks' scores.
    """

    samota: float
    amota: float
    amotp: float
    best: Clear
    threshold: float


class Hota(NamedTuple):
    """HOTA and its parts, percent, averaged over ``ALPHAS``.

    Attributes:
        hota: higher order tracking accuracy.
        deta: detection accuracy.
        assa: association accuracy.
        loca: mean overlap of the hits.
    """

    hota: float
    deta: float
    assa: float
    loca: float


def clear(sequences: Sequence[TrackedFrames], min_overlap: float, keep: Keep = "previous") -> Clear:
    """Counts over some sequences.

    Args:
        sequences: truth and output.
        min_overlap: a hit overlaps so much at least.
        keep: see `matches`; or ``never``: every frame is assigned by overlap alone and a switch needs two frames in a
            row (KITTI's program and AB3DMOT's).
    """
    if keep == "never":
        return _clear_above([_alone(sequence, min_overlap) for sequence in sequences], -np.inf)
    return _sum([_clear_of(sequence, min_overlap, keep) for sequence in sequences])


def _sum(counts: Sequence[tuple[float, ...]]) -> Clear:
    """The counts of some sequences together."""
    total = [sum(column) for column in zip(*counts, strict=True)] if counts else [0.0] * 7
    objects, hits, misses, false_alarms, switches, fragments = (int(count) for count in total[:6])
    return Clear(objects, hits, misses, false_alarms, switches, fragments, float(total[6]))


class Match(NamedTuple):
    """Objects and outputs of a frame that belong together.

    Attributes:
        rows: (K,) of the objects.
        columns: (K,) of the outputs.
        switched: (K,) whether the object has another track than before.
        fragments: how many of the objects were found before, and lost in between.
    """

    rows: IntArray
    columns: IntArray
    switched: BoolArray
    fragments: int


def matches(sequence: TrackedFrames, min_overlap: float, keep: Literal["previous", "ever"]) -> Iterator[Match]:
    """Which outputs belong to which objects, frame after frame.

    Args:
        sequence: truth and output.
        min_overlap: pairs overlap so much at least.
        keep: an object stays with its track of the ``previous`` frame where both still overlap (CLEAR MOT, as in
            TrackEval), or with the last track that it had ``ever`` (as in the nuScenes devkit).
    """
    last: dict[int, int] = {}  # output track that each object was last matched with
    previous: dict[int, int] = {}  # the same in the frame before only
    for truth, found, overlaps in zip(sequence.truth, sequence.found, sequence.overlaps, strict=True):
        gain = np.where(overlaps >= min_overlap, overlaps, 0.0)
        kept_rows, kept_columns = _kept(gain, truth, found, last if keep == "ever" else previous)
        rows, columns = _assigned(gain)
        rows, columns = np.append(kept_rows, rows), np.append(kept_columns, columns)
        pairs = dict(zip(truth[rows].tolist(), found[columns].tolist(), strict=True))
        switched = np.array([last.get(g, p) != p for g, p in pairs.items()], dtype=bool)
        yield Match(rows, columns, switched, sum(g in last and g not in previous for g in pairs))
        last.update(pairs)
        if len(truth) and len(found):
            previous = pairs


def _kept(gain: FloatArray, truth: IntArray, found: IntArray, before: Mapping[int, int]) -> tuple[IntArray, IntArray]:
    """Rows and columns of pairs that stay together; ``gain`` is 0 in them afterwards."""
    rows, columns = [], []
    if before and gain.size:
        column_of = {int(p): column for column, p in enumerate(found)}
        for row, g in enumerate(truth.tolist()):
            column = column_of.get(before.get(g, -1), -1)
            if column >= 0 and gain[row, column] > 0:
                rows.append(row)
                columns.append(column)
                gain[row], gain[:, column] = 0, 0
    return np.array(rows, dtype=np.int64), np.array(columns, dtype=np.int64)


def _clear_of(sequence: TrackedFrames, min_overlap: float, keep: Literal["previous", "ever"]) -> tuple[float, ...]:
    """Counts of one sequence, in the order of `Clear`."""
    objects = sum(len(truth) for truth in sequence.truth)
    hits = false_alarms = switches = fragments = 0
    overlap = 0.0
    matched = matches(sequence, min_overlap, keep)
    for match, found, overlaps in zip(matched, sequence.found, sequence.overlaps, strict=True):
        hits += len(match.rows)
        false_alarms += len(found) - len(match.rows)
        switches += int(match.switched.sum())
        fragments += match.fragments
        overlap += float(overlaps[match.rows, match.columns].sum())
    return objects, hits, objects - hits, false_alarms, switches, fragments, overlap


class _Frame:
    """A frame that is assigned by overlap alone, once for each number of outputs that a threshold leaves."""

    def __init__(self, truth: IntArray, found: IntArray, scores: FloatArray, gain: FloatArray) -> None:
        self.truth, self.found, self.scores, self.gain = truth, found, scores, gain
        self._rising = sorted(scores.tolist())
        self._known: dict[int, tuple[int, dict[int, int], float]] = {}

    def above(self, score: float) -> tuple[int, dict[int, int], float]:
        """Outputs of that score at least: how many, the track of each object that is found, and their overlap."""
        n = len(self._rising) - bisect_left(self._rising, score)
        if n not in self._known:
            kept = np.flatnonzero(self.scores >= score)
            rows, columns = _assigned(self.gain[:, kept])
            tracks = self.found[kept[columns]].tolist()
            overlap = float(self.gain[rows, kept[columns]].sum())
            self._known[n] = n, dict(zip(self.truth[rows].tolist(), tracks, strict=True)), overlap
        return self._known[n]


def _alone(sequence: TrackedFrames, min_overlap: float) -> list[_Frame]:
    """The frames of a sequence, pairs that overlap less left out."""
    gains = [np.where(overlaps >= min_overlap, overlaps, 0.0) for overlaps in sequence.overlaps]
    return [_Frame(*frame) for frame in zip(sequence.truth, sequence.found, sequence.scores, gains, strict=True)]


def _clear_above(sequences: Sequence[Sequence[_Frame]], score: float) -> Clear:
    """Counts of the outputs of that score at least, every frame assigned by overlap alone."""
    counts = []
    for frames in sequences:
        last: dict[int, int] = {}
        previous: dict[int, int] = {}
        objects = sum(len(frame.truth) for frame in frames)
        hits = outputs = switches = fragments = 0
        overlap = 0.0
        for frame in frames:
            n, pairs, shared = frame.above(score)
            hits, outputs, overlap = hits + len(pairs), outputs + n, overlap + shared
            switches += sum(previous.get(g, p) != p for g, p in pairs.items())
            fragments += sum(g in last and g not in previous for g in pairs)
            last.update(pairs)
            previous = pairs
        counts.append((objects, hits, objects - hits, outputs - hits, switches, fragments, overlap))
    return _sum(counts)


def _assigned(gain: FloatArray) -> tuple[IntArray, IntArray]:
    """Rows and columns of the assignment of highest gain, pairs without gain left out."""
    rows, columns = linear_sum_assignment(gain, maximize=True)
    good = gain[rows, columns] > 0
    return rows[good], columns[good]


def averaged(sequences: Sequence[TrackedFrames], min_overlap: float) -> Averaged:
    """sAMOTA, AMOTA and AMOTP over 40 recall positions (AB3DMOT), thresholds taken from the scores of the hits."""
    objects = sum(len(truth) for sequence in sequences for truth in sequence.truth)
    hits = np.concatenate([np.zeros(0), *(_hit_scores(sequence, min_overlap) for sequence in sequences)])
    thresholds, recalls = _thresholds(np.sort(hits)[::-1], objects)
    smoothed = mota = motp = 0.0
    frames = [_alone(sequence, min_overlap) for sequence in sequences]
    best, threshold = _clear_above(frames, np.inf), np.inf
    for score, recall in zip(thresholds, recalls, strict=True):
        counts = _clear_above(frames, score)
        smoothed += counts.smoothed_mota(recall)
        mota += counts.mota
        motp += counts.motp
        if counts.mota > best.mota:
            best, threshold = counts, score
    return Averaged(smoothed / RECALLS, mota / RECALLS, motp / RECALLS, best, threshold)


def _hit_scores(sequence: TrackedFrames, min_overlap: float) -> FloatArray:
    """Scores of the outputs that are hits when nothing is left out."""
    scores = [np.zeros(0)]
    for overlaps, own in zip(sequence.overlaps, sequence.scores, strict=True):
        _, columns = _assigned(np.where(overlaps >= min_overlap, overlaps, 0.0))
        scores.append(own[columns])
    return np.concatenate(scores)


def _thresholds(scores: FloatArray, objects: int) -> tuple[list[float], list[float]]:
    """Scores at which the recall is nearest to each position, and the positions; ``scores`` fall."""
    thresholds, recalls = [], []
    position = 0.0
    for i, score in enumerate(scores):
        here = (i + 1) / objects
        following = (i + 2) / objects if i < len(scores) - 1 else here
        if following - position < position - here and i < len(scores) - 1:
            continue
        thresholds.append(float(score))
        recalls.append(position)
        position += 1 / RECALLS
    return thresholds[1 : RECALLS + 1], recalls[1 : RECALLS + 1]


def hota(sequences: Sequence[TrackedFrames]) -> Hota:
    """Higher order tracking accuracy (Luiten et al. 2021) over some sequences."""
    hits, misses, false_alarms, association, overlap = (np.zeros(len(ALPHAS)) for _ in range(5))
    for sequence in sequences:
        parts = _hota_of(sequence)
        for total, part in zip((hits, misses, false_alarms, association, overlap), parts, strict=True):
            total += part
    detection = hits / np.maximum(hits + misses + false_alarms, 1)
    associated = association / np.maximum(hits, 1)
    located = np.where(hits > 0, overlap / np.maximum(hits, 1e-9), 1.0)
    means = (np.sqrt(detection * associated), detection, associated, located)
    return Hota(*(100 * float(values.mean()) for values in means))


def _hota_of(sequence: TrackedFrames) -> tuple[FloatArray, ...]:
    """(A,) hits, misses, false alarms, summed association and overlap of one sequence at each of ``ALPHAS``."""
    truth_ids, truth = _numbered(sequence.truth)
    found_ids, found = _numbered(sequence.found)
    shared = np.zeros((truth_ids, found_ids))
    truth_count, found_count = np.zeros(truth_ids), np.zeros(found_ids)
    for g, p, overlaps in zip(truth, found, sequence.overlaps, strict=True):
        truth_count[g] += 1
        found_count[p] += 1
        total = overlaps.sum(axis=0)[None] + overlaps.sum(axis=1)[:, None] - overlaps
        share = np.divide(overlaps, total, out=np.zeros_like(overlaps), where=total > 0)
        shared[np.ix_(g, p)] += share
    joint = truth_count[:, None] + found_count[None] - shared
    alignment = np.divide(shared, joint, out=np.zeros_like(shared), where=joint > 0)
    hits, misses, false_alarms, overlap = (np.zeros(len(ALPHAS)) for _ in range(4))
    matched = np.zeros((len(ALPHAS), truth_ids, found_ids), dtype=np.int32)
    for g, p, overlaps in zip(truth, found, sequence.overlaps, strict=True):
        rows, columns = linear_sum_assignment(alignment[np.ix_(g, p)] * overlaps, maximize=True)
        value = overlaps[rows, columns]
        for a, alpha in enumerate(ALPHAS):
            good = value >= alpha - 1e-12
            hits[a] += good.sum()
            misses[a] += len(g) - good.sum()
            false_alarms[a] += len(p) - good.sum()
            overlap[a] += value[good].sum()
            matched[a, g[rows[good]], p[columns[good]]] += 1
    association = np.zeros(len(ALPHAS))
    for a in range(len(ALPHAS)):
        rows, columns = np.nonzero(matched[a])
        count = matched[a, rows, columns].astype(np.float64)
        association[a] = (count * count / (truth_count[rows] + found_count[columns] - count)).sum()
    return hits, misses, false_alarms, association, overlap


def _numbered(ids: Sequence[IntArray]) -> tuple[int, list[IntArray]]:
    """How many different ids there are, and the ids as numbers from 0."""
    every = np.concatenate([np.zeros(0, np.int64), *ids])
    names, index = np.unique(every, return_inverse=True)
    return len(names), np.split(index, np.cumsum([len(own) for own in ids])[:-1]) if ids else []


def track_scores(ids: Sequence[IntArray], scores: Sequence[FloatArray]) -> list[FloatArray]:
    """For each frame the scores of the whole tracks of its outputs: the mean over the track's boxes."""
    every = np.concatenate([np.zeros(0, np.int64), *ids])
    _, index = np.unique(every, return_inverse=True)
    values = np.concatenate([np.zeros(0), *scores])
    mean = np.bincount(index, values) / np.maximum(np.bincount(index), 1)
    return list(np.split(mean[index], np.cumsum([len(own) for own in ids])[:-1])) if ids else []
