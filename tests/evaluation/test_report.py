import base64
import io
import json
import re
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from lcf3d.datasets.kitti_calibration import KittiCalibration
from lcf3d.evaluation.kitti import KittiEvaluator
from lcf3d.evaluation.kitti_breakdown import compare
from lcf3d.evaluation.kitti_study import study
from lcf3d.evaluation.kitti_task import KittiResultSet
from lcf3d.evaluation.pictures import embedded_image, embedded_scan
from lcf3d.evaluation.protocol import TableData
from lcf3d.evaluation.reliability import calibration_error, reliability
from lcf3d.evaluation.report import html_report
from lcf3d.evaluation.report_data import OUTCOMES, report_data
from lcf3d.evaluation.study import ClassStudy, FusionOutcomes, Study
from lcf3d.evaluation.svg import Line, line_chart
from lcf3d.frame import Frame
from lcf3d.structures import Camera

from .kitti_frames import frames


class Balanced(HTMLParser):
    """Checks that every tag is closed in order, and collects the addresses that the page refers to."""

    VOID = ("meta", "link", "rect", "circle", "line", "polyline")

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


def data_of(html: str) -> dict:
    found = re.search(r'<script type="application/json" id="data">(.*?)</script>', html, re.S)
    assert found is not None
    return json.loads(found.group(1))


def rows_of(html: str) -> list[list[str]]:
    """Cells of all table rows, as text."""
    rows = re.findall(r"<tr>(.*?)</tr>", html, re.S)
    return [re.findall(r"<t[hd][^>]*>(.*?)</t[hd]>", row, re.S) for row in rows]


TRANSFORM = np.array([[0, -1, 0, 0], [0, 0, -1, 0], [1, 0, 0, 0], [0, 0, 0, 1.0]])


class Calibrated:
    """What the evaluation and the report ask of a dataset."""

    used_cameras = ("left",)

    def calibration(self, frame_id: str) -> KittiCalibration:
        return KittiCalibration({}, TRANSFORM)

    def frame(self, frame_id: str) -> Frame:
        image = {"left": np.full((40, 120, 3), 90, np.uint8)} if frame_id in ("3", "5") else {}
        points = np.tile(np.array([10, 1, -1, 0], np.float32), (50, 1)) if frame_id == "5" else None
        view = Camera("left", np.eye(3, 4), TRANSFORM, 120, 40)
        return Frame(frame_id, points, cameras=[view], images=image)


def result_set(name: str = "run", shift: float = 0.0) -> KittiResultSet:
    truth = frames([[{"location": (0, 1.5, 10 + i)}, {"location": (6, 1.5, 10)}] for i in range(45)], False)
    rows = [[{"location": (shift, 1.5, 10 + i), "score": 1 - i / 100}] for i in range(45)]
    return KittiResultSet(name, Path("nowhere"), KittiEvaluator(truth, frames(rows, True)), Calibrated(), ())


def page(*sets: KittiResultSet, title: str = "t", **more) -> str:
    return html_report(title, [one.study() for one in sets], [one.tables() for one in sets], **more)


def test_report_is_one_whole_page_without_outside_addresses() -> None:
    html = page(result_set("<run>"), title="A & </script><b>B", origin={"Command": "lcf3d <eval>"})
    outside = [address for address in parsed(html).addresses if not address.startswith(("#", "data:"))]
    assert outside == []
    assert "A &amp; &lt;/script&gt;" in html
    assert "<run>" not in html
    assert "lcf3d &lt;eval&gt;" in html
    assert data_of(html)["runs"][0]["name"] == "<run>"


def test_report_shows_the_numbers_of_the_metrics() -> None:
    one = result_set()
    html = page(one)
    assert f"<td>{one.metrics.ap('Car', '3d', 'moderate'):.2f}</td>" in html
    assert "0 to 20 m" in html
    # 45 objects found, the other 45 missed, nothing wrong
    assert ["Car", "0.56", "45", "0", "45", "1.000", "0.500"] in rows_of(html)


def test_rows_that_go_on_name_their_class_and_sums_stand_below() -> None:
    table = TableData("t", ("class", "m"), [("Car", "2D"), ("", "3D"), None, ("mean", "1")])
    html = html_report("t", [result_set().study()], [[table]])
    assert [row for row in rows_of(html) if len(row) == 2][1:4] == [["Car", "2D"], ["Car", "3D"], ["mean", "1"]]
    assert re.search(r"<tfoot>\s*<tr><th scope=\"row\">mean", html)


def test_two_results_are_compared_in_the_report() -> None:
    first, second = result_set("a", shift=3.0), result_set("b")
    rows = compare(first.evaluator, second.evaluator, samples=20)
    html = page(first, second, comparison=rows)
    parsed(html)
    assert "Side by side" in html
    assert '<td class="good">' in html
    data = data_of(html)
    assert [run["name"] for run in data["runs"]] == ["a", "b"]
    # shifted by 3 m every detection is wrong and every object missed; else one object a frame is missed
    assert [(run["wrong"], run["missed"]) for run in data["frames"][0]["runs"]] == [(1, 2), (0, 1)]


