"""Trainings that begin with an exported network, and those on painted points, from KITTI files to a detector."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

torch = pytest.importorskip("torch")
pytest.importorskip("onnx")
pytest.importorskip("tensorboard")

from lcf3d.datasets.drive import read_drive  # noqa: E402
from lcf3d.detectors.fusion.frustum_pillars import frustum_pillars  # noqa: E402
from lcf3d.detectors.fusion.painting import painted  # noqa: E402
from lcf3d.detectors.lidar import OnnxLidarDetector, export_onnx  # noqa: E402
from lcf3d.detectors.lidar.kinds import shipped_path  # noqa: E402
from lcf3d.detectors.lidar.presets import COMPACT_KITTI, painted_config  # noqa: E402
from lcf3d.errors import ConfigError, DetectorError  # noqa: E402
from lcf3d.training.lidar import LidarTask, trained_detector  # noqa: E402
from lcf3d.training.lidar_scans import LabelledScan, ScanSource  # noqa: E402
from tests.training.lidar_scenes import SCENES, scene  # noqa: E402


def painted_scene(number):
    """Points of cars are painted as such, all others not at all."""
    scan = scene(number)
    paint = np.zeros((len(scan.points), 3), np.float32)
    paint[-160:, 0] = 0.9
    return LabelledScan(np.concatenate([scan.points, paint], axis=1), scan.boxes, scan.labels, scan.counts)


def test_a_painted_training_begins_where_the_exported_network_stands(tmp_path):
    plain = tmp_path / "lidar.onnx"
    learned = LidarTask(SCENES, None, COMPACT_KITTI, batch_size=2, window=(64, 64), begin=shipped_path("kitti"))
    export_onnx(trained_detector(learned.network(), COMPACT_KITTI), plain)
    config = painted_config("masks:shipped:kitti")
    task = LidarTask(ScanSource(painted_scene, 6, np.pi), None, config, batch_size=2, window=(64, 64), begin=plain)
    network = task.network()
    assert network.training
    detector = trained_detector(network, config, score_threshold=0.01)
    scan = painted_scene(0)
    found = detector(scan.points)
    exported = OnnxLidarDetector(plain, nms="keep", score_threshold=0.01, threads=1)(scene(0).points)
    assert len(found) == len(exported) > 0
    np.testing.assert_allclose(found.scores, exported.scores, atol=1e-4)
    np.testing.assert_allclose(found.boxes, exported.boxes, atol=1e-3)
    # what the points are painted with is learned from the first step
    sum(task.loss(network, task.batch(0, np.random.default_rng(0))).values()).backward()
    assert network.voxel_encoder.layers[0].linear.weight.grad[:, 39:].abs().sum() > 0


def test_bytes_of_the_shipped_network_become_weights_again():
    task = LidarTask(SCENES, None, COMPACT_KITTI, batch_size=2, window=(64, 64), begin=shipped_path("kitti"))
    points = read_drive(count=1)[0].points
    found = trained_detector(task.network(), COMPACT_KITTI, score_threshold=0.3)(points)
    exported = OnnxLidarDetector(shipped_path("kitti"), nms="keep", score_threshold=0.3, threads=1)(points)
    # the file rounds its maps as well, so that the two are alike and not equal
    assert len(exported) > 5
    assert abs(len(found) - len(exported)) <= 2
    apart = np.linalg.norm(found.boxes[:, None, :3] - exported.boxes[None, :, :3], axis=2).min(axis=1)
    assert np.median(apart) < 0.1


def test_what_is_no_compact_network_is_refused(tmp_path):
    from lcf3d.detectors.lidar.kinds import MODELS

    broken = tmp_path / "broken.onnx"
    broken.write_bytes(b"\x08\xff\xff")
    cases = (
        (tmp_path / "absent.onnx", "does not exist"),
        (broken, "ONNX"),
        (MODELS / "localizer_kitti.onnx", "is no compact pillar network to begin with"),
    )
    for path, message in cases:
        with pytest.raises(DetectorError, match=message):
            LidarTask(SCENES, None, COMPACT_KITTI, batch_size=2, window=(64, 64), begin=path).network()


@pytest.fixture(scope="module")
def networks(tmp_path_factory):
    """An untrained painted network and one on frustums, as files."""
    folder = tmp_path_factory.mktemp("networks")
    files = {}
    for name, config in (
        ("painted", painted_config("masks:shipped:kitti")),
        ("frustum", painted_config("shipped:kitti", only_painted=True)),
    ):
        task = LidarTask(ScanSource(painted_scene, 6, np.pi), None, config)
        files[name] = folder / f"{name}.onnx"
        export_onnx(trained_detector(task.network(), config), files[name])
    return files


def test_files_run_as_what_they_were_trained_as(networks):
    found = painted(str(networks["painted"]), threads=1)
    assert found.network.config.painted == COMPACT_KITTI.class_names
    assert frustum_pillars(str(networks["frustum"]), threads=1).network.config.only_painted
    for build, path, message in (
        (painted, networks["frustum"], "run it as frustum-pillars"),
        (frustum_pillars, networks["painted"], "run it as painted"),
        (frustum_pillars, shipped_path("kitti"), "run it as onnx-lidar"),
        (painted, shipped_path("kitti"), "run it as onnx-lidar"),
    ):
        with pytest.raises(DetectorError, match=message):
            build(str(path), threads=1)


def test_a_painted_training_resumes_only_with_its_painter():
    source = ScanSource(painted_scene, 6, np.pi)
    first = LidarTask(source, None, painted_config("masks:shipped:kitti")).described()
    other = LidarTask(source, None, painted_config("torchvision:fcn_resnet50")).described()
    assert first["painter"] != other["painter"]
    assert "painter" not in LidarTask(SCENES, None, COMPACT_KITTI).described()
    assert replace(LidarTask(SCENES), begin=shipped_path("kitti")).described()["begin"] == "lidar_kitti.onnx"


def test_the_command_refuses_what_cannot_be_painted(tmp_path):
    from lcf3d.cli.train_lidar import lidar

    with pytest.raises(ConfigError, match="painting needs images"):
        lidar(out=tmp_path, paint="masks:shipped:kitti")
    with pytest.raises(ConfigError, match="train one at a time"):
        lidar("kitti:x", out=tmp_path, paint="masks:shipped:kitti", frustums="shipped:kitti")
    with pytest.raises(DetectorError, match="ships no LiDAR network 'waymo'"):
        lidar("kitti:x", out=tmp_path, init="shipped:waymo", paint="")
