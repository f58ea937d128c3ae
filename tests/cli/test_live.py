import json
from collections import Counter
from importlib.metadata import EntryPoint

import numpy as np
import PIL.Image
import pytest
from typer.testing import CliRunner

from lcf3d import plugins
from lcf3d.cli.app import app
from lcf3d.errors import ConfigError, DatasetError
from lcf3d.frame import Frame
from lcf3d.fusion.alignment import realigned
from lcf3d.fusion.calibration import Calibration
from lcf3d.fusion.memory_config import ClassMemory
from lcf3d.live.replay import frame_times, in_order
from lcf3d.run.folder import RunFolder
from tests.datasets.toy import write_toy


@pytest.fixture
def toy(tmp_path, monkeypatch):
    """Twelve frames with results of two detectors, and the arguments that name them."""
    known = plugins._points
    point = EntryPoint("toy", "tests.datasets.toy:ToyDataset", "lcf3d.datasets")
    monkeypatch.setattr(plugins, "_points", lambda g: {**known(g), **({"toy": point} if g == point.group else {})})
    write_toy(tmp_path, 12)
    branches = ["--lidar", f"results:{tmp_path / 'lidar'}", "--camera", f"results:{tmp_path / 'camera'}"]
    return [f"toy:{tmp_path / 'data'}", *branches]


def lcf3d(*arguments):
    result = CliRunner().invoke(app, [str(a) for a in arguments], catch_exceptions=False)
    assert result.exit_code == 0, result.output
    return result.output


def test_a_replay_reports_latency_health_and_nothing_dropped(toy, tmp_path):
    report = json.loads(lcf3d("live", *toy, "--rate", "0", "--recovery", "off", "--json"))
    assert (report["frames"], report["results"], report["dropped"]) == (12, 12, {})
    assert report["latency_ms"]["added"]["p99"] > 0
    assert [status["hardware_id"] for status in report["diagnostics"]] == ["fusion", "lidar", "camera front"]


def test_real_time_takes_its_time_and_health_is_written(toy, tmp_path):
    told = lcf3d(
        "live", *toy, "--rate", "4", "--hertz", "10", "--health", tmp_path / "health.jsonl", "--recovery", "off"
    )
    assert "12 results" in told
    assert "camera front: ok" in told
    (line,) = (tmp_path / "health.jsonl").read_text().splitlines()
    assert json.loads(line)["status"][0]["hardware_id"] == "fusion"


def test_the_stream_gives_what_the_run_gives(toy, tmp_path, monkeypatch):
    from lcf3d.live import replay

    came = {}
    inner = replay.make_fuser

    def spy(*arguments, **options):
        options["on_result"] = lambda result: came.update({result.frame.id: result.fused})
        return inner(*arguments, **options)

    monkeypatch.setattr(replay, "make_fuser", spy)
    lcf3d("live", *toy, "--rate", "0", "--recovery", "on")
    lcf3d("run", *toy, "--out", tmp_path / "fused", "--recovery", "on")
    folder = RunFolder(tmp_path / "fused")
    assert len(came) == 12
    for fused, frame_id in zip(came.values(), folder.frame_ids(), strict=True):
        written = folder.read(frame_id)
        np.testing.assert_allclose(fused.detections.boxes, written.detections.boxes, atol=1e-5)
        np.testing.assert_allclose(fused.detections.scores, written.detections.scores, atol=1e-6)


@pytest.fixture
def bag(tmp_path, monkeypatch):
    """A bag of six frames of a vehicle that drives, with objects of both branches, and the arguments that name them."""
    pytest.importorskip("rosbags")
    from tests.datasets.test_bag import installed, write_drive_with_objects

    installed.__wrapped__(monkeypatch)
    write_drive_with_objects(tmp_path / "drive.mcap", 6, speed=5.0)
    branches = ["--lidar", "topic:/lidar/objects", "--camera", "topic:/front/objects,/left/objects"]
    return [f"bag:{tmp_path / 'drive.mcap'}", *branches]


def results_of(monkeypatch, *arguments):
    """The fused detections of a ``live`` command, in order."""
    from lcf3d.live import replay

    came, inner = [], replay.make_fuser

    def spy(*given, **options):
        options["on_result"] = lambda result: came.append(result.fused)
        return inner(*given, **options)

    with monkeypatch.context() as patched:
        patched.setattr(replay, "make_fuser", spy)
        lcf3d("live", *arguments)
    return came


