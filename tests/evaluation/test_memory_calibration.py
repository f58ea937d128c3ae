import json
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from lcf3d import read_run
from lcf3d.cli.app import app
from lcf3d.errors import DatasetError
from lcf3d.evaluation.calibration_study import open_study
from lcf3d.evaluation.memory_calibration import MemoryStudy
from lcf3d.formats.kitti import objects_from_detections_2d, write_objects
from lcf3d.fusion.calibration import Calibration
from lcf3d.fusion.memory_config import MemoryConfig
from lcf3d.geometry.camera import project_boxes
from lcf3d.run.setup import RunRequest
from lcf3d.structures import KITTI_CLASSES, Detections2D, Detections3D
from tests.evaluation.drive import CALIBRATION, CAR, VIEW, _objects

DRIVES, FRAMES = 4, 25


def write_drives(root: Path) -> tuple[Path, Path]:
    """Three cars that stand throughout each drive, found four times out of five, and a ghost elsewhere in each frame.

    Car and ghost have scores that overlap; the camera sees what is there in half of the frames.
    """
    rng = np.random.default_rng(0)
    for folder in ("calib", "label_2"):
        (root / "training" / folder).mkdir(parents=True)
    names = [f"{s:04d}_{i:06d}" for s in range(DRIVES) for i in range(FRAMES)]
    (root / "ImageSets").mkdir()
    (root / "ImageSets" / "val.txt").write_text("\n".join(names))
    boxes = np.array([[x, y, -0.9, 4.0, 1.7, 1.5, 0.0] for x, y in ((14, -4), (20, 0), (26, 4))])
    for name in names:
        (root / "training" / "calib" / f"{name}.txt").write_text(CALIBRATION)
        labels = np.full(3, CAR)
        truth = Detections3D(boxes, np.ones(3), labels, KITTI_CLASSES)
        write_objects(root / "training" / "label_2" / f"{name}.txt", _objects(truth, scores=False))
        there = rng.random(3) < 0.8
        ghost = np.array([[rng.uniform(15, 30), rng.choice([-8.0, 8.0]), -0.9, 4.0, 1.7, 1.5, 0.0]])
        found = Detections3D(
            np.concatenate([boxes[there], ghost]),
            np.concatenate([rng.normal(0.5, 1, there.sum()), rng.normal(0, 1, 1)]),
            np.full(there.sum() + 1, CAR),
            KITTI_CLASSES,
        )
        write_objects(root / "lidar" / f"{name}.txt", _objects(found, scores=True))
        seen = project_boxes(np.concatenate([boxes, ghost]), VIEW)[0][rng.random(4) < 0.5]
        camera = Detections2D(seen, np.full(len(seen), 0.9), np.full(len(seen), CAR), KITTI_CLASSES)
        write_objects(root / "camera" / f"{name}.txt", objects_from_detections_2d(camera))
    return root / "lidar", root / "camera"


@pytest.fixture(scope="module")
def drives(tmp_path_factory: pytest.TempPathFactory) -> tuple[str, str, str]:
    root = tmp_path_factory.mktemp("drives")
    lidar, camera = write_drives(root)
    return f"kitti:{root}", f"results:{lidar}", f"results:{camera}"


def lcf3d(*arguments: object) -> str:
    result = CliRunner().invoke(app, [str(a) for a in arguments])
    if result.exception is not None and not isinstance(result.exception, SystemExit):
        raise result.exception
    return result.output


def test_memory_is_fitted_and_brings_what_it_brings_on_other_drives(drives: tuple[str, str, str]) -> None:
    dataset, lidar, camera = drives
    study = open_study(RunRequest(dataset, lidar, {"*": camera}, "val"), folds=4)
    calibration = study.fit()
    fitted = MemoryStudy(study).fit(calibration)
    assert set(fitted.memory) == {"Car"}
    assert fitted.memory["Car"].seen_weight > 0.02
    assert fitted.memory["Car"] != MemoryConfig().of("Car")
    assert fitted.model_copy(update={"memory": {}}) == calibration
    (car,) = MemoryStudy(study).cross_validate(fitted)
    # ghosts never come back to their place, and every fifth car is found by the memory alone
    assert car.fitted[1] > car.alone[1] + 5
    assert car.fitted[1] > car.default[1] - 1


