import json
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import array_shapes, arrays

from lcf3d.errors import FormatError
from lcf3d.formats.coco import (
    decode_mask,
    encode_mask,
    pack_counts,
    read_camera_detections,
    read_coco_index,
    read_coco_results,
    unpack_counts,
    write_camera_detections,
)
from lcf3d.structures import NUSCENES_CLASSES

MASK = np.array([[0, 0, 1, 0], [0, 1, 1, 0], [0, 0, 0, 0]], dtype=bool)
# down the columns: 0 0 0 | 0 1 0 | 1 1 0 | 0 0 0
RUNS = [4, 1, 1, 2, 4]


def test_runs_go_down_the_columns() -> None:
    assert encode_mask(MASK, compressed=False) == {"size": [3, 4], "counts": RUNS}
    np.testing.assert_array_equal(decode_mask({"size": [3, 4], "counts": RUNS}), MASK)


def test_compressed_runs_by_hand() -> None:
    # 4 1 1, then 2 - 1 = 1 and 4 - 1 = 3: one character each, 48 + value
    assert pack_counts(RUNS) == "41113"
    # 40 = 8 + 1 * 32: low bits with the sign to follow, then 1; -3 = 29 in five bits, sign bit set
    assert pack_counts([40, 5, 2, 2]) == "X1" + "5" + "2" + chr(48 + 29)
    assert unpack_counts(b"X152M") == [40, 5, 2, 2]


def test_a_mask_that_begins_with_the_object() -> None:
    assert encode_mask(np.ones((2, 2)), compressed=False)["counts"] == [0, 4]
    assert encode_mask(np.zeros((2, 2)), compressed=False)["counts"] == [4]


@given(arrays(bool, array_shapes(min_dims=2, max_dims=2, max_side=40)), st.booleans())
def test_masks_survive(mask: np.ndarray, compressed: bool) -> None:
    np.testing.assert_array_equal(decode_mask(encode_mask(mask, compressed)), mask)


@given(st.lists(st.integers(0, 2_000_000)))
def test_counts_survive(runs: list[int]) -> None:
    assert unpack_counts(pack_counts(runs)) == runs


@pytest.mark.parametrize(
    "segmentation",
    [
        {"size": [3, 4], "counts": [1, 2]},
        {"size": [3, 4], "counts": [13, -1]},
        {"size": [3, 4], "counts": "\x7f"},
        {"size": [3, 4], "counts": "X"},
        {"size": [3], "counts": [12]},
        {"size": [-3, -4], "counts": [12]},
        {"size": [3, 4], "counts": [10**400]},
        {"counts": [12]},
        [[1, 2, 3, 4, 5, 6]],
    ],
)
def test_malformed_masks(segmentation: object) -> None:
    with pytest.raises(FormatError, match="mask"):
        decode_mask(segmentation)  # type: ignore[arg-type]


def _simple(**changes: object) -> dict[str, object]:
    record = {"sample_token": "s", "camera": "CAM_BACK", "bbox": [10, 20, 30, 40], "score": 0.5, "category_name": "bus"}
    return {**record, **changes}


def test_simple_list(tmp_path: Path) -> None:
    path = tmp_path / "list.json"
    segmentation = encode_mask(MASK)
    path.write_text(
        json.dumps(
            [
                _simple(),
                _simple(score=0.25, category_name="car", segmentation=segmentation),
                _simple(category_name="giraffe"),
                _simple(category_name="giraffe", camera="CAM_FRONT"),
            ]
        )
    )
    found = read_camera_detections(path, NUSCENES_CLASSES)
    assert set(found) == {("s", "CAM_BACK"), ("s", "CAM_FRONT")}
    assert len(found["s", "CAM_FRONT"]) == 0
    back = found["s", "CAM_BACK"]
    np.testing.assert_array_equal(back.boxes, [[10, 20, 40, 60]] * 2)
    np.testing.assert_array_equal(back.scores, [0.5, 0.25])
    assert [back.class_names[label] for label in back.labels] == ["bus", "car"]
    assert back.masks is not None
    assert back.masks[0] is None
    mask = back.masks[1]
    assert mask is not None
    assert (mask.x, mask.y) == (1, 0)
    np.testing.assert_array_equal(mask.bitmap, MASK[:2, 1:3])


def test_simple_list_round_trip(tmp_path: Path) -> None:
    path, copy = tmp_path / "a.json", tmp_path / "b.json"
    path.write_text(json.dumps([_simple(), _simple(camera="CAM_FRONT", score=0.125)]))
    write_camera_detections(copy, read_camera_detections(path, NUSCENES_CLASSES))
    assert json.loads(copy.read_text()) == json.loads(path.read_text())


@pytest.mark.parametrize(
    ("record", "complaint"),
    [
        (_simple(score=float("nan")), "record 0 has a bbox or score that is NaN"),
        (_simple(bbox=[1, 2, 3]), "four numbers"),
        (_simple(score=10**400), "record 0 must have a bbox of four numbers and a score"),
        (_simple(bbox=[1, 2, -3, 4]), "negative size"),
        ({"camera": "CAM_BACK", "bbox": [1, 2, 3, 4], "score": 1, "category_name": "car"}, "no 'sample_token'"),
        (_simple(segmentation={"size": [2, 2], "counts": [1]}), "record 0: the runs of a mask"),
        ("text", "must hold a list of detections"),
    ],
)
def test_bad_records(tmp_path: Path, record: object, complaint: str) -> None:
    path = tmp_path / "list.json"
    path.write_text(json.dumps([record]))
    with pytest.raises(FormatError, match=complaint):
        read_camera_detections(path, NUSCENES_CLASSES)


def test_coco_results(tmp_path: Path) -> None:
    index, results = tmp_path / "index.json", tmp_path / "results.json"
    index.write_text(
        json.dumps(
            {
                "categories": [{"id": 3, "name": "car"}, {"id": 9, "name": "boat"}],
                "images": [{"id": 7, "file_name": "some/where/a.jpg"}, {"id": 8, "file_name": "other.jpg"}],
            }
        )
    )
    categories, images = read_coco_index(index, {"samples/CAM_FRONT/a.jpg": ("t", "CAM_FRONT")})
    assert categories == {3: "car", 9: "boat"}
    assert images == {7: ("t", "CAM_FRONT")}
    results.write_text(
        json.dumps(
            [
                {
                    "image_id": 7,
                    "category_id": 3,
                    "bbox": [0, 0, 4, 3],
                    "score": 0.75,
                    "segmentation": encode_mask(MASK),
                },
                {"image_id": 7, "category_id": 9, "bbox": [0, 0, 1, 1], "score": 0.5},
            ]
        )
    )
    found = read_coco_results(results, NUSCENES_CLASSES, categories, images)
    assert list(found) == [("t", "CAM_FRONT")]
    assert found["t", "CAM_FRONT"].scores.tolist() == [0.75]
    results.write_text(json.dumps([{"image_id": 8, "category_id": 3, "bbox": [0, 0, 1, 1], "score": 1}]))
    with pytest.raises(FormatError, match="image_id 8, which the index does not name"):
        read_coco_results(results, NUSCENES_CLASSES, categories, images)
    index.write_text("[]")
    with pytest.raises(FormatError, match="must hold 'categories'"):
        read_coco_index(index, {})


@pytest.mark.real
def test_simulated_camera_detections(shared: Path) -> None:
    found = read_camera_detections(shared / "data/nuscenes/results/camera_2d_simulated.json", NUSCENES_CLASSES)
    assert sum(len(detections) for detections in found.values()) == 1864
