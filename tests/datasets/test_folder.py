from dataclasses import replace

import numpy as np
import pytest
import yaml

from lcf3d.datasets.folder import FolderDataset
from lcf3d.datasets.folder_export import write_folder
from lcf3d.datasets.folder_init import init_folder
from lcf3d.datasets.folder_poses import AXES, axes_of
from lcf3d.datasets.folder_sensors import canonical_from_axes
from lcf3d.distortion import Distortion
from lcf3d.errors import ConfigError, DatasetError, FormatError
from lcf3d.files import write_json
from lcf3d.formats.kitti import objects_from_detections, objects_from_detections_2d, write_objects
from lcf3d.formats.plain import write_detections_3d
from lcf3d.formats.tables import write_table_2d, write_table_3d
from lcf3d.geometry.boxes import transform_boxes
from lcf3d.geometry.camera import project_boxes
from lcf3d.geometry.rotation import invert_rigid, quaternions_from_matrices
from lcf3d.structures import Detections2D
from tests.datasets.plain_folder import (
    CLASSES,
    FRONT_FROM_LIDAR,
    LEFT_FROM_LIDAR,
    boxes_of,
    camera,
    plain_sensors,
    scan_of,
    write_plain_folder,
    write_sensors,
)


@pytest.fixture
def root(tmp_path):
    return write_plain_folder(tmp_path / "drive")


def findings(root, rule, **arguments):
    return [f for f in FolderDataset(root).check(**arguments) if f.id == rule]


def test_frames_are_what_the_files_hold(root):
    dataset = FolderDataset(root)
    assert dataset.ids == ("f00", "f01", "f02", "f03")
    frame = dataset.frame("f01")
    assert np.array_equal(frame.points, scan_of(boxes_of(1), 1))
    assert np.allclose(frame.labels.boxes, boxes_of(1).boxes)
    assert frame.images["left"].shape == (320, 640, 3)
    assert np.array_equal(frame.camera("front").camera_from_lidar, FRONT_FROM_LIDAR)
    assert dataset.check() == []
    assert len(dataset.lidar_results(root / "lidar_results", CLASSES).detect(frame)) == 5


def test_axes_have_names():
    # nuScenes' LiDAR: x right, y forward
    assert canonical_from_axes("right-forward-up").tolist() == [[0, 1, 0], [-1, 0, 0], [0, 0, 1]]
    assert [axes_of(canonical_from_axes(axes)) for axes in AXES] == list(AXES)
    assert all(np.linalg.det(canonical_from_axes(axes)) == 1 for axes in AXES)


def test_scans_and_poses_in_other_axes_give_the_same_frame(root):
    """nuScenes' axes for the LiDAR, poses on the vehicle (z up from the ground), cameras as bodies."""
    expected = FolderDataset(root).frame("f00")
    assert expected.points is not None  # read before the files change
    own_from_lidar = invert_rigid(_turn("right-forward-up"))
    ego_from_lidar = np.eye(4)
    ego_from_lidar[:3, 3] = 1.0, 0.0, 1.8
    for path in (root / "scans").glob("*.bin"):
        points = np.fromfile(path, "<f4").reshape(-1, 4)
        points[:, :3] = points[:, :3] @ own_from_lidar[:3, :3].T
        points.tofile(path)

    def change(values):
        values["lidars"]["top"].update(
            axes="right-forward-up", ego_from_sensor=(ego_from_lidar @ invert_rigid(own_from_lidar)).tolist()
        )
        front = values["cameras"]["front"]
        del front["camera_from_lidar"]
        body_from_optical = _turn("right-down-forward")
        pose = ego_from_lidar @ invert_rigid(FRONT_FROM_LIDAR) @ invert_rigid(body_from_optical)
        quaternion = quaternions_from_matrices(pose[None, :3, :3])[0]
        front.update(
            axes="forward-left-up",
            ego_from_sensor={"rotation": quaternion.tolist(), "translation": pose[:3, 3].tolist()},
        )
        values["cameras"]["left"]["camera_from_lidar"] = (LEFT_FROM_LIDAR @ invert_rigid(own_from_lidar)).tolist()

    write_sensors(root, change)
    dataset = FolderDataset(root)
    frame = dataset.frame("f00")
    assert np.allclose(frame.points, expected.points, atol=1e-5)
    for name in ("front", "left"):
        assert np.allclose(frame.camera(name).camera_from_lidar, expected.camera(name).camera_from_lidar, atol=1e-9)
    assert np.allclose(dataset.native_from_canonical, own_from_lidar)
    assert dataset.check() == []


