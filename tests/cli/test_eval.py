import json
import sys
from pathlib import Path

import pytest

from lcf3d.cli.app import app, main
from lcf3d.formats.kitti import format_objects
from tests.evaluation.kitti_frames import frames

N = 45


def rows(**changes: object) -> list[list[dict[str, object]]]:
    return [[{"score": 1 - i / 100, "alpha": i / 50, **changes}] for i in range(N)]


def write_folder(folder: Path, made: list[list[dict[str, object]]], results: bool) -> None:
    folder.mkdir(parents=True)
    table = frames(made, results)
    for name, frame in zip(table.frame_ids, table, strict=True):
        (folder / f"{name}.txt").write_text(format_objects(frame))


@pytest.fixture
def root(tmp_path: Path) -> Path:
    """A KITTI tree with results ``good`` (all right) and ``half`` (every second detection elsewhere)."""
    write_folder(tmp_path / "training" / "label_2", rows(), results=False)
    (tmp_path / "ImageSets").mkdir()
    (tmp_path / "ImageSets" / "val.txt").write_text("\n".join(map(str, range(N))))
    (tmp_path / "ImageSets" / "few.txt").write_text("0\n1")
    write_folder(tmp_path / "good" / "data", rows(), results=True)
    half = rows()
    for frame in half[::2]:
        frame[0].update(box=(500, 0, 600, 50), location=(20, 1.5, 10))
    write_folder(tmp_path / "half", half, results=True)
    return tmp_path


def run(monkeypatch: pytest.MonkeyPatch, *arguments: object) -> int:
    """Exit code of ``lcf3d eval ARGUMENTS``."""
    monkeypatch.setattr(sys, "argv", ["lcf3d", "eval", *map(str, arguments)])
    with pytest.raises(SystemExit) as exit_:
        main()
    return int(exit_.value.code or 0)


