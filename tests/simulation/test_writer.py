import errno
import json
from dataclasses import replace

import numpy as np
import pytest
from PIL import Image
from scipy.spatial import cKDTree

from lcf3d.datasets.kitti import KittiDataset
from lcf3d.datasets.kitti_check import check_kitti
from lcf3d.datasets.nuscenes import NuscenesDataset
from lcf3d.datasets.nuscenes_check import check_nuscenes
from lcf3d.errors import ConfigError, DatasetError, MissingExtraError
from lcf3d.formats.kitti import read_objects
from lcf3d.geometry.boxes import points_in_boxes
from lcf3d.geometry.camera import project_points
from lcf3d.simulation import kitti_layout, writer
from lcf3d.simulation import presets as presets_module
from lcf3d.simulation.frames import simulate_drive
from lcf3d.simulation.presets import get_preset
from lcf3d.simulation.writer import Recipe, write_dataset

from .conftest import shrink_presets, tiny


def contents(root):
    return {p.relative_to(root).as_posix(): p.read_bytes() for p in sorted(root.rglob("*")) if p.is_file()}


RECIPE = Recipe("kitti64", 5, seed=1, sequence=True, street="residential")


@pytest.fixture(scope="session")
def kitti(tmp_path_factory):
    """A drive of five small frames, written once."""
    root = tmp_path_factory.mktemp("simulated") / "kitti"
    with pytest.MonkeyPatch.context() as patch:
        shrink_presets(patch)
        write_dataset(RECIPE, root)
    return root


def test_the_kitti_reader_finds_what_was_simulated(kitti, tiny_presets):
    dataset = KittiDataset(kitti, image_size=(248, 75))
    assert dataset.ids == tuple(f"0000_{k:06d}" for k in range(5))
    for index in (0, 4):
        frame = dataset[index]
        expected = next(simulate_drive("kitti64", 1, 5, street="residential", first=index))
        np.testing.assert_array_equal(frame.points, expected.scan.points)
        np.testing.assert_array_equal(frame.images["right"], expected.renders["right"].image)
        np.testing.assert_allclose(frame.labels.boxes, expected.labels.boxes, atol=2e-3)
        for mine, theirs in zip(frame.cameras, expected.preset.cameras, strict=True):
            np.testing.assert_allclose(mine.pixels_from_lidar, theirs.pixels_from_lidar, atol=1e-6)


def test_a_drive_tells_when_and_from_where_it_was_seen(kitti, tiny_presets):
    frames = list(KittiDataset(kitti, image_size=(248, 75)))
    assert [(frame.sequence, round(frame.timestamp, 6)) for frame in frames] == [("0000", k / 10) for k in range(5)]
    expected = [frame.world_from_lidar for frame in simulate_drive("kitti64", 1, 5, street="residential", images=False)]
    first_from_last = np.linalg.inv(frames[0].world_from_lidar) @ frames[4].world_from_lidar
    np.testing.assert_allclose(first_from_last, np.linalg.inv(expected[0]) @ expected[4], atol=1e-6)
    assert np.linalg.norm(first_from_last[:3, 3]) > 0.5


def test_instance_ids_and_tracks_belong_to_the_label_lines(kitti):
    for k in range(5):
        objects = read_objects(kitti / "training" / "label_2" / f"0000_{k:06d}.txt", results=False)
        tracks = [int(t) for t in (kitti / "training" / "tracks" / f"0000_{k:06d}.txt").read_text().split()]
        ids = np.array(Image.open(kitti / "training" / "instance_2" / f"0000_{k:06d}.png"))
        assert ids.dtype == np.uint16
        assert len(tracks) == len(objects)
        for track, box in zip(tracks, objects.boxes2d, strict=True):
            rows, columns = np.nonzero(ids == track)
            bounds = np.array([columns.min(), rows.min(), columns.max() + 1, rows.max() + 1])
            assert (box[:2] <= bounds[:2] + 1.01).all()  # the box bounds the whole object, the mask what is seen of it
            assert (box[2:] >= bounds[2:] - 1.01).all()