def test_from_calibrate_to_run(drives: tuple[str, str, str], tmp_path: Path) -> None:
    dataset, lidar, camera = drives
    branches = ("--lidar", lidar, "--camera", camera)
    file = tmp_path / "c.json"
    text = lcf3d("calibrate", dataset, *branches, "--memory", "--folds", 2, "--out", file)
    assert "memory, cross-validated, 2 folds" in text
    fitted = Calibration.load(file).memory["Car"]
    values = json.loads(lcf3d("calibrate", dataset, *branches, "--memory", "--folds", 2, "--out", file, "--json"))
    assert [row["class_name"] for row in values["memory"]] == ["Car"]
    runs = {}
    for name, weights in (("fitted", fitted), ("defaults", None)):
        calibration = Calibration.load(file).model_copy(update={"memory": {"Car": weights} if weights else {}})
        calibration.dump(tmp_path / f"{name}.json")
        lcf3d("run", dataset, "--split", "val", *branches, "--recovery", "off", "--memory", "--calibration",
              tmp_path / f"{name}.json", "--out", tmp_path / name)  # fmt: skip
        runs[name] = read_run(tmp_path / name)
    alone = tmp_path / "alone"
    lcf3d("run", dataset, "--split", "val", *branches, "--recovery", "off", "--calibration", file, "--out", alone)
    # a box that is there for the second time: its log-odds rise by weight * (support - reference)
    second = {name: runs[name]["0000_000001"].tracks for name in runs}
    past = {name: tracks.log_odds[(tracks.hits == 2) & ~tracks.predicted] for name, tracks in second.items()}
    ratio = fitted.seen_weight / MemoryConfig().of("Car").seen_weight
    np.testing.assert_allclose(np.sort(past["fitted"]), np.sort(past["defaults"] * ratio), atol=1e-4)
    assert len(past["fitted"])


def test_one_drive_cannot_be_cross_validated(drives: tuple[str, str, str]) -> None:
    dataset, lidar, camera = drives
    frames = tuple(f"0000_{i:06d}" for i in range(FRAMES))
    study = open_study(RunRequest(dataset, lidar, {"*": camera}, frames=frames), folds=2)
    calibration = MemoryStudy(study).fit(study.fit())
    with pytest.raises(DatasetError, match="more than one part"):
        MemoryStudy(study).cross_validate(calibration)


def test_frames_without_order_are_refused(drives: tuple[str, str, str], tmp_path: Path) -> None:
    from tests.evaluation.drive import write_drive

    lidar, camera = write_drive(tmp_path, 12)
    with pytest.raises(DatasetError, match="no past to remember"):
        lcf3d("calibrate", f"kitti:{tmp_path}", "--lidar", f"results:{lidar}", "--camera", f"results:{camera}",
              "--memory", "--out", tmp_path / "c.json")  # fmt: skip
    assert not (tmp_path / "c.json").exists()


def test_jobs_and_the_order_of_frames_change_nothing(drives: tuple[str, str, str], tmp_path: Path) -> None:
    dataset, lidar, camera = drives
    names = [f"{s:04d}_{i:06d}" for s in range(2) for i in range(10)]
    mixed = [*names[::2], *names[1::2]][::-1]
    branches = ("--lidar", lidar, "--camera", camera, "--recovery", "off", "--calibration")
    file = tmp_path / "c.json"
    lcf3d("calibrate", dataset, *branches[:4], "--folds", 0, "--out", file)
    for out, frames, more in (("one", names, ()), ("two", names, ("--jobs", 2)), ("mixed", mixed, ("--jobs", 2))):
        chosen = [part for name in frames for part in ("--frame", name)]
        lcf3d("run", dataset, *chosen, *branches, file, "--memory", *more, "--out", tmp_path / out)
    for part in ("provenance", "tracks", "data"):
        one = {p.name: p.read_bytes() for p in (tmp_path / "one" / part).iterdir()}
        assert one
        for other in ("two", "mixed"):
            assert {p.name: p.read_bytes() for p in (tmp_path / other / part).iterdir()} == one
    assert any(found.tracks.predicted.any() for found in read_run(tmp_path / "one").values())


def test_a_gap_in_a_drive_is_told(drives: tuple[str, str, str], tmp_path: Path) -> None:
    dataset, lidar, camera = drives
    frames = [part for i in (0, 1, 2, 20, 21) for part in ("--frame", f"0000_{i:06d}")]
    text = lcf3d("run", dataset, *frames, "--lidar", lidar, "--camera", camera, "--recovery", "off", "--memory",
                 "--json", "--out", tmp_path / "out")  # fmt: skip
    assert '"no frame for 1.80 s: the memory began anew": 1' in text


def test_the_report_and_pictures_of_a_run_with_predicted_boxes(drives: tuple[str, str, str], tmp_path: Path) -> None:
    dataset, lidar, camera = drives
    out = tmp_path / "out"
    branches = ("--lidar", lidar, "--camera", camera, "--recovery", "off")
    lcf3d("run", dataset, "--split", "val", *branches, "--memory", "--out", out)
    shown = next(name for name, found in read_run(out).items() if "predicted" in found.origins)
    lcf3d("view", out, "--frame", shown, "--out", tmp_path / "one.png")
    assert (tmp_path / "one.png").is_file()
    lcf3d("eval", dataset, out, "--split", "val", "--out", tmp_path / "report")
    assert '"predicted"' in (tmp_path / "report" / "report.html").read_text()
