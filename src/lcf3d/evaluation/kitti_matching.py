"""The matching of the official KITTI program: overlaps once a data set, then assignments at every score threshold.

All arrays are flat over the data set; frame ``f`` owns rows ``starts[f]`` to ``starts[f + 1]``, and its overlaps are
the ``(objects, detections)`` matrix stored row after row from ``pair_starts[f]``.
"""

from __future__ import annotations

import math

import numpy as np

from lcf3d.evaluation.curves import ScoreEvents
from lcf3d.formats.kitti import KittiFrames
from lcf3d.geometry.iou import bev_intersection
from lcf3d.kernels import kernel
from lcf3d.structures import FloatArray, IntArray

# what an object or a detection is to the class and difficulty at hand
OTHER, COUNTS, IGNORED = -1, 0, 1

# what became of a detection at one score threshold
BELOW, TRUE_POSITIVE, FALSE_POSITIVE, NOT_COUNTED = 0, 1, 2, 3


def pair_starts(truth: KittiFrames, results: KittiFrames) -> IntArray:
    """(F + 1,) where each frame's overlap matrix begins in the flat arrays."""
    return np.concatenate([[0], np.cumsum(np.diff(truth.starts) * np.diff(results.starts))])


def overlaps(truth: KittiFrames, results: KittiFrames) -> dict[str, FloatArray]:
    """Overlap of every object with every detection of its frame: ``bbox``, ``bev`` and ``3d``, each flat (P,).

    Rows of DontCare regions hold the share of the *detection* that the region covers, all others IoU.
    """
    pairs = pair_starts(truth, results)
    bbox, bev, volume = _overlaps(
        truth.starts,
        results.starts,
        pairs,
        np.char.lower(truth.objects.class_names) == "dontcare",
        np.array(truth.objects.boxes2d),
        _box_rows(truth),
        np.array(results.objects.boxes2d),
        _box_rows(results),
    )
    return {"bbox": bbox, "bev": bev, "3d": volume}


def score_events(
    truth: KittiFrames,
    results: KittiFrames,
    overlap: FloatArray,
    min_overlap: float,
    object_codes: IntArray,
    detection_codes: IntArray,
) -> ScoreEvents:
    """Match every frame at every score threshold.

    Args:
        truth: ground truth of F frames, N objects.
        results: detections of the same frames, M with scores.
        overlap: flat overlaps of one measure, see `overlaps`.
        min_overlap: a pair may match when its overlap is greater.
        object_codes: (N,) `COUNTS`, `IGNORED` or `OTHER`; DontCare regions are `OTHER`.
        detection_codes: (M,) the same for detections.
    """
    scores = results.objects.scores
    assert scores is not None  # checked by the caller
    objects, hits, events = _score_events(
        truth.starts,
        results.starts,
        pair_starts(truth, results),
        overlap,
        min_overlap,
        object_codes,
        detection_codes,
        np.char.lower(truth.objects.class_names) == "dontcare",
        np.array(truth.objects.alpha),
        np.array(results.objects.alpha),
        np.array(scores),
        # sorted here, since numba would compile a sort of its own; by frame, then by falling score
        np.lexsort((-scores, results.frame_of_object)),
    )
    hits = hits[np.argsort(-hits[:, 0], kind="stable")]
    events = events[np.argsort(-events[:, 0], kind="stable")]
    counts = events[:, 1:4].astype(np.int64)  # frame, change of true and of false positives
    return ScoreEvents(
        objects,
        np.ascontiguousarray(hits[:, 0]),
        hits[:, 1].astype(np.int64),
        np.ascontiguousarray(events[:, 0]),
        np.ascontiguousarray(counts[:, 0]),
        np.ascontiguousarray(counts[:, 1]),
        np.ascontiguousarray(counts[:, 2]),
        np.ascontiguousarray(events[:, 4]),
    )


