"""From "my data" to a picture: lines to write and seconds to wait, for the starting points that people have.

Lines are those that somebody writes, imports included: Python, shell commands, and lines of ``sensors.yaml`` to correct
after ``lcf3d init``. What makes the detections (the detector itself) is not counted. Seconds are of fresh processes,
wall clock and CPU, with the compile cache filled; imports are in them. ultralytics' object is a stand-in with its
fields, since that package is AGPL.

PYTHONPATH=. python benchmarks/starting_points.py --argoverse2 ../shared/data/argoverse2
"""

from __future__ import annotations

import argparse
import json
import os
import pickle
import resource
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
from tests.datasets.plain_folder import CLASSES, FRONT_FROM_LIDAR, K, boxes_of, camera, write_plain_folder

from lcf3d import FusionConfig, LateCascadeFusion
from lcf3d.datasets.argoverse2 import Argoverse2Dataset
from lcf3d.datasets.bag_export import write_bag
from lcf3d.datasets.folder import FolderDataset
from lcf3d.files import write_json
from lcf3d.geometry.camera import project_boxes

ARRAYS = """
import numpy as np
from PIL import Image
arrays = np.load("arrays.npz")
points, K, camera_from_lidar = arrays["points"], arrays["K"], arrays["pose"]
boxes3d, scores3d, labels3d = arrays["boxes3d"], arrays["scores3d"], arrays["labels3d"]
boxes2d, scores2d, labels2d = arrays["boxes2d"], arrays["scores2d"], arrays["labels2d"]
image = np.asarray(Image.open("drive/images/front/f00.png"))
"""
FUSE = """\
from lcf3d import Camera, Detections2D, Detections3D, Frame, FusionConfig, LateCascadeFusion, draw
names = ("car", "person")
camera = Camera("front", np.hstack([K, np.zeros((3, 1))]), camera_from_lidar, 640, 320)
frame = Frame("0", points, [camera], {{"front": image}})
lidar = Detections3D(boxes3d, scores3d, labels3d, names)
seen = {seen}
fused = LateCascadeFusion(FusionConfig(class_names=names))(frame, lidar, {{"front": seen}})
draw(frame, fused).save("picture.png")
"""
PYTHON = {
    "numpy arrays": ("", "Detections2D(boxes2d, scores2d, labels2d, names)"),
    "supervision": (
        "import supervision as sv\n"
        "found = sv.Detections(boxes2d, confidence=scores2d, class_id=labels2d)\n"
        "found.data['class_name'] = np.array(['car', 'person'])[labels2d]\n",
        "Detections2D.from_supervision(found).with_classes(names)",
    ),
    "ultralytics (stand-in)": (
        "from types import SimpleNamespace\n"
        "boxes = SimpleNamespace(xyxy=boxes2d, conf=scores2d, cls=labels2d.astype(float))\n"
        "result = SimpleNamespace(boxes=boxes, masks=None, names={0: 'car', 1: 'person'}, orig_shape=(320, 640))\n",
        "Detections2D.from_ultralytics(result).with_classes(names)",
    ),
    "torchvision": (
        "import torch\n"
        "prediction = {'boxes': torch.tensor(boxes2d), 'scores': torch.tensor(scores2d),\n"
        "              'labels': torch.tensor(labels2d) + 1}\n",
        "Detections2D.from_torchvision(prediction, ['__background__', *names]).with_classes(names)",
    ),
}
SHELL = {
    "OpenPCDet's result.pkl": (
        ["run folder:drive --lidar results:result.pkl --camera results:drive/camera_results --out {out} --pictures"],
        0,
    ),
    "mmdet3d's preds": (
        [
            "run folder:drive --lidar results:preds?classes={classes} --camera results:drive/camera_results "
            "--out {out} --pictures"
        ],
        0,
    ),
    "bag (MCAP)": (
        [
            "run bag:drive.mcap --lidar topic:/lidar/objects --camera topic:/front/objects --out {out} --pictures",
        ],
        0,
    ),
    "folder with .pcd": (
        [
            "init pcd",
            "run folder:pcd --lidar results:drive/lidar_results --camera results:drive/camera_results --out {out} "
            "--pictures",
        ],
        4,
    ),
}


