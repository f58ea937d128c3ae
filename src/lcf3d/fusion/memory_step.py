"""One frame onward: the stages of the memory one after the other, see `lcf3d.fusion.memory`."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from lcf3d.decisions import TrackTable
from lcf3d.fusion.evidence import to_log_odds, to_probability
from lcf3d.fusion.memory_association import associate
from lcf3d.fusion.memory_config import MemoryConfig
from lcf3d.fusion.memory_ego import learned_odometry
from lcf3d.fusion.memory_evidence import (
    CAMERA,
    HIDDEN,
    frame_support,
    missed_log_odds,
    motion_log_odds,
    seen_log_odds,
)
from lcf3d.fusion.memory_identity import keep_numbers
from lcf3d.fusion.memory_motion import begin, measure, predict
from lcf3d.fusion.memory_prediction import free_camera_scores, free_share, hidden_share, seen_by, views_of
from lcf3d.fusion.memory_shape import bottom_share, boxes_now, refine, reshape, size_weight
from lcf3d.fusion.memory_state import (
    BORN,
    BOTTOM,
    HITS,
    ID,
    LABEL,
    LAST_SUPPORT,
    NUMBER_HITS,
    SEEN,
    SIZE,
    SIZE_WEIGHT,
    SUPPORT,
    Memory,
    Moment,
    Odometry,
    Tracks,
)
from lcf3d.geometry.boxes import transform_boxes
from lcf3d.geometry.iou import bev_iou
from lcf3d.geometry.rotation import invert_rigid
from lcf3d.kernels import kernel
from lcf3d.provenance import FusedDetections
from lcf3d.structures import BoolArray, Detections3D, FloatArray, IntArray

# a predicted box overlaps no detection of its class, and none of another that is as sure, by more than this from above
DUPLICATE_IOU = 0.1
# a detection and its track's predicted position are at most so far apart: metres, and standard deviations of speed
# for the time between, but no more metres than
REACH_M, REACH_SPREADS, MAX_REACH_M = 0.7, 4.0, 10.0
# share of what the track says of places and heights where the sensor's own motion is estimated, without its pitch
ESTIMATED_SHARE = 0.5
# boxes of log-odds below this hide nothing
SURE_LOG_ODDS = -1.0


class _Seen(NamedTuple):
    """The frame's detections in the world, and the tracks they belong to.

    Attributes:
        boxes: (N, 7) in the world frame.
        distances: (N,) from the sensor.
        log_odds: (N,) of the frame itself.
        match: (N,) track, or -1.
    """

    boxes: FloatArray
    distances: FloatArray
    log_odds: FloatArray
    match: IntArray


class _Predicted(NamedTuple):
    """Boxes that the frame misses: rows of their tracks, and log-odds."""

    rows: IntArray
    log_odds: FloatArray


def aged(memory: Memory, elapsed_s: float) -> Tracks:
    """The tracks at the time of the next frame: moved on, their support faded."""
    return predict(memory.tracks, elapsed_s, memory.classes.motion)


def step(memory: Memory, tracks: Tracks, fused: FusedDetections, moment: Moment) -> tuple[Memory, FusedDetections]:
    """One frame onward.

    Args:
        memory: after the frame before.
        tracks: its tracks at the time of this frame, see `aged`.
        fused: the frame's detections.
        moment: the frame's time and place.
    """
    classes, found, time = memory.classes, fused.detections, moment.time_s
    elapsed = time - memory.time_s
    lidar_from_world = invert_rigid(moment.world_from_lidar)
    boxes = transform_boxes(found.boxes, moment.world_from_lidar)
    distances = np.hypot(found.boxes[:, 0], found.boxes[:, 1])
    reach = np.minimum(REACH_M + REACH_SPREADS * classes.motion.speed_spread * elapsed, MAX_REACH_M)
    match = associate(tracks, boxes, found.labels, distances, reach)
    seen = _Seen(boxes, distances, to_log_odds(found.scores), match)

    support = np.zeros(len(found))
    support[match >= 0] = tracks.support[match[match >= 0]]
    log_odds = seen_log_odds(
        seen.log_odds, support, _looked(memory, seen, elapsed), classes.seen_weight[found.labels], elapsed
    )
    known, own = _updated(tracks, seen, found, memory, moment)
    known = keep_numbers(known, len(tracks), own, boxes, classes.rigid[found.labels])
    log_odds += motion_log_odds(known.standing[own], classes.standing_doubt[found.labels])
    places = boxes_now(known, own, boxes, ESTIMATED_SHARE if moment.estimated else 1.0)
    tracked = transform_boxes(places, lidar_from_world)
    kept = np.empty((len(found), 7))
    shaped = classes.rigid[found.labels], classes.upright[found.labels]
    refine(np.array(found.boxes), match, *shaped, tracked, kept)
    predicted = _predicted(len(tracks), known, tracked, seen, fused, moment, memory)
    extra = tracked[predicted.rows]
    result = _assemble(
        fused,
        np.concatenate([kept, extra]) if len(extra) else kept,
        (log_odds, seen.log_odds, predicted.log_odds),
        known[np.concatenate([own, predicted.rows])],
        lidar_from_world,
        time,
    )
    odometry, world_from_dataset = _odometry(memory, known, moment)
    return replace(
        memory,
        tracks=_bounded(known, time, memory.config),
        time_s=time,
        world_from_lidar=moment.world_from_lidar,
        lidar_from_world=lidar_from_world,
        world_from_dataset=world_from_dataset,
        odometry=odometry,
        ego_velocity=moment.ego_velocity,
        cameras=moment.cameras,
        next_id=memory.next_id + len(known) - len(tracks),
    ), result


def _odometry(memory: Memory, tracks: Tracks, moment: Moment) -> tuple[Odometry, FloatArray | None]:
    """What is known of the poses' scale after the frame, and the memory's world from theirs.

    Where poses are missing, the world goes on by what the objects say, and poses that come again join it there.
    """
    given, known, world_from_dataset = moment.frame.world_from_lidar, memory.odometry, memory.world_from_dataset
    elapsed = moment.time_s - memory.time_s
    if given is None:
        return known, None
    if world_from_dataset is None:
        return known, moment.world_from_lidar @ invert_rigid(given)
    if elapsed <= 0:
        return known, world_from_dataset
    here, before = moment.world_from_lidar[:3, 3], memory.world_from_lidar[:3, 3]
    moved = world_from_dataset.copy()
    moved[:3, 3] += here - (world_from_dataset @ given)[:3, 3]
    return learned_odometry(known, tracks, here[:2] - before[:2], moment.time_s, elapsed), moved


def _looked(memory: Memory, seen: _Seen, elapsed_s: float) -> BoolArray:
    """(N,) whether a frame ago somebody looked where a detection without a past is."""
    new = np.flatnonzero(seen.match < 0)
    looked = np.zeros(len(seen.match), dtype=bool)
    if elapsed_s > 0 and len(new):
        before = transform_boxes(seen.boxes[new], memory.lidar_from_world)
        looked[new] = seen_by(views_of(before, memory.cameras), len(new))
    return looked


def _updated(
    tracks: Tracks, seen: _Seen, found: Detections3D, memory: Memory, moment: Moment
) -> tuple[Tracks, IntArray]:
    """The tracks with what the frame saw of them, and then those that begin; and (N,) the row of each detection's."""
    old, new = seen.match >= 0, seen.match < 0
    n_new = int(new.sum())
    own = seen.match.copy()
    own[new] = len(tracks) + np.arange(n_new)
    values = np.empty((len(tracks) + n_new, tracks.values.shape[1]))
    numbers = np.empty((len(values), tracks.numbers.shape[1]), dtype=np.int64)
    values[: len(tracks)], numbers[: len(tracks)] = tracks.values, tracks.numbers
    shares = np.zeros(len(found))
    time = moment.time_s
    shares[old] = bottom_share(time - tracks.seen[seen.match[old]], seen.distances[old])
    if moment.estimated:
        shares *= ESTIMATED_SHARE
    motion = memory.classes.motion
    _update(
        (numbers, values, own, len(tracks), memory.next_id, time),
        (seen.boxes, np.array(found.labels), seen.distances, frame_support(seen.log_odds)),
        (size_weight(seen.log_odds, seen.distances), shares, motion.turns, motion.speed_spread),
    )
    return Tracks(numbers, values), own


