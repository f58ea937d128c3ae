from __future__ import annotations

import io

import numpy as np
import PIL.Image
import pytest
from hypothesis import given
from hypothesis import strategies as st

from lcf3d.visualization.png import png_bytes
from lcf3d.visualization.strokes import Strokes

WHITE = (255, 255, 255)


def drawn(segments: list[list[float]], width: float = 2.0, opacity: float = 1.0) -> np.ndarray:
    pixels = np.zeros((40, 60, 3), np.uint8)
    Strokes(pixels).lines(np.array(segments, dtype=float), WHITE, width, opacity)
    return pixels[..., 0].astype(int)


def test_a_line_covers_its_width_and_length() -> None:
    level = drawn([[10, 20, 30, 20]])
    # two rows, twenty columns; the round ends add half a disc each
    assert (level[19:21, 10:30] == 255).all()
    assert level[:, 10:30].sum() == 40 * 255
    # distances are taken at the centres of pixels: a disc of radius 1 comes out near its area
    assert level.sum() / 255 == pytest.approx(40 + np.pi, abs=0.6)
    np.testing.assert_array_equal(level.T[:40, :40], drawn([[20, 10, 20, 30]])[:40, :40])


def test_lines_that_cross_cover_once() -> None:
    cross = drawn([[10, 20, 30, 20], [20, 10, 20, 30]], opacity=0.5)
    assert cross.max() == 128
    assert cross[20, 20] == 128


def test_what_is_far_away_or_no_number_does_no_harm() -> None:
    level = drawn([[-1e9, 20, 1e9, 20], [np.nan, 0, 9, 9], [0, 0, np.inf, 5], [1e200, 0, 1e200, 40]])
    assert (level[19:21] == 255).all()
    assert level.sum() == 2 * 60 * 255
    assert drawn([[200, 200, 300, 300]]).sum() == 0
    # a point is a dot
    assert 1 < drawn([[30, 20, 30, 20]]).sum() / 255 < 5


@given(st.lists(st.floats(-90, 150), min_size=4, max_size=4), st.floats(0.5, 4))
def test_a_line_is_where_its_points_are(ends: list[float], width: float) -> None:
    level = drawn([ends], width)
    a, b = np.array(ends[:2]), np.array(ends[2:])
    rows, columns = np.mgrid[:40, :60] + 0.5
    centres = np.stack([columns, rows], axis=-1)
    along = np.clip(((centres - a) @ (b - a)) / max((b - a) @ (b - a), 1e-12), 0, 1)
    distance = np.linalg.norm(centres - a - along[..., None] * (b - a), axis=-1)
    assert (level[distance > width / 2 + 0.51] == 0).all()
    assert (level[distance < width / 2 - 0.51] == 255).all()


def test_a_polygon_is_filled_by_the_centres_of_pixels() -> None:
    pixels = np.zeros((20, 20, 3), np.uint8)
    Strokes(pixels).polygon(np.array([[2.0, 3], [8, 3], [8, 7], [2, 7]]), WHITE, 0.5)
    expected = np.zeros((20, 20), int)
    expected[3:7, 2:8] = 128
    np.testing.assert_array_equal(pixels[..., 1], expected)
    # a polygon that folds back: the notch stays empty
    pixels[:] = 0
    Strokes(pixels).polygon(np.array([[0.0, 0], [30, 0], [30, 9], [10, 1], [-5, 9]]), WHITE, 1.0)
    assert pixels[0, 0, 0] == 255
    assert pixels[7, 10, 0] == 0


@given(st.integers(2, 9), st.integers(1, 9), st.integers(0, 1000))
def test_a_png_reads_as_it_was(width: int, height: int, seed: int) -> None:
    pixels = np.random.default_rng(seed).integers(0, 256, (height, width, 3), dtype=np.uint8)
    with PIL.Image.open(io.BytesIO(png_bytes(pixels))) as picture:
        picture.load()
        assert picture.mode == "RGB"
        np.testing.assert_array_equal(np.asarray(picture), pixels)
