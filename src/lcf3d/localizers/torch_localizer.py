"""Frustum networks run by torch: checkpoints of the LCF3D authors' release, or of our own training."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from lcf3d.detectors.downloads import local_path
from lcf3d.errors import DetectorError
from lcf3d.fusion.frustum import FrustumProposals
from lcf3d.localizers.onnx import localize
from lcf3d.localizers.pointnet2 import FrustumPointNet2
from lcf3d.localizers.spec import TEMPLATES, LocalizerSpec
from lcf3d.networks.checkpoints import load_parameters, read_state_dict
from lcf3d.networks.torch import torch
from lcf3d.structures import FloatArray

OUTPUT = "output_fc.weight"


class TorchLocalizer:
    """A frustum network of the form ``v2`` from a checkpoint file; a `Localizer`.

    The number of classes, and with it the templates (KITTI's three or nuScenes' ten), is found from the parameters.

    Args:
        path: the checkpoint; no code in it is executed.
        device: a torch device, for example ``cpu`` or ``cuda``.

    Raises:
        DetectorError: the file is damaged, or of another architecture; names the first parameter that does not fit.
    """

    def __init__(self, path: Path | str, device: str = "cpu") -> None:
        state = read_state_dict(local_path(str(path), "localizer"))
        self.spec = _spec_of(state, str(path))
        network = FrustumPointNet2(self.spec)
        load_parameters(network, _without_prefix(state), str(path))
        self.device = torch.device(device)
        self.network = network.eval().requires_grad_(False).to(self.device)

    def __call__(self, proposals: FrustumProposals) -> tuple[FloatArray, FloatArray]:
        """Boxes (K, 7) in the frustum frames, NaN for unknown classes, and qualities (K,): certainty of the mask."""
        return localize(proposals, self.spec, self._run)

    def _run(self, points: Any, context: Any) -> tuple[Any, Any, Any]:
        with torch.inference_mode():
            found = self.network(*(torch.from_numpy(value).to(self.device) for value in (points, context)))
        return tuple(v.cpu().double().numpy() for v in (found.centre, found.box, torch.sigmoid(found.quality)))  # type: ignore[return-value]


def _without_prefix(state: Mapping[str, Any]) -> dict[str, Any]:
    """Parameters by the network's own names, should they be nested in a larger model."""
    nested = next((name for name in state if name.endswith("." + OUTPUT)), None)
    if nested is None:
        return dict(state)
    prefix = nested.removesuffix(OUTPUT)
    return {name.removeprefix(prefix): value for name, value in state.items() if name.startswith(prefix)}


def _spec_of(state: Mapping[str, Any], source: str) -> LocalizerSpec:
    weight = _without_prefix(state).get(OUTPUT)
    if weight is None:
        raise DetectorError(f"{source} is of another architecture: it has no parameter {OUTPUT!r}")
    for dataset in TEMPLATES:
        spec = LocalizerSpec.of("v2", dataset)
        if int(np.asarray(weight.shape)[0]) == spec.outputs:
            return spec
    raise DetectorError(
        f"{source} is of another architecture: {OUTPUT!r} has {weight.shape[0]} rows, expected "
        + " or ".join(f"{LocalizerSpec.of('v2', d).outputs} ({d})" for d in TEMPLATES)
    )
