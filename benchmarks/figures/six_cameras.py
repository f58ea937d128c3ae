"""Draw docs/images/six-cameras.jpg: a simulated frame of six cameras, fused.

The LiDAR branch is the labels with a third left out and two false boxes; the camera branch is what a perfect detector
sees. ``python benchmarks/figures/six_cameras.py`` (extra ``simulate``).
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw

from lcf3d import NUSCENES_CLASSES, Detections3D, FusionConfig, LateCascadeFusion, simulate_frame
from lcf3d.frame import Frame
from lcf3d.visualization.bev import BevView, draw_bev
from lcf3d.visualization.camera_view import draw_camera
from lcf3d.visualization.canvas import font
from lcf3d.visualization.png import _legend
from lcf3d.visualization.scene import Scene

TARGET = Path(__file__).parents[2] / "docs" / "images" / "six-cameras.jpg"
# drawn as wide as it is shown, so that labels can be read
WIDTH = 900
# cameras by row, and the part of the image's height that is shown
ROWS = (
    (("CAM_FRONT",), (0.42, 0.9)),
    (("CAM_FRONT_LEFT", "CAM_BACK"), (0.3, 0.8)),
    (("CAM_BACK_LEFT", "CAM_BACK_RIGHT", "CAM_FRONT_RIGHT"), (0.2, 0.8)),
)
BEV_HEIGHT, BEV_SHOWN = 620, (0.27, 0.75)


def composed(frame: Frame, scene: Scene) -> Image.Image:
    """The camera with most in it large, the others below it, then the street from above."""
    parts = [_legend(frame.id, scene, WIDTH)]
    for names, (top, bottom) in ROWS:
        width = WIDTH // len(names)
        for place, name in enumerate(names):
            camera = frame.camera(name)
            whole = draw_camera(frame.images[name], camera, scene, width)
            shown = whole.crop((0, round(top * whole.height), width, round(bottom * whole.height)))
            if not place:
                parts.append(Image.new("RGB", (WIDTH, shown.height)))
            parts[-1].paste(shown, (place * width, 0))
            ImageDraw.Draw(parts[-1]).text(
                (place * width + 6, 4), name, "white", font(13), stroke_width=2, stroke_fill="black"
            )
    view = BevView.fit(np.concatenate([scene.boxes, scene.truth]), frame.cameras, WIDTH, BEV_HEIGHT)
    above = draw_bev(frame.points, frame.cameras, scene, view)
    low, high = (round(share * BEV_HEIGHT) for share in BEV_SHOWN)
    parts.append(above.crop((0, low, WIDTH, high)))
    picture = Image.new("RGB", (WIDTH, sum(part.height for part in parts)))
    top = 0
    for part in parts:
        picture.paste(part, (0, top))
        top += part.height
    return picture


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
    scene = Scene.from_fused(fused, simulated.frame.labels, 0.1)
    picture = composed(simulated.frame, scene)
    picture.save(TARGET, quality=82)
    print(f"wrote {TARGET}: {picture.size}, {len(fused)} boxes")
