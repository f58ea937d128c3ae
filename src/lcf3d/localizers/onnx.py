"""Frustum networks run by onnxruntime: no torch needed; all frustums of a frame in one batch."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from lcf3d.errors import DetectorError
from lcf3d.fusion.frustum import FrustumProposals
from lcf3d.localizers.frustum_inputs import network_inputs
from lcf3d.localizers.spec import LocalizerSpec, decode_boxes
from lcf3d.networks.onnx import open_session, read_metadata
from lcf3d.structures import FloatArray

SPEC_KEY = "lcf3d.localizer"
INPUTS = ("points", "context")
OUTPUTS = ("centre", "box", "quality")


class OnnxLocalizer:
    """A frustum network from a file that `lcf3d.localizers.pointnet.export_onnx` wrote; a `Localizer`.

    Frustums of classes that the network was not trained for get no box.

    Args:
        path: the file.
        threads: threads of onnxruntime, 0 for one a core; the networks are so small that one is quickest.

    Raises:
        DetectorError: there is no such file, or it is no frustum network of lcf3d.
        ConfigError: it was written by a later version.
    """

    def __init__(self, path: Path | str, threads: int = 1) -> None:
        self._session = open_session(Path(path), threads, "a frustum network")
        metadata = read_metadata(self._session, path)
        if SPEC_KEY not in metadata:
            raise DetectorError(f"{path} is no frustum network of lcf3d: its metadata has no {SPEC_KEY}")
        self.spec = LocalizerSpec.from_json(metadata[SPEC_KEY])

    def __call__(self, proposals: FrustumProposals) -> tuple[FloatArray, FloatArray]:
        """Boxes (K, 7) in the frustum frames, NaN for unknown classes, and believed 3D IoUs (K,)."""
        return localize(proposals, self.spec, self._run)

    def _run(self, points: Any, context: Any) -> tuple[Any, Any, Any]:
        centre, box, quality = self._session.run(OUTPUTS, {"points": points, "context": context})
        return centre, box, quality


def localize(proposals: FrustumProposals, spec: LocalizerSpec, run: Any) -> tuple[FloatArray, FloatArray]:
    """Boxes and qualities of the proposals whose class the network knows; NaN and 0 for the others.

    Args:
        proposals: of a frame.
        spec: the network's configuration.
        run: ``(points, context)`` to centres, box head and quality.
    """
    boxes, quality = np.full((len(proposals), 7), np.nan), np.zeros(len(proposals))
    index = {name: k for k, name in enumerate(spec.class_names)}
    classes = np.array([index.get(proposals.class_names[label], -1) for label in proposals.labels], dtype=np.int64)
    known = np.flatnonzero(classes >= 0)
    if len(known):
        chosen = proposals.select(known) if len(known) < len(proposals) else proposals
        inputs = network_inputs(chosen, classes[known], spec)
        centre, box, sure = run(inputs.points, inputs.context)
        boxes[known] = decode_boxes(inputs.reference + centre, box, spec)
        quality[known] = np.clip(sure, 0, 1)
    return boxes, quality
