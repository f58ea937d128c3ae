"""Tiny ONNX files whose outputs are constants, so that what a decoder makes of them can be worked out by hand."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

onnx = pytest.importorskip("onnx")
from onnx import TensorProto, helper, numpy_helper  # noqa: E402


def constant_graph(
    path: Path,
    outputs: Mapping[str, NDArray],
    inputs: Mapping[str, list[int | str]],
    metadata: Mapping[str, str] | None = None,
    dynamic: bool = False,
) -> Path:
    """Write a graph with the given inputs (float, ``orig_target_sizes`` int64) that always gives the given outputs."""
    nodes, values, initializers = [], [], []
    for name, array in outputs.items():
        initializers.append(numpy_helper.from_array(np.ascontiguousarray(array), f"{name}_value"))
        nodes.append(helper.make_node("Identity", [f"{name}_value"], [name]))
        shape = [f"{name}_{i}" for i in range(array.ndim)] if dynamic else array.shape
        values.append(helper.make_tensor_value_info(name, helper.np_dtype_to_tensor_dtype(array.dtype), shape))
    graph_inputs = [
        helper.make_tensor_value_info(name, TensorProto.INT64 if "sizes" in name else TensorProto.FLOAT, shape)
        for name, shape in inputs.items()
    ]
    graph = helper.make_graph(nodes, "constant", graph_inputs, values, initializers)
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)])
    model.ir_version = 8
    helper.set_model_props(model, dict(metadata or {}))
    onnx.save(model, path)
    return path
