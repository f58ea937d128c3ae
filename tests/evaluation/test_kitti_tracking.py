"""Tracks on KITTI's labels: what counts, what is excused, files that lie about."""

import json

import numpy as np
import pytest
from typer.testing import CliRunner

import lcf3d
from lcf3d.cli.app import app
from lcf3d.cli.console import strict
from lcf3d.datasets.opening import open_dataset
from lcf3d.errors import ConfigError, DatasetError, FormatError
from lcf3d.evaluation.opening import open_tracking
from lcf3d.evaluation.protocol import EvaluationOptions
from lcf3d.formats.kitti_tracking import read_tracks
from tests.datasets.kitti_drives import make_tracking


def line(frame, track, name="Car", x=0.0, occluded=0, truncated=0, score=None, box="100 100 200 200"):
    text = f"{frame} {track} {name} {truncated} {occluded} -1.5 {box} 1.5 1.6 4.0 {x} 1.6 20.0 0.0"
    return text + ("" if score is None else f" {score}") + "\n"


def measure(root, frame_ids=None, missing="error", out="out"):
    return open_tracking(open_dataset(f"kitti:{root}"), frame_ids).read(root / out, missing)


def box(score=0.9, **more):
    return [line(t, 9, score=score, **more) for t in range(5)]


@pytest.fixture
def world(tmp_path):
    labels, results = tmp_path / "training" / "label_02", tmp_path / "out" / "tracks"
    labels.mkdir(parents=True), results.mkdir(parents=True)

    def write(truth, found):
        (labels / "0000.txt").write_text("".join(truth))
        (results / "0000.txt").write_text("".join(found))
        return measure(tmp_path).metrics["Car"]

    write.root, write.out = tmp_path, tmp_path / "out"
    return write


def test_labels_as_tracks_are_perfect(world):
    metrics = world([line(t, 4) for t in range(5)], [line(t, 9, score=0.9) for t in range(5)])
    assert metrics.averaged.best.mota == pytest.approx(100)
    assert metrics.hota.hota == pytest.approx(100)
    assert metrics.clear.objects == 5


def test_what_does_not_count(world):
    truth = [line(t, 4) for t in range(5)]
    truth += [line(t, 5, "Van", x=10) for t in range(5)]
    truth += [line(t, 6, x=-10, occluded=3) for t in range(5)]
    truth += [line(t, 7, x=-20, truncated=1) for t in range(5)]
    truth += [line(t, -1, "DontCare", x=-1000, box="300 100 400 200") for t in range(5)]
    found = [line(t, 9, score=0.9) for t in range(5)]
    found += [line(t, 10 + i, x=x, score=0.9) for t in range(5) for i, x in enumerate((10, -10, -20))]
    found += [line(t, 20, x=30, score=0.9, box="310 110 390 190") for t in range(5)]
    found += [line(t, 21, x=40, score=0.9, box="500 100 510 110") for t in range(5)]
    metrics = world(truth, found)
    assert (metrics.clear.objects, metrics.clear.hits, metrics.clear.false_alarms) == (5, 5, 0)
    # and a plain false alarm is one
    metrics = world(truth, [*found, line(0, 30, x=30, score=0.95)])
    assert metrics.averaged.best.false_alarms == 1


def test_overlap_below_a_quarter_is_none(world):
    # cars of 4 m, 2.6 m apart: IoU 1.4 / 6.6
    metrics = world([line(0, 4)], [line(0, 9, x=2.6, score=0.9)])
    assert metrics.averaged.samota == 0


def test_command(world):
    world([line(t, 4) for t in range(5)], [line(t, 9, score=0.9) for t in range(5)])
    run = CliRunner().invoke(app, ["eval", f"kitti:{world.root}", str(world.out), "--tracking", "--json"])
    assert run.exit_code == 0, run.output
    assert json.loads(run.output)["Car"]["MOTA"] == pytest.approx(100)
    measured = lcf3d.evaluate_tracking(f"kitti:{world.root}", world.out)
    # no cyclist is there to be followed: what is not a number in Python is null in JSON, which has none
    assert np.isnan(measured.to_json()["Cyclist"]["MOTA"])
    assert strict(measured.to_json()) == json.loads(run.output, parse_constant=pytest.fail)
    few = lcf3d.evaluate_tracking(f"kitti:{world.root}", world.out, frames=["0000_000001"], classes=("Car",))
    assert "counted: 1 of the 5 frames" in few.table().notes[1]
    run = CliRunner().invoke(app, ["eval", f"kitti:{world.root / 'none'}", str(world.out), "--tracking"])
    assert isinstance(run.exception, DatasetError)


