"""The world each published network was trained in: its frame, its sweeps, what its camera sees. References by hand,
by other code (scipy's rotations, the records of the original implementations) and by what reaches the network."""

from __future__ import annotations

import json

import numpy as np
import pytest
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from lcf3d.datasets.kitti import KittiDataset
from lcf3d.datasets.nuscenes import NuscenesDataset
from lcf3d.detectors.base import CloudRequest, cloud_request
from lcf3d.detectors.lidar.config import LidarConfig
from lcf3d.detectors.lidar.decoding import Candidates, select_by_class
from lcf3d.detectors.lidar.frames import canonical_boxes, turned_points
from lcf3d.detectors.lidar.inputs import network_points
from lcf3d.detectors.lidar.kinds import InClasses
from lcf3d.detectors.lidar.presets import PRESETS
from lcf3d.detectors.lidar.sweeps import accumulate_sweeps, cloud_of, in_view, missing_of
from lcf3d.errors import ConfigError, DatasetError
from lcf3d.frame import Frame, Sweep
from lcf3d.run.sources import LidarOnScans
from lcf3d.structures import Camera, Detections3D
from tests.datasets.nuscenes_world import START_US, world_tables, write_world

NUSCENES = [name for name in PRESETS if "nuscenes" in name]
KITTI = [name for name in PRESETS if "kitti" in name]


class Listening:
    """A LiDAR detector that keeps what it is given."""

    def __init__(self, cloud=None):
        if cloud is not None:
            self.cloud = cloud

    def __call__(self, points):
        self.heard = points
        return Detections3D.empty(("Car",))


def heard(frame, cloud=None):
    detector = Listening(cloud)
    LidarOnScans(detector).detect(frame)
    return detector.heard


def test_every_preset_says_which_world_it_is_from():
    for name in NUSCENES:
        assert PRESETS[name].frame == "lidar_top"
        center = name.startswith("centerpoint")
        expected = CloudRequest(9, remove_close=True, repeat_scan=True) if center else CloudRequest(10)
        assert PRESETS[name].cloud == expected
    for name in KITTI:
        assert PRESETS[name].frame == "canonical"
        assert PRESETS[name].cloud == CloudRequest(view="left")


@pytest.mark.parametrize("name", list(PRESETS))
def test_the_world_travels_with_an_exported_network(name):
    assert LidarConfig.from_dict(json.loads(json.dumps(PRESETS[name].to_dict()))) == PRESETS[name]


def test_a_quarter_turn_by_hand():
    # 7 m ahead and 2 m to the left; in the raw frame x is right and y ahead
    points = np.array([[7, 2, 0.5, 100, 0.1]], np.float32)
    assert turned_points(points, "lidar_top").tolist() == [[-2, 7, 0.5, 100, np.float32(0.1)]]
    # a car there, heading ahead (raw yaw 90 degrees), driving ahead at 3 m/s and to the right at 1 m/s
    raw = np.array([[-2.0, 7, 0.5, 4, 2, 1.5, np.pi / 2, 1, 3]])
    np.testing.assert_allclose(canonical_boxes(raw, "lidar_top"), [[7, 2, 0.5, 4, 2, 1.5, 0, 3, -1]], atol=1e-12)
    assert canonical_boxes(raw, "canonical") is raw
    with pytest.raises(ConfigError, match="one of canonical, lidar_top, got 'ego'"):
        turned_points(points, "ego")


def test_points_and_boxes_turn_together():
    rng = np.random.default_rng(0)
    points = rng.uniform(-50, 50, (200, 5)).astype(np.float32)
    raw = turned_points(points, "lidar_top")
    turn = Rotation.from_euler("z", 90, degrees=True).as_matrix()
    np.testing.assert_allclose(raw[:, :3], points[:, :3] @ turn.T, atol=1e-5)
    boxes = np.column_stack([raw[:, :3], np.ones((200, 3)), rng.uniform(-3, 3, 200), raw[:, :2]]).astype(float)
    back = canonical_boxes(boxes, "lidar_top")
    np.testing.assert_allclose(back[:, :3], points[:, :3], atol=1e-6)
    np.testing.assert_allclose(back[:, 7:], points[:, :2], atol=1e-6)
    headings = [Rotation.from_euler("z", values[:, 6:7]).apply([1.0, 0, 0]) for values in (boxes, back)]
    np.testing.assert_allclose(headings[1], headings[0] @ turn, atol=1e-12)


