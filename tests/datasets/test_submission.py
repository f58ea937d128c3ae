import json
import zipfile

import numpy as np
import pytest

from lcf3d.datasets.submission import KITTI_TEST_FRAMES, META_KEYS, kitti_zip, nuscenes_json, write_submission_file
from lcf3d.errors import ConfigError, DatasetError, FormatError
from lcf3d.formats.nuscenes import read_submission

LINE = "{name} -1 -1 0.5 100 100 {x2} 180 1.5 1.6 3.9 1 1.6 20 0.1 0.8\n"


def write(folder, frames, name="Car", x2=200):
    folder.mkdir()
    for frame in frames:
        (folder / f"{frame}.txt").write_text(LINE.format(name=name, x2=x2))
    return folder


def test_a_kitti_zip_holds_a_file_of_every_test_frame_in_its_root(tmp_path):
    frames = KITTI_TEST_FRAMES[:3]
    write(tmp_path / "data", frames)
    assert kitti_zip(tmp_path, tmp_path / "kitti.zip", frames) == 3
    with zipfile.ZipFile(tmp_path / "kitti.zip") as archive:
        assert archive.namelist() == ["000000.txt", "000001.txt", "000002.txt"]
        fields = archive.read("000000.txt").decode().split()
    assert fields[0] == "Car"
    values = [0.5, 100, 100, 200, 180, 1.5, 1.6, 3.9, 1, 1.6, 20, 0.1, 0.8]
    np.testing.assert_allclose([float(f) for f in fields[3:]], values)


def test_what_kittis_server_would_refuse_is_refused_here(tmp_path):
    frames = KITTI_TEST_FRAMES[:2]
    with pytest.raises(DatasetError):
        kitti_zip(write(tmp_path / "a", frames[:1]), tmp_path / "x.zip", frames)
    with pytest.raises(FormatError, match="holds Van"):
        kitti_zip(write(tmp_path / "b", frames, "Van"), tmp_path / "x.zip", frames)
    with pytest.raises(FormatError, match=r"000000.txt: 2 boxes have no area"):
        kitti_zip(write(tmp_path / "c", frames, x2=100), tmp_path / "x.zip", frames)
    with pytest.raises(DatasetError, match=r"1 files that are of no test frame, first 000001\.txt"):
        kitti_zip(tmp_path / "b", tmp_path / "x.zip", frames[:1])
    with pytest.raises(DatasetError, match="nowhere is not a folder"):
        kitti_zip(tmp_path / "nowhere", tmp_path / "x.zip", frames)
    (tmp_path / "d" / "detections").mkdir(parents=True)
    (tmp_path / "d" / "detections" / "part.parquet").touch()
    with pytest.raises(DatasetError, match="holds parquet files; the server takes text"):
        kitti_zip(tmp_path / "d", tmp_path / "x.zip", frames)
    with pytest.raises(ConfigError, match="is a folder; --out names the file"):
        write_submission_file("kitti:x", None, tmp_path / "b", tmp_path)
    assert not (tmp_path / "x.zip").exists()
    assert len(KITTI_TEST_FRAMES) == 7518


def box(token):
    return {
        "sample_token": token,
        "translation": [1.0, 2.0, 3.0],
        "size": [2.0, 4.0, 1.5],
        "rotation": [1.0, 0.0, 0.0, 0.0],
        "velocity": [0.0, 0.0],
        "detection_name": "car",
        "detection_score": 0.5,
        "attribute_name": "",
    }


def test_a_nuscenes_submission_has_all_samples_and_all_flags(tmp_path):
    tokens = ("a" * 32, "b" * 32)
    meta = dict.fromkeys(META_KEYS, True)
    path = tmp_path / "results.json"
    path.write_text(json.dumps({"meta": meta, "results": {tokens[0]: [box(tokens[0])], tokens[1]: []}}))
    assert nuscenes_json(tmp_path, tokens, tmp_path / "out.json", expected=2) == 2
    boxes, flags = read_submission(tmp_path / "out.json")
    assert (len(boxes), flags) == (1, meta)
    with pytest.raises(DatasetError, match=r"6008 samples of v1\.0-test, the tables hold 2"):
        nuscenes_json(path, tokens, tmp_path / "out.json")
    with pytest.raises(DatasetError, match="lacks 1 samples of the test set and holds 1 of others"):
        nuscenes_json(path, (tokens[0], "c" * 32), tmp_path / "out.json", expected=2)
    path.write_text(json.dumps({"meta": {**meta, "use_map": "no"}, "results": {token: [] for token in tokens}}))
    with pytest.raises(FormatError, match="true or false for use_map"):
        nuscenes_json(path, tokens, tmp_path / "out.json", expected=2)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"detection_name": "tram"}, "tram"),
        ({"attribute_name": "vehicle.flying"}, "vehicle.flying"),
        ({"size": [0.0, 4.0, 1.5]}, "size"),
        ({"detection_score": float("nan")}, "detection_score"),
        ({"translation": [1.0, 2.0]}, "translation"),
        ({"rotation": [0.0, 0.0, 0.0, 0.0]}, "rotation"),
    ],
)
def test_boxes_that_nuscenes_would_refuse_are_refused_here(tmp_path, change, message):
    path = tmp_path / "results.json"
    meta = dict.fromkeys(META_KEYS, True)
    path.write_text(json.dumps({"meta": meta, "results": {"a" * 32: [{**box("a" * 32), **change}]}}))
    with pytest.raises(FormatError, match=message):
        nuscenes_json(path, ("a" * 32,), tmp_path / "out.json", expected=1)
    assert not (tmp_path / "out.json").exists()


def test_501_boxes_are_too_many_for_nuscenes(tmp_path):
    path = tmp_path / "results.json"
    meta = dict.fromkeys(META_KEYS, True)
    path.write_text(json.dumps({"meta": meta, "results": {"a" * 32: [box("a" * 32)] * 501}}))
    with pytest.raises(FormatError, match="500"):
        nuscenes_json(path, ("a" * 32,), tmp_path / "out.json", expected=1)


def test_other_datasets_have_no_server_here(tmp_path):
    with pytest.raises(ConfigError, match="submission files are for"):
        write_submission_file("argoverse2:x", None, tmp_path, tmp_path / "x")