@pytest.mark.parametrize("memory", [(), ("--memory",)])
def test_a_bag_through_the_stream_gives_what_the_run_gives(bag, tmp_path, monkeypatch, memory):
    came = results_of(monkeypatch, *bag, "--rate", "0", *memory)
    lcf3d("run", *bag, "--out", tmp_path / "fused", *memory)
    folder = RunFolder(tmp_path / "fused")
    assert len(came) == len(folder.frame_ids()) == 6
    for fused, frame_id in zip(came, folder.frame_ids(), strict=True):
        written = folder.read(frame_id)
        assert len(fused) == len(written) > 3
        np.testing.assert_allclose(fused.detections.boxes, written.detections.boxes, atol=1e-5)
        np.testing.assert_allclose(fused.detections.scores, written.detections.scores, atol=1e-6)
        assert (fused.tracks is None) == (not memory)
        if memory:
            np.testing.assert_array_equal(fused.tracks.ids, written.tracks.ids)
            np.testing.assert_array_equal(fused.tracks.hits, written.tracks.hits)
    if memory:
        assert came[-1].tracks.hits.max() == 6


def test_a_memory_has_the_weights_of_the_calibration_in_files_and_in_the_stream(bag, tmp_path, monkeypatch):
    fitted = Calibration(memory={name: ClassMemory(seen_weight=1.5, missed_weight=1.0) for name in ("car", "Car")})
    fitted.dump(tmp_path / "calibration.json")
    memory = ("--memory", "--calibration", tmp_path / "calibration.json")
    came = results_of(monkeypatch, *bag, "--rate", "0", *memory)
    plain = results_of(monkeypatch, *bag, "--rate", "0", "--memory", "--calibration", "none")
    lcf3d("run", *bag, "--out", tmp_path / "fused", *memory)
    folder = RunFolder(tmp_path / "fused")
    assert len(came) == 6
    for fused, frame_id in zip(came, folder.frame_ids(), strict=True):
        written = folder.read(frame_id)
        np.testing.assert_allclose(fused.detections.boxes, written.detections.boxes, atol=1e-5)
        np.testing.assert_allclose(fused.detections.scores, written.detections.scores, atol=1e-6)
    # the weights are really used
    assert np.abs(came[-1].detections.scores - plain[-1].detections.scores).max() > 1e-3


def test_a_memory_wants_each_drive_in_one_piece(toy):
    from tests.datasets.toy import ToyDataset

    class Two(ToyDataset):
        def frame(self, frame_id):
            number = int(frame_id[1:])
            return Frame(frame_id, sequence=str(number % 2), timestamp=-0.1 * number)

    assert in_order(Two(toy[0].partition(":")[2]), ("f00", "f01", "f02", "f03")) == ("f02", "f00", "f03", "f01")
    assert in_order(ToyDataset(toy[0].partition(":")[2]), ("f01", "f00")) == ("f01", "f00")


def test_a_bag_is_replayed_in_real_time_with_pictures(bag, tmp_path):
    report = json.loads(lcf3d("live", *bag, "--rate", "1.0", "--pictures", tmp_path / "seen", "--json"))
    assert (report["frames"], report["results"], report["dropped"]) == (6, 6, {})
    # five steps of 0.1 s, and the deadline of the last
    assert report["seconds"] > 0.5
    pictures = sorted((tmp_path / "seen").glob("*.png"))
    (made,) = report["outputs"]
    left_out = int(made.split(", ")[1].split()[0]) if "," in made else 0
    assert len(pictures) + left_out == 6
    assert pictures[-1].name == "000000.500.png"
    with PIL.Image.open(pictures[-1]) as picture:
        assert picture.width == 2 * 840


def test_every_frame_has_its_picture_where_time_does_not_matter(toy, tmp_path):
    told = lcf3d("live", *toy, "--rate", "0", "--recovery", "off", "--pictures", tmp_path / "seen")
    assert "pictures: 12 frames" in told
    assert len(list((tmp_path / "seen").glob("*.png"))) == 12


def test_check_says_how_the_camera_stands(toy):
    told = CliRunner().invoke(app, ["check", *toy]).output
    assert "camera front: ok; pitch" in told
    with pytest.raises(ConfigError, match="takes both"):
        CliRunner().invoke(app, ["check", *toy[:3]], catch_exceptions=False)


def test_a_run_may_turn_its_cameras(toy, tmp_path):
    lcf3d("run", *toy, "--out", tmp_path / "fused", "--recovery", "off", "--self-calibrate")
    alignment = json.loads((tmp_path / "fused" / "alignment.json").read_text())["front"]
    assert alignment["status"] == "ok"
    assert abs(alignment["yaw"]["deg"]) < 0.2