def test_several_lidars_are_merged_in_the_frame_of_the_first(root):
    second = np.eye(4)
    second[:3, 3] = 0, 1.5, 0.3
    (root / "rear").mkdir()
    for path in (root / "scans").glob("*.bin"):
        points = np.fromfile(path, "<f4").reshape(-1, 4)[:10]
        points[:, :3] -= second[:3, 3].astype(np.float32)
        np.save(root / "rear" / f"{path.stem}.npy", points)
    write_sensors(root, lambda v: v["lidars"].update(rear={"scans": "rear", "ego_from_sensor": second.tolist()}))
    points = FolderDataset(root).frame("f02").points
    assert np.allclose(points[-10:], points[:10], atol=1e-6)


def test_files_come_together_by_the_time_in_their_names(root):
    for i, path in enumerate(sorted((root / "scans").iterdir())):
        path.rename(path.with_stem(str(1_600_000_000_000_000_000 + i * 100_000_000)))
    for i, path in enumerate(sorted((root / "images/front").iterdir())):
        path.rename(path.with_stem(str(1_600_000_000_020_000_000 + i * 100_000_000)))
    for i, path in enumerate(sorted((root / "images/left").iterdir())):
        # two of them too late for any scan
        path.rename(path.with_stem(str(1_600_000_000_000_000_000 + (i + 10 * (i > 1)) * 100_000_000)))
    write_sensors(root, lambda v: v.pop("labels"))
    with pytest.raises(DatasetError, match=r"none of the 4 files of camera front, .* write 'match: time'"):
        FolderDataset(root)
    write_sensors(root, lambda v: (v.pop("labels"), v.update(match="time")))
    dataset = FolderDataset(root)
    assert [sorted(dataset.frame(i).images) for i in dataset.ids] == [["front", "left"]] * 2 + [["front"]] * 2
    assert dataset.unmatched == {"camera left": 2}
    assert dataset.frame(dataset.ids[1]).timestamp == pytest.approx(1_600_000_000.1)
    assert dataset.frame(dataset.ids[3]).images["front"][0, 0, 0] == 80


def test_times_poses_and_sweeps(root):
    (root / "times.csv").write_text("frame,timestamp\n" + "".join(f"f{i:02d},{i * 0.1}\n" for i in range(4)))
    (root / "poses.txt").write_text("".join(f"1 0 0 {i} 0 1 0 0 0 0 1 0\n" for i in range(4)))
    write_sensors(root, lambda v: v.update(timestamps="times.csv", poses="poses.txt"))
    frame = FolderDataset(root).frame("f02")
    assert frame.timestamp == pytest.approx(0.2)
    assert frame.world_from_lidar[0, 3] == 2
    first, second = frame.sweeps(5)
    assert first.time_lag_s == pytest.approx(0.1)
    assert second.lidar_from_sweep[0, 3] == -2
    (root / "poses.txt").write_text("1 0 0 0 0 1 0 0 0 0 1 0\n")
    with pytest.raises(FormatError, match="has 1 poses for 4 frames"):
        FolderDataset(root).frame("f02")


