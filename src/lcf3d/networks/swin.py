"""Swin transformer (Liu et al., ICCV 2021), under the parameter names of OpenMMLab's checkpoints."""

# mypy: allow-subclassing-any
from __future__ import annotations

from collections.abc import Sequence

from lcf3d.networks.attention import FeedForward
from lcf3d.networks.torch import Tensor, functional, nn, torch

MASKED = -100.0
"""Added to the attention between cells that the cyclic shift made neighbours, as in the original training."""


def relative_position_index(window: int) -> Tensor:
    """(L, L) row of the bias table for each query and key of a window of L = window ** 2 cells (section 3.2)."""
    axis = torch.arange(window)
    cells = torch.cartesian_prod(axis, axis)
    offset = cells[:, None] - cells[None] + window - 1
    return offset[..., 0] * (2 * window - 1) + offset[..., 1]


def to_windows(x: Tensor, window: int) -> Tensor:
    """(N, windows, L, C) cells of each window of an (N, H, W, C) map whose sides are multiples of ``window``."""
    n, height, width, channels = x.shape
    x = x.reshape(n, height // window, window, width // window, window, channels)
    return x.transpose(2, 3).reshape(n, -1, window * window, channels)


def from_windows(x: Tensor, window: int, height: int, width: int) -> Tensor:
    """The (N, H, W, C) map of which `to_windows` made ``x``."""
    n, _, _, channels = x.shape
    x = x.reshape(n, height // window, width // window, window, window, channels)
    return x.transpose(2, 3).reshape(n, height, width, channels)


def shift_mask(height: int, width: int, window: int, shift: int, like: Tensor) -> Tensor:
    """(windows, 1, L, L) what keeps cells apart that were no neighbours before the map was rolled by ``shift``."""

    def region(size: int) -> Tensor:
        bounds = torch.tensor([size - window, size - shift], device=like.device)
        return torch.bucketize(torch.arange(size, device=like.device), bounds, right=True)

    regions = region(height)[:, None] * 3 + region(width)
    cells = to_windows(regions[None, :, :, None], window)[0, :, :, 0]
    apart = cells[:, None, :] != cells[:, :, None]
    return (apart * MASKED).to(like.dtype)[:, None]


class WindowAttention(nn.Module):
    """Self-attention within a window, with a learned bias for every offset between two cells."""

    def __init__(self, channels: int, heads: int, window: int) -> None:
        super().__init__()
        self.heads, self.window = heads, window
        self.relative_position_bias_table = nn.Parameter(torch.zeros((2 * window - 1) ** 2, heads))
        self.qkv = nn.Linear(channels, 3 * channels)
        self.proj = nn.Linear(channels, channels)

    def forward(self, x: Tensor, mask: Tensor | None) -> Tensor:
        """(N, windows, L, C) -> the same; the (windows, 1, L, L) mask is added to the attention."""
        n, windows, length, channels = x.shape
        qkv = self.qkv(x).reshape(n, windows, length, 3, self.heads, channels // self.heads)
        query, key, value = qkv.permute(3, 0, 1, 4, 2, 5)
        index = relative_position_index(self.window).to(x.device)
        bias = self.relative_position_bias_table[index].permute(2, 0, 1)
        attention = (query * (channels // self.heads) ** -0.5) @ key.transpose(-1, -2)
        attention = attention + (bias if mask is None else bias + mask)
        x = attention.softmax(dim=-1) @ value
        return self.proj(x.transpose(2, 3).reshape(n, windows, length, channels))


class ShiftedWindowAttention(nn.Module):
    """`WindowAttention` (under the name ``w_msa``) on a map, whose windows may be shifted (section 3.2)."""

    def __init__(self, channels: int, heads: int, window: int, shift: int) -> None:
        super().__init__()
        self.window, self.shift = window, shift
        self.w_msa = WindowAttention(channels, heads, window)

    def forward(self, x: Tensor) -> Tensor:
        """(N, H, W, C) -> (N, H, W, C); sides that are no multiples of the window are filled up with zeros."""
        height, width = x.shape[1:3]
        x = functional.pad(x, (0, 0, 0, -width % self.window, 0, -height % self.window))
        full_height, full_width = x.shape[1:3]
        mask = None
        if self.shift:
            x = x.roll((-self.shift, -self.shift), dims=(1, 2))
            mask = shift_mask(full_height, full_width, self.window, self.shift, x)
        x = from_windows(self.w_msa(to_windows(x, self.window), mask), self.window, full_height, full_width)
        if self.shift:
            x = x.roll((self.shift, self.shift), dims=(1, 2))
        return x[:, :height, :width]


class SwinBlock(nn.Module):
    """Attention in windows, then two linear layers, each with a shortcut (equation 3)."""

    def __init__(self, channels: int, heads: int, window: int, shift: int) -> None:
        super().__init__()
        self.norm1 = nn.LayerNorm(channels)
        self.attn = ShiftedWindowAttention(channels, heads, window, shift)
        self.norm2 = nn.LayerNorm(channels)
        self.ffn = FeedForward(channels, 4 * channels, nn.GELU())

    def forward(self, x: Tensor) -> Tensor:
        """(N, H, W, C) -> (N, H, W, C)."""
        x = x + self.attn(self.norm1(x))
        return self.ffn(self.norm2(x), x)


class PatchMerging(nn.Module):
    """Each 2 x 2 cells become one of twice the channels."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.norm = nn.LayerNorm(4 * channels)
        self.reduction = nn.Linear(4 * channels, 2 * channels, bias=False)

    def forward(self, x: Tensor) -> Tensor:
        """(N, H, W, C) -> (N, ceil(H / 2), ceil(W / 2), 2 C)."""
        n, height, width, channels = x.shape
        x = functional.pad(x, (0, 0, 0, width % 2, 0, height % 2))
        # the four cells of a channel follow one another, as torch's unfold puts them
        x = x.reshape(n, (height + 1) // 2, 2, (width + 1) // 2, 2, channels).permute(0, 1, 3, 5, 2, 4).flatten(3)
        return self.reduction(self.norm(x))


class SwinStage(nn.Module):
    """Blocks whose windows are shifted in every second one, and a merging of cells unless it is the last stage."""

    def __init__(self, channels: int, depth: int, heads: int, window: int, last: bool) -> None:
        super().__init__()
        self.blocks = nn.ModuleList(
            [SwinBlock(channels, heads, window, shift=window // 2 * (i % 2)) for i in range(depth)]
        )
        self.downsample = None if last else PatchMerging(channels)

    def forward(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """The stage's (N, H, W, C) output, and what the next stage takes (the same after the last)."""
        for block in self.blocks:
            x = block(x)
        return x, x if self.downsample is None else self.downsample(x)


class PatchEmbed(nn.Module):
    """Each 4 x 4 pixels become one cell."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.projection = nn.Conv2d(3, channels, 4, 4)
        self.norm = nn.LayerNorm(channels)

    def forward(self, image: Tensor) -> Tensor:
        """(N, 3, H, W) -> (N, ceil(H / 4), ceil(W / 4), C)."""
        image = functional.pad(image, (0, -image.shape[-1] % 4, 0, -image.shape[-2] % 4))
        return self.norm(self.projection(image).permute(0, 2, 3, 1))


class SwinTransformer(nn.Module):
    """The backbone.

    Args:
        channels: of the first stage; each further one has twice as many.
        depths: blocks of each stage.
        heads: of each stage's attention.
        window: cells along a side of a window.
        outputs: stages whose output is returned, each through a normalization of its own.
    """

    def __init__(
        self, channels: int, depths: Sequence[int], heads: Sequence[int], window: int, outputs: Sequence[int]
    ) -> None:
        super().__init__()
        self.outputs = tuple(outputs)
        self.patch_embed = PatchEmbed(channels)
        self.stages = nn.ModuleList(
            [
                SwinStage(channels << i, depth, stage_heads, window, last=i == len(depths) - 1)
                for i, (depth, stage_heads) in enumerate(zip(depths, heads, strict=True))
            ]
        )
        for i in self.outputs:
            self.add_module(f"norm{i}", nn.LayerNorm(channels << i))

    def forward(self, image: Tensor) -> list[Tensor]:
        """(N, 3, H, W) -> the maps (N, C 2^i, H / (4 2^i), W / (4 2^i)) of the chosen stages i."""
        x = self.patch_embed(image)
        maps = []
        for i, stage in enumerate(self.stages):
            output, x = stage(x)
            if i in self.outputs:
                maps.append(self.get_submodule(f"norm{i}")(output).permute(0, 3, 1, 2).contiguous())
        return maps
