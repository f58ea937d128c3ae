"""Memory that drawing needs for a moment and keeps for the next picture: fresh pages cost more than filling them."""

from __future__ import annotations

import threading
from typing import Any

import numpy as np
from numpy.typing import NDArray

_kept = threading.local()


def scratch(name: str, size: int, dtype: Any, zeros: bool = False) -> NDArray[Any]:
    """(size,) memory of a name, which a thread gets again the next time; what is in it is of no meaning.

    Args:
        name: of its use; a second use of the same name takes the first one's memory.
        size: how many values.
        dtype: of the values.
        zeros: they are zero, and whoever takes it leaves zeros behind.
    """
    arrays: dict[str, NDArray[Any]] = _kept.__dict__
    if name not in arrays or len(arrays[name]) < size:
        arrays[name] = (np.zeros if zeros else np.empty)(size, dtype)
    return arrays[name][:size]
