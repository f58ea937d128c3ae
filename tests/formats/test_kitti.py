from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from lcf3d.errors import DatasetError, FormatError, ShapeError
from lcf3d.formats import kitti
from lcf3d.structures import Detections2D, Detections3D

LABEL = "Car 0.25 1 -1.5 10 20 110.5 70 1.5 1.6 4.0 -2.0 1.7 20.0 1.57"
DONT_CARE = "DontCare -1 -1 -10 503.89 169.71 590.61 190.13 -1 -1 -1 -1000 -1000 -1000 -10"
RESULT = "Pedestrian -1 -1 0.3 1 2 3 4 1.8 0.6 0.8 3 1.7 12 0.5 -3.25"
FLAT_CAMERA = np.array([[0, -1, 0, 0], [0, 0, -1, -0.08], [1, 0, 0, -0.27], [0, 0, 0, 1.0]])


def write(path: Path, *lines: str) -> Path:
    path.write_text("".join(line + "\n" for line in lines))
    return path


def test_label_file_is_read_column_by_column(tmp_path: Path) -> None:
    objects = kitti.read_objects(write(tmp_path / "000001.txt", LABEL, "", DONT_CARE), results=False)
    assert objects.class_names.tolist() == ["Car", "DontCare"]
    assert objects.truncated[0] == 0.25
    assert objects.occluded.tolist() == [1, -1]
    assert objects.alpha[0] == -1.5
    assert objects.boxes2d[0].tolist() == [10, 20, 110.5, 70]
    assert objects.dimensions[0].tolist() == [1.5, 1.6, 4.0]
    assert objects.locations[0].tolist() == [-2.0, 1.7, 20.0]
    assert objects.rotation_y[0] == 1.57
    assert objects.scores is None
    assert objects.has_box3d.tolist() == [True, False]


def test_scores_are_read_as_written(tmp_path: Path) -> None:
    objects = kitti.read_objects(write(tmp_path / "a.txt", RESULT), results=True)
    assert objects.scores is not None
    assert objects.scores.tolist() == [-3.25]


def test_empty_file_has_no_objects(tmp_path: Path) -> None:
    for results in (False, True):
        objects = kitti.read_objects(write(tmp_path / "a.txt"), results)
        assert len(objects) == 0
        assert objects.boxes2d.shape == (0, 4)
        assert (objects.scores is not None) == results


@pytest.mark.parametrize("size", ["-1 -1 -1", "-1000 -1000 -1000"])
def test_both_ways_of_saying_no_3d_box(tmp_path: Path, size: str) -> None:
    line = f"Car -1 -1 -10 1 2 3 4 {size} -1000 -1000 -1000 -10 0.5"
    assert not kitti.read_objects(write(tmp_path / "a.txt", line), results=True).has_box3d.any()


@pytest.mark.parametrize(
    ("line", "message"),
    [
        (LABEL + " 0.9", r"a.txt:3: expected the 15 columns of a label \(without a score\), got 16"),
        (LABEL.rsplit(" ", 1)[0], "a.txt:3: .* got 14"),
        (LABEL.replace("20.0", "far"), "a.txt:3: column 14 must be a number, got 'far'"),
        (LABEL.replace("20.0", "nan"), "a.txt:3: column 14 is nan"),
        (LABEL.replace("20.0", "inf"), "a.txt:3: column 14 is inf"),
        (LABEL.replace("110.5", "9"), "a.txt:3: 2D box is reversed, .* got 10 20 9 70"),
        (LABEL.replace(" 70 ", " 19 "), "a.txt:3: 2D box is reversed"),
        (LABEL.replace("1.6", "-1.6"), "a.txt:3: .* must not be negative, got 1.5 -1.6 4"),
        (LABEL.replace(" 1 -1.5", " 0.5 -1.5"), "a.txt:3: occlusion must be a whole number, got 0.5"),
    ],
)
def test_bad_line_names_file_line_and_problem(tmp_path: Path, line: str, message: str) -> None:
    path = write(tmp_path / "a.txt", LABEL, "", line, LABEL)
    with pytest.raises(FormatError, match=message):
        kitti.read_objects(path, results=False)