def match_at(
    truth: KittiFrames,
    results: KittiFrames,
    overlap: FloatArray,
    min_overlap: float,
    object_codes: IntArray,
    detection_codes: IntArray,
    threshold: float,
) -> tuple[IntArray, IntArray]:
    """The assignment at one score threshold.

    Returns:
        (N,) row of the detection matched with each object or -1, and (M,) what became of each detection: `BELOW` the
        threshold, `TRUE_POSITIVE`, `FALSE_POSITIVE`, or `NOT_COUNTED` (another class, too small, or matched with an
        ignored object or DontCare region).
    """
    scores = results.objects.scores
    assert scores is not None  # checked by the caller
    matches, outcomes = _match_at(
        truth.starts,
        results.starts,
        pair_starts(truth, results),
        overlap,
        min_overlap,
        object_codes,
        detection_codes,
        np.char.lower(truth.objects.class_names) == "dontcare",
        np.array(scores),
        threshold,
    )
    return matches, outcomes


def _box_rows(frames: KittiFrames) -> FloatArray:
    """(N, 7) x, z, length, width, rotation about y as the other rotation, bottom y and height of each object."""
    objects = frames.objects
    rows = np.empty((len(objects), 7))
    rows[:, :2] = objects.locations[:, ::2]
    # lines without a 3D box have negative sizes; the official program spans the same rectangle from them
    rows[:, 2:4] = np.abs(objects.dimensions[:, :0:-1])
    rows[:, 4] = -objects.rotation_y
    rows[:, 5] = objects.locations[:, 1]
    rows[:, 6] = objects.dimensions[:, 0]
    return rows


@kernel
def _overlaps(  # type: ignore[no-untyped-def]
    object_starts, detection_starts, pairs, is_dontcare, object_boxes, object_rows, detection_boxes, detection_rows
):
    bbox, bev, volume = np.zeros(pairs[-1]), np.zeros(pairs[-1]), np.zeros(pairs[-1])
    for f in range(len(object_starts) - 1):
        pair = pairs[f]
        for i in range(object_starts[f], object_starts[f + 1]):
            a, p = object_boxes[i], object_rows[i]
            for j in range(detection_starts[f], detection_starts[f + 1]):
                b, q = detection_boxes[j], detection_rows[j]
                width, height = min(a[2], b[2]) - max(a[0], b[0]), min(a[3], b[3]) - max(a[1], b[1])
                if width > 0 and height > 0:
                    shared = width * height
                    whole = (b[2] - b[0]) * (b[3] - b[1])
                    if not is_dontcare[i]:
                        whole += (a[2] - a[0]) * (a[3] - a[1]) - shared
                    bbox[pair] = shared / whole
                shared = bev_intersection(p[0], p[1], p[2], p[3], p[4], q[0], q[1], q[2], q[3], q[4])
                if shared > 0:
                    whole = q[2] * q[3]
                    if not is_dontcare[i]:
                        whole += p[2] * p[3] - shared
                    bev[pair] = shared / whole
                    shared *= max(min(p[5], q[5]) - max(p[5] - p[6], q[5] - q[6]), 0.0)
                    whole = q[2] * q[3] * q[6]
                    if not is_dontcare[i]:
                        whole += p[2] * p[3] * p[6] - shared
                    volume[pair] = shared / whole if whole > 0 else 0.0
                pair += 1
    return bbox, bev, volume


@kernel
def _candidates(  # type: ignore[no-untyped-def]
    first_object, last_object, first_detection, last_detection, pair, overlap, min_overlap, object_codes,
    detection_codes, is_dontcare, cover, candidate_starts, candidates, candidate_overlaps
):  # fmt: skip
    """List, for each object of a frame, the detections that overlap it enough; mark those that DontCare covers."""
    n_candidates = 0
    cover[first_detection:last_detection] = False
    for i in range(first_object, last_object):
        candidate_starts[i - first_object] = n_candidates
        if is_dontcare[i] or object_codes[i] != -1:
            for j in range(first_detection, last_detection):
                if detection_codes[j] != -1 and overlap[pair + j - first_detection] > min_overlap:
                    if is_dontcare[i]:
                        cover[j] = True
                    else:
                        candidates[n_candidates] = j
                        candidate_overlaps[n_candidates] = overlap[pair + j - first_detection]
                        n_candidates += 1
        pair += last_detection - first_detection
    candidate_starts[last_object - first_object] = n_candidates
    return n_candidates


