import json
import pickle
import tracemalloc
from dataclasses import replace
from importlib.metadata import EntryPoint

import numpy as np
import pytest
from typer.testing import CliRunner

pytest.importorskip("rosbags")
pytest.importorskip("mcap")

from lcf3d import plugins
from lcf3d.cli.app import app
from lcf3d.datasets.bag import BagDataset
from lcf3d.datasets.bag_export import write_bag
from lcf3d.datasets.bag_transforms import TransformTree
from lcf3d.datasets.folder import FolderDataset
from lcf3d.distortion import Distortion
from lcf3d.errors import ConfigError, DatasetError, FormatError
from lcf3d.formats import ros_messages as ros
from lcf3d.formats.bag_files import BagReader, BagWriter
from lcf3d.frame import Frame
from lcf3d.geometry.camera import project_boxes, project_points
from lcf3d.geometry.rotation import invert_rigid
from lcf3d.structures import Camera, Detections2D, Detections3D
from tests.datasets.plain_folder import CLASSES, POSES, boxes_of, camera, scan_of, write_plain_folder

FORMS = ("drive.mcap", "drive.bag", "drive")


@pytest.fixture(autouse=True)
def installed(monkeypatch):
    known = plugins._points
    added = {
        "lcf3d.datasets": {
            "bag": "lcf3d.datasets.bag:BagDataset",
            "folder": "lcf3d.datasets.folder:FolderDataset",
        },
        "lcf3d.lidar_detectors": {"topic": "lcf3d.datasets.bag_topics:lidar_topic"},
        "lcf3d.camera_detectors": {"topic": "lcf3d.datasets.bag_topics:camera_topic"},
    }
    monkeypatch.setattr(
        plugins,
        "_points",
        lambda g: {**known(g), **{name: EntryPoint(name, at, g) for name, at in added.get(g, {}).items()}},
    )


def moving_frames(count, lens=None):
    """Frames of two cameras on a vehicle that drives 1 m a frame along x."""
    for i in range(count):
        labels = boxes_of(i)
        world = np.eye(4)
        world[0, 3] = i
        cameras = [replace(camera(name), distortion=lens) for name in POSES]
        images = {name: np.full((320, 640, 3), 60 + i, np.uint8) for name in POSES}
        images["front"][10:20, 30:50] = (200, 20, 10)
        yield Frame(f"f{i}", scan_of(labels, i), cameras, images, labels, 1000.0 + 0.1 * i, world)


@pytest.mark.parametrize("name", FORMS)
def test_a_drive_comes_back_from_every_form(tmp_path, name):
    lens = Distortion("fisheye", (0.02, -0.004, 0.0, 0.0))
    frames = list(moving_frames(3, lens))
    assert write_bag(frames, tmp_path / name, quality=None) == 3
    dataset = BagDataset(tmp_path / name, labels="/labels")
    assert BagDataset.recognizes(tmp_path / name)
    assert dataset.camera_names == ("front", "left")
    assert dataset.class_names == CLASSES
    assert dataset.ids == ("1000000000000", "1000100000000", "1000200000000")
    for frame, again in zip(frames, dataset, strict=True):
        assert np.array_equal(again.points, frame.points)
        assert np.allclose(again.labels.boxes, frame.labels.boxes)
        assert np.allclose(again.world_from_lidar, frame.world_from_lidar)
        for one, other in zip(frame.cameras, again.cameras, strict=True):
            assert np.array_equal(again.images[one.name], frame.images[one.name])
            assert np.allclose(one.camera_from_lidar, other.camera_from_lidar, atol=1e-9)
            assert one.distortion == other.distortion
            there, _ = project_points(frame.points, one)
            back, _ = project_points(frame.points, other)
            assert np.allclose(there, back, atol=1e-6, equal_nan=True)
    assert dataset.check() == []
    assert any("objects: /labels, 3 messages" in line for line in dataset.describe())


def test_compressed_images_and_another_process(tmp_path):
    write_bag(moving_frames(2), tmp_path / "drive.mcap")
    dataset = pickle.loads(pickle.dumps(BagDataset(tmp_path / "drive.mcap")))
    image = dataset[1].images["left"]
    assert np.abs(image.astype(int) - 61).max() <= 2