def test_bad_files(world, tmp_path):
    bad = tmp_path / "bad.txt"
    for text, message in (
        ("0 1 Car 0 0\n", "18 columns"),
        (line(0, 1, score="x"), "must be numbers"),
        (line(0.5, 1, score=1), "whole numbers"),
        (line(0, 1, score=1) * 2, "holds track 1 twice"),
    ):
        bad.write_text(text)
        with pytest.raises(FormatError, match=message):
            read_tracks(bad, results=True)


def test_only_the_frames_of_the_run_count(world):
    truth = [line(t, 4) for t in range(10)]
    world(truth, box())
    part = measure(world.root, [f"0000_{t:06d}" for t in range(5)])
    assert part.metrics["Car"].averaged.best.mota == pytest.approx(100)
    assert "counted: 5 of the 10 frames of 1 sequence: those" in part.table().notes[1]
    assert part.to_json()["frames"] == {"0000": 5}
    whole = measure(world.root)
    assert whole.metrics["Car"].averaged.best.mota == pytest.approx(50)
    assert "all 10 frames" in whole.table().notes[1]
    # what the results hold besides is left out
    world(truth, [*box(), *(line(t, 30, x=30, score=0.9) for t in range(5, 10))])
    part = measure(world.root, [f"0000_{t:06d}" for t in range(5)])
    assert part.metrics["Car"].averaged.best.false_alarms == 0


def test_the_layout_of_the_tracking_benchmark(tmp_path):
    root, out = make_tracking(tmp_path / "tracking"), tmp_path / "out"
    out.mkdir()
    for path in (root / "training/label_02").glob("*.txt"):
        lines = [text for text in path.read_text().splitlines() if text.split()[1] != "-1"]
        (out / path.name).write_text("".join(f"{text} 0.9\n" for text in lines))
    measured = open_tracking(open_dataset(f"kitti-tracking:{root}")).read(out)
    best = measured.metrics["Car"].averaged.best
    assert best.false_alarms == best.switches == 0
    assert set(measured.counted) == {"0000", "0001"}
    assert "of 2 sequences" in measured.table().notes[1]


def test_a_sequence_without_results(world):
    world([line(t, 4) for t in range(5)], box())
    labels = world.root / "training/label_02/0001.txt"
    labels.write_text("".join(line(t, 4) for t in range(5)))
    both = [f"{name}_{t:06d}" for name in ("0000", "0001") for t in range(5)]
    with pytest.raises(DatasetError, match=r"lacks the tracks of 1 of 2 sequences, the first is 0001; --missing empty"):
        measure(world.root, both)
    assert measure(world.root, both, "empty").metrics["Car"].averaged.best.mota == pytest.approx(50)


def test_results_of_other_scenes_and_without_numbers(world):
    truth = [line(t, 4) for t in range(5)]
    with pytest.raises(DatasetError, match="holds 1 frames that sequence 0000 does not have, the first is 7"):
        world(truth, [*box(), line(7, 9, score=0.9)])
    with pytest.raises(FormatError, match="2 boxes without a track number"):
        world(truth, [line(0, -1, score=0.9), line(1, -1, score=0.9)])
    with pytest.raises(FormatError, match="gives its objects no track numbers"):
        world([line(t, -1) for t in range(5)], box())
    (world.out / "tracks/0000.txt").rename(world.out / "tracks/0042.txt")
    with pytest.raises(DatasetError, match=r"1 of 1 sequences have no labels .* the first is 0042"):
        measure(world.root)
    (world.out / "tracks/0042.txt").unlink()
    with pytest.raises(DatasetError, match="holds no tracking results"):
        measure(world.root)
    with pytest.raises(DatasetError, match="is not a folder"):
        measure(world.root, out="nowhere")


def test_unknown_classes_options_and_ids(world):
    world([line(t, 4) for t in range(5)], box())
    data = open_dataset(f"kitti:{world.root}")
    with pytest.raises(ConfigError, match="does not know class 'Tram'"):
        open_tracking(data, None, EvaluationOptions(classes=("Tram",)))
    with pytest.raises(ConfigError, match="--iou does not go with --tracking"):
        open_tracking(data, None, EvaluationOptions(iou=("Car=0.5",)))
    with pytest.raises(DatasetError, match="frame 000001 is of no sequence"):
        open_tracking(data, ["000001"])


def test_a_dataset_without_track_numbers(world, tmp_path):
    (tmp_path / "plain/training/calib").mkdir(parents=True)
    with pytest.raises(DatasetError, match="has none"):
        open_tracking(open_dataset(f"kitti:{tmp_path / 'plain'}"))
    with pytest.raises(DatasetError, match="object offers none"):
        open_tracking(object())
