from dataclasses import replace
from pathlib import Path

import numpy as np
import PIL.Image
import pytest

from lcf3d.fusion.memory import remember_sequence
from lcf3d.reasons import Outcome
from lcf3d.visualization.bev import BevView, draw_bev
from lcf3d.visualization.png import GIF_MS, save_gif
from lcf3d.visualization.scene import COLOURS, Scene
from lcf3d.visualization.trails import Trails
from tests.fusion.scenes import car
from tests.fusion.test_memory import drive, frame, fused, moved


def driven(n: int = 6, missing: tuple[int, ...] = ()):
    """A sensor that drives at 5 m/s towards a car that stands 30 m ahead of where it began."""
    frames = [
        (frame(0.1 * t, moved(0.5 * t)), fused(*(([], []) if t in missing else ([car(30 - 0.5 * t, 2.0)], [0.9]))))
        for t in range(n)
    ]
    return [(f, d) for (f, _), d in zip(frames, remember_sequence(frames), strict=True)]


def test_what_stands_has_been_where_it_is() -> None:
    trails = Trails()
    for t, (one, found) in enumerate(driven()):
        (way,) = trails(one, found)
        assert len(way) == t + 1
        np.testing.assert_allclose(way[:, 0], 30 - 0.5 * t, atol=1e-6)


def test_what_moves_leaves_a_way_of_the_last_seconds_only() -> None:
    trails = Trails(seconds=0.25)
    pairs = drive(10.0, missing=set(), n=8)
    for (one, _), found in zip(pairs, remember_sequence(pairs), strict=True):
        (way,) = trails(one, found)
    np.testing.assert_allclose(way[:, 0], [20, 21, 22], atol=0.2)
    np.testing.assert_array_equal(way[-1], found.detections.boxes[0, :3])


@pytest.mark.parametrize("change", [{"sequence": "other"}, {"timestamp": 0.0}])
def test_another_drive_begins_anew(change: dict[str, object]) -> None:
    trails = Trails()
    (first, found), (second, later) = driven(2)
    trails(first, found)
    for name, value in change.items():
        setattr(second, name, value)
    assert [len(way) for way in trails(second, later)] == [1]


def test_without_tracks_pose_or_time_there_is_no_trail() -> None:
    trails = Trails()
    one, found = driven(1)[0]
    assert [len(way) for way in trails(one, replace(found, tracks=None))] == [0]
    for name in ("timestamp", "world_from_lidar"):
        other = driven(1)[0][0]
        setattr(other, name, None)
        assert [len(way) for way in trails(other, found)] == [0]


def test_predicted_boxes_are_drawn_with_their_number_and_trail() -> None:
    trails = Trails()
    for one, found in driven(6, missing=(5,)):
        ways = trails(one, found)
    assert found.outcomes.tolist() == [Outcome.PREDICTED]
    assert found.origins == ["predicted"]
    scene = Scene.from_fused(found, trails=ways)
    assert scene.outcomes == ("predicted",)
    assert scene.texts[0].endswith(f"#{found.tracks.ids[0]}")
    assert scene.counts == {"predicted": 1}
    view = BevView.fit(scene.boxes, one.cameras, 400, 300)
    with_trail = np.asarray(draw_bev(None, one.cameras, scene, view)).astype(int)
    assert (np.abs(with_trail - COLOURS["predicted"]).max(axis=-1) <= 12).sum() > 30
    # a way of its own: from beside the box to its centre
    far = replace(scene, trails=[np.array([[15.0, 2.0, 0.0], [20.0, 2.0, 0.0]])])
    x, y = view.pixels(np.array([17.0, 2.0])).round().astype(int)
    drawn = np.asarray(draw_bev(None, one.cameras, far, view)).astype(int)
    assert np.abs(drawn[y - 2 : y + 3, x] - with_trail[y - 2 : y + 3, x]).max() > 60


def test_low_scores_take_their_trails_with_them() -> None:
    ways = [np.full((2, 3), float(i)) for i in range(2)]
    two = next(iter(remember_sequence([(frame(0.0), fused([car(20), car(30)], [0.9, 0.2]))])))
    scene = Scene.from_fused(two, least_score=0.5, trails=ways)
    assert len(scene.trails) == 1
    assert scene.trails[0][0, 0] == 0


def test_a_moving_picture_takes_its_time(tmp_path: Path) -> None:
    colours = [(255, 0, 0), (0, 255, 0), (0, 0, 255)]
    sizes = [(40, 20), (40, 20), (20, 20)]
    pictures = [PIL.Image.new("RGB", size, colour) for size, colour in zip(sizes, colours, strict=True)]
    save_gif(zip((0.0, 0.1, None), pictures, strict=True), tmp_path / "new" / "drive.gif")
    with PIL.Image.open(tmp_path / "new" / "drive.gif") as picture:
        assert picture.size == (20, 10)
        assert picture.n_frames == 3
        durations = []
        for i in range(3):
            picture.seek(i)
            durations.append(picture.info["duration"])
    assert durations == [100, GIF_MS, GIF_MS]
