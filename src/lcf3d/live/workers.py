"""Detectors in threads of their own, newest first: what comes while one is busy replaces what is waiting."""

from __future__ import annotations

import threading
from collections.abc import Callable
from time import perf_counter
from typing import Any


class Worker:
    """One thread that works on one message at a time and keeps one waiting.

    Args:
        name: of the thread.
        work: what to do with a message; may raise.
        done: called with the message, the result or None, the error or None, and the milliseconds it took.
    """

    def __init__(
        self,
        name: str,
        work: Callable[[Any], Any],
        done: Callable[[Any, Any, Exception | None, float], None],
    ) -> None:
        self._work, self._done = work, done
        self._waiting: Any = None
        self._condition = threading.Condition()
        self._stopped = False
        self.busy_since: float | None = None
        # a detector that hangs must not keep the process alive
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)
        self._thread.start()

    def submit(self, message: Any) -> bool:
        """Hand a message over; False when it took the place of one that was waiting."""
        with self._condition:
            free = self._waiting is None
            self._waiting = message
            self._condition.notify()
        return free

    def stop(self, seconds: float) -> bool:
        """Begin nothing more and wait for what is being done; False if that takes longer."""
        with self._condition:
            self._stopped, self._waiting = True, None
            self._condition.notify()
        self._thread.join(seconds)
        return not self._thread.is_alive()

    def wait_idle(self, seconds: float) -> bool:
        """Wait until nothing is waiting or being done; False if that takes longer."""
        with self._condition:
            return self._condition.wait_for(lambda: self._waiting is None and self.busy_since is None, seconds)

    def _run(self) -> None:
        while True:
            with self._condition:
                self._condition.wait_for(lambda: self._stopped or self._waiting is not None)
                if self._stopped:
                    return
                message, self._waiting = self._waiting, None
                self.busy_since = start = perf_counter()
            result, error = attempt(self._work, message)
            self._done(message, result, error, (perf_counter() - start) * 1e3)
            with self._condition:
                self.busy_since = None
                self._condition.notify_all()


def attempt(work: Callable[[Any], Any], message: Any) -> tuple[Any, Exception | None]:
    """What a detector makes of a message, or the error that it raises: foreign code may raise anything."""
    try:
        return work(message), None
    except Exception as error:
        return None, error
