"""Parts of transformers, under the parameter names of OpenMMLab's checkpoints."""

# mypy: allow-subclassing-any
from __future__ import annotations

from lcf3d.networks.torch import Tensor, nn


class FeedForward(nn.Module):
    """Linear, activation, linear, added to the input; the names are ``layers.0.0`` and ``layers.1``."""

    def __init__(self, channels: int, hidden: int, activation: nn.Module) -> None:
        super().__init__()
        self.layers = nn.Sequential(nn.Sequential(nn.Linear(channels, hidden), activation), nn.Linear(hidden, channels))

    def forward(self, x: Tensor, shortcut: Tensor | None = None) -> Tensor:
        """(..., C) -> (..., C); added to ``shortcut``, or to the input without one."""
        return (x if shortcut is None else shortcut) + self.layers(x)


class Attention(nn.Module):
    """Attention (Vaswani et al., NIPS 2017) added to its input; the parameters are under the name ``attn``."""

    def __init__(self, channels: int, heads: int) -> None:
        super().__init__()
        self.attn = nn.MultiheadAttention(channels, heads, batch_first=True)

    def forward(self, x: Tensor, query: Tensor, key: Tensor, value: Tensor, mask: Tensor | None = None) -> Tensor:
        """(N, Q, C) ``x`` plus what the (N, Q, C) queries gather from the (N, K, C) values at their keys.

        Args:
            x: what the result is added to.
            query: queries, usually ``x`` with its position.
            key: keys.
            value: values.
            mask: (Q, K) bool, True where a query may not look.
        """
        return x + self.attn(query, key, value, need_weights=False, attn_mask=mask)[0]
