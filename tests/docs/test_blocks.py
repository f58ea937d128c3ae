"""Every Python block and command of the README and the docs, run on tiny data, or marked with the reason why not."""

from __future__ import annotations

import argparse
import json
import re
import runpy
import shutil
import sys
from pathlib import Path

import pytest
import typer
from typer.testing import CliRunner

from lcf3d.cli.app import app
from tests.docs.pages import COMMANDS, PAGES, ROOT, Block, blocks, commands
from tests.docs.stand_ins import SUBSTITUTIONS, names, write_base

SHOWN = ("text", "yaml", "toml")
ELSEWHERE = {"docs/my-own-data.md": "tests/test_my_own_data.py follows it from its first line to its last"}


@pytest.fixture(scope="session")
def base(tmp_path_factory) -> Path:
    root = tmp_path_factory.mktemp("docs")
    write_base(root)
    return root


def with_blocks() -> list[str]:
    return [
        n
        for n, p in PAGES.items()
        if n not in ELSEWHERE and any(b.language not in SHOWN for b in blocks(p.read_text()))
    ]


@pytest.mark.parametrize("name", with_blocks())
def test_what_the_page_says_runs(name, base, tmp_path, monkeypatch):
    shutil.copytree(base, tmp_path, dirs_exist_ok=True)
    page = PAGES[name].read_text(encoding="utf-8")
    # a page that does not make its run speaks of one that is there
    (tmp_path / "run").rename(tmp_path / ("run" if "--out fused" in page else "fused"))
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    known = names()
    for block in blocks(page):
        where = f"{name}:{block.line}"
        if block.language == "python" and block.marker != "not run":
            assert block.marker is None, f"{where}: Python is run or marked 'not run'"
            exec(compile("\n" * block.line + block.text, str(PAGES[name]), "exec"), known)
        elif block.language in COMMANDS:
            run_commands(block, where)


def run_commands(block: Block, where: str) -> None:
    if block.marker == "not run":
        return
    for words in commands(block.text):
        told = f"{where}: {' '.join(words)}"
        words = [substituted(word) for word in words]
        if words[:2] == ["lcf3d", "simulate"]:
            words = [*words, "--frames", "1", "--jobs", "1"]
        if words[0] == "lcf3d" and block.marker == "arguments only":
            read_arguments(words[1:], told)
        elif words[:3] == ["python3", "-m", "venv"]:
            # .ci/run takes these from the README and runs them in a fresh clone
            assert block.text in PAGES["README.md"].read_text(encoding="utf-8"), told
        elif words[0] == "lcf3d":
            result = CliRunner().invoke(app, words[1:])
            assert result.exit_code == 0, f"{told}\n{result.output}\n{result.exception!r}"
        elif words[:2] == ["pip", "install"]:
            assert extras(words[2]) <= set(known_extras()), told
        elif words[0] == "python" and words[1] != "-c":
            read_script_arguments(words[1:], told)
        elif words[:2] == ["python", "-c"]:
            exec(words[2], {})
        else:
            pytest.fail(f"{told}: neither run by this test nor marked with a reason")


def substituted(word: str) -> str:
    for ours, theirs in SUBSTITUTIONS.items():
        if "{token}" in theirs:
            theirs = next(iter(json.loads(Path("submission.json").read_text())["results"]))
        word = re.sub(rf"(?<![\w.]){re.escape(ours)}(?![\w.])", theirs, word)
    return word


def read_arguments(words: list[str], told: str) -> None:
    """Let the command line read what it would read, without running it."""
    command = typer.main.get_command(app)
    context = None
    while hasattr(command, "commands"):
        name, *words = words
        assert name in command.commands, f"{told}: no command {name}"
        context = command.context_class(command, info_name=name, parent=context)
        command = command.commands[name]
    try:
        command.make_context(command.name, list(words), parent=context)
    except Exception as error:
        pytest.fail(f"{told}: {error!r}")


def extras(target: str) -> set[str]:
    found = re.search(r"\[([\w,-]+)\]", target)
    return set(found[1].split(",")) if found else set()


def known_extras() -> list[str]:
    text = (ROOT / "pyproject.toml").read_text()
    section = text.split("[project.optional-dependencies]")[1].split("\n[")[0]
    return re.findall(r"^([\w-]+) = \[", section, re.MULTILINE)


class Parsed(Exception):
    """The script has read its arguments."""


def read_script_arguments(words: list[str], told: str) -> None:
    """Let a script of ``benchmarks`` read its arguments with its own parser; what it then does takes minutes."""
    script = ROOT / words[0]
    assert script.is_file(), f"{told}: no such script"
    parse = argparse.ArgumentParser.parse_args

    def stop(self, *arguments, **named):
        parse(self, *arguments, **named)
        raise Parsed

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(argparse.ArgumentParser, "parse_args", stop)
        patch.setattr(sys, "argv", [str(script), *words[1:]])
        patch.syspath_prepend(str(ROOT))
        patch.syspath_prepend(str(script.parent))
        try:
            runpy.run_path(str(script), run_name="__main__")
        except Parsed:
            return
        except SystemExit:
            pytest.fail(f"{told}: the script does not take these arguments")
    pytest.fail(f"{told}: the script reads no arguments")