def test_a_recording_is_written(toy, tmp_path):
    pytest.importorskip("rerun")
    lcf3d("live", *toy, "--rate", "0", "--recovery", "off", "--rerun", tmp_path / "live.rrd")
    lcf3d("run", *toy, "--out", tmp_path / "fused", "--recovery", "off")
    lcf3d("view", tmp_path / "fused", "--rerun", tmp_path / "run.rrd")
    assert (tmp_path / "live.rrd").stat().st_size > 1000
    assert (tmp_path / "run.rrd").stat().st_size > 1000
    with pytest.raises(ConfigError, match=r"\.rrd"):
        CliRunner().invoke(app, ["live", *toy, "--rerun", "x.png"], catch_exceptions=False)
    with pytest.raises(ConfigError, match=r"\.rrd"):
        CliRunner().invoke(app, ["view", str(tmp_path / "fused"), "--rerun", "x.png"], catch_exceptions=False)


def test_times_of_a_replay_always_rise():
    assert frame_times([None, None, None], 10.0) == pytest.approx([0.0, 0.1, 0.2])
    # half a second, then another drive that begins earlier, then a gap of an hour
    assert frame_times([5.0, 5.5, 0.0, 3600.0], 10.0) == pytest.approx([0.0, 0.5, 1.7, 2.9])


def test_a_run_says_loudly_that_a_camera_is_turned_and_how_to_mend_it(toy, tmp_path, monkeypatch, caplog):
    from lcf3d import run
    from tests.datasets import toy as module

    straight, front = module.FRONT, realigned(module.FRONT, np.deg2rad([0, 1.0, 0]))
    monkeypatch.setattr(module, "FRONT", front)
    (warning,) = run(toy[0], toy[2], toy[4], tmp_path / "python", recovery="off")["warnings"]
    assert "camera front looks turned" in warning
    assert "yaw -1.0" in warning
    assert "--self-calibrate" in warning
    assert warning in caplog.text
    command = ["run", *toy, "--recovery", "off", "--json"]
    assert json.loads(lcf3d(*command, "--out", tmp_path / "turned"))["warnings"] == [warning]
    # the same for tables of results
    tables = json.loads(lcf3d(*command, "--out", tmp_path / "tables", "--format", "parquet"))
    assert tables["warnings"] == [warning]
    assert "looks turned" not in lcf3d(*command[:-1], "--out", tmp_path / "mended", "--self-calibrate")
    assert f"warning: {warning}" in lcf3d(*command[:-1], "--out", tmp_path / "told")
    monkeypatch.setattr(module, "FRONT", straight)
    assert json.loads(lcf3d(*command, "--out", tmp_path / "straight"))["warnings"] == []


def test_a_frame_that_cannot_be_read_is_told_and_the_stream_goes_on(toy, monkeypatch):
    from tests.datasets.toy import ToyDataset

    inner, reads = ToyDataset.frame, Counter()

    def frame(self, frame_id):
        # whole while classes are looked at beforehand
        reads[id(self), frame_id] += 1
        if frame_id == "f03" and reads[id(self), frame_id] > 1:
            raise DatasetError("frame f03 is damaged")
        return inner(self, frame_id)

    options = ["--rate", "0", "--recovery", "off", "--calibration", "none", "--json"]
    monkeypatch.setattr(ToyDataset, "frame", frame)
    report = json.loads(lcf3d("live", *toy, *options))
    assert (report["frames"], report["results"]) == (11, 11)
    assert report["unreadable"] == ["frame f03 is damaged"]
    assert "1 frames could not be read in full, first: frame f03" in lcf3d("live", *toy, *options[:-1])


def test_a_replay_that_is_interrupted_tells_what_came_so_far(toy, tmp_path, monkeypatch):
    from tests.datasets.toy import ToyDataset

    inner, reads = ToyDataset.frame, Counter()

    def frame(self, frame_id):
        reads[id(self), frame_id] += 1
        if frame_id == "f05" and reads[id(self), frame_id] > 1:
            raise KeyboardInterrupt
        return inner(self, frame_id)

    monkeypatch.setattr(ToyDataset, "frame", frame)
    health = tmp_path / "health.jsonl"
    options = ["--rate", "0", "--recovery", "off", "--calibration", "none", "--health", health, "--hertz", "2"]
    told = lcf3d("live", *toy, *options)
    assert "5 results" in told
    assert "then interrupted" in told
    assert len(health.read_text().splitlines()) == 2


@pytest.mark.parametrize("option", ["--pictures", "--health", "--rerun"])
def test_a_place_that_cannot_be_written_to_is_told_before_the_stream(toy, tmp_path, option):
    (tmp_path / "file").touch()
    place = tmp_path / "file" / "deep.rrd"
    with pytest.raises(OSError, match="file"):
        CliRunner().invoke(app, ["live", *toy, "--rate", "4", option, str(place)], catch_exceptions=False)
