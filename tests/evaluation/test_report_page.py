"""The report in a real browser: Debian's Chromium, driven by Playwright."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from lcf3d.evaluation.kitti_breakdown import compare
from lcf3d.evaluation.report import html_report
from lcf3d.evaluation.study import ClassStudy, FusionOutcomes, ShownBox, Study

from .test_report import Calibrated, result_set

sync_api = pytest.importorskip("playwright.sync_api", reason="needs playwright: pip install playwright")
CHROMIUM = shutil.which("chromium")
if CHROMIUM is None:
    pytest.skip("needs Chromium: apt-get install chromium", allow_module_level=True)

HOSTILE = "<img src=x onerror=alert(1)></script><script>alert(2)</script>"


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    with sync_api.sync_playwright() as playwright:
        launched = playwright.chromium.launch(
            executable_path=CHROMIUM, args=["--no-sandbox", "--disable-gpu", "--disable-dev-shm-usage"]
        )
        yield launched
        launched.close()


@pytest.fixture(scope="module")
def report(tmp_path_factory: pytest.TempPathFactory) -> Path:
    first, second = result_set("a", shift=3.0), result_set("b")
    rows = compare(first.evaluator, second.evaluator, samples=20)
    fused = FusionOutcomes({"matched": 31}, {"downweighted": 3}, {}, {}, {})
    studies = []
    for one in (first, second):
        own = one.study()
        parts = tuple(ClassStudy(**{**part.__dict__, "fusion": fused}) for part in own.classes)
        studies.append(Study(**{**own.__dict__, "classes": parts}))
    path = tmp_path_factory.mktemp("report") / "report.html"
    tables = [first.tables(), second.tables()]
    path.write_text(html_report("a and b", studies, tables, rows, Calibrated(), 8, {"Version": "1"}))
    return path


class Opened:
    """A page, with everything that it complained about and asked for."""

    def __init__(self, browser: Any, path: Path, **options: Any) -> None:
        self.page = browser.new_page(**options)
        self.complaints: list[str] = []
        self.requests: list[str] = []
        self.page.on("console", lambda m: self.complaints.append(m.text) if m.type in ("error", "warning") else None)
        self.page.on("pageerror", lambda error: self.complaints.append(str(error)))
        self.page.on("request", lambda request: self.requests.append(request.url))
        self.page.on("dialog", lambda dialog: (self.complaints.append(dialog.message), dialog.dismiss()))
        self.page.goto(path.as_uri())

    def text(self, selector: str) -> str:
        return self.page.locator(selector).inner_text()


@pytest.fixture
def opened(browser: Any, report: Path) -> Iterator[Opened]:
    shown = Opened(browser, report, viewport={"width": 1300, "height": 900})
    yield shown
    assert shown.complaints == []
    assert all(url.startswith(("file:", "data:", "blob:")) for url in shown.requests)
    shown.page.close()


@pytest.mark.parametrize("width", [390, 820, 1500])
@pytest.mark.parametrize("theme", ["light", "dark"])
def test_fits_every_width_in_both_themes(browser: Any, report: Path, width: int, theme: str) -> None:
    shown = Opened(browser, report, viewport={"width": width, "height": 900}, color_scheme=theme)
    assert shown.page.evaluate("document.documentElement.scrollWidth") <= width
    colour = shown.page.evaluate("getComputedStyle(document.body).backgroundColor")
    assert colour == {"light": "rgb(255, 255, 255)", "dark": "rgb(11, 18, 32)"}[theme]
    assert shown.page.locator("#chart-grid canvas").count() >= 2
    assert shown.complaints == []
    shown.page.close()


def test_the_theme_can_be_chosen(opened: Opened) -> None:
    button = opened.page.locator("#theme")
    button.click()
    button.click()
    assert opened.text("#theme") == "Theme: dark"
    assert opened.page.evaluate("getComputedStyle(document.body).backgroundColor") == "rgb(11, 18, 32)"


def test_tables_are_sorted_by_a_click_and_by_the_keyboard(opened: Opened) -> None:
    head = opened.page.locator("#comparison thead th").nth(5)
    head.locator("button").click()
    assert head.get_attribute("aria-sort") == "descending"
    cells = "[...document.querySelectorAll('#comparison tbody tr')].map(r => parseFloat(r.cells[5].textContent))"
    values = opened.page.evaluate(cells)
    assert values == sorted(values, reverse=True)
    head.locator("button").focus()
    opened.page.keyboard.press("Enter")
    assert head.get_attribute("aria-sort") == "ascending"
    assert opened.page.evaluate(cells) == sorted(values)


def test_filters_choose_frames(opened: Opened) -> None:
    assert opened.text("#chosen").startswith("45 of 45 frames")
    # 10 m to the object ahead in the first frame, one metre more in each: 20 m and more from the 11th
    opened.page.get_by_label("distance").select_option("2")
    assert opened.text("#chosen").startswith("15 of 45 frames, 30 boxes")
    opened.page.get_by_role("checkbox", name="object found").uncheck()
    assert opened.text("#chosen").startswith("15 of 45 frames, 15 boxes")
    opened.page.get_by_role("button", name="Reset").click()
    opened.page.get_by_label("frame", exact=True).fill("44")
    assert opened.text("#chosen").startswith("1 of 45 frames")
    opened.page.get_by_label("results").select_option("0")
    assert "a: 0 wrong, 2 missed" in opened.text("#detail")


def test_a_bar_and_a_point_of_the_curve_lead_to_their_frames(opened: Opened) -> None:
    opened.page.get_by_role("button", name="Car, a, missed: 90. Show the frames").click()
    assert "object missed; a" in opened.text("#chosen")
    assert opened.text("#chosen").startswith("45 of 45 frames, 90 boxes")
    opened.page.get_by_role("application").nth(1).focus()
    opened.page.keyboard.press("ArrowDown")
    opened.page.keyboard.press("ArrowRight")
    assert "Car, b: recall" in opened.page.locator("#chart-word").text_content()
    opened.page.keyboard.press("Enter")
    assert "Car; wrong; score from" in opened.text("#chosen")
    opened.page.locator(".plot .u-over").nth(0).click(position={"x": 60, "y": 40})
    assert "wrong, object missed" in opened.text("#chosen")


def test_a_frame_has_image_view_from_above_and_scan(opened: Opened) -> None:
    opened.page.get_by_label("frame", exact=True).fill("5")
    opened.page.locator("#frame-table tbody button", has_text="5").first.click()
    views = opened.page.locator("#detail .views")
    views.locator("canvas").wait_for()
    assert views.locator("svg image").count() == 1
    shape = views.locator("svg.above .shape").last
    shape.hover()
    assert "m away" in opened.text("#detail .why")
    assert "lit" in shape.get_attribute("class")
    views.locator("svg.above .shape").first.focus()
    assert "Car" in opened.text("#detail .why")
    views.locator("canvas").focus()
    before = views.locator("canvas").screenshot()
    opened.page.keyboard.press("ArrowLeft")
    assert views.locator("canvas").screenshot() != before
    opened.page.get_by_role("checkbox", name="object missed").uncheck()
    assert "object missed" not in opened.text("#box-table")


def test_names_from_outside_are_shown_as_text(browser: Any, tmp_path: Path) -> None:
    part = ClassStudy(
        HOSTILE, HOSTILE, HOSTILE, {0.5: 50.0}, [], *np.array([[0.5], [1.0], [0.9]]), 0.9,
        {"true_positives": 1, "false_positives": 0, "misses": 1}, None,
    )  # fmt: skip
    box = ShownBox(HOSTILE, "right", 0.9, np.array([10.0, 0, 0, 4, 2, 1.5, 0]), None)
    one = Study(HOSTILE, HOSTILE, (HOSTILE,), {}, (part,), np.array([1]), np.array([0]), lambda number: [box])
    path = tmp_path / "report.html"
    path.write_text(html_report(HOSTILE, [one], [[]], origin={HOSTILE: HOSTILE}))
    shown = Opened(browser, path)
    shown.page.locator("#box-table").wait_for()
    assert HOSTILE in shown.text("h1")
    assert HOSTILE in shown.text("#detail h3")
    assert HOSTILE in shown.text("#box-table")
    assert shown.page.locator("img").count() == 0
    assert shown.complaints == []
    shown.page.close()
