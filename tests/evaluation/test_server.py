import socket

import pytest

from lcf3d.errors import ConfigError
from lcf3d.evaluation.server import HOST, listen, report_app

from .test_report import Calibrated, data_of, result_set

testclient = pytest.importorskip("starlette.testclient", reason="needs starlette: pip install 'lcf3d[serve]'")


@pytest.fixture(scope="module")
def client():
    app = report_app(result_set(), Calibrated(), {"Version": "1"})
    return testclient.TestClient(app, base_url=f"http://{HOST}")


def test_the_page_has_all_frames_and_no_pictures(client) -> None:
    answer = client.get("/")
    data = data_of(answer.text)
    assert len(data["frames"]) == 45
    assert data["pictures"] == {}
    assert data["pictures_from"] == "picture"


def test_pictures_are_given_by_frame(client) -> None:
    picture = client.get("/picture", params={"frame": "5"}).json()
    assert picture["images"][0]["src"].startswith("data:image/jpeg;base64,")
    assert picture["scan"]
    assert client.get("/picture", params={"frame": "4"}).json() == {"images": []}


@pytest.mark.parametrize(
    "path", ["/../pyproject.toml", "/etc/passwd", "/picture/../../etc/passwd", "/static/report.js"]
)
def test_nothing_else_is_served(client, path: str) -> None:
    assert client.get(path).status_code == 404


@pytest.mark.parametrize("frame", ["", "../5", "/etc/passwd", "no"])
def test_frames_that_the_run_has_not(client, frame: str) -> None:
    assert client.get("/picture", params={"frame": frame}).status_code == 404


def test_other_names_of_this_machine_are_refused(client) -> None:
    assert client.get("/", headers={"host": "elsewhere.example"}).status_code == 400


def test_a_port_in_use_is_said_before_anything_is_read(refused_by) -> None:
    with socket.socket() as taken:
        taken.bind((HOST, 0))
        taken.listen()
        port = taken.getsockname()[1]
        with pytest.raises(ConfigError, match="cannot be used"):
            listen(port)
        said = refused_by("serve", "nowhere", "--port", port)
    assert said == f"error: port {port} of {HOST} cannot be used (Address already in use); pass another --port"


def test_any_free_port_is_one_that_can_be_named() -> None:
    with listen(0) as first, listen(0) as second:
        ports = {one.getsockname()[1] for one in (first, second)}
    assert len(ports) == 2
    assert 0 not in ports
