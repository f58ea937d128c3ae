"""The facade: late-cascade fusion of one frame, to be read beside figure 2 of the paper."""

from __future__ import annotations

import logging
from collections import defaultdict
from collections.abc import Collection, Mapping, Sequence
from functools import cached_property, partial

import numpy as np

from lcf3d import plugins
from lcf3d.frame import Frame
from lcf3d.fusion.branches import Branches, by_camera_name, prepare_branches
from lcf3d.fusion.calibration import Calibration
from lcf3d.fusion.cluster_evidence import ClusterEvidence, evidence_of, fused_scores, gather_evidence, recovered_trust
from lcf3d.fusion.clustering import Clusters, cluster_boxes
from lcf3d.fusion.config import FusionConfig
from lcf3d.fusion.decisions import (
    ClusterDecisions,
    assemble,
    choose_representatives,
    decide_clusters,
    settle_doubles,
)
from lcf3d.fusion.localizer import Localizer
from lcf3d.fusion.matching import Matches, View, boxes_after, confirmed_elsewhere, match_view, merge_views
from lcf3d.fusion.recovery import NOTHING, Recovery, recover
from lcf3d.fusion.roles import unknown_classes
from lcf3d.fusion.warm_up import warm_up_frame
from lcf3d.provenance import FusedDetections
from lcf3d.reasons import Outcome, Reason
from lcf3d.structures import BoolArray, Detections2D, Detections3D, FloatArray, IntArray

log = logging.getLogger(__name__)


