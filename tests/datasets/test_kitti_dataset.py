import numpy as np
import pytest
from PIL import Image

from lcf3d.datasets.kitti import KittiDataset, read_points
from lcf3d.datasets.kitti_calibration import read_calibration
from lcf3d.datasets.opening import named, open_dataset
from lcf3d.errors import Lcf3dError
from lcf3d.formats.kitti import KittiObjects, write_objects
from tests.datasets.kitti_folder import CAMERA_FROM_LIDAR, LABELS, OBJECTS, P2, SIZE, make_kitti, make_results


@pytest.fixture
def root(tmp_path):
    return make_kitti(tmp_path / "kitti")


def test_frame_holds_what_was_written(root):
    dataset = KittiDataset(root, "val")
    assert dataset.ids == ("000000", "000001", "night_7")
    frame = dataset[2]
    assert frame.id == "night_7"
    assert [c.name for c in frame.cameras] == ["left", "right"]
    np.testing.assert_allclose(frame.cameras[0].projection, P2)
    np.testing.assert_allclose(frame.cameras[0].camera_from_lidar, CAMERA_FROM_LIDAR)
    assert (frame.cameras[0].width, frame.cameras[0].height) == SIZE
    assert frame.points.shape == (5200, 4)
    assert frame.points.dtype == np.float32
    assert frame.images["left"].shape == (375, 1242, 3)
    assert "right" not in frame.images
    np.testing.assert_allclose(frame.labels.boxes, OBJECTS, atol=2e-4)
    assert frame.labels.labels.tolist() == LABELS


def test_calibrations_of_one_text_are_one_until_a_file_changes(root):
    dataset = KittiDataset(root)
    first, second = dataset.frame("000000"), dataset.frame("night_7")
    assert first.cameras[0] is not None
    assert dataset.calibration("000000") is dataset.calibration("night_7")
    assert not dataset.calibration("000000").camera_from_lidar.flags.writeable
    # the right cameras are without an image in both
    assert first.camera("right") is second.camera("right")
    path = root / "training/calib/night_7.txt"
    path.write_text(path.read_text().replace("P2: ", "P2: 1"))
    assert dataset.frame("night_7").cameras[0].projection[0, 0] != P2[0][0]
    assert dataset.frame("000000").cameras[0].projection[0, 0] == P2[0][0]


def test_files_without_lines_and_without_boxes(root):
    lidar, camera = make_results(root)
    write_objects(lidar / "000001.txt", KittiObjects.empty(results=True))
    dataset = KittiDataset(root)
    source = dataset.lidar_results(lidar, ("Car",))
    assert not len(source.detect(dataset.frame("000001")))
    assert source.detect(dataset.frame("000000")).scores.tolist() == [0.9, 0.8]
    assert dataset.lidar_results(lidar, ("Pedestrian",), "empty").class_names == ("Pedestrian",)
    with pytest.raises(Lcf3dError, match="holds no 3D boxes"):
        dataset.lidar_results(camera, ("Car",)).detect(dataset.frame("000000"))


def test_all_frames_without_a_split(root):
    assert len(KittiDataset(root)) == 3


def test_frame_without_sensor_files(root):
    for folder in ("velodyne", "image_2", "label_2"):
        (root / "training" / folder / "000001.txt").unlink(missing_ok=True)
        (root / "training" / folder / "000001.bin").unlink(missing_ok=True)
        (root / "training" / folder / "000001.png").unlink(missing_ok=True)
    frame = KittiDataset(root, "val").frame("000001")
    assert frame.points is None
    assert frame.labels is None
    assert len(frame.images) == 0
    # known from the focal length of the calibration
    assert (frame.cameras[0].width, frame.cameras[0].height) == SIZE


@pytest.mark.parametrize("place", ["training/calib", "training", "."])
def test_frames_cut_from_a_raw_drive_share_the_calibration_of_its_day(root, tmp_path, place):
    from tests.datasets.kitti_drives import make_raw

    own = KittiDataset(root, "val").frame("night_7")
    day = make_raw(tmp_path / "raw") / "2011_09_26"
    for file in (root / "training/calib").iterdir():
        file.unlink()
    with pytest.raises(Lcf3dError, match="lacks 3 of 3 frames"):
        KittiDataset(root, "val").require_complete(("000000", "000001", "night_7"))
    for name in ("calib_cam_to_cam.txt", "calib_velo_to_cam.txt"):
        (day / name).rename(root / place / name)
    for path in (root / "training/image_2").iterdir():
        path.unlink()
    dataset = KittiDataset(root, "val")
    dataset.require_complete(dataset.ids)
    frame = dataset.frame("night_7")
    np.testing.assert_allclose(frame.cameras[0].pixels_from_lidar, own.cameras[0].pixels_from_lidar, atol=1e-4)
    # S_rect_02 tells the size where there is no image
    assert (frame.cameras[0].width, frame.cameras[0].height) == SIZE
    assert KittiDataset(root).ids == dataset.ids
    (root / place / "calib_velo_to_cam.txt").unlink()
    with pytest.raises(Lcf3dError, match=r"calib_velo_to_cam\.txt does not exist"):
        KittiDataset(root, "val").frame("night_7")


