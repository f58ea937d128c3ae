"""Deformable attention against plain loops, and position encodings by hand."""

from __future__ import annotations

import math

import numpy as np
import pytest

torch = pytest.importorskip("torch")

from lcf3d.networks.deformable import (  # noqa: E402
    DeformableAttention,
    inverse_sigmoid,
    map_positions,
    sine_encoding,
)

SHAPES = ((3, 4), (2, 2))


def bilinear(cells, x, y):
    """(C,) value of a (H, W, C) map at column x and row y, cells centred on half numbers, zero outside."""
    height, width = cells.shape[:2]
    x, y = x - 0.5, y - 0.5
    total = np.zeros(cells.shape[2])
    for row in (math.floor(y), math.floor(y) + 1):
        for column in (math.floor(x), math.floor(x) + 1):
            if 0 <= row < height and 0 <= column < width:
                total += (1 - abs(x - column)) * (1 - abs(y - row)) * cells[row, column]
    return total


@pytest.mark.parametrize("size", [2, 4])
@torch.inference_mode()
def test_attention_is_a_weighted_sum_of_samples(size):
    torch.manual_seed(0)
    heads, points, channels = 2, 3, 4
    layer = DeformableAttention(channels, heads, len(SHAPES), points)
    x, position, values = torch.randn(5, channels), torch.randn(5, channels), torch.randn(16, channels)
    references = torch.rand(5, size)
    query = x + position
    offsets = layer.sampling_offsets(query).reshape(5, heads, 2, points, 2).numpy()
    weights = layer.attention_weights(query).reshape(5, heads, 6).softmax(dim=-1).reshape(5, heads, 2, points).numpy()
    cells = np.split(layer.value_proj(values).numpy(), [12])
    gathered = np.zeros((5, channels))
    for q, head, level, point in np.ndindex(5, heads, 2, points):
        height, width = SHAPES[level]
        step = offsets[q, head, level, point]
        scale = [1 / width, 1 / height] if size == 2 else references[q, 2:].numpy() * 0.5 / points
        u, v = references[q, :2].numpy() + step * scale
        part = slice(head * 2, head * 2 + 2)
        sample = bilinear(cells[level].reshape(height, width, channels), u * width, v * height)[part]
        gathered[q, part] += weights[q, head, level, point] * sample
    expected = x.numpy() + layer.output_proj(torch.from_numpy(gathered).float()).numpy()
    np.testing.assert_allclose(layer(x, position, values, references, SHAPES).numpy(), expected, atol=1e-5)


def test_sine_encoding_takes_turns():
    encoded = sine_encoding(torch.tensor([1.0]), 4, 100.0)
    np.testing.assert_allclose(encoded[0], [math.sin(1), math.cos(1), math.sin(0.1), math.cos(0.1)], rtol=1e-6)


def test_positions_of_a_map_are_row_then_column():
    positions = map_positions(2, 3, 8, 20.0, torch.zeros(1))
    assert positions.shape == (6, 8)
    # the first cell of the second row: row 2 of 2, column 1 of 3
    np.testing.assert_allclose(positions[3, 0], math.sin(2 * math.pi), atol=1e-5)
    np.testing.assert_allclose(positions[3, 4], math.sin(2 * math.pi / 3), rtol=1e-5)


def test_inverse_sigmoid():
    np.testing.assert_allclose(inverse_sigmoid(torch.tensor([0.5, 0.8]), 1e-3), [0, math.log(4)], rtol=1e-5)
    np.testing.assert_allclose(inverse_sigmoid(torch.tensor([1.0]), 1e-3), [math.log(1000)], rtol=1e-4)
