"""``lcf3d run nuscenes:ROOT`` on a tiny folder of two samples and six cameras, made from nothing."""

import json
import sys
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from lcf3d.cli.app import app, main
from lcf3d.datasets.convert import write_nuscenes
from lcf3d.datasets.nuscenes import NuscenesDataset
from lcf3d.datasets.nuscenes_tables import CAMERAS
from lcf3d.formats.coco import encode_mask
from lcf3d.formats.nuscenes import read_submission
from lcf3d.frame import Frame
from lcf3d.geometry.camera import project_boxes
from lcf3d.reasons import Outcome
from lcf3d.run.folder import RunFolder
from lcf3d.structures import NUSCENES_CLASSES, Detections3D
from tests.fusion.scenes import camera, surface_points

DEMO = "ca9a282c9e77460f8360f564131a8af5"
CAR_LABEL, PEDESTRIAN_LABEL = NUSCENES_CLASSES.index("car"), NUSCENES_CLASSES.index("pedestrian")
# in front (seen by CAM_FRONT), behind (CAM_BACK), and a pedestrian to the left (CAM_FRONT_LEFT)
AHEAD = [12.0, 1.0, -0.9, 4.5, 1.9, 1.7, 0.3]
BEHIND = [-14.0, 1.0, -0.9, 4.5, 1.9, 1.7, 0.1]
WALKER = [5.0, 9.0, -0.9, 0.7, 0.7, 1.75, 0.0]
YAWS = {
    "CAM_FRONT": 0,
    "CAM_FRONT_LEFT": 60,
    "CAM_BACK_LEFT": 120,
    "CAM_BACK": 180,
    "CAM_BACK_RIGHT": -120,
    "CAM_FRONT_RIGHT": -60,
}


def ground(seed: int = 1) -> np.ndarray:
    rng = np.random.default_rng(seed)
    xy = rng.uniform(-30, 30, (6000, 2))
    return np.column_stack([xy, np.full(6000, -1.75), np.full(6000, 0.1)]).astype(np.float32)


def rig() -> list:
    focal = 500 / np.tan(np.radians(35))
    return [camera(name, np.radians(yaw), focal=focal) for name, yaw in YAWS.items()]


class World:
    """The folder, the results of both branches, and what they were made from."""

    def __init__(self, path: Path) -> None:
        self.path, self.root, self.out = path, path / "nuscenes", path / "out"
        boxes = np.array([AHEAD, BEHIND, WALKER])
        labels = np.array([CAR_LABEL, CAR_LABEL, PEDESTRIAN_LABEL])
        truth = Detections3D(boxes, np.ones(3), labels, NUSCENES_CLASSES)
        points = np.concatenate([surface_points(boxes), ground()])
        frames = [Frame(name, points, rig(), labels=truth) for name in ("a", "b")]
        self.tokens = {id: t for t, id in write_nuscenes(frames, self.root, {n: n for n in YAWS}).items()}
        self.lidar, self.camera = path / "lidar.json", path / "camera.json"
        # the LiDAR detector misses the pedestrian; it gives speed and attribute to the first car only
        found = Detections3D(
            boxes[:2],
            [0.7, 0.6],
            labels[:2],
            NUSCENES_CLASSES,
            [[3.0, 4.0], [np.nan, np.nan]],
            ["vehicle.moving", ""],
        )
        NuscenesDataset(self.root).write_results(self.lidar, dict.fromkeys(self.tokens.values(), found))
        self.records = [record for token in self.tokens.values() for record in self.detections(token, truth)]
        self.write_camera()

    def detections(self, token: str, truth: Detections3D) -> list[dict]:
        records = []
        for view in rig():
            rectangles, visible = project_boxes(truth.boxes, view)
            for i in np.flatnonzero(visible):
                x1, y1, x2, y2 = rectangles[i].tolist()
                records.append(
                    {
                        "sample_token": token,
                        "camera": view.name,
                        "bbox": [x1, y1, x2 - x1, y2 - y1],
                        "score": 0.8,
                        "category_name": NUSCENES_CLASSES[truth.labels[i]],
                    }
                )
        return records

    def write_camera(self) -> None:
        self.camera.write_text(json.dumps(self.records))

    def change(self, table: str, edit) -> None:
        """Let ``edit`` change the records of a table in place."""
        path = self.root / "v1.0-converted" / f"{table}.json"
        records = json.loads(path.read_text())
        edit(records)
        path.write_text(json.dumps(records))

    def arguments(self, *more) -> list[str]:
        return [
            *("run", f"nuscenes:{self.root}", "--lidar", f"results:{self.lidar}"),
            *("--camera", f"results:{self.camera}", "--out", str(self.out), *map(str, more)),
        ]

    def run(self, *more) -> RunFolder:
        result = CliRunner().invoke(app, self.arguments(*more))
        if result.exception is not None:
            raise result.exception
        self.printed = result.stdout
        return RunFolder(self.out)


