import time
from pathlib import Path

import pytest

from lcf3d.errors import DetectorError

torch = pytest.importorskip("torch")

from lcf3d.networks.checkpoints import TRAINING_FORMAT  # noqa: E402
from lcf3d.training.finishing import FINISHERS, halves, network_of  # noqa: E402


def test_halves_share_no_sample_and_fit_the_time():
    paths = [Path(f"{n}.npz") for n in range(100)]
    fitted, measured = halves(paths, time.time() + 5)
    assert 0 <= len(fitted) - len(measured) <= 1
    assert 6 <= len(fitted) + len(measured) <= 10
    assert not set(fitted) & set(measured)
    assert halves(paths, time.time() - 60) == (paths[:4:2], paths[1:4:2])
    assert halves([], time.time() + 60) == ([], [])


@pytest.mark.parametrize(
    ("name", "file"),
    [("camera", "camera.onnx"), ("lidar", "lidar.onnx"), ("localizer_kitti", "localizer_kitti.onnx")],
)
def test_without_held_out_samples_there_is_a_network_and_no_figure(name, file, tmp_path):
    pytest.importorskip("onnx")
    torch.manual_seed(0)
    weights = dict(fresh(name).state_dict())
    torch.save({"format": TRAINING_FORMAT, "averaged": weights}, tmp_path / "weights.pt")
    network = network_of(name, tmp_path / "weights.pt")
    assert not network.training
    assert all(torch.equal(value, weights[key]) for key, value in network.state_dict().items())
    assert FINISHERS[name](network, [], tmp_path, time.time() + 10) == {}
    assert (tmp_path / file).stat().st_size > 100_000


def test_weights_of_another_network_are_refused(tmp_path):
    torch.save({"format": TRAINING_FORMAT, "averaged": fresh("lidar").state_dict()}, tmp_path / "weights.pt")
    with pytest.raises(DetectorError, match="another architecture"):
        network_of("camera", tmp_path / "weights.pt")


def fresh(name):
    from lcf3d.detectors.camera.small_network import SmallConfig, SmallDetector
    from lcf3d.detectors.lidar.compact import CompactPillars
    from lcf3d.detectors.lidar.presets import COMPACT_KITTI
    from lcf3d.localizers.spec import LocalizerSpec
    from lcf3d.training.localizer import build_network

    if name == "camera":
        return SmallDetector(SmallConfig())
    return CompactPillars.build(COMPACT_KITTI) if name == "lidar" else build_network(LocalizerSpec.of("v1", "kitti"))
