from types import SimpleNamespace

import numpy as np
import pytest

from lcf3d.errors import FormatError
from lcf3d.formats import ros_messages as ros
from lcf3d.structures import Detections2D, Detections3D

pytest.importorskip("rosbags")
from lcf3d.formats.ros_types import store

NAMES = ("Car", "Pedestrian", "Cyclist")
TYPES = store()


def make(kind, /, **fields):
    return TYPES.types[kind](**fields)


def through_cdr(message):
    """The message after being written as ROS 2 sends it, and read back."""
    name = message.__msgtype__
    return TYPES.deserialize_cdr(TYPES.serialize_cdr(message, name), name)


def boxes3d(velocities=None):
    boxes = np.array([[10.0, -2.0, -0.8, 4.0, 1.8, 1.6, 0.5], [20.0, 3.0, -0.6, 0.6, 0.5, 1.8, -3.0]])
    return Detections3D(boxes, np.array([0.9, 0.25]), np.array([0, 1]), NAMES, velocities)


def test_boxes_come_back_from_vision_messages():
    message = through_cdr(ros.vision_from_detections_3d(make, boxes3d(), 12.25, "lidar"))
    assert ros.seconds_of(message.header.stamp) == 12.25
    assert message.header.frame_id == "lidar"
    assert message.detections[0].results[0].hypothesis.class_id == "Car"
    found = ros.detections_3d_from_vision(message, NAMES)
    assert np.allclose(found.boxes, boxes3d().boxes)
    assert np.allclose(found.scores, [0.9, 0.25])
    assert found.labels.tolist() == [0, 1]


def test_the_best_hypothesis_of_a_known_class_counts_and_others_are_left_out():
    message = ros.vision_from_detections_3d(make, boxes3d(), 0.0, "lidar")
    pose = message.detections[0].results[0].pose
    for name, score in (("Tram", 0.99), ("Cyclist", 0.95)):
        hypothesis = make("vision_msgs/msg/ObjectHypothesis", class_id=name, score=score)
        message.detections[0].results.append(
            make("vision_msgs/msg/ObjectHypothesisWithPose", hypothesis=hypothesis, pose=pose)
        )
    message.detections[1].results[0].hypothesis.class_id = "Tram"
    found = ros.detections_3d_from_vision(through_cdr(message), NAMES)
    assert found.labels.tolist() == [2]
    assert found.scores.tolist() == [0.95]


def test_2d_boxes_come_back_from_vision_messages():
    found = Detections2D(np.array([[10.0, 20.0, 50.0, 100.0]]), np.array([0.75]), np.array([1]), NAMES)
    message = through_cdr(ros.vision_from_detections_2d(make, found, 1.5, "camera"))
    assert message.detections[0].bbox.center.position.x == 30
    again = ros.detections_2d_from_vision(message, NAMES)
    assert np.allclose(again.boxes, found.boxes)
    assert again.labels.tolist() == [1]
    old = SimpleNamespace(
        detections=[
            SimpleNamespace(
                results=[SimpleNamespace(id="Car", score=0.5)],
                bbox=SimpleNamespace(center=SimpleNamespace(x=30.0, y=60.0), size_x=40.0, size_y=80.0),
            )
        ]
    )
    assert np.allclose(ros.detections_2d_from_vision(old, NAMES).boxes, found.boxes)


def test_boxes_come_back_from_autoware_messages_with_velocities_in_their_own_axes():
    box = np.array([[10.0, -2.0, -0.8, 4.0, 1.8, 1.6, np.pi / 2]])
    detections = Detections3D(box, np.array([0.5]), np.array([0]), NAMES, np.array([[0.0, 7.0]]))
    message = through_cdr(ros.autoware_from_detections_3d(make, detections, 3.0, "base_link"))
    (found,) = message.objects
    assert found.classification[0].label == 1
    # it looks along +y and drives along +y: straight ahead in its own axes
    assert found.kinematics.twist_with_covariance.twist.linear.x == pytest.approx(7.0)
    assert found.kinematics.twist_with_covariance.twist.linear.y == pytest.approx(0.0, abs=1e-12)
    again = ros.detections_3d_from_autoware(message, NAMES)
    assert np.allclose(again.boxes, box)
    assert np.allclose(again.velocities, [[0.0, 7.0]])
    unknown = ros.autoware_from_detections_3d(make, boxes3d(), 3.0, "base_link")
    assert not unknown.objects[0].kinematics.has_twist
    assert np.isnan(ros.detections_3d_from_autoware(unknown, NAMES).velocities).all()


