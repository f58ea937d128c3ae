import cv2
import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from lcf3d import Camera, Distortion
from lcf3d.errors import ConfigError
from lcf3d.geometry.boxes import EDGES, box_corners
from lcf3d.geometry.camera import (
    cut_by_field,
    pixel_rays,
    pixels_in_field,
    project_boxes,
    project_points,
    require_pinhole,
)
from lcf3d.geometry.iou import image_iou
from lcf3d.geometry.lens import edges_through_lens, local_projection, polygon_through_lens

AXES = np.array([[0.0, -1, 0], [0, 0, -1], [1, 0, 0]])
EQUIDISTANT = Distortion("fisheye", (0, 0, 0, 0))


def camera(distortion, width=1000, height=600, focal=400.0, turn=(0.0, 0.0, 0.0), position=(0.0, 0.0, 0.0), offset=0.0):
    transform = np.eye(4)
    transform[:3, :3] = AXES @ Rotation.from_rotvec(turn).as_matrix()
    transform[:3, 3] = -transform[:3, :3] @ position
    projection = np.array([[focal, 0, width / 2, offset], [0, 1.1 * focal, height / 2, 0], [0, 0, 1, 0]])
    return Camera("front", projection, transform, width, height, distortion)


small = st.floats(-0.02, 0.02)
browns = st.one_of(
    st.tuples(st.floats(-0.2, 0.3), st.floats(0, 0.2), small, small),
    st.tuples(st.floats(-0.2, 0.3), st.floats(0, 0.2), small, small, small),
    st.tuples(*[st.floats(0, 0.2)] * 2, small, small, *[st.floats(0, 0.1)] * 4),
).map(lambda k: Distortion("brown_conrady", k))
fisheyes = st.tuples(st.floats(-0.03, 0.1), *[st.floats(-0.002, 0.004)] * 3).map(lambda k: Distortion("fisheye", k))
lenses = st.one_of(browns, fisheyes)


def make(distortion, **options):
    assume(not distortion.is_pinhole)
    try:
        return camera(distortion, **options)
    except ConfigError:  # some of them fold back
        assume(False)


@settings(max_examples=60, deadline=None)
@given(lenses, st.integers(0, 2**32 - 1))
def test_points_as_opencv_projects_them(distortion, seed):
    view = make(distortion, turn=(0.1, -0.2, 0.3), position=(0.5, -0.2, 0.3))
    points = np.random.default_rng(seed).uniform([2, -6, -3], [12, 6, 3], (50, 3))
    pixels, depths = project_points(points, view)
    turn, move = cv2.Rodrigues(view.camera_from_lidar[:3, :3])[0], view.camera_from_lidar[:3, 3]
    project = cv2.fisheye.projectPoints if distortion.model == "fisheye" else cv2.projectPoints
    coefficients = np.array(distortion.coefficients)
    expected = project(points[:, None], turn, move, np.array(view.intrinsics), coefficients)[0][:, 0]
    # OpenCV mirrors what a fisheye lens sees of the half space behind it
    seen = ~np.isnan(pixels[:, 0]) & (depths > 0)
    np.testing.assert_allclose(pixels[seen], expected[seen], atol=1e-6)
    np.testing.assert_allclose(depths, (points @ view.camera_from_lidar[:3, :3].T + move)[:, 2])
    # what is not seen lies at the side, outside of the image
    inside = ((expected >= 0) & (expected <= [1000, 600])).all(axis=1)
    angles = np.arccos(depths / np.linalg.norm(points - [0.5, -0.2, 0.3], axis=1))
    assert not (inside & ~seen & (depths > 0) & (angles < view.lens_field.half_angle)).any()


@settings(max_examples=60, deadline=None)
@given(lenses, st.integers(0, 2**32 - 1), st.floats(0.5, 80))
def test_pixels_come_back_from_their_rays(distortion, seed, away):
    view = make(distortion, turn=(0.1, -0.2, 0.3), position=(0.5, -0.2, 0.3), offset=40.0)
    pixels = np.random.default_rng(seed).uniform([0, 0], [1000, 600], (50, 2))
    rays = pixel_rays(pixels, view)
    np.testing.assert_allclose(np.linalg.norm(rays, axis=1), 1)
    centre = -np.linalg.solve(view.pixels_from_lidar[:, :3], view.pixels_from_lidar[:, 3])
    inside = pixels_in_field(pixels, view)
    again = project_points(centre + away * rays, view)[0]
    np.testing.assert_allclose(again[inside], pixels[inside], atol=1e-5)


def test_rays_as_opencv_undistorts():
    rng = np.random.default_rng(0)
    pixels = rng.uniform([50, 50], [950, 550], (200, 2))
    for lens, undistort in (
        (Distortion("brown_conrady", (-0.1, 0.02, 0.001, -0.002)), cv2.undistortPoints),
        (Distortion("fisheye", (0.05, -0.01, 0.002, 0)), cv2.fisheye.undistortPoints),
    ):
        view = camera(lens)
        plane = undistort(pixels[:, None], np.array(view.intrinsics), np.array(lens.coefficients))[:, 0]
        rays = pixel_rays(pixels, view) @ AXES.T
        np.testing.assert_allclose(rays[:, :2] / rays[:, 2:], plane, atol=1e-3)


