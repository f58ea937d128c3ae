"""``lcf3d models`` against a server on this machine."""

from __future__ import annotations

import hashlib
import json
import threading
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer

import pytest
from typer import Typer
from typer.testing import CliRunner

from lcf3d.cli.models import models
from lcf3d.detectors import published
from lcf3d.detectors.published import PUBLISHED, PublishedModel, download
from lcf3d.errors import ConfigError, DetectorError

CONTENT = b"weights" * 1000


class Quiet(SimpleHTTPRequestHandler):
    def log_message(self, *arguments):
        pass


@pytest.fixture
def server(tmp_path):
    folder = tmp_path / "served"
    folder.mkdir()
    good = f"model-{hashlib.sha256(CONTENT).hexdigest()[:8]}.pth"
    (folder / good).write_bytes(CONTENT)
    (folder / "model-00000000.pth").write_bytes(CONTENT)
    httpd = ThreadingHTTPServer(("127.0.0.1", 0), partial(Quiet, directory=str(folder)))
    thread = threading.Thread(target=httpd.serve_forever, daemon=True)
    thread.start()
    yield f"http://127.0.0.1:{httpd.server_address[1]}/", good
    httpd.shutdown()


@pytest.fixture
def cli():
    app = Typer()
    app.command()(models)
    return lambda *arguments: CliRunner().invoke(app, arguments)


def test_the_list(cli):
    entries = json.loads(cli("--json").output)
    assert [entry["name"] for entry in entries] == [model.name for model in PUBLISHED]
    assert all(len(entry["sha256_begins"]) == 8 for entry in entries)
    text = cli("list").output
    assert "KITTI: PV-RCNN" in text
    assert "b384d22f" in text


def test_every_published_model_has_its_configuration():
    from lcf3d.detectors.lidar.presets import PRESETS

    assert {model.name for model in PUBLISHED} <= set(PRESETS)


def test_get_downloads_and_verifies(server, tmp_path, cli, monkeypatch):
    url, good = server
    monkeypatch.setattr(published, "PUBLISHED", (PublishedModel("mine", url + good, "", ""),))
    result = cli("get", "mine", "--to", str(tmp_path / "here"))
    assert result.exit_code == 0
    path = tmp_path / "here" / good
    assert result.output.replace("\n", "").endswith(str(path))
    assert path.read_bytes() == CONTENT


def test_a_right_file_is_not_fetched_again(server, tmp_path):
    url, good = server
    (tmp_path / good).write_bytes(CONTENT)
    nowhere = PublishedModel("mine", f"http://127.0.0.1:1/{good}", "", "")
    assert download(nowhere, tmp_path) == tmp_path / good
    # a damaged one is
    (tmp_path / good).write_bytes(b"half")
    assert download(PublishedModel("mine", url + good, "", ""), tmp_path).read_bytes() == CONTENT


def test_another_file_than_published_leaves_nothing(server, tmp_path):
    url, _ = server
    with pytest.raises(DetectorError, match="expected one that begins with 00000000"):
        download(PublishedModel("mine", url + "model-00000000.pth", "", ""), tmp_path / "out")
    assert not list((tmp_path / "out").iterdir())


def test_offline_and_unknown(tmp_path, server, cli):
    with pytest.raises(DetectorError, match=r"cannot be downloaded.*refused.*put it at"):
        download(PublishedModel("mine", "http://127.0.0.1:1/model-12345678.pth", "", ""), tmp_path)
    with pytest.raises(DetectorError, match="404"):
        download(PublishedModel("mine", server[0] + "absent-12345678.pth", "", ""), tmp_path)
    assert isinstance(cli("get", "nothing").exception, DetectorError)
    assert isinstance(cli("get").exception, ConfigError)
    assert isinstance(cli("put").exception, ConfigError)
