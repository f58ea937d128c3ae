import json
import zipfile
from dataclasses import replace

import numpy as np
import pytest

from lcf3d.datasets.drive import (
    DRIVE,
    Distractors,
    Objects,
    ShippedFrame,
    decode_points,
    encode_points,
    read_drive,
    write_drive,
)
from lcf3d.errors import FormatError
from lcf3d.geometry.boxes import points_in_boxes
from lcf3d.geometry.camera import project_boxes
from lcf3d.structures import Camera


@pytest.fixture(scope="module")
def drive():
    return read_drive()


@pytest.fixture
def tiny():
    rng = np.random.default_rng(0)
    points = np.round(np.c_[rng.uniform(-80, 80, (50, 3)), rng.uniform(0, 1, 50)], 2).astype(np.float32)
    camera = Camera("left", np.eye(3, 4), np.eye(4), 16, 8)
    objects = Objects(
        np.array([[10.125, 1, 0, 4, 2, 1.5, 0.25]]),
        np.array(["Car"]),
        np.array([7]),
        np.array([[1.0, 2, 3, 4]]),
        np.array([1]),
        np.array([0.25]),
    )
    things = Distractors(np.zeros((0, 7)), np.zeros(0, dtype="U4"), np.zeros(0, dtype=np.int64))
    return ShippedFrame("000000", points, camera, np.full((8, 16, 3), 90, np.uint8), objects, things)


def test_data_is_small_enough_for_a_wheel():
    assert sum(path.stat().st_size for path in DRIVE.parent.iterdir()) < 8_000_000


def test_twenty_frames_with_people_cyclists_and_cars(drive):
    assert len(drive) == 20
    classes = [set(frame.objects.class_names.tolist()) for frame in drive]
    assert all({"Car", "Pedestrian", "Cyclist"} <= names for names in classes)
    distances = [np.hypot(*frame.objects.boxes[frame.objects.class_names == "Pedestrian", :2].T) for frame in drive]
    assert max(d.max() for d in distances) > 25
    assert all(len(frame.distractors.boxes) > 3 for frame in drive)


def test_labels_hold_their_points_and_none_of_the_ground(drive):
    for frame in drive[::5]:
        boxes = frame.objects.boxes
        inside = points_in_boxes(frame.points, boxes)
        near = np.hypot(boxes[:, 0], boxes[:, 1]) < 20
        assert (inside.sum(axis=1)[near & (frame.objects.occluded == 0)] > 60).all()
        # a little larger (the ranges' noise), they hold hardly more: the boxes fit
        grown = boxes.copy()
        grown[:, 3:5] += 0.2
        grown_in = points_in_boxes(frame.points, grown)
        lifted = frame.points[:, 2][None] > (boxes[:, 2] - boxes[:, 5] / 2 + 0.1)[:, None]
        assert (grown_in & lifted).sum() < 1.1 * inside.sum()


def test_visible_boxes_lie_in_the_projected_ones(drive):
    for frame in drive[::5]:
        projected, visible = project_boxes(frame.objects.boxes, frame.camera)
        assert visible.all()
        assert (frame.objects.boxes2d[:, :2] >= projected[:, :2] - 2).all()
        assert (frame.objects.boxes2d[:, 2:] <= projected[:, 2:] + 2).all()


def test_tracks_keep_their_class_and_size(drive):
    known = {}
    for frame in drive:
        for track, name, box in zip(
            frame.objects.tracks.tolist(), frame.objects.class_names, frame.objects.boxes, strict=True
        ):
            size = tuple(np.round(box[3:6], 2))
            assert known.setdefault(track, (name, size)) == (name, size)


def test_distractors_have_returns_and_are_no_object(drive):
    for frame in drive[::5]:
        boxes = frame.distractors.boxes
        seen = points_in_boxes(frame.points, boxes).sum(axis=1)
        assert (seen >= 8).sum() >= 3
        apart = np.linalg.norm(boxes[:, None, :2] - frame.objects.boxes[None, :, :2], axis=2).min(axis=1)
        assert (apart > 0.2).all()


def test_points_survive_to_the_centimetre():
    rng = np.random.default_rng(1)
    points = np.c_[rng.uniform(-120, 120, (500, 3)), rng.uniform(0, 1, 500)].astype(np.float32)
    assert np.abs(decode_points(encode_points(points)) - points).max() <= 0.00501


def test_write_and_read(tiny, tmp_path):
    for name in ("a.zip", "b.zip"):
        write_drive(tmp_path / name, [tiny, replace(tiny, id="000001")], "by hand")
    assert (tmp_path / "a.zip").read_bytes() == (tmp_path / "b.zip").read_bytes()
    one, two = read_drive(tmp_path / "a.zip")
    assert (one.id, two.id) == ("000000", "000001")
    assert np.allclose(one.points, tiny.points, atol=1e-5)
    assert np.allclose(one.objects.boxes, tiny.objects.boxes)
    assert one.objects.tracks.tolist() == [7]
    assert abs(int(one.image[4, 4, 0]) - 90) < 4
    assert len(one.distractors.boxes) == 0
    assert len(read_drive(tmp_path / "a.zip", 1)) == 1


def test_damaged_archives_are_refused_with_one_sentence(tiny, tmp_path):
    whole = tmp_path / "whole.zip"
    write_drive(whole, [tiny], "by hand")
    data = whole.read_bytes()
    at = data.index(b"\xfd7zXZ") + 40  # within the compressed scan
    cases = {
        "cut": data[: len(data) // 2],
        "flipped": data[:at] + bytes([data[at] ^ 0xFF]) + data[at + 1 :],
        "nothing": b"",
    }
    for name, content in cases.items():
        path = tmp_path / f"{name}.zip"
        path.write_bytes(content)
        with pytest.raises(FormatError, match=r"missing or damaged .* install lcf3d again"):
            read_drive(path)
    lacking = tmp_path / "lacking.zip"
    with zipfile.ZipFile(whole) as source, zipfile.ZipFile(lacking, "w") as target:
        target.writestr("drive.json", source.read("drive.json"))
    with pytest.raises(FormatError, match=r"left\.webp"):
        read_drive(lacking)
    with zipfile.ZipFile(lacking, "w") as target:
        target.writestr("drive.json", json.dumps([1, 2]))
    with pytest.raises(FormatError, match="damaged"):
        read_drive(lacking)
    with pytest.raises(FormatError, match="missing"):
        read_drive(tmp_path / "absent.zip")
