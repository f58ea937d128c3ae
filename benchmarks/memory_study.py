"""What does a memory of past frames bring? The tables of docs/memory.md.

    lcf3d run kitti:ROOT --lidar results:ROOT/results/pointrcnn --camera results:ROOT/results/rrc_2d \\
        --recovery off --out alone
    python benchmarks/memory_study.py kitti:ROOT alone

``ROOT`` is a KITTI-layout folder of whole drives (ids ``SEQUENCE_FRAME``, ``poses/SEQUENCE.txt``); ``alone`` is a run
on it in which every frame was judged alone. Prints one block a question (``--only`` for some of them): gains of each
part with 95 % intervals over sequences, constants chosen by leave-one-sequence-out, rates, degraded inputs, both ways.
Numbers are 3D AP R40 and, beside it, the area under the whole curve, which does not jump where the recall passes one
of the 40 points.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from time import process_time
from typing import NamedTuple

import numpy as np

from lcf3d.datasets.kitti import KittiDataset
from lcf3d.datasets.kitti_results import image_boxes
from lcf3d.decisions import Decisions
from lcf3d.evaluation.curves import average_precision, precision_recall, resampled_curves
from lcf3d.evaluation.kitti import DIFFICULTIES, KittiEvaluator, Selection
from lcf3d.formats.kitti import KittiFrames, objects_from_detections, read_folder
from lcf3d.frame import Frame
from lcf3d.fusion.calibration import Calibration
from lcf3d.fusion.config import FusionConfig
from lcf3d.fusion.evidence import to_log_odds, to_probability
from lcf3d.fusion.memory import remember, remember_sequence
from lcf3d.fusion.memory_config import MemoryConfig
from lcf3d.fusion.memory_smooth import smooth_sequence
from lcf3d.fusion.pipeline import LateCascadeFusion
from lcf3d.geometry.iou import bev_iou
from lcf3d.provenance import FusedDetections
from lcf3d.run.folder import RunFolder
from lcf3d.structures import Detections2D, Detections3D, FloatArray, IntArray

CLASSES = ("Car", "Pedestrian", "Cyclist")
RESAMPLES = 300
LEVELS = ("moderate",)


class Drives(NamedTuple):
    """Frames of whole sequences, in order, and what each frame alone gave."""

    frames: list[Frame]
    alone: list[FusedDetections]
    truth: KittiFrames
    fusion: LateCascadeFusion

    def sequences(self) -> list[str]:
        """Names, in order."""
        return list(dict.fromkeys(str(frame.sequence) for frame in self.frames))

    def chosen(self, index: Sequence[int]) -> Drives:
        """Only some of the frames."""
        truth = KittiFrames.from_frames([self.frames[i].id for i in index], [self.truth[i] for i in index])
        return Drives([self.frames[i] for i in index], [self.alone[i] for i in index], truth, self.fusion)


Runner = Callable[[list[tuple[Frame, FusedDetections]]], Sequence[FusedDetections]]


def play(drives: Drives, runner: Runner) -> list[FusedDetections]:
    """All frames with what the memory adds."""
    return [result for sequence in iter_sequences(drives) for result in runner(sequence)]


def iter_sequences(drives: Drives) -> Iterator[list[tuple[Frame, FusedDetections]]]:
    """The frames of each sequence with what each alone gave."""
    for name in drives.sequences():
        yield [(f, d) for f, d in zip(drives.frames, drives.alone, strict=True) if f.sequence == name]


def causal(config: MemoryConfig | None = None) -> Runner:
    """The memory as it runs live."""
    return lambda frames: list(remember_sequence(frames, config))


def evaluator(drives: Drives, results: Sequence[FusedDetections]) -> KittiEvaluator:
    """The official metric on some results."""
    objects = [
        objects_from_detections(found.detections, image_boxes(frame, found), frame.cameras[0].camera_from_lidar)
        for frame, found in zip(drives.frames, results, strict=True)
    ]
    return KittiEvaluator(drives.truth, KittiFrames.from_frames([f.id for f in drives.frames], objects))


def ap(ev: KittiEvaluator, name: str, level: str, weights: IntArray) -> tuple[FloatArray, float]:
    """(B,) AP R40 of each weighting of the frames, and the area under the whole curve of the first."""
    events = ev.events(Selection(name, "3d", level))
    curves, _ = resampled_curves(events, weights)
    recall, precision, _ = precision_recall(events)
    best = np.maximum.accumulate(precision[::-1])[::-1]
    return average_precision(curves), float(np.sum(np.diff(recall, prepend=0) * best) * 100)


def weights_of(drives: Drives, seed: int = 0) -> IntArray:
    """(1 + RESAMPLES, F) every frame once, then whole sequences drawn with replacement."""
    names = drives.sequences()
    index = np.array([names.index(str(frame.sequence)) for frame in drives.frames])
    drawn = np.random.default_rng(seed).integers(0, len(names), (RESAMPLES, len(names)))
    times = np.array([np.bincount(row, minlength=len(names)) for row in drawn])
    return np.concatenate([np.ones((1, len(index)), dtype=np.int64), times[:, index]])


def report(title: str, drives: Drives, variants: dict[str, Sequence[FusedDetections]], levels: Sequence[str]) -> None:
    """Print each variant's gain over the single frames, with the interval over sequences."""
    print(f"\n## {title}\n")
    print("| | " + " | ".join(f"{name} {level}" for name in CLASSES for level in levels) + " |")
    print("|---|" + "---|" * (len(CLASSES) * len(levels)))
    weights = weights_of(drives)
    base_ev = evaluator(drives, drives.alone)
    base = {(n, d): ap(base_ev, n, d, weights) for n in CLASSES for d in levels}
    cells = [f"{base[n, d][0][0]:.2f} ({base[n, d][1]:.2f})" for n in CLASSES for d in levels]
    print("| single frame | " + " | ".join(cells) + " |", flush=True)
    for label, results in variants.items():
        ev, cells = evaluator(drives, results), []
        for key, (alone, area) in base.items():
            value, own_area = ap(ev, *key, weights)
            gain = value - alone
            low, high = np.nanquantile(gain[1:], [0.025, 0.975])
            cells.append(f"{gain[0]:+.2f} [{low:+.1f}, {high:+.1f}] ({own_area - area:+.2f})")
        print(f"| {label} | " + " | ".join(cells) + " |", flush=True)


