"""Export of the small camera detector to ONNX, in the layout ``ultralytics`` that `OnnxDetector` reads."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from pathlib import Path

from lcf3d.detectors.camera.small import INPUT_SIZE
from lcf3d.detectors.camera.small_network import SmallDetector
from lcf3d.errors import ConfigError, MissingExtraError
from lcf3d.files import atomic_path
from lcf3d.networks.torch import torch
from lcf3d.structures import KITTI_CLASSES

OPSET = 17


def export_small(
    network: SmallDetector,
    path: Path | str,
    names: Sequence[str] = KITTI_CLASSES,
    size: tuple[int, int] = INPUT_SIZE,
) -> None:
    """Write a detector as an ONNX file that takes images of any size in multiples of 32 pixels.

    Args:
        network: in any mode; it is left as it was.
        path: of the file.
        names: of the classes, kept in the file's metadata.
        size: (height, width) of the input that readers choose unless told otherwise; kept in the metadata.

    Raises:
        MissingExtraError: the package onnx is not installed.
        ConfigError: the number of names is not that of the network's classes.
    """
    if len(names) != network.config.classes:
        raise ConfigError(f"the network has {network.config.classes} classes, got {len(names)} names for them")
    try:
        import onnx
    except ModuleNotFoundError:
        raise MissingExtraError("onnx", "train", "exporting a network") from None
    axes = {"images": {2: "height", 3: "width"}, "detections": {2: "cells"}}
    outputs = ["detections"]
    if network.config.prototypes:
        outputs.append("prototypes")
        axes["prototypes"] = {2: "quarter_height", 3: "quarter_width"}
    training = network.training
    network.eval()
    with atomic_path(Path(path)) as temporary, warnings.catch_warnings():
        # torch announces its other exporter at every use
        warnings.simplefilter("ignore", DeprecationWarning)
        torch.onnx.export(
            network,
            (torch.zeros(1, 3, *size),),
            str(temporary),
            input_names=["images"],
            output_names=outputs,
            dynamic_axes=axes,
            opset_version=OPSET,
            dynamo=False,
        )
        model = onnx.load(str(temporary))
        described = {"names": str(dict(enumerate(names))), "imgsz": str(list(size))}
        for key, value in described.items():
            entry = model.metadata_props.add()
            entry.key, entry.value = key, value
        onnx.save(model, str(temporary))
    network.train(training)
