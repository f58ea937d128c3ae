import zlib

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from lcf3d.visualization.deflate import BLOCK, LONGEST, _code_lengths, compress


@given(st.lists(st.tuples(st.integers(0, 255), st.integers(1, 700)), max_size=30), st.integers(0, 1000))
def test_zlib_reads_back_what_was_written(runs, seed):
    noise = np.random.default_rng(seed).integers(0, 256, seed % 97, dtype=np.uint8)
    data = np.concatenate([noise, *(np.full(count, value, np.uint8) for value, count in runs)])
    assert zlib.decompress(compress(data)) == data.tobytes()


@pytest.mark.parametrize("size", [0, 1, 7, 8, BLOCK - 1, BLOCK, BLOCK + 1, 2 * BLOCK + 5])
def test_blocks_of_every_size(size):
    data = np.random.default_rng(0).geometric(0.1, size).astype(np.uint8)
    data[size // 3 : size // 2] = 0
    assert zlib.decompress(compress(data)) == data.tobytes()


def test_plain_areas_become_small_and_noise_hardly_larger():
    assert len(compress(np.zeros(1_000_000, np.uint8))) < 10_000
    noise = np.random.default_rng(0).integers(0, 256, 100_000, dtype=np.uint8)
    assert len(compress(noise)) < 1.01 * len(noise)
    # what zlib makes of differences as a photograph has them, within a fifth
    smooth = np.random.default_rng(0).normal(0, 6, 300_000).round().astype(np.int8).view(np.uint8)
    assert len(compress(smooth)) < 1.2 * len(zlib.compress(smooth, 1))


def test_codes_are_as_short_as_huffmans_and_none_is_too_long():
    count = np.zeros(286, np.int64)
    count[:5] = [1, 2, 4, 8, 16]
    assert _code_lengths(count)[:5].tolist() == [4, 4, 3, 2, 1]
    # Fibonacci numbers make the deepest tree there is
    count[:40] = [1, 1] + [0] * 38
    for k in range(2, 40):
        count[k] = count[k - 1] + count[k - 2]
    length = _code_lengths(count)
    assert length.max() == LONGEST
    # Kraft: the codes fit
    assert (0.5 ** length[length > 0]).sum() <= 1