def without_shapes() -> MemoryConfig:
    """The defaults, boxes left as they are."""
    return MemoryConfig().with_classes(CLASSES, rigid=False, upright=False)


def without_free_camera(drives: Drives) -> Drives:
    """The same without the 2D detections that led to no output."""
    changed = []
    for found in drives.alone:
        kept = np.flatnonzero(found.camera.output >= 0)
        table = type(found.camera)(**{k: v[kept] for k, v in vars(found.camera).items()})
        changed.append(replace(found, camera=table))
    return drives._replace(alone=changed)


def parts(drives: Drives) -> None:
    """Which part brings what."""
    shapes, predictions = without_shapes(), MemoryConfig(predict=False)
    variants = {
        "scores alone": play(drives, causal(shapes.model_copy(update={"predict": False}))),
        "and shapes": play(drives, causal(predictions)),
        "and predicted boxes": play(drives, causal()),
        "of it without the camera's": play(without_free_camera(drives), causal()),
        "both ways": play(drives, smooth_sequence),
    }
    report("Parts", drives, variants, DIFFICULTIES)


def candidates() -> dict[str, MemoryConfig]:
    """Settings that cross-validation chooses from: the defaults and others around them."""
    base = MemoryConfig()
    grid = {}
    for seen in (0.5, 1.0, 2.0):
        for shift in (0.0, 1.0):
            for doubt in (0.0, 1.0):
                classes = {}
                for name in CLASSES:
                    own = base.of(name)
                    update = {
                        "seen_weight": own.seen_weight * seen,
                        "base": own.base + shift,
                        "standing_doubt": own.standing_doubt * doubt,
                    }
                    classes[name] = own.model_copy(update=update)
                grid[f"weight x {seen:g}, base + {shift:g}, doubt x {doubt:g}"] = MemoryConfig(classes=classes)
    return grid