def test_objects_of_topics_are_fused_and_written_as_a_bag_again(tmp_path):
    path = tmp_path / "drive.mcap"
    write_drive_with_objects(path)
    arguments = ["--lidar", "topic:/lidar/objects", "--camera", "topic:/front/objects,/left/objects"]
    out = tmp_path / "fused"
    dataset = f"bag:{path}?labels=/labels"
    result = CliRunner().invoke(app, ["run", dataset, *arguments, "--out", str(out), "--format", "mcap", "--json"])
    assert result.exception is None, result.output
    # from the JSON's first brace: what is logged comes before it
    assert json.loads(result.output[result.output.index("{") :])["frames"] == 4
    fused = BagDataset(out / "fused.mcap", labels="/fused/objects")
    assert {"/fused/markers", "/lidar/points", "/tf"} <= set(fused.bag.topics)
    found = fused.frame(fused.ids[2]).labels
    # the ghost that no camera confirms is left with a low score
    assert sorted(np.round(found.scores, 1))[0] < 0.12
    found = found[found.scores > 0.3]
    assert len(found) == 4
    expected = boxes_of(2).boxes
    order = [int(np.argmin(np.linalg.norm(found.boxes[:, :2] - box[:2], axis=1))) for box in expected]
    assert sorted(order) == [0, 1, 2, 3]
    assert np.allclose(found.boxes[order], expected, atol=1e-4)


def write_drive_with_objects(path, frames=4, speed=None):
    """A drive whose objects come in the vehicle's frame; the ghost that only the LiDAR branch has is in view.

    With a speed (m/s) the vehicle moves in an odometry frame.
    """
    writer = BagWriter(path)
    base_from_lidar = np.eye(4)
    base_from_lidar[:3, 3] = 1.2, 0, 1.8
    for i in range(frames):
        seconds, make = 50.0 + 0.1 * i, writer.make
        labels = boxes_of(i)
        for name, pose in {"lidar": base_from_lidar}.items():
            _write_tf(writer, "base_link", name, pose, seconds)
        if speed is not None:
            moved = np.eye(4)
            moved[0, 3] = speed * 0.1 * i
            _write_tf(writer, "odom", "base_link", moved, seconds)
        for name, pose in POSES.items():
            _write_tf(writer, "lidar", name, invert_rigid(pose), seconds)
            seen = camera(name)
            writer.write(f"/{name}/camera_info", _info(make, seen, seconds), seconds)
            image = make(
                "sensor_msgs/msg/Image",
                header=ros.make_header(make, seconds + 0.01, name),
                height=320, width=640, encoding="mono8", is_bigendian=0, step=640,
                data=np.full(320 * 640, 90, np.uint8),
            )  # fmt: skip
            writer.write(f"/{name}/image_raw", image, seconds + 0.01)
            boxes, visible = project_boxes(labels.boxes, seen)
            found = Detections2D(boxes[visible], np.full(visible.sum(), 0.9), labels.labels[visible], CLASSES)
            writer.write(
                f"/{name}/objects", ros.vision_from_detections_2d(make, found, seconds + 0.01, name), seconds + 0.02
            )
        writer.write("/points", ros.cloud_from_points(make, scan_of(labels, i), seconds, "lidar"), seconds)
        writer.write("/labels", ros.vision_from_detections_3d(make, labels, seconds, "lidar"), seconds)
        moved = labels.boxes + np.array([1.2, 0, 1.8, 0, 0, 0, 0])
        ghost = np.array([[16 + 1.2, 0.5, 0.8, 4, 1.8, 1.5, 0]])
        boxes = Detections3D(
            np.vstack([moved, ghost]), [0.8, 0.8, 0.8, 0.8, 0.12], [*labels.labels.tolist(), 0], CLASSES
        )
        writer.write("/lidar/objects", ros.vision_from_detections_3d(make, boxes, seconds, "base_link"), seconds)
    writer.close()


def _write_tf(writer, parent, child, pose, seconds):
    from lcf3d.datasets.bag_export import _transform

    message = writer.make("tf2_msgs/msg/TFMessage", transforms=[_transform(writer.make, seconds, parent, child, pose)])
    writer.write("/tf_static", message, seconds)


def _info(make, seen: Camera, seconds):
    from lcf3d.datasets.bag_export import _info as info

    return info(make, seen, seconds)


