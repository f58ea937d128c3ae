import ast
import runpy
import sys
import xml.etree.ElementTree as ET
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import yaml

from lcf3d.errors import ConfigError
from lcf3d.formats import ros_messages as ros
from lcf3d.live.ros2 import CAMERA_PARAMETERS, PARAMETERS, FuserNode, make_message, spin
from tests.fusion.scenes import camera

pytest.importorskip("rosbags")
from tests.live.ros_stand_in import Buffer, Node, install
from tests.live.streams import boxes2d, boxes3d, street

PACKAGE = Path(__file__).parents[2] / "ros2" / "lcf3d_ros"
VIEW = camera()


def parameters(**changes):
    values = {"cameras": ["left"], "left.camera_from_lidar": VIEW.camera_from_lidar.ravel().tolist()}
    return {**values, **changes}


def shell(monkeypatch, **changes):
    node, buffer = Node("lcf3d", parameters=parameters(**changes)), Buffer()
    install(monkeypatch, node)
    return node, buffer, FuserNode(node, buffer)


def info(seconds=0.0, frame="left_optical"):
    roi = make_message("sensor_msgs/msg/RegionOfInterest", x_offset=0, y_offset=0, height=0, width=0, do_rectify=False)
    matrix = VIEW.intrinsics.ravel()
    return make_message(
        "sensor_msgs/msg/CameraInfo",
        header=ros.make_header(make_message, seconds, frame),
        height=400,
        width=1000,
        distortion_model="plumb_bob",
        d=np.zeros(5),
        k=matrix,
        r=np.eye(3).ravel(),
        p=VIEW.projection.ravel(),
        binning_x=0,
        binning_y=0,
        roi=roi,
    )


def send(node, seconds, i=0, frame="lidar"):
    node.receive("lidar/detections", ros.vision_from_detections_3d(make_message, boxes3d(street(i)), seconds, frame))
    node.receive(
        "left/detections", ros.vision_from_detections_2d(make_message, boxes2d(VIEW, street(i)), seconds, "left")
    )


def test_boxes_come_in_and_fused_boxes_go_out_with_the_stamp_of_the_scan(monkeypatch):
    node, _, _ = shell(monkeypatch)
    node.receive("left/camera_info", info())
    seconds = 1732672345.123456789
    send(node, seconds)
    (message,) = node.publishers["fused/detections"].sent
    assert (message.header.stamp.sec, message.header.frame_id) == (1732672345, "lidar")
    assert message.header.stamp.nanosec == ros.make_header(make_message, seconds, "").stamp.nanosec
    found = ros.detections_3d_from_vision(message, ("Car",))
    assert len(found) == 4
    assert np.allclose(np.sort(found.boxes[:, 0]), np.sort(street(0)[:, 0]))
    assert found.scores.max() > 0.9


def test_autoware_messages_in_and_out(monkeypatch):
    node, _, _ = shell(monkeypatch, messages="autoware")
    node.receive("left/camera_info", info())
    node.receive("lidar/detections", ros.autoware_from_detections_3d(make_message, boxes3d(street(0)), 1.0, "lidar"))
    node.receive("left/detections", ros.vision_from_detections_2d(make_message, boxes2d(VIEW, street(0)), 1.0, "left"))
    (message,) = node.publishers["fused/detections"].sent
    assert len(message.objects) == 4


def test_extrinsics_come_from_tf2_and_a_transform_that_is_late_is_waited_for(monkeypatch):
    node, buffer, target = shell(monkeypatch, **{"left.camera_from_lidar": [0.0]})
    node.receive("left/camera_info", info())
    assert "no transform" in node.warnings[0]
    matrix = VIEW.camera_from_lidar
    from scipy.spatial.transform import Rotation

    x, y, z, w = Rotation.from_matrix(matrix[:3, :3]).as_quat()
    transform = SimpleNamespace(
        translation=SimpleNamespace(x=0.0, y=0.0, z=0.0), rotation=SimpleNamespace(x=x, y=y, z=z, w=w)
    )
    buffer.known["left_optical", "lidar"] = SimpleNamespace(transform=transform)
    node.receive("left/camera_info", info())
    send(node, 1.0)
    assert len(node.publishers["fused/detections"].sent) == 1
    assert np.allclose(target.fuser._models.at("left", 0.0).camera_from_lidar, matrix)


