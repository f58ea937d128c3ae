"""Detectors by name: what ``--lidar`` and ``--camera`` take."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Literal

from lcf3d import plugins

Sensor = Literal["camera", "lidar"]


def load_detector(
    text: str,
    sensor: Sensor,
    class_names: Sequence[str],
    defaults: Mapping[str, plugins.Setting] | None = None,
    dataset: Any = None,
) -> Any:
    """The detector that a string names.

    Args:
        text: ``kind:argument?name=value``, see `lcf3d.plugins`; for example ``onnx:FILE`` or ``shipped:kitti``.
        sensor: which branch it serves; some kinds serve only one.
        class_names: classes the detections shall have.
        defaults: settings that hold unless ``text`` says otherwise; those the kind does not know are left out.
        dataset: whose frames they are for; ``results:PATH`` asks it how to read its result files.

    Returns:
        A `CameraDetector` or `LidarDetector` (what the kind's callable returns).

    Raises:
        ConfigError: unknown kind or setting.
        DetectorError: the detector cannot be loaded.
    """
    fixed: dict[str, Any] = {"class_names": tuple(class_names)}
    if dataset is not None:
        fixed["dataset"] = dataset
    return plugins.build(f"lcf3d.{sensor}_detectors", text, defaults, fixed)