def test_equidistant_by_hand():
    view = camera(EQUIDISTANT, width=1400, height=600)
    # 45 degrees to the right is pi / 4 focal lengths; straight to the right, depth 0, pi / 2; 94 degrees still seen
    turn = np.deg2rad([45, 90, 94, 96])
    pixels, depths = project_points(10 * np.column_stack([np.cos(turn), -np.sin(turn), np.zeros(4)]), view)
    np.testing.assert_allclose(pixels[:3, 0], 700 + 400 * turn[:3])
    assert np.isnan(pixels[3]).all()
    assert depths[1] == pytest.approx(0, abs=1e-9)
    assert depths[2] < 0


def brute(box, view, count=60):
    """Extent of the image of many points on a box's surface."""
    side = np.linspace(-0.5, 0.5, count)
    a, b = (v.ravel() for v in np.meshgrid(side, side))
    faces = [np.insert(np.column_stack([a, b]), axis, at, axis=1) for axis in range(3) for at in (-0.5, 0.5)]
    local = np.concatenate(faces) * box[3:6]
    cos, sin = np.cos(box[6]), np.sin(box[6])
    turned = np.column_stack(
        [cos * local[:, 0] - sin * local[:, 1], sin * local[:, 0] + cos * local[:, 1], local[:, 2]]
    )
    pixels = project_points(turned + box[:3], view)[0]
    pixels = pixels[~np.isnan(pixels[:, 0])]
    if not len(pixels):
        return None
    ends = np.concatenate([pixels.min(axis=0), pixels.max(axis=0)])
    return np.clip(ends, 0, [view.width, view.height] * 2)


@settings(max_examples=150, deadline=None)
@given(
    st.sampled_from(
        [
            EQUIDISTANT,
            Distortion("fisheye", (0.05, -0.01, 0.002, 0)),
            Distortion("brown_conrady", (-0.1, 0.03, 0.001, 0.002)),
        ]
    ),
    st.floats(3, 30),
    st.floats(-np.pi, np.pi),
    st.floats(-2, 2),
    st.floats(0.5, 5),
    st.floats(0.5, 2.5),
    st.floats(-3, 3),
)
def test_boxes_bound_the_image_of_their_surface(distortion, away, around, up, length, width, yaw):
    view = camera(distortion, width=1400, height=1400, turn=(0.1, 0.05, 0.0))
    box = np.array([away * np.cos(around), away * np.sin(around), up, length, width, 1.6, yaw])
    (found,), (seen,) = project_boxes(box[None], view)
    expected = brute(box, view)
    if expected is None or (expected[2:] - expected[:2]).min() < 2:
        return
    assert seen
    # the surface is sampled: it may fall short of the bounds by its grain, and never lies outside of them
    grain = 0.02 * (expected[2:] - expected[:2]).max() + 1.5
    assert (found[:2] <= expected[:2] + 0.6).all()
    assert (found[2:] >= expected[2:] - 0.6).all()
    if away > 8:
        np.testing.assert_allclose(found, expected, atol=grain)


def test_bent_sides_bulge_beyond_the_corners():
    # a wall above the axis: its upper edge bends away from the middle, so the corners alone would cut it off
    view = camera(EQUIDISTANT, width=1400, height=1400)
    wall = np.array([[5.0, 0, 2, 0.1, 16, 2, 0]])
    (found,), _ = project_boxes(wall, view)
    corners = project_points(box_corners(wall)[0], view)[0]
    assert found[1] < corners[:, 1].min() - 30
    assert found[1] == pytest.approx(700 - 440 * np.arctan2(3, 4.95), abs=0.5)


def test_boxes_behind_the_field_are_not_visible_and_those_around_the_camera_fill_it():
    view = camera(EQUIDISTANT, width=1400, height=1400)
    found, seen = project_boxes(np.array([[-10.0, 0, 0, 4, 2, 2, 0], [0, 0, 0, 6, 6, 6, 0.3]]), view)
    assert seen.tolist() == [False, True]
    assert found[0].tolist() == [0, 0, 0, 0]
    radius = np.deg2rad(95)
    np.testing.assert_allclose(
        found[1], [700 - 400 * radius, max(700 - 440 * radius, 0), 700 + 400 * radius, min(700 + 440 * radius, 1400)]
    )


