"""ONNX files with layers of bytes.

Weights have seven bits, so that no sum of two products leaves sixteen bits: processors without instructions for bytes
compute the same. Ranges of the maps are those seen on examples (Jacob et al., "Quantization and Training of Neural
Networks for Efficient Integer-Arithmetic-Only Inference", CVPR 2018).
"""

from __future__ import annotations

import re
import tempfile
from collections.abc import Iterable, Iterator, Mapping
from itertools import chain
from pathlib import Path
from typing import Any

from numpy.typing import NDArray

from lcf3d.files import atomic_path

Feed = dict[str, NDArray[Any]]
KINDS = ("Conv", "Add", "Resize")
"""Operators that can take bytes."""


def quantize(path: Path, layers: re.Pattern[str], seen: Iterable[Feed], out: Path) -> int:
    """Write a network with some of its layers in bytes.

    Args:
        path: an ONNX file of floats.
        layers: matches the names of the convolutions that take bytes.
        seen: inputs of the network by name: their maps tell how large numbers become.
        out: of the file.

    Returns:
        How many layers take bytes; 0 and no file where nothing was seen.
    """
    import onnx
    from onnxruntime.quantization import QuantFormat, QuantType, quantize_static
    from onnxruntime.quantization.shape_inference import quant_pre_process

    examples = iter(seen)
    first = next(examples, None)
    if first is None:
        return 0
    with tempfile.TemporaryDirectory() as folder, atomic_path(out) as temporary:
        prepared = Path(folder) / "prepared.onnx"
        quant_pre_process(str(path), str(prepared), skip_symbolic_shape=True)
        chosen = chosen_nodes(onnx.load(str(prepared)).graph, layers)
        quantize_static(
            str(prepared),
            str(temporary),
            _Reader(chain([first], examples)),
            quant_format=QuantFormat.QDQ,
            op_types_to_quantize=list(KINDS),
            nodes_to_quantize=chosen,
            per_channel=True,
            reduce_range=True,
            activation_type=QuantType.QUInt8,
            weight_type=QuantType.QInt8,
        )
        model, metadata = onnx.load(str(temporary)), onnx.load(str(path)).metadata_props
        del model.metadata_props[:]
        model.metadata_props.extend(metadata)
        onnx.save(model, str(temporary))
    return len(chosen)


def chosen_nodes(graph: Any, layers: re.Pattern[str]) -> list[str]:
    """Names of an ONNX graph's nodes that take bytes: the convolutions of those names, and what joins their maps."""
    names, byte_maps = [], set()
    for node in graph.node:
        inputs = list(node.input[:1] if node.op_type == "Resize" else node.input)
        if node.op_type == "Conv":
            chosen = layers.search(node.name) is not None
        else:
            chosen = node.op_type in KINDS and all(name in byte_maps for name in inputs)
        if chosen:
            names.append(node.name)
        if chosen or (node.op_type == "Relu" and inputs[0] in byte_maps):
            byte_maps.update(node.output)
    return names


class _Reader:
    """Examples as onnxruntime asks for them: one a call, then None."""

    def __init__(self, seen: Iterator[Feed]) -> None:
        self._seen = seen

    def get_next(self) -> Mapping[str, NDArray[Any]] | None:
        """The next example, or None."""
        return next(self._seen, None)
