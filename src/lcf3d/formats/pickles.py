"""Pickle files read without running anything in them: numpy arrays and plain containers are built, and nothing else."""

from __future__ import annotations

import io
import pickle
import re
from pathlib import Path
from typing import Any

import numpy as np

from lcf3d.errors import FormatError
from lcf3d.files import read_bytes, shortened
from lcf3d.networks.inert_pickle import require_memo

# modules moved in numpy 2; what a pickled array or scalar names
_NUMPY = {
    (module, name)
    for core in ("numpy.core", "numpy._core")
    for module, name in (
        (f"{core}.multiarray", "_reconstruct"),
        (f"{core}.multiarray", "scalar"),
        (f"{core}.numeric", "_frombuffer"),
    )
} | {("numpy", "ndarray"), ("numpy", "dtype")}
_PLAIN: dict[tuple[str, str], Any] = {("collections", "OrderedDict"): dict}


class _ArraysOnly(pickle.Unpickler):
    def find_class(self, module: str, name: str) -> Any:
        if (module, name) in _PLAIN:
            return _PLAIN[module, name]
        if (module, name) == ("_codecs", "encode"):
            return _latin_bytes
        if name == "bytes" and module in ("builtins", "__builtin__"):
            return _empty_bytes
        if module == "numpy.dtypes" and name.endswith("DType") and hasattr(np.dtypes, name):
            return getattr(np.dtypes, name)
        if (module, name) in _NUMPY:
            here = module.replace("numpy.core", "numpy._core") if hasattr(np, "_core") else module
            return super().find_class(here, name)
        raise pickle.UnpicklingError(f"names {module}.{name}")


def _latin_bytes(text: str, encoding: str) -> bytes:
    """What protocol 2 writes for bytes: text that is to be encoded."""
    if encoding != "latin1":
        raise pickle.UnpicklingError(f"names the encoding {encoding}")
    return text.encode("latin1")


def _empty_bytes() -> bytes:
    """What protocols up to 2 write for bytes without content."""
    return b""


def read_arrays(path: Path) -> Any:
    """The content of a pickle file that holds numpy arrays, numbers, texts, lists and dictionaries.

    Raises:
        FormatError: the file is absent, damaged, or names any other class or function, none of which is run.
    """
    if not path.exists():
        raise FormatError(f"{path} does not exist")
    raw = read_bytes(path)
    try:
        if _large_numbers(raw):
            require_memo(io.BytesIO(raw))
        return _ArraysOnly(io.BytesIO(raw)).load()
    except pickle.UnpicklingError as error:
        reason = str(error)
        if reason.startswith("names "):
            raise FormatError(
                f"{path} {reason}, but only numpy arrays and plain containers are read from pickles, and nothing was "
                "run; write the results again with arrays (tensor.cpu().numpy()), or as JSON"
            ) from None
        raise FormatError(f"{path} is no pickle file, or a damaged one ({reason})") from None
    except Exception as error:
        # the unpickler raises many kinds on torn files
        raise FormatError(
            f"{path} is no pickle file, or a damaged one ({shortened(f'{type(error).__name__}: {error}')})"
        ) from None


def _large_numbers(raw: bytes) -> bool:
    """Whether anything in a pickle may be a number of an object beyond its length; arrays make it likely by chance."""
    data = np.frombuffer(raw, dtype=np.uint8)
    places = np.flatnonzero(data[:-4] == ord("r")) + 1
    numbers = sum(data[places + i].astype(np.int64) << 8 * i for i in range(4))
    return bool(np.any(numbers > len(raw))) or re.search(rb"p\d{6,}", raw) is not None