def test_the_splits_share_no_frame(kitti):
    train, val = ((kitti / "ImageSets" / f"{s}.txt").read_text().split() for s in ("train", "val"))
    assert sorted(train + val) == [f"0000_{k:06d}" for k in range(5)]
    assert val == ["0000_000004"]


def test_whole_drives_belong_to_one_split(tmp_path):
    ids = [f"{k:06d}" for k in range(50)]
    kitti_layout.write_splits(tmp_path, ids, 10)
    assert (tmp_path / "ImageSets" / "val.txt").read_text().split() == ids[40:]


@pytest.mark.parametrize(
    ("frames", "drive", "train", "val"),
    [(1, 1, [0], [0]), (2, 1, [0], [1]), (4, 1, [0, 1, 2], [3]), (4, 4, [0, 1, 2], [3]), (3, 2, [0, 1], [2])],
)
def test_small_sets_leave_no_list_empty(tmp_path, frames, drive, train, val):
    kitti_layout.write_splits(tmp_path, [str(k) for k in range(frames)], drive)
    read = [(tmp_path / "ImageSets" / f"{name}.txt").read_text().split() for name in ("train", "val")]
    assert read == [[str(k) for k in train], [str(k) for k in val]]


def test_the_sanity_rules_hold_at_full_size(tmp_path):
    write_dataset(Recipe("kitti64", 1, seed=4, street="city"), tmp_path / "k")
    assert check_kitti(KittiDataset(tmp_path / "k")) == []


def test_nuscenes_reader_finds_what_was_simulated(tmp_path, tiny_presets):
    root = tmp_path / "nuscenes"
    recipe = Recipe("nuscenes32", 2, seed=2, sequence=True, street="residential")
    assert write_dataset(recipe, root) == ["0000_0000", "0000_0001"]
    assert check_nuscenes(root) == []
    assert (root / "train.txt").read_text() == (root / "val.txt").read_text() != ""  # the only drive is in both
    dataset = NuscenesDataset(root)
    simulated = list(simulate_drive("nuscenes32", 2, 2, street="residential"))
    for frame, expected in zip(dataset, simulated, strict=True):
        np.testing.assert_allclose(frame.points[:, :3], expected.scan.points[:, :3], atol=1e-4)
        assert frame.points[:, 3].max() > 1
        ours = expected.labels
        assert len(frame.labels) == len(ours)
        order = [np.abs(ours.boxes[:, :3] - box[:3]).sum(axis=1).argmin() for box in frame.labels.boxes]
        np.testing.assert_allclose(frame.labels.boxes[:, :6], ours.boxes[order][:, :6], atol=1e-3)
        turn = frame.labels.boxes[:, 6] - ours.boxes[order][:, 6]
        np.testing.assert_allclose(np.cos(turn), 1, atol=1e-6)
        assert frame.labels.labels.tolist() == ours.labels[order].tolist()
        assert frame.labels.attributes.tolist() == ours.attributes[order].tolist()
        known = np.isfinite(frame.labels.velocities).all(axis=1)  # an object seen once has no difference to take
        assert known.mean() > 0.5
        np.testing.assert_allclose(frame.labels.velocities[known], ours.velocities[order][known], atol=0.25)
        theirs = {camera.name: camera for camera in expected.preset.cameras}
        for mine in frame.cameras:
            np.testing.assert_allclose(
                mine.pixels_from_lidar, theirs[mine.name].pixels_from_lidar, rtol=1e-6, atol=1e-3
            )
    annotations = json.loads((root / "v1.0-simulated" / "sample_annotation.json").read_text())
    inside = points_in_boxes(simulated[0].scan.points, simulated[0].boxes).sum(axis=1)
    first = [a["num_lidar_pts"] for a in annotations if a["sample_token"] == dataset.ids[0]]
    assert sorted(first) == sorted(n for n in inside.tolist() if n)[-len(first) :] or set(first) <= set(inside.tolist())
    assert {a["visibility_token"] for a in annotations} <= {"1", "2", "3", "4"}