class LateCascadeFusion:
    """Camera and LiDAR detections in, better 3D detections out (paper section 4.1).

    Args:
        config: settings; the defaults of `FusionConfig` if not given.
        localizer: puts boxes into frustums; the geometric one if not given.
        calibration: what the detectors' scores mean, see `lcf3d.fusion.calibration`; scores are taken as they are if
            not given, and must then lie in [0, 1].
        reports: the classes that the detector of each camera can report; cameras left out can report all. A box of
            another class is not judged by a camera: not seeing it there means nothing.

    Example:
        >>> fusion = LateCascadeFusion(FusionConfig.preset("kitti"))  # doctest: +SKIP
        >>> fused = fusion(frame, lidar_detections, {"left": camera_detections})  # doctest: +SKIP
        >>> print(fused.explain(0))  # doctest: +SKIP
    """

    def __init__(
        self,
        config: FusionConfig | None = None,
        localizer: Localizer | None = None,
        calibration: Calibration | None = None,
        reports: Mapping[str, Collection[str]] | None = None,
    ) -> None:
        self.config = config or FusionConfig()
        # a camera that can report all classes is one of which nothing is known
        names = set(self.config.class_names)
        self.reports = {camera: classes for camera, classes in (reports or {}).items() if names - set(classes)}
        unknown = unknown_classes(self.config.class_names)
        if unknown and self.config.ensemble == "evidence":
            log.warning("classes %s are unknown, treated as 'other'; give them weights with evidence", unknown)
        self.calibration = calibration or Calibration()
        self.localizer: Localizer = localizer or plugins.load("lcf3d.localizers", "geometric")()

    def warm_up(self) -> None:
        """Compile and load everything that the first frame would wait for, on a made-up frame."""
        frame, lidar, camera = warm_up_frame(self.config.class_names)
        self(frame, lidar, camera)

    def __call__(
        self, frame: Frame, lidar: Detections3D, camera: Mapping[str, Detections2D] | Detections2D
    ) -> FusedDetections:
        """Fuse the detections of one frame.

        Args:
            frame: cameras and, for recovery, the scan.
            lidar: 3D detections in the LiDAR frame, best without non-maximum suppression.
            camera: 2D detections by camera name; a camera that is left out was not looked through, which is not the
                same as one without detections. Those of a frame with a single camera may come without its name.

        Raises:
            ConfigError: scores outside [0, 1], an unknown camera, or class lists that share no name.
        """
        camera = by_camera_name(frame, camera)
        branches = self._prepare(frame, lidar, camera)  # figure 2 (a), (b)
        clusters, views, matches = self._match(branches)  # (c) bounding box matching
        decisions = self._decide(branches, clusters, views, matches)  # (e) semantic fusion
        recovery, notes = self._recover(frame, branches, clusters, views, matches, decisions)  # (d) detection recovery
        decisions, recovery = settle_doubles(decisions, branches.lidar, recovery, self.config.duplicate_iou)
        given = tuple(camera[view.name] for view in branches.cameras)
        return assemble(branches, clusters, views, matches, decisions, recovery, notes, lidar, given)

    def evidence(self, frame: Frame, lidar: Detections3D, camera: Mapping[str, Detections2D]) -> ClusterEvidence:
        """The evidence for every cluster of one frame, ``box`` counted in ``lidar``: what calibration is fitted on.

        Clusters that no camera looks at, that none judges, or that are matched with another class have their ``agreed``
        False.
        """
        branches = self._prepare(frame, lidar, camera)
        clusters, views, matches = self._match(branches)
        box = choose_representatives(branches, clusters, matches, self.config)
        weighed = gather_evidence(
            box, branches, self._judging(branches, views, box), matches, self.config, self.calibration
        )
        used = weighed.agreed & matches.visible & self._detectable(branches, box, views)
        return weighed._replace(box=branches.lidar_index[box], agreed=used)

    def _prepare(self, frame: Frame, lidar: Detections3D, camera: Mapping[str, Detections2D]) -> Branches:
        """Both branches with calibrated scores, thresholded."""
        probable = {name: self.calibration.calibrate_camera(found) for name, found in camera.items()}
        return prepare_branches(frame, self.calibration.calibrate_lidar(lidar), probable, self.config)

    def _detectable(
        self, branches: Branches, boxes: IntArray, views: Sequence[View] = (), camera: str | None = None
    ) -> BoolArray:
        """Which of some LiDAR boxes, one a cluster, are of a class that the camera branch detects at all.

        With ``views``: that some camera which looks at them can report. With ``camera``: that this camera can report.
        """
        labels = branches.lidar.labels[boxes]
        detected: BoolArray = self._detected[labels]
        if not self.reports:
            return detected
        if camera is not None:
            return detected & self._reported[camera][labels]
        judged = [
            view.visible & self._reported[one.name][labels] for view, one in zip(views, branches.cameras, strict=True)
        ]
        return detected & np.any(judged, axis=0) if judged else detected

    def _judging(self, branches: Branches, views: Sequence[View], boxes: IntArray) -> list[View]:
        """The views, each blind to boxes of classes that its camera cannot report."""
        if not self.reports:
            return list(views)
        labels = branches.lidar.labels[boxes]
        return [
            view._replace(visible=view.visible & self._reported[camera.name][labels])
            for view, camera in zip(views, branches.cameras, strict=True)
        ]

    @cached_property
    def _detected(self) -> BoolArray:
        """(classes,) whether the camera branch detects each class at all."""
        return np.array([self.calibration.detects(name) for name in self.config.class_names], dtype=bool)

    @cached_property
    def _reported(self) -> defaultdict[str, BoolArray]:
        """(classes,) by camera, whether its detector can report each class; all where nothing is known."""
        names = self.config.class_names
        known = {camera: np.array([n in of for n in names], dtype=bool) for camera, of in self.reports.items()}
        return defaultdict(partial(np.ones, len(names), dtype=bool), known)

    @cached_property
    def _weights(self) -> FloatArray:
        """(L, 9) by class, see `Evidence.weights`."""
        return np.array([evidence_of(name, self.config, self.calibration).weights for name in self.config.class_names])

    def _decide(
        self, branches: Branches, clusters: Clusters, views: Sequence[View], matches: Matches
    ) -> ClusterDecisions:
        """Semantic fusion (section 4.1.5) of matched clusters, the chosen policy for the others."""
        box = choose_representatives(branches, clusters, matches, self.config)
        scores = None
        if self.config.ensemble == "evidence":
            weighed = gather_evidence(
                box, branches, self._judging(branches, views, box), matches, self.config, self.calibration
            )
            scores = fused_scores(weighed, self._weights)
        return decide_clusters(box, branches, matches, self.config, self._detectable(branches, box, views), scores)

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
                boxes_after(lidar, camera.delay),
                clusters,
                camera,
                found.boxes,
                iou_threshold=config.match_iou,
                method="paper" if config.assignment == "paper" else "gated",
                rounds=self._rounds(branches, clusters, found, camera.name),
            )
            for camera, found in zip(branches.cameras, branches.camera, strict=True)
        ]
        return clusters, views, merge_views(views, len(clusters))

    def _rounds(self, branches: Branches, clusters: Clusters, found: Detections2D, camera: str) -> list[BoolArray]:
        """Which pairs of clusters and 2D detections may match, by round of assignment; empty for all at once.

        Clusters of a class that the camera branch does not detect match nothing. With ``class_first`` pairs of equal
        class go first; of the others only decisive detections, which may change a label.
        """
        boxes = clusters.representative
        judged = self._detectable(branches, boxes, camera=camera)[:, None]
        if self.config.assignment != "class_first":
            return [] if judged.all() else [np.repeat(judged, len(found), axis=1)]
        equal = branches.lidar.labels[boxes][:, None] == found.labels[None]
        decisive = found.scores > self.config.decisive_score
        return [equal & judged, judged & decisive[None]]

    def _recover(
        self,
        frame: Frame,
        branches: Branches,
        clusters: Clusters,
        views: Sequence[View],
        matches: Matches,
        decisions: ClusterDecisions,
    ) -> tuple[Recovery, list[str]]:
        """Detection recovery (section 4.1.4) of the 2D detections that nothing matched."""
        config = self.config
        candidates = []
        for c, (view, found) in enumerate(zip(views, branches.camera, strict=True)):
            unmatched = np.ones(len(found), dtype=bool)
            unmatched[view.match[view.match >= 0]] = False
            free = unmatched.nonzero()[0]
            if len(views) > 1:
                elsewhere = confirmed_elsewhere(views, matches, clusters, found.boxes[free], c, config.elsewhere_iou)
                self._mark(branches, c, free[elsewhere], Reason.SEEN_ELSEWHERE.value)
                free = free[~elsewhere]
            candidates.append(free)
        notes: list[str] = []
        points = None
        if config.recovery and any(len(c) for c in candidates):
            points = frame.points
            if points is None:
                notes.append("there is no scan: unmatched camera detections could not be recovered")
        if points is None:
            reason = Reason.NO_SCAN.value if config.recovery else Reason.NO_RECOVERY.value
            for c, free in enumerate(candidates):
                self._mark(branches, c, free[branches.camera[c].scores[free] > config.decisive_score], reason)
            return NOTHING, notes
        # one bad value spoils the sum, which takes a fifth of the time of a look at every value
        bad = 0 if np.isfinite(points.sum()) else int((~np.isfinite(points[:, :3]).all(axis=1)).sum())
        if bad:
            notes.append(f"{bad} points of the scan are not finite and were not used")
        candidates, pairs = self._choose_candidates(branches, candidates)
        recovery = recover(
            points,
            branches.cameras,
            branches.camera,
            candidates,
            self._confirmed(branches, decisions),
            self.localizer,
            enlargement=config.enlargement,
            min_points=config.min_points,
            mask_mode=config.mask_mode,
            confirm_iou=config.confirm_iou,
            duplicate_iou=config.duplicate_iou,
            min_quality=config.min_quality,
            pairs=pairs,
        )
        return self._trust_recovered(recovery), notes

    def _choose_candidates(self, branches: Branches, free: list[IntArray]) -> tuple[list[IntArray], IntArray | None]:
        """For each camera the decisive ones of the 2D detections that show nothing confirmed; and pairs of views."""
        decisive = [found.scores > self.config.decisive_score for found in branches.camera]
        return [f[good[f]] for f, good in zip(free, decisive, strict=True)], None

    def _trust_recovered(self, recovery: Recovery) -> Recovery:
        """Scores of recovered boxes as probabilities, where those of the others are: see `Evidence`."""
        if self.config.ensemble != "evidence":
            return recovery
        trust = recovered_trust(self.config, self.calibration)
        return recovery._replace(scores=recovery.scores * trust[recovery.labels])

    def _confirmed(self, branches: Branches, decisions: ClusterDecisions) -> FloatArray:
        """Boxes that a recovered one may not double: matched ones, and those kept where no camera looks."""
        lasting = (decisions.outcome == Outcome.MATCHED.value) | (
            (decisions.outcome == Outcome.KEPT.value) & (decisions.reason == Reason.OUT_OF_VIEW.value)
        )
        boxes: FloatArray = branches.lidar.boxes[decisions.box[lasting]]
        return boxes

    @staticmethod
    def _mark(branches: Branches, camera: int, detections: IntArray, reason: int) -> None:
        """Write down why 2D detections of a camera are dropped."""
        rows = branches.camera_start[camera] + branches.camera_index[camera][detections]
        branches.camera_table.reason[rows] = reason