def test_labels_and_detections_in_every_form(root):
    dataset = FolderDataset(root)
    cameras = dataset.cameras
    seen = {}
    for i, frame_id in enumerate(dataset.ids):
        labels = boxes_of(i)
        boxes2d, visible = project_boxes(labels.boxes, cameras[0])
        objects = objects_from_detections(labels[visible], boxes2d[visible], FRONT_FROM_LIDAR)
        write_objects(root / "kitti" / f"{frame_id}.txt", replace(objects, scores=None))
        write_objects(root / "kitti_results" / f"{frame_id}.txt", objects)
        for camera_name in ("front", "left"):
            found, in_view = project_boxes(labels.boxes, camera(camera_name))
            seen[frame_id, camera_name] = Detections2D(
                found[in_view], np.full(in_view.sum(), 0.5), labels.labels[in_view], CLASSES
            )
            write_objects(
                root / "by_camera" / camera_name / f"{frame_id}.txt",
                objects_from_detections_2d(seen[frame_id, camera_name]),
            )
    write_table_3d(root / "labels.parquet", {i: boxes_of(n) for n, i in enumerate(dataset.ids)})
    write_table_2d(root / "seen.parquet", seen)
    write_json(root / "coco.json", _coco(seen))
    frame = dataset.frame("f01")
    for labels, count in (("labels.parquet", 4), ("kitti", 3)):
        write_sensors(root, lambda v, labels=labels: v.update(labels=labels))
        found = FolderDataset(root).frame("f01").labels
        assert len(found) == count
        assert np.allclose(found.boxes, boxes_of(1).boxes[[0, 1, 3]] if count == 3 else boxes_of(1).boxes, atol=1e-3)
    assert len(dataset.lidar_results(root / "kitti_results", CLASSES).detect(frame)) == 3
    assert len(dataset.lidar_results(root / "labels.parquet", CLASSES).detect(frame)) == 4
    expected = seen["f01", "left"].boxes
    for form in ("seen.parquet", "coco.json", "by_camera", "camera_results"):
        source = dataset.camera_results(root / form, CLASSES)
        assert np.allclose(source.detect(frame, "left").boxes, expected, atol=1e-3), form
    with pytest.raises(DatasetError, match=r"put those of front, left each into a folder"):
        dataset.camera_results(root / "kitti_results", CLASSES)
    with pytest.raises(DatasetError, match="holds COCO JSON, which has no 3D boxes"):
        dataset.lidar_results(root / "coco.json", CLASSES)


def _coco(seen):
    images = [{"id": n, "file_name": f"{camera}/{frame}.png"} for n, (frame, camera) in enumerate(seen)]
    annotations = [
        {"image_id": n, "category_id": int(label), "bbox": [x1, y1, x2 - x1, y2 - y1], "score": 0.5}
        for n, found in enumerate(seen.values())
        for (x1, y1, x2, y2), label in zip(found.boxes.tolist(), found.labels, strict=True)
    ]
    categories = [{"id": i, "name": name} for i, name in enumerate(CLASSES)]
    return {"images": images, "categories": categories, "annotations": annotations}


def _turn(axes):
    turn = np.eye(4)
    turn[:3, :3] = canonical_from_axes(axes)
    return turn


MISTAKES = {
    "camera_from_lidar is inverted: give the inverse": invert_rigid,
    "its axes are forward-left-up": lambda pose: invert_rigid(invert_rigid(_turn("right-down-forward"))) @ pose,
    "rotation of camera_from_lidar is transposed": lambda pose: np.vstack(
        [np.hstack([pose[:3, :3].T, pose[:3, 3:]]), [[0, 0, 0, 1]]]
    ),
}


@pytest.mark.parametrize("words", MISTAKES)
@pytest.mark.parametrize("name", ["front", "left"])
def test_the_check_finds_a_wrong_pose_from_boxes(root, words, name):
    def change(values):
        pose = np.array(values["cameras"][name]["camera_from_lidar"])
        values["cameras"][name]["camera_from_lidar"] = MISTAKES[words](pose).tolist()

    write_sensors(root, change)
    (finding,) = findings(root, "FLD02", results=root / "camera_results")
    assert finding.severity == "error"
    assert f"camera {name}:" in finding.message
    assert words in finding.message


