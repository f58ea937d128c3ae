"""Files in and out: whole files or none, text without byte order marks, listings without hidden files, safe names.

Every reader of lcf3d opens its files through this module, so that what holds for one holds for all: a file that is no
regular file or larger than any real one is refused before it is read, and whatever goes wrong in reading becomes a
`FormatError` that names the file (`reading`).
"""

from __future__ import annotations

import errno
import json
import os
import shutil
import stat
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from lcf3d.errors import ConfigError, DatasetError, FormatError, Lcf3dError
from lcf3d.remote.places import publish
from lcf3d.remote.urls import is_url, url_of

GIGABYTE = 1 << 30
MOST_GIGABYTES = 8.0
"""Larger files are refused before they are read; the environment variable ``LCF3D_MAX_FILE_GB`` sets another limit."""

_TEMPORARY = ".lcf3d-tmp"
_SHOWN = 120


@contextmanager
def atomic_path(path: str | Path) -> Iterator[Path]:
    """A temporary path beside ``path`` to write to; it takes the place of ``path`` when the block ends well.

    Where ``path`` stands for a file elsewhere (`lcf3d.remote`), the finished file is sent there first.

    Its name begins with a dot and holds the process's number: no listing takes it for a finished file, and
    `remove_left_overs` finds it after a crash.

    Raises:
        OSError: no place left, no permission ...; names ``path``.
        DatasetError: it cannot be written where it lies.
        ConfigError: a URL that no folder here stands for.
    """
    path = Path(path)
    if is_url(path):
        raise ConfigError(f"{url_of(path)} lies elsewhere, and this is written on this machine only; name a path of it")
    folder = path.parent
    if not os.path.isdir(folder):
        folder.mkdir(parents=True, exist_ok=True)
    temporary = folder / f"{_TEMPORARY}.{os.getpid()}.{path.name}"
    moved = False
    try:
        yield temporary
        publish(temporary, path)
        os.replace(temporary, path)
        moved = True
    except OSError as error:
        # the file that was to be written, not the one that nobody knows
        if error.errno == errno.ENOSPC:
            raise OSError(error.errno, "no space left, make room and go on with --resume", str(path)) from None
        if error.filename in (None, str(temporary)):
            raise OSError(error.errno, error.strerror, str(path)) from None
        raise
    finally:
        if not moved:
            temporary.unlink(missing_ok=True)


def is_hidden(path: Path) -> bool:
    """Whether a file is none of the data: begins with a dot (``._x`` of macOS, ``.DS_Store``, half-written files)."""
    return path.name.startswith(".") or path.name.endswith("~") or path.name == "Thumbs.db"


def list_files(folder: Path, *suffixes: str) -> list[Path]:
    """The files in a folder with one of the suffixes (any without), sorted by name, hidden ones left out.

    Empty for a folder that does not exist.
    """
    try:
        names = sorted(os.listdir(folder))
    except (FileNotFoundError, NotADirectoryError):
        return []
    paths = [folder / name for name in names if not suffixes or name.lower().endswith(suffixes)]
    return [path for path in paths if not is_hidden(path)]


def remove_left_overs(folder: Path) -> int:
    """Remove what dead processes left half-written in a folder and its sub-folders; gives how many files that were."""
    count = 0
    for path in folder.rglob(f"{_TEMPORARY}.*") if folder.is_dir() else ():
        owner = path.name.removeprefix(_TEMPORARY + ".").split(".")[0]
        if not path.is_symlink() and path.is_file() and not (owner.isdigit() and is_alive(int(owner))):
            path.unlink(missing_ok=True)
            count += 1
    return count


def is_alive(process: int) -> bool:
    """Whether a process of that number runs on this machine."""
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    except (PermissionError, OverflowError):
        return True
    return True


def inside(folder: Path, name: str, suffix: str = "") -> Path:
    """The path of ``name + suffix`` under ``folder``, for names that come from data: frame ids, tokens, file names.

    Raises:
        FormatError: the name leads out of the folder, is empty or no file name at all.
    """
    text = f"{name}{suffix}"
    parts = text.replace("\\", "/").split("/")
    if not name or "\0" in text or text.startswith(("/", "\\", "~")) or ".." in parts or Path(text).is_absolute():
        raise FormatError(f"{shortened(name)!r} is no name of a file inside {folder}: names must not lead elsewhere")
    return folder / text


