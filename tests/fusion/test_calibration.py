import json

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from lcf3d.errors import Lcf3dError
from lcf3d.fusion.calibration import (
    Calibration,
    ScoreMap,
    ground_height,
    load_calibration,
    natural_transform,
    transform_scores,
)
from lcf3d.fusion.evidence import Evidence
from lcf3d.structures import KITTI_CLASSES, Detections2D
from tests.fusion.scenes import CAR, PEDESTRIAN, car, lidar, pedestrian

PLATT = ScoreMap(slope=2.0, intercept=-1.0)
STEPS = ScoreMap(kind="isotonic", transform="log", slope=0.5, points=((0.0, -2.0), (1.0, 0.0), (3.0, 1.0)))


def test_platt_by_hand():
    assert PLATT(np.array([0.5]))[0] == pytest.approx(0.5)
    assert PLATT(np.array([1.0]))[0] == pytest.approx(1 / (1 + np.exp(-1)))


def test_isotonic_by_hand():
    scores = np.expm1([0.5, 2.0, 3.0, 5.0])
    np.testing.assert_allclose(STEPS.log_odds(scores), [-1.0, 0.5, 1.0, 2.0])  # beyond the last point by the slope
    assert STEPS.log_odds(np.array([-np.expm1(1.0)]))[0] == pytest.approx(-2.5)


@given(st.floats(-5, 50), st.floats(-5, 50), st.sampled_from([PLATT, STEPS]))
def test_maps_keep_the_order_and_can_be_undone(a, b, score_map):
    low, high = score_map.log_odds(np.array(sorted((a, b))))
    assert low <= high
    back = score_map.transformed_at(score_map.log_odds(np.array([a])))
    np.testing.assert_allclose(back, transform_scores(np.array([a]), score_map.transform), atol=1e-9)


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"slope": 0.0}, "slope"),
        ({"slope": 1.0, "kind": "isotonic"}, "at least one"),
        ({"slope": 1.0, "points": ((0.0, 1.0),)}, "isotonic"),
        ({"slope": 1.0, "kind": "isotonic", "points": ((0.0, 1.0), (1.0, 0.5))}, "rise"),
    ],
)
def test_senseless_maps(values, message):
    with pytest.raises(ValueError, match=message):
        ScoreMap(**values)


@pytest.mark.parametrize(("scores", "name"), [([0.1, 0.9], "logit"), ([0.5, 90.0], "log"), ([-3.0, 12.0], "identity")])
def test_natural_transforms(scores, name):
    assert natural_transform(np.array(scores)) == name


def test_only_classes_with_a_map_are_changed():
    calibration = Calibration(lidar={"Car": PLATT})
    found = calibration.calibrate_lidar(lidar([car(10), pedestrian(9)], [0.5, 0.5], [CAR, PEDESTRIAN]))
    assert found.scores.tolist() == pytest.approx([0.5, 0.5])
    found = calibration.calibrate_lidar(lidar([car(10), pedestrian(9)], [5.0, 0.25], [CAR, PEDESTRIAN]))
    assert found.scores[0] == pytest.approx(1 / (1 + np.exp(-9)))
    assert found.scores[1] == 0.25
    none = Detections2D.empty(KITTI_CLASSES)
    assert calibration.calibrate_camera(none) is none


def test_files_go_there_and_back(tmp_path):
    calibration = Calibration(
        source="a test",
        lidar={"Car": STEPS},
        camera={"Car": PLATT},
        evidence={"Car": Evidence(miss=0.5)},
        camera_classes=("Car",),
        ground_z=-1.7,
    )
    calibration.dump(tmp_path / "c.json")
    assert Calibration.load(tmp_path / "c.json") == calibration
    assert load_calibration(str(tmp_path / "c.json")) == calibration
    assert load_calibration("none") is None
    assert calibration.detects("Car")
    assert not calibration.detects("Cyclist")
    assert Calibration().detects("Cyclist")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (None, "does not exist"),
        ("{", "not valid JSON"),
        (json.dumps({"version": 2}), "version"),
        (json.dumps({"lidar": {"Car": {"slope": -1}}}), r"lidar\.Car\.slope"),
        (json.dumps({"lidars": {}}), "lidars"),
    ],
)
def test_bad_files_are_one_sentence(tmp_path, text, message):
    path = tmp_path / "c.json"
    if text is not None:
        path.write_text(text)
    with pytest.raises(Lcf3dError, match=message):
        Calibration.load(path)


def test_auto_is_no_file():
    with pytest.raises(Lcf3dError, match="self_calibration"):
        load_calibration("auto")


def test_ground():
    assert ground_height(np.array([-1.6, -1.7, 3.0])) == -1.6
    assert ground_height(np.zeros(0)) is None
