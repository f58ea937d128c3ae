"""Resizing of images, by hand."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from lcf3d.detectors.resizing import fitted_size, resize_bilinear


def test_fitted_size():
    # KITTI's image in 1280 x 384, as the original says
    assert fitted_size(1242, 375, (1280, 384)) == (1272, 384)
    assert fitted_size(1600, 900, (1333, 800)) == (1333, 750)
    assert fitted_size(900, 1600, (1333, 800)) == (750, 1333)


def test_the_other_size_by_hand():
    image = np.array([[[0] * 3, [100] * 3]], np.uint8)
    # places -0.25, 0.25, 0.75, 1.25 between the centres of the two pixels
    assert resize_bilinear(image, 4, 1)[0, :, 0].tolist() == [0, 25, 75, 100]


@given(st.integers(0, 255), st.integers(1, 9), st.integers(1, 9))
def test_one_colour_stays(value, width, height):
    image = np.full((4, 5, 3), value, np.uint8)
    resized = resize_bilinear(image, width, height)
    assert resized.shape == (height, width, 3)
    # fixed-point sums of an edge may fall short by one
    assert (np.abs(resized.astype(int) - value) <= 1).all()
