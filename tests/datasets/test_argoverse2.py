from pathlib import Path

import numpy as np
import pytest

from lcf3d.datasets.argoverse2 import Argoverse2Dataset
from lcf3d.datasets.argoverse2_frames import detections_by_frame, results_of_frames, split_id
from lcf3d.datasets.argoverse2_log import find_logs, nearest
from lcf3d.errors import DatasetError
from lcf3d.geometry.boxes import points_in_boxes
from lcf3d.geometry.camera import project_points
from lcf3d.structures import ARGOVERSE_CLASSES
from tests.datasets.argoverse_log import FIRST_NS, LOG, SPEED, STEP_NS, sweep_time, write_log

pytest.importorskip("pyarrow", reason="needs pyarrow (extra formats)")


@pytest.fixture
def root(tmp_path: Path) -> Path:
    write_log(tmp_path)
    return tmp_path


def test_frames_are_the_sweeps_and_the_annotated_moments(root: Path) -> None:
    dataset = Argoverse2Dataset(root)
    assert dataset.ids == tuple(f"{LOG}_{sweep_time(i)}" for i in range(3))
    assert len(dataset) == 3
    first, last = dataset[0], dataset[2]
    assert first.points is not None
    assert first.points.shape == (7, 5)
    assert last.points is None
    assert first.labels is not None
    assert [ARGOVERSE_CLASSES[i] for i in first.labels.labels] == ["REGULAR_VEHICLE", "PEDESTRIAN"]
    assert first.timestamp == pytest.approx(FIRST_NS * 1e-9)
    assert first.sequence == LOG


def test_poses(root: Path) -> None:
    poses = [frame.world_from_lidar for frame in Argoverse2Dataset(root)]
    assert [pose[0, 3] for pose in poses if pose is not None] == pytest.approx([0, 0.1 * SPEED, 0.2 * SPEED])


def test_scan_labels_and_calibration_agree(root: Path) -> None:
    frame = Argoverse2Dataset(root)[0]
    assert frame.points is not None
    assert frame.labels is not None
    assert points_in_boxes(frame.points, frame.labels.boxes).sum(axis=1).tolist() == [7, 0]
    # the image ahead was taken 25 ms after the sweep, when the vehicle had moved on by 0.25 m
    pixels, depths = project_points(np.array([[21.0, 1.0, 1.5], [1.0, 10.5, 1.5]]), frame.camera("ring_front_center"))
    assert depths[0] == pytest.approx(20 - 0.25)
    np.testing.assert_allclose(pixels[0], [50 - 100 / 19.75, 40])
    # the one to the left at once
    pixels, depths = project_points(np.array([[2.0, 10.5, 1.5]]), frame.camera("ring_side_left"))
    assert depths[0] == pytest.approx(10)
    np.testing.assert_allclose(pixels[0], [60, 40])


def test_images(root: Path) -> None:
    frame = Argoverse2Dataset(root)[1]
    assert set(frame.images) == {"ring_front_center", "ring_side_left"}
    assert frame.images["ring_side_left"].shape == (80, 100, 3)
    # 25 ms are too much: no image, and the camera stands where it stood at the sweep
    strict = Argoverse2Dataset(root, max_camera_delay_s=0.02)[1]
    assert set(strict.images) == {"ring_side_left"}
    _, depths = project_points(np.array([[21.0, 1.0, 1.5]]), strict.camera("ring_front_center"))
    assert depths[0] == pytest.approx(20)


def test_a_log_without_images_or_annotations(tmp_path: Path) -> None:
    folder = write_log(tmp_path, images=False, split="test")
    (folder / "annotations.feather").unlink()
    dataset = Argoverse2Dataset(folder)
    assert len(dataset) == 2
    assert dataset[0].labels is None
    assert not dataset[0].images
    assert len(dataset[0].cameras) == 2
    assert len(dataset.ground_truth()) == 0


def test_annotations_with_few_points_can_be_left_out(root: Path) -> None:
    assert len(Argoverse2Dataset(root, min_points=6)[0].labels or "") == 0


def test_splits_and_logs(root: Path) -> None:
    write_log(root, log="other", split="train")
    assert [f.name for f in find_logs(root)] == ["other", LOG]
    assert Argoverse2Dataset(root).log_ids == ("other", LOG)
    assert Argoverse2Dataset(root, "val").log_ids == (LOG,)
    assert Argoverse2Dataset(root, log="other").log_ids == ("other",)
    assert Argoverse2Dataset(root / "val").log_ids == (LOG,)
    with pytest.raises(DatasetError, match=r"no Argoverse 2 log of split 'test'.* logs found: 2, splits: train, val"):
        Argoverse2Dataset(root, "test")
    with pytest.raises(DatasetError, match="logs found: 0, splits: none"):
        Argoverse2Dataset(root / "val" / LOG / "sensors")


def test_frames_that_are_not_there(root: Path) -> None:
    dataset = Argoverse2Dataset(root)
    with pytest.raises(DatasetError, match="has no log 'x'"):
        dataset.frame("x_1")
    with pytest.raises(DatasetError, match="has no pose within 20 ms of 5 ns"):
        dataset.frame(f"{LOG}_5")
    with pytest.raises(DatasetError, match="is named LOG_TIME"):
        dataset.frame("000001")


def test_results_by_frame_and_back(root: Path) -> None:
    dataset = Argoverse2Dataset(root)
    truth = dataset.ground_truth()
    by_frame = detections_by_frame(truth)
    assert list(by_frame) == list(dataset.ids)
    assert [len(found) for found in by_frame.values()] == [2, 1, 1]
    again = results_of_frames(by_frame)
    assert again.timestamps_ns.tolist() == sorted(truth.timestamps_ns.tolist())
    assert detections_by_frame(truth[:0]) == {}


def test_nearest() -> None:
    times = np.array([10, 20, 40])
    assert [nearest(times, t) for t in (0, 14, 16, 20, 31, 99)] == [0, 0, 1, 1, 2, 2]
    assert nearest(times[:0], 5) == -1
    assert split_id("a_b_12") == ("a_b", 12)


@pytest.mark.real
def test_the_real_log(shared: Path) -> None:
    dataset = Argoverse2Dataset(shared / "data/argoverse2")
    assert len(dataset) == 156
    scans = [i for i in dataset.ids if split_id(i)[1] in dataset.log(dataset.log_ids[0]).sweeps]
    assert len(scans) == 2
    for frame in map(dataset.frame, scans):
        assert len(frame.cameras) == 9
        annotations = dataset.log(dataset.log_ids[0]).annotations
        assert annotations is not None
        assert frame.points is not None
        assert frame.labels is not None
        rows = (annotations.timestamps_ns == split_id(frame.id)[1]) & (annotations.point_counts > 0)
        # the annotators' own counts, within the rounding of half floats
        inside = points_in_boxes(frame.points, frame.labels.boxes).sum(axis=1)
        np.testing.assert_allclose(inside, annotations.point_counts[rows], atol=2, rtol=0.02)
    step = np.diff([frame.timestamp for frame in dataset if frame.timestamp is not None])
    np.testing.assert_allclose(step, STEP_NS * 1e-9, atol=2e-3)
