import time

import pytest

pytest.importorskip("torch")

import numpy as np

from lcf3d.errors import FormatError
from lcf3d.structures import KITTI_CLASSES
from lcf3d.training.arriving import Arrivals, ArrivingLidar, is_held_out, localizer_of
from tests.training.lidar_scenes import CONFIG, scene


def prepare(path):
    if path.stem == "000001":
        raise FormatError("torn")
    return int(path.stem)


def wait_for(arrivals, wanted):
    found, until = [], time.time() + 10
    while len(found) < wanted and time.time() < until:
        found += arrivals.take()
        time.sleep(0.05)
    return found


def test_samples_come_once_each_without_the_held_out_and_the_torn_ones(tmp_path):
    reported = []
    arrivals = Arrivals(tmp_path, prepare, reported.append)
    for number in (0, 1, 2, 15):
        (tmp_path / f"{number:06d}.npz").touch()
    (tmp_path / ".000003.npz").touch()
    assert wait_for(arrivals, 2) == [0, 2]
    (tmp_path / "000004.npz").touch()
    assert wait_for(arrivals, 1) == [4]
    assert arrivals.take() == []
    assert [path.stem for path in arrivals.held_out()] == ["000015"]
    assert len(reported) == 1
    assert "000001.npz is passed over: torn" in reported[0]


def test_one_in_sixteen_is_held_out(tmp_path):
    assert [n for n in range(40) if is_held_out(tmp_path / f"{n:06d}.npz")] == [15, 31]


@pytest.fixture
def scans(tmp_path):
    for number in (0, 1, 2, 15):
        scan = scene(number)
        names = np.array(KITTI_CLASSES)[scan.labels]
        path = tmp_path / f"{number:06d}.npz"
        np.savez(path, points=scan.points, boxes=scan.boxes, names=names, points_on=scan.counts)
    return tmp_path


def test_scans_that_arrive_are_learned_from(scans):
    task = ArrivingLidar(scans, CONFIG, "cpu", batch_size=2)
    until = time.time() + 20
    while task.refresh() < 3 and time.time() < until:
        time.sleep(0.05)
    assert task.refresh() == 3
    terms = task.loss(task.network().train(), 0)
    assert {"heat", "place", "size"} <= set(terms)
    assert all(np.isfinite(float(value.detach())) for value in terms.values())


def test_frustums_of_a_sample_carry_the_localizers_classes(scans):
    task = localizer_of("kitti", scans, 4)
    frustums = task.frustums(scans / "000000.npz", 1)
    assert {f.label for f in frustums if not f.empty} <= {0, 1, 2}