def asymmetric_scan():
    """More to the left than to the right, and more in front than behind: a wrong turn is another scan."""
    rng = np.random.default_rng(1)
    parts = [rng.normal(at, (1.0, 1.0, 0.4), (count, 3)) for at, count in (((20, 8, -1), 300), ((-6, 3, -1), 90))]
    parts.append(rng.uniform((-45, -45, -2), (45, 45, 0), (500, 3)))
    points = np.concatenate(parts)
    return np.column_stack([points, rng.uniform(0, 255, len(points)), np.zeros(len(points))]).astype(np.float32)


@pytest.mark.parametrize("name", ["pointpillars-nuscenes", "ssn-nuscenes", "centerpoint-pillar02-nuscenes"])
def test_an_asymmetric_scan_through_torch_and_onnx(name, tmp_path):
    """The turned network on x-forward points is the raw network on raw points, its boxes turned by a matrix."""
    torch = pytest.importorskip("torch")
    from dataclasses import replace

    from lcf3d.detectors.lidar import OnnxLidarDetector, export_onnx
    from lcf3d.detectors.lidar.loading import detector_class

    torch.manual_seed(2)
    config = replace(PRESETS[name], suppression=replace(PRESETS[name].suppression, score_threshold=0.0))
    kind = detector_class(config.architecture)
    state = kind.build(config).state_dict()
    points = asymmetric_scan()
    raw = points.copy()
    raw[:, 0], raw[:, 1] = -points[:, 1], points[:, 0]
    plain = kind.from_state_dict(state, replace(config, frame="canonical"), nms="off")(raw)
    turned = kind.from_state_dict(state, config, nms="off")
    export_onnx(turned, tmp_path / "network.onnx")
    assert len(plain) > 50
    turn = Rotation.from_euler("z", -90, degrees=True).as_matrix()
    for detector in (turned, OnnxLidarDetector(tmp_path / "network.onnx", nms="off")):
        assert cloud_request(detector) == PRESETS[name].cloud
        found = detector(points)
        # in the order of their scores, in which rounding may exchange two: each is looked up
        keys = [np.column_stack([d.scores * 100, d.labels]) for d in (plain, found)]
        theirs = np.column_stack([plain.boxes[:, :3] @ turn.T, keys[0]])
        distance, index = cKDTree(theirs).query(np.column_stack([found.boxes[:, :3], keys[1]]))
        assert distance.max() < 1e-2
        assert len(set(index)) == len(found) == len(plain)
        difference = found.boxes[:, 6] - (plain.boxes[index, 6] - np.pi / 2)
        np.testing.assert_allclose(np.cos(difference), 1, atol=1e-5)
        moving = np.column_stack([plain.velocities, np.zeros(len(plain))]) @ turn.T
        np.testing.assert_allclose(found.velocities, moving[index, :2], atol=1e-3)