def prepare(folder: Path) -> None:
    """All the data, in ``folder``."""
    write_plain_folder(folder / "drive", 4)
    dataset = FolderDataset(folder / "drive")
    labels = boxes_of(0)
    boxes2d, visible = project_boxes(labels.boxes, camera("front"))
    np.savez(
        folder / "arrays.npz",
        points=dataset[0].points,
        K=K,
        pose=FRONT_FROM_LIDAR,
        boxes3d=labels.boxes,
        scores3d=np.full(len(labels), 0.7),
        labels3d=labels.labels,
        boxes2d=boxes2d[visible],
        scores2d=np.full(visible.sum(), 0.9),
        labels2d=labels.labels[visible],
    )
    records = [
        {
            "boxes_lidar": boxes_of(i).boxes,
            "score": np.full(4, 0.7),
            "name": np.array([CLASSES[label] for label in boxes_of(i).labels]),
            "frame_id": frame_id,
        }
        for i, frame_id in enumerate(dataset.ids)
    ]
    (folder / "result.pkl").write_bytes(pickle.dumps(records))
    for record in records:
        # z of mmdet3d's boxes is that of the bottom face
        boxes = record["boxes_lidar"] - np.array([0, 0, 0.5, 0, 0, 0, 0]) * record["boxes_lidar"][:, 5:6]
        labels3d = [CLASSES.index(name) for name in record["name"]]
        found = {"bboxes_3d": boxes.tolist(), "scores_3d": record["score"].tolist(), "labels_3d": labels3d}
        write_json(folder / "preds" / f"{record['frame_id']}.json", {**found, "box_type_3d": "LiDAR"})
    lidar = dataset.lidar_results(dataset.root / "lidar_results", CLASSES)
    seen = dataset.camera_results(dataset.root / "camera_results", CLASSES)
    write_bag(
        dataset,
        folder / "drive.mcap",
        detections=lambda frame: (lidar.detect(frame), {"front": seen.detect(frame, "front")}),
    )
    _write_pcd(dataset, folder / "pcd")


def _write_pcd(dataset: FolderDataset, root: Path) -> None:
    """The drive with scans as PCD, without a ``sensors.yaml``."""
    from pypcd4 import PointCloud

    shutil.copytree(dataset.root / "images", root / "images")
    (root / "scans").mkdir()
    for frame in dataset:
        PointCloud.from_xyzi_points(frame.points).save(root / "scans" / f"{frame.id}.pcd")


def argoverse2(folder: Path, root: Path) -> list[str]:
    """Commands for one moment of a log, with results made from its labels."""
    dataset = Argoverse2Dataset(root)
    frame = next(f for f in map(dataset.frame, dataset.ids) if f.points is not None)
    labels = frame.labels
    assert labels is not None
    name = "ring_front_center"
    boxes, visible = project_boxes(labels.boxes, frame.camera(name))
    write_json(
        folder / "av2_2d.json",
        [
            {
                "sample_token": frame.id,
                "camera": name,
                "bbox": [x1, y1, x2 - x1, y2 - y1],
                "score": 0.9,
                "category_name": labels.class_names[label],
            }
            for (x1, y1, x2, y2), label in zip(boxes[visible].tolist(), labels.labels[visible], strict=True)
        ],
    )
    run = folder / "av2_run"
    fused = LateCascadeFusion(FusionConfig(class_names=labels.class_names))(frame, labels, {})
    writer = dataset.writer(run)
    writer.write(frame, fused)
    writer.finish([frame.id], lambda _: fused)
    found = next(run.glob("*.feather"))
    return [
        f"run argoverse2:{root} --lidar results:{found} --camera results:av2_2d.json --frame {frame.id} "
        "--out {out} --pictures"
    ]


def timed(commands: list[list[str]], folder: Path) -> tuple[float, float]:
    """Wall and CPU seconds of commands, one after the other."""
    before, start = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
    for command in commands:
        done = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)
        if done.returncode:
            raise SystemExit(f"{' '.join(command)}\n{done.stderr or done.stdout}")
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    cpu = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    return time.perf_counter() - start, cpu


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--argoverse2", type=Path, help="folder with a log")
    parser.add_argument("--repeats", type=int, default=3)
    arguments = parser.parse_args()
    rows: dict[str, dict[str, float]] = {}
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        prepare(folder)
        shell = dict(SHELL)
        if arguments.argoverse2:
            shell["Argoverse 2, one moment"] = (argoverse2(folder, arguments.argoverse2.resolve()), 0)
        jobs: dict[str, tuple[int, list[list[str]]]] = {}
        for title, (made, seen) in PYTHON.items():
            code = FUSE.format(seen=seen)
            jobs[title] = (len(code.splitlines()) + 1, [[sys.executable, "-c", ARRAYS + made + code]])
        for title, (commands, corrected) in shell.items():
            split = [[sys.executable, "-m", "lcf3d", *command.split()] for command in commands]
            jobs[title] = (len(commands) + corrected, split)
        for title, (lines, commands) in jobs.items():
            times = []
            for repeat in range(arguments.repeats + 1):
                (folder / "pcd/sensors.yaml").unlink(missing_ok=True)
                out = f"out{len(rows)}_{repeat}"
                filled = [
                    [part.replace("{out}", out).replace("{classes}", ",".join(CLASSES)) for part in command]
                    for command in commands
                ]
                times.append(timed(filled, folder))
            # the first fills the compile cache
            wall, cpu = np.median(np.array(times[1:]), axis=0)
            rows[title] = {"lines": lines, "wall_s": round(float(wall), 1), "cpu_s": round(float(cpu), 1)}
            print(title, json.dumps(rows[title]), flush=True)


if __name__ == "__main__":
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    main()