def test_autoware_bicycles_are_cyclists_where_there_are_no_bicycles():
    detections = Detections3D(boxes3d().boxes[:1], np.array([0.5]), np.array([2]), NAMES)
    message = ros.autoware_from_detections_3d(make, detections, 0.0, "base_link")
    assert message.objects[0].classification[0].label == 6
    assert ros.detections_3d_from_autoware(message, NAMES).labels.tolist() == [2]


def test_points_come_back_from_clouds():
    points = np.array([[1.0, 2.0, 3.0, 0.5], [4.0, 5.0, 6.0, 0.25]], np.float32)
    message = through_cdr(ros.cloud_from_points(make, points, 1.0, "lidar"))
    assert np.array_equal(ros.points_from_cloud(message), points)


def test_clouds_of_other_layouts_are_read():
    layout = np.dtype(
        {"names": ["x", "y", "z", "i"], "formats": ["f8", "f8", "f8", "u1"], "offsets": [0, 8, 16, 26], "itemsize": 32}
    )
    table = np.zeros((2, 3), layout)
    table["x"], table["i"] = np.arange(6).reshape(2, 3), 200
    data = np.zeros((2, 3 * 32 + 8), np.uint8)
    data[:, :96] = table.view(np.uint8).reshape(2, 96)
    fields = [
        SimpleNamespace(name=n, offset=o, datatype=t)
        for n, o, t in (("x", 0, 8), ("y", 8, 8), ("z", 16, 8), ("i", 26, 2))
    ]
    cloud = SimpleNamespace(
        height=2, width=3, fields=fields, is_bigendian=False, point_step=32, row_step=104, data=data.ravel()
    )
    points = ros.points_from_cloud(cloud)
    assert points[:, 0].tolist() == [0, 1, 2, 3, 4, 5]
    assert points[:, 3].tolist() == [200] * 6
    cloud.data = cloud.data[:-20]
    with pytest.raises(FormatError, match="cut off"):
        ros.points_from_cloud(cloud)
    cloud.fields = fields[:2]
    with pytest.raises(FormatError, match="x, y and z"):
        ros.points_from_cloud(cloud)


def image(encoding, data, step=None):
    height, width = data.shape[:2]
    step = step or data[0].size
    padded = np.zeros((height, step), np.uint8)
    padded[:, : data[0].size] = data.reshape(height, -1)
    return make(
        "sensor_msgs/msg/Image",
        header=ros.make_header(make, 0.0, "camera"),
        height=height,
        width=width,
        encoding=encoding,
        is_bigendian=0,
        step=step,
        data=padded.ravel(),
    )


def test_images_are_rgb_whatever_their_encoding():
    rgb = np.arange(24, dtype=np.uint8).reshape(2, 4, 3)
    assert np.array_equal(ros.pixels_from_image(through_cdr(image("rgb8", rgb, step=16))), rgb)
    assert np.array_equal(ros.pixels_from_image(image("bgr8", rgb[..., ::-1])), rgb)
    assert np.array_equal(ros.pixels_from_image(image("mono8", rgb[..., 0])), np.repeat(rgb[..., :1], 3, axis=2))
    with pytest.raises(FormatError, match="bayer"):
        ros.pixels_from_image(image("bayer_rggb8", rgb[..., 0]))
    cut = image("rgb8", rgb)
    cut.data = cut.data[:-1]
    with pytest.raises(FormatError, match="cut off"):
        ros.pixels_from_image(cut)


