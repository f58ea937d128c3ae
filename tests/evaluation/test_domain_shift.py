import json
import sys
from importlib.metadata import EntryPoint
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from lcf3d import plugins
from lcf3d.cli.app import app, main
from lcf3d.datasets.convert import write_nuscenes
from lcf3d.datasets.kitti import KittiDataset
from lcf3d.datasets.nuscenes import NuscenesDataset
from lcf3d.errors import ConfigError, DatasetError, ShapeError
from lcf3d.evaluation.domain_report import best_cells, charts, html_report
from lcf3d.evaluation.domain_shift import (
    DOMAINS,
    IOU_THRESHOLDS,
    AdaptedFrames,
    AdaptedLidar,
    adapt_points,
    ap_over_iou,
    evaluate_shift,
    find_domain,
    in_kitti_classes,
    split_truth,
    without_ignored,
)
from lcf3d.evaluation.domain_tasks import DomainTask, DomainTaskRunner, parse_task
from lcf3d.evaluation.svg import PALETTE
from lcf3d.frame import Frame
from lcf3d.fusion.config import FusionConfig
from lcf3d.geometry.camera import project_points
from lcf3d.structures import KITTI_CLASSES, NUSCENES_CLASSES, Detections3D
from tests.datasets.kitti_folder import OBJECTS, make_kitti, make_results
from tests.fusion.scenes import camera

KITTI, NUSCENES = DOMAINS["kitti"], DOMAINS["nuscenes"]
CAR = [10.0, 0, 0, 4, 2, 1.5, 0]
BIKE = [12.0, 3, 0, 1.8, 0.6, 1.2, 0]


def boxes(rows, labels, names=KITTI_CLASSES, scores=None, attributes=None) -> Detections3D:
    scores = np.full(len(rows), 0.5) if scores is None else scores
    return Detections3D(np.array(rows, dtype=float).reshape(-1, 7), scores, labels, names, None, attributes)


# what a detector sees that was trained elsewhere


def test_nuscenes_points_for_a_kitti_detector() -> None:
    # on the ground 1.84 m below the LiDAR, full intensity; then something behind the vehicle, with an age
    points = np.array([[10, 0, -1.84, 255, 0], [-10, 0, 0, 51, 0.1]], dtype=np.float32)
    np.testing.assert_allclose(
        adapt_points(points, NUSCENES, KITTI), [[10, 0, -1.73, 1], [-10, 0, 0.11, 0.2]], atol=1e-6
    )
    # KITTI detectors were trained on the front camera's view
    np.testing.assert_allclose(adapt_points(points, NUSCENES, KITTI, camera()), [[10, 0, -1.73, 1]], atol=1e-6)


def test_kitti_points_for_a_nuscenes_detector_have_time_zero() -> None:
    points = np.array([[10, 0, -1.73, 1], [-10, 0, 0, 0.2]], dtype=np.float32)
    adapted = adapt_points(points, KITTI, NUSCENES, camera())
    np.testing.assert_allclose(adapted, [[10, 0, -1.84, 255, 0], [-10, 0, -0.11, 51, 0]], atol=1e-5)
    # a fifth column of KITTI data would be no age
    extra = np.column_stack([points, [7, 7]]).astype(np.float32)
    np.testing.assert_array_equal(adapt_points(extra, KITTI, NUSCENES), adapted)


def test_the_way_there_and_back_and_equal_domains() -> None:
    points = np.random.default_rng(0).uniform(-20, 20, (50, 4)).astype(np.float32)
    there = adapt_points(points, KITTI, NUSCENES)
    np.testing.assert_allclose(adapt_points(there, NUSCENES, KITTI), points, atol=1e-4)
    np.testing.assert_array_equal(adapt_points(points, KITTI, KITTI), points)
    aged = np.column_stack([points, np.arange(50)]).astype(np.float32)
    np.testing.assert_array_equal(adapt_points(aged, NUSCENES, NUSCENES), aged)
    with pytest.raises(ShapeError, match="N, 4 or more"):
        adapt_points(points[:, :3], KITTI, NUSCENES)


def test_points_given_are_not_changed() -> None:
    points = np.ones((3, 4), dtype=np.float32)
    adapt_points(points, KITTI, NUSCENES)
    assert (points == 1).all()


