"""Detectors named by one string: ``kind:argument`` with optional ``?name=value&name=value`` settings.

    onnx:yolox_nano.onnx
    onnx:model.onnx?layout=yolox&size=640&tiles=2
    results:runs/point_gnn/data

The kind names a callable; the argument is its first parameter and the settings are its keyword parameters, so that
a misspelt setting is refused with the list of those that exist. A callable is imported only when its kind is asked for.

A third party adds a kind with an entry point of the group ``lcf3d.detectors``::

    [project.entry-points."lcf3d.detectors"]
    mine = "my_package.detector:MyDetector"   # then --camera mine:ARGUMENT

A camera detector's callable is called as ``callable(argument, class_names=..., **settings)`` and returns a
`lcf3d.detectors.base.CameraDetector`; a LiDAR detector's likewise.
"""

from __future__ import annotations

import inspect
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from importlib import import_module
from importlib.metadata import entry_points
from typing import Any, Literal

from lcf3d.errors import ConfigError, DetectorError

Sensor = Literal["camera", "lidar"]
Setting = int | float | bool | str

ENTRY_POINT_GROUP = "lcf3d.detectors"
# kind -> "module:callable", imported when the kind is first used
KINDS: dict[Sensor, dict[str, str]] = {
    "camera": {
        "shipped": "lcf3d.detectors.camera.small:shipped",
        "onnx": "lcf3d.detectors.camera.onnx:OnnxDetector",
        "results": "lcf3d.detectors.results:CameraResults",
        "fasterrcnn": "lcf3d.detectors.camera.torchvision_fasterrcnn:TorchvisionFasterRCNN",
        "torchvision": "lcf3d.detectors.camera.torchvision_models:TorchvisionDetector",
        "mmdet": "lcf3d.detectors.camera.mmdet:MmdetDetector",
    },
    "lidar": {
        "shipped": "lcf3d.detectors.lidar.kinds:shipped",
        "results": "lcf3d.detectors.results:LidarResults",
        "onnx-lidar": "lcf3d.detectors.lidar.kinds:onnx_lidar",
        "pointpillars": "lcf3d.detectors.lidar.kinds:pointpillars",
        "second": "lcf3d.detectors.lidar.kinds:second",
        "ssn": "lcf3d.detectors.lidar.kinds:ssn",
        "centerpoint": "lcf3d.detectors.lidar.kinds:centerpoint",
        "part-a2": "lcf3d.detectors.lidar.kinds:part_a2",
        "pv-rcnn": "lcf3d.detectors.lidar.kinds:pv_rcnn",
    },
}


@dataclass(frozen=True)
class DetectorSpec:
    """A parsed detector string.

    Attributes:
        kind: what comes before the first colon, for example ``onnx``.
        argument: what follows it, usually a path.
        settings: the values after ``?``, as int, float or bool where they read as such, else str.
    """

    kind: str
    argument: str
    settings: Mapping[str, Setting] = field(default_factory=dict)


def parse_spec(text: str) -> DetectorSpec:
    """The parts of ``kind:argument?name=value&name=value``.

    Raises:
        ConfigError: there is no kind or no argument, or a setting is not ``name=value``.
    """
    kind, colon, rest = text.partition(":")
    argument, _, query = rest.partition("?")
    if not (kind and colon and argument):
        raise ConfigError(f"a detector is named as kind:argument, for example onnx:FILE or results:DIR, got {text!r}")
    settings: dict[str, Setting] = {}
    for item in filter(None, query.split("&")):
        name, equals, value = item.partition("=")
        if not (name and equals and value):
            raise ConfigError(f"settings of detector {text!r} must read name=value, got {item!r}")
        settings[name] = _value(value)
    return DetectorSpec(kind, argument, settings)


def load_detector(
    text: str,
    sensor: Sensor,
    class_names: Sequence[str],
    defaults: Mapping[str, Setting] | None = None,
) -> Any:
    """The detector that a string names.

    Args:
        text: ``kind:argument?name=value``, see the module's text.
        sensor: which branch it serves; some kinds serve only one.
        class_names: classes the detections shall have.
        defaults: settings that hold unless ``text`` says otherwise; those the kind does not know are left out.

    Returns:
        A `CameraDetector` or `LidarDetector` (what the kind's callable returns).

    Raises:
        ConfigError: unknown kind or setting.
        DetectorError: the detector cannot be loaded.
    """
    spec = parse_spec(text)
    build = _callable(spec.kind, sensor)
    known = _settings(build)
    settings = {k: v for k, v in (defaults or {}).items() if known is None or k in known}
    settings.update(spec.settings)
    if known is not None:
        unknown = sorted(set(settings) - known)
        if unknown:
            have = ", ".join(sorted(known)) or "none"
            raise ConfigError(f"detector kind {spec.kind!r} has no setting {unknown[0]!r}; its settings: {have}")
    settings = {name: _fitted(spec.kind, name, value, build) for name, value in settings.items()}
    return build(spec.argument, class_names=tuple(class_names), **settings)


def kinds(sensor: Sensor) -> list[str]:
    """Names of the kinds that can be used for ``sensor``, those of installed third parties included."""
    return sorted({*KINDS[sensor], *(point.name for point in entry_points(group=ENTRY_POINT_GROUP))})


def _callable(kind: str, sensor: Sensor) -> Any:
    if kind in KINDS[sensor]:
        module, _, name = KINDS[sensor][kind].partition(":")
        return getattr(import_module(module), name)
    for point in entry_points(group=ENTRY_POINT_GROUP, name=kind):
        try:
            return point.load()
        except (ImportError, AttributeError) as error:
            raise DetectorError(f"detector kind {kind!r} ({point.value}) cannot be imported: {error}") from error
    raise ConfigError(f"unknown {sensor} detector kind {kind!r}; expected one of: {', '.join(kinds(sensor))}")


def _settings(build: Any) -> set[str] | None:
    """Names of the keyword settings of a detector's callable, None if it takes any."""
    parameters = list(inspect.signature(build).parameters.values())[1:]
    if any(p.kind is p.VAR_KEYWORD for p in parameters):
        return None
    # what a partial has bound is part of the kind, not a setting
    bound = build.keywords if isinstance(build, partial) else {}
    return {p.name for p in parameters if p.kind is not p.VAR_POSITIONAL} - {"class_names", *bound}


def _fitted(kind: str, name: str, value: Setting, build: Any) -> Setting:
    """``value`` as the type of the parameter ``name``, where that is plain.

    Raises:
        ConfigError: a word where a number is wanted.
    """
    parameter = inspect.signature(build).parameters.get(name)
    wanted = set(re.findall(r"\w+", str(parameter.annotation))) if parameter is not None else set()
    if isinstance(value, str) and wanted and wanted <= {"int", "float", "bool", "None"}:
        raise ConfigError(f"setting {name!r} of detector kind {kind!r} must be a number, got {value!r}")
    # a name or path that looks like a number
    return str(value) if "str" in wanted and not wanted & {"int", "float", "bool"} else value


def _value(text: str) -> Setting:
    """``text`` as int, float or bool where it reads as one."""
    for convert in (int, float):
        try:
            return convert(text)
        except ValueError:
            continue
    return {"true": True, "false": False}.get(text.lower(), text)