@pytest.fixture
def world(tmp_path: Path) -> World:
    return World(tmp_path)


def test_results_are_a_submission_of_every_sample(world: World) -> None:
    world.run("--frame", world.tokens["a"])
    boxes, meta = read_submission(world.out / "results.json")
    assert set(boxes.sample_tokens) == set(world.tokens.values())
    assert (meta["use_camera"], meta["use_lidar"]) == (True, True)
    results = json.loads((world.out / "results.json").read_text())["results"]
    assert results[world.tokens["b"]] == []
    by_name = {}
    for box in results[world.tokens["a"]]:
        by_name.setdefault(box["detection_name"], []).append(box)
    assert {name: len(found) for name, found in by_name.items()} == {"car": 2, "pedestrian": 1}
    first, second = sorted(by_name["car"], key=lambda box: -box["translation"][0])
    # carried over from the LiDAR detector where it gave them, defaults where it did not and for recovered boxes
    np.testing.assert_allclose(first["velocity"], [3.0, 4.0], atol=1e-4)
    assert first["attribute_name"] == "vehicle.moving"
    assert (second["velocity"], second["attribute_name"]) == ([0.0, 0.0], "vehicle.parked")
    (walker,) = by_name["pedestrian"]
    assert (walker["velocity"], walker["attribute_name"]) == ([0.0, 0.0], "pedestrian.moving")
    assert np.hypot(*(np.array(walker["translation"][:2]) - WALKER[:2])) < 0.3


def test_at_most_500_boxes_a_sample_the_best_ones(world: World) -> None:
    content = json.loads(world.lidar.read_text())
    token = world.tokens["a"]
    template = content["results"][token][0]
    grid = [(x, y) for x in range(-46, 47, 4) for y in range(-46, 47, 4)][:499]
    content["results"][token] = [
        {**template, "translation": [x, y, -0.9], "size": [0.5, 0.5, 1.0], "detection_score": 0.1 + 0.001 * (i % 800)}
        for i, (x, y) in enumerate(grid)
    ]
    world.lidar.write_text(json.dumps(content))
    folder = world.run("--frame", token)
    fused = folder.read(token)
    assert len(fused) > 500  # recovery has added some
    written = json.loads((world.out / "results.json").read_text())["results"][token]
    assert len(written) == 500
    scores = [box["detection_score"] for box in written]
    assert scores == sorted(scores, reverse=True)
    assert scores[-1] == pytest.approx(fused.detections.scores[499], abs=1e-6)


def test_two_processes_and_a_resumed_run_write_the_same(world: World) -> None:
    world.run()
    whole = (world.out / "results.json").read_bytes()
    (world.out / "results.json").unlink()
    RunFolder(world.out).provenance_path(world.tokens["b"]).unlink()
    world.run("--resume")
    assert (world.out / "results.json").read_bytes() == whole
    world.run("--jobs", "2", "--overwrite")
    assert (world.out / "results.json").read_bytes() == whole


