"""What the commands and Python blocks of the docs find: tiny data under the names that the pages use.

Pages say `kitti:KITTI`, `results:point_gnn`, `my_network`: here these are a folder of five made-up frames, result
files that go with it, and a function.
"""

from __future__ import annotations

import json
import pickle
import shutil
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from lcf3d import Detections2D, Detections3D, FusionConfig, LateCascadeFusion, NuscenesDataset, run, write_nuscenes
from lcf3d.frame import Frame
from lcf3d.geometry.camera import project_boxes
from lcf3d.structures import KITTI_CLASSES, NUSCENES_CLASSES
from tests.datasets.argoverse_log import FIRST_NS, LOG, cuboid, sweep_time, write_log, write_submission_rows
from tests.datasets.kitti_drives import make_raw, make_tracking
from tests.datasets.kitti_folder import OBJECTS, SIZE, ground, left_camera, make_kitti, make_results, right_camera
from tests.datasets.test_bag import write_drive_with_objects
from tests.fusion.scenes import CAR, PEDESTRIAN, camera, surface_points
from tests.localizers.scenes import propose

FRAMES = ("000000", "000001", "000002", "000003", "000008")
# five drives, so that a cross-validation may leave whole ones out
DRIVE = tuple(f"{drive:04d}_{i:06d}" for drive in range(5) for i in range(2))
LIDAR = ("DIR_3D", "point_gnn", "pointpillars", "pointrcnn", "lidar_only", "pillars_k", "pillars_n_on_k")
CAMERA = ("DIR_2D", "rcnn_2d", "rrc_2d", "faster_rcnn", "frustum_pointnets_2d", "yolo", "boxes_2d")
FOLDERS = ("", "runs/", "results/")
NUSCENES_LIDAR = ("results.json", "submission.json", "centerpoint.json", "n.json", "k_on_n.json")
NUSCENES_CAMERA = ("n_2d.json", "detections_2d.json", "boxes_2d.json")

SUBSTITUTIONS = {
    # downloads at first use; the shipped network stands for it
    "yolox:nano": "shipped:kitti",
    "TOKEN": "{token}",
}
"""Words of commands that stand for something of the reader's, and what the test has in their place."""


def write_base(root: Path) -> None:
    """Everything that commands read, but for what a page makes itself."""
    kitti = make_kitti(root / "KITTI", FRAMES)
    (kitti / "training" / "image_3").mkdir()
    for frame_id in FRAMES:
        Image.new("RGB", SIZE, (90, 90, 90)).save(kitti / "training" / "image_3" / f"{frame_id}.png")
    for split in ("train", "sensor_train", "sensor_val", "trainval"):
        shutil.copy(kitti / "ImageSets" / "val.txt", kitti / "ImageSets" / f"{split}.txt")
    lidar, found2d = make_results(root / "made", (*FRAMES, *DRIVE))
    for source, names in ((lidar, LIDAR), (found2d, CAMERA)):
        for name in names:
            for folder in FOLDERS:
                shutil.copytree(source, root / folder / name)
    shutil.copytree(lidar, root / "results" / "fused")
    run(f"kitti:{kitti}", f"results:{lidar}", f"results:{found2d}", root / "run")
    make_kitti(root / "DRIVES", DRIVE)
    scans = make_tracking(root / "TRACKING", ("0000",)) / "training" / "velodyne" / "0000"
    shutil.copy(scans / "000000.bin", scans / "000001.bin")
    make_tracking(root / "TRACKING_5", tuple(f"{drive:04d}" for drive in range(5)))
    shutil.move(root / "TRACKING_5/training/label_02", root / "DRIVES/training/label_02")
    shutil.rmtree(root / "TRACKING_5")
    make_raw(root / "RAW")
    write_drive_with_objects(root / "drive.mcap")
    _other_tools(root)
    _nuscenes(root)
    _argoverse(root)


