"""The facade: late-cascade fusion of one frame, to be read beside figure 2 of the paper."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from lcf3d.fusion.branches import Branches, prepare_branches
from lcf3d.fusion.clustering import Clusters, cluster_boxes
from lcf3d.fusion.config import FusionConfig
from lcf3d.fusion.matching import Matches, View, confirmed_elsewhere, match_view, merge_views
from lcf3d.fusion.outcome import ClusterOutcome, assemble, decide_clusters, replace_unconfirmed
from lcf3d.fusion.recovery import Recovery, recover
from lcf3d.localizers.base import Localizer
from lcf3d.provenance import FusedDetections, Reason, Stage
from lcf3d.structures import Detections2D, Detections3D, FloatArray, Frame, IntArray


class LateCascadeFusion:
    """Camera and LiDAR detections in, better 3D detections out (paper section 4.1).

    Args:
        config: settings; the defaults of `FusionConfig` if not given.
        localizer: puts boxes into frustums; the geometric one, which needs no weights, if not given.

    Example:
        >>> fusion = LateCascadeFusion(FusionConfig.preset("kitti"))  # doctest: +SKIP
        >>> fused = fusion(frame, lidar_detections, {"left": camera_detections})  # doctest: +SKIP
        >>> print(fused.explain(0))  # doctest: +SKIP
    """

    def __init__(self, config: FusionConfig | None = None, localizer: Localizer | None = None) -> None:
        self.config = config or FusionConfig()
        if localizer is None:
            from lcf3d.localizers.geometric import GeometricLocalizer

            localizer = GeometricLocalizer()
        self.localizer = localizer

    def __call__(self, frame: Frame, lidar: Detections3D, camera: Mapping[str, Detections2D]) -> FusedDetections:
        """Fuse the detections of one frame.

        Args:
            frame: cameras and, for recovery, the scan.
            lidar: 3D detections in the LiDAR frame, best without non-maximum suppression.
            camera: 2D detections by camera name; a camera that is left out was not looked through, which is not the
                same as one without detections.

        Raises:
            ConfigError: scores outside [0, 1], an unknown camera, or class lists that share no name.
        """
        branches = prepare_branches(frame, lidar, camera, self.config)  # figure 2 (a), (b)
        clusters, views, matches = self._match(branches)  # (c) bounding box matching
        outcome = decide_clusters(branches, clusters, matches, self.config)  # (e) semantic fusion
        recovery, notes = self._recover(frame, branches, clusters, views, matches, outcome)  # (d) detection recovery
        outcome = replace_unconfirmed(outcome, branches.lidar, recovery, self.config.duplicate_iou)
        fused = assemble(branches, clusters, views, matches, outcome, recovery, notes)
        return replace(fused, lidar_inputs=lidar)

    def _match(self, branches: Branches) -> tuple[Clusters, list[View], Matches]:
        """Bounding box matching (section 4.1.3): cluster once, match per camera, merge."""
        config, lidar = self.config, branches.lidar
        clusters = cluster_boxes(
            lidar.boxes,
            lidar.scores,
            lidar.labels,
            method=config.clustering,
            iou_threshold=config.cluster_iou,
            class_aware=config.class_aware,
        )
        views = [
            match_view(
                lidar.boxes,
                clusters,
                camera,
                found.boxes,
                iou_threshold=config.match_iou,
                method=config.assignment,
            )
            for camera, found in zip(branches.cameras, branches.camera, strict=True)
        ]
        return clusters, views, merge_views(views, len(clusters))

    def _recover(
        self,
        frame: Frame,
        branches: Branches,
        clusters: Clusters,
        views: Sequence[View],
        matches: Matches,
        outcome: ClusterOutcome,
    ) -> tuple[Recovery, list[str]]:
        """Detection recovery (section 4.1.4) of the 2D detections that nothing matched."""
        config = self.config
        candidates = []
        for c, (view, found) in enumerate(zip(views, branches.camera, strict=True)):
            free = np.setdiff1d(np.arange(len(found)), view.match)
            elsewhere = confirmed_elsewhere(views, matches, clusters, found.boxes[free], c, config.confirm_iou)
            self._mark(branches, c, free[elsewhere], Reason.SEEN_ELSEWHERE)
            candidates.append(free[~elsewhere])
        notes: list[str] = []
        points = None
        if config.recovery and any(len(c) for c in candidates):
            points = frame.points
            if points is None:
                notes.append("there is no scan: unmatched camera detections could not be recovered")
        if points is None:
            reason = Reason.NO_SCAN if config.recovery else Reason.NO_RECOVERY
            for c, free in enumerate(candidates):
                self._mark(branches, c, free, reason)
            candidates = [free[:0] for free in candidates]
            points = np.zeros((0, 4), np.float32)
        elif not np.isfinite(points[:, :3]).all():
            bad = int((~np.isfinite(points[:, :3]).all(axis=1)).sum())
            notes.append(f"{bad} points of the scan are not finite and were not used")
        recovery = recover(
            points,
            branches.cameras,
            branches.camera,
            candidates,
            self._confirmed(branches, outcome),
            self.localizer,
            enlargement=config.enlargement,
            min_points=config.min_points,
            mask_mode=config.mask_mode,
            confirm_iou=config.confirm_iou,
            duplicate_iou=config.duplicate_iou,
        )
        return recovery, notes

    def _confirmed(self, branches: Branches, outcome: ClusterOutcome) -> FloatArray:
        """Boxes that a recovered one may not double: matched ones, and those kept where no camera looks."""
        lasting = (outcome.stage == Stage.MATCHED) | (
            (outcome.stage == Stage.KEPT) & (outcome.reason == Reason.OUT_OF_VIEW)
        )
        boxes: FloatArray = branches.lidar.boxes[outcome.box[lasting]]
        return boxes

    @staticmethod
    def _mark(branches: Branches, camera: int, detections: IntArray, reason: Reason) -> None:
        """Write down why 2D detections of a camera are dropped."""
        rows = branches.camera_start[camera] + branches.camera_index[camera][detections]
        branches.camera_table.reason[rows] = reason
