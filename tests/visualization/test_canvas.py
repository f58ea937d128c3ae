from __future__ import annotations

import numpy as np
import PIL.Image
import PIL.ImageDraw
from hypothesis import given
from hypothesis import strategies as st

from lcf3d.visualization.canvas import Canvas, clip_segments, font, plain, text_size

RED = (255, 0, 0)
coordinate = st.floats(-1e6, 1e6)


def black(width: int = 60, height: int = 40) -> PIL.Image.Image:
    return PIL.Image.new("RGB", (width, height))


def test_clipping_by_hand() -> None:
    bounds = (0.0, 0.0, 10.0, 10.0)
    segments = np.array(
        [[-5, 5, 15, 5], [2, 3, 4, 5], [-5, -5, -1, -1], [5, -5, 5, 15], [0, -10, 20, 10], [np.nan, 0, 1, 1]],
        dtype=float,
    )
    expected = [[0, 5, 10, 5], [2, 3, 4, 5], [5, 0, 5, 10], [10, 0, 10, 0]]
    np.testing.assert_allclose(clip_segments(segments, bounds), expected, atol=1e-12)
    assert clip_segments(np.array([[12.0, 0, 12, 9]]), bounds).shape == (0, 4)


@given(st.lists(st.tuples(coordinate, coordinate, coordinate, coordinate), max_size=5))
def test_clipped_segments_lie_within_and_on_the_line(rows: list[tuple[float, float, float, float]]) -> None:
    segments = np.array(rows, dtype=float).reshape(-1, 4)
    for clipped in clip_segments(segments, (0.0, 0.0, 100.0, 50.0)).reshape(-1, 4):
        tolerance = 1e-6 * (1 + np.abs(segments).max())
        assert (clipped >= -tolerance).all()
        assert (clipped <= np.array([100, 50, 100, 50]) + tolerance).all()


def test_lines_are_smooth_and_where_they_should_be() -> None:
    canvas = Canvas(black())
    canvas.lines(np.array([[-100.0, 20, 160, 20]]), RED, width=2.0)
    pixels = np.asarray(canvas.image())[..., 0].astype(int)
    # two rows' worth of ink around row 20 in every column, none far from it
    assert pixels[18:22].sum(axis=0).min() > 1.5 * 255
    assert pixels[:17].max() == pixels[24:].max() == 0
    diagonal = Canvas(black())
    diagonal.lines(np.array([[0.0, 0, 60, 37]]), RED, width=1.0)
    assert len(np.unique(np.asarray(diagonal.image())[..., 0])) > 3


def test_dashes_leave_gaps_and_opacity_dims() -> None:
    pictures = {}
    for name, settings in {"full": {}, "dashed": {"dashed": True}, "dim": {"opacity": 0.5}}.items():
        canvas = Canvas(black())
        canvas.lines(np.array([[0.0, 20, 60, 20]]), RED, width=1.0, **settings)  # type: ignore[arg-type]
        pictures[name] = np.asarray(canvas.image())[..., 0].astype(int).max(axis=0)
    assert (pictures["full"] > 0).all()
    assert 0.25 < (pictures["dashed"] == 0).mean() < 0.5
    assert 0.4 < pictures["dim"].max() / pictures["full"].max() < 0.6


def test_labels_keep_out_of_each_others_way() -> None:
    canvas = Canvas(black(120, 100))
    box = [30, 40, 60, 60]
    placed = [canvas.label(box, "Car 0.90", RED) for _ in range(12)]
    assert placed[0]
    assert not placed[-1]
    places = [label.place for label in canvas._labels]
    assert len(places) == sum(placed) > 2
    for i, a in enumerate(places):
        assert 0 <= a[0] < a[2] <= 120
        assert 0 <= a[1] < a[3] <= 100
        for b in places[:i]:
            assert a[0] >= b[2] or b[0] >= a[2] or a[1] >= b[3] or b[1] >= a[3]


def test_text_is_drawn_and_the_background_kept() -> None:
    background = black()
    canvas = Canvas(background)
    canvas.text(2, 2, "42", (255, 255, 255))
    assert np.asarray(canvas.image()).max() > 200
    assert np.asarray(background).max() == 0


def test_a_text_looks_as_pillow_draws_it_and_stays_in_the_picture() -> None:
    # words are placed to the pixel, so that only the first is where Pillow has it to a fraction
    for text in ("0.93", "pedestrian"):
        canvas = Canvas(black(80, 30))
        canvas.text(10, 5, text, (255, 255, 255), size=12)
        expected = black(80, 30)
        place = (10, 5 + text_size(text, 12)[1] / 2)
        PIL.ImageDraw.Draw(expected).text(place, text, fill=(255, 255, 255), font=font(12), anchor="lm")
        difference = np.abs(np.asarray(canvas.image()).astype(int) - np.asarray(expected).astype(int))
        assert difference.max() <= 1
    both = Canvas(black(160, 30))
    both.text(10, 5, "pedestrian 0.93", (255, 255, 255), size=12)
    inked = np.flatnonzero(np.asarray(both.image()).any(axis=(0, 2)))
    assert abs(np.ptp(inked) + 1 - font(12).getlength("pedestrian 0.93")) <= 3
    assert np.asarray(expected).max() > 200
    # one that begins outside is cut
    outside = Canvas(black(20, 12))
    outside.text(-30, -4, "pedestrian 0.99", RED, plate=True)
    assert np.asarray(outside.image()).shape == (12, 20, 3)


def test_pixels_of_one_colour() -> None:
    assert (plain(3, 5, (1, 2, 3)) == [1, 2, 3]).all()
