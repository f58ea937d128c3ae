"""The converters of `lcf3d.formats.objects` as methods of the detections, imported when they are first used."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from importlib import import_module
from typing import Any

from typing_extensions import Self

_FLAT, _SOLID = "lcf3d.formats.objects", "lcf3d.formats.objects3d"


class Converters2D:
    """What `lcf3d.structures.Detections2D` is made from and turned into."""

    @classmethod
    def from_supervision(cls, detections: Any, class_names: Sequence[str] | None = None) -> Self:
        """See `lcf3d.formats.objects.from_supervision`."""
        found: Self = _call(_FLAT, "from_supervision", detections, class_names)
        return found

    @classmethod
    def from_ultralytics(cls, result: Any, class_names: Sequence[str] | None = None) -> Self:
        """See `lcf3d.formats.objects.from_ultralytics`."""
        found: Self = _call(_FLAT, "from_ultralytics", result, class_names)
        return found

    @classmethod
    def from_torchvision(cls, prediction: Mapping[str, Any], class_names: Sequence[str]) -> Self:
        """See `lcf3d.formats.objects.from_torchvision`."""
        found: Self = _call(_FLAT, "from_torchvision", prediction, class_names)
        return found

    @classmethod
    def from_mmdet(cls, sample: Any, class_names: Sequence[str]) -> Self:
        """See `lcf3d.formats.objects.from_mmdet`."""
        found: Self = _call(_FLAT, "from_mmdet", sample, class_names)
        return found

    def to_supervision(self, image_size: tuple[int, int] | None = None) -> Any:
        """See `lcf3d.formats.objects.to_supervision`."""
        return _call(_FLAT, "to_supervision", self, image_size)

    def to_dataframe(self) -> Any:
        """See `lcf3d.formats.objects.to_dataframe`."""
        return _call(_FLAT, "to_dataframe", self)


class Converters3D:
    """What `lcf3d.structures.Detections3D` is made from and turned into."""

    @classmethod
    def from_mmdet3d(cls, sample: Any, class_names: Sequence[str]) -> Self:
        """See `lcf3d.formats.objects3d.from_mmdet3d`."""
        found: Self = _call(_SOLID, "from_mmdet3d", sample, class_names)
        return found

    @classmethod
    def from_openpcdet(cls, prediction: Mapping[str, Any], class_names: Sequence[str] | None = None) -> Self:
        """See `lcf3d.formats.objects3d.from_openpcdet`."""
        found: Self = _call(_SOLID, "from_openpcdet", prediction, class_names)
        return found

    @classmethod
    def from_nuscenes_boxes(
        cls, boxes: Sequence[Any], class_names: Sequence[str] | None = None, lidar_from_source: Any = None
    ) -> Self:
        """See `lcf3d.formats.objects3d.from_nuscenes_boxes`."""
        found: Self = _call(_SOLID, "from_nuscenes_boxes", boxes, class_names, lidar_from_source)
        return found

    def to_dataframe(self) -> Any:
        """See `lcf3d.formats.objects.to_dataframe`."""
        return _call(_FLAT, "to_dataframe", self)


def _call(module: str, name: str, *arguments: Any) -> Any:
    return getattr(import_module(module), name)(*arguments)
