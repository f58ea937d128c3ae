"""One URL as a folder of the cache: files that stand there without content until they are fetched.

A file without content has its size, and a time of change in the first second of 1970. The fraction of that second, and
of the time of a fetched file, says which version of the remote file it is: everything that is known is in the folder
itself, for all processes that use it.
"""

from __future__ import annotations

import hashlib
import json
import logging
import os
import threading
import time
from bisect import bisect_right
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

from lcf3d.errors import ConfigError, DatasetError
from lcf3d.remote.urls import BUCKETS, below, open_url, refused

log = logging.getLogger(__name__)

NOTE = ".lcf3d-remote.json"
"""The file in a mirror that says what it mirrors."""
MOST_GIGABYTES = 50.0
"""Of fetched files in a mirror; the oldest go. The environment variable ``LCF3D_CACHE_GB`` sets another limit."""
AHEAD = 32
"""Files that are fetched ahead of one that is not here yet: the next ones of its folder."""
AT_ONCE = 16
"""Files that are fetched at the same time."""

_SECOND = 10**9
_FILES_A_SUM = 32
# that are kept whatever their size: those that are being read
_LEAST = 64
# what tells versions of a file apart, as the file systems of fsspec call it
_VERSION = ("ETag", "etag", "md5Hash", "CRC", "LastModified", "last_modified", "mtime", "updated", "created")


def largest_cache() -> float:
    """The most bytes of fetched files that are kept of a URL.

    Raises:
        ConfigError: ``LCF3D_CACHE_GB`` is no number.
    """
    text = os.environ.get("LCF3D_CACHE_GB", "")
    try:
        return float(text or MOST_GIGABYTES) * (1 << 30)
    except ValueError:
        raise ConfigError(f"LCF3D_CACHE_GB must be a number of gigabytes, got {text[:40]!r}") from None


def is_absent(path: str) -> bool:
    """Whether a file has no content yet.

    Raises:
        OSError: it is not there.
    """
    return os.stat(path).st_mtime < 1


