"""Published weights: reading checkpoint files without executing code, and finding out what network they belong to."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from lcf3d.errors import DetectorError

SHOWN_NAMES = 5
"""Names listed in a message before it goes on with how many more there are."""


def load_parameters(network: Any, state: Mapping[str, Any], name: str) -> None:
    """Fill ``network`` (which may be on the meta device) with a checkpoint's parameters.

    Args:
        network: a torch module.
        state: parameter name -> tensor.
        name: what the network is called in the message.

    Raises:
        DetectorError: names or shapes differ; the message lists missing, unexpected and differently shaped ones.
    """
    state = {key.removeprefix("pts_"): value for key, value in state.items()}
    report = difference(network, state)
    if report:
        raise DetectorError(f"the checkpoint does not fit {name}: {report}")
    network.load_state_dict(state, assign=True)


def difference(network: Any, state: Mapping[str, Any]) -> str:
    """What keeps ``state`` from being loaded into ``network``, in words; empty when nothing does."""
    expected = {key: tuple(value.shape) for key, value in network.state_dict().items()}
    missing = [key for key in expected if key not in state and not key.endswith("num_batches_tracked")]
    unexpected = [key for key in state if key not in expected]
    shapes = [
        f"{key} (expected {expected[key]}, got {tuple(state[key].shape)})"
        for key in expected
        if key in state and tuple(state[key].shape) != expected[key]
    ]
    parts = (("missing", missing), ("unexpected", unexpected), ("of another shape", shapes))
    return "; ".join(f"{len(names)} {what}: {_listed(names)}" for what, names in parts if names)


def _listed(names: list[str]) -> str:
    rest = len(names) - SHOWN_NAMES
    return ", ".join(names[:SHOWN_NAMES]) + (f" and {rest} more" if rest > 0 else "")
