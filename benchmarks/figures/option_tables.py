"""Write the tables of options and extras into docs/commands.md and docs/install.md, from the program itself.

``python benchmarks/figures/option_tables.py``
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import typer

from lcf3d.cli.app import app

ROOT = Path(__file__).parents[2]
VERBS = (
    "run",
    "view",
    "eval",
    "check",
    "calibrate",
    "ablate",
    "live",
    "models",
    "bench",
    "config",
    "simulate",
    "serve",
)
EXTRAS = {
    "train": "torch detectors (PointPillars, Faster R-CNN, ...), training, export to ONNX",
    "viz": "recordings for the Rerun viewer",
    "bag": "ROS 1 and ROS 2 bags and MCAP, without ROS",
    "simulate": "simulated streets and drives",
    "sparse": "spconv for the LiDAR networks with sparse convolutions on a GPU; they run without it",
    "formats": "`.las`, `.pcd`, parquet, Argoverse 2's feather files, data frames",
    "fleet": "results as parquet tables",
    "serve": "the report of all frames, served on this machine",
    "docs": "to build these pages",
    "dev": "all of them, and what the tests need",
}


def option_tables() -> str:
    """A heading and a table of options for each verb."""
    commands = typer.main.get_command(app).commands  # type: ignore[attr-defined]
    return "\n\n".join(_table(name, commands[name]) for name in VERBS) + "\n"


def _table(name: str, command: Any) -> str:
    told = (command.help or "").strip().split("\n\n")[0].replace("\n", " ")
    lines = [f"## lcf3d {name}", "", _escaped(told), "", "| option | meaning | default |", "|---|---|---|"]
    for parameter in command.params:
        if parameter.name in ("help", "install_completion", "show_completion"):
            continue
        text = _escaped(getattr(parameter, "help", None) or "")
        if parameter.param_type_name == "option":
            names = " ".join(f"`{name}`" for name in (*parameter.opts, *parameter.secondary_opts))
        else:
            names = f"{(parameter.name or '').upper()}"
        default = parameter.default
        plain = default is not None and default not in (False, True, ...) and not callable(default)
        lines.append(f"| {names} | {text} | {f'`{default}`' if plain and default not in ((), [], '') else ''} |")
    return "\n".join(lines)


def _escaped(text: str) -> str:
    return re.sub(r"\s+", " ", text).replace("|", "\\|").replace("<", "&lt;")


def extras_table() -> str:
    """What each extra of pyproject.toml brings."""
    section = (ROOT / "pyproject.toml").read_text(encoding="utf-8").split("[project.optional-dependencies]")[1]
    names = re.findall(r"^([\w-]+) = \[", section.split("\n[")[0], re.MULTILINE)
    return "\n".join(["| extra | brings |", "|---|---|", *(f"| `{name}` | {EXTRAS[name]} |" for name in names)]) + "\n"


def between(page: str, name: str, table: str) -> str:
    """The page with its table written anew between the markers."""
    begin, end = f"<!-- {name} -->\n", f"<!-- end of {name} -->\n"
    before, rest = page.split(begin)
    return f"{before}{begin}\n{table}\n{end}{rest.split(end)[1]}"


def pages() -> dict[Path, str]:
    """What the pages should hold now."""
    tables = {"commands.md": ("options", option_tables()), "install.md": ("extras", extras_table())}
    return {
        (path := ROOT / "docs" / page): between(path.read_text(encoding="utf-8"), name, table)
        for page, (name, table) in tables.items()
    }


if __name__ == "__main__":
    for path, text in pages().items():
        path.write_text(text, encoding="utf-8")
        print(f"wrote {path}")
