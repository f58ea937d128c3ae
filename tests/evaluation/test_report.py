import re
from html.parser import HTMLParser
from pathlib import Path

import numpy as np

from lcf3d.datasets.kitti import KittiCalibration
from lcf3d.evaluation.kitti import KittiEvaluator
from lcf3d.evaluation.kitti_breakdown import compare
from lcf3d.evaluation.kitti_study import study
from lcf3d.evaluation.kitti_task import KittiResultSet
from lcf3d.evaluation.pictures import footprint, worst_frame_pictures
from lcf3d.evaluation.report import html_report
from lcf3d.evaluation.study import ClassStudy, FusionOutcomes, Study
from lcf3d.evaluation.svg import Line, Shape, bev_scene, image_scene, line_chart
from lcf3d.structures import Camera, Frame

from .kitti_frames import frames


class Balanced(HTMLParser):
    """Checks that every tag is closed in order, and collects the addresses that the page refers to."""

    VOID = ("meta", "image", "rect", "circle", "line", "polyline")

    def __init__(self) -> None:
        super().__init__()
        self.open: list[str] = []
        self.addresses: list[str] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        if tag not in self.VOID:
            self.open.append(tag)
        self.addresses += [value or "" for name, value in attrs if name in ("href", "src")]

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.addresses += [value or "" for name, value in attrs if name in ("href", "src")]

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag


def parsed(html: str) -> Balanced:
    parser = Balanced()
    parser.feed(html)
    assert parser.open == []
    return parser


TRANSFORM = np.array([[0, -1, 0, 0], [0, 0, -1, 0], [1, 0, 0, 0], [0, 0, 0, 1.0]])


class Calibrated:
    """What the evaluation asks of a dataset."""

    def calibration(self, frame_id: str) -> KittiCalibration:
        return KittiCalibration({}, TRANSFORM)

    def frame(self, frame_id: str) -> Frame:
        image = {"left": np.full((40, 120, 3), 90, np.uint8)} if frame_id == "3" else {}
        view = Camera("left", np.eye(3, 4), TRANSFORM, 120, 40)
        return Frame(frame_id, cameras=[view], images=image)


def result_set(name: str = "run", shift: float = 0.0) -> KittiResultSet:
    truth = frames([[{"location": (0, 1.5, 10 + i)}, {"location": (6, 1.5, 10)}] for i in range(45)], False)
    rows = [[{"location": (shift, 1.5, 10 + i), "score": 1 - i / 100}] for i in range(45)]
    return KittiResultSet(name, Path("nowhere"), KittiEvaluator(truth, frames(rows, True)), Calibrated(), ())


def page(*sets: KittiResultSet, title: str = "t", **more) -> str:
    return html_report(title, [one.study() for one in sets], [one.tables() for one in sets], **more)


def test_report_is_one_whole_page_without_outside_addresses() -> None:
    html = page(result_set("<run>"), title="A & B", pictures={"7: 1 wrong": "<p>x</p>"})
    parser = parsed(html)
    assert parser.addresses == []
    assert "A &amp; B" in html
    assert "<run>" not in html
    assert "Worst frames" in html
    assert html.count("<svg") == 2


def test_report_shows_the_numbers_of_the_metrics() -> None:
    one = result_set()
    html = page(one)
    assert f"<td>{one.metrics.ap('Car', '3d', 'moderate'):.2f}</td>" in html
    assert "0 to 20 m" in html
    # 45 objects found, the other 45 missed, nothing wrong
    assert "<td>45</td><td>0</td><td>45</td><td>1.000</td><td>0.500</td>" in html


def test_two_results_are_compared_in_the_report() -> None:
    first, second = result_set("a", shift=3.0), result_set("b")
    rows = compare(first.evaluator, second.evaluator, samples=20)
    html = page(first, second, comparison=rows)
    parsed(html)
    assert "Side by side" in html
    assert "<span class='good'>" in html
    assert "Car, a" in html
    assert "Car, b" in html
    assert "stroke-dasharray" in html


