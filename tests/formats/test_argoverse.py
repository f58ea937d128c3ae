from pathlib import Path

import numpy as np
import pytest

from lcf3d.errors import FormatError
from lcf3d.formats.argoverse import (
    Cuboids,
    read_annotations,
    read_calibration,
    read_poses,
    read_submission,
    read_sweep,
    write_submission,
)
from lcf3d.formats.feather import write_columns
from lcf3d.structures import ARGOVERSE_CLASSES, Detections3D
from tests.datasets.argoverse_log import (
    CUBOID,
    FIRST_NS,
    LOG,
    STEP_NS,
    cuboid,
    rows,
    sweep_time,
    write_annotations,
    write_log,
    write_submission_rows,
)

pytest.importorskip("pyarrow", reason="needs pyarrow (extra formats)")
CAR, PEDESTRIAN = ARGOVERSE_CLASSES.index("REGULAR_VEHICLE"), ARGOVERSE_CLASSES.index("PEDESTRIAN")


def test_annotations(tmp_path: Path) -> None:
    found = read_annotations(write_log(tmp_path) / "annotations.feather", LOG)
    assert found.log_ids == (LOG,)
    assert found.labels.tolist() == [CAR, CAR, CAR, PEDESTRIAN]
    assert found.timestamps_ns.tolist() == [*(FIRST_NS + i * STEP_NS for i in range(3)), FIRST_NS]
    np.testing.assert_allclose(found.boxes[0], [21, 0, 1.5, 4, 2, 1.5, 0])
    assert found.point_counts.tolist() == [5] * 4
    assert found.left_out == {"ANIMAL": 1}
    assert found.detections().class_names == ARGOVERSE_CLASSES


def test_headings_lie_in_the_canonical_range(tmp_path: Path) -> None:
    path = tmp_path / "a.feather"
    write_annotations(path, [cuboid(0, "DOG", (1, 2, 3), yaw=yaw) for yaw in (np.pi, -np.pi, 3.0, -3.0, 3.5)])
    yaws = read_annotations(path, LOG).boxes[:, 6]
    assert ((yaws >= -np.pi) & (yaws < np.pi)).all()
    np.testing.assert_allclose(np.exp(1j * yaws), np.exp(1j * np.array([np.pi, np.pi, 3, -3, 3.5])), atol=1e-12)


def test_a_submission_comes_back(tmp_path: Path) -> None:
    boxes = np.array([[1, 2, 3, 4, 5, 6, 0.7], [9, 8, 7, 6, 5, 4, -3], [0, 1, 0, 2, 2, 2, 0]], dtype=float)
    detections = Detections3D(boxes, np.array([0.2, 0.9, 0.5]), np.array([0, 1, 2]), ("DOG", "SIGN", "tree"))
    parts = Cuboids.from_detections("b", {7: detections, 5: detections[:1]})
    assert parts.left_out == {"tree": 1}
    both = Cuboids.concatenate([parts, Cuboids.from_detections("a", {}), parts])
    assert both.log_ids == ("b", "a")
    assert both.left_out == {"tree": 2}
    write_submission(tmp_path / "s.feather", parts)
    found = read_submission(tmp_path / "s.feather")
    assert found.log_ids == ("b",)
    assert found.timestamps_ns.tolist() == [5, 7, 7]
    np.testing.assert_allclose(found.boxes, boxes[[0, 1, 0]], atol=1e-12)
    assert found.scores.tolist() == [0.2, 0.9, 0.2]
    assert [ARGOVERSE_CLASSES[i] for i in found.labels] == ["DOG", "SIGN", "DOG"]
    assert found.point_counts.tolist() == [-1] * 3


def test_an_empty_submission(tmp_path: Path) -> None:
    write_submission(tmp_path / "s.feather", Cuboids.from_detections("a", {}))
    assert len(read_submission(tmp_path / "s.feather")) == 0


def test_nothing_unfinished_is_written(tmp_path: Path) -> None:
    bad = Cuboids.from_detections("a", {1: Detections3D(np.full((1, 7), np.nan), np.ones(1), np.zeros(1), ("DOG",))})
    with pytest.raises(FormatError, match="NaN or infinite"):
        write_submission(tmp_path / "s.feather", bad)
    assert not (tmp_path / "s.feather").exists()


