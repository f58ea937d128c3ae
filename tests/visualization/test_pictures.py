from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import PIL.Image
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from lcf3d.distortion import Distortion
from lcf3d.errors import ConfigError
from lcf3d.frame import Frame
from lcf3d.geometry.boxes import bev_corners
from lcf3d.geometry.camera import NEAR, project_boxes
from lcf3d.provenance import FusedDetections
from lcf3d.structures import Camera, Detections2D, Detections3D
from lcf3d.visualization.bev import BevView, draw_bev
from lcf3d.visualization.camera_view import draw_camera, projected_edges, resized, scaled_camera
from lcf3d.visualization.canvas import clip_segments
from lcf3d.visualization.png import draw_frame, save_png
from lcf3d.visualization.scene import COLOURS, Scene
from tests.visualization.conftest import make_camera

BOX = np.array([[10, 0, 0, 4, 2, 1.0, 0]], dtype=float)


def box_strategy() -> st.SearchStrategy[list[float]]:
    place, size = st.floats(-20, 20), st.floats(0.3, 10)
    return st.tuples(place, place, st.floats(-3, 3), size, size, size, st.floats(-3.1, 3.1)).map(list)


def has_colour(picture: PIL.Image.Image, colour: tuple[int, int, int]) -> bool:
    """Whether some pixel nearly has this colour."""
    return bool((np.abs(np.asarray(picture).astype(int) - colour).max(axis=-1) <= 12).any())


def test_edges_by_hand(camera: Camera) -> None:
    edges = projected_edges(BOX, camera)[0]
    # the front face is 12 m away: half width 1 m is 8.33 px, half height 0.5 m is 4.17 px
    np.testing.assert_allclose(edges[0], [100 - 100 / 12, 50 + 50 / 12, 100 + 100 / 12, 50 + 50 / 12])
    # the rear face is 8 m away
    np.testing.assert_allclose(edges[2], [100 + 100 / 8, 50 + 50 / 8, 100 - 100 / 8, 50 + 50 / 8])


def test_edges_are_cut_at_the_near_plane(camera: Camera) -> None:
    around = np.array([[0, 0, -1.5, 4, 2, 1.0, 0], [-10, 0, 0, 4, 2, 1, 0]], dtype=float)
    edges = projected_edges(around, camera)
    # the front (x = 2) is seen whole, the rear (x = -2) is behind, the sides are cut
    assert np.isfinite(edges[0]).all(axis=1).tolist() == [k not in (2, 6, 10, 11) for k in range(12)]
    cut = edges[0, 1]  # front right to rear right, bottom: y = -1, z = -2 at depth NEAR
    np.testing.assert_allclose(cut[2:], [100 + 100 * 1 / NEAR, 50 + 100 * 2 / NEAR])
    assert np.isnan(edges[1]).all()


@settings(deadline=None)
@given(st.lists(box_strategy(), min_size=1, max_size=4))
def test_edges_span_what_the_projection_spans(rows: list[list[float]]) -> None:
    camera, boxes = make_camera(), np.array(rows)
    bounds, visible = project_boxes(boxes, camera)
    for edges, expected, seen in zip(projected_edges(boxes, camera), bounds, visible, strict=True):
        points = edges[np.isfinite(edges).all(axis=1)].reshape(-1, 2)
        if not seen:
            # what is not visible draws nothing inside the image
            inside = clip_segments(edges, (1e-6, 1e-6, camera.width - 1e-6, camera.height - 1e-6))
            assert not len(inside)
            continue
        clipped = np.clip([*points.min(axis=0), *points.max(axis=0)], 0, [camera.width, camera.height] * 2)
        np.testing.assert_allclose(clipped, expected, atol=1e-6)


def test_scaled_camera_scales_pixels(camera: Camera) -> None:
    half = scaled_camera(camera, 0.5)
    assert (half.width, half.height) == (100, 50)
    np.testing.assert_allclose(project_boxes(BOX, half)[0], project_boxes(BOX, camera)[0] / 2)


def test_scene_of_a_fusion(fused: FusedDetections) -> None:
    scene = Scene.from_fused(fused)
    # LiDAR detection 3 was below the threshold: it never took part
    assert scene.outcomes == ("matched", "downweighted", "recovered", "dropped")
    assert scene.counts == {"matched": 1, "recovered": 1, "downweighted": 1, "dropped": 1}
    assert scene.texts == ("Car 0.95", "Car 0.40", "Pedestrian 0.30", "")
    np.testing.assert_array_equal(scene.boxes[3], fused.lidar_inputs.boxes[2])
    assert [scene.outcomes[i] for i in scene.drawing_order] == ["dropped", "downweighted", "recovered", "matched"]
    left = scene.image_boxes["left"]
    assert left.used.tolist() == [True, True, False]
    assert left.texts == ("", "", "Pedestrian 0.50 few points")


