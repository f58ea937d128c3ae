import numpy as np
import pytest

from lcf3d import FusionConfig, Lcf3dError
from lcf3d.evaluation.calibration_study import CalibrationStudy, open_study
from lcf3d.run.setup import RunRequest
from lcf3d.structures import Detections3D
from tests.evaluation.drive import CAR, CYCLIST, write_drive

CONFIG = FusionConfig.preset("kitti")


@pytest.fixture(scope="module")
def study(tmp_path_factory):
    root = tmp_path_factory.mktemp("drive")
    lidar, camera = write_drive(root, 60)
    return open_study(
        RunRequest(f"kitti:{root}", f"results:{lidar}", {"*": f"results:{camera}"}, "val", config="kitti"), folds=3
    )


@pytest.fixture(scope="module")
def calibration(study):
    return study.fit()


def test_detections_are_judged_by_the_official_protocol(study):
    lidar = study.lidar
    assert len(lidar.scores) == 60 * 7
    assert lidar.judged.all()
    assert lidar.right[lidar.labels == CAR].sum() == 3 * 60
    assert lidar.right[lidar.labels == CYCLIST].sum() == 60
    assert study.camera.right.sum() == 3 * 60
    assert study.camera_classes == ("Car",)


def test_the_camera_is_believed_where_it_is_right(study, calibration):
    cars = calibration.evidence["Car"]
    assert cars.support[-1] > 2
    assert "Cyclist" not in calibration.evidence
    assert set(calibration.lidar) == {"Car", "Cyclist"}
    assert calibration.ground_z == pytest.approx(-1.65, abs=1e-3)
    # the camera was right every time: a map needs mistakes too
    assert calibration.camera == {}


def test_cross_validation_reports_what_fusion_brings(study, calibration):
    car, cyclist = study.cross_validate(calibration)
    assert (car.class_name, cyclist.class_name) == ("Car", "Cyclist")
    assert car.lidar_count == 5 * 60
    assert np.isnan(car.log_loss_before)  # logits are no probabilities
    assert car.log_loss_fused < car.log_loss_lidar < np.log(2)
    assert car.after[1] > car.before[1] + 5
    assert car.after[1] > 95
    # the camera knows no cyclists: their order is the LiDAR detector's in every fold
    assert cyclist.after == pytest.approx(cyclist.before, abs=1e-9)
    assert np.isnan(cyclist.log_loss_fused)


def test_fits_are_deterministic(study, calibration):
    assert study.fit() == calibration


def test_other_frames_only(study, calibration):
    half = study.fit(study.folds != 0, like=calibration)
    assert half.source == "40 labelled frames"
    assert half.lidar["Car"].kind == calibration.lidar["Car"].kind
    assert half.lidar["Car"] != calibration.lidar["Car"]


def test_results_without_3d_boxes_are_refused(study):
    empty = [Detections3D.empty(CONFIG.class_names)] * 60
    with pytest.raises(Lcf3dError, match="no 3D boxes"):
        CalibrationStudy(study.frames, study.evaluation, empty, study.camera_inputs, CONFIG, study.folds)


@pytest.mark.real
@pytest.mark.parametrize(
    ("folder", "lidar", "camera", "folds", "gains"),
    [
        ("kitti", "point_gnn", "rcnn_2d", 3, {"Car": (0, 1.0, 0.5)}),
        (
            "kitti_tracking",
            "pointrcnn",
            "rrc_2d",
            5,
            {"Car": (0, 0, 0), "Pedestrian": (0, 20, 0), "Cyclist": (-0.5,) * 3},
        ),
    ],
)
def test_the_default_never_loses(shared, folder, lidar, camera, folds, gains):
    root = shared / "data" / folder
    lidar, camera = (f"results:{root / 'results' / name}" for name in (lidar, camera))
    real = open_study(RunRequest(f"kitti:{root}", lidar, {"*": camera}, "val"), folds)
    reports = {r.class_name: r for r in real.cross_validate(real.fit())}
    assert set(reports) == set(gains)
    for name, least in gains.items():
        assert (np.subtract(reports[name].after, reports[name].before) >= least).all(), reports[name]
