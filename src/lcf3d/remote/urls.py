"""What a place is called: paths, URLs, and archives that stand for what is packed in them."""

from __future__ import annotations

import errno
import re
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from lcf3d.errors import ConfigError, DatasetError, Lcf3dError, MissingExtraError

BUCKETS = frozenset({"s3", "s3a", "gs", "gcs", "az", "abfs", "abfss", "oss"})
"""Beginnings of URLs whose first part is a bucket, which must be there before anything is written."""
SCHEMES = BUCKETS | {"adl", "hdfs", "webhdfs", "sftp", "ssh", "ftp", "hf", "memory", "zip", "tar", "file"}
"""Beginnings of URLs that are known where a path has lost one of their two slashes."""
ARCHIVES = {".zip": "zip", ".tar": "tar"}
"""Endings of files that stand for what is packed in them, and how fsspec calls them."""

_URL = re.compile(r"([a-zA-Z][a-zA-Z0-9+.-]+):(/*)(.*)", re.DOTALL)


def is_url(place: str | Path) -> bool:
    """Whether a path or text is a URL, or a chain of them."""
    return _repaired(str(place).split("::")[0]) is not None


def url_of(place: str | Path) -> str | None:
    """The URL that a path or text is; None for folders and files of this machine.

    A path has one slash where a URL has two: ``s3:/bucket`` is understood. A ``.zip`` or ``.tar`` file, here or
    elsewhere, stands for what is packed in it: ``data.zip`` is ``zip://::data.zip``.
    """
    text = str(place)
    parts = text.split("::")
    archive = ARCHIVES.get(Path(text).suffix.lower()) if len(parts) == 1 else None
    if not is_url(text):
        path = Path(text).expanduser()
        return f"{archive}://::{path.resolve()}" if archive and path.is_file() else None
    url = "::".join(_repaired(part) or part for part in parts)
    return f"{archive}://::{url}" if archive else url


def _repaired(part: str) -> str | None:
    """One link of a chain with both slashes; None if it is no URL."""
    match = _URL.fullmatch(part)
    if match is None or not (match[2] == "//" or match[1] in SCHEMES):
        return None
    # file:///place has a third
    third = "/" if match[1] == "file" else ""
    return f"{match[1]}://{third}{match[3]}"


def below(url: str, inner: str) -> str:
    """The URL of a file in the folder that ``url`` names."""
    first, chain, rest = url.partition("::")
    return f"{first}{'' if first.endswith('/') else '/'}{inner}{chain}{rest}"


def open_url(url: str) -> tuple[Any, str]:
    """The file system of a URL and the place in it.

    Raises:
        MissingExtraError: fsspec, or what it takes for such URLs, is not installed.
        ConfigError: there are no such URLs.
        DatasetError: the archive of the URL cannot be opened.
    """
    try:
        from fsspec.core import url_to_fs
    except ImportError:
        raise MissingExtraError("fsspec", "fleet", f"reading {url}") from None
    with refused(url):
        try:
            files, place = url_to_fs(url)
        except ImportError as error:
            if url.startswith("s3"):
                raise MissingExtraError("s3fs", "fleet", f"reading {url}") from None
            raise ConfigError(f"{url} needs a package that is not installed: {error}") from None
        except ValueError as error:
            raise ConfigError(f"{url} cannot be read: {error}") from None
    return files, str(place)


@contextmanager
def refused(url: str, verb: str = "read") -> Iterator[None]:
    """Turn whatever a remote file system says into one sentence.

    Args:
        url: the place in question.
        verb: what was not possible there.

    Raises:
        DatasetError: instead of any error but lcf3d's own, and the disk of this machine being full.
    """
    try:
        yield
    except Lcf3dError:
        raise
    except FileNotFoundError:
        raise DatasetError(f"{url} does not exist") from None
    except PermissionError:
        raise DatasetError(f"{url} may not be {verb} with these credentials: access is denied") from None
    except Exception as error:
        if isinstance(error, OSError) and error.errno == errno.ENOSPC:
            raise
        name = type(error).__name__
        if name in ("NoCredentialsError", "PartialCredentialsError", "ProfileNotFound", "DefaultCredentialsError"):
            raise DatasetError(f"{url} cannot be {verb}: there are no credentials for it ({error})") from None
        said = (str(error).strip() or name).splitlines()[0]
        raise DatasetError(f"{url} cannot be {verb} ({said})") from None
