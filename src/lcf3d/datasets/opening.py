"""Datasets named by one string: ``kind:ROOT``."""

from __future__ import annotations

from pathlib import Path

from lcf3d.errors import ConfigError, DatasetError

KINDS = ("kitti", "nuscenes")


def parse_dataset(text: str) -> tuple[str, Path]:
    """Kind and root folder of ``kind:ROOT``; a bare path is guessed from what lies in it.

    Raises:
        ConfigError: the kind is unknown or cannot be guessed.
        DatasetError: the folder does not exist.
    """
    kind, colon, rest = text.partition(":")
    if not colon:
        kind, rest = _guess(Path(text)), text
    if kind not in KINDS:
        raise ConfigError(
            f"unknown dataset kind {kind!r} in {text!r}; expected {' or '.join(f'{k}:ROOT' for k in KINDS)}"
        )
    root = Path(rest)
    if not root.is_dir():
        raise DatasetError(f"dataset folder {root} does not exist")
    return kind, root


def _guess(root: Path) -> str:
    if (root / "training").is_dir() or (root / "testing").is_dir():
        return "kitti"
    if any(root.glob("v1.0-*")):
        return "nuscenes"
    raise ConfigError(
        f"cannot tell what dataset {str(root)!r} is; name it as {' or '.join(f'{k}:ROOT' for k in KINDS)}"
    )