def sweeps_world(tmp_path, sweeps=3):
    """The tiny world, the vehicle turning, with sweeps every 50 ms before the second sample."""
    tables = world_tables()
    data = [r for r in tables["sample_data"] if r["token"] not in ("sweep", "L1")]
    first = next(r for r in tables["sample_data"] if r["token"] == "L0")
    last = next(r for r in tables["sample_data"] if r["token"] == "L1")
    previous = "L0"
    for i in range(sweeps, 0, -1):
        token, seconds = f"S{i}", 0.5 - 0.05 * i
        angle = 0.3 * seconds
        pose = {"token": f"p-{token}", "timestamp": START_US + round(1e6 * seconds)}
        pose["rotation"] = [float(np.cos(angle / 2)), 0.0, 0.0, float(np.sin(angle / 2))]
        pose["translation"] = [100 + 10 * seconds, 50 + seconds, 0.1 * seconds]
        tables["ego_pose"].append(pose)
        record = {**first, "token": token, "prev": previous, "is_key_frame": False, "sample_token": "s1"}
        record |= {"timestamp": pose["timestamp"], "ego_pose_token": pose["token"], "filename": f"sweeps/{token}.bin"}
        data.append(record)
        previous = token
    data.append({**last, "prev": previous})
    tables["sample_data"] = data
    root = write_world(tmp_path, tables, points=True)
    rng = np.random.default_rng(5)
    for record in data:
        if record["calibrated_sensor_token"] == "c-lidar":
            scan = np.column_stack([rng.uniform(-40, 40, (200, 2)), rng.uniform(-2, 1, 200), rng.uniform(0, 255, 200)])
            scan[:20, :2] = rng.uniform(-1.3, 1.3, (20, 2))
            np.column_stack([scan, np.full(200, 7.0)]).astype("<f4").tofile(root / record["filename"])
    return root, tables


def reference_cloud(root, tables, remove_close):
    """(M, 5) raw LIDAR_TOP cloud of the second sample, by scipy's rotations from the records of the tables."""
    by_token = {
        name: {r["token"]: r for r in tables[name]} for name in ("sample_data", "ego_pose", "calibrated_sensor")
    }

    def pose(record):
        matrix = np.eye(4)
        for table, key in (("ego_pose", "ego_pose_token"), ("calibrated_sensor", "calibrated_sensor_token")):
            entry, step = by_token[table][record[key]], np.eye(4)
            w, x, y, z = entry["rotation"]
            step[:3, :3] = Rotation.from_quat([x, y, z, w]).as_matrix()
            step[:3, 3] = entry["translation"]
            matrix = matrix @ step
        return matrix

    key = by_token["sample_data"]["L1"]
    parts, record = [], key
    while record is not None and key["timestamp"] - record["timestamp"] < 450_000:
        points = np.fromfile(root / record["filename"], "<f4").reshape(-1, 5).astype(np.float64)
        if record is not key and remove_close:
            points = points[~((abs(points[:, 0]) < 1) & (abs(points[:, 1]) < 1))]
        motion = np.linalg.inv(pose(key)) @ pose(record)
        points[:, :3] = points[:, :3] @ motion[:3, :3].T + motion[:3, 3]
        points[:, 4] = (key["timestamp"] - record["timestamp"]) / 1e6
        parts.append(points)
        record = by_token["sample_data"].get(record["prev"])
    return np.concatenate(parts)


@pytest.mark.parametrize("name", NUSCENES)
def test_what_reaches_a_network_of_nuscenes(name, tmp_path):
    root, tables = sweeps_world(tmp_path)
    config = PRESETS[name]
    frame = NuscenesDataset(root).frame("s1")
    given = heard(frame, config.cloud)
    expected = reference_cloud(root, tables, remove_close=config.cloud.remove_close)
    # the key frame of the sample before, half a second old, is the last of the sweeps
    assert (given[len(expected) :, 4] == 0.5).all()
    given = given[: len(expected)]
    reached = network_points(given, config)
    low, high = np.array(config.voxels.area[:3]), np.array(config.voxels.area[3:])
    columns = [("x", "y", "z", "intensity", "time").index(channel) for channel in config.channels]
    inside = ((expected[:, :3] > low) & (expected[:, :3] < high)).all(axis=1)
    np.testing.assert_allclose(reached, expected[inside][:, columns], atol=2e-5)
    # recovery has the key frame only
    assert frame.points.shape == (200, 4)


