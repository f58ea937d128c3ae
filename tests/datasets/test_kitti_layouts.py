from pathlib import Path

import numpy as np
import pytest

from lcf3d.datasets.kitti import KittiDataset
from lcf3d.datasets.kitti_layouts import KittiOdometryDataset, KittiRawDataset, KittiSequences, KittiTrackingDataset
from lcf3d.datasets.opening import open_dataset
from lcf3d.errors import ConfigError, DatasetError, FormatError
from lcf3d.formats.kitti_drives import EARTH_RADIUS_M
from lcf3d.frame import Frame
from lcf3d.geometry.boxes import points_in_boxes
from tests.datasets.kitti_drives import (
    RAW,
    STEP_DEGREES,
    make_odometry,
    make_raw,
    make_tracking,
    moved_lidar,
)
from tests.datasets.kitti_folder import CAMERA_FROM_LIDAR, OBJECTS, left_camera, make_kitti, right_camera

STEP_M = np.radians(STEP_DEGREES) * EARTH_RADIUS_M


def assert_sensors(frame: Frame) -> None:
    """Cameras, image and scan are those of the object layout."""
    for camera, expected in zip(frame.cameras, (left_camera(), right_camera()), strict=True):
        assert camera.name == expected.name
        np.testing.assert_allclose(camera.projection, expected.projection, atol=1e-9)
        np.testing.assert_allclose(camera.camera_from_lidar, CAMERA_FROM_LIDAR, atol=1e-9)
        assert (camera.width, camera.height) == (expected.width, expected.height)
    assert frame.images["left"].shape == (375, 1242, 3)
    assert frame.points is not None
    assert points_in_boxes(frame.points, np.array(OBJECTS)).any(axis=1).all()


def test_tracking(tmp_path: Path) -> None:
    dataset = KittiTrackingDataset(make_tracking(tmp_path))
    assert dataset.ids == tuple(f"{s}_{i:06d}" for s in ("0000", "0001") for i in range(3))
    first = dataset.frame("0000_000000")
    assert_sensors(first)
    assert first.labels is not None
    np.testing.assert_allclose(first.labels.boxes, OBJECTS, atol=2e-3)
    assert dataset.frame("0000_000001").points is None
    # a frame of a labelled sequence without a line has no objects
    assert len(dataset.frame("0000_000002").labels or "") == 0
    assert dataset.frame("0000_000002").labels is not None
    assert [dataset[i].sequence for i in (0, 3)] == ["0000", "0001"]
    assert [dataset[i].timestamp for i in range(3)] == pytest.approx([0, 0.1, 0.2])
    for i in range(3):
        np.testing.assert_allclose(dataset[i].world_from_lidar, moved_lidar(i, STEP_M), rtol=1e-4, atol=1e-4)


def test_tracking_without_labels_or_poses(tmp_path: Path) -> None:
    root = make_tracking(tmp_path, ("0000",))
    (root / "training/label_02/0000.txt").unlink()
    (root / "training/oxts/0000.txt").unlink()
    frame = KittiTrackingDataset(root)[0]
    assert frame.labels is None
    assert frame.world_from_lidar is None
    # poses of the left camera will do
    (root / "poses").mkdir()
    (root / "poses/0000.txt").write_text("1 0 0 4 0 1 0 5 0 0 1 6\n")
    pose = KittiTrackingDataset(root)[0].world_from_lidar
    assert pose is not None
    np.testing.assert_allclose(pose[:3, :3], CAMERA_FROM_LIDAR[:3, :3])
    np.testing.assert_allclose(pose[:3, 3], CAMERA_FROM_LIDAR[:3, 3] + [4, 5, 6])
    assert KittiTrackingDataset(root)[1].world_from_lidar is None


def test_raw(tmp_path: Path) -> None:
    dataset = KittiRawDataset(make_raw(tmp_path))
    assert dataset.ids == (f"{RAW}_0000000000", f"{RAW}_0000000001")
    first, second = dataset
    assert_sensors(first)
    assert first.labels is not None
    assert second.labels is not None
    np.testing.assert_allclose(first.labels.boxes, OBJECTS[:1])
    assert len(second.labels) == 0
    assert (first.timestamp, second.timestamp) == pytest.approx((10.25, 10.353))
    assert first.sequence == RAW
    np.testing.assert_allclose(second.world_from_lidar, moved_lidar(1, STEP_M), rtol=1e-4, atol=1e-4)
    # from the day or the drive itself as well
    for folder in ("2011_09_26", f"2011_09_26/{RAW}"):
        assert KittiRawDataset(tmp_path / folder).ids == dataset.ids


def test_a_raw_drive_that_is_not_rectified(tmp_path: Path) -> None:
    drive = make_raw(tmp_path) / "2011_09_26" / RAW
    drive.rename(drive.with_name(RAW.replace("sync", "extract")))
    with pytest.raises(DatasetError, match="neither rectified nor synchronised; use its _sync form"):
        KittiRawDataset(tmp_path)


def test_raw_without_the_day_s_calibration(tmp_path: Path) -> None:
    (make_raw(tmp_path) / "2011_09_26/calib_velo_to_cam.txt").unlink()
    with pytest.raises(DatasetError, match=r"calib_velo_to_cam\.txt does not exist"):
        _ = KittiRawDataset(tmp_path)[0]


