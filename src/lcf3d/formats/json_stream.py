"""Large JSON files read piece by piece: an object's members one at a time, a list's records in batches."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from lcf3d.errors import DatasetError, FormatError
from lcf3d.files import reading, require_file

_SPACE = re.compile(r"\s*")
_RECORD_END = re.compile(r"\}\s*(?=,)")
_DECODER = json.JSONDecoder()
BATCH_BYTES = 8 << 20


class JsonCursor:
    """A position in a JSON text; walks objects without decoding them whole and sees repeated keys.

    ``json.loads`` keeps the last of several members of one name, silently; `members` yields them all.
    """

    def __init__(self, text: str) -> None:
        self._text = text
        self._position = 0

    def members(self) -> Iterator[str]:
        """Keys of the object at the cursor; the caller consumes each value, with `value` or `members`, in between.

        Raises:
            json.JSONDecodeError: no object is there, or it is malformed.
        """
        self._expect("{")
        if self._accept("}"):
            return
        while True:
            key = self.value()
            if not isinstance(key, str):
                raise json.JSONDecodeError("expected a key in quotes", self._text, self._position)
            self._expect(":")
            yield key
            if self._accept("}"):
                return
            self._expect(",")

    def value(self) -> Any:
        """The decoded value at the cursor, which moves behind it."""
        value, self._position = _DECODER.raw_decode(self._text, self._skip_space())
        return value

    def _skip_space(self) -> int:
        match = _SPACE.match(self._text, self._position)
        return match.end() if match else self._position

    def _accept(self, symbol: str) -> bool:
        self._position = self._skip_space()
        if not self._text.startswith(symbol, self._position):
            return False
        self._position += 1
        return True

    def _expect(self, symbol: str) -> None:
        if not self._accept(symbol):
            raise json.JSONDecodeError(f"expected '{symbol}'", self._text, self._position)


def iterate_records(path: Path, batch_bytes: int = BATCH_BYTES) -> Iterator[list[dict[str, Any]]]:
    """Batches of the records in a JSON file that holds one list of objects, in bounded memory.

    Raises:
        FormatError: the file is absent or not such a list.
    """
    try:
        require_file(path)
        with reading(path, "a JSON list"), path.open(encoding="utf-8-sig") as file:
            pending = file.read(batch_bytes).lstrip()
            if not pending.startswith("["):
                raise FormatError(f"{path} must hold a list of records, it begins with {pending[:20]!r}")
            pending = pending[1:]
            while chunk := file.read(batch_bytes):
                pending += chunk
                # a cut inside a string leaves that string open, so that only a cut between records can be decoded
                ends = [match.end() for match in _RECORD_END.finditer(pending, max(0, len(pending) - 65536))]
                for end in reversed(ends):
                    try:
                        batch = json.loads(f"[{pending[:end]}]")
                    except json.JSONDecodeError:
                        continue
                    pending = pending[end:].lstrip()[1:]
                    yield batch
                    break
            try:
                last = json.loads("[" + pending)
            except json.JSONDecodeError as error:
                raise FormatError(f"{path} is not a valid JSON list ({error.msg}); it may be cut off") from None
    except DatasetError as error:
        raise FormatError(str(error)) from None
    if last and not isinstance(last[0], dict):
        raise FormatError(f"{path} must hold a list of records, it holds {type(last[0]).__name__}s")
    yield last
