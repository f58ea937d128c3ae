"""Other looks for a batch of views, on the device that trains: far beyond what the simulation's renderer can show.

A network that has seen every object in many colours, textures, lights and qualities of image has to go by shapes; real
photographs are then one look more.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

from lcf3d.training.loop import import_torch


@dataclass(frozen=True)
class Appearance:
    """How far the look of views is changed; every change is drawn for each view.

    Attributes:
        plain: share of the views that keep their look but for light and noise.
        repaint: largest logarithm of the factors on the colours of each object.
        filtered: share of the views that pass through a random 3 x 3 filter of all colours.
        colour: standard deviation of what is added to the matrix of colours.
        grey: share of the views without colours.
        gamma: largest logarithm of the exponent on brightness.
        contrast: largest logarithm of the contrast.
        lit: standard deviation of the logarithm of uneven light.
        haze: largest share of haze.
        blur: largest standard deviation of the blur, in pixels.
        noise: largest standard deviation of noise.
        blocks: share of the views with the blocks of strong compression.
    """

    plain: float = 0.15
    repaint: float = 0.5
    filtered: float = 0.3
    colour: float = 0.1
    grey: float = 0.08
    gamma: float = 0.6
    contrast: float = 0.5
    lit: float = 0.35
    haze: float = 0.35
    blur: float = 1.6
    noise: float = 0.08
    blocks: float = 0.3


def changed_look(pixels: Any, owner: Any, how: Appearance, rng: Any) -> Any:
    """Views with another look.

    Args:
        pixels: (B, 3, H, W) in 0 to 1, sides multiples of 8.
        owner: (B, H, W) number of the object in each pixel, or None.
        how: how far to go.
        rng: torch generator of the pixels' device.

    Returns:
        (B, 3, H, W) in 0 to 1.
    """
    torch, device, count = import_torch(), pixels.device, len(pixels)

    def uniform(low: float = 0.0, high: float = 1.0, *shape: int) -> Any:
        return torch.rand(count, *shape, generator=rng, device=device) * (high - low) + low

    def normal(*shape: int) -> Any:
        return torch.randn(count, *shape, generator=rng, device=device)

    bold = (uniform() >= how.plain).float()
    if owner is not None:
        pixels = _repainted(pixels, owner, how, bold, uniform, torch)
    pixels = _filtered(pixels, how, bold, uniform, normal, torch)
    pixels = _recoloured(pixels, how, bold, uniform, normal, torch)
    pixels = _lit(pixels, how, bold, uniform, normal, torch)
    pixels = _blurred(pixels, how, uniform, torch)
    spread = how.noise * uniform(0, 1, 1, 1, 1) ** 2 * (uniform(0, 1, 1, 1, 1) < 0.7)
    pixels = pixels + spread * normal(*pixels.shape[1:])
    return _blocks(pixels.clamp(0, 1), how, uniform, torch).clamp(0, 1)


def _repainted(pixels: Any, owner: Any, how: Appearance, bold: Any, uniform: Any, torch: Any) -> Any:
    """Every object in other colours; scenery keeps its own."""
    numbers = 512
    paint = uniform(-how.repaint, how.repaint, numbers, 3) + uniform(-how.repaint, how.repaint, numbers, 1)
    paint = paint * (uniform(0, 1, numbers, 1) < 0.7) * bold[:, None, None]
    paint[:, 0] = 0
    index = owner.flatten(1)[..., None].expand(-1, -1, 3)
    factor = torch.exp(paint.gather(1, index)).transpose(1, 2).reshape(pixels.shape)
    return (pixels * factor).clamp(0, 1)


def _filtered(pixels: Any, how: Appearance, bold: Any, uniform: Any, normal: Any, torch: Any) -> Any:
    """Some views mixed with a random convolution of themselves, brought to their own mean and spread."""
    count, _, height, width = pixels.shape
    kernels = normal(3, 3, 3, 3).reshape(count * 3, 3, 3, 3) / math.sqrt(27)
    flat = torch.nn.functional.pad(pixels, (1, 1, 1, 1), mode="replicate").reshape(1, count * 3, height + 2, width + 2)
    other = torch.nn.functional.conv2d(flat, kernels, groups=count).reshape(pixels.shape)
    mean, spread = other.mean((2, 3), keepdim=True), other.std((2, 3), keepdim=True) + 1e-3
    other = (other - mean) / spread * pixels.std((2, 3), keepdim=True) + pixels.mean((2, 3), keepdim=True)
    share = uniform(0.1, 0.8) * (uniform() < how.filtered) * bold
    return pixels + share[:, None, None, None] * (other - pixels)


def _recoloured(pixels: Any, how: Appearance, bold: Any, uniform: Any, normal: Any, torch: Any) -> Any:
    """Other hues, saturation, white balance; some views in grey."""
    mixing = torch.eye(3, device=pixels.device) + how.colour * bold[:, None, None] * normal(3, 3)
    grey = torch.full((3, 3), 1 / 3, device=pixels.device)
    saturation = torch.where(uniform() < how.grey, 0.0, uniform(0.3, 1.7))[:, None, None]
    mixing = mixing @ (grey + saturation * (torch.eye(3, device=pixels.device) - grey))
    return torch.einsum("bij,bjhw->bihw", mixing, pixels).clamp(0, 1)


def _lit(pixels: Any, how: Appearance, bold: Any, uniform: Any, normal: Any, torch: Any) -> Any:
    """Other exposure, contrast and gamma, uneven light, haze."""
    one = (..., None, None, None)
    pixels = (pixels + 1e-4) ** torch.exp(uniform(-how.gamma, how.gamma))[one]
    middle = pixels.mean((1, 2, 3), keepdim=True)
    pixels = (pixels - middle) * torch.exp(uniform(-how.contrast, how.contrast))[one] + middle
    pixels = pixels * torch.exp(uniform(-how.contrast, how.contrast))[one]
    field = torch.nn.functional.interpolate(normal(1, 4, 7), size=pixels.shape[2:], mode="bicubic", align_corners=False)
    strength = how.lit * bold * (uniform() < 0.5)
    pixels = pixels * torch.exp(strength[one] * field)
    share = (uniform(0, how.haze) * (uniform() < 0.3) * bold)[one]
    return (pixels * (1 - share) + share * uniform(0.5, 1.0, 1, 1, 1)).clamp(0, 1)


def _blurred(pixels: Any, how: Appearance, uniform: Any, torch: Any) -> Any:
    """Out of focus or in motion: a Gaussian that may be longer in one direction."""
    count, channels, height, width = pixels.shape
    reach = 4
    steps = torch.arange(-reach, reach + 1, device=pixels.device, dtype=pixels.dtype)
    y, x = torch.meshgrid(steps, steps, indexing="ij")
    angle = uniform(0, math.pi)[:, None, None]
    wide = (0.05 + how.blur * uniform() ** 2 * (uniform() < 0.6))[:, None, None]
    narrow = wide * torch.where(uniform() < 0.7, 1.0, 0.3)[:, None, None] + 0.05
    along, across = x * torch.cos(angle) + y * torch.sin(angle), y * torch.cos(angle) - x * torch.sin(angle)
    kernel = torch.exp(-0.5 * ((along / wide) ** 2 + (across / narrow) ** 2))
    kernel = kernel / kernel.sum((1, 2), keepdim=True)
    kernel = kernel[:, None].expand(-1, channels, -1, -1).reshape(count * channels, 1, 2 * reach + 1, 2 * reach + 1)
    flat = torch.nn.functional.pad(pixels, (reach,) * 4, mode="replicate")
    flat = flat.reshape(1, count * channels, height + 2 * reach, width + 2 * reach)
    return torch.nn.functional.conv2d(flat, kernel, groups=count * channels).reshape(pixels.shape)


def _blocks(pixels: Any, how: Appearance, uniform: Any, torch: Any) -> Any:
    """What strong JPEG compression leaves: the cosine coefficients of 8 x 8 blocks, rounded."""
    count, channels, height, width = pixels.shape
    k = torch.arange(8, device=pixels.device, dtype=pixels.dtype)
    basis = torch.cos(math.pi / 8 * (k[None] + 0.5) * k[:, None]) * 0.5
    basis[0] *= math.sqrt(0.5)
    blocks = pixels.reshape(count, channels, height // 8, 8, width // 8, 8)
    waves = torch.einsum("ui,bcyixj,vj->bcyuxv", basis, blocks, basis)
    steps = (1 + k[:, None] + k[None]) / 255
    strength = uniform(0.5, 8.0)[:, None, None, None, None, None]
    steps = steps[None, None, None, :, None, :] * strength
    rounded = torch.einsum("ui,bcyuxv,vj->bcyixj", basis, torch.round(waves / steps) * steps, basis)
    chosen = (uniform() < how.blocks)[:, None, None, None]
    return torch.where(chosen, rounded.reshape(pixels.shape), pixels)
