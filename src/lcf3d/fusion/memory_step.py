"""One frame onward: the stages of the memory one after the other, see `lcf3d.fusion.memory`."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from lcf3d.fusion.evidence import to_log_odds, to_probability
from lcf3d.fusion.memory_association import associate
from lcf3d.fusion.memory_config import ClassColumns, MemoryConfig
from lcf3d.fusion.memory_evidence import (
    CAMERA,
    HIDDEN,
    frame_support,
    grown_support,
    missed_log_odds,
    seen_log_odds,
)
from lcf3d.fusion.memory_motion import first_position_cov, first_yaw_cov, measured, predict
from lcf3d.fusion.memory_prediction import free_camera_scores, free_share, hidden_share, seen_by
from lcf3d.fusion.memory_shape import (
    POSITION_SHARE,
    averaged_sizes,
    resized,
    size_weight,
    steadied_bottoms,
)
from lcf3d.fusion.memory_state import Memory, Moment, Tracks
from lcf3d.geometry.boxes import HEIGHT, YAW, Z, transform_boxes
from lcf3d.geometry.iou import bev_iou
from lcf3d.geometry.rotation import invert_rigid
from lcf3d.provenance import FusedDetections, TrackTable
from lcf3d.structures import Detections3D, FloatArray, IntArray

# a predicted box overlaps no detection in the bird's-eye view by more than this
DUPLICATE_IOU = 0.1
# a detection and its track's predicted position are at most so far apart: metres, and standard deviations of speed
# for the time between, but no more metres than
REACH_M, REACH_SPREADS, MAX_REACH_M = 0.7, 4.0, 10.0
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


def aged(memory: Memory, elapsed_s: float) -> Tracks:
    """The tracks at the time of the next frame: moved on, their support faded."""
    tracks = predict(memory.tracks, elapsed_s, memory.classes.motion)
    support = grown_support(tracks.support, tracks.last_support, elapsed_s)
    return replace(tracks, support=support, last_support=np.zeros(len(tracks)))


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
    boxes = transform_boxes(found.boxes, moment.world_from_lidar)
    distances = np.hypot(found.boxes[:, 0], found.boxes[:, 1])
    reach = np.minimum(REACH_M + REACH_SPREADS * classes.motion.speed_spread * elapsed, MAX_REACH_M)
    match = associate(tracks, boxes, found.labels, distances, reach)
    seen = _Seen(boxes, distances, to_log_odds(found.scores), match)

    had = match >= 0
    support = np.where(had, tracks.support[match] if len(tracks) else 0.0, 0.0)
    looked = np.zeros(len(found), dtype=bool)
    if elapsed > 0 and not had.all():
        looked[~had] = seen_by(transform_boxes(boxes[~had], invert_rigid(memory.world_from_lidar)), memory.cameras)
    log_odds = seen_log_odds(seen.log_odds, support, looked, classes.seen_weight[found.labels], elapsed)

    updated = _updated(tracks, seen, found, time, classes)
    kept = _refined(found, updated, seen, moment.world_from_lidar, classes)
    known = updated.joined(_begun(seen, found, time, memory.next_id, classes))
    own = _track_of_detection(match, len(tracks))
    missed = np.setdiff1d(np.arange(len(tracks)), match)
    predicted, scores = _predicted(missed, updated, fused, moment, memory)
    result = _assemble(fused, kept, log_odds, seen.log_odds, own, known, predicted, scores, moment)
    begun = int((~had).sum())
    bounded = _bounded(known, time, memory.config)
    return replace(
        memory,
        tracks=bounded,
        time_s=time,
        world_from_lidar=moment.world_from_lidar,
        ego_velocity=moment.ego_velocity,
        cameras=moment.cameras,
        next_id=memory.next_id + begun,
    ), result


def _track_of_detection(match: IntArray, n_tracks: int) -> IntArray:
    """(N,) row of each detection's track once the new ones are joined to the ``n_tracks`` old ones."""
    own = match.copy()
    new = match < 0
    own[new] = n_tracks + np.arange(int(new.sum()))
    return own


def _updated(tracks: Tracks, seen: _Seen, found: Detections3D, time: float, classes: ClassColumns) -> Tracks:
    """The tracks with what the frame saw of them."""
    rows = np.flatnonzero(seen.match >= 0)
    if not len(rows):
        return tracks
    own = seen.match[rows]
    old, boxes, log_odds = tracks[own], seen.boxes[rows], seen.log_odds[rows]
    new = measured(old, boxes, seen.distances[rows], classes.motion)
    sizes, weights = averaged_sizes(old.sizes, old.size_weights, boxes[:, 3:6], log_odds)
    bottoms = steadied_bottoms(old.bottoms, boxes[:, Z] - boxes[:, HEIGHT] / 2, time - old.seen)
    new = replace(
        new,
        bottoms=bottoms,
        sizes=sizes,
        size_weights=weights,
        last_support=frame_support(log_odds),
        hits=old.hits + 1,
        seen=np.full(len(rows), time),
    )
    return tracks.updated(own, new)