def test_a_folder_that_is_not_empty_is_refused(tmp_path, tiny_presets):
    (tmp_path / "note.txt").write_text("mine")
    with pytest.raises(ConfigError, match="is not empty"):
        write_dataset(Recipe("kitti64", 1), tmp_path)
    with pytest.raises(ConfigError, match=r"holds no simulation\.json"):
        write_dataset(Recipe("kitti64", 1), tmp_path, resume=True)
    with pytest.raises(ConfigError, match="is a file"):
        write_dataset(Recipe("kitti64", 1), tmp_path / "note.txt")
    assert contents(tmp_path) == {"note.txt": b"mine"}


def test_resume_refuses_other_settings(kitti, tiny_presets):
    with pytest.raises(ConfigError, match="other settings"):
        write_dataset(replace(RECIPE, seed=2), kitti, resume=True)


def test_an_interrupted_run_goes_on_to_the_same_bytes(tmp_path, kitti, tiny_presets, monkeypatch):
    recipe, root = RECIPE, tmp_path / "cut"
    original, written = kitti_layout.write_png, []

    def interrupted(path, image):
        if len(written) == 8:
            raise KeyboardInterrupt
        written.append(path)
        original(path, image)

    monkeypatch.setattr(kitti_layout, "write_png", interrupted)
    with pytest.raises(KeyboardInterrupt):
        write_dataset(recipe, root)
    monkeypatch.setattr(kitti_layout, "write_png", original)
    assert not list(root.rglob("*.tmp*"))
    steps = []
    write_dataset(recipe, root, resume=True, progress=steps.append)
    assert steps[0] == 2  # two frames were whole
    assert sum(steps) == 5
    assert contents(root) == contents(kitti)


def test_a_full_disk_leaves_only_whole_files(tmp_path, tiny_presets, monkeypatch):
    def full(path, image):
        raise OSError(errno.ENOSPC, "No space left on device")

    root = tmp_path / "full"
    with monkeypatch.context() as patch:
        patch.setattr(kitti_layout, "write_png", full)
        with pytest.raises(DatasetError, match="No space left on device"):
            write_dataset(Recipe("kitti64", 1), root)
    assert not kitti_layout.is_complete(root, "000000")
    assert not list(root.rglob("*.tmp*"))
    write_dataset(Recipe("kitti64", 1), root, resume=True)
    assert kitti_layout.is_complete(root, "000000")


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"preset": "kitti", "frames": 1}, "unknown preset 'kitti'"),
        ({"preset": "kitti64", "frames": 0}, "frames must be 1 or more"),
        ({"preset": "kitti64", "frames": 1, "street": "x"}, "unknown street 'x'"),
    ],
)
def test_bad_recipes_are_refused(settings, message):
    with pytest.raises(ConfigError, match=message):
        Recipe(**settings)


def test_bad_jobs_and_a_missing_package_are_refused(tmp_path, monkeypatch):
    with pytest.raises(ConfigError, match="jobs must be 1 or more"):
        write_dataset(Recipe("kitti64", 1), tmp_path / "a", jobs=0)
    monkeypatch.setattr(writer, "find_spec", lambda _: None)
    with pytest.raises(MissingExtraError, match=r"lcf3d\[simulate\]"):
        write_dataset(Recipe("kitti64", 1), tmp_path / "a")
    assert not (tmp_path / "a").exists()


def test_long_sequences_are_cut_into_drives():
    recipe = Recipe("nuscenes32", 90, sequence=True)
    assert recipe.drive_frames == 40
    assert recipe.place(85) == (2, 5)
    assert recipe.frames_of(2) == 10
    assert recipe.id(85) == "0002_0005"
    assert Recipe("kitti64", 90, sequence=True).id(85) == "0002_000005"
    assert Recipe("kitti64", 3).id(2) == "000002"