def test_scene_without_low_scores(fused: FusedDetections) -> None:
    limit = float(np.median(fused.detections.scores))
    scene = Scene.from_fused(fused, least_score=limit)
    kept = fused.detections.boxes[fused.detections.scores >= limit]
    np.testing.assert_array_equal(scene.boxes[: len(kept)], kept)
    assert all(scene.outcomes[i] != "dropped" for i in range(len(kept)))


def test_scene_of_detections() -> None:
    found = Detections3D(BOX, np.array([0.5]), np.array([0]), ("Car",))
    flat = Detections2D(np.array([[0, 0, 9, 9.0]]), np.array([0.25]), np.array([0]), ("Car",))
    scene = Scene.from_detections(found, {"left": flat}, truth=found)
    assert (scene.outcomes, scene.texts) == (("detection",), ("Car 0.50",))
    assert scene.image_boxes["left"].texts == ("Car 0.25",)
    np.testing.assert_array_equal(scene.truth, BOX)


@pytest.mark.parametrize("outcome", ["matched", "recovered", "kept", "downweighted"])
def test_boxes_have_the_colour_of_their_outcome(camera: Camera, outcome: str) -> None:
    image = np.zeros((100, 200, 3), dtype=np.uint8)
    picture = draw_camera(image, camera, Scene(BOX, (outcome,), ("",)))
    assert picture.size == (200, 100)
    for other in COLOURS:
        expected = other == outcome or COLOURS[other] == COLOURS[outcome]
        assert has_colour(picture, COLOURS[other]) == expected
    above = draw_bev(None, [camera], Scene(BOX, (outcome,), ("",)), BevView.fit(BOX, [camera], 300, 200))
    assert has_colour(above, COLOURS[outcome])


def test_dropped_boxes_are_dim_and_behind(camera: Camera) -> None:
    image = np.zeros((100, 200, 3), dtype=np.uint8)
    alone = np.asarray(draw_camera(image, camera, Scene(BOX, ("dropped",), ("",)))).astype(int)
    kept = np.asarray(draw_camera(image, camera, Scene(BOX, ("kept",), ("",)))).astype(int)
    assert 0 < alone.sum() < 0.4 * kept.sum()
    both = Scene(np.repeat(BOX, 2, axis=0), ("kept", "dropped"), ("", ""))
    assert has_colour(draw_camera(image, camera, both), COLOURS["kept"])


def test_boxes_out_of_sight_leave_the_image_alone(camera: Camera) -> None:
    image = np.full((100, 200, 3), 90, dtype=np.uint8)
    behind = np.array([[-10, 0, 0, 4, 2, 1, 0]], dtype=float)
    scene = Scene(behind, ("matched",), ("Car 0.90",), truth=behind)
    np.testing.assert_array_equal(np.asarray(draw_camera(image, camera, scene)), image)


def test_ground_positions_by_hand() -> None:
    view = BevView(100, 80, 2.0, (10.0, 40.0))
    # forward is right, left is up
    np.testing.assert_allclose(view.pixels(np.array([[0, 0], [20, 0], [0, 5]])), [[10, 40], [50, 40], [10, 30]])


@settings(deadline=None)
@given(st.lists(st.tuples(st.floats(0, 70), st.floats(-60, 60)), max_size=6), st.booleans())
def test_views_hold_all_boxes(centres: list[tuple[float, float]], surround: bool) -> None:
    cameras = [make_camera("front"), make_camera("back", np.pi)] if surround else [make_camera("front")]
    boxes = np.array([[x, y, 0, 4, 2, 1.5, 0.3] for x, y in centres], dtype=float).reshape(-1, 7)
    if surround:
        boxes[:, 0] *= -1
    view = BevView.fit(boxes, cameras, 600, 400)
    corners = view.pixels(bev_corners(boxes)).reshape(-1, 2)
    assert ((corners >= -1e-6) & (corners <= np.array([600, 400]) + 1e-6)).all()
    assert 0 <= view.origin[0] <= 600
    assert 0 <= view.origin[1] <= 400


