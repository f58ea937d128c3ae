"""The last second as a witness: what recent frames saw, added to the fused detections of the present one.

`remember` is the optional last stage of the fusion. It is pure: the state goes in and the next one comes out, and a
frame's result depends on nothing else. The steps, each a module of its own:

    tracks move on                (`memory_motion`: constant velocity and turn rate)
    detections find their track   (`memory_association`: one to one, gated by the filter's uncertainty)
    the past adds its evidence    (`memory_evidence`: log-odds that add up)
    boxes gain from their track   (`memory_shape`: sizes, heights, positions)
    what the frame misses         (`memory_prediction`: predicted, and confirmed or refuted by what is seen there)
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from dataclasses import replace

import numpy as np

from lcf3d.errors import ConfigError
from lcf3d.frame import Frame
from lcf3d.fusion.memory_config import MemoryConfig
from lcf3d.fusion.memory_ego import FIRST_ODOMETRY, estimate_pose, stretched
from lcf3d.fusion.memory_state import Memory, Moment, Tracks
from lcf3d.fusion.memory_step import aged, step
from lcf3d.geometry.rotation import invert_rigid
from lcf3d.provenance import FusedDetections
from lcf3d.structures import FloatArray

# a sensor that seems to move faster than this between frames has jumped, m/s and rad/s
MAX_EGO_SPEED = 70.0
MAX_EGO_TURN = 3.0


def remember(
    memory: Memory | None, fused: FusedDetections, frame: Frame, config: MemoryConfig
) -> tuple[Memory | None, FusedDetections]:
    """One frame's fused detections with what the memory adds, and the memory after it.

    A frame without a time is judged alone: it comes back as it is. So do the boxes of the first frame of a sequence,
    and of the first after a gap, a step back in time or a jump of the pose, with which the memory begins anew; a note
    tells. Where a frame has no pose, the sensor's motion is estimated from the objects (`memory_ego`).

    Args:
        memory: after the frame before; None at the beginning.
        fused: the frame's detections; scores are probabilities.
        frame: gives time, pose, cameras and, for the test of free space, the scan.
        config: settings.

    Raises:
        ConfigError: the memory is of other classes, or scores are no probabilities.
    """
    detections = fused.detections
    if frame.timestamp is None:
        return memory, fused
    if memory is not None and not memory.fits(detections.class_names, config):
        raise ConfigError(
            f"frame {frame.id} has classes {list(detections.class_names)} and the memory is of "
            f"{list(memory.class_names)}, or their settings differ; begin a new memory for another configuration"
        )
    if len(detections) and not (detections.scores.min() >= 0 and detections.scores.max() <= 1):
        raise ConfigError(
            f"frame {frame.id} has scores from {detections.scores.min():.4g} to {detections.scores.max():.4g}; memory "
            "adds log-odds and needs probabilities: choose ensemble evidence or probabilistic"
        )
    if memory is not None and (frame.timestamp, frame.sequence) == (memory.time_s, memory.sequence):
        note = f"the memory has seen a frame of time {frame.timestamp:.3f} s already: this one was judged alone"
        return memory, replace(fused, notes=(*fused.notes, note))
    cameras = tuple(camera for camera in frame.cameras if camera.name in fused.camera_names)
    broken = None if memory is None else _discontinuity(memory, frame, config)
    if broken is not None:
        fused = replace(fused, notes=(*fused.notes, broken))
    if memory is None or broken is not None:
        memory = Memory(
            tracks=Tracks.empty(),
            time_s=frame.timestamp,
            world_from_lidar=np.eye(4),
            lidar_from_world=np.eye(4),
            world_from_dataset=None if frame.world_from_lidar is None else invert_rigid(frame.world_from_lidar),
            odometry=FIRST_ODOMETRY,
            ego_velocity=None,
            cameras=cameras,
            next_id=0 if memory is None else memory.next_id,
            class_names=detections.class_names,
            sequence=frame.sequence,
            config=config,
            classes=config.columns(detections.class_names),
        )
        return step(memory, memory.tracks, fused, Moment(frame, frame.timestamp, np.eye(4), None, cameras))
    elapsed = frame.timestamp - memory.time_s
    tracks = aged(memory, elapsed)
    pose, velocity = _given_pose(memory, frame), None
    if pose is not None:
        pose = stretched(pose, memory.world_from_lidar, memory.odometry.scale)
    else:
        note = "no pose that joins the frame before: the memory estimated the sensor's motion from the objects"
        fused = replace(fused, notes=(*fused.notes, note))
        pose, velocity = estimate_pose(
            tracks, detections.boxes, detections.labels, memory.world_from_lidar, memory.ego_velocity, elapsed
        )
    return step(memory, tracks, fused, Moment(frame, frame.timestamp, pose, velocity, cameras))


def _given_pose(memory: Memory, frame: Frame) -> FloatArray | None:
    """(4, 4) pose of the LiDAR in the memory's world; None where this frame, or the one before, has none."""
    if memory.world_from_dataset is None or frame.world_from_lidar is None:
        return None
    pose: FloatArray = memory.world_from_dataset @ frame.world_from_lidar
    return pose


def remember_sequence(
    frames: Iterable[tuple[Frame, FusedDetections]], config: MemoryConfig | None = None
) -> Iterator[FusedDetections]:
    """The frames of one sequence, in order of time, each with what the ones before it add; see `remember`."""
    memory: Memory | None = None
    settings = config or MemoryConfig()
    for frame, fused in frames:
        memory, remembered = remember(memory, fused, frame, settings)
        yield remembered


def _discontinuity(memory: Memory, frame: Frame, config: MemoryConfig) -> str | None:
    """Why the memory does not reach to this frame, in a sentence; None where it does."""
    assert frame.timestamp is not None
    if frame.sequence != memory.sequence:
        return (
            f"the frame before was of drive {memory.sequence}, this one is of {frame.sequence}: the memory began anew"
        )
    elapsed = frame.timestamp - memory.time_s
    if elapsed < 0:
        return f"time went back by {-elapsed:.3f} s: the memory began anew"
    if elapsed > config.max_gap_s:
        return f"no frame for {elapsed:.2f} s: the memory began anew"
    pose = _given_pose(memory, frame)
    if pose is None:
        return None
    moved = (memory.lidar_from_world @ pose).tolist()
    speed = math.hypot(moved[0][3], moved[1][3], moved[2][3]) / elapsed
    cosine = (moved[0][0] + moved[1][1] + moved[2][2] - 1) / 2
    turn = math.acos(min(max(cosine, -1.0), 1.0)) / elapsed
    if speed > MAX_EGO_SPEED or turn > MAX_EGO_TURN:
        return f"the pose jumped ({speed:.0f} m/s, {np.degrees(turn):.0f} degrees/s): the memory began anew"
    return None