def test_table(root: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(monkeypatch, f"kitti:{root}", root / "good") == 0
    out = capsys.readouterr().out
    assert f"KITTI, {N} frames" in out
    lines = {line.split()[-8]: line.split()[-6:] for line in out.splitlines() if line.count("100.00") == 6}
    assert set(lines) == {"2D", "AOS", "BEV", "3D"}
    assert "no detections of Pedestrian, Cyclist: not evaluated" in out


def test_json(root: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(monkeypatch, root, root / "good", "--json", "--class", "Car") == 0
    content = json.loads(capsys.readouterr().out)
    (one,) = content["results"]
    assert one["results"] == "good"
    assert one["frames"] == N
    assert one["metrics"]["Car"]["3d"]["moderate"]["AP_R40"] == 100
    assert one["closer_look"]["Car"]["ap_over_threshold"]["0.9"] == 100
    assert one["closer_look"]["Car"]["best_f1"]["true_positives"] == N


def test_iou_option(root: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    options = ("--json", "--iou", "Car=0.5", "--iou", "Car:3d=0.25")
    assert run(monkeypatch, root, root / "good", *options) == 0
    (one,) = json.loads(capsys.readouterr().out)["results"]
    assert one["metrics"]["min_overlap"]["Car"] == {"bbox": 0.5, "bev": 0.5, "3d": 0.25}


def test_out_writes_the_report_and_its_numbers(
    root: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(monkeypatch, root, root / "half", "--out", root / "report", "--worst", "3") == 0
    assert "report.html" in capsys.readouterr().out
    html = (root / "report" / "report.html").read_text()
    data = json.loads(html.partition('id="data">')[2].partition("</script>")[0])
    # the frames with most errors come first
    assert [(f["runs"][0]["wrong"], f["runs"][0]["missed"]) for f in data["frames"][:3]] == [(1, 1)] * 3
    assert "Command" in html
    content = json.loads((root / "report" / "metrics.json").read_text())
    assert content["results"][0]["closer_look"]["Car"]["best_f1"]["misses"] == 23


@pytest.mark.parametrize("flag_first", [True, False])
def test_compare(
    root: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], flag_first: bool
) -> None:
    pair = [root / "half", root / "good" / "data"]
    order = ["--compare", *pair] if flag_first else [pair[0], "--compare", pair[1]]
    assert run(monkeypatch, root, *order, "--samples", "30", "--json") == 0
    comparison = json.loads(capsys.readouterr().out)["comparison"]
    assert comparison["samples"] == 30
    row = next(r for r in comparison["rows"] if (r["measure"], r["difficulty"]) == ("3D", "moderate"))
    assert row["second"]["value"] == 100
    assert row["difference"]["value"] == 100 - row["first"]["value"]
    assert run(monkeypatch, root, *order, "--samples", "30") == 0
    assert "half" in capsys.readouterr().out


def test_split_of_a_run_is_taken_from_the_run(
    root: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (root / "good" / "run.json").write_text('{"split": "few"}')
    assert run(monkeypatch, root, root / "good") == 0
    captured = capsys.readouterr()
    assert "KITTI, 2 frames" in captured.out
    assert "objects, easy / moderate / hard: Car 2 / 2 / 2; with fewer than 41" in captured.out
    assert f"{N - 2} result files" in captured.out
    assert "first 10.txt" in captured.out
    assert run(monkeypatch, root, root / "good", "--split", "val") == 0
    assert f"KITTI, {N} frames" in capsys.readouterr().out


def test_missing_frames(root: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    for name in ("7", "9"):
        (root / "half" / f"{name}.txt").unlink()
    assert run(monkeypatch, root, root / "half") == 2
    assert f"lacks the files of 2 of {N} frames, first 7.txt" in capsys.readouterr().err
    assert run(monkeypatch, root, root / "half", "--missing", "empty") == 0


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["good", "--iou", "Car"], "--iou takes CLASS=VALUE"),
        (["good", "--iou", "Car=high"], "--iou takes CLASS=VALUE"),
        (["good", "--iou", "Bus=0.5"], "does not know class 'Bus'"),
        (["good", "--iou", "Car=2"], "must be in [0, 1), got 2"),
        (["good", "--class", "Tram"], "does not know class 'Tram'"),
        (["good", "--missing", "maybe"], "--missing takes error or empty, got 'maybe'"),
        (["good", "--split", "test"], "test.txt does not exist; the splits there are: few, val"),
        (["good", "--compare"], "--compare needs two results, got 1"),
        (["good", "half"], "got 2 results; give one, or two with --compare"),
        (["good", "--front"], "--front does not go with KITTI"),
        (["nowhere"], "nowhere is not a folder"),
        (["good", "--out", "ImageSets/val.txt"], "--out needs a folder, ImageSets/val.txt is a file"),
    ],
)
def test_mistakes_are_one_sentence_and_exit_code_2(
    root: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    arguments: list[str],
    message: str,
) -> None:
    monkeypatch.chdir(root)
    assert run(monkeypatch, f"kitti:{root}", *arguments) == 2
    error = capsys.readouterr().err
    assert message in error
    assert error.count("\n") == 1


def test_malformed_results(root: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    line = (root / "half" / "3.txt").read_text().split()
    for change, message in (
        (["nan"], "3.txt:1: column 16 is nan, expected a finite number"),
        ([], "3.txt:1: expected the 16 columns of a result (with a score), got 15"),
    ):
        (root / "half" / "3.txt").write_text(" ".join(line[:-1] + change))
        assert run(monkeypatch, root, root / "half") == 2
        assert message in capsys.readouterr().err
    (root / "half" / "3.txt").write_text(" ".join(["Tank", *line[1:]]))
    assert run(monkeypatch, root, root / "half") == 2
    assert "1 objects of class 'Tank' (first in frame 3)" in capsys.readouterr().err


@pytest.mark.real
def test_nds_hat_of_real_labels_with_noise(
    shared: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    kitti = shared / "data" / "kitti"
    results = kitti / "results" / "perturbed_labels"
    assert run(monkeypatch, kitti, results, "--split", "sensor_val", "--nds-hat", "--json") == 0
    content = json.loads(capsys.readouterr().out)
    content = content["results"][0]["metrics"]
    assert 0.3 < content["nds_hat"] < 1
    assert set(content["mean_dist_aps"]) == {"Car", "Pedestrian", "Cyclist"}
    assert run(monkeypatch, kitti, results, "--split", "sensor_val", "--nds-hat") == 0
    assert "NDS^" in capsys.readouterr().out


def test_help_names_both_datasets() -> None:
    from typer.testing import CliRunner

    text = CliRunner().invoke(app, ["eval", "--help"]).output
    assert "kitti:ROOT" in text
    assert "nuscenes:ROOT" in text
