"""Datasets named by one string: ``kind:ARGUMENT?name=value``, or a bare path that one of them recognizes."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from lcf3d import plugins
from lcf3d.datasets.base import Dataset, require_folder
from lcf3d.datasets.check import Finding
from lcf3d.errors import ConfigError, DatasetError, Lcf3dError
from lcf3d.remote.places import local
from lcf3d.remote.urls import is_url

GROUP = "lcf3d.datasets"


def open_dataset(text: str | Path, **settings: Any) -> Dataset:
    """The dataset that a string names.

    Args:
        text: ``kitti:ROOT``, ``nuscenes:ROOT?version=v1.0-mini``, a kind of an installed plug-in, or a bare path.
        settings: settings of the kind, for example ``split="val"``; those that are None are left to the kind.

    Raises:
        ConfigError: the kind or a setting is unknown, or the kind cannot be told from the path.
        DatasetError: the dataset is not there.
    """
    spec = named(str(text))
    given = {name: value for name, value in settings.items() if value is not None}
    dataset: Dataset = plugins.build(
        GROUP, plugins.Spec(spec.kind, spec.argument, {**spec.settings, **given}), {"late_cameras": "drop"}
    )
    return dataset


def check_dataset(
    text: str,
    results: Path | None = None,
    progress: Callable[[int], Callable[[], None]] | None = None,
    tell: Callable[[Dataset], None] | None = None,
    **settings: Any,
) -> list[Finding]:
    """What is wrong with a dataset, and with result files for it.

    Args:
        text: names the dataset, see `open_dataset`.
        results: result files in its form, or None.
        progress: is told the number of frames and gives what to call after each.
        tell: is given the dataset, if it can be opened, before it is checked.
        settings: settings of the kind; those that are None are left to it.

    Raises:
        Lcf3dError: it cannot be opened, and cannot say by rules what is wrong.
    """
    results = None if results is None else local(results)
    if results is not None and not results.exists():
        raise DatasetError(f"{results} does not exist; name a file or folder of results")
    try:
        dataset = open_dataset(text, **settings)
    except Lcf3dError:
        spec = named(text)
        unreadable = getattr(plugins.load(GROUP, spec.kind), "check_unreadable", None)
        findings = [] if unreadable is None else unreadable(spec.argument, settings.get("version"))
        if not any(finding.severity == "error" for finding in findings):
            raise
        return list(findings)
    if tell is not None:
        tell(dataset)
    return dataset.check(results, (lambda: None) if progress is None else progress(len(dataset)))


def root_of(text: str, kinds: Sequence[str], what: str) -> tuple[str, Path]:
    """Kind and root folder of a dataset, for what can be done with few kinds only.

    Raises:
        ConfigError: it is of another kind; says that ``what`` reads ``kinds``.
        DatasetError: the folder does not exist.
    """
    spec = named(text)
    if spec.kind not in kinds:
        raise ConfigError(f"{what} reads {' or '.join(f'{kind}:ROOT' for kind in kinds)}, got {text!r}")
    return spec.kind, require_folder(local(spec.argument))


def named(text: str) -> plugins.Spec:
    """The parts of a string that names a dataset; the kind of a bare path is told from what lies there."""
    if is_url(text) or Path(text).expanduser().exists():
        root = local(text)
        return plugins.Spec(_recognize(root), str(root))
    spec = plugins.parse(text)
    if not spec.argument and spec.kind not in plugins.kinds(GROUP):
        raise DatasetError(f"there is no {text}; name a dataset as {_examples()}")
    return spec


def _recognize(root: Path) -> str:
    for kind in plugins.kinds(GROUP):
        try:
            recognizes = getattr(plugins.load(GROUP, kind), "recognizes", None)
        except Exception:
            # a plug-in that cannot be imported recognizes nothing; asked for by name, it says why
            continue
        if recognizes is not None and recognizes(root):
            return kind
    raise ConfigError(f"cannot tell what dataset {str(root)!r} is; name it as {_examples()}")


def _examples() -> str:
    return " or ".join(f"{kind}:ROOT" for kind in plugins.kinds(GROUP))
