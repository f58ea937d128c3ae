"""Readers of binary files with a small good file each: networks, checkpoints, tables, clouds and bags.

The libraries behind them raise whatever their parsing ran into; `tests.fuzz.readers` has the readers of text.
"""

from __future__ import annotations

import json
import random
from pathlib import Path
from typing import Any

import numpy as np

from lcf3d.frame import Frame
from lcf3d.structures import KITTI_CLASSES, Detections2D, Detections3D
from tests.fuzz.mutations import mutate_bytes, mutate_json
from tests.fuzz.reader import BOXES, Reader, call

SHIPPED = {"lidar": "lcf3d.lidar_config", "localizer": "lcf3d.localizer"}


def _detections(dimensions: int) -> Any:
    scores, labels = np.array([0.9, 0.3]), np.array([0, 1])
    if dimensions == 3:
        return Detections3D(np.array(BOXES), scores, labels, KITTI_CLASSES)
    return Detections2D(np.array([[1.0, 2, 30, 40], [3, 4, 50, 60]]), scores, labels, KITTI_CLASSES)


def _camera_network(path: Path) -> None:
    """One car at (20, 20) - (40, 30) of a 64 x 64 image, as YOLOv8 says it."""
    from tests.detectors.camera.onnx_graphs import constant_graph

    output = np.zeros((1, 6, 84), np.float32)
    output[0, :5, 3] = 30, 25, 20, 10, 0.9
    names = {"names": "{0: 'car', 1: 'person'}", "imgsz": "[64, 64]", "task": "detect", "stride": "32"}
    constant_graph(path, {"output0": output}, {"images": [1, 3, 64, 64]}, names)


def _read_camera_network(path: Path) -> None:
    from lcf3d.detectors.camera.onnx import OnnxDetector

    OnnxDetector(path, threads=1)([np.full((64, 64, 3), 90, np.uint8)])


def _with_metadata(kind: str) -> Any:
    """A network of constants that holds the settings of a shipped one."""

    def make(path: Path) -> None:
        import onnxruntime

        import lcf3d
        from tests.detectors.camera.onnx_graphs import constant_graph

        shipped = Path(lcf3d.__file__).parent / "models" / f"{kind}_kitti.onnx"
        session = onnxruntime.InferenceSession(str(shipped), providers=["CPUExecutionProvider"])
        key = SHIPPED[kind]
        settings = session.get_modelmeta().custom_metadata_map[key]
        constant_graph(path, {"y": np.zeros(1, np.float32)}, {"x": [1]}, {key: settings})

    return make


def _lidar_network(path: Path) -> None:
    from lcf3d.detectors.lidar.onnx import OnnxLidarDetector

    OnnxLidarDetector(path, threads=1)


def _localizer_network(path: Path) -> None:
    from lcf3d.localizers.onnx import OnnxLocalizer

    OnnxLocalizer(path)


def mutate_metadata(data: bytes, random_: random.Random) -> bytes:
    """The settings that a network carries damaged, the network itself whole; now and then the bytes instead."""
    import onnx

    if random_.random() < 0.2:
        return mutate_bytes(data, random_)
    model = onnx.load_from_string(data)
    chosen = random_.choice(list(model.metadata_props))
    text = chosen.value.encode()
    try:
        json.loads(text)
        damaged = mutate_json(text, random_)
    except ValueError:
        damaged = mutate_bytes(text, random_)
    chosen.value = damaged.decode("utf-8", "replace")
    whole: bytes = model.SerializeToString()
    return whole


def _checkpoint(legacy: bool) -> Any:
    def make(path: Path) -> None:
        import torch

        content = {
            "state_dict": {"layer.weight": torch.arange(12.0).reshape(3, 4), "layer.bias": torch.zeros(3)},
            "meta": {"config": "model = dict(type='X')", "dataset_meta": {"classes": ("car", "bus")}, "epoch": 3},
        }
        torch.save(content, path, _use_new_zipfile_serialization=not legacy)

    return make


def _read_checkpoint(path: Path) -> None:
    from lcf3d.networks.checkpoints import read_notes, read_state_dict

    read_state_dict(path)
    read_notes(path)


def _training(path: Path) -> None:
    import torch

    from lcf3d.networks.checkpoints import TRAINING_FORMAT

    torch.save({"format": TRAINING_FORMAT, "epoch": 1, "network": {"w": torch.zeros(3)}}, path)


def _kept(path: Path) -> None:
    from lcf3d.paper.kept import _write

    _write(path, _detections(2), 3.0)


def _read_kept(path: Path) -> None:
    from lcf3d.paper.kept import _read

    _read(path, Detections2D)


def _annotations(path: Path) -> None:
    from tests.datasets.argoverse_log import cuboid, write_annotations

    write_annotations(path, [cuboid(1, "REGULAR_VEHICLE", (5.0, 1.0, 0.5)), cuboid(2, "PEDESTRIAN", (9.0, -1, 0.5))])


def _sweep(path: Path) -> None:
    from lcf3d.formats.feather import write_columns

    values = np.arange(20, dtype=np.float16)
    kinds = {"intensity": np.uint8, "laser_number": np.uint8, "offset_ns": np.int32}
    write_columns(path, {**dict.fromkeys("xyz", values), **{n: np.arange(20, dtype=k) for n, k in kinds.items()}})


