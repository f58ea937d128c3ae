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


@pytest.fixture(scope="module")
def doubled(tmp_path_factory):
    """The same detections as a LiDAR branch without suppression writes them: each box three times more, less sure."""
    root = tmp_path_factory.mktemp("doubled")
    lidar, camera = write_drive(root, 60)
    for path in lidar.glob("*.txt"):
        lines = [line.split() for line in path.read_text().splitlines()]
        more = [
            " ".join([*f[:11], f"{float(f[11]) + 0.02 * k:.3f}", *f[12:15], f"{float(f[15]) - 0.3 * k:.4f}"])
            for k in range(1, 4)
            for f in lines
        ]
        path.write_text(path.read_text() + "\n".join(more) + "\n")
    request = RunRequest(f"kitti:{root}", f"results:{lidar}", {"*": f"results:{camera}"}, "val", config="kitti")
    return open_study(request, folds=3)


def test_boxes_from_before_suppression_do_not_count_as_wrong(study, calibration, doubled):
    # the fusion passes one box a cluster on, so that is what has to be right
    assert (study.doubles, doubled.doubles) == (0, 3 * 60 * 7)
    assert doubled.lidar.judged.sum() == study.lidar.judged.sum()
    assert doubled.lidar.right.sum() == study.lidar.right.sum()
    fitted = doubled.fit()
    assert (fitted.lidar, fitted.ground_z) == (calibration.lidar, calibration.ground_z)
    # a cluster overlaps a 2D box as much as its best member does, which hardly moves the evidence
    np.testing.assert_allclose(fitted.evidence["Car"].weights, calibration.evidence["Car"].weights, atol=0.1)
    for one, other in zip(study.cross_validate(calibration), doubled.cross_validate(calibration), strict=True):
        assert one.lidar_count == other.lidar_count
        assert one.log_loss_fused == pytest.approx(other.log_loss_fused, abs=0.01, nan_ok=True)
        assert one.before == pytest.approx(other.before)
        assert one.after == pytest.approx(other.after, abs=0.2)


def test_the_command_tells_of_doubles(doubled, calibration, study):
    from lcf3d.cli.calibrate import calibration_table

    assert any("1,260 of 1,680 LiDAR boxes double a surer one" in n for n in calibration_table(doubled, calibration)[3])
    assert not any("double" in note for note in calibration_table(study, calibration)[3])


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
