"""Write the tables of settings into docs/configuration.md: ``python benchmarks/figures/settings_table.py``."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from lcf3d import FusionConfig, StereoConfig
from lcf3d.fusion.config import PRESETS, STAGES

PAGE = Path(__file__).parents[2] / "docs" / "configuration.md"
NAMES = tuple(name for name in PRESETS if name != "default")


def tables() -> str:
    """One table a stage: name, meaning, default, and what each preset changes."""
    parts: list[str] = []
    for config in (FusionConfig, StereoConfig):
        known = FusionConfig.model_fields if config is StereoConfig else {}
        for name, field in config.model_fields.items():
            if name in known:
                continue
            if name in STAGES:
                parts.append(f"\n### {STAGES[name][0].upper()}{STAGES[name][1:]}\n")
                head = ("setting", "meaning", "default", *(f"`{preset}`" for preset in NAMES))
                parts += [f"| {' | '.join(head)} |", f"|{'---|' * len(head)}"]
            default = field.get_default(call_default_factory=True)
            changed = (getattr(config.preset(preset), name) for preset in NAMES)
            cells = ["" if value == default else _text(name, value) for value in changed]
            parts.append(f"| `{name}` | {field.description} | {_text(name, default)} | {' | '.join(cells)} |")
    return "\n".join(parts).strip() + "\n"


def _text(name: str, value: Any) -> str:
    if name == "evidence":
        return "by role"
    if isinstance(value, tuple | list):
        flat = [", ".join(v) if isinstance(v, tuple) else str(v) for v in value]
        return ", ".join(flat) if len(flat) <= 4 else f"{len(flat)} classes of the dataset"
    if isinstance(value, dict):
        return "none" if not value else "set"
    return str(value).lower() if isinstance(value, bool) else str(value)


def updated(page: str) -> str:
    """The page with its tables written anew between the markers."""
    begin, end = "<!-- settings -->\n", "<!-- end of settings -->\n"
    before, rest = page.split(begin)
    return f"{before}{begin}\n{tables()}\n{end}{rest.split(end)[1]}"


if __name__ == "__main__":
    PAGE.write_text(updated(PAGE.read_text(encoding="utf-8")), encoding="utf-8")
    print(f"wrote {PAGE}")
