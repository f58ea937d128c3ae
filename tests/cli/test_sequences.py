"""Argoverse 2 and KITTI's drives through the verbs of the command line."""

import json
import socket
from pathlib import Path

import pytest
from typer.testing import CliRunner, Result

from lcf3d import read_run
from lcf3d.cli.app import app
from lcf3d.errors import FormatError, Lcf3dError
from lcf3d.formats.coco import write_camera_detections
from lcf3d.formats.feather import write_columns
from lcf3d.structures import ARGOVERSE_CLASSES, Detections2D
from tests.datasets.argoverse_log import CUBOID, LOG, cuboid, rows, sweep_time, write_log, write_submission_rows
from tests.datasets.kitti_drives import RAW, make_raw, make_tracking
from tests.datasets.kitti_folder import make_results

pytest.importorskip("pyarrow", reason="needs pyarrow (extra formats)")


def lcf3d(*arguments: object) -> Result:
    result = CliRunner().invoke(app, [str(a) for a in arguments])
    if result.exception is not None and not isinstance(result.exception, SystemExit):
        raise result.exception
    return result


@pytest.fixture
def argoverse(tmp_path: Path) -> Path:
    """A log with LiDAR detections of the car at every moment and a camera detection of it at the first."""
    write_log(tmp_path / "av2")
    cars = [cuboid(sweep_time(i), "REGULAR_VEHICLE", (21.0 - i, 0.2, 1.5)) for i in range(3)]
    write_submission_rows(tmp_path / "lidar.feather", cars, [0.6] * 3)
    seen = Detections2D([[44, 36, 56, 44]], [0.9], [ARGOVERSE_CLASSES.index("REGULAR_VEHICLE")], ARGOVERSE_CLASSES)
    write_camera_detections(tmp_path / "camera.json", {(f"{LOG}_{sweep_time(0)}", "ring_front_center"): seen})
    return tmp_path


def run_argoverse(root: Path) -> dict[str, object]:
    branches = "--lidar", f"results:{root / 'lidar.feather'}", "--camera", f"results:{root / 'camera.json'}"
    found: dict[str, object] = json.loads(
        lcf3d("run", f"argoverse2:{root / 'av2'}", *branches, "--out", root / "out", "--json").stdout
    )
    return found


def test_argoverse2_from_run_to_eval(argoverse: Path) -> None:
    counts = run_argoverse(argoverse)
    assert counts["frames"] == 3
    assert counts["outputs"] == {"kept": {"REGULAR_VEHICLE": 2}, "matched": {"REGULAR_VEHICLE": 1}}
    metrics = json.loads(lcf3d("eval", argoverse / "av2", argoverse / "out", "--json").stdout)["results"][0]["metrics"]
    assert metrics["REGULAR_VEHICLE"]["AP"] == 1
    assert metrics["REGULAR_VEHICLE"]["ATE"] == pytest.approx(0.2)
    table = lcf3d("eval", f"argoverse2:{argoverse / 'av2'}", argoverse / "lidar.feather").stdout
    assert "REGULAR_VEHICLE 100.0" in table
    lcf3d("view", argoverse / "out", "--limit", "1")
    assert len(list((argoverse / "out/pictures").glob("*.png"))) == 1


def test_argoverse2_check(argoverse: Path) -> None:
    result = lcf3d("check", f"argoverse2:{argoverse / 'av2'}", "--results", argoverse / "lidar.feather", "--json")
    assert result.exit_code == 0
    assert [finding["id"] for finding in json.loads(result.stdout)] == ["ARG02", "ARG04", "FRM06"]


def test_feather_without_a_column(argoverse: Path) -> None:
    columns = rows(CUBOID, [cuboid(sweep_time(0), "DOG", (1, 2, 3))])
    write_columns(argoverse / "lidar.feather", columns)
    with pytest.raises(FormatError, match=r"lidar\.feather has no column score, log_id; it holds"):
        run_argoverse(argoverse)


@pytest.mark.parametrize("kind", ["kitti-tracking", "kitti-raw"])
def test_kitti_drives_from_run_to_eval(tmp_path: Path, kind: str) -> None:
    if kind == "kitti-raw":
        make_raw(tmp_path / "data")
        ids = tuple(f"{RAW}_{i:010d}" for i in range(2))
    else:
        make_tracking(tmp_path / "data", ("0000",))
        ids = tuple(f"0000_{i:06d}" for i in range(3))
    lidar, camera = make_results(tmp_path, ids)
    branches = "--lidar", f"results:{lidar}", "--camera", f"results:{camera}"
    counts = json.loads(
        lcf3d("run", f"{kind}:{tmp_path / 'data'}", *branches, "--out", tmp_path / "out", "--json").stdout
    )
    assert counts["frames"] == len(ids)
    assert counts["outputs"]["matched"] == {"Car": len(ids)}
    assert sorted(p.stem for p in (tmp_path / "out/data").iterdir()) == list(ids)
    (results,) = json.loads(lcf3d("eval", f"{kind}:{tmp_path / 'data'}", tmp_path / "out", "--json").stdout)["results"]
    if kind == "kitti-tracking":
        # KITTI's protocol: two frames with two cars each, of which one is found, and a frame without labels
        assert results["metrics"]["Car"]["3d"]["easy"]["objects"] == 4
    else:
        # by centre distance: the tracklet of the first frame is found where it is
        assert results["metrics"]["label_aps"]["Car"]["0.5"] > 0
        assert results["metrics"]["label_tp_errors"]["Car"]["trans_err"] == pytest.approx(0, abs=1e-3)
    checked = lcf3d("check", f"{kind}:{tmp_path / 'data'}", "--results", tmp_path / "out", "--json")
    assert not [finding for finding in json.loads(checked.stdout) if finding["severity"] == "error"]


def test_a_sequence_that_is_not_there(tmp_path: Path) -> None:
    make_tracking(tmp_path)
    with pytest.raises(Lcf3dError, match="has no sequence '9' among its 2"):
        lcf3d("check", f"kitti-tracking:{tmp_path}?sequence=0009")


@pytest.mark.parametrize("option", ["--memory", "--smooth"])
def test_frames_of_a_drive_remember(argoverse: Path, option: str) -> None:
    branches = "--lidar", f"results:{argoverse / 'lidar.feather'}", "--camera", f"results:{argoverse / 'camera.json'}"
    run_argoverse(argoverse)
    alone = list(read_run(argoverse / "out").values())
    lcf3d("run", f"argoverse2:{argoverse / 'av2'}", *branches, option, "--out", argoverse / "remembering")
    remembered = list(read_run(argoverse / "remembering").values())
    assert all(found.tracks is None for found in alone)
    assert {int(i) for found in remembered for i in found.tracks.ids} == {0}
    # the camera saw the car in the first frame only: the last one profits from that
    assert remembered[-1].detections.scores[0] > alone[-1].detections.scores[0]


def test_serve_at_its_port(argoverse: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("starlette", reason="needs starlette (extra serve)")
    ports: list[int] = []

    def note_port(application: object, listening: socket.socket) -> None:
        ports.append(listening.getsockname()[1])
        listening.close()

    monkeypatch.setattr("lcf3d.evaluation.server.serve", note_port)
    run_argoverse(argoverse)
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = free.getsockname()[1]
    lcf3d("serve", argoverse / "out", "--port", port)
    assert ports == [port]