@pytest.mark.parametrize("how", ["late", "missing"])
def test_a_camera_that_is_late_or_missing_is_left_out_and_says_so(world: World, how: str) -> None:
    def edit(records: list[dict]) -> None:
        (record,) = [r for r in records if r["sample_token"] == world.tokens["a"] and "/CAM_BACK/" in r["filename"]]
        if how == "late":
            record["timestamp"] += 300_000
        else:
            records.remove(record)

    world.change("sample_data", edit)
    folder = world.run()
    assert world.printed.count("nobody looked there") == 1
    assert "in 1 frames: camera CAM_BACK is missing" in world.printed
    fused, other = folder.read(world.tokens["a"]), folder.read(world.tokens["b"])
    assert "CAM_BACK" not in fused.camera_names
    assert len(fused.camera_names) == 5
    (note,) = [note for note in fused.notes if "CAM_BACK " in note]
    assert "nobody looked there" in note
    assert not any("CAM_BACK " in note for note in other.notes)
    reasons = [fused.lidar.row(i)["reason"] for i in range(2)]
    assert sorted(reasons) == ["confirmed", "out_of_view"]
    assert sorted(other.lidar.row(i)["reason"] for i in range(2)) == ["confirmed", "confirmed"]


def test_without_any_camera_in_time_the_lidar_stands_alone(world: World) -> None:
    def edit(records: list[dict]) -> None:
        for record in records:
            if record["sample_token"] == world.tokens["a"] and "/CAM_" in record["filename"]:
                record["timestamp"] += 300_000

    world.change("sample_data", edit)
    fused = world.run().read(world.tokens["a"])
    assert fused.outcomes.tolist() == [Outcome.KEPT, Outcome.KEPT]
    assert fused.detections.scores.tolist() == [0.7, 0.6]
    assert sum("nobody looked there" in note for note in fused.notes) == 6


@pytest.mark.parametrize("mode", ["box", "mask", "box+mask"])
def test_instance_masks_of_the_file_choose_the_object(world: World, mode: str) -> None:
    """Two people side by side in one 2D box; the mask covers one of them, then the other."""
    token = world.tokens["a"]
    view = next(v for v in rig() if v.name == "CAM_FRONT_LEFT")
    other = [WALKER[0] - 1.3, WALKER[1] + 0.75, *WALKER[2:]]
    scan = world.root / "samples/LIDAR_TOP/a.pcd.bin"
    added = surface_points([other], seed=3)
    raw = np.column_stack([-added[:, 1], added[:, 0], added[:, 2], added[:, 3], np.zeros(len(added))])
    np.concatenate([np.fromfile(scan, "<f4").reshape(-1, 5), raw.astype("<f4")]).tofile(scan)
    rectangles, _ = project_boxes(np.array([WALKER, other]), view)
    (x1, y1), (x2, y2) = rectangles[:, :2].min(axis=0), rectangles[:, 2:].max(axis=0)
    record = next(r for r in world.records if r["sample_token"] == token and r["category_name"] == "pedestrian")
    record["bbox"] = [x1, y1, x2 - x1, y2 - y1]
    found = []
    for rectangle in rectangles.astype(int):
        image = np.zeros((view.height, view.width), dtype=bool)
        image[rectangle[1] : rectangle[3], rectangle[0] : rectangle[2]] = True
        record["segmentation"] = encode_mask(image)
        world.write_camera()
        settings = ("--set", f"mask_mode={mode}", "--set", "confirm_iou=0.1", "--overwrite")
        detections = world.run("--frame", token, *settings).read(token).detections
        found.append(detections.boxes[detections.labels == PEDESTRIAN_LABEL])
    assert [len(boxes) for boxes in found] == [1, 1]
    if mode == "box":
        np.testing.assert_array_equal(found[0], found[1])
    else:
        assert np.hypot(*(found[0][0, :2] - WALKER[:2])) < 0.3
        assert np.hypot(*(found[1][0, :2] - other[:2])) < 0.3


BAD_TABLES = {
    "dangling token": ("sample_data", lambda r: r[0].update(ego_pose_token="ghost"), ("ego_pose", "ghost")),
    "no LiDAR sweep": ("sample_data", lambda r: r.remove(_lidar(r)), ("LIDAR_TOP",)),
    "not a unit quaternion": (
        "ego_pose",
        lambda r: r[0].update(rotation=[2.0, 0, 0, 0]),
        ("ego_pose.json", "length 2, not 1"),
    ),
    "token twice": ("sample", lambda r: r[1].update(token=r[0]["token"]), ("token",)),
    "no intrinsics": ("calibrated_sensor", lambda r: r[1].update(camera_intrinsic=[]), ("intrinsic",)),
}