@kernel
def _update(to, seen, by):  # type: ignore[no-untyped-def]
    """Correct the tracks that were seen and fill the rows of those that begin, see `_updated`."""
    numbers, values, own, n_old, next_id, time = to
    boxes, labels, distances, supports = seen
    weights, shares, turns, speed_spread = by
    for i in range(len(own)):
        row, label = own[i], labels[i]
        track = values[row]
        if row < n_old:
            measure(track, boxes[i], distances[i], turns[label])
            reshape(track, boxes[i], weights[i], shares[i])
            numbers[row, HITS] += 1
        else:
            begin(track, boxes[i], distances[i], speed_spread[label])
            numbers[row, ID], numbers[row, LABEL] = next_id + row - n_old, label
            numbers[row, HITS], numbers[row, NUMBER_HITS] = 1, 0
            track[SIZE : SIZE + 3] = boxes[i, 3:6]
            track[SIZE_WEIGHT], track[BOTTOM] = weights[i], boxes[i, 2] - boxes[i, 5] / 2
            track[SUPPORT], track[BORN] = 0.0, time
        track[LAST_SUPPORT], track[SEEN] = supports[i], time


def _predicted(
    n_old: int,
    tracks: Tracks,
    tracked: FloatArray,
    seen: _Seen,
    fused: FusedDetections,
    moment: Moment,
    memory: Memory,
) -> _Predicted:
    """Boxes for those of the first ``n_old`` tracks that the frame misses; ``tracked`` are their boxes here."""
    config, classes, found = memory.config, memory.classes, fused.detections
    missed = np.ones(n_old, dtype=bool)
    missed[seen.match[seen.match >= 0]] = False
    chosen = np.flatnonzero(missed & (tracks.hits[:n_old] >= config.min_hits))
    # nothing that is seen there can lift a box by more than HIDDEN and CAMERA
    labels = tracks.labels[chosen]
    moves = motion_log_odds(tracks.standing[chosen], classes.standing_doubt[labels])
    best = classes.missed_weight[labels] * tracks.support[chosen] - classes.base[labels] + HIDDEN + CAMERA + moves
    likely = best > config.min_log_odds
    chosen, moves = chosen[likely], moves[likely]
    if not config.predict or not len(chosen):
        return _Predicted(chosen[:0], np.zeros(0))
    views = views_of(tracked[chosen], moment.cameras)
    there = seen_by(views, len(chosen))
    covered = bev_iou(tracked[chosen], found.boxes) >= DUPLICATE_IOU
    alike = tracks.labels[chosen][:, None] == found.labels[None]
    there = there & ~(covered & alike).any(axis=1)
    chosen, boxes, moves, covered = chosen[there], tracked[chosen[there]], moves[there], covered[there]
    if not len(chosen):
        return _Predicted(chosen, np.zeros(0))
    views = [view._replace(pixels=view.pixels[there], visible=view.visible[there]) for view in views]
    labels = tracks.labels[chosen]
    free = np.zeros(len(chosen))
    if config.free_space and moment.frame.points is not None:
        free = free_share(boxes, moment.frame.points)
    log_odds = missed_log_odds(
        tracks.support[chosen],
        hidden_share(boxes, found.boxes[seen.log_odds > SURE_LOG_ODDS], views),
        free_camera_scores(labels, fused, views),
        free,
        classes.missed_weight[labels],
        classes.base[labels],
    )
    log_odds += moves
    good = (log_odds > config.min_log_odds) & ~(covered & (seen.log_odds[None] >= log_odds[:, None])).any(axis=1)
    return _Predicted(chosen[good], log_odds[good])