@kernel
def _assign(  # type: ignore[no-untyped-def]
    first_object, last_object, threshold, object_codes, detection_codes, scores, candidate_starts, candidates,
    candidate_overlaps, assigned, matches
):  # fmt: skip
    """Assign detections at or above ``threshold`` to the objects of a frame, as the official program does.

    Objects choose in file order: the free detection of the greatest overlap, one that counts before one that is
    ignored for its height. Fills ``assigned`` (detection rows) and ``matches`` (object rows, -1 without).
    """
    for c in range(candidate_starts[last_object - first_object]):
        assigned[candidates[c]] = False
    for i in range(first_object, last_object):
        best, best_overlap, best_ignored = -1, 0.0, False
        for c in range(candidate_starts[i - first_object], candidate_starts[i - first_object + 1]):
            j = candidates[c]
            if assigned[j] or scores[j] < threshold:
                continue
            if detection_codes[j] == 0:
                if candidate_overlaps[c] > best_overlap or best_ignored:
                    best, best_overlap, best_ignored = j, candidate_overlaps[c], False
            elif best == -1:
                best, best_ignored = j, True
        matches[i] = best
        if best != -1:
            assigned[best] = True


@kernel
def _take_highest_scores(  # type: ignore[no-untyped-def]
    first_object, last_object, scores, candidate_starts, candidates, assigned, matches
):
    """Assign detections as for the recall thresholds: nothing is cut, objects choose the free one of highest score."""
    for c in range(candidate_starts[last_object - first_object]):
        assigned[candidates[c]] = False
    for i in range(first_object, last_object):
        best = -1
        for c in range(candidate_starts[i - first_object], candidate_starts[i - first_object + 1]):
            j = candidates[c]
            if not assigned[j] and (best == -1 or scores[j] > scores[best]):
                best = j
        matches[i] = best
        if best != -1:
            assigned[best] = True


@kernel
def _count_matches(  # type: ignore[no-untyped-def]
    first_object, last_object, matches, object_codes, detection_codes, cover, object_alpha, detection_alpha
):
    """True positives, detections that a match keeps from being false positives, and summed orientation similarity."""
    true, taken, similar = 0, 0, 0.0
    for i in range(first_object, last_object):
        j = matches[i]
        if j == -1 or detection_codes[j] != 0:
            continue
        taken += not cover[j]
        if object_codes[i] == 0:
            true += 1
            similar += (1.0 + math.cos(object_alpha[i] - detection_alpha[j])) / 2.0
    return true, taken, similar


