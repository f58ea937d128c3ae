"""Statistics and targets on the device against those of the detector and of hand-made scenes."""

import numpy as np
import pytest

torch = pytest.importorskip("torch")

from lcf3d.detectors.lidar.presets import COMPACT_KITTI  # noqa: E402
from lcf3d.detectors.lidar.statistics import pillar_statistics  # noqa: E402
from lcf3d.training.lidar_tensors import statistics_of, targets_of  # noqa: E402


def scan(seed, count=4000):
    rng = np.random.default_rng(seed)
    points = rng.uniform((-5, -45, -4, 0), (75, 45, 2, 1), (count, 4))
    points[: count // 2, :2] = rng.normal((20, 3), 1.5, (count // 2, 2))
    return points.astype(np.float32)


def test_statistics_equal_those_of_the_detector():
    scans = [scan(0), scan(1)]
    points = torch.from_numpy(np.concatenate(scans))
    number = torch.tensor([0] * len(scans[0]) + [1] * len(scans[1]))
    table, cells = statistics_of(points, number, 2, COMPACT_KITTI.voxels)
    size = COMPACT_KITTI.voxels.grid[0] * COMPACT_KITTI.voxels.grid[1]
    parts = [pillar_statistics(s, COMPACT_KITTI.voxels) for s in scans]
    wanted = np.concatenate([part for part, _ in parts])
    places = np.concatenate([part + k * size for k, (_, part) in enumerate(parts)])
    order = np.argsort(places)
    np.testing.assert_array_equal(cells.numpy(), places[order])
    # a point on the border of a quarter may round to either side
    assert (np.abs(table.numpy() - wanted[order]) > 2e-3).mean() < 5e-4


def test_targets_equal_those_of_a_single_scan():
    from lcf3d.training.lidar_targets import center_targets

    boxes = np.array(
        [
            [20, 0, -1, 4, 1.8, 1.5, 0.3],
            [20.9, 1.5, -1, 0.8, 0.6, 1.7, 1],
            [50, -20, -1, 10, 2.5, 3, 2],
            [90, 0, 0, 4, 2, 2, 0.0],
        ]
    )
    labels = np.array([0, 1, -2, 0])
    single = center_targets(boxes, labels, COMPACT_KITTI)
    padded = np.zeros((2, 6, 7))
    padded[1, 1:5] = boxes
    names = np.full((2, 6), -3)
    names[1, 1:5] = labels
    both = targets_of(torch.from_numpy(padded).float(), torch.from_numpy(names), COMPACT_KITTI)
    np.testing.assert_allclose(both["heat"][1].numpy(), single.heat, atol=1e-5)
    assert float(both["heat"][0].max()) == 0
    np.testing.assert_array_equal(both["counted"][1].numpy(), single.counted)
    assert float(both["counted"][0].min()) == 1
    order = np.argsort(both["cells"].numpy())
    np.testing.assert_array_equal(both["cells"].numpy()[order], single.cells + single.counted.size)
    np.testing.assert_allclose(both["boxes"].numpy()[order], single.boxes, atol=1e-4)


def test_no_objects_give_empty_targets():
    nothing = targets_of(torch.zeros(1, 3, 7), torch.full((1, 3), -3), COMPACT_KITTI)
    assert len(nothing["cells"]) == 0
    assert float(nothing["heat"].sum()) == 0
