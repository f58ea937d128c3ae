from __future__ import annotations

from collections.abc import Iterator, Sequence
from importlib.metadata import EntryPoint, EntryPoints
from typing import Any

import numpy as np
import pytest

from lcf3d import plugins
from lcf3d.detectors.named import load_detector
from lcf3d.errors import ConfigError, DetectorError
from lcf3d.plugins import Spec, build, kinds, parse
from lcf3d.structures import Detections2D

HERE = "tests.test_plugins"
CAMERA, LIDAR = "lcf3d.camera_detectors", "lcf3d.lidar_detectors"


class Blind:
    """A camera detector of a third party that finds nothing."""

    def __init__(self, argument: str, class_names: Sequence[str], strength: float = 1.0) -> None:
        self.argument, self.class_names, self.strength = argument, tuple(class_names), strength

    def __call__(self, images: Sequence[np.ndarray]) -> list[Detections2D]:
        return [Detections2D.empty(self.class_names) for _ in images]


def any_settings(argument: str, **settings: object) -> dict[str, object]:
    return settings


def named(argument: str, class_names: Sequence[str], preset: str | None = None, size: int | str = 1) -> Any:
    return preset, size


def plain() -> str:
    return "plain"


@pytest.fixture
def third_party(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    points = EntryPoints(
        [
            EntryPoint("blind", f"{HERE}:Blind", CAMERA),
            EntryPoint("named", f"{HERE}:named", CAMERA),
            EntryPoint("any", f"{HERE}:any_settings", LIDAR),
            EntryPoint("gone", "no_such_module:Detector", CAMERA),
            EntryPoint("plain", f"{HERE}:plain", "lcf3d.localizers"),
        ]
    )
    monkeypatch.setattr(plugins, "entry_points", lambda **query: points.select(**query))
    plugins._points.cache_clear()
    yield
    plugins._points.cache_clear()


def test_parsing() -> None:
    assert parse("onnx:a/b.onnx") == Spec("onnx", "a/b.onnx", {})
    assert parse("geometric") == Spec("geometric")
    assert parse(r"onnx:C:\net.onnx?layout=yolox&size=640&score_threshold=0.2&fast=true") == Spec(
        "onnx", r"C:\net.onnx", {"layout": "yolox", "size": 640, "score_threshold": 0.2, "fast": True}
    )


@pytest.mark.parametrize("text", ["", ":file", "?a=b"])
def test_strings_that_name_nothing(text: str) -> None:
    with pytest.raises(ConfigError, match="expected kind:argument"):
        parse(text)


@pytest.mark.parametrize("query", ["size", "=3", "size="])
def test_settings_without_a_value(query: str) -> None:
    with pytest.raises(ConfigError, match="must read name=value"):
        parse(f"onnx:file?{query}")


def test_unknown_kind_lists_the_installed_ones(third_party: None) -> None:
    with pytest.raises(ConfigError, match=r"unknown camera detector kind 'yolo'; installed: blind, gone, named"):
        load_detector("yolo:x", "camera", ("Car",))
    with pytest.raises(ConfigError, match="unknown LiDAR detector kind 'blind'"):
        load_detector("blind:x", "lidar", ("Car",))


def test_third_party_kind(third_party: None) -> None:
    detector = load_detector("blind:street?strength=2", "camera", ["Car"], {"tiles": 2, "strength": 0.5})
    assert (detector.argument, detector.class_names, detector.strength) == ("street", ("Car",), 2)
    assert load_detector("blind:street", "camera", ["Car"], {"strength": 0.5}).strength == 0.5
    assert len(detector([np.zeros((4, 4, 3), dtype=np.uint8)])[0]) == 0
    assert load_detector("any:x?a=1", "lidar", ["Car"])["a"] == 1


def test_third_party_that_is_gone(third_party: None) -> None:
    with pytest.raises(DetectorError, match=r"'gone' \(no_such_module:Detector\) cannot be imported: ModuleNotFound"):
        load_detector("gone:x", "camera", ("Car",))


def test_misspelt_setting(third_party: None) -> None:
    with pytest.raises(ConfigError, match="'blind' has no setting 'strenght'; its settings: strength"):
        load_detector("blind:x?strenght=2", "camera", ("Car",))
    with pytest.raises(ConfigError, match="'blind' has no setting 'class_names'; its settings: strength"):
        load_detector("blind:x?class_names=Car", "camera", ("Car",))


def test_settings_of_the_wrong_kind(third_party: None) -> None:
    with pytest.raises(ConfigError, match="setting 'strength' of camera detector kind 'blind' must be a number"):
        load_detector("blind:x?strength=high", "camera", ("Car",))


def test_a_name_that_looks_like_a_number(third_party: None) -> None:
    assert load_detector("named:x?preset=2024&size=640", "camera", ("Car",)) == ("2024", 640)


def test_an_argument_too_few_or_too_many(third_party: None) -> None:
    assert build("lcf3d.localizers", "plain") == "plain"
    with pytest.raises(ConfigError, match="localizer 'plain' takes no argument, got '3'"):
        build("lcf3d.localizers", "plain:3")
    with pytest.raises(ConfigError, match="camera detector 'blind' needs an argument: blind:ARGUMENT"):
        load_detector("blind", "camera", ("Car",))


@pytest.mark.parametrize("group", plugins.GROUPS)
def test_our_own_kinds_are_installed_and_importable(group: str) -> None:
    own = [kind for kind, origin in kinds(group).items() if not origin]
    assert own
    for kind in own:
        assert callable(plugins.load(group, kind))
