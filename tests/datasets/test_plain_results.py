import pickle
from pathlib import Path

import numpy as np
import pytest

from lcf3d.datasets import plain_results
from lcf3d.datasets.plain_results import PlainCameraResults, PlainLidarResults
from lcf3d.errors import DatasetError
from lcf3d.formats.plain import write_detections_2d
from lcf3d.frame import Frame
from lcf3d.structures import Detections2D, Detections3D
from tests.datasets.plain_folder import CLASSES, boxes_of, camera

IDS = ("f0", "f1")


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    for i, name in enumerate(IDS):
        plain_results.write_detections_3d(tmp_path / "lidar" / f"{name}.json", boxes_of(i))
        seen = Detections2D(np.array([[10.0, 10, 60, 40 + i]]), np.array([0.9]), np.array([0]), CLASSES)
        write_detections_2d(tmp_path / "camera" / f"{name}.json", {"front": seen, "left": seen})
    return tmp_path


@pytest.fixture
def parsed(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Names of the files that are parsed, one entry a time."""
    names: list[str] = []
    for function in ("read_detections_2d", "read_detections_3d"):
        own = getattr(plain_results, function)
        monkeypatch.setattr(plain_results, function, lambda path, own=own: (names.append(path.name), own(path))[1])
    return names


def frame(name: str) -> Frame:
    return Frame(name, None, [camera("front"), camera("left")])


def test_a_file_is_parsed_once(folder: Path, parsed: list[str]) -> None:
    lidar = PlainLidarResults(folder / "lidar", CLASSES)
    lidar.load(IDS)
    assert [len(lidar.detect(frame(name))) for name in IDS] == [len(boxes_of(i)) for i in range(2)]
    assert parsed == ["f0.json", "f1.json"]
    parsed.clear()
    seen = PlainCameraResults(folder / "camera", CLASSES, camera_names=("front", "left"))
    seen.load(IDS)
    for i, name in enumerate(IDS):
        for view in ("front", "left"):
            assert seen.detect(frame(name), view).boxes[0, 3] == 40 + i
    assert parsed == ["f0.json", "f1.json"]


def test_what_is_not_kept_is_read_when_it_is_used(
    folder: Path, parsed: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(plain_results, "MOST_KEPT", 1)
    lidar = PlainLidarResults(folder / "lidar", CLASSES)
    lidar.load(IDS)
    found: Detections3D = lidar.detect(frame("f1"))
    np.testing.assert_allclose(found.boxes, boxes_of(1).boxes, atol=1e-5)
    assert parsed == ["f0.json", "f1.json", "f1.json"]
    # another process takes the places along, not what they hold
    other = pickle.loads(pickle.dumps(lidar))
    np.testing.assert_array_equal(other.detect(frame("f1")).boxes, found.boxes)
    (folder / "lidar/f1.json").unlink()
    with pytest.raises(DatasetError, match=r"f1\.json does not exist"):
        lidar.detect(frame("f1"))
