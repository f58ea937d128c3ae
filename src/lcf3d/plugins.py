"""What a string names: ``kind:argument?name=value&name=value``, for datasets, detectors and localizers alike.

    kitti:KITTI?split=val
    onnx:model.onnx?layout=yolox&size=640&tiles=2
    results:runs/point_gnn/data
    geometric

The kind is the name of an entry point; lcf3d declares its own in the same way as anybody else, in ``pyproject.toml``::

    [project.entry-points."lcf3d.camera_detectors"]
    mine = "my_package.detector:MyDetector"   # then --camera mine:ARGUMENT?name=value

There are four groups: ``lcf3d.datasets``, ``lcf3d.camera_detectors``, ``lcf3d.lidar_detectors`` and
``lcf3d.localizers``. An entry point is a callable: the argument is its first parameter and the settings are its keyword
parameters, so that a misspelt setting is refused with the list of those that exist. It is imported only when its kind
is asked for.
"""

from __future__ import annotations

import inspect
import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cache, partial
from importlib.metadata import EntryPoint, entry_points
from typing import Any

from lcf3d.errors import ConfigError, DetectorError, Lcf3dError
from lcf3d.remote.places import local
from lcf3d.remote.urls import is_url

Setting = int | float | bool | str

GROUPS = {
    "lcf3d.datasets": "dataset",
    "lcf3d.camera_detectors": "camera detector",
    "lcf3d.lidar_detectors": "LiDAR detector",
    "lcf3d.localizers": "localizer",
}
"""Group of entry points -> what its kinds are called in messages."""


# what a string cannot give: parameters of these types are for Python only
_COMPOSED = re.compile(r"\b(Sequence|Mapping|Callable|tuple|list|dict|set|Tables|NuscenesTables|NDArray|FloatArray)\b")


@dataclass(frozen=True)
class Spec:
    """A parsed string.

    Attributes:
        kind: what comes before the first colon, for example ``onnx``.
        argument: what follows it, usually a path; empty where there is none.
        settings: the values after ``?``, as int, float or bool where they read as such, else str.
    """

    kind: str
    argument: str = ""
    settings: Mapping[str, Setting] = field(default_factory=dict)


def parse(text: str) -> Spec:
    """The parts of ``kind:argument?name=value&name=value``; argument and settings may be left out.

    Raises:
        ConfigError: there is no kind, or a setting is not ``name=value``.
    """
    named, _, query = text.partition("?")
    kind, _, argument = named.partition(":")
    if not kind:
        raise ConfigError(f"expected kind:argument, for example yolox:nano or results:DIR, got {text!r}")
    settings: dict[str, Setting] = {}
    for item in filter(None, query.split("&")):
        name, equals, value = item.partition("=")
        if not (name and equals and value):
            raise ConfigError(f"settings of {text!r} must read name=value, got {item!r}")
        settings[name] = _value(value)
    return Spec(kind, argument, settings)


def build(
    group: str, text: str | Spec, defaults: Mapping[str, Setting] | None = None, fixed: Mapping[str, Any] | None = None
) -> Any:
    """What a string names.

    Args:
        group: one of `GROUPS`.
        text: ``kind:argument?name=value``.
        defaults: settings that hold unless ``text`` says otherwise; those that the kind does not know are left out.
        fixed: further keyword arguments that are passed as they are; those that the kind does not know are left out.

    Returns:
        What the kind's callable returns.

    Raises:
        ConfigError: unknown kind or setting, or an argument too many or too few.
        Lcf3dError: what the callable raises.
    """
    spec = parse(text) if isinstance(text, str) else text
    call = load(group, spec.kind)
    known = settings_of(call)
    given = {name: value for name, value in (defaults or {}).items() if known is None or name in known}
    given.update(spec.settings)
    unknown = sorted(set(given) - known) if known is not None else []
    passed = fixed or {}
    if unknown or any(name in passed for name in spec.settings):
        name = (unknown or [name for name in spec.settings if name in passed])[0]
        have = ", ".join(sorted(set(known or ()) - set(passed))) or "none"
        raise ConfigError(f"{GROUPS[group]} kind {spec.kind!r} has no setting {name!r}; its settings: {have}")
    given = {name: _fitted(group, spec.kind, name, value, call) for name, value in given.items()}
    taken = inspect.signature(call).parameters
    given.update({name: value for name, value in passed.items() if known is None or name in taken})
    return call(*_arguments(group, spec, call), **given)


