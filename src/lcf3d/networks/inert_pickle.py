"""Reading what ``torch.save`` wrote without building anything but plain containers and tensors.

A checkpoint is a pickle, and a pickle names classes and functions to be called. Nothing that a file names is imported
or called here: tensors, storages and dictionaries are understood, and whatever else is named (training logs, settings,
optimizers, random states) becomes an empty stand-in. That does not depend on which names a release of torch allows.

Both forms of file are read: the zip archive of torch 1.6 and later, and the older sequence of pickles. Tensors are
read from the file when they are asked for (`LazyTensor.load`), so that an optimizer's state costs nothing.
"""

from __future__ import annotations

import math
import pickle
import pickletools
import struct
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import IO, Any

LEGACY_MAGIC = 0x1950A86A20F9469CFC6C
LEGACY_PROTOCOL = 1001
LEAST_MEMO = 1 << 16
"""Numbers of objects up to here cost nothing, wherever they stand."""
EXPANDED = 1 << 24
"""A tensor that repeats its numbers may have this many, however few there are in the file."""
_DTYPES = {
    "Double": "float64",
    "Float": "float32",
    "Half": "float16",
    "BFloat16": "bfloat16",
    "Long": "int64",
    "Int": "int32",
    "Short": "int16",
    "Char": "int8",
    "Byte": "uint8",
    "Bool": "bool",
    "ComplexDouble": "complex128",
    "ComplexFloat": "complex64",
}
_STORAGES = {f"{name}Storage": dtype for name, dtype in _DTYPES.items()}


class Inert:
    """Stands for whatever a checkpoint names beside tensors; takes any items and forgets them.

    Attributes:
        state: what the pickle gave as the object's state, unused; None without one.
    """

    state: Any = None

    def __new__(cls, *arguments: Any, **settings: Any) -> Inert:
        """An empty stand-in, whatever it is made from."""
        return super().__new__(cls)

    def __init__(self, *arguments: Any, **settings: Any) -> None: ...

    def __call__(self, *arguments: Any, **settings: Any) -> Inert:
        """A stand-in for the result of calling what this stands for."""
        return Inert()

    def __setstate__(self, state: Any) -> None:
        """Keep the state as it is."""
        self.state = state

    def __setitem__(self, key: Any, value: Any) -> None: ...

    def append(self, item: Any) -> None:
        """Take an item of a pickled list, and forget it."""

    def extend(self, items: Any) -> None:
        """Take items of a pickled list, and forget them."""

    def add(self, item: Any) -> None:
        """Take an item of a pickled set, and forget it."""


class PlainDict(dict[Any, Any]):
    """Stands for ``OrderedDict``; attributes that were set on one (``_metadata``) are forgotten."""

    def __setstate__(self, state: Any) -> None: ...


class Storage:
    """Numbers of a file that tensors are views of.

    Attributes:
        dtype: name of the torch data type.
        read: the bytes, when they are asked for.
    """

    def __init__(self, dtype: str, read: Callable[[], bytes]) -> None:
        self.dtype = dtype
        self.read = read


class LazyTensor:
    """A tensor of a file that has not been read yet."""

    def __init__(self, storage: Any, offset: Any, shape: Any, stride: Any, *_: Any) -> None:
        if not isinstance(storage, Storage):
            raise pickle.UnpicklingError("a tensor without a storage")
        self.storage, self.offset = storage, int(offset)
        self.shape, self.stride = tuple(map(int, shape)), tuple(map(int, stride))

    def load(self) -> Any:
        """The torch tensor, on the CPU, with memory of its own.

        Raises:
            ValueError: it reaches beyond the numbers that are there.
        """
        from lcf3d.networks.torch import torch

        dtype = getattr(torch, self.storage.dtype)
        data = bytearray(self.storage.read())
        flat = torch.frombuffer(data, dtype=dtype) if data else torch.empty(0, dtype=dtype)
        if len(self.shape) != len(self.stride) or min((*self.shape, *self.stride, self.offset), default=0) < 0:
            raise ValueError("a tensor of impossible shape")
        count = math.prod(self.shape)
        if count > max(len(flat), EXPANDED):
            raise ValueError("a tensor larger than its data")
        last = self.offset + sum((n - 1) * step for n, step in zip(self.shape, self.stride, strict=True))
        if count and last >= len(flat):
            raise ValueError("a tensor larger than its data")
        return torch.as_strided(flat, self.shape, self.stride, self.offset).clone()


def _inert_attribute(*_: Any) -> type:
    """Stands for ``getattr``: a class, since a nested class is what it may name and what pickle then instantiates."""
    return type("Inert", (Inert,), {})


def _first(value: Any, *_: Any) -> Any:
    """Stands for functions that wrap their first argument, as ``torch.nn.Parameter`` does."""
    return value


def _apply(function: Any, _: Any, arguments: Any, *__: Any) -> Any:
    """Stands for ``_rebuild_from_type_v2``: a tensor of another class or with attributes. Nothing known here runs."""
    return function(*arguments)