def cross_validated(drives: Drives) -> None:
    """Weights chosen on all sequences but one, and used on that one, for each class apart."""
    played = {label: play(drives, causal(config)) for label, config in candidates().items()}
    evaluators = {label: evaluator(drives, results) for label, results in played.items()}
    names = drives.sequences()
    own = np.array([str(frame.sequence) for frame in drives.frames])
    others = np.array([(own != name).astype(np.int64) for name in names])
    everything = np.ones((1, len(own)), dtype=np.int64)
    base = evaluator(drives, drives.alone)
    print("\n## Leave one sequence out\n\n| | chosen | single frame | gain easy / moderate / hard | area |")
    print("|---|---|---|---|---|")
    for class_name in CLASSES:
        scores = {k: np.nan_to_num(ap(e, class_name, "moderate", others)[0]) for k, e in evaluators.items()}
        labels = list(scores)
        choice = np.argmax(np.array([scores[label] for label in labels]), axis=0)
        chosen = [labels[choice[names.index(name)]] for name in own]
        mixed = evaluator(drives, [played[label][i] for i, label in enumerate(chosen)])
        gains, areas, alone = [], [], []
        for level in DIFFICULTIES:
            before, area = ap(base, class_name, level, everything)
            after, own_area = ap(mixed, class_name, level, everything)
            gains.append(f"{after[0] - before[0]:+.2f}")
            areas.append(f"{own_area - area:+.2f}")
            alone.append(f"{before[0]:.2f}")
        used = ", ".join(f"{labels[c]} ({int((choice == c).sum())})" for c in np.unique(choice))
        print(
            f"| {class_name} | {used} | {' / '.join(alone)} | {' / '.join(gains)} | {' / '.join(areas)} |", flush=True
        )


def rates(drives: Drives) -> None:
    """Fewer frames a second, and no poses."""
    for every, rate in ((2, 5), (5, 2)):
        index = [i for i, frame in enumerate(drives.frames) if int(frame.id.rpartition("_")[2]) % every == 0]
        fewer = drives.chosen(index)
        report(f"{rate} Hz", fewer, {"with memory": play(fewer, causal())}, ("moderate",))
    blind = [Frame(f.id, cameras=f.cameras, timestamp=f.timestamp, sequence=f.sequence) for f in drives.frames]
    unposed = drives._replace(frames=blind)
    report("10 Hz, poses estimated from the objects", unposed, {"with memory": play(unposed, causal())}, ("moderate",))


def degraded(drives: Drives) -> None:
    """Boxes dropped in bursts of five frames, and noise on the scores."""
    compare("30 % of boxes dropped in bursts of five frames", dropped(drives))
    compare("score noise of 1.5 logits", noisy(drives))


def without_sensors(drives: Drives) -> None:
    """A camera that is blind for two seconds of every ten, and a LiDAR that turns half as fast as the camera looks."""
    compare("camera blind for 2 s of every 10 s", fused_anew(drives, lambda n: True, lambda n: n % 100 < 80))
    compare("LiDAR at 5 Hz, camera at 10 Hz", fused_anew(drives, lambda n: n % 2 == 0, lambda n: True))


def compare(title: str, drives: Drives) -> None:
    """Print what the memory brings to some drives, causal and both ways."""
    report(title, drives, {"with memory": play(drives, causal()), "both ways": play(drives, smooth_sequence)}, LEVELS)


def fused_anew(drives: Drives, has_scan: Callable[[int], bool], has_image: Callable[[int], bool]) -> Drives:
    """The drives fused again, each frame (by its number) with or without the detections of either branch."""
    changed = []
    for frame, found in zip(drives.frames, drives.alone, strict=True):
        number = int(frame.id.rpartition("_")[2])
        lidar = found.lidar_inputs if has_scan(number) else Detections3D.empty(found.lidar_inputs.class_names)
        camera = dict(zip(found.camera_names, found.camera_inputs, strict=True)) if has_image(number) else {}
        changed.append(drives.fusion(frame, lidar, camera))
    return drives._replace(alone=changed)


