"""Tables, COCO files and folders by camera as results of a plain folder: what fits nothing is counted or refused."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from lcf3d.datasets.folder_results import folder_camera_results, folder_lidar_results
from lcf3d.errors import DatasetError
from lcf3d.files import write_json
from lcf3d.formats import coco
from lcf3d.formats.kitti import write_objects
from lcf3d.frame import Frame
from lcf3d.structures import Detections2D, Detections3D
from tests.datasets.plain_folder import camera

CLASSES = ("car", "pedestrian")
OWN = ("Car", "person", "Tram")
IMAGES = {f"images/{name}/{i}.png": (i, name) for name in ("front", "left") for i in ("a", "b")}
IDS = ("a", "b")
FRAME = Frame("a", None, [camera("front"), camera("left")])


def boxes_3d() -> Detections3D:
    boxes = np.tile([10.0, 0, 0, 4, 2, 1.5, 0], (3, 1))
    return Detections3D(boxes, np.array([0.9, 0.8, 0.7]), np.array([0, 1, 2]), OWN)


def boxes_2d() -> Detections2D:
    return Detections2D(np.tile([10.0, 10, 60, 40], (3, 1)), np.array([0.9, 0.8, 0.7]), np.array([0, 1, 2]), OWN)


def coco_file(path: Path, of: list[tuple[str, str]]) -> Path:
    images = [{"id": i, "file_name": f"{name}/{frame}.png"} for i, (frame, name) in enumerate(of)]
    records = [
        {"image_id": i, "category_id": k, "bbox": [10, 10, 50, 30], "score": 0.5}
        for i in range(len(of))
        for k in range(3)
    ]
    categories = [{"id": i, "name": name} for i, name in enumerate(OWN)]
    write_json(path, {"images": images, "categories": categories, "annotations": records})
    return path


def camera_source(path: Path, of: dict[tuple[str, str], Detections2D]) -> Any:
    """The same detections as a table or a COCO file."""
    if path.suffix == ".parquet":
        pytest.importorskip("pyarrow")
        from lcf3d.formats.tables import write_table_2d

        write_table_2d(path, of)
    else:
        coco_file(path, list(of))
    return folder_camera_results(path, CLASSES, "error", None, IMAGES)


@pytest.mark.parametrize("name", ["a.parquet", "a.json"])
def test_names_are_joined_and_what_fits_nothing_is_counted(tmp_path: Path, name: str) -> None:
    known = {("a", "front"): boxes_2d(), ("b", "left"): boxes_2d()}
    source = camera_source(tmp_path / name, known)
    source.load(IDS)
    found = source.detect(FRAME, "front")
    assert [found.class_names[label] for label in found.labels] == ["car", "pedestrian"]
    assert source.left_out.taken == 4
    assert source.left_out.to_json() == {"classes": {"Tram": 2}}
    # frames beyond those of the run, once more as many detections of known classes
    source.load(("a",))
    assert source.left_out.taken == 2
    assert source.left_out.to_json() == {"classes": {"Tram": 2}, "frames": {"b": 2}}


def test_images_of_a_coco_file_that_the_dataset_does_not_have(tmp_path: Path) -> None:
    source = camera_source(tmp_path / "a.json", {("a", "front"): boxes_2d(), ("z", "front"): boxes_2d()})
    source.load(IDS)
    assert source.left_out.to_json()["frames"] == {"image 1": 3}


def test_cameras_of_a_table(tmp_path: Path) -> None:
    pytest.importorskip("pyarrow")
    source = camera_source(tmp_path / "a.parquet", {("a", "FRONT"): boxes_2d(), ("a", "back"): boxes_2d()})
    source.load(IDS)
    assert len(source.detect(FRAME, "front")) == 2
    assert source.left_out.to_json()["cameras"] == {"back": 2}
    nothing = camera_source(tmp_path / "b.parquet", {("a", "back"): boxes_2d()})
    with pytest.raises(DatasetError, match=r"of cameras that are not of this run \(back\); expected front, left"):
        nothing.load(IDS)


def test_a_table_of_3d_boxes(tmp_path: Path) -> None:
    pytest.importorskip("pyarrow")
    from lcf3d.formats.tables import write_table_3d

    write_table_3d(tmp_path / "a.parquet", {"a": boxes_3d(), "y": boxes_3d()})
    source: Any = folder_lidar_results(tmp_path / "a.parquet", CLASSES)
    source.load(IDS)
    assert len(source.detect(FRAME)) == 2
    assert source.left_out.to_json() == {"classes": {"Tram": 2}, "frames": {"y": 2}}
    with pytest.raises(DatasetError, match=r"has none of the 1 frames; its first is 'a'"):
        source.load(("q",))
    other: Any = folder_lidar_results(tmp_path / "a.parquet", ("bus",))
    with pytest.raises(DatasetError, match=r"of classes that are not of this run"):
        other.load(("a", "y"))


def test_a_folder_of_text_for_each_camera(tmp_path: Path) -> None:
    from lcf3d.formats.kitti import objects_from_detections_2d

    for name in ("Front", "left", "top"):
        for frame_id in IDS:
            write_objects(tmp_path / name / f"{frame_id}.txt", objects_from_detections_2d(boxes_2d()))
    source: Any = folder_camera_results(tmp_path, CLASSES, "error", None, IMAGES)
    source.load(IDS)
    assert len(source.detect(FRAME, "front")) == 2
    assert source.left_out.to_json() == {"classes": {"Tram": 4}, "cameras": {"top": 2}}
    with pytest.raises(DatasetError, match=r"of which none is a camera; expected back"):
        folder_camera_results(tmp_path, CLASSES, "error", None, {"x.png": ("a", "back")})


def test_a_coco_file_is_parsed_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from lcf3d.datasets import folder_results

    names: list[str] = []
    for module in (coco, folder_results):
        own = module.read_json
        monkeypatch.setattr(module, "read_json", lambda path, own=own: (names.append(path.name), own(path))[1])
    camera_source(tmp_path / "a.json", {("a", "front"): boxes_2d()}).load(IDS)
    assert names == ["a.json"]
