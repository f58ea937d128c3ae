"""Every reader of files with a small file that it reads well, to be damaged."""

from __future__ import annotations

import json
import pickle
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from lcf3d.structures import KITTI_CLASSES, NUSCENES_CLASSES, Detections2D, Detections3D
from tests.datasets.kitti_folder import calibration_text
from tests.fuzz.binary_readers import BINARY_READERS
from tests.fuzz.mutations import mutate_bytes, mutate_json
from tests.fuzz.reader import BOXES, Reader, call

LABEL = "Car 0.00 0 -1.57 100.0 120.0 200.0 180.0 1.5 1.6 3.9 1.0 1.5 20.0 -1.6"


def _text(text: str) -> Callable[[Path], None]:
    return lambda path: path.write_text(text)  # type: ignore[return-value]


def _json(value: Any) -> Callable[[Path], None]:
    return _text(json.dumps(value))


def _detections() -> Detections3D:
    return Detections3D(np.array(BOXES), np.array([0.9, 0.3]), np.array([0, 1]), KITTI_CLASSES)


def _provenance(path: Path) -> None:
    from lcf3d.frame import Frame
    from lcf3d.fusion.config import FusionConfig
    from lcf3d.fusion.pipeline import LateCascadeFusion
    from tests.datasets.kitti_folder import left_camera

    found = Detections2D(np.array([[500.0, 150, 600, 220]]), np.array([0.8]), np.array([0]), KITTI_CLASSES)
    fusion = LateCascadeFusion(FusionConfig.preset("kitti").updated(recovery=False))
    fused = fusion(Frame("f", None, [left_camera()]), _detections(), {"left": found})
    path.parent.mkdir(parents=True)
    path.write_text(json.dumps(fused.to_json()))


def _read_provenance(path: Path) -> None:
    from lcf3d.run.folder import RunFolder

    fused = RunFolder(path.parent.parent).read(path.stem)
    for i in range(len(fused)):
        fused.explain(i)
    for i in range(len(fused.lidar_inputs)):
        fused.explain_lidar(i)
    for i in range(len(fused.camera)):
        fused.explain_camera(i)


def _run_json(path: Path) -> None:
    from lcf3d.run.folder import RunFolder

    RunFolder(path.parent).request()


def _coco(path: Path) -> None:
    from lcf3d.formats.coco import encode_mask

    mask = np.zeros((20, 30), dtype=bool)
    mask[5:10, 4:9] = True
    segmentations = [encode_mask(mask), encode_mask(mask, compressed=False)]
    records = [
        {"image_id": 1, "category_id": 3, "bbox": [4, 5, 5, 5], "score": 0.5, "segmentation": s} for s in segmentations
    ]
    path.write_text(json.dumps(records))


def _read_coco(path: Path) -> None:
    from lcf3d.formats.coco import read_coco_results

    read_coco_results(path, ("car",), {3: "car"}, {1: ("a", "left")})


def _read_index(path: Path) -> None:
    from lcf3d.formats.coco import read_coco_index

    read_coco_index(path, {"image_2/000001.png": ("000001", "left")})


def _png(path: Path) -> None:
    from PIL import Image

    Image.fromarray(np.random.default_rng(0).integers(0, 255, (24, 32, 3), dtype=np.uint8)).save(path)


def _npz(path: Path) -> None:
    rng = np.random.default_rng(0)
    names = ("image", "boxes", "visible", "names", "hidden", "truncated", "owner")
    np.savez_compressed(path, **{name: rng.random(5) for name in names})


def _pickle(path: Path) -> None:
    record = {
        "name": np.array(["Car", "Pedestrian"]),
        "score": np.array([0.9, 0.3]),
        "boxes_lidar": np.array(BOXES),
        "pred_labels": np.array([1, 2]),
        "frame_id": "000001",
    }
    path.write_bytes(pickle.dumps([record]))


def _world(path: Path) -> None:
    from tests.datasets.nuscenes_world import write_world

    write_world(path.parents[1])


def _tables(path: Path) -> None:
    from lcf3d.datasets.nuscenes import NuscenesDataset

    dataset = NuscenesDataset(path.parents[1], path.parent.name)
    for frame in dataset:
        _ = frame.labels, frame.points


