"""``lcf3d models`` against a server on this machine."""

from __future__ import annotations

import hashlib
import json
import threading
from contextlib import contextmanager
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer

import numpy as np
import pytest
from typer import Typer
from typer.testing import CliRunner

from lcf3d.cli.models import models
from lcf3d.detectors import downloads
from lcf3d.detectors.camera.yolox import yolox
from lcf3d.detectors.downloads import download, local_path
from lcf3d.detectors.lidar.presets import PRESETS
from lcf3d.detectors.published import PUBLISHED, PublishedModel
from lcf3d.errors import ConfigError, DetectorError

CONTENT = b"weights" * 1000


class Quiet(SimpleHTTPRequestHandler):
    def log_message(self, *arguments):
        pass


@contextmanager
def serving(folder):
    """The address of a server of the files of a folder."""
    httpd = ThreadingHTTPServer(("127.0.0.1", 0), partial(Quiet, directory=str(folder)))
    threading.Thread(target=httpd.serve_forever, daemon=True).start()
    yield f"http://127.0.0.1:{httpd.server_address[1]}/"
    httpd.shutdown()
    httpd.server_close()


@pytest.fixture
def server(tmp_path):
    folder = tmp_path / "served"
    folder.mkdir()
    good = f"model-{hashlib.sha256(CONTENT).hexdigest()[:8]}.pth"
    (folder / good).write_bytes(CONTENT)
    (folder / "model-00000000.pth").write_bytes(CONTENT)
    with serving(folder) as url:
        yield url, good


@pytest.fixture
def cli():
    app = Typer()
    app.command()(models)
    return lambda *arguments: CliRunner().invoke(app, arguments)


def test_the_list(cli):
    entries = json.loads(cli("--json").output)
    assert [entry["name"] for entry in entries] == [model.name for model in PUBLISHED]
    known = {entry["name"]: len(entry["sha256_begins"]) for entry in entries if entry["url"]}
    assert {name for name, digits in known.items() if digits == 0} == {"yolox-m", "ddq-detr-swinl-coco"}
    assert set(known.values()) == {0, 8, 64}
    text = cli("list").output
    for said in ("KITTI: PV-RCNN", "b384d22f... (the rest is not published)", "--lidar pv-rcnn:pv-rcnn-kitti"):
        assert said in text
    for said in ("--camera yolox:nano", "3,659,407 bytes", "Apache-2.0", "--localizer frustum-pointnet:FILE"):
        assert said in text


def test_every_published_lidar_network_has_its_configuration():
    fusion = {"mvxnet-kitti", "bevfusion-nuscenes", "bevfusion-lidar-nuscenes"}
    assert {model.name for model in PUBLISHED if model.sensor == "lidar"} <= set(PRESETS) | fusion
    for model in PUBLISHED:
        assert bool(model.url) == bool(model.licence)
        assert model.note or model.url


def test_get_downloads_and_verifies(server, tmp_path, cli, monkeypatch):
    url, good = server
    monkeypatch.setattr("lcf3d.detectors.published.PUBLISHED", (PublishedModel("mine", url + good),))
    result = cli("get", "mine", "--to", str(tmp_path / "here"))
    assert result.exit_code == 0
    path = tmp_path / "here" / good
    assert result.output.replace("\n", "").endswith(str(path))
    assert path.read_bytes() == CONTENT


def test_a_right_file_is_not_fetched_again(server, tmp_path):
    url, good = server
    (tmp_path / good).write_bytes(CONTENT)
    nowhere = PublishedModel("mine", f"http://127.0.0.1:1/{good}")
    assert download(nowhere, tmp_path) == tmp_path / good
    # a damaged one is
    (tmp_path / good).write_bytes(b"half")
    assert download(PublishedModel("mine", url + good), tmp_path).read_bytes() == CONTENT


def test_another_file_than_published_leaves_nothing(server, tmp_path):
    url, _ = server
    with pytest.raises(DetectorError, match="expected one that begins with 00000000"):
        download(PublishedModel("mine", url + "model-00000000.pth"), tmp_path / "out")
    assert not list((tmp_path / "out").iterdir())


def test_offline_and_unknown(tmp_path, server, cli):
    with pytest.raises(DetectorError, match=r"cannot be downloaded.*refused.*put it at"):
        download(PublishedModel("mine", "http://127.0.0.1:1/model-12345678.pth"), tmp_path)
    with pytest.raises(DetectorError, match="404"):
        download(PublishedModel("mine", server[0] + "absent-12345678.pth"), tmp_path)
    assert isinstance(cli("get", "nothing").exception, DetectorError)
    assert isinstance(cli("get").exception, ConfigError)
    assert isinstance(cli("put").exception, ConfigError)


