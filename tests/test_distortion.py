import numpy as np
import pytest

from lcf3d import Camera, Distortion
from lcf3d.distortion import field_of
from lcf3d.errors import ConfigError

K = np.array([[400.0, 0, 500], [0, 400, 300], [0, 0, 1]])
PROJECTION = np.column_stack([K, np.zeros(3)])


def camera(distortion, projection=PROJECTION):
    return Camera("front", projection, np.eye(4), 1000, 600, distortion)


@pytest.mark.parametrize(("model", "count"), [("brown_conrady", 6), ("brown_conrady", 14), ("fisheye", 5)])
def test_wrong_number_of_coefficients(model, count):
    with pytest.raises(ConfigError, match=rf"needs .* coefficients \(k1 k2 .*\), got {count}"):
        Distortion(model, (0.1,) * count)


def test_coefficients_must_be_finite():
    with pytest.raises(ConfigError, match="finite"):
        Distortion("fisheye", (0.1, np.nan, 0, 0))


def test_unknown_model():
    with pytest.raises(ConfigError, match="brown_conrady, fisheye, got 'omni'"):
        Distortion("omni", (0.1,) * 4)


def test_bare_coefficients_need_a_model():
    with pytest.raises(ConfigError, match=r"'front': distortion must be a Distortion\(model, coefficients\), got list"):
        camera([0.1, 0.1, 0.0, 0.0])


def test_a_lens_of_zeros_is_a_pinhole():
    assert camera(Distortion("brown_conrady", (0,) * 5)).distortion is None
    # a fisheye of zeros is equidistant, no pinhole
    assert camera(Distortion("fisheye", (0,) * 4)).distortion is not None


def test_model_that_folds_back_inside_the_image():
    # r (1 - r^2 / 3) is largest at r = 1: 45 degrees, 0.67 focal lengths, but the corners lie at 583 / 400 = 1.46
    with pytest.raises(ConfigError, match=r"'front': its brown_conrady .*45\.0 degrees.*0\.67 of the 1\.46 focal"):
        camera(Distortion("brown_conrady", (-1 / 3, 0, 0, 0)))
    # t (1 - t^2 / 3) is largest at t = 1 = 57.3 degrees: 0.67 of the 0.75 to the nearest border
    with pytest.raises(ConfigError, match=r"57\.[23] degrees.*0\.67 of the 0\.75 focal"):
        camera(Distortion("fisheye", (-1 / 3, 0, 0, 0)))


def test_a_pole_inside_the_image_is_refused():
    # 1 - r^2 / 1 is zero at 45 degrees; before it the radius grows without bounds and nothing folds
    lens = Distortion("brown_conrady", (0, 0, 0, 0, 0, -1, 0, 0))
    assert camera(lens).lens_field.half_angle < np.deg2rad(45)
    with pytest.raises(ConfigError, match="folds back"):
        camera(Distortion("brown_conrady", (-1.2, 0, 0, 0, 0, -1, 0, 0)))


def test_field_ends_where_the_model_does():
    # equidistant: 95 degrees, unless the image is left behind before: 1.5 times 1.458 rad is more
    assert camera(Distortion("fisheye", (0,) * 4)).lens_field.half_angle == pytest.approx(np.deg2rad(95))
    # the fold of t (1 - t^2 / 12) at t = 2 lies beyond 95 degrees; a small image is left at 1.5 times its corner
    small = field_of(Distortion("fisheye", (0,) * 4), K, 1000, 600)
    assert small.radii[-1] == pytest.approx(small.half_angle)
    narrow = Camera(
        "n",
        PROJECTION * [[4], [4], [1]] + [[0, 0, -1500, 0], [0, 0, -900, 0], [0] * 4],
        np.eye(4),
        1000,
        600,
        Distortion("fisheye", (0,) * 4),
    )
    assert narrow.lens_field.half_angle == pytest.approx(1.5 * np.hypot(500, 300) / 1600, abs=1e-3)


def test_projection_with_a_pose_in_it_is_refused_with_a_lens():
    turned = PROJECTION.copy()
    turned[:, :3] = K @ [[0, -1, 0], [0, 0, -1], [1, 0, 0]]
    assert camera(None, turned).distortion is None
    with pytest.raises(ConfigError, match="give the pose in camera_from_lidar"):
        camera(Distortion("fisheye", (0.01, 0, 0, 0)), turned)