def test_boxes_of_another_frame_are_brought_into_the_lidars(monkeypatch):
    node, buffer, _ = shell(monkeypatch)
    node.receive("left/camera_info", info())
    shifted = street(0) + np.array([1.5, 0, 0, 0, 0, 0, 0])
    send(node, 0.5, frame="base_link")
    assert "base_link" in node.warnings[0]
    assert not node.publishers["fused/detections"].sent
    turn = SimpleNamespace(x=0.0, y=0.0, z=0.0, w=1.0)
    move = SimpleNamespace(x=-1.5, y=0.0, z=0.0)
    buffer.known["lidar", "base_link"] = SimpleNamespace(transform=SimpleNamespace(translation=move, rotation=turn))
    message = ros.vision_from_detections_3d(make_message, boxes3d(shifted), 1.0, "base_link")
    node.receive("lidar/detections", message)
    node.receive("left/detections", ros.vision_from_detections_2d(make_message, boxes2d(VIEW, street(0)), 1.0, "left"))
    found = ros.detections_3d_from_vision(node.publishers["fused/detections"].sent[-1], ("Car",))
    assert np.allclose(np.sort(found.boxes[:, 0]), np.sort(street(0)[:, 0]))


def test_diagnostics_go_out_and_a_broken_message_is_told_once(monkeypatch):
    node, _, _ = shell(monkeypatch, scan="lidar/points")
    node.receive("left/camera_info", info())
    points = np.zeros((3, 4), np.float32)
    whole = ros.cloud_from_points(make_message, points, 1.0, "lidar")
    cut = ros.cloud_from_points(make_message, points, 1.0, "lidar")
    cut.data = cut.data[:10]
    for _ in range(3):
        node.receive("lidar/points", cut)
    assert len(node.warnings) == 1
    # a trouble that lasts is told again after a while
    monkeypatch.setattr("lcf3d.live.ros2.monotonic", lambda: 1e9)
    node.receive("lidar/points", cut)
    assert len(node.warnings) == 2
    node.receive("lidar/points", whole)
    send(node, 1.0)
    assert len(node.publishers["fused/detections"].sent) == 1
    next(callback for period, callback in node.timers if period == 1.0)()
    (message,) = node.publishers["/diagnostics"].sent
    assert {status.hardware_id for status in message.status} == {"fusion", "lidar", "camera left"}


def test_parameters_that_cannot_work_are_refused(monkeypatch):
    with pytest.raises(ConfigError, match="vision or autoware"):
        shell(monkeypatch, messages="custom")
    with pytest.raises(ConfigError, match="neither a preset"):
        shell(monkeypatch, config="no-such-file")


def test_spin_runs_the_node_and_shuts_down(monkeypatch):
    node = Node("lcf3d", parameters=parameters())
    rclpy = install(monkeypatch, node)["rclpy"]
    spin(["--ros-args"])
    assert [name for name, _ in rclpy.calls] == ["init", "spin", "shutdown"]


def test_without_ros_the_command_says_what_to_do():
    with pytest.raises(ConfigError, match="source a ROS 2 installation"):
        spin([])


