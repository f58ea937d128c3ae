from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from lcf3d.detectors.camera.onnx_images import PADDING, prepare_image
from lcf3d.detectors.camera.onnx_layouts import LAYOUTS


def red(height: int, width: int) -> np.ndarray:
    image = np.zeros((height, width, 3), dtype=np.uint8)
    image[..., 0] = 255
    return image


def test_yolox_wants_blue_first_and_the_image_in_the_top_left() -> None:
    values, placement = prepare_image(red(50, 100), (64, 64), LAYOUTS["yolox"])
    assert values.shape == (1, 3, 64, 64)
    assert values.dtype == np.float32
    np.testing.assert_array_equal(values[0, :, 0, 0], [0, 0, 255])
    np.testing.assert_array_equal(values[0, :, 40, 0], [PADDING] * 3)
    assert placement.scale == (0.64, 0.64)
    assert placement.offset == (0, 0)


def test_ultralytics_wants_red_first_and_the_image_in_the_middle() -> None:
    values, placement = prepare_image(red(50, 100), (64, 64), LAYOUTS["ultralytics"])
    np.testing.assert_allclose(values[0, :, 32, 32], [1, 0, 0])
    np.testing.assert_allclose(values[0, :, 15, 32], [PADDING / 255] * 3, rtol=1e-6)
    assert placement.offset == (0, 16)


def test_detr_wants_the_image_stretched_and_perhaps_normalised() -> None:
    values, placement = prepare_image(red(50, 100), (64, 64), LAYOUTS["detr"], imagenet=True)
    np.testing.assert_allclose(values[0, 0], (1 - 0.485) / 0.229, rtol=1e-5)
    np.testing.assert_allclose(values[0, 2], (0 - 0.406) / 0.225, rtol=1e-5)
    assert placement.scale == (0.64, 1.28)


@given(
    st.sampled_from(sorted(LAYOUTS)), st.integers(1, 300), st.integers(1, 300), st.sampled_from([(64, 64), (32, 96)])
)
def test_the_whole_image_comes_back(name: str, height: int, width: int, size: tuple[int, int]) -> None:
    _, placement = prepare_image(np.zeros((height, width, 3), dtype=np.uint8), size, LAYOUTS[name])
    (x, y), (sx, sy) = placement.offset, placement.scale
    box = np.array([[x, y, x + width * sx, y + height * sy]])
    assert (box[:, 2:] <= np.array([size[1], size[0]]) + 1e-9).all()
    np.testing.assert_allclose(placement.to_image(box), [[0, 0, width, height]], atol=1e-6)


def test_an_image_that_almost_fills_the_input_is_not_resampled() -> None:
    image = np.random.default_rng(0).integers(0, 256, (63, 95, 3)).astype(np.uint8)
    values, placement = prepare_image(image, (64, 96), LAYOUTS["ultralytics"])
    assert placement.scale == (1, 1)
    assert placement.offset == (0, 0)
    np.testing.assert_array_equal(values[0, :, :63, :95], image.transpose(2, 0, 1) / np.float32(255))
    np.testing.assert_array_equal(values[0, :, 63:], np.float32(PADDING) / np.float32(255))
    # one that is larger by as little is
    assert prepare_image(np.zeros((65, 97, 3), np.uint8), (64, 96), LAYOUTS["ultralytics"])[1].scale[0] < 1


def test_what_lies_in_the_padding_is_clipped() -> None:
    _, placement = prepare_image(red(50, 100), (64, 64), LAYOUTS["ultralytics"])
    clipped = placement.to_image(np.array([[-5.0, 0.0, 32.0, 64.0]]))
    assert clipped.tolist() == [pytest.approx([0, 0, 50, 50])]
