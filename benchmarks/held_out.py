"""What each part of the fusion brings on simulated streets that no network saw: modules, variants, stereo, localizers.

    lcf3d simulate HELDOUT --preset kitti64 --frames 1000 --seed 3101
    python benchmarks/held_out.py HELDOUT --json held_out.json

The shipped networks are run once a frame: the LiDAR's without suppression on the scan as it is and on one in four of
its beams, the camera's on both images. Rows: those of ``lcf3d ablate`` (left camera, ``--localizer``), stereo pairs
beside one camera, and the localizers; 3D AP R40 (KITTI, moderate), mean centre-distance AP, and for the modules the
gain over the LiDAR alone with 95 % bootstrap intervals over frames. A folder that is still being simulated is taken as
far as it has come.

What the networks find is kept in HELDOUT/detections-WEIGHTS, one file a frame, named after the weights: the tables can
be made again, or in a process for each LiDAR (``--lidars``), without running them; ``--detect-only`` makes the files.
"""

from __future__ import annotations

import argparse
import hashlib
import json
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from lcf3d.datasets.drive import every_beam
from lcf3d.datasets.kitti import KittiDataset
from lcf3d.detectors.lidar.kinds import MODELS
from lcf3d.detectors.named import load_detector
from lcf3d.evaluation.ablation import MODULES, Variant, suppressed, variants
from lcf3d.evaluation.domain_shift import evaluate_shift, split_truth
from lcf3d.evaluation.kitti_task import KittiEvaluation
from lcf3d.evaluation.protocol import EvaluationOptions
from lcf3d.files import atomic_path
from lcf3d.frame import Frame
from lcf3d.fusion.config import FusionConfig
from lcf3d.fusion.pipeline import LateCascadeFusion
from lcf3d.fusion.stereo import StereoConfig, StereoLateCascadeFusion
from lcf3d.localizers.combined import CombinedLocalizer
from lcf3d.localizers.geometric import GeometricLocalizer
from lcf3d.localizers.named import ShippedLocalizer
from lcf3d.reasons import Outcome
from lcf3d.structures import KITTI_CLASSES, Detections2D, Detections3D, InstanceMask

LIDARS = {"64 beams": 1, "16 beams": 4}
WITH_INTERVALS = (MODULES, "these settings")
LOCALIZERS: dict[str, Callable[[], Any]] = {
    "geometric": GeometricLocalizer,
    "network": ShippedLocalizer,
    "combined": CombinedLocalizer,
}