def test_size_and_whole_sum_are_checked_where_they_are_known(server, tmp_path):
    url, good = server
    whole = hashlib.sha256(CONTENT).hexdigest()
    right = PublishedModel("mine", url + good, sha256=whole, size_bytes=len(CONTENT))
    assert download(right, tmp_path).read_bytes() == CONTENT
    with pytest.raises(DetectorError, match=r"sent 7000 bytes, expected 7001"):
        download(PublishedModel("mine", url + good, size_bytes=7001, sha256="0" * 64), tmp_path / "short")
    with pytest.raises(DetectorError, match=r"expected one that begins with 0000"):
        download(PublishedModel("mine", url + good, sha256="0" * 64), tmp_path / "other")


def test_a_model_without_an_address_says_what_to_do(cli):
    error = cli("get", "frustum-pointnet-kitti").exception
    assert isinstance(error, DetectorError)
    assert "pass the path of your file" in str(error)


def test_the_authors_networks_say_what_to_do():
    pytest.importorskip("torch")
    from lcf3d.detectors.camera.torchvision_fasterrcnn import TorchvisionFasterRCNN
    from lcf3d.localizers.torch_localizer import TorchLocalizer

    for build, name in ((TorchvisionFasterRCNN, "fasterrcnn-r101-kitti"), (TorchLocalizer, "frustum-pointnet-kitti")):
        with pytest.raises(DetectorError, match=f"{name}: trained by the LCF3D authors.*pass the path of your file"):
            build(name)


def test_a_lidar_detector_is_named_by_its_published_file(tmp_path, monkeypatch):
    """``--lidar pointpillars:pointpillars-kitti``: downloaded from a server here, verified, and kept."""
    torch = pytest.importorskip("torch")
    from lcf3d.detectors.lidar.kinds import pointpillars, second
    from lcf3d.detectors.lidar.pointpillars import PointPillars

    torch.manual_seed(0)
    folder = tmp_path / "served"
    folder.mkdir()
    torch.save({"state_dict": PointPillars.build(PRESETS["pointpillars-kitti"]).state_dict()}, folder / "file.pth")
    name = f"file-{hashlib.sha256((folder / 'file.pth').read_bytes()).hexdigest()[:8]}.pth"
    (folder / "file.pth").rename(folder / name)
    monkeypatch.setattr(downloads, "CACHE", tmp_path / "cache")
    with serving(folder) as url:
        models = (PublishedModel("pointpillars-kitti", url + name),)
        monkeypatch.setattr("lcf3d.detectors.published.PUBLISHED", models)
        monkeypatch.setattr(downloads, "PUBLISHED", models)
        with pytest.raises(DetectorError, match="pointpillars-kitti is a pointpillars network, not second"):
            second("pointpillars-kitti")
        assert not (tmp_path / "cache").exists()
        assert pointpillars("pointpillars-kitti").config.name == "pointpillars-kitti"
    # the server is gone: the file is not fetched again
    assert pointpillars("pointpillars-kitti").class_names == ("Pedestrian", "Cyclist", "Car")
    (tmp_path / "cache" / name).unlink()
    with pytest.raises(DetectorError, match=r"pointpillars-kitti cannot be downloaded .* put it at .*cache.* or"):
        pointpillars("pointpillars-kitti")


def test_a_file_goes_before_a_published_name(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "second-kitti").write_bytes(b"mine")
    assert local_path("second-kitti", "lidar").read_bytes() == b"mine"
    assert local_path("elsewhere.pth", "lidar").name == "elsewhere.pth"


def test_yolox_by_size(tmp_path, monkeypatch, cli):
    with pytest.raises(ConfigError, match=r"sizes nano, tiny, s, m, l, x, got 'huge'"):
        yolox("huge")
    monkeypatch.setattr(downloads, "CACHE", tmp_path)

    def offline(*_, **__):
        raise OSError("no network")

    monkeypatch.setattr(downloads, "urlopen", offline)
    with pytest.raises(DetectorError, match=r"yolox-nano cannot be downloaded .*no network.*yolox_nano.onnx"):
        yolox("nano")


@pytest.mark.real
def test_yolox_reads_the_official_form(shared, tmp_path, monkeypatch):
    """The shared export of the same network, in the place of Megvii's file, finds the cars of a KITTI image."""
    from PIL import Image

    data = (shared / "weights" / "yolox_nano.onnx").read_bytes()
    mine = PublishedModel(
        "yolox-nano",
        "http://127.0.0.1:1/yolox_nano.onnx",
        sha256=hashlib.sha256(data).hexdigest(),
        size_bytes=len(data),
    )
    (tmp_path / "yolox_nano.onnx").write_bytes(data)
    monkeypatch.setattr(downloads, "CACHE", tmp_path)
    monkeypatch.setattr("lcf3d.detectors.published.PUBLISHED", (mine,))
    image = next(path for path in sorted((shared / "data" / "kitti").rglob("image_2/*")) if "000008" in path.name)
    with Image.open(image) as picture:
        (found,) = yolox("nano", ("Car", "Pedestrian", "Cyclist"), tiles=2)([np.asarray(picture.convert("RGB"))])
    assert (found.labels[found.scores > 0.5] == 0).sum() >= 3
