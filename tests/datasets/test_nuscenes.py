import copy
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from lcf3d.datasets.nuscenes import NuscenesDataset, find_version, read_lidar
from lcf3d.datasets.nuscenes_annotations import annotation_velocities
from lcf3d.datasets.nuscenes_loading import load_tables
from lcf3d.datasets.nuscenes_results import NuscenesLidarResults
from lcf3d.datasets.nuscenes_splits import SPLITS, default_split, scenes_of_split
from lcf3d.errors import ConfigError, DatasetError, FormatError
from lcf3d.geometry.boxes import CORNER_SIGNS, points_in_boxes
from lcf3d.geometry.camera import project_boxes, project_points
from lcf3d.geometry.iou import image_iou
from lcf3d.geometry.rotation import rotation_matrices, transform_points
from lcf3d.structures import NUSCENES_CLASSES, Detections3D
from tests.datasets.nuscenes_world import SAMPLES, Tables, world_tables, write_world


@pytest.fixture(scope="module")
def world(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_world(tmp_path_factory.mktemp("nuscenes"), points=True)


def test_frames_are_samples_in_order_of_time(world: Path) -> None:
    dataset = NuscenesDataset(world)
    assert (dataset.version, dataset.ids, len(dataset)) == ("v1.0-mini", SAMPLES, 3)
    assert [frame.id for frame in dataset] == list(SAMPLES)
    assert [camera.name for camera in dataset[0].cameras] == ["CAM_FRONT"]
    assert NuscenesDataset(world, split="mini_val").ids == SAMPLES


def test_points_in_the_canonical_frame(world: Path) -> None:
    points = NuscenesDataset(world)[0].points
    assert points is not None
    assert points.dtype == np.float32
    np.testing.assert_allclose(points, [[7, 2, 0.5, 100], [0.2, -0.5, 0, 50]], atol=1e-6)


def test_labels_in_the_lidar_frame_by_hand(world: Path) -> None:
    labels = NuscenesDataset(world)[0].labels
    assert labels is not None
    # the rack and the dog are no detection classes
    assert [NUSCENES_CLASSES[label] for label in labels.labels] == ["car", "pedestrian", "bicycle"]
    # vehicle at (100, 50, 0), LiDAR 2 m up, level, axes along the global ones; width comes first in nuScenes
    np.testing.assert_allclose(labels.boxes[0], [20, 0, -1, 4, 2, 1.5, np.pi / 2], atol=1e-9)
    assert labels.velocities is not None
    assert labels.attributes is not None
    np.testing.assert_allclose(labels.velocities[0], [3, 4], atol=1e-6)
    assert np.isnan(labels.velocities[1]).all()
    assert labels.attributes.tolist() == ["vehicle.moving", "", ""]
    assert labels.scores.tolist() == [1, 1, 1]


def test_annotations_without_points_are_no_labels_unless_asked_for(world: Path) -> None:
    assert len(NuscenesDataset(world).labels("s1")) == 1
    assert len(NuscenesDataset(world, min_points=0).labels("s1")) == 2


def test_camera_projection_leads_through_both_ego_poses(world: Path) -> None:
    camera = NuscenesDataset(world)[0].camera("CAM_FRONT")
    # the camera was 0.4 m further back: 20 m ahead of the LiDAR are 20.4 m ahead of the camera
    pixels, depths = project_points(np.array([[20.0, 1.0, -1.0]]), camera)
    np.testing.assert_allclose(depths, [20.4], atol=1e-6)
    np.testing.assert_allclose(pixels, [[800 - 1000 / 20.4, 450 + 1000 / 20.4]], atol=1e-4)
    assert (camera.width, camera.height) == (1600, 900)


def test_sweeps_are_moved_by_the_ego_motion(world: Path) -> None:
    points = NuscenesDataset(world, sweeps=1).points("s1")
    # half a metre driven in 50 ms: the sweep's point is that much nearer; its return from the roof is left out
    np.testing.assert_allclose(
        points, [[7, 2, 0.5, 100, 0], [0.2, -0.5, 0, 50, 0], [6.5, 2, 0.5, 100, 0.05]], atol=1e-5
    )


def test_old_and_absent_sweeps_are_left_out(world: Path, tmp_path: Path) -> None:
    # before the sweep comes a key frame half a second old: more than ten times 0.1 s only for few sweeps
    assert len(NuscenesDataset(world, sweeps=2).points("s1")) == 3
    assert len(NuscenesDataset(world, sweeps=10).points("s1")) == 4
    root = write_world(tmp_path, points=True)
    (root / "samples/sweep.pcd.bin").unlink()
    assert len(NuscenesDataset(root, sweeps=1).points("s1")) == 2


def test_sensor_files_are_optional_and_read_late(tmp_path: Path) -> None:
    root = write_world(tmp_path)
    frame = NuscenesDataset(root)[0]
    assert frame.points is None
    assert len(frame.images) == 0
    (root / "samples").mkdir()
    (root / "samples/C0.jpg").write_bytes(b"no image")
    frame = NuscenesDataset(root)[0]
    assert list(frame.images) == ["CAM_FRONT"]
    with pytest.raises(FormatError, match="cannot be read as an image"):
        frame.images["CAM_FRONT"]
    Image.new("RGB", (1600, 900), (255, 0, 0)).save(root / "samples/C0.jpg")
    assert frame.images["CAM_FRONT"].shape == (900, 1600, 3)


def test_results_survive_the_way_to_the_lidar_frame_and_back(tmp_path: Path) -> None:
    tables = world_tables()
    tilted = rotation_quaternion(np.array([0.02, -0.03, 0.5]))
    for pose in tables["ego_pose"]:
        pose["rotation"] = tilted
    dataset = NuscenesDataset(write_world(tmp_path, tables))
    rng = np.random.default_rng(0)
    boxes = np.column_stack([rng.uniform(-50, 50, (9, 3)), rng.uniform(0.5, 5, (9, 3)), rng.uniform(-3, 3, 9)])
    velocities = rng.normal(size=(9, 2))
    given = Detections3D(boxes, np.linspace(0.9, 0.1, 9), np.arange(9), NUSCENES_CLASSES, velocities)
    path = tmp_path / "results.json"
    dataset.write_results(path, {"s1": given})
    found = dataset.read_results(path)
    assert [len(found[token]) for token in SAMPLES] == [0, 9, 0]
    np.testing.assert_allclose(found["s1"].boxes, boxes, atol=1e-9)
    np.testing.assert_allclose(found["s1"].velocities, velocities, atol=1e-12)
    np.testing.assert_array_equal(found["s1"].labels, given.labels)
    np.testing.assert_array_equal(found["s1"].scores, given.scores)


def rotation_quaternion(rotation_vector: np.ndarray) -> list[float]:
    angle = np.linalg.norm(rotation_vector)
    return [float(np.cos(angle / 2)), *(np.sin(angle / 2) * rotation_vector / angle).tolist()]


def test_image_files_lead_to_samples(world: Path) -> None:
    files = NuscenesDataset(world).image_files()
    assert files == {f"samples/C{i}.jpg": (f"s{i}", "CAM_FRONT") for i in range(3)}


def test_results_of_other_samples(world: Path, tmp_path: Path) -> None:
    dataset = NuscenesDataset(world)
    path = tmp_path / "results.json"
    with pytest.raises(FormatError, match="sample other"):
        dataset.write_results(path, {"other": Detections3D.empty(NUSCENES_CLASSES)})
    path.write_text('{"meta": {}, "results": {"s0": []}}')
    with pytest.raises(FormatError, match="lacks 2 of 3 samples, the first is s1"):
        dataset.lidar_results(path, NUSCENES_CLASSES).load(dataset.ids)


@pytest.mark.parametrize(("seconds", "known"), [(1.4, True), (1.6, False)])
def test_velocities_over_long_gaps_are_unknown(tmp_path: Path, seconds: float, known: bool) -> None:
    tables = world_tables()
    for i, sample in enumerate(tables["sample"]):
        sample["timestamp"] = round(i * seconds * 1e6)
    velocities = annotation_velocities(load_tables(write_world(tmp_path, tables), "v1.0-mini"))
    # the car's annotations: one-sided, central (twice the limit), one-sided
    np.testing.assert_array_equal(np.isfinite(velocities[:3, 0]), [known, known, known])
    if known:
        np.testing.assert_allclose(velocities[:3], np.tile([1.5 / seconds, 2 / seconds], (3, 1)))


def _tamper(table: str, row: int, **changes: object) -> Tables:
    tables = copy.deepcopy(world_tables())
    tables[table][row].update(changes)
    return tables


@pytest.mark.parametrize(
    ("tables", "complaint"),
    [
        (_tamper("sample_annotation", 1, sample_token="ghost"), "record car1 names sample 'ghost', which sample.json"),
        (_tamper("sample_annotation", 1, prev="ghost"), "record car1 names prev 'ghost'"),
        (_tamper("sample_annotation", 0, attribute_tokens=["ghost"]), "names attribute 'ghost'"),
        (_tamper("instance", 0, category_token="ghost"), "instance.json: record i-car names category 'ghost'"),
        (_tamper("sample_data", 0, ego_pose_token="ghost"), "record L0 names ego_pose 'ghost'"),
        (_tamper("sample_data", 0, calibrated_sensor_token="ghost"), "record L0 names calibrated_sensor 'ghost'"),
        (_tamper("sample_data", 1, prev="ghost"), "record sweep names prev 'ghost'"),
        (_tamper("calibrated_sensor", 0, sensor_token="ghost"), "record c-lidar names sensor 'ghost'"),
        (_tamper("sample", 0, scene_token="ghost"), "record s0 names scene 'ghost'"),
        (_tamper("sample", 1, token="s0"), "sample.json holds token s0 more than once"),
        (
            _tamper("ego_pose", 0, rotation=[2, 0, 0, 0]),
            "ego_pose.json: the rotation of record p-L0 has length 2, not 1",
        ),
        (_tamper("calibrated_sensor", 1, rotation=[0, 0, 0, 0]), "record c-front has length 0"),
        (_tamper("sample_annotation", 0, rotation=[0.9, 0, 0, 0]), "record car0 has length 0.9"),
        (_tamper("sample_data", 2, is_key_frame=False), "sample s1 has no LIDAR_TOP key frame"),
        (_tamper("calibrated_sensor", 1, camera_intrinsic=[]), "image C0 has no camera_intrinsic"),
        (_tamper("sample_annotation", 0, size=[1, 0, 1]), "the size of record car0 is not positive"),
        (
            _tamper("sample_annotation", 0, attribute_tokens=["a-moving", "a-moving"]),
            "record car0 has several attributes",
        ),
        (_tamper("sample_annotation", 0, size=[1, 2]), "'size' of a record cannot be read"),
        (_tamper("sample", 0, timestamp="noon"), "'timestamp' of a record cannot be read"),
        (_tamper("ego_pose", 0, translation=[0, float("nan"), 0]), "'translation' of a record holds NaN"),
        (_tamper("ego_pose", 0, token=["p"]), "ego_pose.json: a record's token is not text"),
        ({**world_tables(), "calibrated_sensor": []}, "calibrated_sensor.json is empty"),
        (_tamper("sample", 0, timestamp=10**400), "'timestamp' of a record cannot be read"),
        ({**world_tables(), "ego_pose": [{}]}, "ego_pose.json: a record has no 'token'"),
        ({**world_tables(), "sample": [{"token": "s0"}]}, "a record has no 'timestamp'"),
        ({**world_tables(), "sample_data": [{"token": "s0"}]}, "a record has no 'calibrated_sensor_token'"),
    ],
)
def test_inconsistent_tables_are_refused(tmp_path: Path, tables: Tables, complaint: str) -> None:
    with pytest.raises(DatasetError) as error:
        load_tables(write_world(tmp_path, tables), "v1.0-mini")
    assert complaint in str(error.value)
    assert "\n" not in str(error.value)


def test_missing_tables(tmp_path: Path) -> None:
    with pytest.raises(DatasetError, match="there are none"):
        find_version(tmp_path)
    with pytest.raises(DatasetError, match="is not a folder of nuScenes tables"):
        load_tables(tmp_path, "v1.0-test")
    root = write_world(tmp_path)
    (root / "v1.0-mini/ego_pose.json").unlink()
    with pytest.raises(DatasetError, match=r"ego_pose\.json is missing"):
        load_tables(root, "v1.0-mini")


def test_tables_without_annotations_give_frames_without_labels(tmp_path: Path) -> None:
    frame = NuscenesDataset(write_world(tmp_path, {**world_tables(), "sample_annotation": [], "instance": []}))[0]
    assert frame.labels is None


def test_late_cameras(world: Path) -> None:
    with pytest.raises(DatasetError, match=r"sample s0: CAM_FRONT is 0\.040 s away from the LiDAR sweep"):
        NuscenesDataset(world, max_camera_delay_s=0.03)[0]
    assert NuscenesDataset(world, max_camera_delay_s=0.03, late_cameras="drop")[0].cameras == ()
    with pytest.raises(ConfigError, match="late_cameras"):
        NuscenesDataset(world, late_cameras="ignore")  # type: ignore[arg-type]


def test_lidar_files(tmp_path: Path) -> None:
    path = tmp_path / "scan.pcd.bin"
    np.array([[1, 2, 3, 4, 5], [np.nan, 2, 3, 4, 5]], dtype="<f4").tofile(path)
    np.testing.assert_array_equal(read_lidar(path), [[2, -1, 3, 4]])
    path.write_bytes(path.read_bytes()[:-1])
    with pytest.raises(FormatError, match="cut off"):
        read_lidar(path)
    with pytest.raises(DatasetError, match="does not exist"):
        read_lidar(tmp_path / "none")


def test_splits(world: Path, tmp_path: Path) -> None:
    sizes = {split: len(scenes_of_split(split)) for split in SPLITS}
    assert sizes == {"mini_train": 8, "mini_val": 2, "train": 700, "val": 150, "test": 150}
    everything = scenes_of_split("train") | scenes_of_split("val") | scenes_of_split("test")
    assert len(everything) == 1000
    assert scenes_of_split("mini_train") | scenes_of_split("mini_val") <= scenes_of_split("train") | scenes_of_split(
        "val"
    )
    assert scenes_of_split("mini_val") == {"scene-0103", "scene-0916"}
    assert default_split("v1.0-trainval") == "val"
    assert default_split("mine") is None
    names = tmp_path / "scenes.txt"
    names.write_text("scene-0103\n\nscene-9999\n")
    assert NuscenesDataset(world, split=str(names)).ids == SAMPLES
    names.write_bytes(b"\xff\xfe")
    with pytest.raises(DatasetError, match="not a text file"):
        scenes_of_split(str(names))
    with pytest.raises(DatasetError, match="neither one of mini_train"):
        scenes_of_split("validation")
    with pytest.raises(DatasetError, match="holds no sample of split 'train'"):
        NuscenesDataset(world, split="train")


@pytest.mark.real
def test_projection_of_the_devkit(shared: Path) -> None:
    """Corners of the annotated boxes land where the reference export puts them, through our chain of transforms."""
    import json

    dataset = NuscenesDataset(shared / "data/nuscenes", split="mini_val", min_points=0)
    golden = json.loads((shared / "golden/nuscenes_eval/projected_boxes_mono3d.json").read_text())
    annotations = dataset.tables.annotations
    row_of = {token.decode(): i for i, token in enumerate(annotations.tokens.tolist())}
    frames = {frame.id: frame for frame in dataset}
    compared, overlaps = 0, []
    for record in golden:
        row, frame = row_of[record["annotation_token"]], frames[record["sample_token"]]
        camera = frame.camera(record["camera"])
        local = CORNER_SIGNS * annotations.sizes[row, [1, 0, 2]] / 2
        corners = local @ rotation_matrices(annotations.rotations[[row]])[0].T + annotations.translations[row]
        pixels, _ = project_points(transform_points(corners, dataset.lidar_from_global(frame.id)), camera)
        # the export clips the hull to the image, we the rectangle: the same for boxes wholly in it
        if not ((pixels >= 0) & (pixels <= [1600, 900])).all():
            continue
        x, y, width, height = record["bbox"]
        expected = np.array([[x, y, x + width, y + height]])
        np.testing.assert_allclose([[*pixels.min(0), *pixels.max(0)]], expected, atol=1e-6)
        compared += 1
        center = dataset.lidar_from_global(frame.id) @ [*annotations.translations[row], 1]
        boxes = dataset.labels(frame.id).boxes
        nearest = boxes[[np.argmin(np.linalg.norm(boxes[:, :3] - center[:3], axis=1))]]
        overlaps.append(image_iou(project_boxes(nearest, camera)[0], expected)[0, 0])
    assert compared > 2000
    # what an upright box in the LiDAR frame cannot show: the tilt of the vehicle and of the sensor's mounting
    assert np.median(overlaps) > 0.93
    assert np.min(overlaps) > 0.8


@pytest.mark.real
def test_the_complete_frame(shared: Path) -> None:
    dataset = NuscenesDataset(shared / "data/nuscenes", split="mini_train")
    frame = dataset[0]
    assert frame.points is not None
    assert frame.labels is not None
    assert {image.shape for image in frame.images.values()} == {(900, 1600, 3)}
    assert len(frame.images) == 6
    annotations = dataset.annotations(frame.id)
    counted = points_in_boxes(frame.points, frame.labels.boxes).sum(axis=1)
    stated = annotations.point_counts[annotations.point_counts >= 1]
    # those stated include radar points, and our boxes stand upright in the LiDAR frame
    assert np.corrcoef(counted, stated)[0, 1] > 0.999


@pytest.mark.parametrize(("second", "known"), [([0.0, 0.0], False), ([0.0, 0.1], True)])
def test_a_file_of_velocities_that_are_all_zero_knows_none(world: Path, second: list[float], known: bool) -> None:
    box = np.array([[10, 0, 0, 4, 2, 1.5, 0.0]])
    label = [NUSCENES_CLASSES.index("car")]
    frames = {
        token: Detections3D(box, [0.9], label, NUSCENES_CLASSES, velocities=np.array([velocity]))
        for token, velocity in zip(SAMPLES, ([0.0, 0.0], second, [0.0, 0.0]), strict=True)
    }
    source = NuscenesLidarResults(Path("results.json"), frames, NUSCENES_CLASSES)
    found = [source.detect(frame).velocities for frame in NuscenesDataset(world)]
    assert [velocity is not None for velocity in found] == [known] * 3


@pytest.mark.real
def test_real_results_survive_the_way_to_the_lidar_frame_and_back(shared: Path, tmp_path: Path) -> None:
    dataset = NuscenesDataset(shared / "data/nuscenes", split="mini_val")
    first = dataset.read_results(shared / "data/nuscenes/results/perturbed_gt.json")
    dataset.write_results(tmp_path / "again.json", first)
    again = dataset.read_results(tmp_path / "again.json")
    for token in dataset.ids:
        order = np.argsort(-first[token].scores, kind="stable")
        np.testing.assert_allclose(again[token].boxes, first[token].boxes[order], atol=1e-9)
        np.testing.assert_allclose(again[token].velocities, first[token][order].velocities, atol=1e-9)
        assert again[token].attributes is not None
