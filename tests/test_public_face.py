"""What ``from lcf3d import ...`` gives, and that the docs need nothing deeper."""

import re
import subprocess
import sys
from pathlib import Path

import pytest

import lcf3d

DOCS = Path(__file__).parents[1] / "docs"


def test_every_name_is_there_and_listed():
    for name in lcf3d.__all__:
        assert getattr(lcf3d, name) is not None
    assert set(lcf3d.__all__) <= set(dir(lcf3d))
    with pytest.raises(AttributeError, match="has no attribute 'nothing'"):
        lcf3d.nothing  # noqa: B018


def test_import_is_light():
    code = "import lcf3d, sys; print([m for m in ('numba', 'scipy', 'pydantic', 'torch', 'PIL') if m in sys.modules])"
    told = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert told.stdout.strip() == "[]"


def test_run_is_a_package_and_a_function():
    code = "import lcf3d.run.setup, lcf3d; assert callable(lcf3d.run); import lcf3d.run.frames"
    subprocess.run([sys.executable, "-c", code], check=True)


@pytest.mark.parametrize("page", sorted(p.name for p in DOCS.glob("*.md")))
def test_pages_import_from_the_top(page):
    deep = re.findall(r"^\s*(?:from|import) (lcf3d\.[\w.]+)", (DOCS / page).read_text(), re.MULTILINE)
    assert deep == []


def test_arrays_in_python_give_what_the_command_line_gives(tmp_path, monkeypatch):
    """Own numpy detections with own classes, and the same as files through ``lcf3d.run``."""
    from importlib.metadata import EntryPoint

    import numpy as np

    from lcf3d import plugins
    from tests.datasets.toy import CLASSES, ToyDataset, write_toy

    known = plugins._points
    toy = EntryPoint("toy", "tests.datasets.toy:ToyDataset", "lcf3d.datasets")
    monkeypatch.setattr(plugins, "_points", lambda g: {**known(g), **({"toy": toy} if g == toy.group else {})})
    write_toy(tmp_path, 3)
    counts = lcf3d.run(
        f"toy:{tmp_path / 'data'}",
        f"results:{tmp_path / 'lidar'}",
        f"results:{tmp_path / 'camera'}",
        tmp_path / "fused",
        recovery="off",
    )
    assert counts["frames"] == 3
    dataset = ToyDataset(str(tmp_path / "data"))
    fusion = lcf3d.LateCascadeFusion(lcf3d.FusionConfig(class_names=CLASSES, recovery=False))
    for frame_id, written in lcf3d.read_run(tmp_path / "fused").items():
        frame = dataset.frame(frame_id)
        lidar = lcf3d.read_detections_3d(tmp_path / "lidar" / f"{frame_id}.json")
        camera = lcf3d.read_detections_2d(tmp_path / "camera" / f"{frame_id}.json")
        fused = fusion(frame, lidar, camera["front"])
        np.testing.assert_allclose(fused.detections.scores, written.detections.scores, atol=1e-6)
        assert fused.detections.labels.tolist() == written.detections.labels.tolist()
    measured = lcf3d.evaluate(f"toy:{tmp_path / 'data'}", tmp_path / "fused")
    assert measured.to_json()["mean_ap"] > 0.9
    assert lcf3d.draw(dataset.frame("f00"), lcf3d.read_run(tmp_path / "fused")["f00"]).size[0] > 100


def test_paths_may_be_text(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    frame = lcf3d.demo_frames(1)[0]
    lcf3d.write_kitti([frame], "kitti", camera="left")
    lcf3d.write_nuscenes([frame], "nuscenes", cameras={"left": "CAM_FRONT"})
    lcf3d.write_folder([frame], "folder", image_format="jpg")
    lcf3d.write_bag([frame], "drive.mcap")
    lcf3d.write_detections_3d("boxes.json", frame.labels)
    assert len(lcf3d.read_detections_3d("boxes.json")) == len(frame.labels)
    dataset = lcf3d.NuscenesDataset("nuscenes")
    dataset.write_results("results.json", {dataset.ids[0]: dataset[0].labels})
    assert len(dataset.read_results("results.json")[dataset.ids[0]]) == len(dataset[0].labels) > 5


def test_frames_of_the_demo():
    frames = lcf3d.demo_frames(2)
    assert [frame.timestamp for frame in frames] == [0.0, 0.1]
    thinned = lcf3d.demo_frames(1, beam_step=4)[0]
    assert 0.2 < len(thinned.points) / len(frames[0].points) < 0.3
    assert thinned.images["left"].shape == (375, 1242, 3)
    assert set(frames[0].labels.class_names) == {"Car", "Pedestrian", "Cyclist"}
