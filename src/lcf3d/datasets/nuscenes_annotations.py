"""Ground truth from the nuScenes tables: boxes in the global frame with velocities, and the bicycle racks."""

from __future__ import annotations

import numpy as np

from lcf3d.datasets.nuscenes_tables import BICYCLE_RACK, NuscenesTables
from lcf3d.formats.nuscenes_boxes import GlobalBoxes
from lcf3d.structures import FloatArray, IntArray

MAX_VELOCITY_GAP_S = 1.5
"""Longest time between neighbouring annotations of an object for its velocity to be known (nuScenes devkit)."""


def annotation_velocities(tables: NuscenesTables) -> FloatArray:
    """(A, 2) m/s along global x and y of every annotation, NaN where unknown.

    The central difference over the object's annotations before and after; one-sided at the ends of a track. Unknown
    for a single annotation and where the annotations are more than `MAX_VELOCITY_GAP_S` (twice that for the central
    difference) apart, as in the official evaluation.
    """
    table = tables.annotations
    rows = np.arange(len(table.tokens))
    has_previous, has_following = table.previous >= 0, table.following >= 0
    first = np.where(has_previous, table.previous, rows)
    last = np.where(has_following, table.following, rows)
    seconds = 1e-6 * tables.samples.timestamps_us[table.samples]
    elapsed = seconds[last] - seconds[first]
    limit = np.where(has_previous & has_following, 2 * MAX_VELOCITY_GAP_S, MAX_VELOCITY_GAP_S)
    known = (has_previous | has_following) & (elapsed <= limit) & (elapsed > 0)
    moved = table.translations[last, :2] - table.translations[first, :2]
    velocities = np.full((len(rows), 2), np.nan)
    velocities[known] = moved[known] / elapsed[known, None]
    return velocities


def ground_truth_boxes(tables: NuscenesTables, sample_rows: IntArray) -> GlobalBoxes:
    """Annotations of the ten detection classes in the given samples, global frame, score -1, in table order.

    Args:
        tables: all tables.
        sample_rows: (S,) rows of the samples, which are the boxes' ``samples`` 0 to S - 1.
    """
    table = tables.annotations
    position = _positions(tables, sample_rows)
    labels = tables.detection_labels()
    rows = _detection_rows(tables, sample_rows)
    tokens = tuple(token.decode() for token in tables.samples.tokens[sample_rows].tolist())
    return GlobalBoxes(
        tokens,
        position[table.samples[rows]],
        table.translations[rows],
        table.sizes[rows],
        table.rotations[rows],
        annotation_velocities(tables)[rows],
        labels[rows],
        np.full(len(rows), -1.0),
        table.attributes[rows],
        table.point_counts[rows],
    )


def ground_truth_instances(tables: NuscenesTables, sample_rows: IntArray) -> IntArray:
    """(N,) object of each of the boxes of `ground_truth_boxes`."""
    return tables.annotations.instances[_detection_rows(tables, sample_rows)]


def _detection_rows(tables: NuscenesTables, sample_rows: IntArray) -> IntArray:
    """Annotation rows of the ten detection classes in the given samples."""
    position = _positions(tables, sample_rows)
    rows: IntArray = np.flatnonzero((tables.detection_labels() >= 0) & (position[tables.annotations.samples] >= 0))
    return rows


def bicycle_racks(tables: NuscenesTables, sample_rows: IntArray) -> tuple[IntArray, IntArray]:
    """Annotation rows (R,) of the bicycle racks in the given samples, and (R,) their positions in ``sample_rows``."""
    table = tables.annotations
    if BICYCLE_RACK not in tables.category_names:
        return np.zeros(0, dtype=np.int64), np.zeros(0, dtype=np.int64)
    position = _positions(tables, sample_rows)[table.samples]
    rows = np.flatnonzero((table.categories == tables.category_names.index(BICYCLE_RACK)) & (position >= 0))
    return rows, position[rows]


def _positions(tables: NuscenesTables, sample_rows: IntArray) -> IntArray:
    """(M,) position of each sample in ``sample_rows``, -1 for the others."""
    positions = np.full(len(tables.samples.tokens), -1, dtype=np.int64)
    positions[sample_rows] = np.arange(len(sample_rows))
    return positions
