"""Procedural textures: seamless tiles of mean 1 with their mip levels, made once a process."""

from __future__ import annotations

from functools import lru_cache
from typing import Final

import numpy as np
from numpy.typing import NDArray

SIZE: Final = 256
LEVELS: Final = 9
LEVEL_OFFSET: Final = np.concatenate([[0], np.cumsum([(SIZE >> k) ** 2 for k in range(LEVELS)])]).astype(np.int64)
_SEED: Final = 20240229

Tile = NDArray[np.float64]


def _noise(rng: np.random.Generator, falloff: float, low: float = 1.0, stretch: tuple[float, float] = (1, 1)) -> Tile:
    """(S, S) seamless noise of unit deviation whose amplitude falls as frequency to the power -falloff."""
    f = np.fft.fftfreq(SIZE) * SIZE
    radius = np.hypot(f[:, None] * stretch[0], f[None, :] * stretch[1])
    amplitude = np.where(radius < low, 0, np.maximum(radius, 1.0) ** -falloff)
    value = np.fft.ifft2(np.fft.fft2(rng.normal(size=(SIZE, SIZE))) * amplitude).real
    result: Tile = value / value.std()
    return result


def _grey(value: Tile) -> Tile:
    return np.repeat(value[:, :, None], 3, axis=2)


def _joints(rows: int, columns: int, joint: float, shift: float, rng: np.random.Generator, vary: float) -> Tile:
    """(S, S) stones in rows with darker joints; every other row is shifted and each stone has its own brightness."""
    v, u = np.mgrid[0:SIZE, 0:SIZE] / SIZE
    row = np.floor(v * rows).astype(int)
    across = u * columns + shift * (row % 2)
    column = np.floor(across).astype(int) % columns
    stone = 1 + vary * rng.normal(size=(rows, columns))[row, column]
    edge_v = np.minimum(v * rows % 1, 1 - v * rows % 1) / rows
    edge_u = np.minimum(across % 1, 1 - across % 1) / columns
    groove = np.clip(np.minimum(edge_u, edge_v) / joint, 0, 1)
    result: Tile = stone * (0.55 + 0.45 * groove)
    return result


def _asphalt(rng: np.random.Generator) -> Tile:
    base = 1 + 0.10 * _noise(rng, 0.35, 20) + 0.07 * _noise(rng, 1.2, 1)
    ridge = np.abs(_noise(rng, 1.6, 1) + 0.3 * _noise(rng, 0.9, 4))
    crack = np.clip(ridge / 0.025, 0.55, 1)
    return _grey(base * crack)


def _cobbles(rng: np.random.Generator) -> Tile:
    n = 14
    gy, gx = np.mgrid[0:n, 0:n]
    centres = (np.stack([gy, gx], -1) + 0.5 + rng.uniform(-0.25, 0.25, (n, n, 2))).reshape(-1, 2) / n
    v, u = np.mgrid[0:SIZE, 0:SIZE] / SIZE
    nearest = np.full((SIZE, SIZE), 9.0)
    second = nearest.copy()
    owner = np.zeros((SIZE, SIZE), dtype=int)
    for k, (cy, cx) in enumerate(centres):
        dy, dx = np.abs(v - cy), np.abs(u - cx)
        d = np.hypot(np.minimum(dy, 1 - dy), np.minimum(dx, 1 - dx))
        closer = d < nearest
        second = np.where(closer, nearest, np.minimum(second, d))
        owner[closer] = k
        nearest = np.minimum(nearest, d)
    groove = np.clip((second - nearest) * n / 0.25, 0, 1)
    return _grey(
        (1 + 0.12 * rng.normal(size=len(centres)))[owner] * (0.5 + 0.5 * groove) * (1 + 0.06 * _noise(rng, 0.6, 8))
    )


def _grass(rng: np.random.Generator) -> Tile:
    blades = _noise(rng, 0.55, 6, (0.7, 1.2))
    patches = _noise(rng, 1.6, 1)
    light = np.clip(1 + 0.34 * blades + 0.18 * patches, 0.15, 2.2)
    dry = np.clip(0.5 + 0.5 * patches, 0, 1)
    return np.stack([light * (0.92 + 0.30 * dry), light, light * (0.95 + 0.05 * dry)], axis=-1)


