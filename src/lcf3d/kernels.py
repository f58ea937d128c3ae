"""Compiled functions: numba's, with a cache on disk where there is a place for one and without where there is none.

numba itself refuses to work where it finds no place for its cache (a package owned by root, a home that cannot be
written to), and fails on cache files that are cut off or cannot be written. Here a function is then compiled anew.
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from typing import Any, overload

import numba

log = logging.getLogger(__name__)

_said: set[str] = set()


@overload
def kernel(function: Callable[..., Any]) -> Any: ...
@overload
def kernel(*, inline: str = "never") -> Callable[[Callable[..., Any]], Any]: ...
def kernel(function: Any = None, *, inline: str = "never") -> Any:
    """Decorator: compile a function for the types that it is called with, without Python's lock.

    Args:
        function: of arrays and scalars.
        inline: ``always`` puts the function's code into its callers.
    """
    if function is None:
        return lambda later: kernel(later) if inline == "never" else _compiled(later, inline)
    return _compiled(function, inline)


def _compiled(function: Any, inline: str) -> Any:
    try:
        # nothing passes kernels on as C functions: without that wrapper they are compiled a twelfth quicker
        compiled = numba.njit(cache=True, nogil=True, inline=inline, no_cfunc_wrapper=True)(function)
    except (RuntimeError, OSError) as error:
        # "cannot cache function ...: no locator available"
        _say(f"compiled functions are not kept, every start compiles them anew ({error}); set NUMBA_CACHE_DIR")
        return numba.njit(nogil=True, inline=inline, no_cfunc_wrapper=True)(function)
    cache = getattr(compiled, "_cache", None)
    if cache is not None:
        compiled._cache = _ForgivingCache(cache)
    return compiled


class _ForgivingCache:
    """numba's cache of one function; what cannot be read is thrown away, what cannot be written is left out.

    Args:
        cache: numba's.
    """

    def __init__(self, cache: Any) -> None:
        self._cache = cache

    def load_overload(self, signature: Any, target: Any) -> Any:
        """Compiled code from the disk, None where there is none that can be used."""
        try:
            return self._cache.load_overload(signature, target)
        except Exception:
            # cut off, or of another version: numba raises what its unpickler raises
            try:
                self._cache.flush()
            except Exception:
                _say("the cache of compiled functions is damaged and cannot be rewritten; functions are compiled anew")
            return None

    def save_overload(self, signature: Any, data: Any) -> None:
        """Keep compiled code."""
        try:
            self._cache.save_overload(signature, data)
        except Exception as error:
            _say(f"compiled functions cannot be kept ({error}); every start compiles them anew")

    def __getattr__(self, name: str) -> Any:
        return getattr(self._cache, name)


def _say(text: str) -> None:
    """Log a note, once a process."""
    key = text.split("(")[0]
    if key not in _said:
        _said.add(key)
        log.warning(text)
