import numpy as np
import pytest

from lcf3d import FusionConfig
from lcf3d.fusion.evidence import Evidence
from lcf3d.fusion.self_calibration import camera_share, self_calibrate
from lcf3d.structures import KITTI_CLASSES, Detections2D
from tests.fusion.scenes import CAR, CYCLIST, camera, car, frame, lidar, pedestrian, seen

CONFIG = FusionConfig.preset("kitti")


def drive(count, seed=0, scale=10.0):
    """Frames of a true car that the camera sees, a ghost that it does not, and a cyclist that it does not know."""
    rng = np.random.default_rng(seed)
    for _ in range(count):
        true, ghost = car(rng.uniform(10, 30), rng.uniform(2, 5)), car(rng.uniform(10, 30), rng.uniform(-5, -2))
        rider = pedestrian(20, 8)
        scores = scale * np.exp(rng.normal([1, -1, 0], 0.5))
        found = lidar([true, ghost, rider], scores, [CAR, CAR, CYCLIST])
        yield frame([camera()]), found, seen(camera(), [true], [0.9])


def test_the_camera_teaches_the_scale():
    calibration = self_calibrate(drive(200), CONFIG)
    car_map = calibration.lidar["Car"]
    assert car_map.transform == "log"
    low, middle, high = car_map(10 * np.exp(np.array([-1.0, 0.0, 1.0])))
    assert low < 0.1
    assert 0.3 < middle < 0.7
    assert high > 0.9
    assert calibration.camera_classes == ("Car",)
    assert calibration.ground_z == pytest.approx(-1.6)
    assert calibration.evidence == {}


def test_a_class_the_camera_does_not_know_is_standardised():
    scores = np.concatenate([found.scores[found.labels == CYCLIST] for _, found, _ in drive(200)])
    rider = self_calibrate(drive(200), CONFIG).lidar["Cyclist"]
    assert rider(np.array([np.median(scores)]))[0] == pytest.approx(0.5, abs=0.02)


@pytest.mark.parametrize("count", [1, 6])
def test_few_frames_are_enough(count):
    calibration = self_calibrate(drive(count), CONFIG)
    p = calibration.lidar["Car"](np.array([1.0, 10.0, 100.0]))
    assert ((p > 0) & (p < 1)).all()
    assert (np.diff(p) > 0).all()


def test_order_of_frames_does_not_matter():
    frames = list(drive(30))
    assert self_calibrate(frames, CONFIG) == self_calibrate(frames[::-1], CONFIG)


def test_probabilities_are_left_alone():
    calibration = self_calibrate(drive(10, scale=0.01), CONFIG)
    assert calibration.lidar == {}
    assert calibration.camera_classes == ("Car",)


def test_nothing_at_all():
    empty = lidar([], [])
    calibration = self_calibrate([(frame([camera()]), empty, Detections2D.empty(KITTI_CLASSES))], CONFIG)
    assert calibration.lidar == {}
    assert calibration.ground_z is None
    assert self_calibrate([], CONFIG).lidar == {}


def test_logits_of_one_lone_box():
    found = lidar([car(15)], [-0.5])
    calibration = self_calibrate([(frame([camera()]), found, Detections2D.empty(KITTI_CLASSES))], CONFIG)
    assert calibration.lidar["Car"].transform == "identity"
    assert calibration.lidar["Car"].slope == pytest.approx(1.0)


def test_a_camera_that_misses_the_best_boxes_is_believed_less():
    scores = np.arange(10000.0)
    rng = np.random.default_rng(0)
    # of the best 200 boxes 40 % are confirmed: log(0.6) / log(0.1), a little more for the prior
    assert camera_share(scores, rng.random(10000) < 0.4) == pytest.approx(0.26, abs=0.05)
    assert camera_share(scores, scores > 5000) == 1
    assert camera_share(scores[:3], np.zeros(3, dtype=bool)) == 1  # one box proves nothing
    assert camera_share(scores[:0], np.zeros(0, dtype=bool)) == 1


def test_what_is_believed_less_is_the_camera_alone():
    half = Evidence(support=(1, 2, 3, 4), miss=0.5, trust=0.7).with_camera_share(0.5)
    assert half == Evidence(support=(0.5, 1, 1.5, 2), miss=0.25, trust=0.7)


def test_a_blind_camera_loses_its_weight():
    blind = [
        (f, found, Detections2D.empty(KITTI_CLASSES) if i % 2 else two_d)
        for i, (f, found, two_d) in enumerate(drive(600))
    ]
    cars = self_calibrate(blind, CONFIG).evidence["Car"]
    assert cars.support[-1] < 0.8 * CONFIG.evidence_of("Car").support[-1]
    assert cars.trust == CONFIG.evidence_of("Car").trust
