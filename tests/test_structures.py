import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from lcf3d import Camera, Detections2D, Detections3D, Frame
from lcf3d.errors import ConfigError, ShapeError
from lcf3d.structures import InstanceMask, with_columns

NAMES = ("car", "person")
BOX = [10.0, 2, -1, 4, 2, 1.5, 0.1]


def test_arrays_are_converted_copied_and_read_only():
    boxes = np.array([BOX], dtype=np.float32)
    found = Detections3D(boxes, [0.5], [1], list(NAMES))
    boxes[:] = 0
    assert found.boxes.dtype == np.float64
    assert found.boxes[0, 0] == 10
    assert found.labels.dtype == np.int64
    assert found.class_names == NAMES
    with pytest.raises(ValueError, match="read-only"):
        found.boxes[0, 0] = 1


@pytest.mark.parametrize(
    ("values", "message"),
    [
        (([BOX[:6]], [0.5], [0]), r"boxes must have shape \(N, 7\), got \(1, 6\)"),
        (([BOX], [0.5, 0.6], [0]), "1 boxes but 2 scores and 1 labels"),
        (([BOX], [0.5], [2]), "must index its 2 class names, got 2 to 2"),
        (([BOX], [0.5], [-1]), "got -1 to -1"),
    ],
)
def test_what_does_not_fit_is_told(values, message):
    with pytest.raises(ShapeError, match=message):
        Detections3D(*values, NAMES)


def test_nothing_is_a_detections_object_too():
    for kind, columns in ((Detections3D, 7), (Detections2D, 4)):
        assert len(kind.empty(NAMES)) == 0
        assert kind.empty(NAMES).boxes.shape == (0, columns)
        assert len(kind([], [], [], NAMES)) == 0


@given(st.lists(st.integers(0, 1), max_size=8), st.randoms())
def test_selecting_and_joining_keep_rows_together(labels, random):
    n = len(labels)
    boxes = np.arange(7.0 * n).reshape(n, 7)
    found = Detections3D(boxes, np.arange(n) / 10, labels, NAMES)
    order = list(range(n))
    random.shuffle(order)
    chosen = found[np.array(order, dtype=np.int64)]
    assert chosen.scores.tolist() == [i / 10 for i in order]
    np.testing.assert_array_equal(chosen.boxes, boxes[order])
    joined = Detections3D.concatenate([found, chosen])
    assert len(joined) == 2 * n
    assert joined.labels.tolist() == [*labels, *(labels[i] for i in order)]


def test_other_classes_by_name():
    found = Detections2D([[0, 0, 1, 1], [0, 0, 2, 2]], [0.1, 0.2], [0, 1], NAMES)
    turned = found.with_classes(("person", "bus"))
    assert (turned.labels.tolist(), turned.scores.tolist()) == ([0], [0.2])
    mapped = found.with_classes(("vehicle",), {"car": "vehicle"})
    assert (mapped.labels.tolist(), mapped.scores.tolist()) == ([0], [0.1])
    with pytest.raises(ConfigError, match="must share one class list"):
        Detections2D.concatenate([found, turned])


def test_boxes_are_clipped_to_an_image():
    camera = Camera("c", np.eye(3, 4), np.eye(4), 100, 50)
    found = Detections2D([[-5, 10, 120, 60]], [0.1], [0], NAMES)
    assert found.clipped(camera).boxes.tolist() == [[0, 10, 100, 50]]


def test_tensors_that_want_a_gradient():
    torch = pytest.importorskip("torch")
    boxes = torch.tensor([BOX], requires_grad=True)
    found = Detections3D(boxes, torch.tensor([0.5], requires_grad=True), torch.tensor([1]), NAMES)
    np.testing.assert_allclose(found.boxes[0], BOX, rtol=1e-6)


def test_frames_read_when_first_asked_and_keep_time_and_place():
    read = []

    def points():
        read.append(1)
        return np.zeros((3, 4), np.float32)

    frame = Frame("f", points, timestamp=1.5, world_from_lidar=np.eye(4), sequence="drive")
    assert read == []
    assert len(frame.points) == len(frame.points) == 3
    assert read == [1]
    assert (frame.timestamp, frame.sequence) == (1.5, "drive")
    with pytest.raises(ShapeError, match=r"world_from_lidar must have shape \(4, 4\)"):
        Frame("f", world_from_lidar=np.eye(3))
    with pytest.raises(ShapeError, match="points must have shape"):
        _ = Frame("f", np.zeros((3, 3), np.float32)).points
    camera = Camera("c", np.eye(3, 4), np.eye(4), 10, 10)
    with pytest.raises(ConfigError, match="names must differ"):
        Frame("f", cameras=[camera, camera])


def test_a_mask_keeps_the_part_that_holds_something():
    image = np.zeros((6, 8), dtype=bool)
    image[2:4, 3:6] = True
    mask = InstanceMask.from_image(image)
    assert mask.contains(np.array([[3.5, 2.5], [0.5, 0.5], [5.5, 3.5]])).tolist() == [True, False, True]


def test_what_is_made_of_detections_stays_read_only_and_says_what_does_not_fit():
    found = Detections3D([BOX, BOX, BOX], [0.1, 0.2, 0.3], [0, 1, 0], NAMES, velocities=np.ones((3, 2)))
    made = [found[1:], found[[2, 0]], found[found.scores > 0.1], found.with_classes(("person",))]
    made += [Detections3D.concatenate([found, found]), with_columns(found, scores=np.ones(3))]
    for one in made:
        for column in (one.boxes, one.scores, one.labels, one.velocities):
            assert not column.flags.writeable
            assert len(column) == len(one)
    assert found.with_classes(NAMES) is found
    assert made[-1].scores.tolist() == [1, 1, 1]
    with pytest.raises(ShapeError, match=r"boxes must have shape \(N, 7\), got \(7,\)"):
        found[0]
    with pytest.raises(ShapeError, match=r"boxes must have shape \(N, 4\), got \(4,\)"):
        Detections2D([[0, 0, 1, 1]], [0.1], [0], NAMES)[0]


def test_arrays_that_nobody_can_change_are_shared():
    found = Detections3D([BOX], [0.1], [0], NAMES)
    again = Detections3D(found.boxes, found.scores, found.labels, NAMES)
    assert again.boxes is found.boxes
    view = np.array([BOX])[:]
    view.setflags(write=False)
    # its base can still be written to
    assert Detections3D(view, [0.1], [0], NAMES).boxes is not view
