"""Deflate (RFC 1951) for pictures: Huffman codes and runs of zeros, nothing else, in a fourth of zlib's time.

The rows of a photograph, each as differences to the pixel before, hold few repetitions that are worth looking for;
plain areas are zeros.
"""

from __future__ import annotations

import zlib

import numpy as np
from numpy.typing import NDArray

from lcf3d.kernels import kernel
from lcf3d.visualization.scratch import scratch

# bytes that share one pair of code tables, and the longest code that deflate knows
BLOCK, LONGEST = 1 << 21, 15
# symbols of literals, end of block and lengths; lengths of runs
SYMBOLS, END, SHORTEST_RUN, LONGEST_RUN = 286, 256, 3, 258
# tokens: 0 to 255 a literal, from here on a run of so many zeros after a zero; runs are whole words
_RUN, _WORD = 256, 8
# codes of the lengths of codes: four bits each, first bit lowest
_FOUR_BITS = tuple(int(f"{size:04b}"[::-1], 2) for size in range(16))


def _run_symbols() -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]]:
    """(259,) symbol of each length of a run, number of extra bits, and their value (RFC 1951, section 3.2.5)."""
    symbol, bits, value = (np.zeros(LONGEST_RUN + 1, dtype=np.int64) for _ in range(3))
    length, code = SHORTEST_RUN, 257
    while length < LONGEST_RUN:
        extra = max((code - 261) // 4, 0)
        for k in range(1 << extra):
            if length + k < LONGEST_RUN:
                symbol[length + k], bits[length + k], value[length + k] = code, extra, k
        length, code = length + (1 << extra), code + 1
    symbol[LONGEST_RUN] = 285
    return symbol, bits, value


_SYMBOL, _EXTRA_BITS, _EXTRA = _run_symbols()


def compress(data: NDArray[np.uint8]) -> bytes:
    """(N,) bytes as a zlib stream (RFC 1950)."""
    # no code is longer than 15 bits; the tables of a block have less than 256 bytes
    out = scratch("deflated", len(data) // 2 + 64 * (len(data) // BLOCK + 2), np.uint32)
    tokens = scratch("tokens", min(BLOCK, len(data)), np.uint16)
    # full words, bits of the next, and those bits
    place = np.zeros(3, np.uint64)
    for first in range(0, max(len(data), 1), BLOCK):
        part = np.ascontiguousarray(data[first : first + BLOCK])
        count = np.zeros(SYMBOLS, np.int64)
        count[END] = 1
        number = _find_runs(part, part[: len(part) // _WORD * _WORD].view(np.uint64), tokens, _SYMBOL, count)
        length = _code_lengths(count)
        code = _codes(length)
        _put(out, place, *_header(length, last=first + BLOCK >= len(data)))
        _write_tokens(tokens[:number], *_pieces(code, length), out, place)
        _put(out, place, int(code[END]), int(length[END]))
    words, bits, held = (int(value) for value in place)
    out[words] = held
    whole = out[: words + 1].astype("<u4", copy=False).view(np.uint8)[: 4 * words + -(-bits // 8)]
    return b"".join([b"\x78\x01", whole.data, zlib.adler32(data).to_bytes(4, "big")])


def _header(length: NDArray[np.int64], last: bool) -> tuple[int, int]:
    """The head of a block with (286,) code lengths, and how many bits it has."""
    # last block; dynamic codes; all symbols, one distance code, all lengths of code lengths; the one distance, 1
    fields = [(int(last), 1), (2, 2), (SYMBOLS - 257, 5), (0, 5), (15, 4)]
    fields += [(size, 3) for size in (0, 0, 0, *[4] * 16)]
    # code lengths are sent in 4 bits each, of the distance too: its code has one bit, 0
    fields += [(_FOUR_BITS[size], 4) for size in (*length.tolist(), 1)]
    value, bits = 0, 0
    for field, size in fields:
        value |= field << bits
        bits += size
    return value, bits


def _pieces(code: NDArray[np.int64], length: NDArray[np.int64]) -> tuple[NDArray[np.uint64], NDArray[np.uint64]]:
    """What stands for each token, and its bits: its code, the extra bits of its length, its distance."""
    symbol = _SYMBOL[SHORTEST_RUN:]
    piece, size = (np.zeros(_RUN + LONGEST_RUN + 1, np.uint64) for _ in range(2))
    piece[:256], size[:256] = code[:256], length[:256]
    piece[_RUN + SHORTEST_RUN :] = code[symbol] | _EXTRA[SHORTEST_RUN:] << length[symbol]
    size[_RUN + SHORTEST_RUN :] = length[symbol] + _EXTRA_BITS[SHORTEST_RUN:] + 1
    return piece, size


def _codes(length: NDArray[np.int64]) -> NDArray[np.int64]:
    """(286,) canonical codes of those lengths, first bit lowest (RFC 1951, section 3.2.2)."""
    code, following = np.zeros(len(length), dtype=np.int64), 0
    for size in range(1, LONGEST + 1):
        following <<= 1
        for k in np.flatnonzero(length == size):
            code[k] = int(f"{following:0{size}b}"[::-1], 2)
            following += 1
    return code


def _put(out: NDArray[np.uint32], place: NDArray[np.uint64], value: int, size: int) -> None:
    """Some more bits, lowest first."""
    words, bits, held = (int(part) for part in place)
    held |= value << bits
    bits += size
    while bits >= 32:
        out[words] = held & 0xFFFFFFFF
        held >>= 32
        words, bits = words + 1, bits - 32
    place[:] = words, bits, held


@kernel
def _write_tokens(tokens, piece, size, out, place):  # type: ignore[no-untyped-def]
    """The innermost loop: all of one type, so that nothing is converted."""
    words, bits, held = place[0], place[1], place[2]
    for k in range(len(tokens)):
        token = tokens[k]
        held |= piece[token] << bits
        bits += size[token]
        # written every time, counted when it is full: a branch here would be guessed wrongly half of the time
        out[words] = np.uint32(held & np.uint64(0xFFFFFFFF))
        full = bits >> np.uint64(5)
        words += full
        held >>= full << np.uint64(5)
        bits &= np.uint64(31)
    place[0], place[1], place[2] = words, bits, held


@kernel
def _find_runs(data, words, tokens, symbol, count):  # type: ignore[no-untyped-def]
    """Tokens of some bytes, and how often each symbol comes; how many tokens there are.

    A run begins after a zero, at a word, and goes on for whole words of zeros: so it is found without looking at bytes.
    """
    number, k, total = 0, 0, len(data)
    while k < total:
        value = data[k]
        tokens[number] = value
        number += 1
        count[value] += 1
        k += 1
        if value != 0 or k & (_WORD - 1):
            continue
        first = k // _WORD
        end, limit = first, min(len(words), first + LONGEST_RUN // _WORD)
        while end < limit and words[end] == 0:
            end += 1
        if end > first:
            run = (end - first) * _WORD
            tokens[number] = _RUN + run
            number += 1
            count[symbol[run]] += 1
            k += run
    return number


@kernel
def _code_lengths(count):  # type: ignore[no-untyped-def]
    """(286,) lengths of Huffman codes, none longer than `LONGEST`; 0 for symbols that never come."""
    weights = count.copy()
    while True:
        length = _huffman(weights)
        if length.max() <= LONGEST:
            return length
        # flatter weights have shorter longest codes
        for k in range(len(weights)):
            if weights[k]:
                weights[k] = weights[k] // 2 + 1


@kernel
def _huffman(weights):  # type: ignore[no-untyped-def]
    """Depth of each leaf of the Huffman tree."""
    n = len(weights)
    weight = np.zeros(2 * n, np.int64)
    parent = np.zeros(2 * n, np.int64)
    open_ = np.empty(2 * n, np.int64)
    left = 0
    for k in range(n):
        weight[k] = weights[k]
        if weights[k]:
            open_[left] = k
            left += 1
    nodes = n
    length = np.zeros(n, np.int64)
    if left == 1:
        length[open_[0]] = 1
        return length
    while left > 1:
        for _ in range(2):
            best = 0
            for k in range(1, left):
                if weight[open_[k]] < weight[open_[best]]:
                    best = k
            weight[nodes] += weight[open_[best]]
            parent[open_[best]] = nodes
            left -= 1
            open_[best] = open_[left]
        open_[left] = nodes
        left += 1
        nodes += 1
    for k in range(n):
        node = k
        while weights[k] and node != nodes - 1:
            node = parent[node]
            length[k] += 1
    return length