def test_boxes_of_an_adapted_detector_are_in_the_frames_coordinates() -> None:
    """A detector that puts a box on the highest point: the box comes back where that point was."""

    def detector(points):
        assert points.shape[1] == 4
        top = points[points[:, 2].argmax(), :3]
        return boxes([[*top, 1, 1, 1, 0]], [0])

    scan = np.array([[10, 0, 0.5, 9], [12, 1, 0.2, 9]], dtype=np.float32)
    source = AdaptedLidar(detector, NUSCENES, KITTI, "left")
    found = source.detect(Frame("f", scan, [camera()]))
    np.testing.assert_allclose(found.boxes[0, :3], [10, 0, 0.5], atol=1e-6)


def test_a_detector_of_frames_sees_points_where_they_were_in_the_image() -> None:
    """The LiDAR frame moves to the height of training, the cameras stay: pixels of points do not change."""
    scan = np.array([[10, 0, 0.5, 255], [12, 1, 0.2, 51]], dtype=np.float32)
    given = Frame("f", scan, [camera()])

    class Detector:
        def detect_frame(self, frame):
            np.testing.assert_allclose(frame.points[:, 3], [1, 0.2], rtol=1e-6)
            seen, seen_before = (project_points(f.points[:, :3], f.camera("left"))[0] for f in (frame, given))
            np.testing.assert_allclose(seen, seen_before, atol=1e-3)
            return boxes([[*frame.points[0, :3], 1, 1, 1, 0]], [0])

    found = AdaptedFrames(Detector(), NUSCENES, KITTI, "left").detect(given)
    np.testing.assert_allclose(found.boxes[0, :3], [10, 0, 0.5], atol=1e-6)
    with pytest.raises(DatasetError, match="no scan"):
        AdaptedFrames(Detector(), NUSCENES, KITTI, "left").detect(Frame("f", None, [camera()]))


def test_domains_by_the_beginning_of_a_name() -> None:
    assert find_domain("kitti64") is KITTI
    assert find_domain("nuScenes32") is NUSCENES
    with pytest.raises(ConfigError, match="begin with kitti or nuscenes"):
        find_domain("waymo")


# classes


def test_nuscenes_truth_in_kitti_classes() -> None:
    names = [NUSCENES_CLASSES.index(n) for n in ("car", "bicycle", "motorcycle", "bicycle", "pedestrian", "bus")]
    attributes = ["", "cycle.with_rider", "cycle.with_rider", "cycle.without_rider", "pedestrian.moving", ""]
    truth = split_truth(boxes([CAR, BIKE, BIKE, BIKE, CAR, CAR], names, NUSCENES_CLASSES, attributes=attributes))
    assert truth.counted.class_names == KITTI_CLASSES
    assert truth.counted.labels.tolist() == [0, 2, 2, 1]
    assert truth.ignored.labels.tolist() == [2]


def test_kitti_truth_ignores_what_looks_alike() -> None:
    names = (*KITTI_CLASSES, "Van", "Person_sitting")
    truth = split_truth(boxes([CAR, BIKE, CAR, CAR, CAR], [0, 2, 1, 3, 4], names))
    assert truth.counted.labels.tolist() == [0, 2, 1]
    assert truth.ignored.labels.tolist() == [0, 1]


def test_predictions_in_kitti_classes() -> None:
    names = [NUSCENES_CLASSES.index(n) for n in ("car", "bicycle", "motorcycle", "bicycle", "truck")]
    found = boxes([CAR] * 5, names, NUSCENES_CLASSES, attributes=["", "", "", "cycle.without_rider", ""])
    # "without rider" is what detectors write by default, and is not believed
    assert in_kitti_classes(found).labels.tolist() == [0, 2, 2, 2]
    assert in_kitti_classes(boxes([CAR, BIKE], [0, 2])).labels.tolist() == [0, 2]


def test_detections_of_ignored_objects_do_not_count() -> None:
    empty_bike, ridden = [12.0, 3, 0, 1.8, 0.6, 1.2, 0], [12.0, 6, 0, 1.8, 0.6, 1.7, 0]
    truth = split_truth(
        boxes(
            [empty_bike, ridden],
            [NUSCENES_CLASSES.index("bicycle")] * 2,
            NUSCENES_CLASSES,
            attributes=["cycle.without_rider", "cycle.with_rider"],
        )
    )
    found = boxes(
        [
            [12.5, 3, 0, 1.8, 0.6, 1.2, 0],  # the empty bicycle
            [12, 4.4, 0, 1.8, 0.6, 1.2, 0],  # between both, nearer to the empty one
            [12, 4.6, 0, 1.8, 0.6, 1.2, 0],  # nearer to the ridden one
            [12, 0.9, 0, 1.8, 0.6, 1.2, 0],  # 2.1 m from the empty one: a false detection
            [12.5, 3, 0, 1.8, 0.6, 1.2, 0],  # a car on the empty bicycle: false as well
        ],
        [2, 2, 2, 2, 0],
    )
    assert without_ignored(found, truth).boxes[:, 1].tolist() == [4.6, 0.9, 3]