def _assemble(
    fused: FusedDetections,
    boxes: FloatArray,
    log_odds: tuple[FloatArray, FloatArray, FloatArray],
    tracks: Tracks,
    lidar_from_world: FloatArray,
    time: float,
) -> FusedDetections:
    """Detections and predicted boxes, highest score first, with the table of their tracks.

    Args:
        fused: the frame alone.
        boxes: (N + P, 7) detections and predicted boxes.
        log_odds: (N,) of the detections, (N,) without the past, (P,) of the predicted boxes.
        tracks: N + P of them.
        lidar_from_world: (4, 4).
        time: of the frame.
    """
    found, (own, alone, extra) = fused.detections, log_odds
    n = len(found)
    velocities = tracks.velocities @ lidar_from_world[:2, :2].T
    velocities[tracks.hits < 2] = np.nan
    if found.velocities is not None:
        given = np.isfinite(found.velocities).all(axis=1)
        velocities[:n][given] = found.velocities[given]
    attributes = None
    if found.attributes is not None:
        attributes = np.concatenate([found.attributes, np.full(len(extra), "")])
    scores = to_probability(np.concatenate([own, extra]))
    # the log-odds are bounded, so a score that the memory leaves alone is taken as it was
    np.copyto(scores[:n], found.scores, where=own == alone)
    order = np.argsort(-scores, kind="stable")
    if (np.diff(scores[order]) == 0).any():
        order = np.lexsort((*boxes.T[::-1], -scores))
    detections = Detections3D(
        boxes[order],
        scores[order],
        tracks.labels[order],
        found.class_names,
        velocities[order],
        None if attributes is None else attributes[order],
    )
    tracks = tracks[order]
    table = TrackTable(
        ids=tracks.ids,
        ages_s=time - tracks.born,
        hits=tracks.number_hits,
        unseen_s=time - tracks.seen,
        support=tracks.support,
        log_odds=np.concatenate([own - alone, extra])[order],
    )
    return fused.reordered(detections, order, table)


def _bounded(tracks: Tracks, time: float, config: MemoryConfig) -> Tracks:
    """The tracks worth keeping: seen within the horizon, at most as many as the settings allow.

    What stands is where it was, what moves is soon elsewhere: the horizon lies between both by how probable each is.
    """
    moving = min(config.moving_horizon_s, config.horizon_s)
    recent = time - tracks.seen <= moving + tracks.standing * (config.horizon_s - moving)
    if not recent.all():
        tracks = tracks[recent]
    if len(tracks) <= config.max_tracks:
        return tracks
    order = np.lexsort((-(tracks.support + tracks.last_support), time - tracks.seen))
    return tracks[np.sort(order[: config.max_tracks])]