def test_an_image_taken_later_is_seen_from_where_the_vehicle_was_then():
    tree = TransformTree()
    for i in range(3):
        pose = np.eye(4)
        pose[0, 3] = 10.0 * i
        tree.add("odom", "base_link", pose, float(i) * 0.1)
    mount = np.eye(4)
    mount[:3, 3] = 1, 0, 2
    tree.add("base_link", "lidar", mount, None)
    tree.add("base_link", "cam", np.eye(4), None)
    # 20 ms later the vehicle is 2 m ahead: what the LiDAR has at its place is 1 m behind the camera then
    found = tree.lookup("cam", 0.12, "lidar", 0.1)
    assert np.allclose(found[:3, 3], [1 - 2, 0, 2])
    assert np.allclose(tree.lookup("cam", 0.1, "lidar", 0.1)[:3, 3], [1, 0, 2])
    with pytest.raises(DatasetError, match=r"no transform within 0\.5 s of 7\.000 s"):
        tree.lookup("cam", 7.0, "lidar", 0.1)
    with pytest.raises(DatasetError, match="no transform leads from frame 'radar' to 'cam'; frames of the bag: base"):
        tree.lookup("cam", 0.1, "radar", 0.1)


def test_regions_of_interest_and_autoware_objects_are_objects_too(tmp_path):
    writer = BagWriter(tmp_path / "a.mcap")
    make = writer.make
    labels = Detections3D(boxes_of(0).boxes[:1], [0.75], [0], ("car",))
    (found,) = ros.autoware_from_detections_3d(make, labels, 1.0, "lidar").objects
    roi = make("sensor_msgs/msg/RegionOfInterest", x_offset=10, y_offset=20, height=30, width=40, do_rectify=False)
    cloud = ros.cloud_from_points(make, np.zeros((0, 4), np.float32), 1.0, "front")
    kind = "tier4_perception_msgs/msg/"
    feature = make(f"{kind}Feature", cluster=cloud, roi=roi)
    both = make(f"{kind}DetectedObjectWithFeature", object=found, feature=feature)
    message = make(
        f"{kind}DetectedObjectsWithFeature", header=ros.make_header(make, 1.0, "front"), feature_objects=[both]
    )
    writer.write("/rois", message, 1.0)
    writer.write("/points", ros.cloud_from_points(make, scan_of(labels, 0), 1.0, "lidar"), 1.0)
    writer.write("/objects", ros.autoware_from_detections_3d(make, labels, 1.0, "lidar"), 1.0)
    writer.close()
    dataset = BagDataset(tmp_path / "a.mcap")
    assert dataset.class_names == ("car",)
    seen = dataset.objects_2d("/rois", "front", dataset.ids[0])
    assert seen.boxes.tolist() == [[10, 20, 50, 50]]
    assert seen.scores.tolist() == [0.75]
    assert np.allclose(dataset.objects_3d("/objects", dataset.ids[0]).boxes, labels.boxes)


def test_memory_does_not_grow_with_the_bag(tmp_path):
    points = np.zeros((60_000, 4), np.float32)
    points[:, 0] = 5
    frames = (Frame(f"f{i}", points, timestamp=1.0 + i) for i in range(30))
    write_bag(frames, tmp_path / "long")
    tracemalloc.start()
    dataset = BagDataset(tmp_path / "long")
    for frame in dataset:
        assert len(frame.points) == 60_000
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    # 29 MB of clouds, one of them at a time
    assert peak < 12e6


def test_several_roots_are_trees_of_their_own(caplog):
    tree = TransformTree()
    at = np.eye(4)
    at[0, 3] = 2.0
    tree.add("base", "lidar", at, None)
    tree.add("map", "drone", at, None)
    assert tree.root("lidar") == "base"
    assert tree.root("drone") == "map"
    with pytest.raises(DatasetError, match=r"no transform leads from frame 'drone' to 'lidar'; frames of the bag"):
        tree.lookup("lidar", 0.0, "drone", 0.0)
    # two localizations of one vehicle: the second must not be mixed into the first
    for second in range(3):
        for parent, metres in (("odom", float(second)), ("world", 1000.0)):
            pose = np.eye(4)
            pose[0, 3] = metres
            tree.add(parent, "base", pose, second + (0.01 if parent == "world" else 0.0))
    assert tree.root("lidar") == "odom"
    assert tree.root_from("lidar", 1.2)[0, 3] == pytest.approx(3.2)
    said = [record.getMessage() for record in caplog.records]
    assert said == ["frame base hangs below odom and below world; only the first is used"]


