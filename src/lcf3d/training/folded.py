"""Beginning a training with an exported network, whose normalization was folded into its layers.

Every layer gets its folded weights, and every normalization is set so that it changes nothing but adds the folded bias:
its running statistics are those of a batch, its scale and shift undo them. Training then goes on with batch statistics,
close to where the exported network stood.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lcf3d.errors import DetectorError, MissingExtraError


def exported_graph(path: Path) -> tuple[Any, dict[str, NDArray[np.float32]]]:
    """The graph of an ONNX file, and its parameters by name; those that are stored as bytes by their own name again.

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
        values = {tensor.name: to_array(tensor) for tensor in graph.initializer}
        return graph, values | dict(_dequantized(graph, values))
    except Exception as error:  # protobuf's errors share no base class with onnx's
        raise DetectorError(f"{path} cannot be read as an ONNX file ({type(error).__name__})") from None


def _dequantized(graph: Any, values: Mapping[str, NDArray[Any]]) -> Iterator[tuple[str, NDArray[np.float32]]]:
    """Parameters that are stored as bytes (`lcf3d.training.quantization`), by their own names and their nodes'."""
    for node in graph.node:
        if node.op_type != "DequantizeLinear" or node.input[0] not in values:
            continue
        stored, scale, zero = (values[name].astype(np.float32) for name in node.input)
        # one scale, or one a channel of the first axis
        shape = (-1,) + (1,) * (stored.ndim - 1) if scale.size > 1 else ()
        whole = ((stored - zero.reshape(shape)) * scale.reshape(shape)).astype(np.float32)
        yield node.output[0], whole
        yield node.input[0].removesuffix("_quantized"), whole


def begin_folded(
    network: Any, parameters: Mapping[str, NDArray[np.float32]], run: Callable[[], Any], path: Path, what: str
) -> None:
    """Fill a network with folded parameters, in place, and leave it in training mode.

    Args:
        network: a torch module; its layers may take more values than the exported ones, which begin at zero.
        parameters: by their names in the network; a layer with a normalization has the folded weight and bias.
        run: passes a batch through the network, to measure the statistics of the normalizations on.
        path: of the exported file, for messages.
        what: the file should be, in words.

    Raises:
        DetectorError: a parameter is missing or of another shape.
    """
    from lcf3d.detectors.lidar.fusing import normalized_layers
    from lcf3d.networks.torch import torch

    norms = {
        f"{name}.{layer}".lstrip("."): module.get_submodule(norm)
        for name, module, layer, norm in normalized_layers(network)
    }
    with torch.no_grad():
        for name, layer in network.named_modules():
            if not hasattr(layer, "weight") or layer in norms.values():
                continue
            bias = norms[name].bias if name in norms else layer.bias
            for parameter, part in ((layer.weight, "weight"), (bias, "bias")):
                _fill(parameter, parameters.get(f"{name}.{part}"), f"{name}.{part}", f"{path} is no {what}")
        network.eval()
        _measure(list(norms.values()), run)
    network.train()


def _fill(parameter: Any, values: NDArray[np.float32] | None, name: str, no: str) -> None:
    """Copy values into a parameter; what they lack along its second axis is zero."""
    from lcf3d.networks.torch import torch

    wanted = tuple(parameter.shape)
    fits = values is not None and (
        values.shape == wanted
        or (values.ndim == 2 == len(wanted) and values.shape[0] == wanted[0] and values.shape[1] < wanted[1])
    )
    if values is None or not fits:
        came = "is missing" if values is None else f"has shape {values.shape}, expected {wanted}"
        raise DetectorError(f"{no} to begin with: {name} {came}")
    parameter.zero_()
    parameter[tuple(slice(n) for n in values.shape)] = torch.from_numpy(values.copy())


def _measure(norms: list[Any], run: Callable[[], Any]) -> None:
    """Give normalizations, whose biases are the folded ones, the statistics of a batch, and undo them.

    Of one that is used several times (on maps of several sizes) it is the mean of its statistics.
    """
    seen: list[list[tuple[Any, Any]]] = [[] for _ in norms]
    folded = [norm.bias.clone() for norm in norms]
    handles = [
        norm.register_forward_pre_hook(partial(_note, seen=seen[k], folded=folded[k])) for k, norm in enumerate(norms)
    ]
    run()
    for handle in handles:
        handle.remove()
    for norm, statistics, bias in zip(norms, seen, folded, strict=True):
        if statistics:
            mean, variance = (sum(part) / len(statistics) for part in zip(*statistics, strict=True))
            _undo(norm, mean, variance, bias)


def _note(norm: Any, inputs: tuple[Any, ...], seen: list[tuple[Any, Any]], folded: Any) -> None:
    """Note the statistics of what comes in, and let nothing but the folded bias be added to it."""
    (x,) = inputs
    axes = [axis for axis in range(x.ndim) if axis != 1]
    seen.append((x.mean(axes), x.var(axes, unbiased=False)))
    _undo(norm, *seen[-1], folded)


def _undo(norm: Any, mean: Any, variance: Any, folded: Any) -> None:
    """Statistics of a normalization, and the scale and shift that leave the folded bias of it."""
    norm.running_mean.copy_(mean)
    norm.running_var.copy_(variance)
    norm.weight.copy_((variance + norm.eps).sqrt())
    norm.bias.copy_(folded + mean)