def _world_table(name: str) -> Reader:
    return Reader(f"world/v1.0-mini/{name}.json", _world, _tables, mutate_json)


def _config(path: Path) -> None:
    from lcf3d.fusion.config import FusionConfig

    FusionConfig.load(path)


def _set(path: Path) -> None:
    from lcf3d.run.settings import build_config

    build_config("kitti", path.read_text(errors="replace").splitlines())


def _good_config(path: Path) -> None:
    from lcf3d.fusion.config import FusionConfig

    FusionConfig.preset("kitti").dump(path)


def _calibration(path: Path) -> None:
    from lcf3d.fusion.calibration import Calibration

    Calibration.load(path)


def _classes(path: Path) -> None:
    from lcf3d.detectors.classes import read_class_names

    read_class_names(str(path))


def _spec(path: Path) -> None:
    from lcf3d.localizers.spec import LocalizerSpec

    LocalizerSpec.from_json(path.read_text(errors="replace"))


def _good_spec(path: Path) -> None:
    from lcf3d.localizers.spec import LocalizerSpec

    path.write_text(LocalizerSpec.of("v2", "kitti").to_json())


def _foreign(path: Path) -> None:
    from lcf3d.datasets.foreign_results import ForeignLidarResults

    ForeignLidarResults(path, ["000001"], KITTI_CLASSES)


def _mmdet3d(path: Path) -> None:
    from lcf3d.datasets.foreign_results import ForeignLidarResults

    ForeignLidarResults(path, [path.stem], KITTI_CLASSES, classes="Car,Pedestrian")


def _plain(dimensions: int) -> Reader:
    boxes = BOXES if dimensions == 3 else [[1.0, 2, 30, 40], [3, 4, 50, 60]]
    one = {"class_names": ["Car", "Pedestrian"], "boxes": boxes, "scores": [0.9, 0.2], "labels": [0, 1]}
    value = one if dimensions == 3 else {"left": one}
    return Reader("a.json", _json(value), call(f"lcf3d.formats.plain:read_detections_{dimensions}d"), mutate_json)


SUBMISSION = {
    "meta": {"use_camera": True, "use_lidar": True, "use_radar": False, "use_map": False, "use_external": False},
    "results": {
        "s0": [
            {
                "sample_token": "s0",
                "translation": [1.0, 2.0, 3.0],
                "size": [2.0, 4.0, 1.5],
                "rotation": [1.0, 0.0, 0.0, 0.0],
                "velocity": [0.5, 0.0],
                "detection_name": "car",
                "detection_score": 0.5,
                "attribute_name": "vehicle.moving",
            }
        ]
    },
}  # fmt: skip
_TRACKED = {key: value for key, value in SUBMISSION["results"]["s0"][0].items() if key != "attribute_name"}
TRACKING = {
    "meta": SUBMISSION["meta"],
    "results": {
        "s0": [{key.replace("detection", "tracking"): v for key, v in _TRACKED.items()} | {"tracking_id": "1"}]
    },
}
MAP = {"kind": "isotonic", "transform": "logit", "slope": 1.0, "points": [[0.0, 0.0], [1.0, 2.0]]}
CAMERA_LIST = [{"sample_token": "s", "camera": "C", "bbox": [1, 2, 3, 4], "score": 0.5, "category_name": "car"}]
COCO_INDEX = {"categories": [{"id": 3, "name": "car"}], "images": [{"id": 1, "file_name": "000001.png"}]}
MMDET3D = {"bboxes_3d": BOXES, "scores_3d": [0.9, 0.3], "labels_3d": [0, 1], "box_type_3d": "LiDAR"}
TIMES = "2011-09-26 13:02:25.964389445\n0.1\n"
OXTS = " ".join(["49.0", "8.4", "112.0", *["0.1"] * 27])

