"""Localizers by name: what ``--localizer`` takes, and the networks that come with lcf3d."""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path

from lcf3d import plugins
from lcf3d.fusion.frustum import FrustumProposals
from lcf3d.fusion.localizer import Localizer
from lcf3d.structures import FloatArray

MODELS = Path(__file__).parent.parent / "models"
SHIPPED = {"kitti": MODELS / "localizer_kitti.onnx", "nuscenes": MODELS / "localizer_nuscenes.onnx"}


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


def load_localizer(text: str) -> Localizer:
    """The localizer that a string names, see `lcf3d.plugins`.

    ``geometric`` (the default), ``network`` (the shipped ones), ``combined`` (both), ``onnx:FILE`` (of ``lcf3d train
    localizer``), ``frustum-pointnet:FILE`` (a checkpoint of the LCF3D authors' form).

    Raises:
        ConfigError: it names none.
        DetectorError: the file is no such network.
    """
    localizer: Localizer = plugins.build("lcf3d.localizers", text)
    return localizer