# metrics


def test_ap_over_iou_by_hand() -> None:
    """Boxes of length 4 moved by 1 m: IoU 3 / 5."""
    truth = [boxes([CAR, [20.0, *CAR[1:]]], [0, 0])]
    found = [boxes([[11.0, *CAR[1:]], [20.0, *CAR[1:]], [40.0, *CAR[1:]]], [0, 0, 0], scores=[0.9, 0.8, 0.7])]
    ap = ap_over_iou(truth, found, np.array([0.5, 0.59, 0.61, 0.9]))
    assert np.isnan(ap[1:]).all()
    # both found before the false one; then only the second of rank two: precision 1/2 up to recall 1/2
    np.testing.assert_allclose(ap[0], [100, 100, 25, 25])


def test_ap_over_iou_takes_every_object_once() -> None:
    truth = [boxes([CAR], [0]), boxes([CAR], [0])]
    found = [boxes([CAR, CAR], [0, 0], scores=[0.9, 0.8]), boxes([], [])]
    # one of two objects found first, the second detection of it is false
    np.testing.assert_allclose(ap_over_iou(truth, found, np.array([0.5]))[0], [50])


def test_truth_against_itself_in_the_cameras_view() -> None:
    behind = [-10.0, 0, 0, 4, 2, 1.5, 0]
    truth = [split_truth(boxes([CAR, behind], [0, 0]))]
    result = evaluate_shift(truth, [boxes([CAR], [0])], [camera()])
    assert result.metrics.class_names == ("Car",)
    assert result.metrics.ground_truth_counts == (1,)
    assert result.metrics.nds_hat == pytest.approx(1)
    np.testing.assert_allclose(result.ap_over_iou, 100)
    assert result.ap_over_iou.shape == (1, len(IOU_THRESHOLDS))


# tasks


def test_tasks_from_text() -> None:
    task = parse_task("kitti64->nuscenes32 'nuscenes:my data' lidar=results:a=b.json camera=onnx:x.onnx split=val")
    assert task == DomainTask(
        "kitti64", "nuscenes32", "nuscenes:my data", "results:a=b.json", "onnx:x.onnx", None, "val"
    )
    assert task.name == "kitti64 -> nuscenes32"


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "begins with TRAINED->TESTED"),
        ("kitti kitti:D lidar=results:L", "begins with TRAINED->TESTED"),
        ("kitti->kitti lidar=results:L", "begins with TRAINED->TESTED"),
        ("kitti->kitti kitti:D", "names no LiDAR detector"),
        ("kitti->kitti kitti:D lidar=results:L radar=x", "got 'radar=x'"),
        ("kitti->kitti kitti:D lidar=results:L lidar=results:M", "got 'lidar=results:M'"),
        ("kitti->kitti kitti:D lidar=results:L camera=results:C fused=results:F", "not both"),
        ("kitti->kitti kitti:D lidar=results:L fused=onnx:F", "takes results:PATH"),
        ("waymo->kitti kitti:D lidar=results:L", "begin with kitti or nuscenes"),
        ("kitti->kitti 'kitti:D lidar=results:L", "cannot be read"),
    ],
)
def test_malformed_tasks_are_refused(text: str, words: str) -> None:
    with pytest.raises(ConfigError, match=words):
        parse_task(text)


