"""Beginning a training with an exported network, whose normalization was folded into its layers.

Every layer gets its folded weights, and every normalization is set so that it changes nothing but adds the folded bias:
its running statistics are those of a batch, its scale and shift undo them. Training then goes on with batch statistics,
close to where the exported network stood. Values of painted points, which the exported network did not know, begin with
weights of zero.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lcf3d.errors import DetectorError, MissingExtraError

PREFIX = "network."
"""Of the parameters' names in exported files."""


def begin_with(network: Any, path: Path, batch: Any, window: tuple[int, int]) -> None:
    """Fill a compact network with the weights of an exported one, in place.

    Args:
        network: a `lcf3d.detectors.lidar.compact.CompactNetwork`, which may take more values of a pillar.
        path: the exported file.
        batch: as `lcf3d.training.lidar.collate` makes it, to measure the statistics of the normalizations on.
        window: pillars along x and y of its windows.

    Raises:
        DetectorError: the file is no such network.
        MissingExtraError: the package onnx is not installed.
    """
    from lcf3d.detectors.lidar.fusing import normalized_layers
    from lcf3d.networks.torch import torch

    parameters = exported_parameters(path)
    norms = {
        f"{name}.{layer}".lstrip("."): module.get_submodule(norm)
        for name, module, layer, norm in normalized_layers(network)
    }
    handles = []
    with torch.no_grad():
        for name, layer in network.named_modules():
            if not hasattr(layer, "weight") or layer in norms.values():
                continue
            _fill(layer.weight, parameters.get(f"{name}.weight"), f"{name}.weight", path)
            bias = norms[name].bias if name in norms else layer.bias
            _fill(bias, parameters.get(f"{name}.bias"), f"{name}.bias", path)
        for norm in norms.values():
            handles.append(norm.register_forward_pre_hook(_pass_through))
        network.eval()
        network(batch["features"], batch["pillars"], len(batch["heat"]), window)
    for handle in handles:
        handle.remove()
    network.train()


def exported_parameters(path: Path) -> dict[str, NDArray[np.float32]]:
    """The parameters in a file of `lcf3d.detectors.lidar.export.export_onnx`, by their names in the network.

    Raises:
        DetectorError: the file is absent or no ONNX file.
        MissingExtraError: the package onnx is not installed.
    """
    try:
        import onnx
        from onnx.numpy_helper import to_array
    except ModuleNotFoundError:
        raise MissingExtraError("onnx", "train", "beginning with an exported network") from None
    if not path.is_file():
        raise DetectorError(f"{path} does not exist; expected an exported network, or shipped:kitti")
    try:
        graph = onnx.load(str(path)).graph
    except Exception as error:  # protobuf's errors share no base class with onnx's
        raise DetectorError(f"{path} cannot be read as an ONNX file ({type(error).__name__})") from None
    return {
        tensor.name.removeprefix(PREFIX): to_array(tensor)
        for tensor in graph.initializer
        if tensor.name.startswith(PREFIX)
    }


def _fill(parameter: Any, values: NDArray[np.float32] | None, name: str, path: Path) -> None:
    """Copy values into a parameter; what they lack along its second axis is zero."""
    from lcf3d.networks.torch import torch

    wanted = tuple(parameter.shape)
    fits = values is not None and (
        values.shape == wanted
        or (values.ndim == 2 == len(wanted) and values.shape[0] == wanted[0] and values.shape[1] < wanted[1])
    )
    if values is None or not fits:
        came = "is missing" if values is None else f"has shape {values.shape}, expected {wanted}"
        raise DetectorError(f"{path} is no compact pillar network to begin with: {name} {came}")
    parameter.zero_()
    parameter[tuple(slice(n) for n in values.shape)] = torch.from_numpy(values.copy())


def _pass_through(norm: Any, inputs: tuple[Any, ...]) -> None:
    """Make a normalization, whose bias is the folded one, add that bias and nothing else to what comes in now."""
    (x,) = inputs
    axes = [axis for axis in range(x.ndim) if axis != 1]
    mean, variance = x.mean(axes), x.var(axes, unbiased=False)
    norm.running_mean.copy_(mean)
    norm.running_var.copy_(variance)
    norm.weight.copy_((variance + norm.eps).sqrt())
    norm.bias.add_(mean)