def test_the_package_is_one_that_colcon_builds():
    root = ET.parse(PACKAGE / "package.xml").getroot()
    assert (root.tag, root.get("format")) == ("package", "3")
    assert root.findtext("export/build_type") == "ament_python"
    assert root.findtext("name") == "lcf3d_ros"
    for part in ("version", "description", "maintainer", "license"):
        assert root.findtext(part)
    tree = ast.parse((PACKAGE / "setup.py").read_text())
    files = [node.value for node in ast.walk(tree) if isinstance(node, ast.Constant) and isinstance(node.value, str)]
    for name in ("package.xml", "launch/fuser.launch.py", "config/fuser.yaml"):
        assert name in files
        assert (PACKAGE / name).is_file()
    assert (PACKAGE / "resource" / "lcf3d_ros").is_file()
    ast.parse((PACKAGE / "launch" / "fuser.launch.py").read_text())


def test_the_package_passes_the_rules_of_ros_packages():
    """The parser that colcon reads ``package.xml`` with; colcon itself built the package where this was written."""
    parse_package = pytest.importorskip("catkin_pkg.package").parse_package
    told = []
    package = parse_package(str(PACKAGE / "package.xml"), warnings=told)
    package.validate(warnings=told)
    assert told == []
    assert package.get_build_type() == "ament_python"
    needed = {depend.name for depend in package.exec_depends}
    launched = ast.parse((PACKAGE / "launch" / "fuser.launch.py").read_text())
    for node in ast.walk(launched):
        if isinstance(node, ast.ImportFrom):
            assert node.module.split(".")[0] in needed


def test_the_launch_file_describes_one_node_with_its_parameters(monkeypatch):
    class Made:
        """A class of ``launch`` or ``launch_ros``: it keeps what it was made with."""

        def __init__(self, *given, **named):
            self.given, self.named = given, named

    names = {
        "ament_index_python.packages": {"get_package_share_directory": lambda package_name: f"/share/{package_name}"},
        "launch": {"LaunchDescription": Made},
        "launch.actions": {"DeclareLaunchArgument": Made},
        "launch.substitutions": {"LaunchConfiguration": Made},
        "launch_ros.actions": {"Node": Made},
    }
    for name, contents in names.items():
        monkeypatch.setitem(sys.modules, name, SimpleNamespace(**contents))
    description = runpy.run_path(str(PACKAGE / "launch" / "fuser.launch.py"))["generate_launch_description"]()
    argument, node = description.given[0]
    assert argument.given == ("params",)
    assert argument.named["default_value"] == "/share/lcf3d_ros/config/fuser.yaml"
    assert (node.named["package"], node.named["name"]) == ("lcf3d_ros", "lcf3d")
    assert node.named["parameters"][0].given == ("params",)
    # the executable is one that setup.py installs, and it is the node
    assert f'"{node.named["executable"]} = lcf3d_ros.fuser:main"' in (PACKAGE / "setup.py").read_text()
    sys.path.insert(0, str(PACKAGE))
    try:
        from lcf3d_ros.fuser import main
    finally:
        sys.path.remove(str(PACKAGE))
    with pytest.raises(ConfigError, match="source a ROS 2"):
        main()


def test_the_parameter_file_names_parameters_that_there_are():
    values = yaml.safe_load((PACKAGE / "config" / "fuser.yaml").read_text())["lcf3d"]["ros__parameters"]
    cameras = values["cameras"]
    assert set(values) <= {*PARAMETERS, *cameras}
    for camera_name in cameras:
        assert set(values[camera_name]) <= set(CAMERA_PARAMETERS)
    for name, value in values.items():
        if name in PARAMETERS:
            assert isinstance(value, type(PARAMETERS[name][0]))


@pytest.mark.parametrize("separator", [(), ("--",)])
def test_the_command_hands_everything_on_to_ros(monkeypatch, separator):
    from typer.testing import CliRunner

    from lcf3d.cli.app import app

    node = Node("lcf3d", parameters=parameters())
    rclpy = install(monkeypatch, node)["rclpy"]
    given = ["--ros-args", "--params-file", "fuser.yaml", "-r", "__ns:=/front"]
    result = CliRunner().invoke(app, ["ros2", *separator, *given], catch_exceptions=False)
    assert result.exit_code == 0, result.output
    assert rclpy.calls[0] == ("init", given)
