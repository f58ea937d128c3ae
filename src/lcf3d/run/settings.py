"""Settings from a preset or file and ``name=value`` items, as the command line and `lcf3d.run` take them."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import yaml

from lcf3d.errors import ConfigError, FormatError
from lcf3d.files import reading, shortened
from lcf3d.fusion.config import FusionConfig
from lcf3d.fusion.stereo import StereoConfig


def build_config(
    name_or_path: str | Path,
    changes: Sequence[str] = (),
    stereo: bool = False,
    class_names: Sequence[str] | None = None,
) -> FusionConfig:
    """Settings from a preset or file, changed by ``name=value`` items; those of stereo pairs if ``stereo``.

    ``class_names`` are the classes to detect, where preset or file do not say.

    Raises:
        ConfigError: unknown preset, file, setting or value, or one that has no effect under the others.
    """
    config = (StereoConfig if stereo else FusionConfig).load(name_or_path, class_names)
    values: dict[str, Any] = {}
    for item in changes:
        name, equals, text = item.partition("=")
        if not equals:
            raise ConfigError(f"--set takes name=value, got {item!r}")
        try:
            with reading(f"--set {name}", "a value"):
                values[name] = yaml.safe_load(text)
        except FormatError:
            raise ConfigError(f"--set {name} cannot be read as a value: {shortened(text)!r}") from None
    return config.updated(**values) if values else config
