"""Damage for files, the same for the same seed: bytes flipped, cut and doubled, values replaced by strange ones."""

from __future__ import annotations

import copy
import json
import random
import re
from collections.abc import Callable
from typing import Any

_NUMBER = re.compile(rb"-?\d+(\.\d+)?([eE][-+]?\d+)?")
_TOKENS = (
    b"nan",
    b"-inf",
    b"1e400",
    b"9" * 400,
    b"9" * 5000,
    b"-1",
    b"0",
    b"",
    b"x",
    b"\xff\xfe",
    b"\x00",
    b"0x10",
    b"1_000",
    b"../../../x",
    b"[bold]",
    b"2001-01-01",
    "é".encode(),
)


def _values() -> list[Any]:
    deep: Any = []
    for _ in range(60):
        deep = [deep]
    return [
        None, True, -1, 0, 10**30, -(10**400), 1e308, float("nan"), float("inf"), 0.5, "", "x", "../../../x", "a\x00b",
        "[/bold]", [], [[]], {}, {"a": 1}, [1, "x"], deep, "9" * 4000, [None] * 5, {"": None},
    ]  # fmt: skip


def mutate_bytes(data: bytes, random_: random.Random) -> bytes:
    """One to four small damages anywhere."""
    found = bytearray(data)
    for _ in range(random_.choice((1, 1, 1, 2, 4))):
        place = random_.randrange(len(found) + 1)
        length = random_.choice((1, 1, 2, 8, 64, 1000))
        kind = random_.randrange(7)
        if kind == 0 and found:
            found[min(place, len(found) - 1)] ^= 1 << random_.randrange(8)
        elif kind == 1:
            del found[place : place + length]
        elif kind == 2:
            found[place:place] = random_.randbytes(length)
        elif kind == 3:
            del found[place:]
        elif kind == 4:
            found[place:place] = found[place : place + length]
        elif kind == 5:
            found[place:place] = random_.choice(_TOKENS)
        else:
            numbers = list(_NUMBER.finditer(found[:100_000]))
            if numbers:
                chosen = random_.choice(numbers)
                found[chosen.start() : chosen.end()] = random_.choice(_TOKENS)
    return bytes(found)


def mutate_json(data: bytes, random_: random.Random) -> bytes:
    """A value anywhere in a JSON file replaced, removed, doubled or renamed; now and then the bytes damaged instead."""
    if random_.random() < 0.3:
        return mutate_bytes(data, random_)
    root = {"root": json.loads(data)}
    for _ in range(random_.choice((1, 1, 2))):
        places = list(_places(root))
        holder, key = random_.choice(places)
        kind = random_.randrange(5)
        if kind == 0 and holder is not root:
            del holder[key]
        elif kind == 1 and isinstance(holder, list):
            holder.insert(key, copy.deepcopy(holder[key]))
        elif kind == 2 and isinstance(holder, dict) and holder is not root:
            holder[random_.choice(("", "x", "../x", "9"))] = holder.pop(key)
        else:
            holder[key] = random_.choice(_values())
    return json.dumps(root["root"]).encode()


def _places(value: Any) -> Any:
    items = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    for key, inner in list(items):
        yield value, key
        yield from _places(inner)


Mutation = Callable[[bytes, random.Random], bytes]