def _fused_table(path: Path) -> None:
    from lcf3d.formats.fused_table import write_frames
    from lcf3d.fusion.config import FusionConfig
    from lcf3d.fusion.pipeline import LateCascadeFusion
    from tests.datasets.kitti_folder import left_camera

    fusion = LateCascadeFusion(FusionConfig.preset("kitti").updated(recovery=False))
    fused = fusion(Frame("f", None, [left_camera()]), _detections(3), {"left": _detections(2)})
    write_frames(path, [("f", fused)])


def _read_fused_table(path: Path) -> None:
    from lcf3d.formats.fused_table import read_frames

    for _, fused in read_frames(path):
        for i in range(len(fused)):
            fused.explain(i)


def _table(dimensions: int) -> Reader:
    from lcf3d.formats import tables

    write = tables.write_table_3d if dimensions == 3 else tables.write_table_2d
    key: Any = "f" if dimensions == 3 else ("f", "left")
    return Reader(
        "a.parquet",
        lambda path: write(path, {key: _detections(dimensions)}),
        call(f"lcf3d.formats.tables:read_table_{dimensions}d", KITTI_CLASSES),
        mutate_bytes,
        ("pyarrow",),
    )


def _pcd(path: Path) -> None:
    header = (
        "VERSION 0.7\nFIELDS x y z intensity\nSIZE 4 4 4 4\nTYPE F F F F\nCOUNT 1 1 1 1\nWIDTH 20\nHEIGHT 1\n"
        "VIEWPOINT 0 0 0 1 0 0 0\nPOINTS 20\nDATA binary\n"
    )
    path.write_bytes(header.encode() + np.random.default_rng(0).random((20, 4), dtype=np.float32).tobytes())


def _ply(path: Path) -> None:
    header = "ply\nformat binary_little_endian 1.0\nelement vertex 20\n"
    fields = "".join(f"property float {name}\n" for name in ("x", "y", "z", "intensity"))
    values = np.random.default_rng(0).random((20, 4), dtype=np.float32)
    path.write_bytes(f"{header}{fields}end_header\n".encode() + values.tobytes())


def _las(path: Path) -> None:
    import laspy

    cloud = laspy.create(point_format=1, file_version="1.2")
    cloud.x, cloud.y, cloud.z = np.random.default_rng(0).random((3, 20))
    cloud.write(str(path))


def _numpy(path: Path) -> None:
    np.save(path, np.random.default_rng(0).random((30, 4), dtype=np.float32))


def _cloud(suffix: str, make: Any, *needs: str) -> Reader:
    return Reader(f"a{suffix}", make, call("lcf3d.formats.point_files:read_scan"), mutate_bytes, needs)


def _bag(path: Path) -> None:
    from lcf3d.datasets.bag_export import write_bag
    from tests.datasets.plain_folder import boxes_of, camera

    rng = np.random.default_rng(0)
    frames = [
        Frame(
            f"f{i}",
            np.column_stack([rng.uniform(1, 20, (40, 3)), rng.random(40)]).astype(np.float32),
            [camera("front")],
            {"front": np.full((320, 640, 3), 60, np.uint8)},
            boxes_of(i),
            1000.0 + 0.1 * i,
            np.eye(4),
        )
        for i in range(2)
    ]
    write_bag(frames, path)


def _read_bag(path: Path) -> None:
    from lcf3d.datasets.bag import BagDataset

    for frame in BagDataset(path):
        _ = frame.points, frame.labels, [frame.images[name] for name in frame.images or {}]


ONNX = ("onnx",)
ARROW = ("pyarrow",)
BAGS = ("rosbags", "mcap")

BINARY_READERS: dict[str, Reader] = {
    "camera network": Reader("a.onnx", _camera_network, _read_camera_network, mutate_bytes, ONNX),
    "camera network's settings": Reader("a.onnx", _camera_network, _read_camera_network, mutate_metadata, ONNX),
    "lidar network's settings": Reader("a.onnx", _with_metadata("lidar"), _lidar_network, mutate_metadata, ONNX),
    "frustum network's settings": Reader(
        "a.onnx", _with_metadata("localizer"), _localizer_network, mutate_metadata, ONNX
    ),
    "checkpoint": Reader("a.pth", _checkpoint(False), _read_checkpoint, mutate_bytes, ("torch",)),
    "old checkpoint": Reader("a.pth", _checkpoint(True), _read_checkpoint, mutate_bytes, ("torch",)),
    "training checkpoint": Reader(
        "last.pt", _training, call("lcf3d.networks.checkpoints:read_training"), mutate_bytes, ("torch",)
    ),
    "kept detections": Reader("a.npz", _kept, _read_kept, mutate_bytes),
    "argoverse annotations": Reader(
        "a.feather", _annotations, call("lcf3d.formats.argoverse:read_annotations", "log"), mutate_bytes, ARROW
    ),
    "argoverse sweep": Reader("a.feather", _sweep, call("lcf3d.formats.argoverse:read_sweep"), mutate_bytes, ARROW),
    "table 3d": _table(3),
    "table 2d": _table(2),
    "fused table": Reader("a.parquet", _fused_table, _read_fused_table, mutate_bytes, ARROW),
    "pcd": _cloud(".pcd", _pcd, "pypcd4"),
    "ply": _cloud(".ply", _ply),
    "las": _cloud(".las", _las, "laspy"),
    "npy cloud": _cloud(".npy", _numpy),
    "mcap": Reader("a.mcap", _bag, _read_bag, mutate_bytes, BAGS, 4),
    "ros 1 bag": Reader("a.bag", _bag, _read_bag, mutate_bytes, BAGS, 4),
}