def test_the_check_finds_an_inverted_pose_from_the_way_up_alone(root):
    def change(values):
        values["cameras"]["front"]["camera_from_lidar"] = invert_rigid(FRONT_FROM_LIDAR).tolist()
        del values["labels"]

    write_sensors(root, change)
    (finding,) = findings(root, "FLD02")
    assert "image-up that points up" in finding.message
    assert "inverted" in finding.message


def test_the_check_finds_a_quaternion_in_another_order(root):
    w, x, y, z = quaternions_from_matrices(FRONT_FROM_LIDAR[None, :3, :3])[0].tolist()

    def change(values):
        pose = {"rotation": [x, y, z, w], "translation": FRONT_FROM_LIDAR[:3, 3].tolist()}
        values["cameras"]["front"]["camera_from_lidar"] = pose

    write_sensors(root, change)
    (finding,) = findings(root, "FLD02", results=root / "camera_results")
    assert "x, y, z, w" in finding.message


def test_the_check_finds_wrong_axes_of_scans_and_labels(root):
    write_sensors(root, lambda v: v["lidars"]["top"].update(axes="forward-right-down"))
    (finding,) = findings(root, "FLD03")
    assert "above the LiDAR" in finding.message
    assert "forward-left-up" in finding.message
    write_sensors(root, lambda v: v["lidars"]["top"].update(axes="right-forward-up"))
    (finding,) = findings(root, "FLD04")
    assert "or the first LiDAR's axes are forward-left-up" in finding.message
    write_sensors(root)
    turned = invert_rigid(_turn("right-forward-up"))
    for i in range(4):
        labels = boxes_of(i)
        write_detections_3d(
            root / "labels" / f"f{i:02d}.json", replace(labels, boxes=transform_boxes(labels.boxes, turned))
        )
    (finding,) = findings(root, "FLD04")
    assert "with 'label_axes: right-forward-up'" in finding.message
    write_sensors(root, lambda v: v.update(label_axes="right-forward-up"))
    assert findings(root, "FLD04") == []


def test_strange_classes_left_files_and_intensities_are_told(root):
    write_sensors(root, lambda v: v.update(classes=["car", "tram"]))
    (finding,) = findings(root, "FLD05")
    assert "labels of person (4) are left out" in finding.message
    (root / "images/left/late.png").write_bytes((root / "images/left/f00.png").read_bytes())
    assert [f.message for f in findings(root, "FLD01")] == ["1 files of camera left belong to no frame"]
    points = np.fromfile(root / "scans/f00.bin", "<f4").reshape(-1, 4)
    points[:, 3] *= 200
    points.tofile(root / "scans/f00.bin")
    (finding,) = findings(root, "FLD06")
    assert "intensity_scale: 0.00392157" in finding.message


def test_init_writes_what_can_be_read(root):
    (root / "sensors.yaml").unlink()
    sensors, guessed = init_folder(root)
    assert list(sensors.cameras) == ["front", "left"]
    assert sensors.lidars["lidar"].columns == ["x", "y", "z", "intensity"]
    assert sensors.classes == ["car", "person"]
    assert any("intrinsics" in what for what in guessed)
    dataset = FolderDataset(root)
    assert len(dataset) == 4
    assert dataset.frame("f00").labels is not None
    assert any("looks forward" in line for line in dataset.describe())
    with pytest.raises(ConfigError, match="exists; pass --overwrite"):
        init_folder(root)


def test_lenses_are_read_and_written(root, tmp_path):
    lens = {"model": "fisheye", "coefficients": [0.02, -0.004, 0.0, 0.0]}
    write_sensors(root, lambda v: v["cameras"]["front"].update(distortion=lens))
    write_folder(FolderDataset(root), tmp_path / "again", "webp")
    for place in (root, tmp_path / "again"):
        front, left = FolderDataset(place).cameras
        assert front.distortion == Distortion("fisheye", (0.02, -0.004, 0.0, 0.0))
        assert left.distortion is None
    write_sensors(root, lambda v: v["cameras"]["front"].update(distortion={**lens, "coefficients": [1.0]}))
    with pytest.raises(ConfigError, match="needs 4 coefficients"):
        _ = FolderDataset(root).cameras