def main() -> None:
    """Detect, fuse, measure, print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("root", type=Path, help="folder of 'lcf3d simulate', KITTI layout, both images")
    parser.add_argument("--frames", type=int, default=1000, help="at most so many")
    parser.add_argument("--samples", type=int, default=1000, help="draws of the frames for the intervals")
    parser.add_argument("--localizer", choices=list(LOCALIZERS), default="network", help="of the rows of the ablation")
    parser.add_argument("--lidars", default=",".join(LIDARS), help=f"tables to make, of {', '.join(LIDARS)}")
    parser.add_argument("--detect-only", action="store_true", help="run the networks, make no tables")
    parser.add_argument("--json", type=Path, help="write the figures to this file")
    options = parser.parse_args()
    ids = sorted(path.stem for path in (options.root / "training" / "label_2").glob("*.txt"))[: options.frames]
    dataset = KittiDataset(options.root, class_names=(*KITTI_CLASSES, "Van", "Person_sitting"))
    weights = [MODELS / f"{name}_kitti.onnx" for name in ("camera", "lidar")]
    mark = hashlib.sha256(b"".join(path.read_bytes() for path in weights)).hexdigest()[:8]
    frames, lidar, camera = detect(dataset, ids, options.root / f"detections-{mark}")
    if options.detect_only:
        return
    evaluation = KittiEvaluation(KittiDataset(options.root), ids, EvaluationOptions())
    tables = {}
    for name in options.lidars.split(","):
        step = LIDARS[name]
        thinned = [
            Frame(f.id, every_beam(_points(f), step), f.cameras, {}, f.labels) if step > 1 else f for f in frames
        ]
        tables[name] = rows_of(thinned, lidar[name], camera, evaluation, options)
    counts = {
        name: sum(int((f.labels.labels == k).sum()) for f in frames if f.labels is not None)
        for k, name in enumerate(KITTI_CLASSES)
    }
    print(f"{len(ids)} frames, labelled objects: {counts}")
    for name, rows in tables.items():
        print(f"\n{name} | {' | '.join(KITTI_CLASSES)} | gain {' | '.join(KITTI_CLASSES)} | mAP | matched, recovered")
        for row in rows:
            print(as_line(row))
    if options.json:
        options.json.write_text(json.dumps({"frames": len(ids), "objects": counts, "tables": tables}, indent=1))


def detect(
    dataset: KittiDataset, ids: Sequence[str], kept: Path
) -> tuple[list[Frame], dict[str, list[Detections3D]], list[dict[str, Detections2D]]]:
    """Frames without images, and what the networks find in them: read from ``kept`` where it is there."""
    look = load_detector("shipped:kitti?threads=1", "camera", KITTI_CLASSES)
    scan = load_detector("shipped:kitti?nms=off&threads=1", "lidar", KITTI_CLASSES)
    kept.mkdir(exist_ok=True)
    frames: list[Frame] = []
    lidar: dict[str, list[Detections3D]] = {name: [] for name in LIDARS}
    camera: list[dict[str, Detections2D]] = []
    for frame_id in ids:
        frame, path = dataset.frame(frame_id), kept / f"{frame_id}.npz"
        if not path.is_file():
            seen = {name: look([image])[0] for name, image in frame.images.items()}
            boxes = {
                name: scan(every_beam(_points(frame), step) if step > 1 else _points(frame))
                for name, step in LIDARS.items()
            }
            write_detections(path, seen, boxes)
        seen, boxes = read_detections(path)
        camera.append(seen)
        for name, found in boxes.items():
            lidar[name].append(found)
        frames.append(Frame(frame.id, frame.points, frame.cameras, {}, frame.labels))
    return frames, lidar, camera


def write_detections(path: Path, seen: Mapping[str, Detections2D], boxes: Mapping[str, Detections3D]) -> None:
    """Keep what the networks found in a frame."""
    arrays: dict[str, Any] = {}
    for name, found in (*seen.items(), *boxes.items()):
        arrays |= {f"{name}/{part}": getattr(found, part) for part in ("boxes", "scores", "labels")}
    for name, found in seen.items():
        masks = found.masks or ()
        arrays[f"{name}/places"] = np.array([[m.x, m.y, *m.bitmap.shape] if m else [0] * 4 for m in masks], dtype=int)
        bitmaps = [m.bitmap.ravel() for m in masks if m]
        arrays[f"{name}/bitmaps"] = np.packbits(np.concatenate([np.zeros(0, dtype=bool), *bitmaps]))
    with atomic_path(path) as temporary:
        np.savez_compressed(temporary, allow_pickle=False, **arrays)


def read_detections(path: Path) -> tuple[dict[str, Detections2D], dict[str, Detections3D]]:
    """What `write_detections` kept."""
    with np.load(path, allow_pickle=False) as file:
        arrays = dict(file)
    cameras = [name.partition("/")[0] for name in arrays if name.endswith("/bitmaps")]
    parts = ("boxes", "scores", "labels")
    boxes = {name: Detections3D(*(arrays[f"{name}/{part}"] for part in parts), KITTI_CLASSES) for name in LIDARS}
    seen = {}
    for name in cameras:
        masks: list[InstanceMask | None] = []
        bits, begin = np.unpackbits(arrays[f"{name}/bitmaps"]).astype(bool), 0
        for x, y, height, width in arrays[f"{name}/places"].tolist():
            bitmap = bits[begin : begin + height * width].reshape(height, width)
            masks.append(InstanceMask(x, y, bitmap) if bitmap.size else None)
            begin += height * width
        found = (arrays[f"{name}/{part}"] for part in parts)
        seen[name] = Detections2D(*found, KITTI_CLASSES, tuple(masks) if masks else None)
    return seen, boxes


def rows_of(
    frames: Sequence[Frame],
    lidar: Sequence[Detections3D],
    camera: Sequence[Mapping[str, Detections2D]],
    evaluation: KittiEvaluation,
    options: argparse.Namespace,
) -> list[dict[str, Any]]:
    """All rows with one LiDAR."""
    alone = [suppressed(found) for found in lidar]
    left = [{"left": seen["left"]} for seen in camera]
    masks = any(seen["left"].masks is not None for seen in left)
    config, localizer = FusionConfig.preset("kitti"), LOCALIZERS[options.localizer]()
    chosen: list[tuple[Variant, Any, Any]] = [
        (v, None if v.changes is None else LateCascadeFusion(config.updated(**v.changes), localizer), left)
        for v in variants(config, scans=True, masks=masks)
    ]
    for name, preset in (("as they are", "kitti"), ("paper's settings", "paper")):
        one = LateCascadeFusion(FusionConfig.preset(preset), localizer)
        two = StereoLateCascadeFusion(StereoConfig.preset(preset), localizer)
        chosen += [
            (Variant("cameras", f"{name}, left", {}), one, left),
            (Variant("cameras", f"{name}, stereo", {}), two, camera),
        ]
    chosen += [
        (Variant("localizer", name, {}), LateCascadeFusion(config, make()), left) for name, make in LOCALIZERS.items()
    ]
    rows: list[dict[str, Any]] = []
    made: dict[str, dict[str, Any]] = {}
    for variant, fusion, seen in chosen:
        # what the settings at hand are in one group is a row of many others
        key = "alone" if fusion is None else f"{fusion.config} {type(fusion.localizer).__name__} {seen is left}"
        if key not in made:
            samples = options.samples if variant.group in WITH_INTERVALS else 0
            made[key] = row_of(variant, fusion, seen, frames, lidar, alone, evaluation, samples)
        rows.append({**made[key], "group": variant.group, "name": variant.name})
    return rows


def row_of(
    variant: Variant,
    fusion: Any,
    camera: Sequence[Mapping[str, Detections2D]],
    frames: Sequence[Frame],
    lidar: Sequence[Detections3D],
    alone: Sequence[Detections3D],
    evaluation: KittiEvaluation,
    samples: int,
) -> dict[str, Any]:
    """The figures of one variant."""
    results, outcomes = list(alone), np.zeros(len(Outcome), dtype=np.int64)
    if fusion is not None:
        results = []
        for frame, found, seen in zip(frames, lidar, camera, strict=True):
            fused = fusion(frame, found, seen)
            results.append(fused.detections)
            outcomes += np.bincount(fused.outcomes, minlength=len(Outcome))
    truths = [split_truth(frame.labels) for frame in frames if frame.labels is not None]
    shift = evaluate_shift(truths, results, [frame.camera("left") for frame in frames]).metrics
    gain = evaluation.differences(alone, results, samples) if samples and fusion is not None else {}
    return {
        "group": variant.group,
        "name": variant.name,
        "ap": {name: values[1] for name, values in evaluation.figures(results).items()},
        "gain": {name: [one.value, one.low, one.high] for name, one in gain.items()},
        "centre_ap": dict(zip(shift.class_names, (100 * shift.aps.mean(axis=1)).tolist(), strict=True)),
        "map": 100 * shift.mean_ap,
        "nds_hat": shift.nds_hat,
        "matched": int(outcomes[Outcome.MATCHED]),
        "recovered": int(outcomes[Outcome.RECOVERED]),
    }


def as_line(row: Mapping[str, Any]) -> str:
    """A row of the printed table."""
    ap = " | ".join(f"{row['ap'][name]:.1f}" for name in KITTI_CLASSES)
    gains = " | ".join(
        "{:+.1f} [{:+.1f}, {:+.1f}]".format(*row["gain"][n]) if row["gain"] else "" for n in KITTI_CLASSES
    )
    return f"{row['group']}: {row['name']} | {ap} | {gains} | {row['map']:.1f} | {row['matched']}, {row['recovered']}"


def _points(frame: Frame) -> Any:
    assert frame.points is not None, f"frame {frame.id} has no scan"
    return frame.points


if __name__ == "__main__":
    main()