def test_image_sizes_come_from_the_calibration_where_there_are_no_images(tmp_path: Path) -> None:
    day = make_raw(tmp_path) / "2011_09_26"
    for path in (day / RAW / "image_02/data").iterdir():
        path.unlink()
    calibration = day / "calib_cam_to_cam.txt"
    size = "S_rect_02: 1.242000000000e+03 3.750000000000e+02"
    assert size in calibration.read_text()
    calibration.write_text(calibration.read_text().replace(size, "S_rect_02: 1300 400"))
    camera = KittiRawDataset(tmp_path)[0].camera("left")
    assert (camera.width, camera.height) == (1300, 400)


def test_odometry(tmp_path: Path) -> None:
    dataset = KittiOdometryDataset(make_odometry(tmp_path))
    assert dataset.ids == ("00_000000", "00_000001")
    first, second = dataset
    assert_sensors(first)
    assert first.labels is None
    assert second.timestamp == pytest.approx(0.1037)
    expected = CAMERA_FROM_LIDAR.copy()
    expected[2, 3] += 1
    np.testing.assert_allclose(second.world_from_lidar, expected)


def test_splits_and_sequences(tmp_path: Path) -> None:
    root = make_tracking(tmp_path)
    (root / "ImageSets").mkdir()
    (root / "ImageSets/val.txt").write_text("0001\n0000_000002\n")
    ids = ("0000_000002", *(f"0001_{i:06d}" for i in range(3)))
    assert KittiTrackingDataset(root, "val").ids == ids
    assert KittiTrackingDataset(root, "val", sequence="0000").ids == ids[:1]
    # as numbers come from the command line
    assert KittiTrackingDataset(root, sequence="1").ids == ids[1:]
    with pytest.raises(DatasetError, match=r"test.txt does not exist; the splits there are: val"):
        KittiTrackingDataset(root, "test")
    with pytest.raises(DatasetError, match=r"has no sequence .7. among its 2: 0000, 0001"):
        KittiTrackingDataset(root, sequence="7")
    (root / "ImageSets/val.txt").write_text("000001\n")
    with pytest.raises(DatasetError, match="names no sequence and no frame that is there"):
        KittiTrackingDataset(root, "val")
    with pytest.raises(ConfigError, match="has no frame '0009_000000'; its first is '0000_000000'"):
        KittiTrackingDataset(root).frame("0009_000000")


@pytest.mark.parametrize("kind", [KittiRawDataset, KittiTrackingDataset, KittiOdometryDataset])
def test_folders_of_something_else(tmp_path: Path, kind: type[KittiSequences]) -> None:
    with pytest.raises(DatasetError, match="holds no sequence of KITTI's"):
        kind(tmp_path)  # type: ignore[call-arg, arg-type]
    with pytest.raises(DatasetError, match="does not exist"):
        kind(tmp_path / "nowhere")  # type: ignore[call-arg, arg-type]


def test_a_bare_path_is_told_apart(tmp_path: Path) -> None:
    makers = {
        KittiTrackingDataset: make_tracking,
        KittiRawDataset: make_raw,
        KittiOdometryDataset: make_odometry,
        KittiDataset: make_kitti,
    }
    for kind, make in makers.items():
        assert type(open_dataset(make(tmp_path / kind.__name__))) is kind


def test_a_malformed_label_names_file_and_line(tmp_path: Path) -> None:
    root = make_tracking(tmp_path)
    path = root / "training/label_02/0000.txt"
    path.write_text(path.read_text() + "2 1 Car\n")
    with pytest.raises(FormatError, match=r"0000.txt:7: expected the 17 columns of a tracking label, got 3"):
        _ = KittiTrackingDataset(root).ids


@pytest.mark.real
def test_real_tracking_labels(shared: Path, tmp_path: Path) -> None:
    source = shared / "data/kitti_tracking_10hz"
    part = tmp_path / "training"
    (part / "calib").mkdir(parents=True)
    (part / "calib/0000.txt").write_text((source / "training/calib/0000_000000.txt").read_text())
    (part / "label_02").symlink_to(source / "training/label_02")
    (tmp_path / "poses").symlink_to(source / "poses")
    tracking, objects = KittiTrackingDataset(tmp_path), KittiDataset(source)
    assert set(tracking.ids) <= set(objects.ids)
    assert len(tracking) > 150
    for frame_id in tracking.ids[::20]:
        found, expected = tracking.frame(frame_id), objects.frame(frame_id)
        assert found.labels is not None
        assert expected.labels is not None
        np.testing.assert_allclose(found.labels.boxes, expected.labels.boxes, atol=2e-3)
        np.testing.assert_allclose(found.cameras[0].pixels_from_lidar, expected.cameras[0].pixels_from_lidar)
    # the vehicle drives ahead
    poses = [tracking.frame(f"0000_{i:06d}").world_from_lidar for i in (0, 10)]
    assert poses[0] is not None
    assert poses[1] is not None
    ahead = np.linalg.inv(poses[0]) @ poses[1]
    assert ahead[0, 3] > 1
    assert abs(ahead[1, 3]) < 1
