from __future__ import annotations

from collections.abc import Sequence
from importlib.metadata import EntryPoint, EntryPoints

import numpy as np
import pytest

from lcf3d.detectors import specs
from lcf3d.detectors.specs import DetectorSpec, load_detector, parse_spec
from lcf3d.errors import ConfigError, DetectorError
from lcf3d.structures import Detections2D


class Blind:
    """A camera detector of a third party that finds nothing."""

    def __init__(self, argument: str, class_names: Sequence[str], strength: float = 1.0) -> None:
        self.argument, self.class_names, self.strength = argument, tuple(class_names), strength

    def __call__(self, images: Sequence[np.ndarray]) -> list[Detections2D]:
        return [Detections2D.empty(self.class_names) for _ in images]


def any_settings(argument: str, **settings: object) -> dict[str, object]:
    return settings


@pytest.fixture
def third_party(monkeypatch: pytest.MonkeyPatch) -> None:
    points = EntryPoints(
        [
            EntryPoint("blind", "tests.detectors.test_detector_specs:Blind", specs.ENTRY_POINT_GROUP),
            EntryPoint("any", "tests.detectors.test_detector_specs:any_settings", specs.ENTRY_POINT_GROUP),
            EntryPoint("gone", "no_such_module:Detector", specs.ENTRY_POINT_GROUP),
        ]
    )
    monkeypatch.setattr(specs, "entry_points", lambda **query: points.select(**query))


def test_parsing() -> None:
    assert parse_spec("onnx:a/b.onnx") == DetectorSpec("onnx", "a/b.onnx", {})
    assert parse_spec(r"onnx:C:\net.onnx?layout=yolox&size=640&score_threshold=0.2&fast=true") == DetectorSpec(
        "onnx", r"C:\net.onnx", {"layout": "yolox", "size": 640, "score_threshold": 0.2, "fast": True}
    )


@pytest.mark.parametrize("text", ["", "onnx", "onnx:", ":file", "?a=b"])
def test_strings_that_name_nothing(text: str) -> None:
    with pytest.raises(ConfigError, match="named as kind:argument"):
        parse_spec(text)


@pytest.mark.parametrize("query", ["size", "=3", "size="])
def test_settings_without_a_value(query: str) -> None:
    with pytest.raises(ConfigError, match="must read name=value"):
        parse_spec(f"onnx:file?{query}")


def test_unknown_kind_lists_the_known_ones(third_party: None) -> None:
    with pytest.raises(ConfigError, match=r"unknown camera detector kind 'yolo'; expected one of: .*blind.*onnx"):
        load_detector("yolo:x", "camera", ("Car",))
    with pytest.raises(ConfigError, match="unknown lidar detector kind 'onnx'"):
        load_detector("onnx:x", "lidar", ("Car",))


def test_third_party_kind(third_party: None) -> None:
    detector = load_detector("blind:street?strength=2", "camera", ["Car"], {"tiles": 2, "strength": 0.5})
    assert (detector.argument, detector.class_names, detector.strength) == ("street", ("Car",), 2)
    assert load_detector("blind:street", "camera", ["Car"], {"strength": 0.5}).strength == 0.5
    assert len(detector([np.zeros((4, 4, 3), dtype=np.uint8)])[0]) == 0
    assert load_detector("any:x?a=1", "lidar", ["Car"])["a"] == 1


def test_third_party_that_is_gone(third_party: None) -> None:
    with pytest.raises(DetectorError, match=r"'gone'.*cannot be imported"):
        load_detector("gone:x", "camera", ("Car",))


def test_misspelt_setting(third_party: None) -> None:
    with pytest.raises(ConfigError, match="'blind' has no setting 'strenght'; its settings: strength"):
        load_detector("blind:x?strenght=2", "camera", ("Car",))


def test_builtin_kinds_exist() -> None:
    from importlib import import_module

    for kinds in specs.KINDS.values():
        for target in kinds.values():
            module, _, name = target.partition(":")
            assert callable(getattr(import_module(module), name))


def test_settings_of_the_wrong_kind(third_party: None) -> None:
    with pytest.raises(ConfigError, match="setting 'strength' of detector kind 'blind' must be a number, got 'high'"):
        load_detector("blind:x?strength=high", "camera", ("Car",))


def test_a_name_that_looks_like_a_number(monkeypatch: pytest.MonkeyPatch) -> None:
    def build(argument: str, class_names: Sequence[str], preset: str | None = None, size: int | str = 1) -> object:
        return preset, size

    monkeypatch.setattr(specs, "_callable", lambda kind, sensor: build)
    assert load_detector("mine:x?preset=2024&size=640", "camera", ("Car",)) == ("2024", 640)