def test_points_of_the_vehicle_and_missing_sweeps_are_as_in_training(tmp_path):
    root = write_world(tmp_path, points=True)
    first = NuscenesDataset(root).frame("s0")
    # no sweep before the first sample: CenterPoint repeats the scan without the vehicle's own point, the others do not
    anchors, center = PRESETS["pointpillars-nuscenes"].cloud, PRESETS["centerpoint-voxel01-nuscenes"].cloud
    assert heard(first, anchors).tolist() == [[7, 2, 0.5, 100, 0], [np.float32(0.2), -0.5, 0, 50, 0]]
    repeated = heard(first, center)
    assert len(repeated) == 2 + 9
    assert (repeated[2:] == repeated[0]).all()
    assert missing_of(first, center) == ("fewer earlier sweeps than the 9 that the LiDAR detector was trained with",)
    # one sweep is there, and no more: nothing is repeated
    second = NuscenesDataset(root).frame("s1")
    assert sorted(set(heard(second, anchors)[:, 4].tolist())) == [0, np.float32(0.05), 0.5]
    assert np.abs(heard(second, anchors)[:, :2]).max(axis=1).min() < 1
    kept = heard(second, CloudRequest(1, remove_close=True))
    assert kept[:, 4].tolist() == [0, 0, np.float32(0.05)]


def test_sweeps_of_a_plain_frame():
    points = np.array([[5.0, 0, 0, 9]], np.float32)
    frame = Frame("f", points=points)
    assert frame.sweeps(3) == ()
    assert heard(frame, CloudRequest(sweeps=3)).tolist() == [[5, 0, 0, 9, 0]]
    asked = []
    move = np.eye(4)
    move[0, 3] = -2

    def load(count):
        asked.append(count)
        return [Sweep(points, move, 0.1)]

    frame = Frame("f", points=points, sweeps=load)
    np.testing.assert_allclose(heard(frame, CloudRequest(sweeps=1)), [[5, 0, 0, 9, 0], [3, 0, 0, 9, 0.1]])
    assert missing_of(frame, CloudRequest(sweeps=1)) == ()
    assert asked == [1]
    with pytest.raises(DatasetError, match="has no scan"):
        cloud_of(Frame("f"), CloudRequest(sweeps=1))


def test_a_cloud_that_is_joined_already_is_left_alone(tmp_path):
    root = write_world(tmp_path, points=True)
    frame = NuscenesDataset(root, sweeps=1).frame("s1")
    given = heard(frame, PRESETS["centerpoint-voxel01-nuscenes"].cloud)
    assert given[:, 4].tolist() == [0, 0, np.float32(0.05)]
    assert missing_of(frame, PRESETS["centerpoint-voxel01-nuscenes"].cloud) == ()


def camera(name="left", width=100, height=50):
    forward = np.array([[0.0, -1, 0, 0], [0, 0, -1, 0], [1, 0, 0, 0], [0, 0, 0, 1]])
    projection = np.array([[50.0, 0, 50, 0], [0, 50, 25, 0], [0, 0, 1, 0]])
    return Camera(name, projection, forward, width, height)


def test_the_field_of_view_by_hand():
    # 10 m ahead the image is 20 m wide and 10 m high; it ends at its right and lower edge
    points = [[10, 0, 0], [10, 10, 0], [10, 10.1, 0], [10, -10, 0], [10, -9.9, 0], [10, 0, 5.1], [-10, 0, 0]]
    seen = in_view(np.array(points, np.float32), camera())
    np.testing.assert_allclose(seen, np.array(points, np.float32)[[0, 1, 4]])


def test_whose_field_of_view():
    points = np.array([[10.0, 0, 0, 1], [-10, 0, 0, 1]], np.float32)
    left, wide = camera(), camera("right", 10_000)
    request = CloudRequest(view="left")
    assert len(heard(Frame("f", points, [left, wide]), request)) == 1
    assert len(heard(Frame("f", points, [wide]), request)) == 1
    several = Frame("f", points, [camera("CAM_FRONT"), camera("CAM_BACK")])
    assert len(heard(several, request)) == 2
    assert "got the whole scan" in missing_of(several, request)[0]
    assert missing_of(Frame("f", points, [left]), request) == ()
    assert len(heard(Frame("f", points, [left]))) == 2