def dropped(drives: Drives, share: float = 0.3, length: int = 5, seed: int = 0) -> Drives:
    """Objects lose their boxes for five frames at a time; boxes on no object go one by one."""
    rng = np.random.default_rng(seed)
    decided: dict[tuple[object, ...], bool] = {}
    changed = []
    for frame, found in zip(drives.frames, drives.alone, strict=True):
        number = int(frame.id.rpartition("_")[2])
        gone = rng.random(len(found)) < share
        if frame.labels is not None and len(frame.labels) and len(found):
            overlap = bev_iou(found.detections.boxes, frame.labels.boxes)
            for i in np.flatnonzero(overlap.max(axis=1) > 0.1):
                box = frame.labels.boxes[overlap[i].argmax()]
                # without track ids an object is told by its size, which labels keep over the whole drive
                key = (frame.sequence, *np.round(box[3:6], 3).tolist(), number // length)
                gone[i] = decided.setdefault(key, bool(rng.random() < share))
        changed.append(without_outputs(found, gone))
    return drives._replace(alone=changed)


def without_outputs(found: FusedDetections, gone: np.ndarray) -> FusedDetections:
    """The same without some outputs; their 2D detections are then free."""
    kept = np.flatnonzero(~gone)
    place = np.full(len(found) + 1, -1)
    place[kept] = np.arange(len(kept))
    tables = [replace(table, output=place[table.output]) for table in (found.lidar, found.camera)]
    return replace(found, detections=found.detections[kept], lidar=tables[0], camera=tables[1])


def noisy(drives: Drives, logits: float = 1.5, seed: int = 0) -> Drives:
    """Gaussian noise on the log-odds of every score."""
    rng = np.random.default_rng(seed)
    changed = []
    for found in drives.alone:
        own = found.detections
        scores = to_probability(to_log_odds(own.scores) + rng.normal(0, logits, len(own)))
        changed.append(replace(found, detections=replace(own, scores=scores)))
    return drives._replace(alone=changed)


def speed(drives: Drives) -> None:
    """Milliseconds a frame with 50 objects, of which a tenth is missed in every frame."""
    rng = np.random.default_rng(0)
    count, times = 50, []
    places = np.column_stack([rng.uniform(8, 70, count), rng.uniform(-25, 25, count), np.full(count, -0.8)])
    objects = np.column_stack([places, np.tile([4.0, 1.8, 1.6, 0.0], (count, 1))])
    camera, pairs, config = drives.frames[0].cameras[0], [], MemoryConfig()
    for t in range(300):
        boxes = objects[rng.random(count) < 0.9] + rng.normal(0, 0.03, 7)
        found = Detections3D(boxes, rng.uniform(0.3, 0.99, len(boxes)), np.zeros(len(boxes), np.int64), CLASSES)
        table = Decisions.blank(len(boxes))
        table.output[:] = np.arange(len(boxes))
        fused = FusedDetections(found, table, Decisions.blank(0), found, (Detections2D.empty(CLASSES),), (camera.name,))
        frame = Frame(str(t), cameras=(camera,), timestamp=0.1 * t, world_from_lidar=np.eye(4))
        pairs.append((frame, fused))
    for _ in range(10):
        memory, before = None, process_time()
        for frame, fused in pairs:
            memory, _ = remember(memory, fused, frame, config)
        times.append((process_time() - before) / len(pairs) * 1e3)
    print(f"\n## Speed\n\n{count} objects: {np.median(times):.2f} ms of the processor a frame (least {min(times):.2f})")


QUESTIONS = {
    "speed": speed,
    "parts": parts,
    "cross-validated": cross_validated,
    "rates": rates,
    "degraded": degraded,
    "without-sensors": without_sensors,
}


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("dataset", help="kitti:ROOT")
    parser.add_argument("run", help="folder of 'lcf3d run' without memory")
    parser.add_argument("--split", help="file of ROOT/ImageSets; all frames if left out")
    parser.add_argument("--only", nargs="*", choices=tuple(QUESTIONS), default=list(QUESTIONS))
    options = parser.parse_args()
    root = options.dataset.partition(":")[2]
    dataset, folder = KittiDataset(root, options.split), RunFolder(options.run)
    truth = read_folder(dataset.folder / "label_2", dataset.ids, results=False)
    fusion = LateCascadeFusion(
        FusionConfig.load(folder.path / "config.yaml"), calibration=Calibration.load(folder.calibration_path)
    )
    drives = Drives([dataset.frame(i) for i in dataset.ids], [folder.read(i) for i in dataset.ids], truth, fusion)
    for question in options.only:
        QUESTIONS[question](drives)


if __name__ == "__main__":
    main()