@pytest.fixture
def folders(tmp_path: Path) -> dict[str, Path]:
    """The same street as KITTI layout and as nuScenes tables, with results of both branches for both."""
    kitti = make_kitti(tmp_path / "kitti")
    lidar, camera_results = make_results(tmp_path)
    frames = list(KittiDataset(kitti, "val"))
    nuscenes = tmp_path / "nuscenes"
    tokens = {id: token for token, id in write_nuscenes(frames, nuscenes, {"left": "CAM_FRONT"}).items()}
    found = boxes([OBJECTS[0]], [NUSCENES_CLASSES.index("car")], NUSCENES_CLASSES, scores=[0.9])
    NuscenesDataset(nuscenes).write_results(tmp_path / "lidar.json", dict.fromkeys(tokens.values(), found))
    records = []
    for frame in frames:
        for box, label in zip(_projections(frame), ("car", "car", "pedestrian"), strict=True):
            x1, y1, x2, y2 = box.tolist()
            records.append(
                {
                    "sample_token": tokens[frame.id],
                    "camera": "CAM_FRONT",
                    "bbox": [x1, y1, x2 - x1, y2 - y1],
                    "score": 0.9,
                    "category_name": label,
                }
            )
    (tmp_path / "camera.json").write_text(json.dumps(records))
    return {
        "kitti": kitti,
        "kitti_lidar": lidar,
        "kitti_camera": camera_results,
        "nuscenes": nuscenes,
        "nuscenes_lidar": tmp_path / "lidar.json",
        "nuscenes_camera": tmp_path / "camera.json",
    }


def _projections(frame: Frame) -> np.ndarray:
    from lcf3d.geometry.camera import project_boxes

    return project_boxes(np.array(OBJECTS, dtype=float), frame.camera("left"))[0]


def task_text(folders: dict[str, Path], trained: str, tested: str) -> str:
    return (
        f"{trained}->{tested} {tested}:{folders[tested]} lidar=results:{folders[f'{tested}_lidar']} "
        f"camera=results:{folders[f'{tested}_camera']}"
    )


def test_four_tasks_end_to_end(folders: dict[str, Path], tmp_path: Path) -> None:
    tasks = [task_text(folders, a, b) for a in ("kitti", "nuscenes") for b in ("kitti", "nuscenes")]
    out = tmp_path / "shift"
    arguments = ["generalize", "--out", str(out), *(word for task in tasks for word in ("--task", task))]
    result = CliRunner().invoke(app, arguments)
    assert result.exit_code == 0, result.exception
    assert "nuscenes -> kitti" in result.stdout
    report = json.loads((out / "domain_shift.json").read_text())
    assert [(t["trained"], t["tested"]) for t in report] == [
        ("kitti", "kitti"),
        ("kitti", "nuscenes"),
        ("nuscenes", "kitti"),
        ("nuscenes", "nuscenes"),
    ]
    for task in report:
        alone, fused = task["methods"]["LiDAR"], task["methods"]["fused"]
        assert set(alone["label_aps"]) == {"Car", "Pedestrian"}  # nobody cycles there
        # the LiDAR branch misses the pedestrian, the camera brings it back
        assert alone["label_aps"]["Pedestrian"]["1.0"] == 0
        assert fused["label_aps"]["Pedestrian"]["1.0"] > 0.9
        assert fused["nds_hat"] > alone["nds_hat"]
        assert fused["ap_over_iou"]["Pedestrian"]["0.10"] == 100
        assert set(alone["ap_over_iou"]["Car"]) == {f"{t:.2f}" for t in IOU_THRESHOLDS}
    drawn = sorted(path.name for path in (out / "charts").iterdir())
    assert drawn == ["kitti_Car.svg", "kitti_Pedestrian.svg", "nuscenes_Car.svg", "nuscenes_Pedestrian.svg"]
    assert (out / "charts/kitti_Car.svg").read_text().count("<polyline") == 4
    html = (out / "report.html").read_text()
    assert html.count("<svg") == 4
    assert html.count("kitti -&gt; nuscenes") == 1
    # a training set has one colour in all charts
    kitti_color, nuscenes_color = PALETTE[:2]
    for name in drawn:
        svg = (out / "charts" / name).read_text()
        assert svg.index(kitti_color) < svg.index("kitti, LiDAR") < svg.index(nuscenes_color)


def test_a_detector_of_the_other_data_gets_adapted_points(folders: dict[str, Path], monkeypatch) -> None:
    seen = []

    def build(argument, class_names):
        assert class_names == NUSCENES_CLASSES  # the vocabulary it was trained with

        def detect(points):
            seen.append(points)
            return boxes([[*OBJECTS[0][:2], OBJECTS[0][2] - 0.11, *OBJECTS[0][3:]]], [0], NUSCENES_CLASSES)

        return detect

    monkeypatch.setitem(sys.modules, "my_lidar", type(sys)("my_lidar"))
    sys.modules["my_lidar"].Build = build
    point = EntryPoint("mine", "my_lidar:Build", "lcf3d.lidar_detectors")
    installed = plugins._points
    lidar = {"mine": point}
    monkeypatch.setattr(plugins, "_points", lambda g: lidar if g == point.group else installed(g))
    task = parse_task(f"nuscenes->kitti kitti:{folders['kitti']} lidar=mine:x split=val")
    result = DomainTaskRunner(task, FusionConfig())()
    raw = KittiDataset(folders["kitti"], "val")[0].points
    assert seen[0].shape == (len(raw), 5)
    np.testing.assert_allclose(seen[0][:, 2], raw[:, 2] - 0.11, atol=1e-5)
    np.testing.assert_allclose(seen[0][:, 3], raw[:, 3] * 255, rtol=1e-5)
    assert set(result) == {"LiDAR"}
    # its box came back at the height of the label
    assert result["LiDAR"].ap_over_iou[0, -1] == pytest.approx(50, abs=3)


