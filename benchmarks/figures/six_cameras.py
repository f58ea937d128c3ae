"""Draw docs/images/six-cameras.jpg: a simulated frame of six cameras, fused.

The LiDAR branch is the labels with a third left out and two false boxes; the camera branch is what a perfect detector
sees. ``python benchmarks/figures/six_cameras.py`` (extra ``simulate``).
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
from PIL import Image

from lcf3d import NUSCENES_CLASSES, Detections3D, FusionConfig, LateCascadeFusion, draw, simulate_frame

TARGET = Path(__file__).parents[2] / "docs" / "images" / "six-cameras.jpg"
WIDTH = 1440

if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--index", type=int, default=3, help="which simulated frame")
    arguments = parser.parse_args()
    simulated = simulate_frame("nuscenes32", seed=11, index=arguments.index)
    labels = simulated.frame.labels.with_classes(NUSCENES_CLASSES)
    rng = np.random.default_rng(0)
    kept = rng.random(len(labels)) > 1 / 3
    car, person = NUSCENES_CLASSES.index("car"), NUSCENES_CLASSES.index("pedestrian")
    false = [[18, 7, -0.9, 4.3, 1.8, 1.6, 0.2], [-12, -6, -0.9, 0.7, 0.7, 1.7, 0]]
    boxes = np.concatenate([labels.boxes[kept] + rng.normal(0, 0.08, (int(kept.sum()), 7)), false])
    scores = np.append(rng.uniform(0.4, 0.9, int(kept.sum())), [0.5, 0.5])
    lidar = Detections3D(boxes, scores, [*labels.labels[kept], car, person], NUSCENES_CLASSES)
    camera = {
        view.name: simulated.detections_2d(view.name).with_classes(NUSCENES_CLASSES) for view in simulated.frame.cameras
    }
    fused = LateCascadeFusion(FusionConfig.preset("nuscenes"))(simulated.frame, lidar, camera)
    picture = draw(simulated.frame, fused, min_score=0.1)
    print(picture.size, len(fused), "boxes")
    # the images, and of the view from above the street
    width, height = picture.size
    images, street = (
        picture.crop((0, 0, width, round(0.438 * height))),
        picture.crop((0, round(0.61 * height), width, round(0.82 * height))),
    )
    whole = Image.new("RGB", (width, images.height + street.height))
    whole.paste(images, (0, 0))
    whole.paste(street, (0, images.height))
    whole.resize((WIDTH, round(whole.height * WIDTH / width))).save(TARGET, quality=82)
    print(f"wrote {TARGET}")