def test_an_export_comes_back(root, tmp_path):
    write_folder(FolderDataset(root), tmp_path / "again")
    for frame, again in zip(FolderDataset(root), FolderDataset(tmp_path / "again"), strict=True):
        assert np.array_equal(frame.points, again.points)
        assert np.array_equal(frame.images["left"], again.images["left"])
        assert np.allclose(frame.labels.boxes, again.labels.boxes, atol=1e-5)
        for one, other in zip(frame.cameras, again.cameras, strict=True):
            assert np.allclose(one.pixels_from_lidar, other.pixels_from_lidar)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            lambda v: v["cameras"]["front"].update(focal=3),
            "unknown key 'cameras.front.focal'; the keys there are images",
        ),
        (lambda v: v.update(lidar={}), "unknown key 'lidar'; the keys there are cameras, lidars"),
        (lambda v: v["cameras"]["front"].pop("intrinsics"), "cameras.front.intrinsics is missing"),
        (lambda v: v["cameras"]["front"].pop("camera_from_lidar"), "front needs one of camera_from_lidar and ego"),
        (lambda v: v["cameras"]["front"].update(intrinsics=[1, 2]), "intrinsics must be fx, fy, cx, cy or the 9"),
        (lambda v: v["cameras"]["front"].update(camera_from_lidar=[1, 2]), "a pose must be 12 or 16 numbers, got 2"),
        (lambda v: v["cameras"]["front"].update(camera_from_lidar=[2.0] * 16), "not at right angles"),
        (lambda v: v["lidars"]["top"].update(axes="up-up-left"), "axes must point along three different lines"),
        (lambda v: v["lidars"]["top"].update(axes="north"), "axes must be three of forward, back"),
        (lambda v: v["lidars"]["top"].update(axes="forward-right-up"), "pose of camera front mirrors the scene"),
        (
            lambda v: v["cameras"]["front"].update(distortion={"model": "fisheye", "coefficients": [0.1], "k": 1}),
            "unknown key 'cameras.front.distortion.k'; the keys there are model, coefficients",
        ),
        (
            lambda v: v["cameras"]["front"].update(distortion=[0.1, 0.2]),
            "cameras.front.distortion takes keys (model, coefficients), got [0.1, 0.2]",
        ),
        (lambda v: v["cameras"].update(front=3), "cameras.front takes keys (images, intrinsics"),
    ],
)
def test_one_sentence_for_a_sensors_file_that_is_wrong(root, change, message):
    write_sensors(root, change)
    with pytest.raises(ConfigError) as error:
        FolderDataset(root)
    assert message in str(error.value)
    assert "\n" not in str(error.value)


def test_a_scan_that_is_cut_off_is_told_once(root):
    scan = next(path for path in sorted((root / "scans").iterdir()) if path.suffix == ".bin")
    scan.write_bytes(scan.read_bytes()[:-3])
    (told,) = findings(root, "FRM01")
    assert "is cut off" in told.message


def test_folders_that_are_not_there(root, tmp_path):
    with pytest.raises(DatasetError, match=r"sensors.yaml is a file; name the folder"):
        FolderDataset(root / "sensors.yaml")
    with pytest.raises(DatasetError, match="lcf3d init"):
        FolderDataset(tmp_path)
    write_sensors(root, lambda v: v["cameras"]["front"].update(images="nowhere"))
    with pytest.raises(DatasetError, match="the folder of camera front, does not exist"):
        FolderDataset(root)
    (root / "sensors.yaml").write_text("cameras: [")
    with pytest.raises(ConfigError, match="is no YAML file"):
        FolderDataset(root)
    assert yaml.safe_load(yaml.safe_dump(plain_sensors())) == plain_sensors()
