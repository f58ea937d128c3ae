"""Draws docs/images/localizer_geometric.png from a ray-cast scene.

python benchmarks/figures/localizer_geometric.py
"""

from __future__ import annotations

import sys
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.patches import Rectangle

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))
from tests.localizers.scenes import camera, propose, scan, standing, turn

from lcf3d.geometry.boxes import EDGES, bev_corners, box_corners
from lcf3d.geometry.camera import project_points
from lcf3d.localizers.cluster import MOST_POINTS, take_cluster, weigh_points
from lcf3d.localizers.geometric import GeometricLocalizer
from lcf3d.localizers.ground import STATIONS, ground_along, lowest_returns

SLOPE = 0.02
CAR = standing(14, 1.5, 4.1, 1.7, 1.5, 0.6, SLOPE)
BODY = standing(14, 1.5, 4.1, 1.7, 0.95, 0.6, SLOPE)  # beams pass through its windows
POLE = standing(9, 1.25, 0.2, 0.2, 3, 0, SLOPE)
WALL = standing(21, 0, 0.3, 40, 5, 0.1, SLOPE)
COLOURS = {"ground": "#b9b9b9", "other": "#e69f00", "cluster": "#0072b2"}
NAMES = {"ground": "ground", "other": "pole in front, wall behind", "cluster": "cluster of the car"}


def main() -> None:
    """Draw the frustum in the image and from above."""
    proposals = propose(scan([BODY, POLE, WALL], slope=SLOPE), [CAR], [0])
    box = GeometricLocalizer()(proposals)[0]
    points = proposals.points.astype(np.float64)
    planes, reaches, weights = np.empty((STATIONS, 3)), np.empty(len(points)), np.empty(len(points))
    ground_along(lowest_returns(proposals.cloud), proposals.axis_yaw[0], -1.73, planes)
    weigh_points(points, proposals.gaussian.astype(np.float64), planes, 1.53, reaches, weights)
    taken = np.empty((MOST_POINTS, 3))
    near = np.hypot(*box[0, :2]) - 2.1
    used, _ = take_cluster(points, reaches, weights, near, near + 5, 1.2, taken)
    gap = np.sqrt(((points[:, None, :2] - taken[None, :used, :2]) ** 2).sum(-1)).min(axis=1)
    kind = np.where(weights == 0, "ground", np.where(gap < 0.25, "cluster", "other"))
    kind[(weights == 0) & (points[:, 2] > planes[4, 0] + 1)] = "other"

    view = camera()
    back = turn(proposals.axis_yaw[0])[:3, :3]
    pixels, _ = project_points(points[:, :3] @ back.T, view)
    figure, (image, above) = plt.subplots(1, 2, figsize=(11, 3.9), gridspec_kw={"width_ratios": [1.15, 1]})
    for name, colour in COLOURS.items():
        chosen = kind == name
        image.scatter(*pixels[chosen].T, s=6, c=colour)
        above.scatter(*points[chosen, :2].T, s=6, c=colour, label=NAMES[name])
    corners, _ = project_points(box_corners(proposals.lidar_from_frustum(box))[0], view)
    for a, b in EDGES:
        image.plot(*corners[[a, b]].T, c="#d55e00", lw=1.6)
    x1, y1, x2, y2 = proposals.boxes2d[0]
    image.add_patch(Rectangle((x1, y1), x2 - x1, y2 - y1, fill=False, ls="--", ec="black"))
    image.text(x1, y1 - 4, "2D box", fontsize=10)
    image.set(xlim=(x1 - 25, x2 + 25), ylim=(y2 + 20, y1 - 20), xlabel="u in pixels", ylabel="v in pixels")
    image.set_aspect("equal")
    for shape, colour, style, label in (
        (proposals.frustum_from_lidar(CAR[None]), "black", ":", "true box"),
        (box, "#d55e00", "-", "located box"),
    ):
        outline = bev_corners(shape)[0][[0, 1, 2, 3, 0]]
        above.plot(*outline.T, c=colour, ls=style, lw=1.8, label=label)
    above.set(xlim=(7.5, 23.5), ylim=(-4.5, 6.5), xlabel="along the frustum, metres", ylabel="across, metres")
    above.set_aspect("equal")
    above.legend(fontsize=9, loc="upper left", framealpha=1, ncol=2)
    figure.tight_layout()
    figure.savefig(Path(__file__).parents[2] / "docs" / "images" / "localizer_geometric.png", dpi=110)


if __name__ == "__main__":
    main()
