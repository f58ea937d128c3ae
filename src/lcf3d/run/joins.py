"""What a run leaves out of its inputs, and what its cameras can report: counted once, said once."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from typing import Any

from lcf3d.datasets.base import CameraSource, LidarSource
from lcf3d.detectors.joins import LeftOut
from lcf3d.fusion.config import FusionConfig

# with fewer frames than this, a class that a result file does not hold may just not have been there
FEW_FRAMES = 100


def left_out_counts(lidar: LidarSource, cameras: Mapping[str, CameraSource]) -> dict[str, Any]:
    """Counts of what fits nothing, by branch (`LeftOut.to_json`); empty where everything is used."""
    return {branch: counts for branch, left_out in _by_branch(lidar, cameras) if (counts := left_out.to_json())}


def left_out_notes(lidar: LidarSource, cameras: Mapping[str, CameraSource]) -> tuple[str, ...]:
    """The same as sentences."""
    return tuple(
        f"{branch} branch: {note}" for branch, left_out in _by_branch(lidar, cameras) for note in left_out.notes()
    )


def report_notes(reports: Mapping[str, Collection[str]], config: FusionConfig) -> tuple[str, ...]:
    """Which classes no detector of which cameras reports."""
    by_missing: dict[tuple[str, ...], list[str]] = {}
    for name, classes in reports.items():
        missing = tuple(c for c in config.class_names if c not in classes)
        if missing:
            by_missing.setdefault(missing, []).append(name)
    return tuple(
        f"the detector of {', '.join(names)} reports no {', '.join(missing)}: boxes of these are not judged by it"
        for missing, names in by_missing.items()
    )


def score_notes(config: FusionConfig) -> tuple[str, ...]:
    """What the scores are where they are no probabilities."""
    if config.ensemble != "product":
        return ()
    return (
        "scores of matched detections are the product s3d s2d / p(class) of the paper: they may exceed 1, order the "
        "detections and are no probabilities (ensemble: evidence or probabilistic stays within 0 to 1)",
    )


def _by_branch(lidar: LidarSource, cameras: Mapping[str, CameraSource]) -> list[tuple[str, LeftOut]]:
    found = [("lidar", lidar), *((f"camera {name}", source) for name, source in cameras.items())]
    seen: set[int] = set()
    parts = []
    for branch, source in found:
        left_out = getattr(source, "left_out", None)
        if isinstance(left_out, LeftOut) and id(source) not in seen:
            seen.add(id(source))
            parts.append((branch if branch == "lidar" else "camera", left_out))
    return parts