def test_results_without_score_are_refused(tmp_path: Path) -> None:
    with pytest.raises(FormatError, match=r"expected the 16 columns of a result \(with a score\), got 15"):
        kitti.read_objects(write(tmp_path / "a.txt", LABEL), results=True)


def test_bad_line_in_the_second_file_of_a_folder(tmp_path: Path) -> None:
    write(tmp_path / "a.txt", LABEL)
    write(tmp_path / "b.txt", LABEL, LABEL + " x")
    with pytest.raises(FormatError, match=r"b\.txt:2"):
        kitti.read_folder(tmp_path, ["a", "b"], results=False)


def test_bad_line_far_down_a_large_folder(tmp_path: Path) -> None:
    frame_ids = [f"{i:03}" for i in range(300)]
    for frame_id in frame_ids:
        write(tmp_path / f"{frame_id}.txt", LABEL)
    assert len(kitti.read_folder(tmp_path, frame_ids, results=False).objects) == 300
    write(tmp_path / "299.txt", LABEL, LABEL, "Car 1")
    with pytest.raises(FormatError, match=r"299\.txt:3: .* got 2"):
        kitti.read_folder(tmp_path, frame_ids, results=False)


def test_binary_file_is_no_text(tmp_path: Path) -> None:
    (tmp_path / "a.txt").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(FormatError, match="UTF-8"):
        kitti.read_objects(tmp_path / "a.txt", results=False)


def test_missing_file_and_folder(tmp_path: Path) -> None:
    with pytest.raises(DatasetError, match="does not exist"):
        kitti.read_objects(tmp_path / "a.txt", results=False)
    with pytest.raises(DatasetError, match="is not a folder"):
        kitti.read_folder(tmp_path / "none", ["a"], results=False)


def test_folder_keeps_the_order_of_the_ids_and_any_id(tmp_path: Path) -> None:
    write(tmp_path / "0000_000005.txt", RESULT, RESULT)
    write(tmp_path / "left.txt")
    write(tmp_path / "000001.txt", RESULT)
    frames = kitti.read_folder(tmp_path, ["left", "0000_000005", "000001"], results=True)
    assert frames.frame_ids == ("left", "0000_000005", "000001")
    assert [len(frame) for frame in frames] == [0, 2, 1]
    assert frames.frame_of_object.tolist() == [1, 1, 2]
    assert len(frames[-1]) == 1
    assert [len(frame) for frame in frames[:2]] == [0, 2]
    with pytest.raises(IndexError):
        frames[3]


def test_missing_frames_are_counted_or_taken_as_empty(tmp_path: Path) -> None:
    write(tmp_path / "a.txt", RESULT)
    with pytest.raises(DatasetError, match=r"2 of 3 frames, first b\.txt"):
        kitti.read_folder(tmp_path, ["a", "b", "c"], results=True)
    frames = kitti.read_folder(tmp_path, ["a", "b", "c"], results=True, missing="empty")
    assert [len(frame) for frame in frames] == [1, 0, 0]


def test_frames_joined_and_taken_apart_are_the_same(tmp_path: Path) -> None:
    one = kitti.read_objects(write(tmp_path / "a.txt", RESULT, RESULT), results=True)
    frames = kitti.KittiFrames.from_frames(["a", "b"], [one, kitti.KittiObjects.empty(results=True)])
    assert kitti.format_objects(frames[0]) == kitti.format_objects(one)
    assert len(frames[1]) == 0
    labels = kitti.read_objects(write(tmp_path / "b.txt", LABEL), results=False)
    with pytest.raises(FormatError, match="cannot be joined"):
        kitti.KittiFrames.from_frames(["a", "b"], [one, labels])