def test_a_wrapped_detector_asks_for_the_same():
    request = CloudRequest(sweeps=2)
    assert cloud_request(InClasses(Listening(request), ("Car",))) == request
    assert cloud_request(Listening()) == CloudRequest()


def test_openpcdet_gives_each_box_one_class():
    boxes = np.array([[0.0, 0, 0, 4, 2, 1, 0], [0.2, 0, 0, 4, 2, 1, 0], [30, 0, 0, 4, 2, 1, 0]])
    scores = np.array([[0.8, 0.6, 0.1], [0.2, 0.9, 0.3], [0.05, 0.1, 0.02]])
    candidates = Candidates(boxes, scores, np.zeros(3, np.int64))
    config = PRESETS["second-kitti-openpcdet"]
    found = select_by_class(candidates, config.anchors, config.suppression, 0.1, "keep")
    # the second suppresses the first although its best class is another; a score of 0.1 passes
    assert found[1].tolist() == [0.9, 0.1]
    assert found[2].tolist() == [1, 1]
    loose = select_by_class(candidates, config.anchors, config.suppression, 0.1, "off")
    assert loose[1].tolist() == [0.9, 0.8, 0.1]
    own = PRESETS["second-kitti"]
    assert len(select_by_class(candidates, own.anchors, own.suppression, 0.1, "off")[1]) == 5


def test_openpcdet_keeps_tall_raw_points():
    points = np.array([[10.0, 0, 0.5, 1], [10, 0, 2.5, 1], [10, 0, -4, 1], [-1, 0, 0, 1]], np.float32)
    assert len(network_points(points, PRESETS["pv-rcnn-kitti-openpcdet"])) == 3
    assert len(network_points(points, PRESETS["pv-rcnn-kitti"])) == 1
    assert len(network_points(points, PRESETS["second-kitti-openpcdet"])) == 1


@pytest.mark.real
def test_what_reaches_a_network_of_kitti(shared, golden):
    """The cloud that the original pipeline recorded for frame 000008, point by point."""
    frame = KittiDataset(shared / "data" / "kitti").frame("000008")
    config = PRESETS["second-kitti"]
    reached = network_points(heard(frame, config.cloud), config)
    whole = network_points(heard(frame), config)
    expected = golden("second_kitti.one_thread").arrays["input"]
    np.testing.assert_array_equal(reached, expected)
    assert len(whole) > 3 * len(expected)


@pytest.mark.real
@pytest.mark.parametrize("name", NUSCENES)
def test_a_real_scan_of_nuscenes_reaches_each_network_as_recorded(shared, golden, name):
    """First sample of scene-0061: what the original pipeline recorded, in the raw frame, time 0."""
    model = {"pointpillars": "pointpillars_nus", "ssn": "ssn_nus", "centerpoint": "centerpoint_pillar02_nus"}
    token = "ca9a282c9e77460f8360f564131a8af5"
    frame = NuscenesDataset(shared / "data" / "nuscenes").frame(token)
    config = PRESETS[name]
    expected = golden(model[name.partition("-")[0]]).arrays["input"]
    reached = network_points(heard(frame, config.cloud), config)
    # the recorded points of all models are those within 50 m along x and y; CenterPoint's own volume is a little larger
    reached = reached[(np.abs(reached[:, :2]) < 50).all(axis=1)]
    # of CenterPoint, nine copies follow in the place of the sweeps
    np.testing.assert_array_equal(reached[: len(expected)], expected)
    assert len(reached) == len(expected) or name.startswith("centerpoint")
    raw = np.fromfile(next((shared / "data/nuscenes/samples/LIDAR_TOP").glob("*.bin")), "<f4").reshape(-1, 5)
    own = (np.abs(raw[:, :2]) < 1).all(axis=1)
    assert len(accumulate_sweeps(frame.points, [Sweep(frame.points, np.eye(4), 0.0)])) == 2 * len(raw) - own.sum()