def test_results_of_another_fusion_and_unbounded_scores(folders: dict[str, Path]) -> None:
    base = f"kitti->kitti kitti:{folders['kitti']} lidar=results:{folders['kitti_lidar']}"
    given = DomainTaskRunner(parse_task(f"{base} fused=results:{folders['kitti_lidar']}"), FusionConfig())()
    np.testing.assert_array_equal(given["fused"].ap_over_iou, given["LiDAR"].ap_over_iou)
    for path in folders["kitti_lidar"].iterdir():
        path.write_text("".join(f"{line.rsplit(' ', 1)[0]} 12.5\n" for line in path.read_text().splitlines()))
    fused = DomainTaskRunner(parse_task(f"{base} camera=results:{folders['kitti_camera']}"), FusionConfig())()
    assert fused["fused"].metrics.mean_ap > fused["LiDAR"].metrics.mean_ap


def test_bad_requests_are_one_sentence(folders: dict[str, Path], tmp_path: Path, monkeypatch, capsys) -> None:
    def sentence(*arguments) -> str:
        monkeypatch.setattr(sys, "argv", ["lcf3d", "generalize", "--out", str(tmp_path / "x"), *arguments])
        with pytest.raises(SystemExit) as stop:
            main()
        assert stop.value.code == 2
        (line,) = capsys.readouterr().err.strip().splitlines()
        return line

    task = task_text(folders, "kitti", "kitti")
    assert "Tram" in sentence("--task", task, "--class", "Tram")
    assert "two tasks are named 'kitti -> kitti'" in sentence("--task", task, "--task", task)
    assert "the settings have car" in sentence("--task", task, "--config", "nuscenes")
    for path in (folders["kitti"] / "training/label_2").iterdir():
        path.unlink()
    assert "has no labels" in sentence("--task", task)
    (folders["kitti_lidar"] / "000001.txt").unlink()
    assert "000001" in sentence("--task", task)
    assert not (tmp_path / "x").exists()


def test_best_of_a_task() -> None:
    frame, view = boxes([CAR], [0]), [camera()]
    truth = [split_truth(frame)]
    good = evaluate_shift(truth, [frame], view)
    shifted = evaluate_shift(truth, [boxes([[10.8, *CAR[1:]]], [0])], view)
    best = best_cells({"LiDAR": shifted, "fused": good})
    # both have the right size and heading: nobody is better there
    assert best == {"LiDAR": [False] * 5, "fused": [True, True, True, False, False]}


def test_lines_of_a_chart_are_named_and_coloured_by_task() -> None:
    frame = boxes([CAR], [0])
    result = evaluate_shift([split_truth(frame)], [frame], [camera()])
    results = [(DomainTask(a, "kitti", "kitti:D", "results:L"), {"LiDAR": result}) for a in ("kitti", "nuscenes<1>")]
    ((place, svg),) = charts(results).items()
    assert place == ("kitti", "Car")
    assert svg.count("stroke-dasharray") >= 2
    assert "nuscenes&lt;1&gt;, LiDAR" in svg
    assert "nuscenes&lt;1&gt; -&gt; kitti" in html_report(results)


@pytest.mark.real
def test_kitti_on_kitti_with_real_detectors(shared: Path) -> None:
    root = shared / "data/kitti"
    task = parse_task(
        f"kitti->kitti kitti:{root} split=sensor_val lidar=results:{root}/results/point_gnn "
        f"camera=results:{root}/results/rcnn_2d"
    )
    result = DomainTaskRunner(task, FusionConfig.preset("kitti"))(("Car",))
    assert result["LiDAR"].metrics.mean_ap > 0.5
    assert result["fused"].metrics.mean_ap > 0.5
