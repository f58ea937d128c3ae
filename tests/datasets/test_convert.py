from pathlib import Path

import numpy as np
import pytest

from lcf3d.datasets.convert import KITTI_NAMES, kitti_labels, nuscenes_labels, write_kitti, write_nuscenes
from lcf3d.datasets.kitti import KittiDataset
from lcf3d.datasets.nuscenes import NuscenesDataset
from lcf3d.datasets.nuscenes_check import check_nuscenes
from lcf3d.errors import ConfigError
from lcf3d.formats.kitti import read_objects
from lcf3d.frame import Frame
from lcf3d.geometry.camera import project_boxes
from lcf3d.structures import KITTI_CLASSES, NUSCENES_CLASSES, Camera, Detections3D

# a stereo camera's projection with a baseline, mounted with a tilt
PROJECTION = np.array([[700.0, 0, 620, 45], [0, 700, 190, 0.2], [0, 0, 1, 0.003]])
TILT = np.array([[1, 0, 0], [0, np.cos(0.02), -np.sin(0.02)], [0, np.sin(0.02), np.cos(0.02)]])
CAMERA_FROM_LIDAR = np.eye(4)
CAMERA_FROM_LIDAR[:3, :3] = TILT @ [[0, -1, 0], [0, 0, -1], [1, 0, 0]]
CAMERA_FROM_LIDAR[:3, 3] = [0.1, -0.2, -0.3]
CAMERA = Camera("left", PROJECTION, CAMERA_FROM_LIDAR, 1240, 370)

BOXES = np.array(
    [
        [15.0, 1, -0.8, 4.2, 1.8, 1.5, 0.3],
        [25.0, -4, -0.7, 0.6, 0.5, 1.8, -2.0],
        [20.0, 5, -0.8, 1.7, 0.6, 1.7, 3.0],
        [-20.0, 0, -0.8, 4.2, 1.8, 1.5, 0.0],
    ]
)


def frame(id: str = "a", names: tuple[str, ...] = KITTI_CLASSES, attributes: list[str] | None = None) -> Frame:
    rng = np.random.default_rng(1)
    points = np.column_stack([rng.uniform(-30, 30, (500, 3)), rng.integers(0, 256, 500) / 255]).astype(np.float32)
    points[:3, :3] = BOXES[:3, :3]
    image = rng.integers(0, 256, (370, 1240, 3), dtype=np.uint8)
    labels = Detections3D(
        BOXES,
        np.ones(4),
        np.array([0, 1, 2, 0]),
        names,
        attributes=None if attributes is None else np.array(attributes),
    )
    return Frame(id, points, [CAMERA], {"left": image}, labels)


def test_kitti_layout_and_back(tmp_path: Path) -> None:
    source = frame("some/token")
    assert write_kitti([source], tmp_path, "left", intensity_scale=1) == {"000000": "some/token"}
    assert (tmp_path / "frames.txt").read_text() == "000000 some/token\n"
    (found,) = KittiDataset(tmp_path, split="val")
    np.testing.assert_array_equal(found.points, source.points)
    np.testing.assert_array_equal(found.images["left"], source.images["left"])
    np.testing.assert_allclose(found.camera("left").pixels_from_lidar, CAMERA.pixels_from_lidar, rtol=1e-11)
    assert found.labels is not None
    # the box behind the camera is not seen
    np.testing.assert_allclose(found.labels.boxes, BOXES[:3], atol=2e-4)
    assert [KITTI_CLASSES[label] for label in found.labels.labels] == ["Car", "Pedestrian", "Cyclist"]


def test_nuscenes_layout_and_back(tmp_path: Path) -> None:
    sources = [frame("a"), frame("b")]
    ids = write_nuscenes(sources, tmp_path, {"left": "CAM_FRONT"})
    assert list(ids.values()) == ["a", "b"]
    dataset = NuscenesDataset(tmp_path)
    assert dataset.ids == tuple(ids)
    assert {finding.id for finding in check_nuscenes(tmp_path)} == {"NUS09"}
    found = dataset[1]
    assert found.points is not None
    assert sources[1].points is not None
    np.testing.assert_allclose(found.points, sources[1].points * [1, 1, 1, 255], atol=1e-4)
    np.testing.assert_array_equal(found.images["CAM_FRONT"], sources[1].images["left"])
    camera = found.camera("CAM_FRONT")
    np.testing.assert_allclose(project_boxes(BOXES, camera)[0], project_boxes(BOXES, CAMERA)[0], atol=1e-6)
    # the box behind holds no point: no label in nuScenes' sense
    assert found.labels is not None
    np.testing.assert_allclose(found.labels.boxes, BOXES[:3], atol=1e-9)
    assert [NUSCENES_CLASSES[label] for label in found.labels.labels] == ["car", "pedestrian", "bicycle"]
    assert found.labels.attributes is not None
    assert found.labels.attributes.tolist() == ["", "", "cycle.with_rider"]