_KNOWN: dict[tuple[str, str], Any] = {
    ("collections", "OrderedDict"): PlainDict,
    ("torch._utils", "_rebuild_tensor"): LazyTensor,
    ("torch._utils", "_rebuild_tensor_v2"): LazyTensor,
    ("torch._utils", "_rebuild_parameter"): _first,
    ("torch._utils", "_rebuild_parameter_with_state"): _first,
    ("torch._tensor", "_rebuild_from_type_v2"): _apply,
    ("torch", "Size"): tuple,
    ("builtins", "getattr"): _inert_attribute,
    ("__builtin__", "getattr"): _inert_attribute,
}


class _Unpickler(pickle.Unpickler):
    """Builds `PlainDict`, `LazyTensor` and `Inert` only."""

    def __init__(self, file: IO[bytes], storage: Callable[[str, tuple[Any, ...]], Storage] | None = None) -> None:
        super().__init__(file, encoding="utf-8")
        self._storage = storage

    def find_class(self, module: str, name: str) -> Any:
        """What stands for ``module.name``; nothing is imported."""
        if (module, name) in _KNOWN:
            return _KNOWN[module, name]
        if module in ("torch", "torch.storage") and name in _STORAGES:
            return type(name, (Inert,), {"dtype": _STORAGES[name]})
        return type("Inert", (Inert,), {})

    def persistent_load(self, pid: Any) -> Any:
        """The storage that a tensor refers to; of modules that old files carry with their source, a stand-in."""
        kind = pid[0] if isinstance(pid, tuple) and pid else None
        if kind in (b"module", "module"):
            return pid[1]
        if kind not in (b"storage", "storage") or self._storage is None:
            raise pickle.UnpicklingError(f"unknown reference {str(kind)[:40]!r}")
        dtype = getattr(pid[1], "dtype", None)
        return Inert() if dtype is None else self._storage(dtype, pid[2:])


def require_memo(file: IO[bytes]) -> None:
    """See that a pickle numbers its objects as it goes; Python makes room for as many as the largest number says.

    The file is left where it was. What is no pickle at all is left to the reading of it.

    Raises:
        pickle.UnpicklingError: a number that no pickle of that length reaches, worth gigabytes of room.
    """
    start = file.tell()
    try:
        for operation, argument, place in pickletools.genops(file):
            # an object takes a byte or more, so that no number is larger than its place in the file
            if operation.name in ("PUT", "BINPUT", "LONG_BINPUT") and int(argument or 0) > (place or 0) + LEAST_MEMO:
                raise pickle.UnpicklingError(f"object {argument} at byte {place}")
    except (ValueError, IndexError, OverflowError):
        return
    finally:
        file.seek(start)


def _load(file: IO[bytes], storage: Callable[[str, tuple[Any, ...]], Storage] | None = None) -> Any:
    require_memo(file)
    return _Unpickler(file, storage).load()


def load_inert(path: Path) -> Any:
    """The content of a file of ``torch.save``: containers, plain values, `LazyTensor` and `Inert`.

    Raises:
        Exception: of many classes, for files that are damaged or no such file; `LazyTensor.load` likewise.
    """
    return _load_zip(path) if zipfile.is_zipfile(path) else _load_legacy(path)


def _load_zip(path: Path) -> Any:
    # stays open for the tensors that refer to it, and is closed with the last of them
    archive = zipfile.ZipFile(path)
    names = set(archive.namelist())
    pickled = [name for name in names if name.endswith("/data.pkl")]
    if len(pickled) != 1:
        raise ValueError("a zip archive that torch did not write")
    root = pickled[0].removesuffix("data.pkl")
    if f"{root}byteorder" in names and archive.read(f"{root}byteorder") != b"little":
        raise ValueError("written on a big-endian machine")

    def storage(dtype: str, reference: tuple[Any, ...]) -> Storage:
        return Storage(dtype, lambda: archive.read(f"{root}data/{reference[0]}"))

    with archive.open(pickled[0]) as file:
        return _load(file, storage)


def _load_legacy(path: Path) -> Any:
    """A file of torch before 1.6: magic number, version, machine, content, names of the storages, their bytes."""
    places: dict[str, tuple[int, int]] = {}

    def storage(dtype: str, reference: tuple[Any, ...]) -> Storage:
        key, view = str(reference[0]), reference[3] if len(reference) > 3 else None
        size = _itemsize(dtype)
        sizes[key] = size

        def read() -> bytes:
            start, count = places[key]
            if view is not None:
                start, count = start + int(view[1]) * size, min(int(view[2]), count - int(view[1]))
            with path.open("rb") as again:
                again.seek(start)
                data = again.read(count * size)
            if len(data) != count * size:
                raise EOFError("cut off within the parameters")
            return data

        return Storage(dtype, read)

    sizes: dict[str, int] = {}
    with path.open("rb") as file:
        if _load(file) != LEGACY_MAGIC or _load(file) != LEGACY_PROTOCOL:
            raise ValueError("no file of torch.save")
        machine = _load(file)
        if not machine.get("little_endian", True):
            raise ValueError("written on a big-endian machine")
        content = _load(file, storage)
        keys = _load(file)
        end = path.stat().st_size
        for key in keys:
            (count,) = struct.unpack("<q", file.read(8))
            start, size = file.tell(), sizes[str(key)]
            if count < 0 or start + count * size > end:
                raise EOFError("cut off within the parameters")
            places[str(key)] = start, count
            file.seek(start + count * size)
    return content


def _itemsize(dtype: str) -> int:
    from lcf3d.networks.torch import torch

    return int(getattr(torch, dtype).itemsize)