def test_a_rosbag2_folder_with_mcap_storage(tmp_path):
    """What ROS 2 writes by default since Iron."""
    from rosbags.rosbag2 import Reader, StoragePlugin, Writer

    write_bag(moving_frames(3), tmp_path / "sqlite")
    with (
        Reader(tmp_path / "sqlite") as reader,
        Writer(tmp_path / "mcap", version=9, storage_plugin=StoragePlugin.MCAP) as writer,
    ):
        ways = {
            c.id: writer.add_connection(c.topic, c.msgtype, msgdef=c.msgdef.data, rihs01=c.digest)
            for c in reader.connections
        }
        for connection, stamp, raw in reader.messages():
            writer.write(ways[connection.id], stamp, raw)
    assert list((tmp_path / "mcap").glob("*.mcap"))
    first, second = BagDataset(tmp_path / "sqlite"), BagDataset(tmp_path / "mcap")
    assert first.ids == second.ids
    for a, b in zip(first, second, strict=True):
        assert np.array_equal(a.points, b.points)
        assert np.array_equal(a.images["front"], b.images["front"])
    assert len(second.ids) == 3


@pytest.mark.parametrize("name", FORMS)
def test_a_bag_that_is_cut_off(tmp_path, name):
    write_bag(moving_frames(3), tmp_path / name)
    path = tmp_path / name
    file = path if path.is_file() else next(path.glob("*.db3"))
    file.write_bytes(file.read_bytes()[: file.stat().st_size // 2])
    with pytest.raises(FormatError, match="cut off or no bag") as error:
        _ = [frame.points for frame in BagDataset(path)]
    assert "\n" not in str(error.value)


def test_topics_without_calibration_strange_types_and_clocks_that_jump(tmp_path):
    writer = BagWriter(tmp_path / "a.mcap")
    make = writer.make
    for i, seconds in enumerate((10.0, 10.1, 4.0)):
        writer.write("/points", ros.cloud_from_points(make, np.ones((5, 4), np.float32), seconds, "lidar"), 10.0 + i)
    writer.write("/note", make("std_msgs/msg/String", data="x"), 10.0)
    image = make(
        "sensor_msgs/msg/CompressedImage",
        header=ros.make_header(make, 10.0, "c"),
        format="jpeg",
        data=np.zeros(1, np.uint8),
    )
    writer.write("/cam/image/compressed", image, 10.0)
    writer.close()
    path = tmp_path / "a.mcap"
    with pytest.raises(
        DatasetError, match="no image topic has a calibration: /cam/image/compressed has no calibration"
    ):
        BagDataset(path)
    with pytest.raises(DatasetError, match="/cam/camera_info is not in"):
        BagDataset(path, cameras="/cam/image/compressed")
    with pytest.raises(ConfigError, match=r"topic /note of .* holds std_msgs/msg/String, which is none of sensor_msgs"):
        BagDataset(path, points="/note")
    with pytest.raises(ConfigError, match="has no topic '/lidar'; of that kind it has /points"):
        BagDataset(path, points="/lidar")
    with pytest.raises(
        DatasetError, match=r"the stamps of /points jump back by 6\.1 s at message 2; cut a\.mcap there"
    ):
        BagReader(path).index(["/points"])
    with pytest.raises(DatasetError, match="does not exist"):
        BagReader(tmp_path / "b.mcap")
    with pytest.raises(ConfigError, match="exists"):
        BagWriter(path)
    (tmp_path / "c.mcap").write_text("nothing")
    with pytest.raises(FormatError, match="cut off or no bag"):
        BagReader(tmp_path / "c.mcap")


def test_topics_are_for_bags(tmp_path):
    root = write_plain_folder(tmp_path / "drive", 1)
    from lcf3d.datasets.bag_topics import lidar_topic

    with pytest.raises(ConfigError, match="run it on bag:FILE"):
        lidar_topic("/objects", CLASSES, FolderDataset(root))