def test_the_command_writes_a_data_set_and_refuses_bad_input(tmp_path, tiny_presets):
    from typer.testing import CliRunner

    from lcf3d.cli.app import app

    runner = CliRunner()
    result = runner.invoke(app, ["simulate", str(tmp_path / "out"), "--frames", "1", "--preset", "sparse16"])
    assert result.exit_code == 0, result.output
    assert (tmp_path / "out" / "training" / "label_2" / "000000.txt").exists()
    again = runner.invoke(app, ["simulate", str(tmp_path / "out"), "--frames", "1", "--preset", "sparse16"])
    assert isinstance(again.exception, ConfigError)


def test_a_data_set_of_one_camera_is_complete_without_the_other(tmp_path):
    recipe = Recipe("mono64", 1, seed=3)
    write_dataset(recipe, tmp_path)
    folders = {path.name for path in (tmp_path / "training").iterdir()}
    assert folders == {"calib", "velodyne", "image_2", "instance_2", "tracks", "label_2"}
    counts: list[int] = []
    write_dataset(recipe, tmp_path, resume=True, progress=counts.append)
    assert counts == [1], "nothing is left to do"


def test_sweeps_and_cameras_with_their_own_times_are_read_back(tmp_path, tiny_presets, monkeypatch):
    preset = replace(get_preset("nuscenes_sweeps"), sweeps=2)
    monkeypatch.setattr(presets_module, "all_presets", lambda: {preset.name: preset})
    write_dataset(Recipe(preset.name, 2, seed=2, sequence=True, street="city"), tmp_path)
    assert check_nuscenes(tmp_path) == []
    assert len(list((tmp_path / "sweeps" / "LIDAR_TOP").iterdir())) == 2
    rows = json.loads((tmp_path / "v1.0-simulated" / "sample_data.json").read_text())
    lidar = [row for row in rows if row["fileformat"] == "pcd"]
    assert [row["is_key_frame"] for row in lidar] == [True, False, False, True]
    assert np.diff([row["timestamp"] for row in lidar]).tolist() == [400_000, 50_000, 50_000]
    assert [row["next"] for row in lidar] == [*(row["token"] for row in lidar[1:]), ""]
    last = list(simulate_drive(preset, 2, 2, street="city"))[1]
    frame = NuscenesDataset(tmp_path, sweeps=2)[1]
    ages = np.unique(frame.points[:, 4].round(3))
    np.testing.assert_allclose(ages, [0, 0.05, 0.1], atol=1e-3)
    # what stands still is where the key frame has it, although the car has moved by up to two metres
    still = last.scan.points[(last.scan.owner == 0) & (np.abs(last.scan.points[:, 2] + 1.84) > 1.0), :3]
    old = frame.points[np.abs(frame.points[:, 4] - 0.1) < 0.01, :3]
    near = cKDTree(still).query(old[np.abs(old[:, 2] + 1.84) > 1.0])[0]
    assert np.median(near) < 0.35
    expected = {camera.name: camera for camera in last.cameras}
    assert any(preset.camera_delays_s)
    for camera in frame.cameras:
        wanted = expected[camera.name].pixels_from_lidar
        np.testing.assert_allclose(camera.pixels_from_lidar, wanted, rtol=1e-5, atol=0.05)


def test_a_camera_that_fires_late_sees_still_things_where_its_own_pose_says():
    preset = replace(tiny("nuscenes32"), camera_delays_s=(0.0, 0.0, 0.0, 0.2, 0.0, 0.0))
    late = list(simulate_drive(preset, 2, 2, street="residential"))[1]
    assert late.scene.ego.speed > 1
    camera = late.cameras[3]
    moved = camera.camera_from_lidar @ np.linalg.inv(preset.cameras[3].camera_from_lidar)
    assert np.linalg.norm(moved[:3, 3]) == pytest.approx(0.2 * late.scene.ego.speed, rel=0.05)
    pixels, depth = project_points(late.scan.points[late.scan.owner == 0], camera)
    u, v = np.floor(np.nan_to_num(pixels, nan=-1)).astype(int).T
    inside = (depth > 2) & (u >= 0) & (u < camera.width) & (v >= 0) & (v < camera.height)
    seen = late.renders[camera.name].depth[v[inside], u[inside]]
    assert (np.abs(seen - depth[inside]) < 0.05 * depth[inside]).mean() > 0.7
