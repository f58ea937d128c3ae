"""Simulated data beside real data: the same statistics of two KITTI-layout folders, as numbers and as a figure."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from lcf3d.datasets.kitti import KittiDataset, read_points
from lcf3d.errors import DatasetError, MissingExtraError
from lcf3d.files import list_files
from lcf3d.formats.kitti import KittiObjects, read_folder
from lcf3d.geometry.boxes import lidar_from_kitti, points_in_boxes
from lcf3d.structures import FloatArray

RANGE_EDGES: Final = np.array([0, 3, 4, 5, 6, 8, 10, 12.5, 15, 20, 25, 30, 40, 50, 60, 70, 80.0])
"""Edges of the range histogram in metres."""
DISTANCE_EDGES: Final = np.array([5, 10, 15, 20, 25, 30, 40, 50, 60.0])
"""Edges of the distance classes for points per object, in metres."""
INTENSITY_EDGES: Final = np.linspace(0, 1, 21)
HEIGHT_EDGES: Final = np.array([0, 25, 50, 100, 375.0])
"""Edges of the classes of heights in the image, in pixels."""
DRAWN_CLASSES: Final = ("Car", "Pedestrian", "Cyclist")


@dataclass(frozen=True, eq=False)
class ScanStatistics:
    """Of F scans.

    Attributes:
        counts: (F,) points a scan.
        ranges: (F, len(RANGE_EDGES) - 1) share of the points in each range class.
        intensities: (F, 20) share of the points in each intensity class.
        beams: (F, 64) points in each third of a degree of elevation from -25 to 5 degrees.
        objects: class -> (K, 2) distance and number of points of its clearly visible objects.
    """

    counts: NDArray[np.int64]
    ranges: FloatArray
    intensities: FloatArray
    beams: FloatArray
    objects: dict[str, FloatArray]


@dataclass(frozen=True, eq=False)
class LabelStatistics:
    """Of the labels of F frames.

    Attributes:
        frames: F.
        per_frame: class -> mean number a frame.
        frames_with: class -> share of frames with at least one.
        distances: class -> (K,) metres from the camera.
        sizes: class -> (K, 3) length, width, height.
        occlusion: class -> (4,) share of occlusion levels 0 to 3.
        heights: class -> (K,) pixels from top to bottom of the 2D boxes.
    """

    frames: int
    per_frame: dict[str, float]
    frames_with: dict[str, float]
    distances: dict[str, FloatArray]
    sizes: dict[str, FloatArray]
    occlusion: dict[str, FloatArray]
    heights: dict[str, FloatArray]


def scan_statistics(
    root: Path, ids: Sequence[str] | None = None, classes: Sequence[str] = ("Car", "Pedestrian", "Cyclist")
) -> ScanStatistics:
    """Statistics of the scans of a KITTI-layout folder; objects need labels beside the scans.

    Raises:
        DatasetError: there is no scan.
    """
    dataset = KittiDataset(root)
    found = [
        i for i in (ids if ids is not None else dataset.ids) if (dataset.folder / "velodyne" / f"{i}.bin").exists()
    ]
    if not found:
        raise DatasetError(f"{root} holds no scans")
    counts, ranges, intensities, beams = [], [], [], []
    objects: dict[str, list[FloatArray]] = {name: [] for name in classes}
    for frame_id in found:
        points = read_points(dataset.folder / "velodyne" / f"{frame_id}.bin")
        distance = np.linalg.norm(points[:, :3], axis=1)
        counts.append(len(points))
        ranges.append(np.histogram(distance, RANGE_EDGES)[0] / len(points))
        intensities.append(np.histogram(points[:, 3], INTENSITY_EDGES)[0] / len(points))
        elevation = np.degrees(np.arcsin(points[:, 2] / np.maximum(distance, 1e-6)))
        beams.append(np.histogram(elevation, np.linspace(-25, 5, 65))[0])
        if (dataset.folder / "label_2" / f"{frame_id}.txt").exists():
            _count_points(dataset, frame_id, points, objects)
    gathered = {name: np.array(rows).reshape(-1, 2) for name, rows in objects.items()}
    return ScanStatistics(
        np.array(counts), np.array(ranges), np.array(intensities), np.array(beams, dtype=np.float64), gathered
    )


def _count_points(
    dataset: KittiDataset, frame_id: str, points: NDArray[np.float32], objects: dict[str, list[FloatArray]]
) -> None:
    """Add distance and points of every unoccluded, untruncated object of a frame."""
    labels = read_folder(dataset.folder / "label_2", [frame_id], results=False)[0]
    clear = (labels.occluded == 0) & (labels.truncated < 0.05)
    boxes = lidar_from_kitti(
        labels.locations, labels.dimensions, labels.rotation_y, dataset.calibration(frame_id).camera_from_lidar
    )
    for name, rows in objects.items():
        chosen = boxes[clear & (labels.class_names == name)]
        if len(chosen):
            inside = points_in_boxes(points, chosen).sum(axis=1)
            rows += [np.array([np.hypot(b[0], b[1]), n]) for b, n in zip(chosen, inside, strict=True)]


def label_statistics(root: Path, ids: Sequence[str] | None = None) -> LabelStatistics:
    """Statistics of the label files of a KITTI-layout folder."""
    folder = root / "training" / "label_2"
    chosen = list(ids) if ids is not None else [p.stem for p in list_files(folder, ".txt")]
    frames = read_folder(folder, chosen, results=False)
    every = KittiObjects(
        *(
            np.concatenate([getattr(f, n) for f in frames])
            for n in (
                "class_names",
                "truncated",
                "occluded",
                "alpha",
                "boxes2d",
                "dimensions",
                "locations",
                "rotation_y",
            )
        )
    )
    names = sorted(set(every.class_names.tolist()))
    count = max(1, len(frames))
    with_class = {n: float(np.mean([np.any(f.class_names == n) for f in frames])) for n in names}
    mask = {n: every.class_names == n for n in names}
    solid = [n for n in names if n != "DontCare"]
    return LabelStatistics(
        len(frames),
        {n: float(mask[n].sum()) / count for n in names},
        with_class,
        {n: np.linalg.norm(every.locations[mask[n]][:, [0, 2]], axis=1) for n in solid},
        {n: every.dimensions[mask[n]][:, [2, 1, 0]] for n in solid},
        {n: np.bincount(every.occluded[mask[n]].clip(0, 3), minlength=4) / max(1, mask[n].sum()) for n in solid},
        {n: every.boxes2d[mask[n]][:, 3] - every.boxes2d[mask[n]][:, 1] for n in solid},
    )


def median_points(objects: FloatArray) -> FloatArray:
    """(len(DISTANCE_EDGES) - 1,) median points per object in each distance class, NaN where there are fewer than 2."""
    which = np.digitize(objects[:, 0], DISTANCE_EDGES) - 1
    result = [
        np.median(objects[which == k, 1]) if (which == k).sum() >= 2 else np.nan for k in range(len(DISTANCE_EDGES) - 1)
    ]
    return np.array(result)


def height_shares(labels: LabelStatistics) -> dict[str, FloatArray]:
    """Class -> (len(HEIGHT_EDGES) - 1,) share of its labels in each class of height in the image."""
    return {n: np.histogram(h, HEIGHT_EDGES)[0] / max(1, len(h)) for n, h in labels.heights.items()}


def summary(
    real: ScanStatistics, simulated: ScanStatistics, real_labels: LabelStatistics, simulated_labels: LabelStatistics
) -> dict[str, Any]:
    """The comparison as numbers, for JSON."""

    def scans(s: ScanStatistics) -> dict[str, Any]:
        return {
            "scans": len(s.counts),
            "points_mean": float(s.counts.mean()),
            "points_min": int(s.counts.min()),
            "points_max": int(s.counts.max()),
            "range_edges_m": RANGE_EDGES.tolist(),
            "range_share": s.ranges.mean(axis=0).round(4).tolist(),
            "range_share_spread": s.ranges.std(axis=0).round(4).tolist(),
            "intensity_share": s.intensities.mean(axis=0).round(4).tolist(),
            "median_points": {
                n: [None if np.isnan(v) else float(v) for v in median_points(o)] for n, o in s.objects.items()
            },
        }

    def labels(s: LabelStatistics) -> dict[str, Any]:
        quartiles = {n: np.percentile(d, [10, 50, 90]).round(1).tolist() for n, d in s.distances.items() if len(d)}
        return {
            "frames": s.frames,
            "per_frame": s.per_frame,
            "frames_with": s.frames_with,
            "distance_10_50_90": quartiles,
            "occlusion": {n: o.round(3).tolist() for n, o in s.occlusion.items()},
            "heights_px": {n: shares.round(3).tolist() for n, shares in height_shares(s).items()},
        }

    inside = np.abs(simulated.ranges.mean(axis=0) - real.ranges.mean(axis=0)) <= 2 * real.ranges.std(axis=0)
    return {
        "real": {**scans(real), **labels(real_labels)},
        "simulated": {**scans(simulated), **labels(simulated_labels)},
        "range_classes_within_two_deviations": f"{int(inside.sum())} of {len(inside)}",
    }


REAL_LOOK = ("real KITTI", "#444444")
SIMULATED_LOOK = ("simulated", "#d9622b")
"""Name and colour in the figure."""


def draw(
    real: ScanStatistics,
    simulated: ScanStatistics,
    real_labels: LabelStatistics,
    simulated_labels: LabelStatistics,
    path: Path,
) -> None:
    """Draw the comparison as a PNG with eight panels.

    Raises:
        MissingExtraError: matplotlib is not installed.
    """
    try:
        from matplotlib.figure import Figure
    except ImportError:
        raise MissingExtraError("matplotlib", "simulate", "drawing the comparison") from None
    figure = Figure(figsize=(16.5, 7.5), dpi=90, layout="constrained")
    axes = figure.subplots(2, 4)
    _draw_scans(axes, ((real, *REAL_LOOK), (simulated, *SIMULATED_LOOK)))
    _draw_labels(axes, ((-0.2, real_labels, *REAL_LOOK), (0.2, simulated_labels, *SIMULATED_LOOK)))
    for axis in axes.flat:
        axis.grid(alpha=0.3)
        if axis.get_legend_handles_labels()[0]:
            axis.legend(fontsize=7)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path)


def _draw_scans(axes: Any, both: Sequence[tuple[ScanStatistics, str, str]]) -> None:
    """Points a scan, ranges, intensities and points an object, of scans with their name and colour."""
    bins = np.linspace(60, 140, 21)
    centre = np.arange(len(RANGE_EDGES) - 1)
    middle = (INTENSITY_EDGES[1:] + INTENSITY_EDGES[:-1]) / 2
    dots: dict[str, Any] = {"marker": "o", "ms": 3}
    for s, name, colour in both:
        label = f"{name}, mean {s.counts.mean() / 1000:.1f}"
        axes[0, 0].hist(s.counts / 1000, bins, alpha=0.55, color=colour, label=label, density=True)
        ranges = s.ranges.mean(axis=0), s.ranges.std(axis=0)
        axes[0, 1].errorbar(centre, *ranges, color=colour, capsize=3, label=name, **dots)
        intensities = s.intensities.mean(axis=0), s.intensities.std(axis=0)
        axes[0, 2].errorbar(middle, *intensities, color=colour, capsize=2, **dots)
        for kind, style in zip(DRAWN_CLASSES, ("-", "--", ":"), strict=True):
            distances, medians = (DISTANCE_EDGES[1:] + DISTANCE_EDGES[:-1]) / 2, median_points(s.objects[kind])
            axes[1, 0].plot(distances, medians, style, color=colour, label=f"{kind}, {name}", **dots)
            axes[1, 0].scatter(s.objects[kind][:, 0], s.objects[kind][:, 1], s=3, color=colour, alpha=0.25)
    axes[0, 0].set(title="points per scan (thousands)")
    axes[0, 1].set(title="share of points by range (m)", xticks=centre, yscale="log", ylim=(1e-3, 0.6))
    axes[0, 1].set_xticklabels([f"{a:g}" for a in RANGE_EDGES[:-1]], fontsize=7)
    axes[0, 2].set(title="intensity of returns")
    axes[1, 0].set(title="points per clear object by distance (m)", yscale="log", xlim=(0, 70), ylim=(1, 20000))


def _draw_labels(axes: Any, sides: Sequence[tuple[float, LabelStatistics, str, str]]) -> None:
    """Labels a frame, their distances, occlusion and heights, of labels with the place of their bars, name, colour."""
    names = ("Car", "Van", "Truck", "Pedestrian", "Cyclist", "DontCare")
    none = np.zeros(0)
    for shift, t, name, colour in sides:
        counts = [t.per_frame.get(n, 0) for n in names]
        axes[1, 1].bar(np.arange(len(names)) + shift, counts, 0.4, color=colour, label=name)
        cars, people = t.distances.get("Car", none), [t.distances.get(n, none) for n in ("Pedestrian", "Cyclist")]
        edges = np.arange(0, 85, 5)
        axes[1, 2].hist(cars, edges, density=True, alpha=0.55, color=colour, label=f"Car, {name}")
        label = f"Pedestrian, Cyclist, {name}"
        axes[1, 2].hist(np.concatenate(people), edges, density=True, histtype="step", lw=1.6, color=colour, label=label)
        _draw_shares(axes[0, 3], shift, t.occlusion, name, colour)
        _draw_shares(axes[1, 3], shift, height_shares(t), name, colour)
    axes[1, 1].set(title="labels per frame", xticks=np.arange(len(names)))
    axes[1, 1].set_xticklabels(names, fontsize=8)
    axes[1, 2].set(title="distance of labels (m)")
    axes[0, 3].set(title="labels of occlusion 0, 1, 2, 3 (share)")
    lowest = ", ".join(f"{edge:g}" for edge in HEIGHT_EDGES[:-1])
    axes[1, 3].set(title=f"share of labels over {lowest} px")


def _draw_shares(axis: Any, shift: float, shares: Mapping[str, FloatArray], name: str, colour: str) -> None:
    """Four bars a class, the classes side by side."""
    places = np.array([[5 * k + level for level in range(4)] for k in range(len(DRAWN_CLASSES))])
    heights = [shares.get(n, np.zeros(4)) for n in DRAWN_CLASSES]
    axis.bar(places.ravel() + shift, np.concatenate(heights), 0.4, color=colour, label=name)
    axis.set_xticks(places.mean(axis=1), DRAWN_CLASSES, fontsize=8)


def compare(
    real_root: Path, simulated_root: Path, figure: Path | None = None, real_label_ids: Sequence[str] | None = None
) -> dict[str, Any]:
    """Compare two KITTI-layout folders; writes the figure if asked, returns the numbers."""
    parts = (
        scan_statistics(real_root),
        scan_statistics(simulated_root),
        label_statistics(real_root, real_label_ids),
        label_statistics(simulated_root),
    )
    if figure is not None:
        draw(*parts, figure)
    return summary(*parts)