def test_frame_ids(tmp_path: Path) -> None:
    assert kitti.read_frame_ids(write(tmp_path / "s.txt", "000001", "", "x_2")) == ("000001", "x_2")
    with pytest.raises(FormatError, match="names no frames"):
        kitti.read_frame_ids(write(tmp_path / "s.txt", ""))
    with pytest.raises(FormatError, match="frame b more than once"):
        kitti.read_frame_ids(write(tmp_path / "s.txt", "a", "b", "c", "b"))
    with pytest.raises(DatasetError, match="does not exist"):
        kitti.read_frame_ids(tmp_path / "none.txt")


def test_shapes_are_checked() -> None:
    empty = kitti.KittiObjects.empty(results=True)
    with pytest.raises(ShapeError, match=r"boxes2d must have shape \(0, 4\), got \(3, 4\)"):
        kitti.KittiObjects(
            empty.class_names,
            empty.truncated,
            empty.occluded,
            empty.alpha,
            np.zeros((3, 4)),
            empty.dimensions,
            empty.locations,
            empty.rotation_y,
        )


def test_writing_gives_back_what_was_read(tmp_path: Path) -> None:
    for results, lines in ((False, [LABEL, DONT_CARE]), (True, [RESULT])):
        objects = kitti.read_objects(write(tmp_path / "a.txt", *lines), results)
        kitti.write_objects(tmp_path / "out" / "b.txt", objects)
        text = (tmp_path / "out" / "b.txt").read_text()
        assert [len(line.split()) for line in text.splitlines()] == [16 if results else 15] * len(lines)
        for wrote, read in zip(text.splitlines(), lines, strict=True):
            assert [wrote.split()[0], *map(float, wrote.split()[1:])] == [
                read.split()[0],
                *map(float, read.split()[1:]),
            ]


def test_no_objects_make_an_empty_file(tmp_path: Path) -> None:
    kitti.write_objects(tmp_path / "a.txt", kitti.KittiObjects.empty(results=True))
    assert (tmp_path / "a.txt").read_bytes() == b""


def test_detections_2d_keep_known_classes_only(tmp_path: Path) -> None:
    objects = kitti.read_objects(write(tmp_path / "a.txt", DONT_CARE, LABEL), results=False)
    detections = kitti.detections_2d(objects, ["Pedestrian", "Car"])
    assert detections.labels.tolist() == [1]
    assert detections.scores.tolist() == [1.0]
    assert detections.boxes.tolist() == [[10, 20, 110.5, 70]]


def test_detections_3d_are_geometric_centres_in_the_lidar_frame(tmp_path: Path) -> None:
    two_d = "Car -1 -1 -10 1 2 3 4 -1 -1 -1 -1000 -1000 -1000 -10 0.5"
    three_d = "Car -1 -1 0 1 2 3 4 1.5 1.6 4.0 -2.0 1.7 20.0 0 0.75"
    objects = kitti.read_objects(write(tmp_path / "a.txt", two_d, RESULT, three_d), results=True)
    detections = kitti.detections_3d(objects, FLAT_CAMERA, ["Car"])
    assert detections.scores.tolist() == [0.75]
    # forward 20 + 0.27, left 2, up -(1.7 + 0.08) + 1.5 / 2, heading to the right
    np.testing.assert_allclose(detections.boxes, [[20.27, 2, -1.03, 4.0, 1.6, 1.5, -np.pi / 2]], atol=1e-12)


@given(st.integers(0, 2**32 - 1))
def test_detections_survive_a_round_trip_through_text(tmp_path_factory: pytest.TempPathFactory, seed: int) -> None:
    rng = np.random.default_rng(seed)
    n = int(rng.integers(0, 5))
    boxes = rng.uniform([2, -20, -3, 0.3, 0.3, 0.3, -np.pi], [70, 20, 3, 9, 3, 3, np.pi], (n, 7))
    detections = Detections3D(boxes, rng.uniform(size=n), rng.integers(0, 2, n), ("Car", "Cyclist"))
    objects = kitti.objects_from_detections(detections, np.tile([1.0, 2, 3, 4], (n, 1)), FLAT_CAMERA)
    path = tmp_path_factory.mktemp("round") / "a.txt"
    kitti.write_objects(path, objects)
    back = kitti.detections_3d(kitti.read_objects(path, results=True), FLAT_CAMERA, ("Car", "Cyclist"))
    assert back.labels.tolist() == detections.labels.tolist()
    np.testing.assert_allclose(back.scores, detections.scores, rtol=1e-7)
    np.testing.assert_allclose(back.boxes[:, :6], boxes[:, :6], atol=2e-4)
    turn = back.boxes[:, 6] - boxes[:, 6]
    np.testing.assert_allclose((turn + np.pi) % (2 * np.pi) - np.pi, 0, atol=2e-4)


