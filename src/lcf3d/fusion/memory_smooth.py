"""Both ways: a memory that also runs backwards, for labelling and other work that may wait for the end of a drive.

The sequence is remembered forwards and, with time turned round, backwards. For what a frame sees, both add their
evidence and the boxes are averaged; a box that both predict lies between the last and the next sighting, by time.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy.optimize import linear_sum_assignment

from lcf3d.decisions import TrackTable
from lcf3d.frame import Frame
from lcf3d.fusion.evidence import to_log_odds, to_probability
from lcf3d.fusion.memory import remember
from lcf3d.fusion.memory_config import MemoryConfig
from lcf3d.fusion.memory_state import Memory
from lcf3d.geometry.boxes import wrap_angle
from lcf3d.geometry.iou import bev_iou
from lcf3d.provenance import FusedDetections
from lcf3d.structures import Detections3D, FloatArray, IntArray

# predicted boxes of both directions that overlap by more than this in the bird's-eye view are one
SAME_IOU = 0.1


def smooth_sequence(
    frames: Sequence[tuple[Frame, FusedDetections]], config: MemoryConfig | None = None
) -> list[FusedDetections]:
    """The frames of one sequence, in order of time, each with what those before and after it add.

    Frames without a time come back as they are, see `lcf3d.fusion.memory.remember`. Predicted boxes are not tested for
    free space: the frames after say more, and no scan is read twice.
    """
    settings = (config or MemoryConfig()).model_copy(update={"free_space": False})
    forward, poses = _run([frame for frame, _ in frames], [fused for _, fused in frames], settings)
    turned = [
        Frame(
            frame.id,
            cameras=frame.cameras,
            timestamp=None if frame.timestamp is None else -frame.timestamp,
            world_from_lidar=pose,
            sequence=frame.sequence,
        )
        for (frame, _), pose in zip(frames, poses, strict=True)
    ]
    backward, _ = _run(turned[::-1], [fused for _, fused in frames][::-1], _without_motion(settings, frames))
    backward = backward[::-1]
    forward_id = _forward_ids(forward, backward)
    return [
        fused if ahead.tracks is None or back.tracks is None else _joined(fused, ahead, back, forward_id, settings)
        for (_, fused), ahead, back in zip(frames, forward, backward, strict=True)
    ]


def _without_motion(config: MemoryConfig, frames: Sequence[tuple[Frame, FusedDetections]]) -> MemoryConfig:
    """The same, but how an object moves says nothing: it is one piece of evidence, and the other direction has it."""
    names = dict.fromkeys(name for _, fused in frames for name in fused.detections.class_names)
    return config.with_classes(names, standing_doubt=0.0)


def _run(
    frames: Sequence[Frame], detections: Sequence[FusedDetections], config: MemoryConfig
) -> tuple[list[FusedDetections], list[FloatArray | None]]:
    """Every frame with what those before it add, and where the sensor was, given or estimated."""
    memory: Memory | None = None
    results: list[FusedDetections] = []
    poses: list[FloatArray | None] = []
    for frame, fused in zip(frames, detections, strict=True):
        memory, remembered = remember(memory, fused, frame, config)
        results.append(remembered)
        poses.append(None if memory is None or remembered.tracks is None else memory.world_from_lidar)
    return results, poses


def _rows(result: FusedDetections) -> IntArray:
    """(N,) a number for each output that is the same in every result of the frame: its input; -1 for predicted ones."""
    rows = np.full(len(result), -1, dtype=np.int64)
    for table, start in ((result.camera, len(result.lidar)), (result.lidar, 0)):
        led = np.flatnonzero(table.output >= 0)
        rows[table.output[led]] = start + led
    return rows


def _forward_ids(forward: Sequence[FusedDetections], backward: Sequence[FusedDetections]) -> dict[int, int]:
    """The forward track that each backward track most often shares a detection with."""
    votes: dict[int, Counter[int]] = {}
    for ahead, back in zip(forward, backward, strict=True):
        if ahead.tracks is None or back.tracks is None:
            continue
        by_row = dict(zip(_rows(ahead).tolist(), ahead.tracks.ids.tolist(), strict=True))
        for row, own in zip(_rows(back).tolist(), back.tracks.ids.tolist(), strict=True):
            if row >= 0:
                votes.setdefault(own, Counter())[by_row[row]] += 1
    return {own: counted.most_common(1)[0][0] for own, counted in votes.items()}


def _joined(
    fused: FusedDetections,
    ahead: FusedDetections,
    back: FusedDetections,
    forward_id: dict[int, int],
    config: MemoryConfig,
) -> FusedDetections:
    """One frame of both directions as one result."""
    assert ahead.tracks is not None
    assert back.tracks is not None
    rows = _rows(fused)
    place_ahead, place_back = ({int(r): i for i, r in enumerate(_rows(one)) if r >= 0} for one in (ahead, back))
    a = np.array([place_ahead[int(r)] for r in rows], dtype=np.int64)
    b = np.array([place_back[int(r)] for r in rows], dtype=np.int64)
    pa, pb, only_a, only_b = _pairs(ahead, back)
    only_b = _unknown(ahead.tracks, back.tracks, only_b, forward_id)
    own = to_log_odds(fused.detections.scores)
    seen = own + ahead.tracks.log_odds[a] + back.tracks.log_odds[b]
    weight = np.array([config.of(name).missed_weight for name in ahead.detections.class_names])
    both = ahead.tracks.log_odds[pa] + weight[ahead.detections.labels[pa]] * back.tracks.support[pb]
    log_odds = np.concatenate([seen, both, ahead.tracks.log_odds[only_a], back.tracks.log_odds[only_b]])
    # between the sightings, nearer in time to the one that counts more
    until, since = back.tracks.unseen_s[pb], ahead.tracks.unseen_s[pa]
    middle = _between(ahead.detections.boxes[pa], back.detections.boxes[pb], since / (since + until))
    boxes = np.concatenate(
        [
            _between(ahead.detections.boxes[a], back.detections.boxes[b], np.full(len(a), 0.5)),
            middle,
            ahead.detections.boxes[only_a],
            back.detections.boxes[only_b],
        ]
    )
    a, b = np.concatenate([a, pa]), np.concatenate([b, pb])
    tracks = _tables(ahead.tracks, back.tracks, a, b, only_a, only_b, forward_id)
    added = log_odds.copy()
    added[: len(own)] -= own
    labels = [ahead.detections.labels[np.concatenate([a, only_a])], back.detections.labels[only_b]]
    detections = Detections3D(
        boxes,
        np.where(added == 0, np.concatenate([fused.detections.scores, added[len(own) :]]), to_probability(log_odds)),
        np.concatenate(labels),
        fused.detections.class_names,
        _velocities(fused.detections, ahead, back, (a, b, only_a, only_b)),
        _attributes(fused, len(log_odds)),
    )
    order = np.lexsort((*detections.boxes.T[::-1], -detections.scores))
    notes = tuple(dict.fromkeys((*ahead.notes, *back.notes)))
    result = replace(fused, notes=notes)
    return result.reordered(detections[order], order, replace(tracks, log_odds=added)[order])


def _pairs(ahead: FusedDetections, back: FusedDetections) -> tuple[IntArray, IntArray, IntArray, IntArray]:
    """Predicted boxes that both directions have, one to one, and those that only one has."""
    assert ahead.tracks is not None
    assert back.tracks is not None
    a, b = np.flatnonzero(ahead.tracks.predicted), np.flatnonzero(back.tracks.predicted)
    overlap = bev_iou(ahead.detections.boxes[a], back.detections.boxes[b])
    overlap[ahead.detections.labels[a][:, None] != back.detections.labels[b][None]] = 0
    rows, columns = linear_sum_assignment(overlap, maximize=True)
    good = overlap[rows, columns] > SAME_IOU
    rows, columns = rows[good], columns[good]
    return a[rows], b[columns], np.delete(a, rows), np.delete(b, columns)


def _unknown(ahead: TrackTable, back: TrackTable, only_b: IntArray, forward_id: dict[int, int]) -> IntArray:
    """Those of the backward boxes whose objects the forward direction does not have in this frame, each object once."""
    taken = set(ahead.ids.tolist())
    kept = []
    for row in only_b:
        own = forward_id.get(int(back.ids[row]))
        if own is None or own not in taken:
            kept.append(row)
            taken |= set() if own is None else {own}
    return np.array(kept, dtype=np.int64)


def _between(first: FloatArray, second: FloatArray, share: FloatArray) -> FloatArray:
    """(N, 7) boxes a share of the way from the first to the second."""
    boxes = first + share[:, None] * (second - first)
    turn = wrap_angle(second[:, 6] - first[:, 6])
    # front and rear may differ between the two: the first says
    turn = np.where(np.abs(turn) > np.pi / 2, wrap_angle(turn + np.pi), turn)
    boxes[:, 6] = wrap_angle(first[:, 6] + share * turn)
    return boxes


def _tables(
    ahead: TrackTable,
    back: TrackTable,
    a: IntArray,
    b: IntArray,
    only_a: IntArray,
    only_b: IntArray,
    forward_id: dict[int, int],
) -> TrackTable:
    """The tracks of both directions; numbers are those of the forward one where it knows the object."""
    free = 1 + max((*forward_id.values(), *ahead.ids.tolist(), 0))
    ids_b = [forward_id.get(int(own), free + int(own)) for own in back.ids[only_b]]
    first = np.concatenate([a, only_a])
    hits = ahead.hits[first]
    hits[: len(a)] += back.hits[b] - (ahead.unseen_s[a] == 0)
    support = ahead.support[first]
    support[: len(a)] += back.support[b]
    return TrackTable(
        ids=np.concatenate([ahead.ids[first], np.array(ids_b, dtype=np.int64)]),
        ages_s=np.concatenate([ahead.ages_s[first], np.zeros(len(only_b))]),
        hits=np.concatenate([hits, back.hits[only_b]]),
        unseen_s=np.concatenate([ahead.unseen_s[first], back.unseen_s[only_b]]),
        support=np.concatenate([support, back.support[only_b]]),
        log_odds=np.zeros(len(first) + len(only_b)),
    )


def _velocities(
    given: Detections3D,
    ahead: FusedDetections,
    back: FusedDetections,
    rows: tuple[IntArray, IntArray, IntArray, IntArray],
) -> FloatArray:
    """(N, 2) mean velocities of both directions, of which time has turned one round; NaN where neither knows.

    Those that the detector gave stay.
    """
    assert ahead.detections.velocities is not None
    assert back.detections.velocities is not None
    a, b, only_a, only_b = rows
    first, second = ahead.detections.velocities, -back.detections.velocities
    mean = np.where(np.isnan(first[a]), second[b], np.where(np.isnan(second[b]), first[a], (first[a] + second[b]) / 2))
    velocities = np.concatenate([mean, first[only_a], second[only_b]])
    if given.velocities is not None:
        known = np.flatnonzero(np.isfinite(given.velocities).all(axis=1))
        velocities[known] = given.velocities[known]
    return velocities


def _attributes(fused: FusedDetections, n: int) -> np.ndarray[tuple[int], np.dtype[np.str_]] | None:
    """(N,) attributes of the outputs, empty for predicted ones; None where there are none."""
    given = fused.detections.attributes
    return None if given is None else np.concatenate([given, np.full(n - len(given), "")])
