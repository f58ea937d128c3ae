from types import SimpleNamespace

import numpy as np
import pytest

from lcf3d import FusionConfig
from lcf3d.cli.ablate import ablation_table
from lcf3d.errors import ConfigError
from lcf3d.evaluation.ablation import MODULES, AblationInput, ablate, suppressed, variants
from lcf3d.evaluation.bootstrap import Interval
from lcf3d.evaluation.calibration_study import open_study
from lcf3d.fusion.self_calibration import self_calibrate
from lcf3d.run.setup import RunRequest
from lcf3d.structures import KITTI_CLASSES, Detections3D
from tests.evaluation.drive import write_drive

CONFIG = FusionConfig.preset("kitti")


@pytest.fixture(scope="module")
def rows(tmp_path_factory):
    root = tmp_path_factory.mktemp("drive")
    lidar, camera = write_drive(root, 30)
    study = open_study(
        RunRequest(f"kitti:{root}", f"results:{lidar}", {"*": f"results:{camera}"}, "val", config="kitti"), folds=0
    )
    inputs = [AblationInput(*i) for i in zip(study.frames, study.lidar_inputs, study.camera_inputs, strict=True)]
    calibration = self_calibrate(inputs, CONFIG)
    measured = ablate(inputs, study.evaluation, CONFIG, calibration, samples=50)
    return {(row.group, row.name): row for row in measured}


def test_lidar_alone_and_the_filter(rows):
    alone = rows[MODULES, "none: LiDAR alone"]
    assert (alone.matched, alone.recovered, alone.kept) == (0, 0, 0)
    matching = rows[MODULES, "matching"]
    # three cars a frame match; the two boxes of a class that the camera does not know are kept
    assert (matching.matched, matching.kept) == (3 * 30, 2 * 30)
    assert matching.ap["Car"][1] > alone.ap["Car"][1] + 5
    assert matching.ap["Cyclist"] == pytest.approx(alone.ap["Cyclist"])
    assert np.isnan(alone.ap["Pedestrian"]).all()


def test_gains_over_the_lidar_alone_have_intervals(rows):
    alone, matching = rows[MODULES, "none: LiDAR alone"], rows[MODULES, "matching"]
    assert alone.gain["Car"] == Interval(0.0, 0.0, 0.0)
    gain = matching.gain["Car"]
    assert gain.value == pytest.approx(matching.ap["Car"][1] - alone.ap["Car"][1])
    assert 0 < gain.low < gain.value < gain.high
    table = ablation_table(list(rows.values()), SimpleNamespace(heading="AP", columns=("easy",)), 30, False)
    (row,) = (cells for cells in table.rows if cells is not None and cells[0] == "  matching")
    assert f"{gain.value:+.1f} [{gain.low:+.1f}, {gain.high:+.1f}]" in row[1]
    assert any("intervals" in note for note in table.notes)


def test_intervals_are_refused_where_there_are_none():
    with pytest.raises(ConfigError, match="KITTI's evaluation only"):
        ablate([], SimpleNamespace(), CONFIG, samples=10)


def test_policies_differ_in_what_they_keep(rows):
    kept = {name: row.kept for (group, name), row in rows.items() if group == "unmatched clusters"}
    assert kept == {"drop": 2 * 30, "downweight": 4 * 30, "keep": 4 * 30}


def test_rows_that_need_scans_or_masks_are_left_out_without():
    def names(**kwargs):
        return {(v.group, v.name) for v in variants(CONFIG, **kwargs)}

    bare = names(scans=False, masks=True)
    assert not any("recovery" in name for _, name in bare)
    assert all((v.changes or {"recovery": False})["recovery"] is False for v in variants(CONFIG, False, False))
    full = names(scans=True, masks=True)
    assert {n for g, n in full if g == "instance masks"} == {"box", "mask", "box+mask"}
    assert (MODULES, "matching + recovery + semantic") in full
    assert names(scans=True, masks=False) < full


def test_every_variant_is_a_valid_setting():
    for variant in variants(CONFIG, True, True):
        if variant.changes is not None:
            CONFIG.updated(**variant.changes)


def test_json_has_no_nan(rows):
    values = rows[MODULES, "none: LiDAR alone"].to_json()
    assert values["ap"]["Pedestrian"] == [None, None, None]
    assert values["ap"]["Car"][0] > 0


def test_lidar_alone_is_measured_after_suppression_where_that_is_asked():
    boxes = np.array([[10.0, 0, 0, 4, 1.6, 1.5, 0], [10.2, 0, 0, 4, 1.6, 1.5, 0], [30, 0, 0, 4, 1.6, 1.5, 0]])
    found = Detections3D(boxes, np.array([0.4, 0.9, 0.3]), np.zeros(3, np.int64), KITTI_CLASSES)
    kept = suppressed(found)
    np.testing.assert_array_equal(np.sort(kept.scores), [0.3, 0.9])