def _cloth_patterns(rng: np.random.Generator) -> dict[str, Tile]:
    v, u = np.mgrid[0:SIZE, 0:SIZE] / SIZE
    folds = 1 + 0.10 * _noise(rng, 1.8, 1)
    weave = 1 + 0.05 * np.sin(u * 2 * np.pi * 64) * np.sin(v * 2 * np.pi * 64)
    checks = np.where((np.floor(u * 4) % 2 == 0), 1.3, 0.75) * np.where((np.floor(v * 4) % 2 == 0), 1.25, 0.75)
    stripes = np.where(v * 5 % 1 < 0.5, 1.6, 0.45)
    return {
        "cloth": _grey(folds * weave),
        "denim": _grey(folds * (1 + 0.10 * _noise(rng, 0.3, 10))),
        "checks": _grey(checks * folds),
        "stripes": np.stack([stripes * folds, stripes**0.9 * folds, stripes**0.8 * folds], axis=-1),
        "hair": _grey(1 + 0.25 * _noise(rng, 0.7, 4, (0.15, 2.0))),
        "tarpaulin": _grey(folds * (1 + 0.10 * np.cos(u * 2 * np.pi * 3)) * np.where(v % 1 < 0.02, 0.7, 1)),
        "ribs": _grey(
            1 + 0.22 * np.sign(np.sin(u * 2 * np.pi * 5)) * np.clip(np.abs(np.sin(u * 2 * np.pi * 5)) * 4, 0, 1)
        ),
    }


def _plate(rng: np.random.Generator) -> Tile:
    """Dark characters on a light plate, with a blue end."""
    tile = np.ones((SIZE, SIZE, 3)) * 1.35
    tile[:, : SIZE // 11] = (0.05, 0.12, 0.75)
    for k in range(7):
        x0 = int(SIZE * (0.13 + 0.122 * k))
        if k == 2:
            continue
        glyph = np.kron(rng.random((5, 3)) < 0.62, np.ones((32, 7)))
        glyph[:, :7] = np.maximum(glyph[:, :7], k % 2)
        tile[48 : 48 + glyph.shape[0], x0 : x0 + glyph.shape[1]] *= np.where(glyph > 0, 0.06, 1)[:, :, None]
    tile[:8], tile[-8:] = 0.1, 0.1
    return tile


def _tiles() -> dict[str, Tile]:
    rng = np.random.default_rng(_SEED)
    v, _ = np.mgrid[0:SIZE, 0:SIZE] / SIZE
    fine = 1 + 0.05 * _noise(rng, 0.5, 8)
    brick = _joints(16, 5, 0.008, 0.5, rng, 0.13) * fine
    roof_rows = 0.72 + 0.4 * (v * 6 % 1)
    tiles = {
        "plain": np.ones((SIZE, SIZE, 3)),
        "asphalt": _asphalt(rng),
        "slabs": _grey(_joints(5, 4, 0.010, 0.5, rng, 0.05) * fine * (1 + 0.05 * _noise(rng, 1.4, 1))),
        "cobbles": _cobbles(rng),
        "grass": _grass(rng),
        "earth": _grey(1 + 0.16 * _noise(rng, 0.8, 3) + 0.12 * _noise(rng, 1.7, 1)),
        "plaster": _grey(1 + 0.025 * _noise(rng, 0.4, 16) + 0.035 * _noise(rng, 1.7, 1)),
        "brick": np.stack([brick, brick**1.15, brick**1.2], axis=-1),
        "tiles": _grey(roof_rows * _joints(6, 6, 0.012, 0.5, rng, 0.10)),
        "concrete": _grey(1 + 0.05 * _noise(rng, 0.6, 6) + 0.06 * _noise(rng, 1.6, 1)),
        "wood": _grey(1 + 0.18 * _noise(rng, 0.9, 2, (2.5, 0.12))),
        "bark": _grey(np.clip(1 + 0.35 * _noise(rng, 0.8, 4, (0.25, 2.0)), 0.2, 2)),
        "leaf": _grey(1 + 0.20 * _noise(rng, 0.8, 2)),
        "plate": _plate(rng),
    }
    tiles.update(_cloth_patterns(rng))
    return tiles


@lru_cache(maxsize=1)
def texture_ids() -> dict[str, int]:
    """Texture name -> index into `texture_pyramids`."""
    return {name: index for index, name in enumerate(_tiles())}


@lru_cache(maxsize=1)
def texture_pyramids() -> NDArray[np.float32]:
    """(K, sum of texels over levels, 3) float32: level k starts at ``LEVEL_OFFSET[k]`` and is (SIZE >> k) wide."""
    result = []
    for name, tile in _tiles().items():
        level = np.clip(tile, 0, None)
        if name != "plate":
            level = level / level.mean(axis=(0, 1))
        flat = []
        for _ in range(LEVELS):
            flat.append(level.reshape(-1, 3))
            half = level.shape[0] // 2
            if half:
                level = level.reshape(half, 2, half, 2, 3).mean(axis=(1, 3))
        result.append(np.concatenate(flat))
    return np.array(result, dtype=np.float32)


@lru_cache(maxsize=1)
def cloud_noise() -> NDArray[np.float32]:
    """(S, S) seamless noise for clouds, of unit deviation."""
    rng = np.random.default_rng(_SEED + 1)
    return _noise(rng, 1.5, 1).astype(np.float32)
