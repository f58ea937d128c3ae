"""Does ``lcf3d check folder:`` find and name mistakes in the poses of real cameras?

One frame of a dataset is written as a plain folder; then each camera's pose is spoilt in three ways (its inverse, the
axes of a camera body, a transposed rotation), one at a time, and the check is asked, with the projected labels as 2D
boxes and without any boxes.

python benchmarks/wrong_poses.py kitti:../shared/data/kitti nuscenes:../shared/data/nuscenes
"""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path

import numpy as np
import yaml

from lcf3d import Detections2D, Frame, open_dataset, write_detections_2d, write_folder
from lcf3d.datasets.folder import FolderDataset
from lcf3d.datasets.folder_sensors import turn
from lcf3d.geometry.camera import project_boxes
from lcf3d.structures import FloatArray

WORDS = {
    "inverse": "camera_from_lidar is inverted: give the inverse",
    "body axes": "its axes are forward-left-up: write 'axes: forward-left-up'",
    "transposed": "the rotation of camera_from_lidar is transposed",
}


def spoilt(pose: FloatArray, mistake: str) -> FloatArray:
    """A pose with a mistake in it."""
    if mistake == "inverse":
        return np.linalg.inv(pose)
    if mistake == "body axes":
        return np.asarray(turn("right-down-forward") @ pose)
    changed = pose.copy()
    changed[:3, :3] = pose[:3, :3].T
    return changed


def export(text: str, root: Path) -> list[str]:
    """The first labelled frame of a dataset as a folder, and its labels as 2D boxes; cameras that see some."""
    dataset = open_dataset(text)
    frame = next(f for f in map(dataset.frame, dataset.ids) if f.labels is not None and len(f.labels) > 3)
    images = {c.name: np.zeros((c.height, c.width, 3), np.uint8) for c in frame.cameras}
    write_folder([Frame(frame.id, frame.points, frame.cameras, images, frame.labels)], root)
    seen = {}
    assert frame.labels is not None
    for camera in frame.cameras:
        boxes, visible = project_boxes(frame.labels.boxes, camera)
        labels = frame.labels.labels[visible]
        seen[camera.name] = Detections2D(boxes[visible], np.ones(len(labels)), labels, frame.labels.class_names)
    write_detections_2d(root / "seen" / f"{frame.id}.json", seen)
    return [name for name, found in seen.items() if len(found)]


def main() -> None:
    """Print how many mistakes were found and named."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("datasets", nargs="+")
    for text in parser.parse_args().datasets:
        with tempfile.TemporaryDirectory() as folder:
            root = Path(folder)
            with_objects = export(text, root)
            good = yaml.safe_load((root / "sensors.yaml").read_text())
            counts = {"boxes": np.zeros(3, int), "no boxes": np.zeros(3, int)}
            false = [f for f in FolderDataset(root).check(root / "seen") if f.id.startswith("FLD0") and f.id < "FLD05"]
            for name, setup in good["cameras"].items():
                for mistake, words in WORDS.items():
                    changed = yaml.safe_load((root / "sensors.yaml").read_text())
                    pose = spoilt(np.array(setup["camera_from_lidar"]), mistake)
                    changed["cameras"][name]["camera_from_lidar"] = pose.tolist()
                    (root / "sensors.yaml").write_text(yaml.safe_dump(changed, sort_keys=False))
                    for given, count in counts.items():
                        if given == "boxes" and name not in with_objects:
                            continue
                        told = FolderDataset(root).check(root / "seen" if given == "boxes" else None)
                        found = [f.message for f in told if f.id == "FLD02" and f"camera {name}:" in f.message]
                        count += [1, bool(found), bool(found) and found[0].endswith(f"if {words}")]
                    (root / "sensors.yaml").write_text(yaml.safe_dump(good, sort_keys=False))
            print(f"{text.partition(':')[0]}: {len(false)} findings with the poses as they are")
            for given, (all_, found_, named) in counts.items():
                print(f"  {given}: {all_} mistakes, {found_} found, {named} named and nothing else")


if __name__ == "__main__":
    main()