def shortened(value: object, most: int = _SHOWN) -> str:
    """The text of a value for a message: one line, cut where it is long, without control characters."""
    text = "".join(c if c.isprintable() else " " for c in str(value)[: most + 1])
    return text if len(text) <= most else text[:most] + "..."


@contextmanager
def reading(place: object, what: str) -> Iterator[None]:
    """Turn whatever goes wrong while a file is read into one sentence.

    Args:
        place: the file, and the place in it where that is known.
        what: the file should be, with its article, for the message.

    Raises:
        FormatError: instead of any error that is neither lcf3d's own nor the system's.
    """
    try:
        yield
    except (Lcf3dError, OSError, json.JSONDecodeError):
        # JSON's own error knows the line, and becomes a sentence where the text is known
        raise
    except RecursionError:
        raise FormatError(f"{place} is not {what}: it is nested too deep") from None
    except MemoryError:
        raise FormatError(f"{place} is not {what}, or larger than this machine's memory") from None
    except Exception as error:
        detail = shortened(str(error).strip() or type(error).__name__)
        if isinstance(error, KeyError):
            detail = f"entry {detail} is missing"
        raise FormatError(f"{place} cannot be read as {what} ({detail})") from None


def largest_size() -> int:
    """The largest accepted file size in bytes.

    Raises:
        ConfigError: ``LCF3D_MAX_FILE_GB`` is no number.
    """
    text = os.environ.get("LCF3D_MAX_FILE_GB", "")
    try:
        return int(float(text or MOST_GIGABYTES) * GIGABYTE)
    except (ValueError, OverflowError):
        raise ConfigError(f"LCF3D_MAX_FILE_GB must be a number of gigabytes, got {shortened(text)!r}") from None


def require_file(path: str | Path) -> None:
    """See that a path is a regular file of a size that real data has, without opening it.

    Raises:
        DatasetError: it does not exist or is a folder.
        FormatError: it is a pipe or device, or too large.
    """
    try:
        found = os.stat(path)
    except (FileNotFoundError, NotADirectoryError):
        raise DatasetError(f"{path} does not exist") from None
    except ValueError:
        raise DatasetError(f"{shortened(path)!r} is no file name") from None
    if stat.S_ISDIR(found.st_mode):
        raise DatasetError(f"{path} is a folder; expected a file")
    if not stat.S_ISREG(found.st_mode):
        raise FormatError(f"{path} is a pipe or device; expected a regular file")
    if found.st_size > largest_size():
        raise FormatError(
            f"{path} holds {found.st_size / GIGABYTE:.1f} GB, more than the {largest_size() / GIGABYTE:g} GB that are "
            "read; set LCF3D_MAX_FILE_GB if it is right"
        )


def read_bytes(path: str | Path) -> bytes:
    """The content of a file.

    Raises:
        DatasetError: it does not exist or is a folder.
        FormatError: it is no regular file, or too large.
    """
    require_file(path)
    with open(path, "rb", buffering=0) as file:
        return file.read()


def read_text(path: str | Path) -> str:
    """The text of a file in UTF-8, without a byte order mark.

    Raises:
        DatasetError: it does not exist or is a folder.
        FormatError: it is not UTF-8, no regular file, or too large.
    """
    try:
        return read_bytes(path).decode("utf-8-sig")
    except UnicodeDecodeError:
        raise FormatError(f"{path} is not a text file in UTF-8") from None


def write_text(path: str | Path, text: str) -> None:
    """Write ``text`` to ``path``, whole or not at all."""
    with atomic_path(path) as temporary, open(temporary, "wb") as file:
        file.write(text.encode())


def copy_file(source: Path, path: Path) -> None:
    """Copy a file to ``path``, whole or not at all."""
    with atomic_path(path) as temporary:
        shutil.copyfile(source, temporary)


def write_json(path: str | Path, value: Any, indent: int | None = 2) -> None:
    """Write ``value`` as JSON to ``path``, whole or not at all."""
    write_text(path, json.dumps(value, indent=indent) + "\n")


def read_json(path: str | Path) -> Any:
    """The value in a JSON file.

    Raises:
        FormatError: the file is absent or not JSON; names file, line and column.
    """
    try:
        text = read_text(path)
    except DatasetError as error:
        raise FormatError(str(error)) from None
    with reading(path, "JSON"):
        try:
            return json.loads(text)
        except json.JSONDecodeError as error:
            raise FormatError(f"{path}:{error.lineno}:{error.colno}: not valid JSON ({error.msg})") from None