def _nuscenes(root: Path) -> None:
    boxes = np.array([[12.0, 1, -0.9, 4.5, 1.9, 1.7, 0.3], [14.0, -4, -0.9, 0.7, 0.7, 1.75, 0]])
    labels = np.array([NUSCENES_CLASSES.index(name) for name in ("car", "pedestrian")])
    truth = Detections3D(boxes, np.ones(2), labels, NUSCENES_CLASSES)
    points = np.concatenate([surface_points(boxes), ground()])
    view = camera("CAM_FRONT", 0.0)
    image = np.zeros((view.height, view.width, 3), np.uint8)
    frames = [Frame(name, points, [view], {view.name: image}, labels=truth) for name in ("a", "b")]
    tokens = {id: t for t, id in write_nuscenes(frames, root / "NUSCENES", {"CAM_FRONT": "CAM_FRONT"}).items()}
    tables = (root / "NUSCENES" / "v1.0-converted").rename(root / "NUSCENES" / "v1.0-mini")
    scenes = (tables / "scene.json").read_text()
    # names that the official split mini_val lists
    (tables / "scene.json").write_text(scenes.replace("scene-a", "scene-0103").replace("scene-b", "scene-0916"))
    dataset = NuscenesDataset(root / "NUSCENES")
    found = Detections3D(boxes, [0.7, 0.4], labels, NUSCENES_CLASSES)
    rectangles, _ = project_boxes(boxes, view)
    records = [
        {
            "sample_token": token,
            "camera": "CAM_FRONT",
            "bbox": [x1, y1, x2 - x1, y2 - y1],
            "score": 0.8,
            "category_name": NUSCENES_CLASSES[label],
        }
        for token in tokens.values()
        for (x1, y1, x2, y2), label in zip(rectangles.tolist(), labels, strict=True)
    ]
    for name in NUSCENES_LIDAR:
        dataset.write_results(root / name, dict.fromkeys(tokens.values(), found))
    for name in NUSCENES_CAMERA:
        (root / name).write_text(json.dumps(records))
    images = [{"id": i, "file_name": path} for i, path in enumerate(dataset.image_files())]
    categories = [{"id": 7, "name": "car"}]
    (root / "annotations.json").write_text(json.dumps({"images": images, "categories": categories}))
    found_2d = {"image_id": 0, "category_id": 7, "bbox": records[0]["bbox"], "score": 0.5}
    (root / "coco_results.json").write_text(json.dumps([found_2d]))


def _other_tools(root: Path) -> None:
    """What OpenPCDet and mmdet3d write."""
    boxes = np.array([OBJECTS[0]])
    with (root / "result.pkl").open("wb") as file:
        records = [{"frame_id": i, "boxes_lidar": boxes, "score": [0.6], "name": np.array(["Car"])} for i in FRAMES]
        pickle.dump([{**record, "score": np.array(record["score"])} for record in records], file)
    (root / "preds").mkdir()
    bottom = boxes - np.array([[0, 0, boxes[0, 5] / 2, 0, 0, 0, 0]])
    for frame_id in FRAMES:
        found = {"bboxes_3d": bottom.tolist(), "scores_3d": [0.6], "labels_3d": [2]}
        (root / "preds" / f"{frame_id}.json").write_text(json.dumps(found))


def _argoverse(root: Path) -> None:
    write_log(root / "ARGOVERSE2")
    cars = [cuboid(sweep_time(i), "REGULAR_VEHICLE", (21.0 - i, 0.1, 1.5)) for i in range(3)]
    for name in ("detections.feather", "submission.feather"):
        write_submission_rows(root / name, cars, [0.8, 0.7, 0.6])
    seen = {"sample_token": f"{LOG}_{FIRST_NS}", "camera": "ring_front_center", "score": 0.9}
    box = {**seen, "bbox": [45.0, 33, 11, 11], "category_name": "REGULAR_VEHICLE"}
    (root / "ring_2d.json").write_text(json.dumps([box]))


def names() -> dict[str, Any]:
    """What a Python block may use without defining it: the reader's own detectors, frame and arrays."""
    left, right = left_camera(), right_camera()
    points = np.concatenate([surface_points(OBJECTS), ground()]).astype(np.float32)
    image = np.full((SIZE[1], SIZE[0], 3), 90, np.uint8)
    truth = Detections3D(OBJECTS, np.ones(3), [CAR, CAR, PEDESTRIAN], KITTI_CLASSES)
    frame = Frame("000008", points, [left, right], {"left": image, "right": image}, labels=truth)
    lidar = Detections3D(OBJECTS, [0.6, 0.7, 0.5], [CAR, CAR, PEDESTRIAN], KITTI_CLASSES)
    views = {
        view.name: Detections2D(project_boxes(lidar.boxes, view)[0], [0.9, 0.8, 0.7], lidar.labels, KITTI_CLASSES)
        for view in (left, right)
    }
    fusion = LateCascadeFusion(FusionConfig.preset("kitti"))

    def my_network(_: np.ndarray) -> tuple[Any, Any, Any]:
        return np.zeros((0, 7)), np.zeros(0), np.zeros(0, int)

    return {
        "frame": frame,
        "points": points,
        "image": image,
        "lidar": lidar,
        "camera": views["left"],
        "left_detections": views["left"],
        "right_detections": views["right"],
        "fusion": fusion,
        "fused": fusion(frame, lidar, {"left": views["left"]}),
        "my_network": my_network,
        "my_lidar_detector": lambda _: lidar,
        "lidar_detections": lidar.with_classes(("car", "person"), {"Car": "car", "Pedestrian": "person"}),
        "camera_detections": views["left"].with_classes(("car", "person"), {"Car": "car", "Pedestrian": "person"}),
        "K": left.projection[:, :3],
        "camera_from_lidar": left.camera_from_lidar,
        "proposals": propose(points, OBJECTS, lidar.labels, left),
    }