def test_box_beside_the_camera_ends_where_the_field_does():
    # a lorry from 10 m ahead to 10 m behind, 3 m to the right: its right end is the field's border at eye level
    view = camera(EQUIDISTANT, width=1400, height=1400)
    (found,), (seen,) = project_boxes(np.array([[0.0, -4, 0, 20, 2, 3, 0]]), view)
    assert seen
    assert found[2] == pytest.approx(700 + 400 * np.deg2rad(95), abs=0.5)
    # and its left end are the corners of the front, 1.5 m above and below
    across = np.hypot(3, 1.5)
    assert found[0] == pytest.approx(700 + 400 * np.arctan2(across, 10) * 3 / across)


def test_weak_lens_is_nearly_the_pinhole():
    boxes = np.array([[12.0, 3, 0.2, 4, 1.8, 1.5, 0.4], [8, -5, -0.5, 0.7, 0.6, 1.8, 1.0], [2, 1, 0, 5, 2, 2, 0.1]])
    straight, _ = project_boxes(boxes, camera(None))
    bent, _ = project_boxes(boxes, camera(Distortion("brown_conrady", (1e-9, 0, 0, 0))))
    np.testing.assert_allclose(bent, straight, atol=0.05)


def test_edges_follow_the_image_of_the_edges():
    view = camera(Distortion("fisheye", (0.05, -0.01, 0.002, 0)), width=1400, height=1400)
    box = np.array([[4.0, 3, 0, 4, 2, 2, 0.4]])
    edges = edges_through_lens(box, view)
    assert edges.shape[:2] == (1, len(EDGES))
    corners = box_corners(box)[0]
    for (a, b), line in zip(EDGES, edges[0], strict=True):
        line = line[~np.isnan(line[:, 0])]
        dense = project_points(corners[a] + np.linspace(0, 1, 2000)[:, None] * (corners[b] - corners[a]), view)[0]
        away = np.linalg.norm(line[:, None] - dense[None], axis=2).min(axis=1)
        assert away.max() < 0.5
        np.testing.assert_allclose(line[[0, -1]], dense[[0, -1]], atol=1e-6)


def test_faces_are_drawn_whole_or_not_at_all():
    view = camera(EQUIDISTANT, width=1400, height=1400)
    face = np.array([[5.0, 1, 1], [5, -1, 1], [5, -1, -1], [5, 1, -1]])
    around = polygon_through_lens(face, view)
    assert len(around) > 4
    np.testing.assert_allclose(around.mean(axis=0), [700, 700], atol=1)
    assert len(polygon_through_lens(face - [10, 0, 0], view)) == 0


@pytest.mark.parametrize("yaw", [0.0, 0.6, 1.2, 1.5])
def test_local_projection_shows_an_object_where_the_lens_does(yaw):
    view = camera(Distortion("fisheye", (0.05, -0.01, 0.002, 0)), width=1800, height=1400)
    box = np.array([[15 * np.cos(yaw), 15 * np.sin(yaw), -1, 4, 1.8, 1.6, 0.3]])
    (bounds,), _ = project_boxes(box, view)
    local = Camera("local", local_projection(view, bounds), np.eye(4), view.width, view.height)
    (found,), _ = project_boxes(box, local)
    # far off the axis the lens shears, which no pinhole has
    assert image_iou(found[None], bounds[None])[0, 0] > (0.97 if yaw < 1 else 0.9)
    # depths are along the ray through its middle
    assert project_points(box[:, :3], local)[1][0] == pytest.approx(15, abs=0.2)


def test_pixels_outside_of_the_field_look_at_its_border():
    view = camera(EQUIDISTANT, width=1400, height=1400)
    corner = np.array([[1400.0, 700], [1399, 1399]])
    assert pixels_in_field(corner, view).tolist() == [False, False]
    rays = pixel_rays(corner, view) @ AXES.T
    np.testing.assert_allclose(np.arccos(rays[:, 2]), np.deg2rad(95))
    assert rays[0, 0] == pytest.approx(np.sin(np.deg2rad(95)))
    assert np.isfinite(local_projection(view, np.array([1300.0, 1300, 1400, 1400]))).all()


def test_no_points_and_no_boxes():
    view = camera(EQUIDISTANT)
    assert project_points(np.zeros((0, 3)), view)[0].shape == (0, 2)
    assert project_boxes(np.zeros((0, 7)), view)[0].shape == (0, 4)
    assert np.isnan(project_points(np.array([[np.nan, 0, 0], [0, 0, 0]]), view)[0]).all()


def test_formats_without_lenses_refuse_them():
    require_pinhole(camera(None), "it")
    with pytest.raises(ConfigError, match="the KITTI layout has no place for the fisheye distortion of camera 'front'"):
        require_pinhole(camera(EQUIDISTANT), "the KITTI layout")


def test_boxes_that_the_field_cuts_are_known():
    view = camera(EQUIDISTANT, width=1400, height=1400)
    boxes, _ = project_boxes(np.array([[0.0, -4, 0, 20, 2, 3, 0], [10, 0, 0, 4, 2, 2, 0]]), view)
    assert cut_by_field(boxes, view).tolist() == [True, False]
    assert cut_by_field(boxes, camera(None)).tolist() == [False, False]
