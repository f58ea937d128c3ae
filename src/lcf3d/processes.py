"""Processes that share folders and work: one writer a folder, workers that do not outlive who asked for them."""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Iterator
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from pathlib import Path

from lcf3d.errors import ConfigError, Lcf3dError

LOCK = ".lcf3d-lock"
_WATCH_S = 1.0
_held: dict[Path, int] = {}


def lock_folder(folder: Path) -> None:
    """Become the only process that writes into a folder, made where it is not there.

    The lock is the system's: it ends with the process, however that ends. Asking again within a process is allowed.

    Raises:
        ConfigError: another process has it; says which.
    """
    import fcntl

    folder.mkdir(parents=True, exist_ok=True)
    key = folder.resolve()
    if key in _held:
        return
    path = folder / LOCK
    while True:
        descriptor = os.open(path, os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW, 0o644)
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            owner = os.read(descriptor, 100).decode("utf-8", "replace").strip() or "another process"
            os.close(descriptor)
            raise ConfigError(
                f"{folder} is being written by {owner}: wait until it is done, or choose another folder"
            ) from None
        except OSError:
            # a file system without locks: better to work than not to
            pass
        # whoever had it before may have removed the file in between
        if path.exists() and os.path.samestat(os.fstat(descriptor), os.stat(path)):
            break
        os.close(descriptor)
    os.truncate(descriptor, 0)
    os.write(descriptor, f"process {os.getpid()} on {os.uname().nodename}\n".encode())
    _held[key] = descriptor


def unlock_folder(folder: Path) -> None:
    """Give up what `lock_folder` took; nothing where it took nothing."""
    descriptor = _held.pop(folder.resolve(), None)
    if descriptor is not None:
        (folder / LOCK).unlink(missing_ok=True)
        os.close(descriptor)


def end_with_parent() -> None:
    """Let this worker end when the process that started it does, however that ends."""
    parent = os.getppid()

    def watch() -> None:
        while os.getppid() == parent:
            time.sleep(_WATCH_S)
        os._exit(1)

    threading.Thread(target=watch, name="watch-parent", daemon=True).start()


@contextmanager
def workers(what: str) -> Iterator[None]:
    """Turn the death of a worker process into one sentence.

    Args:
        what: they were doing, and how to go on, for the message.

    Raises:
        Lcf3dError: a worker was killed.
    """
    try:
        yield
    except BrokenProcessPool:
        raise Lcf3dError(
            f"a worker process was killed (by the system when memory runs out, or by somebody) while {what}"
        ) from None
