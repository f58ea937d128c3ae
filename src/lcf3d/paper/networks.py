"""What stands for the networks that a row of the paper names: published weights, a file, or another detector."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from lcf3d import plugins
from lcf3d.detectors.published import KINDS, find_model
from lcf3d.errors import ConfigError, Lcf3dError
from lcf3d.paper.tables import Row, paper_tables

GROUPS = {"lidar": "lcf3d.lidar_detectors", "camera": "lcf3d.camera_detectors", "localizer": "lcf3d.localizers"}

# LiDAR kinds that know the setting nms; alone, a network is measured after its own suppression
_TORCH = KINDS
_TORCH_CAMERAS = ("fasterrcnn", "ddq", "detectors", "mmdet")
_SUPPRESSES = (*(kind for kind in _TORCH if kind != "bevfusion"), "shipped", "onnx-lidar")


class NeedsError(Lcf3dError):
    """A row cannot be measured here; the message says what would have to be there.

    Attributes:
        parts: each thing that would have to be there.
    """

    def __init__(self, *parts: str) -> None:
        super().__init__("; ".join(parts))
        self.parts = parts


def parse_uses(items: tuple[str, ...]) -> dict[str, str]:
    """``NAME=SPEC`` items: what is to stand for a network of the paper.

    Raises:
        ConfigError: not of that form, or no row of the paper names such a network.
    """
    known = {name for table in paper_tables().values() for row in table.rows for name in row.networks}
    uses: dict[str, str] = {}
    for item in items:
        name, equals, text = item.partition("=")
        if not equals or not text or name not in known:
            raise ConfigError(
                f"--use takes NETWORK=FILE or NETWORK=kind:ARGUMENT with NETWORK one of {', '.join(sorted(known))}, "
                f"got {item!r}"
            )
        uses[name] = text
    return uses


def spec_of(name: str, branch: str, uses: Mapping[str, str]) -> str:
    """The string that a command would name the network with.

    Args:
        name: published name, see `lcf3d.detectors.published`.
        branch: ``lidar``, ``camera`` or ``localizer``.
        uses: what is to stand for it: a file of weights, or ``kind:ARGUMENT``.

    Raises:
        NeedsError: its weights have no public address and nothing stands for it.
        ConfigError: a file is named that is not there.
    """
    model = find_model(name)
    spec = model.use.partition(" ")[2]
    if name not in uses:
        if not model.url:
            raise NeedsError(f"{name} ({model.note}): --use {name}=FILE, or another {branch} as kind:ARGUMENT")
        return spec
    text = uses[name]
    if Path(text).expanduser().is_file():
        kind = spec.partition(":")[0]
        if kind == "mmdet":
            raise ConfigError(f"--use {name}: mmdet wants its configuration too; give mmdet:CONFIG,{text}")
        return f"{kind}:{Path(text).expanduser()}"
    if plugins.parse(text).kind in plugins.kinds(GROUPS[branch]):
        return text
    raise ConfigError(f"--use {name}={text}: there is no such file, and it names no {branch} detector")


def branches(row: Row, uses: Mapping[str, str], device: str = "cpu") -> tuple[str, str, str]:
    """LiDAR, camera and localizer of a row as a run takes them; "" for a camera branch that it has not.

    Args:
        row: names the networks.
        uses: what stands for them, see `spec_of`.
        device: torch device of those that torch runs.

    Raises:
        NeedsError: a network's weights have no public address; all of those are named.
    """
    found: list[str] = []
    absent: list[str] = []
    for branch in ("lidar", "camera", "localizer"):
        name = getattr(row, branch)
        try:
            found.append(spec_of(name, branch, uses) if name else "")
        except NeedsError as error:
            absent += error.parts
    if absent:
        raise NeedsError(*absent)
    lidar, camera, localizer = (with_device(spec, device) for spec in found)
    if not row.camera and plugins.parse(lidar).kind in _SUPPRESSES:
        lidar = with_setting(lidar, "nms=keep")
    return lidar, camera, localizer or "geometric"


def with_setting(spec: str, setting: str) -> str:
    """A string that names a network, with one more setting ``name=value``."""
    return f"{spec}{'&' if '?' in spec else '?'}{setting}"


def with_device(spec: str, device: str) -> str:
    """What a command would name a network with, run on a torch device where torch runs it."""
    by_torch = spec.partition(":")[0] in (*_TORCH, *_TORCH_CAMERAS, "frustum-pointnet")
    return with_setting(spec, f"device={device}") if by_torch and device != "cpu" else spec


def substitutes(row: Row, uses: Mapping[str, str]) -> tuple[str, ...]:
    """What stands for the paper's networks in a row, in words, so that nobody takes one for the other."""
    return tuple(f"{uses[name]} for {name}" for name in row.networks if name in uses)
