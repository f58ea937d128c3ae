"""Late-cascade fusion with stereo pairs (paper section 4.2): each view confirms, both views together recover."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Annotated, Any, Literal, NamedTuple

import numpy as np
from pydantic import Field, model_validator
from typing_extensions import Self

from lcf3d.errors import ConfigError
from lcf3d.frame import Frame
from lcf3d.fusion.branches import Branches
from lcf3d.fusion.clustering import Clusters
from lcf3d.fusion.config import FusionConfig
from lcf3d.fusion.decisions import ClusterDecisions
from lcf3d.fusion.localizer import Localizer
from lcf3d.fusion.matching import Matches, View
from lcf3d.fusion.pipeline import LateCascadeFusion
from lcf3d.fusion.semantic import fuse_scores
from lcf3d.fusion.stereo_pairing import check_not_exchanged, check_stereo_pair, pair_views
from lcf3d.provenance import FusedDetections
from lcf3d.reasons import Reason
from lcf3d.structures import Detections2D, Detections3D, IntArray


class StereoConfig(FusionConfig):
    """Settings of `StereoLateCascadeFusion`: those of `FusionConfig`, with ``match_iou`` 0.5, and four more."""

    match_iou: Annotated[float, Field(ge=0, le=1)] = Field(default=0.5, description="tau_b: image IoU of a match")
    pairs: tuple[tuple[str, str], ...] = Field(
        default=(("left", "right"),), min_length=1, description="stereo pairs of camera names, the left one first"
    )
    epipolar_gate_px: Annotated[float, Field(gt=0)] = Field(
        default=10.0, description="corners farther than that from their epipolar lines, on average, are of two objects"
    )
    check_depth: bool = Field(
        default=True, description="views pair only where disparity and height in the image give a believable size"
    )
    unpaired: Literal["discard", "single_view"] = Field(
        default="single_view",
        description="2D detections that only one view of a pair has: drop, or recover from that view",
    )

    @model_validator(mode="after")
    def _check_pairs(self) -> StereoConfig:
        names = [name for pair in self.pairs for name in pair]
        if len(set(names)) != len(names):
            raise ValueError(f"pairs must name each camera once, got {[list(pair) for pair in self.pairs]}")
        return self

    @classmethod
    def preset(cls, name: str, **changes: Any) -> Self:
        """The settings of `FusionConfig.preset` with the stereo values; ``paper`` discards and checks no depth.

        Raises:
            ConfigError: there is no such preset, or a change makes no sense.
        """
        own: dict[str, Any] = {"check_depth": False, "unpaired": "discard"} if name == "paper" else {}
        return super().preset(name, **{**own, **changes})


class _Pair(NamedTuple):
    """A stereo pair of which both cameras are used: their positions among the cameras of the fusion."""

    left: int
    right: int


class StereoLateCascadeFusion(LateCascadeFusion):
    """`LateCascadeFusion` with stereo pairs (paper section 4.2); cameras in no pair are treated as there.

    A LiDAR cluster is confirmed by either view. 2D detections that match nothing are recovered in pairs, one of each
    view, from the points in both frustums. A pair of which one camera has no detections given is a single camera.

    Args:
        config: settings; the defaults of `StereoConfig` if not given.
        localizer: see `LateCascadeFusion`.
        options: what else `LateCascadeFusion` takes.

    Example:
        >>> fusion = StereoLateCascadeFusion(StereoConfig.preset("kitti"))  # doctest: +SKIP
        >>> fused = fusion(frame, lidar, {"left": left_detections, "right": right_detections})  # doctest: +SKIP
    """

    config: StereoConfig

    def __init__(self, config: StereoConfig | None = None, localizer: Localizer | None = None, **options: Any) -> None:
        super().__init__(config or StereoConfig(), localizer, **options)

    def __call__(
        self, frame: Frame, lidar: Detections3D, camera: Mapping[str, Detections2D] | Detections2D
    ) -> FusedDetections:
        """Fuse the detections of one frame; see `LateCascadeFusion.__call__`.

        Raises:
            ConfigError: also for a pair that is not calibrated, has images of different size, or is exchanged.
        """
        fused = super().__call__(frame, lidar, camera)
        table = fused.camera
        second = (table.reason == Reason.OTHER_VIEW.value) & (table.pair >= 0)
        return replace(fused, camera=replace(table, reason=np.where(second, Reason.SECOND_VIEW.value, table.reason)))

    def _prepare(self, frame: Frame, lidar: Detections3D, camera: Mapping[str, Detections2D]) -> Branches:
        """Both branches, the pairs checked, and a note on every pair that is not whole."""
        known = {view.name for view in frame.cameras}
        notes = []
        for left, right in self.config.pairs:
            absent = [name for name in (left, right) if name not in known]
            if len(absent) == 1:
                raise ConfigError(
                    f"frame {frame.id}: stereo pair {left}/{right} needs both cameras calibrated, but there is no "
                    f"calibration of {absent[0]!r}, only of {sorted(known)}; add it or run with one camera"
                )
            if (left in camera) != (right in camera):
                only = left if left in camera else right
                notes.append(f"stereo pair {left}/{right} is not whole: {only} was used as a single camera")
        branches = super()._prepare(frame, lidar, camera)
        for pair in self._pairs(branches):
            views = branches.cameras[pair.left], branches.cameras[pair.right]
            check_stereo_pair(*views)
            found = branches.camera[pair.left], branches.camera[pair.right]
            check_not_exchanged(*views, *found, self.config.epipolar_gate_px)
        return branches._replace(notes=(*branches.notes, *notes))

    def _pairs(self, branches: Branches) -> list[_Pair]:
        """The pairs of which both cameras are used."""
        position = {view.name: c for c, view in enumerate(branches.cameras)}
        return [_Pair(position[a], position[b]) for a, b in self.config.pairs if a in position and b in position]

    def _match(self, branches: Branches) -> tuple[Clusters, list[View], Matches]:
        """Bounding box matching in every view (section 4.2.2); the more confident view of a pair is the primary one."""
        clusters, views, matches = super()._match(branches)
        for pair in self._pairs(branches):
            _prefer_confident_view(pair, branches, views, matches)
        return clusters, views, matches

    def _decide(
        self, branches: Branches, clusters: Clusters, views: Sequence[View], matches: Matches
    ) -> ClusterDecisions:
        """Stereo semantic fusion (section 4.2.4): the second view's score joins where the views' labels agree."""
        decisions = super()._decide(branches, clusters, views, matches)
        for pair in self._pairs(branches):
            self._fuse_second_views(pair, branches, views, matches, decisions)
        return decisions

    def _fuse_second_views(
        self, pair: _Pair, branches: Branches, views: Sequence[View], matches: Matches, decisions: ClusterDecisions
    ) -> None:
        """Multiply in ``s2d / p`` of the second view of clusters matched in both, and note the views as a pair.

        With ``ensemble: evidence`` scores stay: what two views of one detector say is not independent, and the weights
        were fitted for one; with ``none`` no camera changes a score.
        """
        priors = self.config.prior_array()
        for first, second in (pair, _Pair(pair.right, pair.left)):
            both = np.flatnonzero((matches.camera == first) & (views[second].match >= 0))
            other = views[second].match[both]
            rows, other_rows = _rows(branches, first, matches.detection[both]), _rows(branches, second, other)
            table = branches.camera_table
            table.pair[rows], table.pair[other_rows] = other_rows, rows
            branches.lidar_table.pair[branches.lidar_index[decisions.box[both]]] = other_rows
            if self.config.ensemble == "evidence" or self.config.ensemble == "none":
                continue
            found = branches.camera[second]
            agreed = found.labels[other] == decisions.labels[both]
            both, other = both[agreed], other[agreed]
            decisions.scores[both] = fuse_scores(
                decisions.scores[both], found.scores[other], priors[decisions.labels[both]], self.config.ensemble
            )

    def _choose_candidates(self, branches: Branches, free: list[IntArray]) -> tuple[list[IntArray], IntArray]:
        """Candidates with each pair's second view taken out, and the pairs as `recover` wants them (section 4.2.3).

        The more confident detection of a pair comes first and must be decisive. Decisive detections left alone are
        taken out and marked, or stay, as ``unpaired`` says.
        """
        candidates, rows = list(free), [np.zeros((0, 4), dtype=np.int64)]
        decisive = [found.scores > self.config.decisive_score for found in branches.camera]
        for left, right in self._pairs(branches):
            found = branches.camera[left][free[left]], branches.camera[right][free[right]]
            matched = pair_views(
                branches.cameras[left],
                branches.cameras[right],
                *found,
                gate_px=self.config.epipolar_gate_px,
                check_depth=self.config.check_depth,
                decisive_score=self.config.decisive_score,
                method="paper" if self.config.assignment == "paper" else "gated",
            )
            own, other = free[left][matched[:, 0]], free[right][matched[:, 1]]
            left_first = found[0].scores[matched[:, 0]] >= found[1].scores[matched[:, 1]]
            forward = np.stack([np.full(len(own), left), own, np.full(len(own), right), other], axis=1)
            rows.append(np.where(left_first[:, None], forward, forward[:, [2, 3, 0, 1]]))
            for camera, paired, kept in ((left, own, left_first), (right, other, ~left_first)):
                alone = np.setdiff1d(free[camera], paired)
                alone = alone[decisive[camera][alone]]
                if self.config.unpaired == "discard":
                    self._mark(branches, camera, alone, Reason.UNPAIRED.value)
                    alone = alone[:0]
                candidates[camera] = np.sort(np.concatenate([paired[kept], alone]))
        return [c[good[c]] for c, good in zip(candidates, decisive, strict=True)], np.concatenate(rows)


def _rows(branches: Branches, camera: int, detections: IntArray) -> IntArray:
    """Rows of the camera table of some detections of a camera that take part."""
    rows: IntArray = branches.camera_start[camera] + branches.camera_index[camera][detections]
    return rows


def _prefer_confident_view(pair: _Pair, branches: Branches, views: Sequence[View], matches: Matches) -> None:
    """Make the view of higher 2D score the primary match of clusters matched in both views of their primary pair."""
    left, right = views[pair.left].match, views[pair.right].match
    both = np.flatnonzero(np.isin(matches.camera, pair) & (left >= 0) & (right >= 0))
    scores = branches.camera[pair.left].scores[left[both]], branches.camera[pair.right].scores[right[both]]
    for camera, rows in ((pair.left, both[scores[0] >= scores[1]]), (pair.right, both[scores[0] < scores[1]])):
        detection = views[camera].match[rows]
        matches.camera[rows], matches.detection[rows] = camera, detection
        matches.iou[rows] = views[camera].iou[rows, detection]
