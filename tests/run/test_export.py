"""Exports in the tools that are to load them, and what is said of runs that cannot be read."""

import json
import socket
from contextlib import redirect_stdout
from io import StringIO
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

import lcf3d
from lcf3d.cli.app import app
from lcf3d.datasets.nuscenes import NuscenesDataset
from lcf3d.datasets.opening import open_dataset
from lcf3d.errors import ConfigError
from lcf3d.formats.argoverse import read_submission as read_argoverse
from lcf3d.formats.nuscenes import read_submission as read_nuscenes
from lcf3d.run.export import export_run
from lcf3d.run.folder import RunFolder
from lcf3d.structures import Detections2D, Detections3D
from tests.cli.test_run_nuscenes import World
from tests.datasets.argoverse_log import LOG, sweep_time, write_log
from tests.datasets.kitti_folder import make_kitti, make_results


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A KITTI drive, ``fused`` of it and the same in tables, ``tables``."""
    folder = tmp_path_factory.mktemp("drive")
    make_kitti(folder / "kitti")
    make_results(folder)
    fused(folder, folder / "fused")
    return folder


def fused(root: Path, out: Path, **options) -> Path:
    lcf3d.run(f"kitti:{root / 'kitti'}", f"results:{root / 'lidar'}", f"results:{root / 'camera'}", out, **options)
    return out


def exported(root: Path, form: str, out: Path) -> Path:
    assert export_run(root / "fused", open_dataset(f"kitti:{root / 'kitti'}"), form, out) == 3
    return out


def test_coco_loads_and_measures_itself(root: Path, tmp_path: Path) -> None:
    coco = pytest.importorskip("pycocotools.coco", reason="needs pycocotools: pip install 'lcf3d[dev]'")
    from pycocotools.cocoeval import COCOeval

    with redirect_stdout(StringIO()):
        truth = coco.COCO(str(exported(root, "coco", tmp_path / "coco.json")))
        found = truth.loadRes([dict(a) for a in truth.dataset["annotations"]])
        measured = COCOeval(truth, found, "bbox")
        measured.evaluate()
        measured.accumulate()
        measured.summarize()
    assert len(truth.getImgIds()) == 3
    assert sorted(c["name"] for c in truth.loadCats(truth.getCatIds())) == ["Car", "Cyclist", "Pedestrian"]
    image = truth.loadImgs(1)[0]
    assert Path(image["file_name"]).is_file()
    assert (image["width"], image["height"]) == (1242, 375)
    # boxes against themselves: average precision 1 at all thresholds
    assert measured.stats[0] == pytest.approx(1.0)


def test_fiftyone_loads_its_form(root: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    # its importer, which needs no database
    monkeypatch.setenv("FIFTYONE_DATABASE_VALIDATION", "false")
    importers = pytest.importorskip("fiftyone.utils.data.importers", reason="needs FiftyOne: pip install fiftyone")
    run = RunFolder(root / "fused")
    labels = exported(root, "fiftyone", tmp_path / "labels.json")
    images = root / "kitti" / "training" / "image_2"
    with importers.FiftyOneImageDetectionDatasetImporter(data_path=str(images), labels_path=str(labels)) as loaded:
        assert len(loaded) == 3
        for path, _, found in loaded:
            fused = run.read(Path(path).stem)
            one = fused.detections
            assert [d.label for d in found.detections] == [one.class_names[label] for label in one.labels]
            assert [d.confidence for d in found.detections] == pytest.approx(one.scores.tolist())
            assert [d.explanation for d in found.detections] == [fused.explain(i) for i in range(len(one))]
            assert all(0 <= value <= 1 for d in found.detections for value in d.bounding_box)


def test_label_studio_takes_its_tasks(root: Path, tmp_path: Path) -> None:
    interface = pytest.importorskip(
        "label_studio_sdk.label_interface", reason="needs Label Studio's kit: pip install label-studio-sdk"
    )
    setup = interface.LabelInterface(
        '<View><Image name="image" value="$image"/><RectangleLabels name="label" toName="image">'
        '<Label value="Car"/><Label value="Pedestrian"/></RectangleLabels></View>'
    )
    tasks = json.loads(exported(root, "label-studio", tmp_path / "tasks.json").read_text())
    assert len(tasks) == 3
    for task in tasks:
        assert setup.validate_task({"data": task["data"]})
        (prediction,) = task["predictions"]
        assert prediction["result"]
        assert setup.validate_prediction(prediction)
        # a control of another name is refused
        wrong = {**prediction, "result": [{**prediction["result"][0], "from_name": "other"}]}
        assert not setup.validate_prediction(wrong)


@pytest.mark.parametrize("form", ["folder", "parquet"])
def test_nuscenes_is_what_the_run_itself_writes(tmp_path: Path, form: str) -> None:
    world = World(tmp_path)
    world.run("--format", form)
    data = NuscenesDataset(world.root)
    assert export_run(world.out, data, "nuscenes", tmp_path / "export.json") == 2
    boxes, meta = read_nuscenes(tmp_path / "export.json")
    assert (meta["use_camera"], meta["use_lidar"]) == (True, True)
    assert len(boxes.scores) > 2
    if form == "folder":
        own, _ = read_nuscenes(world.out / "results.json")
        for name in ("translations", "sizes", "rotations", "velocities", "scores", "labels", "attributes"):
            np.testing.assert_array_equal(getattr(boxes, name), getattr(own, name))
    # back in the LiDAR frame they are the boxes of the run
    token = world.tokens["a"]
    back = data.lidar_results(tmp_path / "export.json", data.class_names).detect(data.frame(token))
    kept = lcf3d.read_run(world.out)[token].detections
    order, other = np.argsort(-back.scores), np.argsort(-kept.scores)
    np.testing.assert_allclose(back.boxes[order], kept.boxes[other], atol=1e-5)


def test_argoverse_is_what_the_run_itself_writes(tmp_path: Path) -> None:
    pytest.importorskip("pyarrow", reason="needs pyarrow: pip install 'lcf3d[fleet]'")
    from lcf3d.datasets.argoverse2 import Argoverse2Dataset
    from lcf3d.fusion.config import FusionConfig
    from lcf3d.fusion.pipeline import LateCascadeFusion

    write_log(tmp_path / "data")
    data = Argoverse2Dataset(tmp_path / "data")
    folder = RunFolder(tmp_path / "run", data.writer(tmp_path / "run"))
    fusion = LateCascadeFusion(FusionConfig.load("argoverse2").updated(recovery=False))
    classes = fusion.config.class_names
    car = classes.index("REGULAR_VEHICLE")
    for i, frame in enumerate(data):
        found = Detections3D([[20.0 + i, 0, 1.5, 4, 2, 1.5, 0.3]], [0.9], [car], classes)
        seen = {camera.name: Detections2D.empty(classes) for camera in frame.cameras}
        folder.write(frame, fusion(frame, found, seen))
    folder.finish(data.ids)
    assert export_run(tmp_path / "run", data, "argoverse", tmp_path / "export.feather") == 3
    one, own = read_argoverse(tmp_path / "export.feather"), read_argoverse(tmp_path / "run" / "results.feather")
    assert one.log_ids == own.log_ids == (LOG,)
    assert one.timestamps_ns.tolist() == [sweep_time(i) for i in range(3)]
    np.testing.assert_array_equal(one.boxes, own.boxes)
    np.testing.assert_allclose(one.boxes[:, 0], [20, 21, 22])


def test_classes_of_others_are_not_left_out_in_silence(root: Path, tmp_path: Path) -> None:
    data = open_dataset(f"kitti:{root / 'kitti'}")
    with pytest.raises(ConfigError, match=r"class 'Car' is none of nuScenes: not exported"):
        export_run(root / "fused", data, "nuscenes", tmp_path / "x")


def test_shards_that_are_missing_or_overlap(root: Path, tmp_path: Path, refused_by) -> None:
    one, two = (fused(root, tmp_path / f"part-{i}", shard=f"{i}/3") for i in (1, 2))
    half = fused(root, tmp_path / "half", shard="1/2")
    assert refused_by("merge", one, two, "--out", tmp_path / "all") == "error: 1 of 3 shards are missing: 3/3"
    said = refused_by("merge", one, half, "--out", tmp_path / "all")
    assert said == "error: the shards overlap: they are of runs cut into 2 and 3"
    assert not (tmp_path / "all").exists()


def test_tables_of_another_version(root: Path, tmp_path: Path, refused_by) -> None:
    pyarrow = pytest.importorskip("pyarrow", reason="needs pyarrow: pip install 'lcf3d[fleet]'")
    tables = fused(root, tmp_path / "tables", form="parquet")
    (part,) = (tables / "provenance").iterdir()
    table = pyarrow.parquet.read_table(part)
    pyarrow.parquet.write_table(table.replace_schema_metadata({"lcf3d.schema": "2"}), part)
    expected = f"error: {part} has schema 2, this lcf3d reads 1: upgrade it, or write the run again"
    for command in (
        ("view", tables),
        ("eval", f"kitti:{root / 'kitti'}", tables),
        ("export", tables, "--to", "coco", "--out", tmp_path / "x.json"),
        ("serve", tables),
    ):
        assert refused_by(*command) == expected


def test_a_run_that_moved_away_from_its_dataset(root: Path, tmp_path: Path, refused_by) -> None:
    run = fused(root, tmp_path / "run")
    moved = run.rename(tmp_path / "elsewhere")
    data = json.loads((moved / "run.json").read_text())
    (moved / "run.json").write_text(json.dumps({**data, "dataset": f"kitti:{tmp_path / 'gone'}"}))
    gone = f"dataset folder {tmp_path / 'gone'} does not exist"
    for command in (("export", moved, "--to", "coco", "--out", tmp_path / "x.json"), ("serve", moved, "--port", 0)):
        assert refused_by(*command) == f"error: the dataset of this run is not there ({gone}); name it with --dataset"
    said = refused_by("view", moved)
    assert said.startswith(f"error: the dataset of this run is not there ({gone})")
    # named anew it is read
    again = ["export", moved, "--to", "coco", "--out", tmp_path / "x.json", "--dataset", f"kitti:{root / 'kitti'}"]
    assert CliRunner().invoke(app, [str(a) for a in again]).exit_code == 0
    assert len(json.loads((tmp_path / "x.json").read_text())["images"]) == 3


def test_a_port_in_use(root: Path, refused_by) -> None:
    pytest.importorskip("uvicorn", reason="needs uvicorn: pip install 'lcf3d[serve]'")
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        with redirect_stdout(StringIO()):
            said = refused_by("serve", root / "fused", "--port", port)
    assert said.startswith(f"error: port {port} of 127.0.0.1 cannot be used")


def test_exports_into_folders_are_refused(root: Path, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="is a folder; coco is one file"):
        export_run(root / "fused", open_dataset(f"kitti:{root / 'kitti'}"), "coco", tmp_path)