def test_what_the_fusion_did_is_shown_by_reason() -> None:
    one = result_set().study()
    fused = FusionOutcomes(
        {"matched": 31},
        {"downweighted": 3},
        {"unconfirmed": 7},
        {"unconfirmed": 19, "low_score": 5},
        {"dropped": 7, "below_threshold": 2, "not_proposed": 36},
    )
    changed = ClassStudy(**{**one.classes[0].__dict__, "fusion": fused})
    html = html_report("t", [Study(**{**one.__dict__, "classes": (changed,)})], [[]])
    parsed(html)
    rows = rows_of(html)
    assert ["class", "", "matched", "downweighted"] in rows
    assert ["Car", "right", "31", "0"] in rows
    assert ["Car", "unconfirmed", "19", "7"] in rows
    assert ["Car", "low score", "5", "0"] in rows
    assert ["Car", "7", "2", "36"] in rows


def test_results_without_3d_boxes_have_a_report_too() -> None:
    flat = {"size": (-1, -1, -1), "location": (-1000, -1000, -1000), "alpha": -10}
    rows = [[{**flat, "score": 1 - i / 100}] for i in range(45)]
    evaluator = KittiEvaluator(frames([[]] + [[{}]] * 44, False), frames(rows, True))
    one = study(evaluator, "2d", {}, {}, lambda _: TRANSFORM)
    html = html_report("t", [one], [[]], dataset=Calibrated())
    parsed(html)
    assert "By distance" not in html
    worst = data_of(html)["frames"][0]
    assert (worst["id"], worst["runs"][0]["wrong"], worst["runs"][0]["missed"]) == ("0", 1, 0)


def test_data_has_every_frame_worst_first_and_its_boxes() -> None:
    data = report_data([result_set().study()], Calibrated(), worst=8)
    assert len(data["frames"]) == 45
    assert data["left_out"] == 0
    boxes = next(frame for frame in data["frames"] if frame["id"] == "4")["runs"][0]["boxes"]
    assert sorted(OUTCOMES[box["o"]] for box in boxes) == ["found", "missed", "right"]
    right = next(box for box in boxes if OUTCOMES[box["o"]] == "right")
    assert right["s"] == 0.96
    # camera z is forward: LiDAR x
    assert right["b"][0] == 14


def test_frames_with_sensor_data_have_pictures() -> None:
    pictures = report_data([result_set().study()], Calibrated(), worst=8)["pictures"]
    assert set(pictures) == {"3", "5"}
    (image,) = pictures["3"]["images"]
    assert image["size"] == [120, 40]
    assert image["src"].startswith("data:image/jpeg;base64,")
    assert "scan" not in pictures["3"]
    assert np.frombuffer(base64.b64decode(pictures["5"]["scan"]), "<i2")[:3].tolist() == [1000, 100, -100]
    assert len(report_data([result_set().study()], Calibrated(), worst=1)["pictures"]) == 1


def test_what_does_not_fit_is_left_out_and_counted() -> None:
    whole = report_data([result_set().study()], Calibrated(), worst=8)
    small = report_data([result_set().study()], Calibrated(), worst=8, limit_bytes=260_000)
    assert 0 < len(small["frames"]) < len(whole["frames"])
    assert small["left_out"] == 45 - len(small["frames"])
    html = page(result_set(), dataset=Calibrated(), limit_bytes=260_000)
    assert len(html) < 260_000
    assert f"{small['left_out']} more are left out" in html


def test_reliability_by_hand() -> None:
    rows = reliability(np.array([0.05, 0.15, 0.17, 1.0]), np.array([0, 1, 0, 1]))
    assert [(row.score, row.right, row.detections) for row in rows] == [
        (0.05, 0.0, 1),
        (pytest.approx(0.16), 0.5, 2),
        (1.0, 1.0, 1),
    ]
    # (1 * 0.05 + 2 * 0.34 + 1 * 0) / 4
    assert calibration_error(rows) == pytest.approx(0.1825)


def test_scores_that_are_no_probabilities_have_no_reliability() -> None:
    assert reliability(np.array([0.5, 3.0]), np.array([1, 0])) == ()
    assert reliability(np.zeros(0), np.zeros(0)) == ()
    assert np.isnan(calibration_error(()))


def test_embedded_pictures_are_small() -> None:
    address = embedded_image(np.zeros((1000, 2080, 3), np.uint8))
    with Image.open(io.BytesIO(base64.b64decode(address.partition(",")[2]))) as image:
        assert image.size == (1040, 500)
    scan = np.arange(30, dtype=np.float32).reshape(10, 3)
    raw = np.frombuffer(base64.b64decode(embedded_scan(scan, 4)), "<i2").reshape(-1, 3)
    # every third of ten points, in centimetres
    np.testing.assert_array_equal(raw, [[0, 100, 200], [900, 1000, 1100], [1800, 1900, 2000], [2700, 2800, 2900]])


def test_chart_puts_values_where_the_axes_say() -> None:
    svg = line_chart([Line("a<b", [0, 1], [0, 100], "#000")], "x", "y", (0, 1), (0, 100), width=400, height=280)
    parsed(svg)
    assert "a&lt;b" in svg
    points = re.search(r"<polyline points='([^']*)'", svg)
    assert points is not None
    # margins: 46 left, 14 right, 12 above, 40 below
    assert points.group(1) == "46.0,240.0 386.0,12.0"
    assert re.findall(r">(\d+)</text>", svg)[:6] == ["0", "20", "40", "60", "80", "100"]