def test_compressed_images_are_read_and_broken_ones_refused():
    import io

    from PIL import Image

    rgb = np.full((4, 6, 3), 90, np.uint8)
    stream = io.BytesIO()
    Image.fromarray(rgb).save(stream, "PNG")
    whole = np.frombuffer(stream.getvalue(), np.uint8)
    header = ros.make_header(make, 0.0, "camera")
    message = make("sensor_msgs/msg/CompressedImage", header=header, format="png", data=whole)
    assert np.array_equal(ros.pixels_from_image(through_cdr(message)), rgb)
    message.data = whole[:20]
    with pytest.raises(FormatError, match="cannot be read"):
        ros.pixels_from_image(message)


def info(**changes):
    values = {
        "height": 400,
        "width": 600,
        "distortion_model": "plumb_bob",
        "d": [0.0] * 5,
        "k": [500.0, 0, 300, 0, 500, 200, 0, 0, 1],
        "p": [480.0, 0, 300, -50, 0, 480, 200, 0, 0, 0, 1, 0],
    }
    return SimpleNamespace(**{**values, **changes})


def test_a_camera_info_gives_the_camera_of_raw_or_rectified_images():
    raw = ros.camera_from_info("left", info(d=[-0.1, 0.01, 0, 0, 0]), np.eye(4))
    assert raw.intrinsics[0, 0] == 500
    assert raw.distortion.model == "brown_conrady"
    assert ros.camera_from_info("left", info(), np.eye(4)).distortion is None
    rectified = ros.camera_from_info("left", info(), np.eye(4), rectified=True)
    assert rectified.projection[0].tolist() == [480, 0, 300, -50]
    fisheye = ros.camera_from_info("left", info(distortion_model="equidistant", d=[0.01, 0, 0, 0]), np.eye(4))
    assert fisheye.distortion.model == "fisheye"
    with pytest.raises(FormatError, match="not calibrated"):
        ros.camera_from_info("left", info(k=[0.0] * 9), np.eye(4))
    with pytest.raises(FormatError, match="unknown"):
        ros.camera_from_info("left", info(distortion_model="magic", d=[1.0]), np.eye(4))


def test_transforms_poses_and_odometry_are_one_matrix():
    half = np.sqrt(0.5)
    turn = make("geometry_msgs/msg/Quaternion", x=0.0, y=0.0, z=half, w=half)
    where = make("geometry_msgs/msg/Vector3", x=1.0, y=2.0, z=3.0)
    transform = make("geometry_msgs/msg/Transform", translation=where, rotation=turn)
    stamped = make(
        "geometry_msgs/msg/TransformStamped",
        header=ros.make_header(make, 0.0, "map"),
        child_frame_id="lidar",
        transform=transform,
    )
    expected = np.array([[0, -1, 0, 1], [1, 0, 0, 2], [0, 0, 1, 3], [0, 0, 0, 1.0]])
    assert np.allclose(ros.transform_of(through_cdr(stamped)), expected)
    pose = SimpleNamespace(position=where, orientation=turn)
    assert np.allclose(ros.transform_of(SimpleNamespace(pose=SimpleNamespace(pose=pose))), expected)
    turn.z = turn.w = 0.0
    with pytest.raises(FormatError, match="zero"):
        ros.transform_of(stamped)


def test_diagnostics_are_a_ros_message():
    entries = [
        {
            "name": "lcf3d: lidar",
            "level": 1,
            "message": "late",
            "hardware_id": "lidar",
            "values": [{"key": "rate", "value": "10"}],
        }
    ]
    message = through_cdr(ros.diagnostics_message(make, entries, 5.0, level_bytes=False))
    assert message.status[0].level == 1
    assert message.status[0].values[0].value == "10"


def test_no_detections_are_an_empty_message():
    message = through_cdr(ros.vision_from_detections_3d(make, Detections3D.empty(NAMES), 0.0, "lidar"))
    assert len(ros.detections_3d_from_vision(message, NAMES)) == 0
    assert len(ros.detections_3d_from_autoware(SimpleNamespace(objects=[]), NAMES)) == 0