def test_there_and_back_again(tmp_path: Path) -> None:
    """KITTI -> nuScenes -> KITTI: the same label lines, now in the coordinates of the colour camera itself."""
    source = frame()
    write_kitti([source], tmp_path / "a", "left", intensity_scale=1)
    write_nuscenes(KittiDataset(tmp_path / "a"), tmp_path / "b", {"left": "CAM_FRONT"})
    write_kitti(NuscenesDataset(tmp_path / "b"), tmp_path / "c", "CAM_FRONT")
    first, last = (read_objects(tmp_path / x / "training/label_2/000000.txt", results=False) for x in "ac")
    assert first.class_names.tolist() == last.class_names.tolist()
    baseline = np.linalg.solve(PROJECTION[:, :3], PROJECTION[:, 3])
    np.testing.assert_allclose(last.locations, first.locations + baseline, atol=2e-4)
    for name in ("dimensions", "rotation_y", "truncated"):
        np.testing.assert_allclose(getattr(last, name), getattr(first, name), atol=2e-4, err_msg=name)
    np.testing.assert_allclose(last.boxes2d, first.boxes2d, atol=0.02)


def test_riders_make_cyclists() -> None:
    labels = frame(
        names=("bicycle", "motorcycle", "barrier"),
        attributes=["cycle.with_rider", "cycle.with_rider", "", "cycle.without_rider"],
    ).labels
    assert labels is not None
    found = kitti_labels(labels)
    assert [KITTI_NAMES[label] for label in found.labels] == ["Cyclist", "Cyclist"]
    assert len(kitti_labels(Detections3D.empty(NUSCENES_CLASSES))) == 0
    back = nuscenes_labels(found)
    assert [NUSCENES_CLASSES[label] for label in back.labels] == ["bicycle", "bicycle"]
    assert back.attributes is not None
    assert back.attributes.tolist() == ["cycle.with_rider"] * 2


def test_truncation_is_the_share_outside_the_image(tmp_path: Path) -> None:
    level = np.array([[0.0, -1, 0, 0], [0, 0, -1, 0], [1, 0, 0, 0], [0, 0, 0, 1]])
    camera = Camera("left", np.array([[100.0, 0, 50, 0], [0, 100, 50, 0], [0, 0, 1, 0]]), level, 100, 100)
    # a thin plate 10 m ahead, 2 m wide, its middle on the left border of the image at y = 5 m
    labels = Detections3D(np.array([[10.0, 5, 0, 1e-6, 2, 1, 0]]), np.ones(1), np.array([0]), KITTI_CLASSES)
    write_kitti([Frame("a", None, [camera], None, labels)], tmp_path, "left")
    objects = read_objects(tmp_path / "training/label_2/000000.txt", results=False)
    np.testing.assert_allclose(objects.truncated, [0.5], atol=1e-4)
    np.testing.assert_allclose(objects.boxes2d, [[0, 45, 10, 55]], atol=1e-3)
    assert objects.occluded.tolist() == [0]
    assert not (tmp_path / "training/velodyne").exists()


def test_bad_input(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="no camera 'right'"):
        write_kitti([frame()], tmp_path, "right")
    with pytest.raises(ConfigError, match="nuScenes has no camera 'front'"):
        write_nuscenes([frame()], tmp_path, {"left": "front"})
    with pytest.raises(ConfigError, match="two frames have the id 'a'"):
        write_nuscenes([frame(), frame()], tmp_path, {"left": "CAM_FRONT"})


@pytest.mark.real
def test_a_real_kitti_frame_as_nuscenes(shared: Path, tmp_path: Path) -> None:
    source = KittiDataset(shared / "data/kitti", split="sensor_val")[0]
    write_nuscenes([source], tmp_path, {"left": "CAM_FRONT"})
    found = NuscenesDataset(tmp_path, min_points=0)[0]
    assert source.labels is not None
    assert found.labels is not None
    np.testing.assert_allclose(found.labels.boxes, source.labels.boxes, atol=1e-9)
    ours, theirs = (
        project_boxes(found.labels.boxes, found.camera("CAM_FRONT")),
        project_boxes(source.labels.boxes, source.camera("left")),
    )
    np.testing.assert_allclose(ours[0], theirs[0], atol=1e-6)


@pytest.mark.real
def test_the_real_nuscenes_frame_as_kitti(shared: Path, tmp_path: Path) -> None:
    source = NuscenesDataset(shared / "data/nuscenes", split="mini_train")[0]
    write_kitti([source], tmp_path, "CAM_FRONT")
    found = KittiDataset(tmp_path, class_names=KITTI_NAMES)[0]
    assert source.labels is not None
    assert found.labels is not None
    expected = kitti_labels(source.labels)
    seen = project_boxes(expected.boxes, source.camera("CAM_FRONT"))[1]
    assert 0 < seen.sum() < len(expected)
    np.testing.assert_allclose(found.labels.boxes, expected.boxes[seen], atol=2e-4)
    assert found.images["left"].shape == (900, 1600, 3)
