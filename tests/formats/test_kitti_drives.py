from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from lcf3d.errors import DatasetError, FormatError
from lcf3d.formats.kitti_drives import (
    EARTH_RADIUS_M,
    poses_from_oxts,
    read_camera_poses,
    read_oxts,
    read_times,
    read_tracking_labels,
    read_tracklets,
)

CAR = "Car 1 2 -1.5 10 20 30 40 1.5 1.6 4.0 1.0 2.0 20.0 -1.6"
DONT_CARE = "DontCare -1 -1 -10 10 20 30 40 -1000 -1000 -1000 -10 -1 -1 -1"


def record(latitude: float = 49.0, longitude: float = 8.0, altitude: float = 0.0, *angles: float) -> list[float]:
    roll, pitch, yaw = angles or (0.0, 0.0, 0.0)
    return [latitude, longitude, altitude, roll, pitch, yaw]


def test_poses_on_the_map() -> None:
    # a hundred-thousandth of a degree north, then east, 2 m higher, turned a quarter
    step = 1e-5
    poses = poses_from_oxts(
        np.array([record(), record(49 + step), record(49, 8 + step, 2.0), record(49, 8, 0, 0, 0, np.pi / 2)])
    )
    metre = np.radians(step) * EARTH_RADIUS_M
    np.testing.assert_allclose(poses[0], np.eye(4), atol=1e-12)
    # true to scale at the first latitude: a step north is as long on the map as on the sphere
    np.testing.assert_allclose(poses[1, :3, 3], [0, metre, 0], rtol=1e-5, atol=1e-8)
    np.testing.assert_allclose(poses[2, :3, 3], [metre * np.cos(np.radians(49)), 0, 2], rtol=1e-6, atol=1e-8)
    # x ahead is then north
    np.testing.assert_allclose(poses[3, :3, 0], [0, 1, 0], atol=1e-12)
    assert poses_from_oxts(np.zeros((0, 30))).shape == (0, 4, 4)


@given(st.tuples(*[st.floats(-1.5, 1.5)] * 3))
def test_roll_pitch_yaw_in_that_order(angles: tuple[float, float, float]) -> None:
    roll, pitch, yaw = angles

    def turn(axis: int, angle: float) -> np.ndarray:
        a, b = [i for i in range(3) if i != axis]
        matrix = np.eye(3)
        matrix[[a, b], [a, b]] = np.cos(angle)
        sign = -1 if axis != 1 else 1
        matrix[a, b], matrix[b, a] = sign * np.sin(angle), -sign * np.sin(angle)
        return matrix

    expected = turn(2, yaw) @ turn(1, pitch) @ turn(0, roll)
    found = poses_from_oxts(np.array([record(49, 8, 0, roll, pitch, yaw)]))[0, :3, :3]
    np.testing.assert_allclose(found, expected, atol=1e-12)


def test_oxts_files(tmp_path: Path) -> None:
    path = tmp_path / "0000.txt"
    path.write_text("49.0 8.0 116.4 0.1 0.2 0.3 " + "0 " * 24 + "\n49 8 117 0 0 0\n")
    records = read_oxts(path)
    assert records.shape == (2, 30)
    assert records[0, :6].tolist() == [49, 8, 116.4, 0.1, 0.2, 0.3]
    path.write_text("49.0 8.0\n")
    with pytest.raises(FormatError, match=r"0000.txt:1: expected 30 numbers, got 2"):
        read_oxts(path)
    path.write_text("49.0 8.0 north 0 0 0\n")
    with pytest.raises(FormatError, match=r":1: expected 30 numbers, got '49.0 8.0 north"):
        read_oxts(path)
    path.write_text("\n49.0 8.0 nan 0 0 0\n")
    with pytest.raises(FormatError, match=":2: holds NaN"):
        read_oxts(path)


def test_camera_poses(tmp_path: Path) -> None:
    path = tmp_path / "00.txt"
    path.write_text("1 0 0 5 0 1 0 6 0 0 1 7\n")
    np.testing.assert_array_equal(read_camera_poses(path)[0], [[1, 0, 0, 5], [0, 1, 0, 6], [0, 0, 1, 7], [0, 0, 0, 1]])


