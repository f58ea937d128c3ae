"""Beginning the training of the small camera detector with an exported one, such as the one that is shipped."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lcf3d.errors import DetectorError
from lcf3d.training.folded import begin_folded, exported_graph

WHAT = "small camera detector"


def begin_with(network: Any, path: Path, batch: Any) -> None:
    """Fill a network with the weights of an exported one, in place; the calibration of its scores is left out.

    Args:
        network: a `lcf3d.detectors.camera.small_network.SmallDetector`; without masks, what makes them is left out.
        path: a file of `lcf3d.detectors.camera.small_export.export_small`.
        batch: of `lcf3d.training.camera.CameraTask.batch`, to measure the statistics of the normalizations on.

    Raises:
        DetectorError: the file is no such network.
        MissingExtraError: the package onnx is not installed.
    """
    from lcf3d.networks.torch import torch

    parameters, scales = exported_parameters(path)
    outputs = len(network.predict.bias)
    for name in ("predict.weight", "predict.bias"):
        if name in parameters and not network.config.prototypes:
            parameters[name] = parameters[name][:outputs]
    if len(scales) != len(network.scale):
        raise DetectorError(f"{path} is no {WHAT} to begin with: it has {len(scales)} scales of boxes")
    begin_folded(network, parameters, lambda: network.outputs(batch["pixels"].float() / 255), path, WHAT)
    with torch.no_grad():
        network.scale.copy_(torch.tensor(scales))


def exported_parameters(path: Path) -> tuple[dict[str, NDArray[np.float32]], list[float]]:
    """Weights and biases of the convolutions by their names in the network, and the scale of boxes of each level.

    Export names what it folded by numbers; the names of the layers are left in those of the graph's nodes.

    Raises:
        DetectorError: the file is absent or no ONNX file.
        MissingExtraError: the package onnx is not installed.
    """
    graph, values = exported_graph(path)
    parameters: dict[str, NDArray[np.float32]] = {}
    scaled: dict[str, float] = {}
    scales: list[float] = []
    for node in graph.node:
        if node.op_type == "Identity" and node.input[0] in values:
            # equal parameters are in the file once
            values[node.output[0]] = values[node.input[0]]
        known = [values[name] for name in node.input if name in values]
        if node.op_type == "Conv" and len(known) == 2:
            name = module_name(node.name)
            parameters[f"{name}.weight"], parameters[f"{name}.bias"] = known
        elif node.op_type == "Mul" and [value.ndim for value in known] == [0]:
            scaled[node.output[0]] = float(known[0])
        elif node.op_type == "Clip":
            # a factor of one is left out of the file
            scales.append(scaled.get(node.input[0], 1.0))
    return parameters, scales


def module_name(node: str) -> str:
    """Name of the module of a node: ``/stages.1/stages.1.2/body/body.0/Conv`` is of ``stages.1.2.body.0``.

    A part of a sequence is named after the whole of it, which is then left out.
    """
    parts = node.strip("/").split("/")[:-1]
    kept = [a for a, b in zip(parts, [*parts[1:], ""], strict=True) if not b.startswith(f"{a}.")]
    return ".".join(kept)
