"""Pillar networks against the original implementations, map by map, with every parameter filled by rule."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial import cKDTree

torch = pytest.importorskip("torch")

from lcf3d.detectors.lidar.centerpoint import CenterPoint  # noqa: E402
from lcf3d.detectors.lidar.detector import to_arrays  # noqa: E402
from lcf3d.detectors.lidar.inputs import map_detections  # noqa: E402
from lcf3d.detectors.lidar.pointpillars import PointPillars  # noqa: E402
from lcf3d.detectors.lidar.presets import PRESETS  # noqa: E402
from lcf3d.detectors.lidar.ssn import SSN  # noqa: E402
from lcf3d.geometry.boxes import canonical_from_mmdet3d  # noqa: E402

pytestmark = pytest.mark.real
DENSE = 1e-4


@pytest.fixture
def run(golden, capture):
    """Run a detector on a model's scan; returns parity data, stage outputs and detections."""

    def run_model(name, detector_class, preset, columns=(0, 1, 2, 3)):
        data = golden(name)
        detector = detector_class.from_state_dict(data.state(), PRESETS[preset])
        network = detector.network
        outputs = capture({"backbone": network.backbone, "neck": network.neck, "bbox_head": network.bbox_head})
        return data, outputs, detector(data.points(columns))

    return run_model


def check_trunk(data, outputs, prefix=""):
    """Scattered pillars, backbone and neck."""
    data.check(f"{prefix}middle_encoder", outputs["backbone.input"][0], DENSE)
    for stage in ("backbone", "neck"):
        for i, value in enumerate(outputs[stage]):
            data.check(f"{prefix}{stage}.{i}", value, DENSE)


def test_pointpillars_kitti(run):
    data, outputs, detections = run("pointpillars_kitti", PointPillars, "pointpillars-kitti")
    check_trunk(data, outputs)
    for i, value in enumerate(outputs["bbox_head"][0]):
        data.check(f"bbox_head.{i}.0", value, DENSE)
    data.check_predictions(detections)


def test_pointpillars_nuscenes(run):
    data, outputs, detections = run("pointpillars_nus", PointPillars, "pointpillars-nuscenes", (0, 1, 2, 4))
    check_trunk(data, outputs, "pts_")
    for level, maps in enumerate(outputs["bbox_head"]):
        for i, value in enumerate(maps):
            data.check(f"pts_bbox_head.{i}.{level}", value, DENSE)
    # nearly all of the original's 500 scores are 1 in float32: its boxes must be among ours before suppression
    assert len(detections) == 500
    config = PRESETS["pointpillars-nuscenes"]
    many = replace(config, suppression=replace(config.suppression, candidates=60000, max_boxes=600000))
    candidates = map_detections(to_arrays(outputs["bbox_head"]), many, 0.9999, "off")
    boxes, scores, labels = data.predictions()
    centers = canonical_from_mmdet3d(boxes)[:, :3]
    near = np.unique(cKDTree(candidates.boxes[:, :3]).query(centers, k=20)[1])
    data.check_contained(candidates[near], boxes, scores, labels, 1e-3)


@pytest.mark.parametrize(("name", "preset"), [("ssn_nus", "ssn-nuscenes"), ("ssn_regnet_nus", "ssn-regnet-nuscenes")])
def test_ssn(run, name, preset):
    data, outputs, detections = run(name, SSN, preset, (0, 1, 2, 4))
    check_trunk(data, outputs, "pts_")
    for i, depth in enumerate((10, 9, 2)):
        # the original flattens every group to (anchor, row, column) and concatenates the groups
        flat = [
            maps[i].reshape(1, -1, depth, *maps[i].shape[2:]).permute(0, 1, 3, 4, 2) for maps in outputs["bbox_head"]
        ]
        data.check(f"pts_bbox_head.{i}.0", torch.cat([x.reshape(1, -1, depth) for x in flat], dim=1), DENSE)
    data.check_predictions(detections)


def test_centerpoint_pillar(run):
    data, outputs, detections = run(
        "centerpoint_pillar02_nus", CenterPoint, "centerpoint-pillar02-nuscenes", (0, 1, 2, 3, 4)
    )
    check_trunk(data, outputs, "pts_")
    for task, maps in enumerate(outputs["bbox_head"]):
        for name, value in maps.items():
            data.check(f"pts_bbox_head.{task}.0.{name}", value, DENSE)
    data.check_predictions(detections)
    assert np.isfinite(detections.velocities).all()
