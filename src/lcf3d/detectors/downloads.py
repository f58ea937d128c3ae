"""Fetching a published file whole and verified, into a cache."""

from __future__ import annotations

import hashlib
from pathlib import Path
from urllib.error import HTTPError, URLError
from urllib.request import urlopen

from lcf3d.detectors.published import PUBLISHED, PublishedModel, Sensor, find_model
from lcf3d.errors import DetectorError
from lcf3d.files import atomic_path

CACHE = Path("~/.cache/lcf3d/models")
BLOCK = 1 << 20


def local_path(argument: str, sensor: Sensor) -> Path:
    """The file that a detector's argument names: a path, or a published model, downloaded at its first use.

    A file of that path goes before a published model of that name.

    Raises:
        DetectorError: the model is published but cannot be had; the message says what to put where.
    """
    return download(find_model(argument)) if is_published(argument, sensor) else Path(argument)


def is_published(argument: str, sensor: Sensor) -> bool:
    """Whether a detector's argument names a published model of that branch, and no file."""
    return any(m.name == argument and m.sensor == sensor for m in PUBLISHED) and not Path(argument).exists()


def download(model: PublishedModel, folder: Path | None = None, timeout_s: float = 30.0) -> Path:
    """The path of the model's file in ``folder``, downloaded unless it is there and right.

    Right is what has the published size and SHA-256, as far as they are published.

    Raises:
        DetectorError: the server cannot be reached or sends something else (nothing is left in ``folder`` then), or the
            model is known only by name.
    """
    if not model.url:
        raise DetectorError(f"{model.name}: {model.note}")
    path = (folder or CACHE.expanduser()) / model.file_name
    if path.is_file() and _is_right(model, _sha256(path)):
        return path
    with atomic_path(path) as temporary:
        digest = _fetch(model, temporary, timeout_s)
        if not _is_right(model, digest):
            raise DetectorError(
                f"{model.url} has SHA-256 {digest[:16]}..., expected one that begins with {model.digest_prefix}: "
                "the download was cut or the file was replaced; try again"
            )
    return path


def _is_right(model: PublishedModel, digest: str) -> bool:
    return digest.startswith(model.digest_prefix.lower())


def _sha256(path: Path) -> str:
    with path.open("rb") as file:
        digest = hashlib.sha256()
        while block := file.read(BLOCK):
            digest.update(block)
    return digest.hexdigest()


def _fetch(model: PublishedModel, path: Path, timeout_s: float) -> str:
    """Write what the URL serves to ``path``; its SHA-256."""
    from rich.progress import BarColumn, DownloadColumn, Progress, TransferSpeedColumn

    digest = hashlib.sha256()
    received = 0
    try:
        with (
            urlopen(model.url, timeout=timeout_s) as response,
            path.open("wb") as file,
            Progress("{task.description}", BarColumn(), DownloadColumn(), TransferSpeedColumn()) as progress,
        ):
            length = response.headers.get("Content-Length")
            task = progress.add_task(model.name, total=int(length) if length else None)
            while block := response.read(BLOCK):
                file.write(block)
                digest.update(block)
                received += len(block)
                progress.update(task, completed=received)
    except (URLError, OSError) as error:
        reason = error if isinstance(error, HTTPError) else getattr(error, "reason", error)
        raise DetectorError(
            f"{model.name} cannot be downloaded from {model.url} ({reason}); on a machine without network, download it "
            f"elsewhere and put it at {CACHE / model.file_name}, or name its path in the place of {model.name!r}"
        ) from None
    expected = model.size_bytes or (int(length) if length else received)
    if received != expected:
        raise DetectorError(f"{model.url} sent {received} bytes, expected {expected}; try again")
    return digest.hexdigest()
