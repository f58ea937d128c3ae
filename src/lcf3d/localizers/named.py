"""Localizers by name: what ``--localizer`` takes, and what the fusion uses when none is named."""

from __future__ import annotations

from collections.abc import Callable, Collection
from functools import lru_cache
from pathlib import Path

import numpy as np

from lcf3d.errors import ConfigError
from lcf3d.fusion.frustum import FrustumProposals
from lcf3d.localizers.base import Localizer
from lcf3d.localizers.geometric import GeometricLocalizer
from lcf3d.structures import FloatArray

MODELS = Path(__file__).parent.parent / "models"
SHIPPED = {"kitti": MODELS / "localizer_kitti.onnx", "nuscenes": MODELS / "localizer_nuscenes.onnx"}
BY_NETWORK: frozenset[str] = frozenset()
"""Classes in which the shipped network beats the geometric localizer on real scans: docs/localizers.md."""


class HybridLocalizer:
    """A network for the classes in which it is the better one, geometry for all others; a `Localizer`.

    Args:
        network: asked for the classes of ``by_network``.
        by_network: class names.
        geometric: asked for the rest, and where the network gives no box.
    """

    def __init__(self, network: Localizer, by_network: Collection[str], geometric: Localizer | None = None) -> None:
        self.network, self.by_network = network, frozenset(by_network)
        self.geometric = geometric or GeometricLocalizer()

    def __call__(self, proposals: FrustumProposals) -> tuple[FloatArray, FloatArray]:
        """Boxes (K, 7) in the frustum frames, NaN where no object was found, and qualities (K,)."""
        boxes, quality = np.full((len(proposals), 7), np.nan), np.zeros(len(proposals))
        names = np.array([proposals.class_names[label] in self.by_network for label in proposals.labels], dtype=bool)
        for rows, localizer in ((np.flatnonzero(names), self.network), (np.flatnonzero(~names), self.geometric)):
            if len(rows):
                boxes[rows], quality[rows] = localizer(proposals.select(rows))
        return boxes, quality


class ShippedLocalizer:
    """The networks that come with lcf3d: KITTI's for its three classes, nuScenes' for its ten; a `Localizer`.

    Args:
        threads: threads of onnxruntime, 0 for one a core; the networks are so small that one is quickest.
    """

    def __init__(self, threads: int = 1) -> None:
        self.threads = threads

    def __call__(self, proposals: FrustumProposals) -> tuple[FloatArray, FloatArray]:
        """Boxes (K, 7) in the frustum frames, NaN for classes of neither, and believed 3D IoUs (K,)."""
        dataset = "nuscenes" if any(name.islower() for name in proposals.class_names) else "kitti"
        return _shipped(dataset, self.threads)(proposals)


@lru_cache(maxsize=4)
def _shipped(dataset: str, threads: int) -> Localizer:
    from lcf3d.localizers.onnx import OnnxLocalizer

    return OnnxLocalizer(SHIPPED[dataset], threads)


def default_localizer(threads: int = 1) -> Localizer:
    """The better one for each class, as measured; ``threads`` are those of the network, 0 for one a core."""
    return HybridLocalizer(ShippedLocalizer(threads), BY_NETWORK) if BY_NETWORK else GeometricLocalizer()


def load_localizer(text: str) -> Localizer:
    """The localizer that a string names.

    ``hybrid`` (the default), ``geometric``, ``network`` (the shipped ones), ``onnx:FILE`` (of ``lcf3d train
    localizer``), ``frustum-pointnet:FILE`` (a checkpoint of the LCF3D authors' form).

    Raises:
        ConfigError: it names none.
        DetectorError: the file is no such network.
    """
    kind, _, argument = text.partition(":")
    if text in PLAIN:
        return PLAIN[text]()
    if kind == "onnx" and argument:
        from lcf3d.localizers.onnx import OnnxLocalizer

        return OnnxLocalizer(argument)
    if kind == "frustum-pointnet" and argument:
        from lcf3d.localizers.torch_localizer import TorchLocalizer

        return TorchLocalizer(argument)
    raise ConfigError(f"unknown localizer {text!r}; name {', '.join(PLAIN)}, onnx:FILE, or frustum-pointnet:FILE")


PLAIN: dict[str, Callable[[], Localizer]] = {
    "hybrid": default_localizer,
    "geometric": GeometricLocalizer,
    "network": ShippedLocalizer,
}