def _lidar(records: list[dict]) -> dict:
    return next(r for r in records if "LIDAR_TOP" in r["filename"])


def fails(monkeypatch, capsys, *arguments) -> str:
    """The one sentence on standard error of a command that ends with exit code 2."""
    monkeypatch.setattr(sys, "argv", ["lcf3d", *map(str, arguments)])
    with pytest.raises(SystemExit) as stop:
        main()
    assert stop.value.code == 2
    lines = capsys.readouterr().err.strip().splitlines()
    assert len(lines) == 1
    assert lines[0].startswith("error: ")
    return lines[0]


@pytest.mark.parametrize("case", BAD_TABLES)
def test_bad_tables_are_one_sentence_and_check_lists_them(world: World, case: str, monkeypatch, capsys) -> None:
    table, edit, words = BAD_TABLES[case]
    world.change(table, edit)
    sentence = fails(monkeypatch, capsys, *world.arguments())
    assert all(word in sentence for word in words), sentence
    assert not world.out.exists()
    listed = CliRunner().invoke(app, ["check", f"nuscenes:{world.root}"])
    assert listed.exit_code == 1
    assert any(all(word in line for word in words) for line in listed.stdout.splitlines()), listed.stdout


def test_check_lists_all_faults_at_once(world: World) -> None:
    for table, edit, _ in BAD_TABLES.values():
        world.change(table, edit)
    world.change("sample_data", lambda records: records[-1].update(timestamp=0))
    found = json.loads(CliRunner().invoke(app, ["check", f"nuscenes:{world.root}", "--json"]).stdout)
    assert {"NUS02", "NUS03", "NUS04", "NUS05", "NUS06"} <= {finding["id"] for finding in found}


def test_unsynchronised_stamps_are_listed_by_check(world: World) -> None:
    world.change("sample_data", lambda records: records[-1].update(timestamp=records[-1]["timestamp"] + 250_000))
    listed = CliRunner().invoke(app, ["check", f"nuscenes:{world.root}"])
    assert listed.exit_code == 0  # a warning: the camera is left out, the rest can be used
    assert any("NUS10" in line and "0.250 s" in line for line in listed.stdout.splitlines())


def _edit_json(path: Path, edit) -> None:
    content = json.loads(path.read_text())
    edit(content)
    path.write_text(json.dumps(content))


BAD_RESULTS = {
    "too many boxes": ("lidar", lambda c: _first(c).extend(_first(c)[:1] * 500), "at most 500"),
    "sample missing": ("lidar", lambda c: c["results"].pop(next(iter(c["results"]))), "lacks 1 of 2 samples"),
    "unknown class": ("lidar", lambda c: _first(c)[0].update(detection_name="tram"), "tram"),
    "score NaN": ("lidar", lambda c: _first(c)[0].update(detection_score=float("nan")), "NaN"),
    "no bbox": ("camera", lambda c: c[0].pop("bbox"), "bbox"),
    "mask of another size": (
        "camera",
        lambda c: c[0].update(segmentation={"size": [4, 4], "counts": [3, 4]}),
        "the runs of a mask",
    ),
}


def _first(content: dict) -> list[dict]:
    return next(iter(content["results"].values()))


@pytest.mark.parametrize("case", BAD_RESULTS)
def test_bad_results_are_one_sentence(world: World, case: str, monkeypatch, capsys) -> None:
    branch, edit, words = BAD_RESULTS[case]
    _edit_json(getattr(world, branch), edit)
    sentence = fails(monkeypatch, capsys, *world.arguments())
    assert words in sentence
    assert str(getattr(world, branch)) in sentence
    assert not world.out.exists()


