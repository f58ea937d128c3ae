"""Options that several verbs share."""

from __future__ import annotations

from typing import Any

import yaml

from lcf3d.errors import ConfigError
from lcf3d.fusion.config import FusionConfig


def build_config(name_or_path: str, changes: list[str]) -> FusionConfig:
    """Settings from a preset or file, changed by ``name=value`` items.

    Raises:
        ConfigError: unknown preset, file, setting or value.
    """
    config = FusionConfig.load(name_or_path)
    values: dict[str, Any] = {}
    for item in changes:
        name, equals, text = item.partition("=")
        if not equals:
            raise ConfigError(f"--set takes name=value, got {item!r}")
        values[name] = yaml.safe_load(text)
    return config.updated(**values) if values else config
