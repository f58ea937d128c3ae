import sys

import numpy as np
import pytest

from lcf3d.errors import DatasetError, MissingExtraError
from lcf3d.simulation import benchmark, get_preset, simulate_frame
from lcf3d.simulation.comparison import (
    RANGE_EDGES,
    compare,
    height_shares,
    label_statistics,
    median_points,
    scan_statistics,
)
from lcf3d.simulation.sizes import KITTI_SIZES

from .conftest import tiny


def write_kitti(root, scans, labels):
    """A KITTI-layout folder from lists of points and of label lines."""
    for name in ("velodyne", "label_2", "calib"):
        (root / "training" / name).mkdir(parents=True)
    identity = "1 0 0 0 0 1 0 0 0 0 1 0"
    axes = "0 -1 0 0 0 0 -1 0 1 0 0 0"
    for k, (points, lines) in enumerate(zip(scans, labels, strict=True)):
        np.array(points, dtype="<f4").tofile(root / "training" / "velodyne" / f"{k:06d}.bin")
        (root / "training" / "label_2" / f"{k:06d}.txt").write_text("".join(line + "\n" for line in lines))
        text = f"P2: {identity}\nR0_rect: 1 0 0 0 1 0 0 0 1\nTr_velo_to_cam: {axes}\n"
        (root / "training" / "calib" / f"{k:06d}.txt").write_text(text)


def test_statistics_by_hand(tmp_path):
    # a car 10 m ahead, 4 m long and 2 m wide and high, that holds two of three points
    car = "Car 0 0 0 10 10 20 20 2 2 4 0 1 10 -1.5708"
    hidden = "Car 0 2 0 10 10 20 20 2 2 4 0 1 30 -1.5708"
    points = [[9, 0, 0, 0.2], [11, 0.5, 0.5, 0.9], [3.5, 0, 0, 0.0]]
    write_kitti(tmp_path, [points, points[:1]], [[car, hidden], []])
    scans, labels = scan_statistics(tmp_path), label_statistics(tmp_path)
    assert scans.counts.tolist() == [3, 1]
    shares = dict(zip(RANGE_EDGES[:-1].tolist(), scans.ranges[0].tolist(), strict=True))
    assert shares[3.0] == pytest.approx(1 / 3)
    assert shares[8.0] == pytest.approx(1 / 3)
    assert shares[10.0] == pytest.approx(1 / 3)
    np.testing.assert_allclose(scans.objects["Car"], [[10, 2]], atol=1e-3)
    assert labels.per_frame["Car"] == 1.0
    assert labels.frames_with["Car"] == 0.5
    assert labels.occlusion["Car"].tolist() == [0.5, 0, 0.5, 0]
    np.testing.assert_allclose(labels.sizes["Car"], [[4, 2, 2], [4, 2, 2]])
    np.testing.assert_allclose(sorted(labels.distances["Car"]), [10, 30])
    assert labels.heights["Car"].tolist() == [10, 10]
    assert height_shares(labels)["Car"].tolist() == [1, 0, 0, 0]  # lower than 25 pixels


def test_median_points_need_two_objects_in_a_class():
    result = median_points(np.array([[6.0, 100], [7.0, 300], [12.0, 50]]))
    assert result[0] == 200
    assert np.isnan(result[1:]).all()


def test_compare_draws_a_figure_and_gives_numbers(tmp_path):
    rng = np.random.default_rng(0)
    cloud = np.concatenate([rng.normal(size=(50, 3)) * 10, rng.random((50, 1))], axis=1)
    car = "Car 0 0 0 10 10 20 20 2 2 4 0 1 10 -1.5708"
    write_kitti(tmp_path / "a", [cloud, cloud], [[car], [car]])
    result = compare(tmp_path / "a", tmp_path / "a", tmp_path / "figure.png")
    assert result["real"] == result["simulated"]
    assert result["range_classes_within_two_deviations"] == f"{len(RANGE_EDGES) - 1} of {len(RANGE_EDGES) - 1}"
    assert (tmp_path / "figure.png").stat().st_size > 10_000


def test_a_folder_without_scans_and_a_missing_package_are_refused(tmp_path, monkeypatch):
    write_kitti(tmp_path, [[[1, 2, 3, 0]]], [[]])
    monkeypatch.setitem(sys.modules, "matplotlib.figure", None)
    with pytest.raises(MissingExtraError, match=r"lcf3d\[simulate\]"):
        compare(tmp_path, tmp_path, tmp_path / "figure.png")
    (tmp_path / "training" / "velodyne" / "000000.bin").unlink()
    with pytest.raises(DatasetError, match="holds no scans"):
        scan_statistics(tmp_path)


def test_the_benchmark_times_every_stage():
    times = benchmark(1, tiny("kitti64"))
    assert set(times) == {"scene", "stage", "lidar", "camera", "frame"}
    assert all(t > 0 for t in times.values())
    assert times["frame"] > times["camera"]


@pytest.mark.real
def test_scans_have_the_points_and_ranges_of_real_ones(shared):
    real = scan_statistics(shared / "data" / "kitti")
    preset = get_preset("kitti64")
    counts, ranges = [], []
    for k in range(5):
        points = simulate_frame(preset, 11, k, images=False).scan.points
        counts.append(len(points))
        ranges.append(np.histogram(np.linalg.norm(points[:, :3], axis=1), RANGE_EDGES)[0] / len(points))
    assert real.counts.min() < np.mean(counts) < real.counts.max()
    gap = np.abs(np.mean(ranges, axis=0) - real.ranges.mean(axis=0))
    assert (gap < 2 * real.ranges.std(axis=0) + 0.01).all()


@pytest.mark.real
def test_the_size_table_is_that_of_the_training_labels(shared):
    ids = (shared / "data" / "kitti" / "ImageSets" / "train_labels.txt").read_text().split()
    sizes = label_statistics(shared / "data" / "kitti", ids).sizes
    for name, (mean, deviation) in KITTI_SIZES.items():
        np.testing.assert_allclose(sizes[name].mean(axis=0), mean, atol=0.002)
        np.testing.assert_allclose(sizes[name].std(axis=0), deviation, atol=0.002)