class Mirror:
    """One URL and its folder.

    Args:
        root: the folder.
        url: what it mirrors; None where the folder says it.

    Attributes:
        root: the folder.
        url: what it mirrors.
        name: of the only file, where the URL is that of a file; empty for folders.
    """

    def __init__(self, root: Path, url: str | None = None) -> None:
        note = {"url": url, "name": ""} if url else json.loads((root / NOTE).read_text(encoding="utf-8"))
        self.root, self.url, self.name = root, str(note["url"]), str(note["name"])
        self._lock = threading.Lock()
        self._opened: tuple[Any, str] | None = None
        self._pool: ThreadPoolExecutor | None = None
        self._busy: dict[str, threading.Lock] = {}
        self._kept: dict[str, int] = {}
        self._names: dict[str, list[str]] = {}

    def refresh(self, new: bool) -> Path:
        """List the URL anew; gives the folder, or the file where the URL is that of one.

        Args:
            new: it need not be there, since it is going to be written.

        Raises:
            DatasetError: it is not there, or may not be read.
        """
        started = time.time()
        files, place = self._files()
        with refused(self.url):
            files.invalidate_cache()
            found = files.find(place, detail=True)
            if not found:
                self._require(files, place, new)
        is_file = [path.strip("/") for path in found] == [place.strip("/")]
        self.name = place.rstrip("/").rsplit("/", 1)[-1] if is_file else ""
        self.note()
        prefix = place.strip("/")
        entries = {}
        for path, info in found.items():
            inner = self.name or path.strip("/").removeprefix(prefix).lstrip("/")
            if not path.endswith("/"):
                entries[inner] = info
        self._place(entries)
        self._forget(set(entries), started)
        return self.root / self.name

    def note(self) -> None:
        """Say in the folder what it mirrors, for other processes."""
        self.root.mkdir(parents=True, exist_ok=True)
        temporary = self.root / f"{NOTE}.{os.getpid()}"
        temporary.write_text(json.dumps({"url": self.url, "name": self.name}), encoding="utf-8")
        os.replace(temporary, self.root / NOTE)

    def _require(self, files: Any, place: str, new: bool) -> None:
        """See that an empty place is there, or that it can come to be."""
        protocols = (files.protocol,) if isinstance(files.protocol, str) else files.protocol
        if new and BUCKETS.isdisjoint(protocols):
            return
        if new:
            # of a bucket that is not there this fails
            files.ls(place.strip("/").split("/")[0])
        elif not files.isdir(place):
            raise FileNotFoundError(place)

    def _files(self) -> tuple[Any, str]:
        """The file system and the place in it, opened when first asked for."""
        with self._lock:
            if self._opened is None:
                self._opened = open_url(self.url)
            return self._opened

    def _place(self, entries: Mapping[str, Mapping[str, Any]]) -> None:
        """Put every file that is new or has changed into the folder, without content."""
        odd, made = [], set()
        for inner, info in entries.items():
            size = int(info.get("size") or 0)
            version = _version_of(info, size)
            if _is_odd(inner):
                odd.append(inner)
                continue
            path = self.root / inner
            try:
                there = os.lstat(path)
                if there.st_size == size and there.st_mtime_ns % _SECOND == version:
                    if there.st_mtime >= 1:
                        self._kept[str(path)] = size
                    continue
            except (FileNotFoundError, NotADirectoryError):
                pass
            try:
                if path.parent not in made:
                    path.parent.mkdir(parents=True, exist_ok=True)
                    made.add(path.parent)
                _stand_in(path, size, version)
            except (NotADirectoryError, FileExistsError, IsADirectoryError):
                # object stores can have a and a/b
                odd.append(inner)
        if odd:
            log.warning("%s: %d names cannot be those of files and are left out, first %r", self.url, len(odd), odd[0])

    def _forget(self, inner: set[str], started: float) -> None:
        """Remove what is no longer there, but for what a process has written since."""
        for folder, _, names in os.walk(self.root):
            for name in names:
                path = os.path.join(folder, name)
                gone = not name.startswith(".") and os.path.relpath(path, self.root) not in inner
                if gone and os.lstat(path).st_mtime < started:
                    os.unlink(path)
                    self._kept.pop(path, None)
        self._names.clear()

    def fetch(self, path: str, ahead: bool = True) -> None:
        """Fetch the content of a file of the folder, and of the next ones in the background.

        Raises:
            DatasetError: it is gone, or may not be read.
        """
        with self._lock:
            busy = self._busy.setdefault(path, threading.Lock())
        try:
            if ahead:
                self._fetch_ahead(path)
            with busy:
                if is_absent(path):
                    self._fetch_now(path)
        finally:
            with self._lock:
                self._busy.pop(path, None)

    def _fetch_now(self, path: str) -> None:
        files, _ = self._files()
        inner, there = os.path.relpath(path, self.root), os.lstat(path)
        temporary = _beside(path)
        with refused(self.url_of(inner)):
            try:
                files.get_file(self._remote(inner), temporary)
                if os.stat(temporary).st_size != there.st_size:
                    raise DatasetError(f"{self.url_of(inner)} was changed while it was being read; start again")
                # a second ago, so that no fraction leads into the future
                _stamp(temporary, int(time.time()) - 1, there.st_mtime_ns % _SECOND)
                os.replace(temporary, path)
            finally:
                Path(temporary).unlink(missing_ok=True)
        self._keep(path, there.st_size)

    def _keep(self, path: str, size: int) -> None:
        """Note what was fetched, and let the oldest go where that is too much."""
        gone = []
        with self._lock:
            self._kept[path] = size
            if len(self._kept) > _LEAST and len(self._kept) % _FILES_A_SUM == 0:
                total, most = sum(self._kept.values()), largest_cache()
                while total > most and len(self._kept) > _LEAST:
                    oldest = next(iter(self._kept))
                    total -= self._kept.pop(oldest)
                    gone.append(oldest)
        for oldest in gone:
            there = os.lstat(oldest)
            # another file in its place: whoever has the old one open reads on in it
            _stand_in(Path(oldest), there.st_size, there.st_mtime_ns % _SECOND)

    def _fetch_ahead(self, path: str) -> None:
        """Fetch the next files of the same folder in the background: drives are read in order."""
        folder, name = os.path.split(path)
        with self._lock:
            if folder not in self._names:
                self._names[folder] = sorted(os.listdir(folder))
            names = self._names[folder]
            if self._pool is None:
                self._pool = ThreadPoolExecutor(AT_ONCE, thread_name_prefix="lcf3d-fetch")
            first = bisect_right(names, name)
            coming = [os.path.join(folder, following) for following in names[first : first + AHEAD]]
            for other in coming:
                if other not in self._busy:
                    self._busy[other] = threading.Lock()
                    self._pool.submit(self._try_fetch, other)

    def _try_fetch(self, path: str) -> None:
        try:
            self.fetch(path, ahead=False)
        except (DatasetError, OSError) as error:
            # whoever opens the file is told
            log.debug("not fetched ahead: %s", error)

    def send(self, written: Path, inner: str) -> None:
        """Write a finished file to where ``inner`` lies.

        Raises:
            DatasetError: it cannot be written there.
        """
        files, _ = self._files()
        with refused(self.url_of(inner), "written"):
            files.put_file(str(written), self._remote(inner))

    def drop(self, inner: str) -> None:
        """Remove a file where it lies; nothing where there is none.

        Raises:
            DatasetError: it may not be removed.
        """
        files, _ = self._files()
        with refused(self.url_of(inner), "removed"):
            if files.exists(self._remote(inner)):
                files.rm_file(self._remote(inner))

    def _remote(self, inner: str) -> str:
        place = self._files()[1]
        if self.name:
            return place
        return f"{place.rstrip('/')}/{inner}" if place.strip("/") else inner

    def url_of(self, inner: str) -> str:
        """The URL of a file of the folder."""
        return self.url if self.name else below(self.url, inner)


def _is_odd(inner: str) -> bool:
    parts = inner.split("/")
    return "" in parts or ".." in parts or "." in parts or "\0" in inner or parts[-1].startswith(".lcf3d")


def _version_of(info: Mapping[str, Any], size: int) -> int:
    """Nanoseconds below a second that stand for the version of a remote file."""
    text = repr([size, *(info.get(key) for key in _VERSION)])
    return int(hashlib.sha256(text.encode()).hexdigest()[:12], 16) % _SECOND


def _beside(path: str) -> str:
    """A name of `lcf3d.files.atomic_path`'s form, so that what is left of it after a crash is found."""
    folder, name = os.path.split(path)
    return os.path.join(folder, f".lcf3d-tmp.{os.getpid()}.{threading.get_ident()}.{name}")


def _stand_in(path: Path, size: int, version: int) -> None:
    """Put a file without content in the place of ``path``; it takes no room on the disk."""
    temporary = _beside(str(path))
    with open(temporary, "wb") as file:
        file.truncate(size)
    # there is nothing to fetch of an empty file
    _stamp(temporary, 0 if size else int(time.time()) - 1, version)
    os.replace(temporary, path)


def _stamp(path: str, seconds: int, version: int) -> None:
    os.utime(path, ns=(seconds * _SECOND + version,) * 2)
