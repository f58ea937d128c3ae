"""Results of OpenPCDet and mmdet3d as a LiDAR branch: by the records that those tools write."""

import json
import pickle

import numpy as np
import pytest

from lcf3d.datasets.base import BaseDataset
from lcf3d.datasets.foreign_results import ForeignLidarResults, is_foreign
from lcf3d.datasets.nuscenes import RAW_FROM_CANONICAL
from lcf3d.errors import ConfigError, DatasetError, FormatError, Lcf3dError
from lcf3d.frame import Frame
from lcf3d.run.results import lidar_results
from lcf3d.structures import KITTI_CLASSES

CAR = [10.0, 2.0, -0.9, 4.0, 1.8, 1.6, 0.5]
IDS = ("000001", "000002")
CLASSES = "Pedestrian,Cyclist,Car"


class Folder(BaseDataset):
    """A dataset with nothing in its frames."""

    ids = IDS
    class_names = KITTI_CLASSES
    camera_names = ()

    def frame(self, frame_id):
        return Frame(frame_id)


def openpcdet(frame_id, boxes=(CAR,), names=("Car",), **more):
    """A record as OpenPCDet's ``generate_prediction_dicts`` makes it."""
    n = len(boxes)
    return {
        "name": np.array(names) if n else np.zeros(0),
        "truncated": np.zeros(n),
        "score": np.full(n, 0.8, np.float32),
        "boxes_lidar": np.array(boxes, dtype=np.float32).reshape(n, -1) if n else np.zeros([0, 7]),
        "frame_id": frame_id,
        **more,
    }


def mmdet3d(**more):
    """A record as mmdet3d's inferencers write it: z at the bottom."""
    bottom = [*CAR[:2], CAR[2] - 0.8, *CAR[3:]]
    return {"labels_3d": [2], "scores_3d": [0.8], "bboxes_3d": [bottom], "box_type_3d": "LiDAR", **more}


def written(path, content):
    if path.suffix == ".pkl":
        path.write_bytes(pickle.dumps(content))
    else:
        path.write_text(json.dumps(content))
    return path


def load(path, **options):
    return ForeignLidarResults(path, IDS, KITTI_CLASSES, **options)


def test_openpcdet(tmp_path):
    path = written(tmp_path / "result.pkl", [openpcdet("000002", [], []), openpcdet("000001")])
    source = lidar_results(str(path), KITTI_CLASSES, Folder())
    found = source.detect(Frame("000001"))
    np.testing.assert_allclose(found.boxes, [CAR], rtol=1e-6)
    assert found.class_names == KITTI_CLASSES
    assert found.labels.tolist() == [KITTI_CLASSES.index("Car")]
    assert len(source.detect(Frame("000002"))) == 0


def test_openpcdet_of_nuscenes_is_turned_and_joined_by_token(tmp_path):
    # raw LIDAR_TOP has y ahead: the same car stands at (-y, x) with its yaw a quarter turn more
    raw = [-2.0, 10.0, -0.9, 4.0, 1.8, 1.6, 0.5 + np.pi / 2, -1.0, 3.0]
    record = openpcdet("n015-lidar-file", [raw], ["car"], metadata={"token": "000001"})
    source = load(
        written(tmp_path / "result.pkl", [record]), missing="empty", native_from_canonical=np.array(RAW_FROM_CANONICAL)
    )
    found = source.detect(Frame("000001"))
    np.testing.assert_allclose(found.boxes, [CAR], atol=1e-5)
    np.testing.assert_allclose(found.velocities, [[3, 1]], atol=1e-5)
    assert found.labels.tolist() == [KITTI_CLASSES.index("Car")]


def test_mmdet3d_folder_of_an_inferencer(tmp_path):
    for frame_id in IDS:
        written(tmp_path / f"{frame_id}.json", mmdet3d())
    assert is_foreign(tmp_path)
    source = lidar_results(str(tmp_path), KITTI_CLASSES, Folder(), classes=CLASSES)
    for frame_id in IDS:
        np.testing.assert_allclose(source.detect(Frame(frame_id)).boxes, [CAR])
    with pytest.raises(ConfigError, match=r"\?classes=NAME,NAME"):
        lidar_results(str(tmp_path), KITTI_CLASSES, Folder())


@pytest.mark.parametrize("name", ["preds.pkl", "preds.json"])
def test_mmdet3d_lists(tmp_path, name):
    # sample_idx is KITTI's number
    records = [{"pred_instances_3d": mmdet3d(), "sample_idx": 1}, mmdet3d(sample_idx=2)]
    path = written(tmp_path / name, records)
    assert is_foreign(path)
    source = load(path, classes=CLASSES)
    assert [len(source.detect(Frame(i))) for i in IDS] == [1, 1]


def test_joins_are_loud(tmp_path):
    path = written(tmp_path / "result.pkl", [openpcdet("000001")])
    with pytest.raises(DatasetError, match="lacks the results of 1 of 2 frames, first 000002"):
        load(path)
    assert len(load(path, missing="empty").detect(Frame("000002"))) == 0
    with pytest.raises(DatasetError, match="first 'abc', none of them of the dataset, whose first is '000001'"):
        load(written(path, [openpcdet("abc")]), missing="empty")
    with pytest.raises(DatasetError, match="detections of Tram, none of the classes Car"):
        load(written(path, [openpcdet("000001", names=["Tram"])]), missing="empty")
    with pytest.raises(FormatError, match="record 1 is a second one of frame 000001"):
        load(written(path, [openpcdet("000001"), openpcdet("000001")]))


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ({"a": 1}, "must hold a list of records, one a frame, got dict"),
        ([1, 2], "must hold a list of records"),
        ([{"boxes_lidar": np.zeros((0, 7))}], "record 0 names no frame; expected one of sample_idx"),
        ([{"boxes_lidar": np.zeros((1, 3)), "name": ["Car"], "score": [1.0], "frame_id": "000001"}], "000001 is malf"),
        ([{"boxes_lidar": np.zeros((1, 7)), "name": ["Car"], "frame_id": "000001"}], "000001 is malformed.*'score'"),
        ([{"frame_id": "000001", "sample_idx": "000001"}], "malformed.*'bboxes_3d'"),
    ],
)
def test_malformed_files(tmp_path, content, message):
    with pytest.raises(FormatError, match=message):
        load(written(tmp_path / "result.pkl", content), missing="empty", classes=CLASSES)


def test_classes_without_numbers_are_refused(tmp_path):
    with pytest.raises(ConfigError, match="holds none of those"):
        lidar_results(str(tmp_path), KITTI_CLASSES, Folder(), classes=CLASSES)
    with pytest.raises(Lcf3dError):
        lidar_results(str(tmp_path / "absent.pkl"), KITTI_CLASSES, Folder())
