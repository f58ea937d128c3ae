"""An exported pillar network run by onnxruntime: no torch needed."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lcf3d.detectors.base import CloudRequest
from lcf3d.detectors.lidar.config import LidarConfig
from lcf3d.detectors.lidar.grounding import ground_of, grounded, levelled
from lcf3d.detectors.lidar.inputs import encoder_inputs, map_detections
from lcf3d.detectors.lidar.suppression import NmsMode, suppression_threshold
from lcf3d.detectors.lidar.upright import checked
from lcf3d.errors import ConfigError, DetectorError
from lcf3d.files import shortened
from lcf3d.networks.onnx import open_session, read_metadata
from lcf3d.structures import Detections3D

CONFIG_KEY = "lcf3d.lidar_config"


class OnnxLidarDetector:
    """A LiDAR detector from a file that `lcf3d.detectors.lidar.export_onnx` wrote.

    Args:
        path: the file.
        nms: ``off`` (the paper's choice), ``low`` or ``keep``.
        score_threshold: boxes need a higher score; the network's own without one.
        threads: threads of onnxruntime; 0 for one a core.
        candidates: best boxes considered before suppression; the configuration's own number without it.

    Raises:
        DetectorError: the file is not such a network.
        ConfigError: ``nms``, ``score_threshold`` or ``candidates`` makes no sense.
    """

    def __init__(
        self,
        path: Path | str,
        nms: NmsMode = "keep",
        score_threshold: float | None = None,
        threads: int = 0,
        candidates: int | None = None,
    ) -> None:
        suppression_threshold(nms, 0.0)
        if score_threshold is not None and not 0 <= score_threshold < 1:
            raise ConfigError(f"score_threshold must be in [0, 1), got {score_threshold}")
        self._session = open_session(Path(path), threads, "a LiDAR network")
        metadata = read_metadata(self._session, path)
        if CONFIG_KEY not in metadata:
            raise DetectorError(f"{path} was not exported by lcf3d: it holds no {CONFIG_KEY}")
        try:
            settings = json.loads(metadata[CONFIG_KEY])
        except (ValueError, RecursionError) as error:
            raise DetectorError(f"{path}: its {CONFIG_KEY} is damaged ({shortened(error)}); export it again") from None
        config = LidarConfig.from_dict(settings)
        self.config = config if candidates is None else config.with_candidates(candidates)
        self.nms = nms
        self.score_threshold = self.config.suppression.score_threshold if score_threshold is None else score_threshold

    @property
    def cloud(self) -> CloudRequest:
        """The cloud that the network was trained on, see `lcf3d.detectors.lidar.sweeps.cloud_of`."""
        return self.config.cloud

    @property
    def class_names(self) -> tuple[str, ...]:
        """The classes that labels index."""
        return self.config.class_names

    def __call__(self, points: NDArray[np.floating], around: NDArray[np.floating] | None = None) -> Detections3D:
        """Detections in (N, 4 or more) points, as of `lcf3d.detectors.lidar.detector.TorchLidarDetector`.

        Args:
            points: the cloud.
            around: the whole scan, to find the ground in, where ``points`` are a part of it.
        """
        ground = ground_of(points if around is None else around, self.config)
        inputs = encoder_inputs(levelled(points, ground, self.config), self.config)
        if inputs is None:
            velocities = np.zeros((0, 2)) if self.config.has_velocity else None
            return Detections3D(np.zeros((0, 7)), np.zeros(0), np.zeros(0, np.int64), self.class_names, velocities)
        found = map_detections(self.maps(inputs), self.config, self.score_threshold, self.nms)
        return checked(grounded(found, ground, self.config), points, self.config, self.score_threshold)

    def inputs(self, points: NDArray[np.floating]) -> dict[str, NDArray[Any]] | None:
        """What the network is given for (N, 4 or more) points, by the names of its inputs; None if it sees none."""
        return encoder_inputs(levelled(points, ground_of(points, self.config), self.config), self.config)

    def maps(self, inputs: dict[str, NDArray[Any]]) -> list[Any]:
        """The head's maps, without batch axis, from the arrays of `encoder_inputs`."""
        names = [output.name for output in self._session.get_outputs()]
        values = [value[0] for value in self._session.run(names, inputs)]
        groups: dict[str, dict[str, Any]] = {}
        for name, value in zip(names, values, strict=True):
            group, _, kind = name.partition(".")
            groups.setdefault(group, {})[kind] = value
        if self.config.anchors is None:
            return list(groups.values())
        return [(maps["cls"], maps["reg"], maps["dir"]) for maps in groups.values()]