def test_tracking_spelling_of_the_calibration(tmp_path):
    from tests.datasets.kitti_folder import calibration_text

    text = calibration_text().replace("R0_rect:", "R_rect").replace("Tr_velo_to_cam:", "Tr_velo_cam")
    (tmp_path / "c.txt").write_text(text)
    np.testing.assert_allclose(read_calibration(tmp_path / "c.txt").camera_from_lidar, CAMERA_FROM_LIDAR)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda t: t.replace("P2:", "Q2:"), "no entry P2"),
        (lambda t: t.replace("R0_rect", "R"), "no entry R0_rect or R_rect"),
        (lambda t: t.replace("P2: 7", "P2: x"), r"c.txt:3: P2 must be followed by numbers"),
        (lambda t: t.replace("P2: 7", "P2: nan 7"), r"c.txt:3: P2 holds NaN"),
        (lambda t: t.replace("P2: ", "P2: 1 "), "P2 must hold 12 numbers, got 13"),
    ],
)
def test_malformed_calibration(tmp_path, change, message):
    from tests.datasets.kitti_folder import calibration_text

    (tmp_path / "c.txt").write_text(change(calibration_text()))
    with pytest.raises(Lcf3dError, match=message):
        read_calibration(tmp_path / "c.txt")


def test_missing_calibration_is_found_before_any_work(root):
    (root / "training" / "calib" / "000001.txt").unlink()
    data = KittiDataset(root, "val")
    with pytest.raises(Lcf3dError, match=r"lacks 1 of 3 frames, first 000001.txt"):
        data.require_complete(data.ids)


def test_bad_scans(tmp_path):
    path = tmp_path / "p.bin"
    path.write_bytes(b"\0" * 30)
    with pytest.raises(Lcf3dError, match="cut off: 30 bytes"):
        read_points(path)
    path.write_bytes(np.array([[1, 2, np.nan, 0], [1, 2, 3, 0]], "<f4").tobytes())
    with pytest.raises(Lcf3dError, match="1 points with NaN"):
        read_points(path)
    with pytest.raises(Lcf3dError, match="does not exist"):
        read_points(tmp_path / "absent.bin")


def test_bad_images(root):
    path = root / "training" / "image_2" / "000000.png"
    path.write_bytes(b"not an image")
    with pytest.raises(Lcf3dError, match="cannot be read as an image"):
        KittiDataset(root, "val").frame("000000")
    Image.new("RGB", (621, 187)).save(path)
    with pytest.raises(Lcf3dError, match=r"621 x 187 pixels, but its calibration.*wrong width"):
        KittiDataset(root, "val").frame("000000")


@pytest.mark.parametrize(("split", "message"), [("train", "the splits there are: val"), ("../val", "does not exist")])
def test_unknown_split(root, split, message):
    with pytest.raises(Lcf3dError, match=message):
        KittiDataset(root, split)


def test_dataset_strings(root, tmp_path):
    assert open_dataset(f"kitti:{root}").root == root
    assert named(str(root)).kind == "kitti"
    (tmp_path / "n" / "v1.0-mini").mkdir(parents=True)
    assert named(str(tmp_path / "n")).kind == "nuscenes"
    for text, message in (
        (f"waymo:{root}", "unknown dataset kind 'waymo'"),
        (str(tmp_path), "cannot tell what dataset"),
        ("kitti:/nowhere", "does not exist"),
    ):
        with pytest.raises(Lcf3dError, match=message):
            open_dataset(text)


@pytest.mark.real
def test_real_frames(shared):
    dataset = KittiDataset(shared / "data" / "kitti", "sensor_val")
    assert len(dataset) == 6
    frame = dataset.frame("000107")
    assert set(frame.images) == {"left", "right"}
    assert frame.points.shape[1] == 4
