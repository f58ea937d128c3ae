"""How the frames of a bag stand to each other: what ``/tf`` and ``/tf_static`` say."""

from __future__ import annotations

import logging
from bisect import bisect_left

import numpy as np

from lcf3d.errors import DatasetError
from lcf3d.geometry.rotation import interpolated, invert_rigid
from lcf3d.structures import FloatArray

log = logging.getLogger(__name__)

STALE_S = 0.5
"""Transforms that move are not used at moments farther from them than this."""


class TransformTree:
    """Frames with their parents; those that move are interpolated in time."""

    def __init__(self) -> None:
        self._parents: dict[str, str] = {}
        self._left_out: set[tuple[str, str]] = set()
        self._static: dict[str, FloatArray] = {}
        self._times: dict[str, list[float]] = {}
        self._poses: dict[str, list[FloatArray]] = {}

    def add(self, parent: str, child: str, parent_from_child: FloatArray, time: float | None) -> None:
        """Take in a transform, of a moment or (None) for good.

        A frame has one parent, the first that is heard of: two localizations (``odom`` and ``map`` both above
        ``base_link``) are two drives, whose poses must not be mixed. What is left out is said once a frame.
        """
        parent, child = parent.lstrip("/"), child.lstrip("/")
        first = self._parents.setdefault(child, parent)
        if parent != first:
            if (child, parent) not in self._left_out:
                self._left_out.add((child, parent))
                log.warning("frame %s hangs below %s and below %s; only the first is used", child, first, parent)
            return
        if time is None:
            self._static[child] = parent_from_child
            return
        times, poses = self._times.setdefault(child, []), self._poses.setdefault(child, [])
        place = bisect_left(times, time)
        if place < len(times) and times[place] == time:
            return
        times.insert(place, time)
        poses.insert(place, parent_from_child)

    def frames(self) -> set[str]:
        """Names of all frames."""
        return {*self._parents, *self._parents.values()}

    def root(self, frame: str) -> str:
        """The frame that is the parent of all others of its tree."""
        seen = [frame.lstrip("/")]
        while seen[-1] in self._parents:
            seen.append(self._parents[seen[-1]])
            if seen[-1] in seen[:-1]:
                raise DatasetError(f"the transforms go round in a circle: {' -> '.join(seen)}")
        return seen[-1]

    def moves(self, frame: str) -> bool:
        """Whether a frame moves against its root."""
        name = frame.lstrip("/")
        while name in self._parents:
            if name not in self._static and len(self._times.get(name, ())) > 1:
                return True
            name = self._parents[name]
        return False

    def root_from(self, frame: str, time: float) -> FloatArray:
        """(4, 4) coordinates of the root from those of a frame at a moment.

        Raises:
            DatasetError: a transform that moves is not known near that moment.
        """
        self.root(frame)
        name, pose = frame.lstrip("/"), np.eye(4)
        while name in self._parents:
            pose = self._edge(name, time) @ pose
            name = self._parents[name]
        return pose

    def lookup(self, target: str, target_time: float, source: str, source_time: float) -> FloatArray:
        """(4, 4) ``target`` at one moment from ``source`` at another, through a root that does not move.

        Raises:
            DatasetError: they are not connected.
        """
        if self.root(target) != self.root(source):
            known = ", ".join(sorted(self.frames())) or "none"
            raise DatasetError(f"no transform leads from frame {source!r} to {target!r}; frames of the bag: {known}")
        if not (self.moves(target) or self.moves(source)):
            target_time = source_time
        return np.asarray(invert_rigid(self.root_from(target, target_time)) @ self.root_from(source, source_time))

    def _edge(self, child: str, time: float) -> FloatArray:
        if child in self._static:
            return self._static[child]
        times, poses = self._times[child], self._poses[child]
        if len(times) == 1:
            return poses[0]
        place = min(max(bisect_left(times, time), 1), len(times) - 1)
        before, after = times[place - 1], times[place]
        if time < times[0] - STALE_S or time > times[-1] + STALE_S or min(time - before, after - time) > STALE_S:
            raise DatasetError(
                f"frame {child!r} has no transform within {STALE_S} s of {time:.3f} s; it has those of "
                f"{times[0]:.3f} to {times[-1]:.3f} s"
            )
        return interpolated(poses[place - 1], poses[place], (time - before) / (after - before))