def test_alpha_is_the_angle_seen_along_the_ray() -> None:
    # 10 m forward and 10 m right in the camera: the ray is at atan2(10, 10) = pi/4; yaw -pi/2 is rotation_y 0
    box = np.array([[10.27, -10, 0, 4, 2, 1.5, -np.pi / 2]])
    detections = Detections3D(box, np.ones(1), np.zeros(1), ("Car",))
    objects = kitti.objects_from_detections(detections, np.array([[0.0, 0, 1, 1]]), FLAT_CAMERA)
    np.testing.assert_allclose(objects.alpha, -np.pi / 4)
    with pytest.raises(ShapeError, match=r"boxes2d must have shape \(1, 4\)"):
        kitti.objects_from_detections(detections, np.zeros((2, 4)), FLAT_CAMERA)


def test_2d_detections_are_written_without_a_3d_box() -> None:
    detections = Detections2D(np.array([[1.0, 2, 3, 4]]), np.array([0.5]), np.array([0]), ("Car",))
    text = kitti.format_objects(kitti.objects_from_detections_2d(detections))
    assert text == "Car -1 -1 -10 1 2 3 4 -1 -1 -1 -1000 -1000 -1000 -10 0.5\n"


NUMBERS = st.floats(-1e5, 1e5) | st.sampled_from([0.0, -0.0, -0.00004, 100.0, 0.05, 10.5, -1000.0])


@given(st.lists(st.tuples(st.lists(NUMBERS, min_size=13, max_size=13), NUMBERS), max_size=4), st.booleans())
def test_numbers_of_a_file_are_written_like_single_ones(rows: list[tuple[list[float], float]], scored: bool) -> None:
    values = np.array([row for row, _ in rows]).reshape(-1, 13)
    scores = np.array([score for _, score in rows])
    n = len(rows)
    objects = kitti.KittiObjects(
        # a name may end like a number with zeros
        np.array(["Car.00"] * n, dtype=np.str_),
        values[:, 0],
        np.full(n, 10),
        values[:, 1],
        values[:, 2:6],
        values[:, 6:9],
        values[:, 9:12],
        values[:, 12],
        scores if scored else None,
    )

    def written(value: float) -> str:
        text = f"{value:.4f}".rstrip("0").rstrip(".")
        return "0" if text == "-0" else text

    expected = ""
    for i, (row, score) in enumerate(rows):
        box = row[6:] if objects.has_box3d[i] else [-1, -1, -1, -1000, -1000, -1000, -10]
        fields = [written(value) for value in (row[0], 10, *row[1:6], *box)]
        expected += " ".join(["Car.00", *fields, *([f"{score:.8g}"] if scored else [])]) + "\n"
    assert kitti.format_objects(objects) == expected


@pytest.mark.real
def test_every_shared_kitti_file_is_read(shared: Path) -> None:
    root = shared / "data" / "kitti"
    frame_ids = kitti.read_frame_ids(root / "ImageSets" / "val.txt")
    labels = kitti.read_folder(root / "training" / "label_2", frame_ids, results=False)
    assert len(labels) == 1912
    assert len(labels.objects) == 13669
    for name, count in (("perturbed_labels", 9643), ("point_gnn", 8199), ("rcnn_2d", 14372)):
        assert len(kitti.read_folder(root / "results" / name / "data", frame_ids, results=True).objects) == count
