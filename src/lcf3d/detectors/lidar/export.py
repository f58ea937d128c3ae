"""Export of the pillar networks to ONNX: everything between voxelization and decoding, with dynamic point numbers."""

# mypy: allow-subclassing-any
from __future__ import annotations

import json
from pathlib import Path

from lcf3d.detectors.lidar._torch import Tensor, nn, torch
from lcf3d.detectors.lidar.detector import TorchLidarDetector
from lcf3d.detectors.lidar.heads import CENTER_CHANNELS
from lcf3d.detectors.lidar.onnx import CONFIG_KEY
from lcf3d.detectors.lidar.pillars import PillarNetwork
from lcf3d.errors import DetectorError, MissingExtraError
from lcf3d.formats.files import atomic_path

OPSET = 18
"""First version whose scatter can take a maximum."""
INPUTS = ("features", "pillar", "padded", "cells")


class _Flat(nn.Module):
    """A pillar network with its output maps in one flat tuple."""

    def __init__(self, network: PillarNetwork) -> None:
        super().__init__()
        self.network = network

    def forward(self, features: Tensor, pillar: Tensor, padded: Tensor, cells: Tensor) -> tuple[Tensor, ...]:
        """Maps in the order of `output_names`."""
        flat: list[Tensor] = []
        for maps in self.network(features, pillar, padded, cells):
            flat += [maps[name] for name in (*CENTER_CHANNELS, "heatmap")] if isinstance(maps, dict) else maps
        return tuple(flat)


def output_names(detector: TorchLidarDetector) -> list[str]:
    """Names of the exported maps: ``LEVEL.KIND`` for anchors, ``TASK.KIND`` for centres."""
    config = detector.config
    if config.anchors is not None:
        return [f"{i}.{kind}" for i in range(len(config.anchors.levels)) for kind in ("cls", "reg", "dir")]
    assert config.centers is not None
    return [f"{i}.{kind}" for i in range(len(config.centers.tasks)) for kind in (*CENTER_CHANNELS, "heatmap")]


def export_onnx(detector: TorchLidarDetector, path: Path | str) -> None:
    """Write a pillar detector (PointPillars, SSN, CenterPoint with pillars) as an ONNX file for `OnnxLidarDetector`.

    The configuration travels in the file's metadata. The network is exported as it is used: normalization folded.

    Raises:
        MissingExtraError: the package onnx is not installed.
        DetectorError: the network has sparse convolutions, for which ONNX has no operator.
    """
    if not isinstance(detector.network, PillarNetwork):
        raise DetectorError(
            f"{detector.config.name} has sparse convolutions, which ONNX cannot express; "
            "PointPillars, SSN and CenterPoint with pillars can be exported"
        )
    try:
        import onnx
    except ModuleNotFoundError:
        raise MissingExtraError("onnx", "train", "exporting a network") from None
    network = detector.network.to("cpu")
    points = len(detector.config.channels) + 6
    example = (
        torch.zeros(3, points),
        torch.tensor([0, 0, 1]),
        torch.ones(2, 1),
        torch.tensor([0, 1]),
    )
    names = output_names(detector)
    axes = {"features": {0: "points"}, "pillar": {0: "points"}, "padded": {0: "pillars"}, "cells": {0: "pillars"}}
    with atomic_path(Path(path)) as temporary:
        torch.onnx.export(
            _Flat(network).eval(),
            example,
            str(temporary),
            input_names=list(INPUTS),
            output_names=names,
            dynamic_axes=axes,
            opset_version=OPSET,
            dynamo=False,
        )
        model = onnx.load(str(temporary))
        entry = model.metadata_props.add()
        entry.key, entry.value = CONFIG_KEY, json.dumps(detector.config.to_dict())
        onnx.save(model, str(temporary))
    detector.network.to(detector.device)
