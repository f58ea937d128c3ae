import numpy as np
import pytest

from lcf3d.detectors.camera.onnx_images import PADDING
from lcf3d.training.camera_augmentation import Augmentation, cut, draw_view, mirrored
from lcf3d.training.camera_images import IGNORED
from tests.training.camera_pictures import COLOURS, picture

CAR = ("Car", (20, 16, 60, 48))


def test_a_cut_at_scale_one_copies_pixels() -> None:
    source = picture([CAR])
    view = cut(source, (32, 32), 1.0, np.array([16.0, 8.0]))
    np.testing.assert_array_equal(view.image, source.image[8:40, 16:48])
    assert source.owner is not None
    np.testing.assert_array_equal(view.owner, source.owner[8:40, 16:48])
    np.testing.assert_allclose(view.boxes, [[4, 8, 32, 32]])


@pytest.mark.parametrize("scale", [0.5, 0.73, 1.0, 1.61, 2.0])
def test_boxes_pixels_and_masks_stay_together(scale: float) -> None:
    source = picture([CAR])
    view = cut(source, (96, 192), scale, np.array([-5.0, -3.0]))
    red = (view.image[..., 0] > 145) & (view.image[..., 1] < 80)
    rows, columns = np.flatnonzero(red.any(axis=1)), np.flatnonzero(red.any(axis=0))
    seen = [columns[0], rows[0], columns[-1] + 1, rows[-1] + 1]
    np.testing.assert_allclose(view.boxes[0], seen, atol=1.01)
    assert view.owner is not None
    owned = view.owner == view.numbers[0]
    assert (owned & red).sum() / (owned | red).sum() > 0.85


def test_outside_the_image_is_grey() -> None:
    view = cut(picture([CAR]), (64, 128), 1.0, np.array([-16.0, 0.0]))
    assert (view.image[:, :16] == PADDING).all()
    assert (view.image[:, 112:] == PADDING).all()
    assert (cut(picture([CAR]), (32, 32), 1.0, np.array([500.0, 0.0])).image == PADDING).all()


def test_objects_cut_off_or_too_small_are_ignored_and_those_outside_left_out() -> None:
    source = picture([CAR, ("Pedestrian", (80, 20, 86, 40))])
    assert cut(source, (64, 64), 1.0, np.array([55.0, 0.0])).labels.tolist() == [IGNORED, 1]
    assert cut(source, (32, 48), 0.4, np.array([0.0, 0.0])).labels.tolist() == [0, IGNORED]
    assert cut(source, (64, 32), 1.0, np.array([0.0, 0.0])).labels.tolist() == [0]


def test_mirroring_twice_changes_nothing() -> None:
    source = picture([CAR])
    once = mirrored(source)
    np.testing.assert_allclose(once.boxes, [[36, 16, 76, 48]])
    np.testing.assert_array_equal(once.image[30, 40], COLOURS["Car"])
    twice = mirrored(once)
    np.testing.assert_array_equal(twice.image, source.image)
    np.testing.assert_allclose(twice.boxes, source.boxes)


def test_equal_generators_draw_equal_views() -> None:
    source = picture([CAR, ("Cyclist", (70, 20, 80, 40))])
    first, second = (draw_view(source, (32, 64), Augmentation(), np.random.default_rng(3)) for _ in range(2))
    np.testing.assert_array_equal(first.image, second.image)
    np.testing.assert_array_equal(first.boxes, second.boxes)


def test_views_that_seek_hold_the_pedestrian() -> None:
    source = picture([CAR, ("Pedestrian", (150, 20, 160, 44))], size=(64, 400))
    settings = Augmentation(scales=(1.0, 1.0), sought=1.0)
    for seed in range(20):
        assert 1 in draw_view(source, (64, 96), settings, np.random.default_rng(seed)).labels


def test_images_without_objects_give_views_without_objects() -> None:
    view = draw_view(picture([]), (32, 64), Augmentation(), np.random.default_rng(0))
    assert view.image.shape == (32, 64, 3)
    assert view.boxes.shape == (0, 4)
