"""What a page of the docs tells the reader to do: its fenced blocks, in order, with what a marker says of them.

A marker is a comment before the fence: ``<!-- arguments only: WHY -->`` (commands are read, not run) or
``<!-- not run: WHY -->``.
"""

from __future__ import annotations

import re
import shlex
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).parents[2]
PAGES = {p.relative_to(ROOT).as_posix(): p for p in [ROOT / "README.md", *sorted(ROOT.glob("docs/**/*.md"))]}
COMMANDS = ("sh", "bash", "console")
FENCE = re.compile(
    r"(?:^<!-- (?P<marker>arguments only|not run): (?P<why>[^>]*?) -->\n+)?"
    r"^(?P<indent> *)```(?P<language>[^\n]*)\n(?P<text>.*?)^(?P=indent)```\s*$",
    re.MULTILINE | re.DOTALL,
)


@dataclass(frozen=True)
class Block:
    """A fenced block: its language, its text, the line of the page, and the marker before it."""

    language: str
    text: str
    line: int
    marker: str | None
    why: str | None


def blocks(page: str) -> list[Block]:
    """The fenced blocks of a page in their order."""
    found = []
    for match in FENCE.finditer(page):
        indent = match["indent"]
        text = "".join(line.removeprefix(indent) for line in match["text"].splitlines(keepends=True))
        line = page.count("\n", 0, match.start("language")) + 1
        found.append(Block(match["language"].strip(), text, line, match["marker"], match["why"]))
    return found


def commands(text: str) -> list[list[str]]:
    """Command lines as words: lines that end in a backslash go on, comments are left out."""
    lines = text.replace("\\\n", " ").splitlines()
    return [words for line in lines if (words := shlex.split(line, comments=True))]