def load(group: str, kind: str) -> Any:
    """The callable of a kind, imported now.

    Raises:
        ConfigError: there is no such kind; lists those installed and where they come from.
        DetectorError: it cannot be imported; says why.
    """
    points = _points(group)
    if kind not in points:
        listed = ", ".join(f"{name}{origin and f' (from {origin})'}" for name, origin in kinds(group).items())
        raise ConfigError(f"unknown {GROUPS[group]} kind {kind!r}; installed: {listed or 'none'}")
    point = points[kind]
    try:
        return point.load()
    except Lcf3dError:
        raise
    except Exception as error:
        # a third party's module may fail in any way while it is imported
        origin = _origin(point)
        raise DetectorError(
            f"{GROUPS[group]} kind {kind!r} ({point.value}{origin and f', installed by {origin}'}) cannot be imported: "
            f"{type(error).__name__}: {error}"
        ) from error


def kinds(group: str) -> dict[str, str]:
    """Kinds of a group, sorted, with the package that brought each; an empty string for lcf3d's own."""
    return {name: _origin(point) for name, point in sorted(_points(group).items())}


def settings_of(call: Any) -> set[str] | None:
    """Names of the keyword settings of a kind's callable that a string can give, None if it takes any."""
    parameters = list(inspect.signature(call).parameters.values())
    if any(p.kind is p.VAR_KEYWORD for p in parameters):
        return None
    # what a partial has bound is part of the kind, not a setting
    bound = call.keywords if isinstance(call, partial) else {}
    first = {p.name for p in parameters[:1] if _is_argument(p)}
    plain = {p.name for p in parameters if p.kind is not p.VAR_POSITIONAL and _has_plain_form(str(p.annotation))}
    return plain - first - set(bound)


def _has_plain_form(annotation: str) -> bool:
    """Whether a parameter takes anything that a string can give: ``str | Sequence[str] | None`` does."""
    forms = [form.strip() for form in annotation.split("|")]
    return any(form != "None" and not _COMPOSED.search(form) for form in forms)


def _is_argument(parameter: inspect.Parameter) -> bool:
    """Whether the first parameter of a callable is what follows the colon: it has no default."""
    positional = parameter.kind in (parameter.POSITIONAL_ONLY, parameter.POSITIONAL_OR_KEYWORD)
    return positional and parameter.default is parameter.empty


def _arguments(group: str, spec: Spec, call: Any) -> tuple[str, ...]:
    parameters = list(inspect.signature(call).parameters.values())
    wanted = bool(parameters) and _is_argument(parameters[0])
    if wanted and not spec.argument:
        raise ConfigError(f"{GROUPS[group]} {spec.kind!r} needs an argument: {spec.kind}:{parameters[0].name.upper()}")
    if not wanted and spec.argument:
        raise ConfigError(f"{GROUPS[group]} {spec.kind!r} takes no argument, got {spec.argument!r}")
    if not wanted:
        return ()
    # an address or archive is read like a folder where the kind cannot mean anything else by it
    own = (group == "lcf3d.datasets" or spec.kind == "results") and not _origin(_points(group)[spec.kind])
    elsewhere = is_url(spec.argument) and not spec.argument.startswith("http")
    return (str(local(spec.argument)) if own or elsewhere else spec.argument,)


@cache
def _points(group: str) -> dict[str, EntryPoint]:
    return {point.name: point for point in entry_points(group=group)}


def _origin(point: EntryPoint) -> str:
    name = point.dist.name if point.dist is not None else ""
    return "" if name == "lcf3d" else name


def _fitted(group: str, kind: str, name: str, value: Setting, call: Any) -> Setting:
    """``value`` as the type of the parameter ``name``, where that is plain.

    Raises:
        ConfigError: a word where a number is wanted.
    """
    parameter = inspect.signature(call).parameters.get(name)
    wanted = set(re.findall(r"\w+", str(parameter.annotation))) if parameter is not None else set()
    if isinstance(value, str) and wanted and wanted <= {"int", "float", "bool", "None"}:
        raise ConfigError(f"setting {name!r} of {GROUPS[group]} kind {kind!r} must be a number, got {value!r}")
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
