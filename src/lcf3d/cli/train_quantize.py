"""``lcf3d train quantize``: a trained network with layers of bytes."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer


def quantize(
    network: Annotated[Path, typer.Argument(help="camera.onnx or lidar.onnx of 'lcf3d train'")],
    dataset: Annotated[
        str, typer.Argument(help="kitti:ROOT, nuscenes:ROOT, ...: frames like those to come, no labels")
    ],
    out: Annotated[Path, typer.Option(help="file for the quicker network")],
    split: Annotated[str | None, typer.Option(help="split of the dataset; the usual one if left out")] = None,
    frames: Annotated[int, typer.Option(min=1, help="so many frames, evenly spread over the split")] = 24,
) -> None:
    """Make a trained network about twice as quick: its middle layers compute with bytes.

    lcf3d train quantize mine/lidar.onnx kitti:KITTI --split train --out mine/lidar-bytes.onnx

    Frames tell how large the numbers in the network become. Measure both files before one takes the other's place.
    """
    from lcf3d.cli.console import console
    from lcf3d.datasets.opening import open_dataset
    from lcf3d.errors import ConfigError
    from lcf3d.run.alignment import evenly
    from lcf3d.training.quantization import kind_of, quantize_trained

    if out.resolve() == network.resolve():
        raise ConfigError(f"--out {out} is the network itself; name another file, so that both can be compared")
    kind = kind_of(network)
    data = open_dataset(dataset, split=split)
    chosen, _ = evenly(data.ids, frames)
    layers = quantize_trained(network, kind, map(data.frame, chosen), out)
    sizes = " -> ".join(f"{path.stat().st_size / 1e6:.1f} MB" for path in (network, out))
    console().print(f"wrote {out}: {layers} layers take bytes, {sizes}; ranges of {len(chosen)} frames")
