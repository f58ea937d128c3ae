"""The pages as text: what they promise about themselves."""

import re
import runpy

import pytest
import yaml

from tests.docs.pages import PAGES, ROOT, blocks

TUTORIALS = sorted((ROOT / "docs" / "tutorials").glob("*.py"))
LONGEST_LINE = 110


@pytest.mark.parametrize("name", PAGES)
def test_blocks_name_their_language_and_are_no_wider_than_a_page(name):
    for block in blocks(PAGES[name].read_text(encoding="utf-8")):
        assert block.language in ("python", "sh", "text", "yaml", "toml"), f"{name}:{block.line} names no language"
        if block.language == "python":
            wide = [line for line in block.text.splitlines() if len(line) > LONGEST_LINE]
            assert wide == [], f"{name}:{block.line}: these lines are cut off on most screens"
        elif block.language == "text":
            assert not re.search(r"^(lcf3d|pip|python) ", block.text, re.MULTILINE), (
                f"{name}:{block.line}: commands are sh"
            )


def test_markers_stand_before_a_block():
    """A marker that belongs to nothing would excuse nothing, and nobody would see it."""
    for name, path in PAGES.items():
        page = path.read_text(encoding="utf-8")
        marked = [block for block in blocks(page) if block.marker]
        assert page.count("<!-- arguments only:") + page.count("<!-- not run:") == len(marked), name
        assert all(len(block.why or "") > 10 for block in marked), name


def test_tables_of_options_and_extras_are_those_of_the_program():
    for path, text in runpy.run_path(str(ROOT / "benchmarks/figures/option_tables.py"))["pages"]().items():
        assert path.read_text(encoding="utf-8") == text, (
            f"python benchmarks/figures/option_tables.py rewrites {path.name}"
        )


def test_tutorials_are_executed_when_the_pages_are_built():
    text = (ROOT / "mkdocs.yml").read_text(encoding="utf-8")
    settings = yaml.safe_load(text)
    (jupyter,) = [p["mkdocs-jupyter"] for p in settings["plugins"] if isinstance(p, dict) and "mkdocs-jupyter" in p]
    assert jupyter["execute"] is True
    assert jupyter["allow_errors"] is False
    assert "mkdocs build --quiet --strict" in (ROOT / ".ci/run").read_text()
    assert len(TUTORIALS) >= 4
    assert all(f"tutorials/{path.name}" in text for path in TUTORIALS)


@pytest.mark.parametrize("path", TUTORIALS, ids=lambda path: path.stem)
def test_tutorials_import_from_the_top(path):
    assert re.findall(r"^\s*(?:from|import) (lcf3d\.[\w.]+)", path.read_text(encoding="utf-8"), re.MULTILINE) == []


def test_every_page_is_in_the_navigation():
    navigation = (ROOT / "mkdocs.yml").read_text(encoding="utf-8").split("\nnav:")[1]
    pages = [p.relative_to(ROOT / "docs").as_posix() for p in (ROOT / "docs").rglob("*.md")]
    assert [page for page in pages if f" {page}\n" not in navigation] == []
