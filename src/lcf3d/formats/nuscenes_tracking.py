"""nuScenes tracking files: a detection submission with ``tracking_id``, ``tracking_name`` and ``tracking_score``."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from lcf3d.errors import FormatError
from lcf3d.files import write_text
from lcf3d.formats.nuscenes import MAX_BOXES_PER_SAMPLE, META, TRACKING_CLASSES
from lcf3d.formats.nuscenes_boxes import global_from_detections
from lcf3d.structures import Detections3D, FloatArray, IntArray


def write_tracking(
    path: Path,
    detections: Mapping[str, Detections3D],
    ids: Mapping[str, IntArray],
    scenes: Mapping[str, str],
    global_from_lidar: Mapping[str, FloatArray],
    sample_tokens: Sequence[str],
) -> None:
    """Write tracked boxes as a tracking submission, the highest scores first, at most 500 a sample.

    Boxes of classes that the tracking benchmark does not know are left out.

    Args:
        path: the file, written whole or not at all.
        detections: by sample token, in the canonical LiDAR frame.
        ids: (N,) track of each of them, by sample token; unique within a scene.
        scenes: name of the scene by sample token, which makes ids unique over all.
        global_from_lidar: (4, 4) by sample token.
        sample_tokens: every token to list.

    Raises:
        FormatError: ids and boxes differ in number, or a value is not finite.
    """
    results: dict[str, list[dict[str, Any]]] = {token: [] for token in sample_tokens}
    for token, found in detections.items():
        if len(ids[token]) != len(found):
            raise FormatError(f"sample {token} has {len(found)} boxes but {len(ids[token])} track ids")
        tracked = np.flatnonzero(np.isin(np.array(found.class_names)[found.labels], TRACKING_CLASSES))
        tracked = tracked[np.argsort(-found.scores[tracked], kind="stable")][:MAX_BOXES_PER_SAMPLE]
        chosen = found[tracked].with_classes(TRACKING_CLASSES)
        boxes = global_from_detections({token: found[tracked]}, {token: global_from_lidar[token]}, (token,))
        numbers = np.column_stack([boxes.translations, boxes.sizes, boxes.rotations, boxes.scores])
        if not np.isfinite(numbers).all():
            raise FormatError(f"cannot write {path}: a box of sample {token} holds NaN or infinite values")
        velocities = np.nan_to_num(boxes.velocities)
        for i, track in enumerate(ids[token][tracked]):
            results[token].append(
                {
                    "sample_token": token,
                    "translation": boxes.translations[i].tolist(),
                    "size": boxes.sizes[i].tolist(),
                    "rotation": boxes.rotations[i].tolist(),
                    "velocity": velocities[i].tolist(),
                    "tracking_id": f"{scenes[token]}-{track}",
                    "tracking_name": TRACKING_CLASSES[chosen.labels[i]],
                    "tracking_score": float(boxes.scores[i]),
                }
            )
    write_text(path, json.dumps({"meta": META, "results": results}) + "\n")
