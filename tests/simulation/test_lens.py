"""Cameras with lenses in simulated scenes: what is rendered lies where the projection says."""

from dataclasses import replace

import numpy as np
import pytest

from lcf3d import Camera, Distortion
from lcf3d.geometry.camera import pixels_in_field, project_boxes
from lcf3d.simulation.presets import get_preset

pytest.importorskip("embreex")

from lcf3d.simulation.frames import simulate_frame


@pytest.fixture(scope="module")
def fisheye_frame():
    """A frame of a nuScenes-like preset with one fisheye camera of 190 degrees, 240 x 200 pixels."""
    preset = get_preset("nuscenes32")
    front = preset.cameras[0]
    projection = np.array([[70.0, 0, 120, 0], [0, 70, 100, 0], [0, 0, 1, 0]])
    lens = Distortion("fisheye", (-0.012, 0.004, -0.003, 0.0005))
    view = Camera("front", projection, front.camera_from_lidar, 240, 200, lens)
    preset = replace(preset, cameras=(view,), lidar=replace(preset.lidar, steps=120))
    return simulate_frame(preset, seed=11, street="city", threads=1)


def test_actors_are_seen_inside_their_projected_boxes(fisheye_frame):
    view, seen = fisheye_frame.preset.cameras[0], fisheye_frame.sightings["front"]
    amodal, _ = project_boxes(fisheye_frame.boxes, view)
    np.testing.assert_allclose(seen.amodal, amodal)
    visible = np.flatnonzero(seen.pixels > 20)
    assert len(visible) >= 3
    # boxes are tight around their actors, and a pixel is the least there is
    assert (seen.boxes2d[visible, :2] >= amodal[visible, :2] - 2).all()
    assert (seen.boxes2d[visible, 2:] <= amodal[visible, 2:] + 2).all()
    clear = visible[(seen.hidden[visible] < 0.05) & (seen.truncated[visible] < 0.05)]
    assert len(clear)
    sides = amodal[clear, 2:] - amodal[clear, :2]
    assert (np.abs(seen.boxes2d[clear] - amodal[clear]) <= 2 + 0.25 * np.tile(sides, 2)).all()


def test_nothing_is_seen_outside_of_the_field(fisheye_frame):
    view, render = fisheye_frame.preset.cameras[0], fisheye_frame.renders["front"]
    u, v = np.meshgrid(np.arange(240) + 0.5, np.arange(200) + 0.5)
    inside = pixels_in_field(np.column_stack([u.ravel(), v.ravel()]), view).reshape(200, 240)
    assert 0.6 < inside.mean() < 0.95
    assert (render.image[~inside] == 0).all()
    assert (render.owner[~inside] == 0).all()
    assert np.isinf(render.depth[~inside]).all()
    assert render.image[inside].mean() > 20


def test_resized_presets_keep_their_lenses(fisheye_frame):
    half = fisheye_frame.preset.resized(0.5).cameras[0]
    assert half.distortion == fisheye_frame.preset.cameras[0].distortion
    assert (half.width, half.height) == (120, 100)