def test_six_cameras_take_one_detector(world: World, monkeypatch, capsys) -> None:
    arguments = world.arguments()
    arguments[arguments.index("--camera")] = "--camera-left"
    sentence = fails(monkeypatch, capsys, *arguments, "--camera-right", f"results:{world.camera}")
    assert "stereo pair, which this dataset does not have; --camera is for CAM_FRONT_LEFT" in sentence


def test_the_rig_is_that_of_nuscenes() -> None:
    assert set(YAWS) == set(CAMERAS)


def real_run(shared: Path, out: Path, *more) -> RunFolder:
    """The first sample of scene-0061, complete with images and scan, and an empty LiDAR branch."""
    empty, split = out / "empty.json", out / "scene.txt"
    empty.write_text(json.dumps({"meta": {}, "results": {DEMO: []}}))
    split.write_text("scene-0061\n")
    arguments = ["run", f"nuscenes:{shared / 'data/nuscenes'}", "--split", str(split), "--out", str(out / "run")]
    result = CliRunner().invoke(app, [*arguments, "--lidar", f"results:{empty}", *map(str, more)])
    if result.exception is not None:
        raise result.exception
    return RunFolder(out / "run")


def center_distances(folder: RunFolder, shared: Path) -> np.ndarray:
    """(N,) horizontal distance from each output to the nearest annotation of its class in metres."""
    found, truth = folder.read(DEMO).detections, NuscenesDataset(shared / "data/nuscenes").frame(DEMO).labels
    apart = np.linalg.norm(found.boxes[:, None, :2] - truth.boxes[None, :, :2], axis=2)
    apart[found.labels[:, None] != truth.labels[None]] = np.inf
    return apart.min(axis=1)


@pytest.mark.real
def test_six_real_images_and_their_scan_give_boxes_without_any_lidar_detector(shared: Path, tmp_path: Path) -> None:
    weights = shared / "weights/deimv2_femto.onnx"
    folder = real_run(shared, tmp_path, "--camera", f"onnx:{weights}", "--tiles", "2", "--pictures")
    fused = folder.read(DEMO)
    assert set(fused.camera_names) == set(CAMERAS)
    assert set(fused.outcomes.tolist()) == {Outcome.RECOVERED}
    # measured: 5 of 14 lie within half a metre of an annotation of their class, among them the most certain ones
    distances = center_distances(folder, shared)
    assert (distances < 0.5).sum() >= 4
    assert (distances[:4] < 2.0).all()
    assert (folder.path / "pictures" / f"{DEMO}.png").stat().st_size > 100_000


@pytest.mark.real
def test_instance_masks_of_a_real_network(shared: Path, tmp_path: Path) -> None:
    weights = shared / "weights/yolov8n-seg_int8.onnx"
    folder = real_run(shared, tmp_path, "--camera", f"onnx:{weights}", "--set", "mask_mode=mask")
    distances = center_distances(folder, shared)
    assert len(distances) >= 2
    assert np.median(distances) < 0.5


@pytest.mark.real
def test_fusion_improves_centerpoint_on_mini_val(shared: Path, tmp_path: Path) -> None:
    """Camera detections are simulated from ground truth, so that the size of the gain says nothing."""
    root = shared / "data/nuscenes"
    lidar, camera = root / "results/centerpoint.json", root / "results/camera_2d_simulated.json"
    branches = ["--lidar", f"results:{lidar}", "--camera", f"results:{camera}", "--recovery", "off"]
    arguments = ["run", f"nuscenes:{root}", "--split", "mini_val", *branches, "--out", str(tmp_path / "out")]
    assert CliRunner().invoke(app, arguments).exit_code == 0
    scores = {}
    for path in (lidar, tmp_path / "out/results.json"):
        printed = CliRunner().invoke(app, ["eval", f"nuscenes:{root}", str(path), "--split", "mini_val", "--json"])
        scores[path.name] = json.loads(printed.stdout)["results"][0]["metrics"]
    alone, fused = scores["centerpoint.json"], scores["results.json"]
    assert fused["mean_ap"] > alone["mean_ap"] + 0.03
    # without velocity and attributes, which CenterPoint's file does not hold
    assert fused["nds_hat"] > alone["nds_hat"] + 0.01
    assert fused["nd_score"] > alone["nd_score"] + 0.01