def test_times(tmp_path: Path) -> None:
    path = tmp_path / "times.txt"
    path.write_text("0.000000e+00\n1.036224e-01\n")
    assert read_times(path).tolist() == [0, 0.1036224]
    path.write_text("2011-09-26 13:02:25.500000000\n\n1970-01-01 00:00:01.25\n")
    times = read_times(path)
    # days since 1970: 15243 up to 26 September 2011
    assert times[0] == 15243 * 86400 + 13 * 3600 + 2 * 60 + 25.5
    assert np.isnan(times[1])
    assert times[2] == 1.25
    path.write_text("0.1\nsoon\n")
    with pytest.raises(FormatError, match=r"times.txt:2: expected a time in seconds or a date and time, got 'soon'"):
        read_times(path)


def test_tracking_labels(tmp_path: Path) -> None:
    path = tmp_path / "0000.txt"
    path.write_text(f"0 -1 {DONT_CARE}\n0 7 {CAR}\n3 7 {CAR.replace('Car 1', 'Car 2')}\n")
    found = read_tracking_labels(path)
    assert list(found) == [0, 3]
    assert found[0].track_ids.tolist() == [-1, 7]
    objects = found[0].objects
    assert objects.class_names.tolist() == ["DontCare", "Car"]
    assert objects.has_box3d.tolist() == [False, True]
    assert objects.truncated.tolist() == [-1, 0.25]
    assert found[3].objects.truncated.tolist() == [0.6]
    assert objects.occluded.tolist() == [-1, 2]
    np.testing.assert_array_equal(objects.locations[1], [1, 2, 20])
    np.testing.assert_array_equal(objects.dimensions[1], [1.5, 1.6, 4])
    path.write_text("")
    assert read_tracking_labels(path) == {}


@pytest.mark.parametrize(
    ("line", "message"),
    [
        (CAR, "expected the 17 columns of a tracking label, got 15"),
        (f"0.5 1 {CAR}", "frame number and track id must be whole numbers, got 0.5 1"),
        (f"0 x {CAR}", "must be a number, got 'x'"),
        (f"0 1 {CAR.replace('4.0', 'long')}", "must be a number, got 'long'"),
        (f"0 1 {CAR.replace('4.0', 'nan')}", "expected a finite number"),
        (f"0 1 {CAR.replace('10 20 30', '50 20 30')}", "2D box is reversed"),
    ],
)
def test_bad_tracking_labels(tmp_path: Path, line: str, message: str) -> None:
    path = tmp_path / "0000.txt"
    path.write_text(f"0 1 {CAR}\n\n{line}\n")
    with pytest.raises(FormatError, match=f"0000.txt:3: .*{message}"):
        read_tracking_labels(path)


def test_a_label_file_that_is_not_there(tmp_path: Path) -> None:
    with pytest.raises(DatasetError, match="does not exist"):
        read_tracking_labels(tmp_path / "none.txt")


TRACKLETS = """<?xml version="1.0"?>
<boost_serialization signature="serialization::archive" version="9">
<tracklets class_id="0" tracking_level="0" version="0">
<count>2</count>
<item><objectType>Car</objectType><h>1.5</h><w>1.7</w><l>4.2</l><first_frame>3</first_frame>
<poses><count>2</count>
<item><tx>10</tx><ty>2</ty><tz>-1.7</tz><rx>0</rx><ry>0</ry><rz>0.5</rz></item>
<item><tx>11</tx><ty>2</ty><tz>-1.7</tz><rx>0</rx><ry>0</ry><rz>4</rz></item></poses></item>
<item><objectType>Person (sitting)</objectType><h>1</h><w>1</w><l>1</l><first_frame>0</first_frame>
<poses><item><tx>1</tx><ty>1</ty><tz>0</tz><rz>0</rz></item></poses></item>
</tracklets></boost_serialization>
"""


def test_tracklets(tmp_path: Path) -> None:
    path = tmp_path / "tracklet_labels.xml"
    path.write_text(TRACKLETS)
    found = read_tracklets(path)
    assert found.frames.tolist() == [3, 4, 0]
    assert found.track_ids.tolist() == [0, 0, 1]
    assert found.class_names.tolist() == ["Car", "Car", "Person_sitting"]
    # the centre is half the height above the bottom
    np.testing.assert_allclose(found.boxes[0], [10, 2, -0.95, 4.2, 1.7, 1.5, 0.5])
    assert found.boxes[1, 6] == pytest.approx(4 - 2 * np.pi)
    path.write_text(TRACKLETS.replace("<h>1.5</h>", ""))
    with pytest.raises(FormatError, match=r"is no file of tracklets \(<item> has no <h>\)"):
        read_tracklets(path)
    path.write_text(TRACKLETS[:300])
    with pytest.raises(FormatError, match="is no XML file"):
        read_tracklets(path)
    with pytest.raises(FormatError, match="does not exist"):
        read_tracklets(tmp_path / "none.xml")
