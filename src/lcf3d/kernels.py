"""Compiled functions: numba's, with a cache on disk where there is a place for one and without where there is none.

numba itself refuses to work where it finds no place for its cache (a package owned by root, a home that cannot be
written to), and fails on cache files that are cut off or cannot be written. Here a function is then compiled anew.
numba also knows a cached function by its own file alone, and would go on with what it called before where a function
or a constant of another file has changed. Here it is known by all that it uses.
"""

from __future__ import annotations

import hashlib
import logging
from collections.abc import Callable
from types import CodeType
from typing import Any, overload

import numba
import numpy as np

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
        compiled._cache = _ForgivingCache(cache, compiled.py_func)
    return compiled


def _digest(function: Any) -> str:
    """A number for a function with all compiled functions that it calls and all constants that they use."""
    found = hashlib.sha256()
    _add(found, function, set())
    return found.hexdigest()


def _add(found: Any, function: Any, seen: set[Any]) -> None:
    """Add code and constants of a function, and of those that it calls, in the order of their names."""
    if function in seen:
        return
    seen.add(function)
    code = function.__code__
    found.update(code.co_code + repr([one for one in code.co_consts if not isinstance(one, CodeType)]).encode())
    for name in sorted(code.co_names):
        value = function.__globals__.get(name)
        if hasattr(value, "py_func"):
            _add(found, value.py_func, seen)
        elif isinstance(value, int | float | complex | str | bytes | tuple | np.generic):
            found.update(f"{name}={value!r}".encode())
        elif isinstance(value, np.ndarray):
            found.update(f"{name}={value.dtype}{value.shape}".encode() + value.tobytes())


class _ForgivingCache:
    """numba's cache of one function; what cannot be read is thrown away, what cannot be written is left out.

    Args:
        cache: numba's.
        function: the function, which is looked at when it is first needed: then all that it calls is there.
    """

    def __init__(self, cache: Any, function: Any) -> None:
        self._cache, self._function = cache, function

    def _name_all(self) -> None:
        """Let what is kept hold for the function with all that it uses."""
        file: Any = getattr(self._cache, "_cache_file", None)
        if self._function is not None and hasattr(file, "_source_stamp"):
            file._source_stamp = (file._source_stamp, _digest(self._function))
        self._function = None

    def load_overload(self, signature: Any, target: Any) -> Any:
        """Compiled code from the disk, None where there is none that can be used."""
        self._name_all()
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
        self._name_all()
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
