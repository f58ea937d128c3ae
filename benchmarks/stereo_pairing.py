"""How often epipolar assignment pairs the right boxes, on the labels of a KITTI-layout folder.

    python benchmarks/stereo_pairing.py /data/kitti --split val

Needs labels and calibrations, no images: the labelled boxes are projected into both cameras and given a detector's
errors, independently in each view: every edge moves (``--noise``, a share of the box's side), boxes are missed
(``--miss``), and boxes that show nothing come in (``--false``). Prints, for each way of pairing, which share of the
objects seen in both views is paired rightly, which share of the pairs is wrong, and how many frames would be taken for
ones with exchanged views (as they are, and when they are exchanged indeed).
"""

from __future__ import annotations

import argparse
import json
from dataclasses import replace
from pathlib import Path

import numpy as np

from lcf3d import Lcf3dError
from lcf3d.datasets.kitti import KittiDataset
from lcf3d.fusion.stereo_pairing import check_not_exchanged, pair_views
from lcf3d.geometry.camera import project_boxes
from lcf3d.structures import Camera, Detections2D, Detections3D, IntArray

WAYS = {
    "paper": {"method": "paper", "check_depth": False},
    "gated": {"method": "gated", "check_depth": False},
    "paper + depth": {"method": "paper", "check_depth": True},
    "gated + depth": {"method": "gated", "check_depth": True},
}
# labels smaller than that in the image are no detections, in pixels
LEAST_HEIGHT = 20.0


def views_of(
    labels: Detections3D, cameras: list[Camera], noise: float, miss: float, false: float, rng: np.random.Generator
) -> tuple[list[Detections2D], list[IntArray]]:
    """For each camera what a detector might see of the labels, and the label of each box (-1 for none)."""
    projected = [project_boxes(labels.boxes, camera) for camera in cameras]
    large = (projected[0][0][:, 3] - projected[0][0][:, 1]) >= LEAST_HEIGHT
    found, owners = [], []
    for boxes, visible in projected:
        seen = np.flatnonzero(visible & large & (rng.random(len(labels)) >= miss))
        # a false box has the size of some object and stands anywhere
        count = rng.poisson(false) if len(labels) else 0
        models = rng.integers(0, max(len(labels), 1), count)
        shift = rng.uniform([-400, -15], [400, 15], (count, 2))
        false_boxes = boxes[models] + np.tile(shift, 2)
        owner = np.concatenate([seen, np.full(count, -1)])
        exact = np.concatenate([boxes[seen], false_boxes])
        sides = np.tile(exact[:, 2:] - exact[:, :2], 2)
        noisy = exact + rng.normal(0, 1, exact.shape) * np.maximum(noise * sides, 0.7)
        noisy[:, 0::2] = noisy[:, 0::2].clip(0, cameras[0].width)
        noisy[:, 1::2] = noisy[:, 1::2].clip(0, cameras[0].height)
        kept = (noisy[:, 2:] - noisy[:, :2] > 2).all(axis=1)
        classes = np.concatenate([labels.labels[seen], labels.labels[models]])[kept]
        found.append(Detections2D(noisy[kept], np.full(kept.sum(), 0.9), classes, labels.class_names))
        owners.append(owner[kept])
    return found, owners


def exchanged(cameras: list[Camera], found: list[Detections2D], gate_px: float) -> bool:
    """Whether the frame is taken for one with exchanged views."""
    try:
        check_not_exchanged(*cameras, *found, gate_px)
    except Lcf3dError:
        return True
    return False


def main() -> None:
    """Run the benchmark."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("root", type=Path)
    parser.add_argument("--split", default="val")
    parser.add_argument("--noise", type=float, default=0.03, help="deviation of each edge, as a share of the side")
    parser.add_argument("--miss", type=float, default=0.2, help="share of the objects that a view misses")
    parser.add_argument("--false", type=float, default=0.5, help="boxes a view that show nothing")
    parser.add_argument("--gate", type=float, default=10.0, help="epipolar gate in pixels")
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()

    rng = np.random.default_rng(0)
    data = KittiDataset(options.root, options.split)
    counts = {way: np.zeros(3, dtype=int) for way in WAYS}
    flags = np.zeros(2, dtype=int)
    for frame_id in data.ids:
        frame = data.frame(frame_id)
        cameras = [frame.camera("left"), frame.camera("right")]
        cameras[1] = replace(cameras[1], width=cameras[0].width, height=cameras[0].height)
        assert frame.labels is not None
        found, owners = views_of(frame.labels, cameras, options.noise, options.miss, options.false, rng)
        common = len(np.intersect1d(owners[0][owners[0] >= 0], owners[1][owners[1] >= 0]))
        for way, settings in WAYS.items():
            pairs = pair_views(*cameras, *found, gate_px=options.gate, **settings)
            own, other = owners[0][pairs[:, 0]], owners[1][pairs[:, 1]]
            right = int(((own == other) & (own >= 0)).sum())
            counts[way] += (common, right, len(pairs) - right)
        flags += exchanged(cameras, found, options.gate), exchanged(cameras, found[::-1], options.gate)
    rows = {
        way: {"seen_in_both": int(n), "paired_rightly": right / n, "wrong_pairs": wrong / max(right + wrong, 1)}
        for way, (n, right, wrong) in counts.items()
    }
    result = {"frames": len(data), "taken_for_exchanged": int(flags[0]), "exchanged_found": int(flags[1]), "ways": rows}
    if options.json:
        print(json.dumps(result, indent=2))
        return
    print(f"{len(data)} frames, noise {options.noise}, missed {options.miss}, false {options.false}")
    for way, row in rows.items():
        print(f"{way:15s} paired rightly {row['paired_rightly']:6.1%}   wrong pairs {row['wrong_pairs']:6.1%}")
    print(f"taken for exchanged: {flags[0]}; of frames exchanged indeed: {flags[1]}")


if __name__ == "__main__":
    main()