def _begun(seen: _Seen, found: Detections3D, time: float, next_id: int, classes: ClassColumns) -> Tracks:
    """Tracks of the detections that belong to none."""
    rows = np.flatnonzero(seen.match < 0)
    n, boxes, labels, distances = len(rows), seen.boxes[rows], found.labels[rows], seen.distances[rows]
    return Tracks(
        ids=next_id + np.arange(n),
        labels=labels,
        positions=boxes[:, :2],
        velocities=np.zeros((n, 2)),
        position_cov=first_position_cov(distances, labels, classes.motion),
        yaws=boxes[:, YAW],
        yaw_rates=np.zeros(n),
        yaw_cov=first_yaw_cov(distances),
        bottoms=boxes[:, Z] - boxes[:, HEIGHT] / 2,
        sizes=boxes[:, 3:6],
        size_weights=size_weight(seen.log_odds[rows]),
        support=np.zeros(n),
        last_support=frame_support(seen.log_odds[rows]),
        hits=np.ones(n, dtype=np.int64),
        born=np.full(n, time),
        seen=np.full(n, time),
    )


def _refined(
    found: Detections3D, tracks: Tracks, seen: _Seen, world_from_lidar: FloatArray, classes: ClassColumns
) -> FloatArray:
    """(N, 7) the detections' boxes in the LiDAR frame, those of rigid objects made better by their tracks."""
    boxes = np.array(found.boxes)
    rows = np.flatnonzero((seen.match >= 0) & classes.rigid[found.labels])
    if not len(rows):
        return boxes
    own = tracks[seen.match[rows]]
    in_lidar = transform_boxes(own.boxes, invert_rigid(world_from_lidar))
    better = resized(boxes[rows], own.sizes)
    better[:, Z] = in_lidar[:, Z]
    better[:, :2] += POSITION_SHARE * (in_lidar[:, :2] - boxes[rows, :2])
    boxes[rows] = better
    return boxes


def _predicted(
    missed: IntArray,
    tracks: Tracks,
    fused: FusedDetections,
    moment: Moment,
    memory: Memory,
) -> tuple[IntArray, FloatArray]:
    """Rows of the tracks for which a box is predicted, and the boxes' log-odds."""
    config, classes, found = memory.config, memory.classes, fused.detections
    chosen = missed[tracks.hits[missed] >= config.min_hits]
    # nothing that is seen there can lift a box by more than HIDDEN and CAMERA
    labels = tracks.labels[chosen]
    best = classes.missed_weight[labels] * tracks.support[chosen] - classes.base[labels] + HIDDEN + CAMERA
    chosen = chosen[best > config.min_log_odds]
    if not config.predict or not len(chosen):
        return chosen[:0], np.zeros(0)
    boxes = transform_boxes(tracks[chosen].boxes, invert_rigid(moment.world_from_lidar))
    there = seen_by(boxes, moment.cameras)
    if len(found):
        there &= bev_iou(boxes, found.boxes).max(axis=1) < DUPLICATE_IOU
    chosen, boxes = chosen[there], boxes[there]
    labels = tracks.labels[chosen]
    sure = found.boxes[to_log_odds(found.scores) > SURE_LOG_ODDS]
    free = np.zeros(len(chosen))
    if config.free_space and len(chosen) and moment.frame.points is not None:
        free = free_share(boxes, moment.frame.points)
    log_odds = missed_log_odds(
        tracks.support[chosen],
        hidden_share(boxes, sure, moment.cameras),
        free_camera_scores(boxes, labels, fused, moment.cameras),
        free,
        classes.missed_weight[labels],
        classes.base[labels],
    )
    good = log_odds > config.min_log_odds
    return chosen[good], log_odds[good]


def _assemble(
    fused: FusedDetections,
    boxes: FloatArray,
    log_odds: FloatArray,
    alone: FloatArray,
    own: IntArray,
    tracks: Tracks,
    predicted: IntArray,
    predicted_log_odds: FloatArray,
    moment: Moment,
) -> FusedDetections:
    """Detections and predicted boxes, highest score first, with the table of their tracks."""
    found = fused.detections
    lidar_from_world = invert_rigid(moment.world_from_lidar)
    rows = np.concatenate([own, predicted])
    of = tracks[rows]
    n = len(found)
    velocities = of.velocities @ lidar_from_world[:2, :2].T
    velocities[of.hits < 2] = np.nan
    if found.velocities is not None:
        given = np.isfinite(found.velocities).all(axis=1)
        velocities[:n][given] = found.velocities[given]
    extra = transform_boxes(tracks[predicted].boxes, lidar_from_world)
    attributes = None
    if found.attributes is not None:
        attributes = np.concatenate([found.attributes, np.full(len(predicted), "")])
    # the log-odds are bounded, so a score that the memory leaves alone is taken as it was
    scores = np.where(log_odds == alone, found.scores, to_probability(log_odds))
    detections = Detections3D(
        np.concatenate([boxes, extra]),
        np.concatenate([scores, to_probability(predicted_log_odds)]),
        of.labels,
        found.class_names,
        velocities,
        attributes,
    )
    order = np.lexsort((*detections.boxes.T[::-1], -detections.scores))
    table = TrackTable(
        ids=of.ids,
        ages_s=moment.time_s - of.born,
        hits=of.hits,
        unseen_s=moment.time_s - of.seen,
        support=of.support,
        log_odds=np.concatenate([log_odds - alone, predicted_log_odds]),
    )
    return fused.reordered(detections[order], order, table[order])


def _bounded(tracks: Tracks, time: float, config: MemoryConfig) -> Tracks:
    """The tracks worth keeping: seen within the horizon, at most as many as the settings allow."""
    tracks = tracks[time - tracks.seen <= config.horizon_s]
    if len(tracks) <= config.max_tracks:
        return tracks
    order = np.lexsort((-(tracks.support + tracks.last_support), time - tracks.seen))
    return tracks[np.sort(order[: config.max_tracks])]