@pytest.mark.parametrize(
    ("bad", "message"),
    [
        (cuboid(0, "TRAM", (1, 2, 3)), "unknown category 'TRAM'; known are ARTICULATED_BUS"),
        (cuboid(0, "DOG", (1, np.nan, 3)), "1 cuboids, the first in row 1, have NaN or infinite numbers"),
        (cuboid(0, "DOG", (1, 2, 3), (1, 0, 1)), "row 1, have a size that is not positive"),
        ((0, "DOG", 1.0, 1.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 1.0, 1.0, 4), "quaternion of zero length"),
    ],
)
def test_bad_cuboids(tmp_path: Path, bad: tuple[object, ...], message: str) -> None:
    path = tmp_path / "a.feather"
    write_annotations(path, [cuboid(0, "DOG", (1, 2, 3)), bad])
    with pytest.raises(FormatError, match=message):
        read_annotations(path, LOG)


def test_bad_columns_and_scores(tmp_path: Path) -> None:
    path = tmp_path / "a.feather"
    columns = rows(CUBOID, [cuboid(0, "DOG", (1, 2, 3))])
    del columns["tz_m"]
    write_columns(path, columns)
    with pytest.raises(FormatError, match=r"a\.feather has no column tz_m"):
        read_annotations(path, LOG)
    write_submission_rows(path, [cuboid(0, "DOG", (1, 2, 3))], [np.inf])
    with pytest.raises(FormatError, match="column score holds NaN or infinite values"):
        read_submission(path)
    write_annotations(path, [cuboid(0, "DOG", (1, 2, 3))])
    with pytest.raises(FormatError, match="has no column score, log_id"):
        read_submission(path)


def test_sweep_poses_and_calibration(tmp_path: Path) -> None:
    folder = write_log(tmp_path)
    points = read_sweep(folder / f"sensors/lidar/{sweep_time(0)}.feather")
    assert (points.shape, points.dtype) == ((7, 5), np.float32)
    np.testing.assert_allclose(points[2], [19, -0.2, 1.5, 7, 2e-6], atol=1e-3)
    times, city_from_ego = read_poses(folder / "city_SE3_egovehicle.feather")
    assert (np.diff(times) > 0).all()
    np.testing.assert_allclose(city_from_ego[times == FIRST_NS + STEP_NS][0, :3, 3], [1, 0, 0])
    calibration = read_calibration(folder / "calibration")
    # camera z is the vehicle's x, camera x its -y
    np.testing.assert_allclose(
        calibration.ego_from_sensor["ring_front_center"][:3], [[0, 0, 1, 1], [-1, 0, 0, 0], [0, -1, 0, 1.5]], atol=1e-12
    )
    assert calibration.sizes["ring_side_left"] == (100, 80)
    np.testing.assert_array_equal(calibration.intrinsics["ring_side_left"], [[100, 0, 50], [0, 100, 40], [0, 0, 1]])


def test_points_that_are_not_numbers_are_left_out(tmp_path: Path) -> None:
    path = tmp_path / "s.feather"
    columns = {name: np.array([1.0, np.nan, 2.0], np.float16) for name in ("x", "y", "z")}
    write_columns(path, {**columns, "intensity": np.zeros(3, np.uint8), "offset_ns": np.zeros(3, np.int32)})
    assert read_sweep(path)[:, 0].tolist() == [1, 2]


def test_a_camera_without_pose(tmp_path: Path) -> None:
    folder = write_log(tmp_path) / "calibration"
    write_columns(
        folder / "intrinsics.feather",
        rows(
            ["sensor_name", "fx_px", "fy_px", "cx_px", "cy_px", "height_px", "width_px"],
            [("stereo_front_left", 1.0, 1.0, 1.0, 1.0, 1, 1)],
        ),
    )
    with pytest.raises(FormatError, match="describes camera stereo_front_left, which egovehicle_SE3_sensor"):
        read_calibration(folder)
