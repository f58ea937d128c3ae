"""``lcf3d train lidar`` from samples to an ONNX file, and the figures of a detector."""

from __future__ import annotations

import json
from itertools import islice

import numpy as np
import pytest

from lcf3d.datasets.drive import read_drive
from lcf3d.errors import ConfigError
from lcf3d.files import write_json
from lcf3d.structures import KITTI_CLASSES, Detections3D
from lcf3d.training.lidar_evaluation import detector_figures, drive_scans, sample_scans
from lcf3d.training.samples import RECIPE_FILE, SampleRecipe
from tests.training.lidar_scenes import scene

RECIPE = SampleRecipe("lidar", "kitti64", 3, 5)


@pytest.fixture
def samples(tmp_path):
    """A folder with simulated samples that need no simulation."""
    folder = tmp_path / "samples" / RECIPE.folder
    write_json(folder / RECIPE_FILE, RECIPE.made_by())
    for number in range(RECIPE.frames):
        scan = scene(number)
        names = np.array(KITTI_CLASSES)[scan.labels]
        np.savez(folder / f"{number:06d}.npz", points=scan.points, boxes=scan.boxes, names=names, points_on=scan.counts)
    return tmp_path / "samples"


def test_the_command_writes_a_network_that_runs(samples, tmp_path):
    pytest.importorskip("torch")
    pytest.importorskip("onnx")
    from lcf3d.cli.train_lidar import lidar
    from lcf3d.detectors.lidar import OnnxLidarDetector

    options = {"frames": RECIPE.frames, "samples_seed": RECIPE.seed, "samples": samples, "out": tmp_path / "out"}
    lidar(**options, held_out=1, steps=1, batch_size=2)
    detector = OnnxLidarDetector(tmp_path / "out" / "lidar.onnx", nms="off", score_threshold=0.0, threads=1)
    assert len(detector(scene(0).points)) > 0
    # what is behind the sensor is out of the network's range
    there = {KITTI_CLASSES[k] for k in scene(2).labels[scene(2).boxes[:, 0] > 0]}
    assert set(json.loads((tmp_path / "out" / "figures.json").read_text())) == {f"AP {name}" for name in there}
    with pytest.raises(ConfigError, match="holds a training already"):
        lidar(**options, held_out=1, steps=1, batch_size=2)
    with pytest.raises(ConfigError, match="too few to hold out"):
        lidar(**{**options, "out": tmp_path / "new"}, held_out=3)


def test_the_truth_itself_is_perfect(samples):
    frames = {len(frame.points): frame for frame in read_drive(count=3)}

    def detect(points):
        o = frames[len(points)].objects
        kept = np.isin(o.class_names, KITTI_CLASSES)
        labels = np.array([KITTI_CLASSES.index(name) for name in o.class_names[kept]])
        return Detections3D(o.boxes[kept], np.full(int(kept.sum()), 0.9), labels, KITTI_CLASSES)

    figures = detector_figures(detect, islice(drive_scans(), len(frames)))
    assert set(figures) == set(KITTI_CLASSES)
    present = {name for name, row in figures.items() if row["objects"]}
    assert present
    for name in present:
        assert figures[name]["distance"] == pytest.approx(100)
    assert figures["Car"]["3d"] > 0
    # samples of the simulation are cut to what the drive's camera sees
    (first, *_) = sample_scans(sorted(samples.rglob("*.npz")))
    assert (first.objects.boxes2d[:, 2] > first.objects.boxes2d[:, 0]).all()
    assert (first.objects.truncated >= 0).all()
