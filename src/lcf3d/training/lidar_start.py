"""Beginning the training of a pillar network with an exported one.

Values of painted points, which the exported network did not know, begin with weights of zero.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from lcf3d.training.folded import begin_folded, exported_graph

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
    _, values = exported_graph(path)
    parameters = {n.removeprefix(PREFIX): value for n, value in values.items() if n.startswith(PREFIX)}
    begin_folded(
        network,
        parameters,
        lambda: network(batch["features"], batch["pillars"], len(batch["heat"]), window),
        path,
        "compact pillar network",
    )