def test_points_are_brighter_with_height() -> None:
    view = BevView(100, 80, 2.0, (10.0, 40.0))
    points = np.array([[20.3, -3.3, -2, 0], [20.3, -3.3, 2, 0], [30.3, -3.3, -2, 0], [500, 0, 0, 0]], dtype=np.float32)
    empty = Scene(np.zeros((0, 7)), (), ())
    picture = np.asarray(draw_bev(points, [], empty, view)).astype(int)
    high, low, ground = picture[46, 50].sum(), picture[46, 70].sum(), picture[75, 95].sum()
    assert high > low > ground


def test_one_camera_above_the_ground_plan(camera: Camera, fused: FusedDetections, tmp_path: Path) -> None:
    frame = Frame("000001", np.zeros((5, 4), np.float32), [camera], {"left": np.zeros((100, 200, 3), np.uint8)})
    picture = draw_frame(frame, Scene.from_fused(fused))
    assert picture.width == 200
    for outcome in ("matched", "recovered", "downweighted"):
        assert has_colour(picture, COLOURS[outcome])
    only_image = draw_frame(frame, Scene.from_fused(fused), bev=False)
    assert picture.height > only_image.height > 100
    save_png(picture, tmp_path / "deep" / "a.png")
    with PIL.Image.open(tmp_path / "deep" / "a.png") as saved:
        np.testing.assert_array_equal(np.asarray(saved), np.asarray(picture))
    assert [p.name for p in (tmp_path / "deep").iterdir()] == ["a.png"]


def test_six_cameras_in_two_rows(fused: FusedDetections) -> None:
    cameras = [make_camera(f"c{i}", i * np.pi / 3) for i in range(6)]
    frame = Frame("f", None, cameras, {c.name: np.zeros((100, 200, 3), np.uint8) for c in cameras})
    picture = draw_frame(frame, Scene.from_fused(fused), bev=False)
    assert picture.width == 3 * 560
    assert 2 * 280 <= picture.height <= 2 * 280 + 100
    assert draw_frame(frame, Scene.from_fused(fused), cameras=["c0"], bev=False).width == 200
    with pytest.raises(ConfigError, match="no camera 'c9'"):
        draw_frame(frame, Scene.from_fused(fused), cameras=["c9"])


@pytest.mark.parametrize("cameras", [[], [make_camera()]])
def test_missing_sensors_still_give_a_picture(cameras: list[Camera]) -> None:
    empty = Scene(np.zeros((0, 7)), (), ())
    picture = draw_frame(Frame("f", None, cameras), empty)
    assert min(picture.size) > 100


def test_edges_through_a_lens_bend_and_fit_its_bounds(camera: Camera) -> None:
    lens = replace(camera, distortion=Distortion("fisheye", (0.02, 0.0, 0.0, 0.0)))
    near = np.array([[4.0, 1.0, 0.0, 4.0, 2.0, 1.5, 0.4]])
    edges = projected_edges(near, lens)[0]
    edges = edges[np.isfinite(edges).all(axis=1)]
    assert len(edges) > 12
    ends = np.concatenate([edges[:, :2], edges[:, 2:]])
    bounds, _ = project_boxes(near, lens)
    limits = np.array([camera.width, camera.height] * 2)
    np.testing.assert_allclose(np.clip([*ends.min(axis=0), *ends.max(axis=0)], 0, limits), bounds[0], atol=1e-6)
    picture = draw_camera(None, lens, Scene(near, ("matched",), ("car",)), width=400)
    assert len(np.unique(np.asarray(picture).reshape(-1, 3), axis=0)) > 2


def test_an_image_made_smaller_shows_the_mean_of_each_area() -> None:
    image = np.random.default_rng(0).integers(0, 256, (60, 90, 3), dtype=np.uint8)
    small = resized(image, 30, 20)
    expected = image.reshape(20, 3, 30, 3, 3).mean(axis=(1, 3))
    assert np.abs(small - expected).max() <= 1.5
    # parts of pixels: by the share of each
    wide = np.zeros((10, 25, 3), np.uint8)
    wide[:, 12] = 200
    assert resized(wide, 10, 4)[0, :, 0].tolist() == [0, 0, 0, 0, 40, 40, 0, 0, 0, 0]
    for value in (0, 1, 128, 255):
        flat = np.full((315, 777, 3), value, np.uint8)
        assert (resized(flat, 171, 99) == value).all()
    # hardly smaller, or larger, and never the same memory
    assert resized(image, 80, 55).shape == (55, 80, 3)
    assert resized(image, 180, 120).shape == (120, 180, 3)
    assert not np.shares_memory(resized(image, 90, 60), image)
    # of any layout
    turned = np.ascontiguousarray(image.transpose(1, 0, 2)).transpose(1, 0, 2)
    assert np.array_equal(resized(turned, 30, 20), small)
