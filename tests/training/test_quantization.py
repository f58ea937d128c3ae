"""Trained networks with layers of bytes."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

torch = pytest.importorskip("torch")
onnx = pytest.importorskip("onnx")

from onnx import TensorProto, helper  # noqa: E402

from lcf3d.demo.drive import demo_frames  # noqa: E402
from lcf3d.detectors.camera.onnx import OnnxDetector  # noqa: E402
from lcf3d.detectors.camera.small import shipped_path as camera_path  # noqa: E402
from lcf3d.detectors.camera.small_export import export_small  # noqa: E402
from lcf3d.detectors.camera.small_network import SmallConfig, SmallDetector  # noqa: E402
from lcf3d.detectors.lidar import OnnxLidarDetector, export_onnx  # noqa: E402
from lcf3d.detectors.lidar.compact import CompactNetwork  # noqa: E402
from lcf3d.detectors.lidar.kinds import shipped_path as lidar_path  # noqa: E402
from lcf3d.detectors.lidar.presets import COMPACT_KITTI  # noqa: E402
from lcf3d.errors import ConfigError, DetectorError  # noqa: E402
from lcf3d.frame import Frame  # noqa: E402
from lcf3d.networks.quantization import KINDS, chosen_nodes  # noqa: E402
from lcf3d.training.folded import exported_graph  # noqa: E402
from lcf3d.training.lidar import trained_detector  # noqa: E402
from lcf3d.training.quantization import LAYERS, feeds, kind_of, quantize_trained  # noqa: E402

FRAMES = demo_frames(2)


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """Networks of random weights, as exported."""
    torch.manual_seed(0)
    folder = tmp_path_factory.mktemp("networks")
    made = {name: folder / f"{name}.onnx" for name in LAYERS}
    export_small(SmallDetector(SmallConfig()), made["camera"], size=(96, 320))
    export_onnx(trained_detector(CompactNetwork(COMPACT_KITTI), COMPACT_KITTI), made["lidar"])
    return made


@pytest.fixture(scope="module")
def smaller(files: dict[str, Path], tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """The same with layers of bytes."""
    made = {name: tmp_path_factory.mktemp("bytes") / f"{name}.onnx" for name in files}
    for name, path in files.items():
        assert kind_of(path) == name
        # 7 residual blocks with two convolutions, 3 + 13 others; 7 + 1 + 2 + 1 sums, 3 maps made larger
        layers = {"camera": 30 + 14, "lidar": 6}[name]
        assert quantize_trained(path, name, FRAMES, made[name]) == layers
    return made


@pytest.mark.parametrize("name", list(LAYERS))
def test_maps_are_nearly_the_same(name: str, files: dict[str, Path], smaller: dict[str, Path]) -> None:
    makes = {"camera": OnnxDetector, "lidar": OnnxLidarDetector}[name]
    whole, rounded = (makes(path, threads=1)._session for path in (files[name], smaller[name]))
    for feed in feeds(files[name], name, FRAMES[1:]):
        for a, b in zip(whole.run(None, feed), rounded.run(None, feed), strict=True):
            # a byte has 256 steps, and layers add up
            assert np.abs(a - b).mean() < 0.1 * a.std() + 1e-6
            assert not np.array_equal(a, b)


@pytest.mark.parametrize("name", list(LAYERS))
def test_weights_have_seven_bits_and_come_back(name: str, files: dict[str, Path], smaller: dict[str, Path]) -> None:
    _, whole = exported_graph(files[name])
    _, rounded = exported_graph(smaller[name])
    stored = [key for key in rounded if key.endswith("_quantized") and rounded[key].dtype == np.int8]
    assert len(stored) >= 6
    for key in stored:
        weights = whole[key.removesuffix("_quantized")]
        # seven bits: products of two bytes added in pairs stay below 2 ** 15, with or without instructions for them
        assert np.abs(rounded[key].astype(int)).max() <= 64
        largest = np.abs(weights).max(axis=(1, 2, 3), keepdims=True)
        assert (np.abs(rounded[key.removesuffix("_quantized")] - weights) <= largest / 63 / 2 + 1e-6).all()


@pytest.mark.parametrize("name", list(LAYERS))
def test_what_the_file_says_of_itself_is_kept(name: str, files: dict[str, Path], smaller: dict[str, Path]) -> None:
    a, b = (onnx.load(str(path)) for path in (files[name], smaller[name]))
    assert {p.key: p.value for p in a.metadata_props} == {p.key: p.value for p in b.metadata_props}
    assert smaller[name].stat().st_size < 0.5 * files[name].stat().st_size
    with pytest.raises(DetectorError, match="has layers of bytes already"):
        kind_of(smaller[name])


def test_the_shipped_networks_have_layers_of_bytes() -> None:
    for path in (camera_path("kitti"), lidar_path("kitti")):
        with pytest.raises(DetectorError, match="has layers of bytes already"):
            kind_of(path)


def test_what_joins_maps_of_bytes_takes_bytes() -> None:
    nodes = [
        helper.make_node("Conv", ["x", "w"], ["a"], "/stem/Conv"),
        helper.make_node("Conv", ["a", "w"], ["b"], "/stages.1/Conv"),
        helper.make_node("Relu", ["b"], ["c"], "relu"),
        helper.make_node("Add", ["b", "c"], ["d"], "both"),
        helper.make_node("Add", ["a", "d"], ["e"], "one"),
        helper.make_node("Resize", ["d", "", "scales"], ["f"], "larger"),
        helper.make_node("Mul", ["d", "f"], ["g"], "no such kind"),
        helper.make_node("Add", ["g", "f"], ["h"], "after it"),
    ]
    assert set(KINDS) == {"Conv", "Add", "Resize"}
    graph = helper.make_graph(nodes, "graph", [], [])
    assert chosen_nodes(graph, LAYERS["camera"]) == ["/stages.1/Conv", "both", "larger"]


def test_other_files_and_empty_frames_are_refused(files: dict[str, Path], tmp_path: Path) -> None:
    value = helper.make_tensor_value_info("x", TensorProto.FLOAT, [1])
    graph = helper.make_graph(
        [helper.make_node("Identity", ["x"], ["y"])],
        "graph",
        [value],
        [helper.make_tensor_value_info("y", TensorProto.FLOAT, [1])],
    )
    other = tmp_path / "other.onnx"
    onnx.save(helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8), str(other))
    with pytest.raises(DetectorError, match="is no network of 'lcf3d train camera'"):
        kind_of(other)
    with pytest.raises(DetectorError, match="does not exist"):
        kind_of(tmp_path / "absent.onnx")
    blind = [Frame("0", None, FRAMES[0].cameras, {})]
    for name, wanted in (("camera", "images"), ("lidar", "scans")):
        with pytest.raises(DetectorError, match=f"give a dataset with {wanted}"):
            quantize_trained(files[name], name, blind, tmp_path / "out.onnx")
    assert not (tmp_path / "out.onnx").exists()


def test_the_command_refuses_to_replace_the_network(files: dict[str, Path]) -> None:
    from lcf3d.cli.train_quantize import quantize as command

    with pytest.raises(ConfigError, match="name another file"):
        command(files["camera"], "kitti:x", files["camera"])