READERS: dict[str, Reader] = {
    "kitti labels": Reader(
        "a.txt", _text(f"{LABEL}\n" * 3), call("lcf3d.formats.kitti:read_objects", False), mutate_bytes
    ),
    "kitti results": Reader(
        "a.txt", _text(f"{LABEL} 0.9\n" * 3), call("lcf3d.formats.kitti:read_objects", True), mutate_bytes
    ),
    "kitti tracking": Reader(
        "a.txt", _text(f"0 1 {LABEL}\n" * 3), call("lcf3d.formats.kitti_drives:read_tracking_labels"), mutate_bytes
    ),
    "kitti tracks": Reader(
        "a.txt",
        _text("".join(f"{frame} 1 {LABEL} 0.9\n" for frame in range(3))),
        call("lcf3d.formats.kitti_tracking:read_tracks", True),
        mutate_bytes,
    ),
    "kitti calibration": Reader(
        "a.txt", _text(calibration_text()), call("lcf3d.datasets.kitti_calibration:read_calibration"), mutate_bytes
    ),
    "kitti split": Reader("a.txt", _text("000001\n000002\n"), call("lcf3d.formats.kitti:read_frame_ids"), mutate_bytes),
    "kitti scan": Reader(
        "a.bin",
        lambda path: np.random.default_rng(0).random((300, 4), dtype=np.float32).tofile(path),
        call("lcf3d.datasets.kitti:read_points"),
        mutate_bytes,
    ),
    "npy scan": Reader(
        "a.npy",
        lambda path: np.save(path, np.random.default_rng(0).random((300, 4), dtype=np.float32)),
        call("lcf3d.datasets.kitti:read_points"),
        mutate_bytes,
    ),
    "oxts": Reader("a.txt", _text(OXTS), call("lcf3d.formats.kitti_drives:read_oxts"), mutate_bytes),
    "times": Reader(
        "a.txt",
        _text("2011-09-26 13:02:25.964389445\n0.1\n"),
        call("lcf3d.formats.kitti_drives:read_times"),
        mutate_bytes,
    ),
    "poses": Reader("a.txt", _text("1 " * 12), call("lcf3d.formats.kitti_drives:read_camera_poses"), mutate_bytes),
    "coco results": Reader("a.json", _coco, _read_coco, mutate_json),
    "coco index": Reader("a.json", _json(COCO_INDEX), _read_index, mutate_json),
    "camera list": Reader(
        "a.json", _json(CAMERA_LIST), call("lcf3d.formats.coco:read_camera_detections", NUSCENES_CLASSES), mutate_json
    ),
    "submission": Reader("a.json", _json(SUBMISSION), call("lcf3d.formats.nuscenes:read_submission"), mutate_json),
    "tracking submission": Reader("a.json", _json(TRACKING), call("lcf3d.formats.nuscenes:read_tracking"), mutate_json),
    "plain 3d": _plain(3),
    "plain 2d": _plain(2),
    "provenance": Reader("run/provenance/f.json", _provenance, _read_provenance, mutate_json),
    "run.json": Reader("run.json", _json({"format": 2, "lcf3d": "0.2", "frames": ["a"]}), _run_json, mutate_json),
    "settings": Reader("a.yaml", _good_config, _config, mutate_bytes),
    "--set": Reader("a.txt", _text("match_iou=0.3\nunmatched=drop\nclass_names=[Car]\n"), _set, mutate_bytes),
    "score calibration": Reader("a.json", _json({"version": 1, "lidar": {"Car": MAP}}), _calibration, mutate_json),
    "class names": Reader("a.txt", _text("Car\nPedestrian\n"), _classes, mutate_bytes),
    "image": Reader("a.png", _png, call("lcf3d.datasets.images:read_image"), mutate_bytes),
    "image size": Reader("a.png", _png, call("lcf3d.datasets.images:image_size"), mutate_bytes),
    "training sample": Reader("a.npz", _npz, call("lcf3d.training.samples:read_image"), mutate_bytes),
    "openpcdet": Reader("a.pkl", _pickle, _foreign, mutate_bytes),
    "mmdet3d": Reader("000001.json", _json(MMDET3D), _mmdet3d, mutate_json),
    "localizer": Reader("a.json", _good_spec, _spec, mutate_json),
    **{
        f"nuscenes {name}": _world_table(name)
        for name in ("sample", "sample_data", "sample_annotation", "calibrated_sensor", "ego_pose", "sensor", "scene")
    },
    **BINARY_READERS,
}