@kernel
def _score_events(  # type: ignore[no-untyped-def]
    object_starts, detection_starts, pairs, overlap, min_overlap, object_codes, detection_codes, is_dontcare,
    object_alpha, detection_alpha, scores, order
):  # fmt: skip
    """Objects that count by frame, (H, 2) hits (score, frame), (E, 5) events (score, frame, changes)."""
    n_frames, n_detections = len(object_starts) - 1, len(scores)
    objects = np.zeros(n_frames, np.int64)
    hits, events = np.empty((len(object_codes), 2)), np.empty((n_detections, 5))
    n_hits = n_events = 0
    widest = 0
    for f in range(n_frames):
        widest = max(widest, pairs[f + 1] - pairs[f])
    candidate_starts = np.empty(len(object_codes) + 1, np.int64)
    candidates, candidate_overlaps = np.empty(widest, np.int64), np.empty(widest)
    cover, assigned = np.zeros(n_detections, np.bool_), np.zeros(n_detections, np.bool_)
    is_candidate = np.zeros(n_detections, np.bool_)
    matches = np.empty(len(object_codes), np.int64)
    for f in range(n_frames):
        o0, o1, d0, d1 = object_starts[f], object_starts[f + 1], detection_starts[f], detection_starts[f + 1]
        for i in range(o0, o1):
            objects[f] += object_codes[i] == 0
        if d0 == d1:
            continue
        n_candidates = _candidates(
            o0, o1, d0, d1, pairs[f], overlap, min_overlap, object_codes, detection_codes, is_dontcare, cover,
            candidate_starts, candidates, candidate_overlaps
        )  # fmt: skip
        for c in range(n_candidates):
            is_candidate[candidates[c]] = True
        _take_highest_scores(o0, o1, scores, candidate_starts, candidates, assigned, matches)
        for i in range(o0, o1):
            if matches[i] != -1 and object_codes[i] == 0 and detection_codes[matches[i]] == 0:
                hits[n_hits, 0], hits[n_hits, 1] = scores[matches[i]], f
                n_hits += 1
        # detections come in by falling score; equal scores come in together
        true_before, false_before, similar_before, reported = 0, 0, 0.0, 0
        true, taken, similar = 0, 0, 0.0
        k = d0
        while k < d1:
            threshold = scores[order[k]]
            changed = False
            while k < d1 and scores[order[k]] == threshold:
                reported += detection_codes[order[k]] == 0 and not cover[order[k]]
                changed |= is_candidate[order[k]]
                k += 1
            if changed:
                _assign(
                    o0, o1, threshold, object_codes, detection_codes, scores, candidate_starts, candidates,
                    candidate_overlaps, assigned, matches
                )  # fmt: skip
                true, taken, similar = _count_matches(
                    o0, o1, matches, object_codes, detection_codes, cover, object_alpha, detection_alpha
                )
            false = reported - taken
            if true != true_before or false != false_before or similar != similar_before:
                events[n_events, 0], events[n_events, 1] = threshold, f
                events[n_events, 2], events[n_events, 3] = true - true_before, false - false_before
                events[n_events, 4] = similar - similar_before
                n_events += 1
                true_before, false_before, similar_before = true, false, similar
    return objects, hits[:n_hits].copy(), events[:n_events].copy()


@kernel
def _match_at(  # type: ignore[no-untyped-def]
    object_starts, detection_starts, pairs, overlap, min_overlap, object_codes, detection_codes, is_dontcare, scores,
    threshold
):  # fmt: skip
    n_detections = len(scores)
    widest = 0
    for f in range(len(object_starts) - 1):
        widest = max(widest, pairs[f + 1] - pairs[f])
    candidate_starts = np.empty(len(object_codes) + 1, np.int64)
    candidates, candidate_overlaps = np.empty(widest, np.int64), np.empty(widest)
    cover, assigned = np.zeros(n_detections, np.bool_), np.zeros(n_detections, np.bool_)
    matches = np.full(len(object_codes), -1)
    outcomes = np.full(n_detections, NOT_COUNTED)
    for f in range(len(object_starts) - 1):
        o0, o1, d0, d1 = object_starts[f], object_starts[f + 1], detection_starts[f], detection_starts[f + 1]
        _candidates(
            o0, o1, d0, d1, pairs[f], overlap, min_overlap, object_codes, detection_codes, is_dontcare, cover,
            candidate_starts, candidates, candidate_overlaps
        )  # fmt: skip
        _assign(
            o0, o1, threshold, object_codes, detection_codes, scores, candidate_starts, candidates,
            candidate_overlaps, assigned, matches
        )  # fmt: skip
        for j in range(d0, d1):
            if scores[j] < threshold:
                outcomes[j] = BELOW
            elif detection_codes[j] == 0 and not assigned[j] and not cover[j]:
                outcomes[j] = FALSE_POSITIVE
        for i in range(o0, o1):
            if matches[i] != -1 and object_codes[i] == 0 and detection_codes[matches[i]] == 0:
                outcomes[matches[i]] = TRUE_POSITIVE
    return matches, outcomes
