"""Paths of this machine for places anywhere, and what happens when their files are opened, written and removed."""

from __future__ import annotations

import hashlib
import os
import re
import sys
import threading
from pathlib import Path
from typing import Any

from lcf3d.remote.mirror import NOTE, Mirror, is_absent
from lcf3d.remote.urls import is_url, url_of

_mirrors: dict[str, Mirror] = {}
_lock = threading.Lock()
_watching = False


def cache_folder() -> Path:
    """Where mirrors are: the folder ``remote`` in ``LCF3D_CACHE``, or in ``~/.cache/lcf3d``."""
    return Path(os.path.realpath(Path(os.environ.get("LCF3D_CACHE") or "~/.cache/lcf3d").expanduser())) / "remote"


def local(place: str | Path, new: bool = False) -> Path:
    """The path on this machine of a path or URL; what lies elsewhere is listed now, and fetched when it is opened.

    Args:
        place: a path, ``s3://bucket/folder``, ``gs://...``, ``memory://...``, ``zip://folder::file.zip``, an archive.
        new: it is going to be written, so it need not be there.

    Raises:
        DatasetError: it is not there, or may not be read.
        MissingExtraError: the package for such URLs is not installed.
    """
    url = url_of(place) if not new or is_url(place) else None
    if url is None:
        return Path(place).expanduser()
    watch()
    return _mirror_of(url).refresh(new)


def local_file(place: str | Path) -> Path:
    """The path on this machine of a file that is going to be written; its folder is not listed.

    Raises:
        MissingExtraError: the package for such URLs is not installed.
    """
    if not is_url(place):
        return Path(place).expanduser()
    watch()
    folder, _, name = str(url_of(place)).rpartition("/")
    mirror = _mirror_of(folder)
    mirror.note()
    return mirror.root / name


def _mirror_of(url: str) -> Mirror:
    name = re.sub(r"[^A-Za-z0-9.]+", "-", url).strip("-")[:60]
    root = cache_folder() / f"{name}-{hashlib.sha256(url.encode()).hexdigest()[:8]}"
    with _lock:
        return _mirrors.setdefault(str(root), Mirror(root, url))


def watch() -> None:
    """Fetch files of mirrors when they are opened in this process; asked for by `local` and in worker processes."""
    global _watching
    with _lock:
        if not _watching:
            sys.addaudithook(_before)
            os.register_at_fork(after_in_child=_forked)
            _watching = True


def is_watching() -> bool:
    """Whether this process uses mirrors."""
    return _watching


def fetched(path: Path) -> Path:
    """``path``, with its content: for libraries that open files by themselves, without Python's knowledge."""
    if _watching:
        _before("open", (str(path), "r", 0))
    return path


def publish(written: Path, path: Path) -> None:
    """Send a finished file to where ``path`` lies; nothing for files of this machine, and hidden ones.

    Raises:
        DatasetError: it cannot be written there.
    """
    owner = _owner(path)
    if owner is not None and not path.name.startswith("."):
        owner.send(written, os.path.relpath(os.path.realpath(path), owner.root))


def remove(path: Path) -> None:
    """Remove a file here and where it lies; nothing where there is none.

    Raises:
        DatasetError: it may not be removed there.
    """
    owner = _owner(path)
    if owner is not None and path.is_file():
        owner.drop(os.path.relpath(os.path.realpath(path), owner.root))
    path.unlink(missing_ok=True)


def name_of(path: Path) -> str:
    """What a file is called for others: its URL where it lies elsewhere, else its path."""
    owner = _owner(path)
    return str(path) if owner is None else owner.url_of(os.path.relpath(os.path.realpath(path), owner.root))


def legible(text: str) -> str:
    """A message with URLs where it names files of mirrors."""
    if not _watching:
        return text
    start = re.escape(f"{cache_folder()}{os.sep}")

    def named(match: re.Match[str]) -> str:
        folder, inner = cache_folder() / match[1], match[2] or ""
        if not (folder / NOTE).is_file():
            return match[0]
        mirror = Mirror(folder)
        return mirror.url_of(inner.lstrip("/")) if inner else mirror.url

    return re.sub(start + r"([^/\s]+)(/[^\s:,;)]*)?", named, text)


def _before(event: str, arguments: tuple[Any, ...]) -> None:
    """What Python calls before it opens a file (`sys.addaudithook`)."""
    if event not in ("open", "sqlite3.connect") or isinstance(arguments[0], int):
        return
    try:
        path = os.fsdecode(arguments[0])
        if event == "sqlite3.connect":
            path = path.removeprefix("file:").partition("?")[0]
        # opened to be written anew: the content does not matter
        elif int(arguments[2] or 0) & os.O_TRUNC:
            return
        if not is_absent(path):
            return
    except (OSError, ValueError, TypeError):
        return
    owner = _owner(Path(path))
    if owner is not None:
        owner.fetch(os.path.realpath(path))


def _owner(path: Path) -> Mirror | None:
    """The mirror that a file belongs to; through links, as those of folders for the time being."""
    if not _watching:
        return None
    folder = f"{cache_folder()}{os.sep}"
    real = os.path.realpath(path)
    if not real.startswith(folder):
        return None
    root = folder + real[len(folder) :].split(os.sep)[0]
    with _lock:
        if root not in _mirrors:
            if not os.path.isfile(os.path.join(root, NOTE)):
                return None
            _mirrors[root] = Mirror(Path(root))
        return _mirrors[root]


def _forked() -> None:
    """A forked process has none of its parent's threads and connections, and locks that nobody will open."""
    global _lock
    _lock = threading.Lock()
    _mirrors.clear()