def test_what_the_fusion_did_is_shown_by_reason() -> None:
    one = result_set().study()
    part = one.classes[0]
    fused = FusionOutcomes(
        {"matched": 31},
        {"downweighted": 3},
        {"unconfirmed": 7},
        {"unconfirmed": 19, "low_score": 5},
        {"dropped": 7, "below_threshold": 2, "not_proposed": 36},
    )
    changed = ClassStudy(**{**part.__dict__, "fusion": fused})
    html = html_report("t", [Study(**{**one.__dict__, "classes": (changed,)})], [[]])
    parsed(html)
    assert "<th>matched</th><th>downweighted</th>" in html
    assert "<td>right</td><td>31</td><td>0</td>" in html
    assert "<td>unconfirmed</td><td>19</td><td>7</td>" in html
    assert "<td>low score</td><td>5</td><td>0</td>" in html
    assert "<td>7</td><td>2</td><td>36</td>" in html


def test_results_without_3d_boxes_have_a_report_too() -> None:
    flat = {"size": (-1, -1, -1), "location": (-1000, -1000, -1000), "alpha": -10}
    rows = [[{**flat, "score": 1 - i / 100}] for i in range(45)]
    evaluator = KittiEvaluator(frames([[]] + [[{}]] * 44, False), frames(rows, True))
    one = study(evaluator, "2d", {}, {}, lambda _: TRANSFORM)
    html = html_report("t", [one], [[]], pictures=worst_frame_pictures(one, Calibrated()))
    parsed(html)
    assert "By distance" not in html
    assert "0: 1 wrong, 0 missed" in html


def test_pictures_of_the_worst_frames_are_embedded() -> None:
    pictures = worst_frame_pictures(result_set().study(), Calibrated(), count=5)
    assert len(pictures) == 5
    with_image = [body for heading, body in pictures.items() if heading.startswith("3:")]
    assert len(with_image) == 1
    assert "href='data:image/jpeg;base64," in with_image[0]
    assert "viewBox='0 0 120 40'" in with_image[0]
    for body in pictures.values():
        parsed(body)
        assert "Car, missed" in body  # the title of the object that nothing found


def test_footprint_has_metres_right_and_forward_with_the_front_first() -> None:
    ahead = np.array([20.0, -1, 0, 4, 2, 1.5, 0.0])
    np.testing.assert_allclose(footprint(ahead), [[0, 22], [2, 22], [2, 18], [0, 18]], atol=1e-12)
    # heading to the left: the front lies to the left
    left = np.array([20.0, -1, 0, 4, 2, 1.5, np.pi / 2])
    np.testing.assert_allclose(footprint(left), [[-1, 19], [-1, 21], [3, 21], [3, 19]], atol=1e-12)


def test_chart_puts_values_where_the_axes_say() -> None:
    svg = line_chart([Line("a<b", [0, 1], [0, 100], "#000")], "x", "y", (0, 1), (0, 100), width=400, height=280)
    parsed(svg)
    assert "a&lt;b" in svg
    points = re.search(r"<polyline points='([^']*)'", svg)
    assert points is not None
    # margins: 46 left, 14 right, 12 above, 40 below
    assert points.group(1) == "46.0,240.0 386.0,12.0"
    assert re.findall(r">(\d+)</text>", svg)[:6] == ["0", "20", "40", "60", "80", "100"]


def test_scenes_draw_each_shape_with_its_title() -> None:
    square = np.array([[-1.0, 11], [1, 11], [1, 9], [-1, 9]])
    bev = bev_scene([Shape(square, "#123456", "Car & co", dashed=True)], width=500)
    parsed(bev)
    assert "<title>Car &amp; co</title>" in bev
    # 25 m reach at least: 500 px over 2 * 13.75 m; the object lies on the vertical centre line
    corners = re.search(r"<polygon points='([^']*)'", bev)
    assert corners is not None
    assert [float(c.split(",")[0]) for c in corners.group(1).split()] == [231.8, 268.2, 268.2, 231.8]
    assert "stroke-dasharray" in bev
    image = image_scene("data:x", 10, 20, [Shape(square, "#123456", "t")])
    parsed(image)
    assert parsed(image).addresses == ["data:x"]
