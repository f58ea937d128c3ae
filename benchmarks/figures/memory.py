"""Draws docs/images/memory.svg: a car that drives behind a parked truck, and a false alarm, with the real memory.

python benchmarks/figures/memory.py
"""

from pathlib import Path

import numpy as np

from lcf3d.decisions import Decisions
from lcf3d.frame import Frame
from lcf3d.fusion.memory import remember_sequence
from lcf3d.geometry.boxes import bev_corners
from lcf3d.provenance import FusedDetections
from lcf3d.reasons import Outcome
from lcf3d.structures import KITTI_CLASSES, Camera, Detections2D, Detections3D

FRAMES, HIDDEN, ALARM = 13, (7, 8, 9, 10), (3,)
TRUCK = [9.5, 4.6, 0.0, 6.5, 2.5, 3.2, 0.0]
BLUE, AMBER, RED, GREY = "#2563eb", "#d97706", "#dc2626", "#64748b"


def car_at(t: int) -> list[float]:
    """The car, seen across the street."""
    return [10.0 + 1.15 * t, 9.5, -0.9, 4.2, 1.8, 1.5, 0.0]


def frames() -> list[tuple[Frame, FusedDetections]]:
    """What the fusion of each frame alone gives."""
    axes = np.array([[0.0, -1, 0, 0], [0, 0, -1, 0], [1, 0, 0, 0], [0, 0, 0, 1]])
    camera = Camera("left", [[500, 0, 800, 0], [0, 500, 200, 0], [0, 0, 1, 0]], axes, 1600, 400)
    result = []
    for t in range(FRAMES):
        found = [(TRUCK, 0.97)]
        found += [(car_at(t), 0.75 + 0.1 * np.sin(2.1 * t))] if t not in HIDDEN else []
        found += [([27.0, 1.0, -0.9, 4.0, 1.7, 1.5, 0.4], 0.6)] if t in ALARM else []
        boxes, scores = np.array([box for box, _ in found]), [score for _, score in found]
        detections = Detections3D(boxes, scores, [0] * len(found), KITTI_CLASSES)
        table = Decisions.blank(len(found))
        table.outcome[:] = Outcome.KEPT
        table.lidar[:] = table.output[:] = np.arange(len(found))
        nothing = Detections2D.empty(KITTI_CLASSES)
        fused = FusedDetections(detections, table, Decisions.blank(0), detections, (nothing,), ("left",))
        result.append((Frame(str(t), cameras=(camera,), timestamp=0.1 * t, world_from_lidar=np.eye(4)), fused))
    return result


def polygon(box: np.ndarray, style: str) -> str:
    """A box seen from above; x to the right, y up, 12 pixels a metre."""
    corners = bev_corners(np.array(box, dtype=float)[None])[0]
    points = " ".join(f"{20 + 12 * x:.1f},{190 - 12 * y:.1f}" for x, y in corners)
    return f"<polygon points='{points}' {style}/>"


def text(x: float, y: float, words: str, color: str = "#334155") -> str:
    """A line of words."""
    return f"<text x='{x:.0f}' y='{y:.0f}' fill='{color}' font-size='12'>{words}</text>"


def score_lines(alone: dict[int, float], memory: dict[int, tuple[float, bool]], color: str, x0: float) -> str:
    """Scores over time: rings for the frame alone, dots (hollow squares where predicted) with memory."""

    def at(t: int, score: float) -> tuple[float, float]:
        return x0 + 26 * t, 190 - 150 * score

    path = " ".join(f"{x:.1f},{y:.1f}" for x, y in (at(t, s) for t, (s, _) in sorted(memory.items())))
    parts = [f"<polyline points='{path}' fill='none' stroke='{color}' stroke-width='1.5'/>"]
    for t, score in alone.items():
        x, y = at(t, score)
        parts.append(f"<circle cx='{x:.1f}' cy='{y:.1f}' r='5' fill='none' stroke='{GREY}'/>")
    for t, (score, predicted) in memory.items():
        x, y = at(t, score)
        mark = f"<rect x='{x - 4:.1f}' y='{y - 4:.1f}' width='8' height='8' fill='white' stroke='{AMBER}'/>"
        parts.append(mark if predicted else f"<circle cx='{x:.1f}' cy='{y:.1f}' r='3' fill='{color}'/>")
    return "".join(parts)


def main() -> None:
    """Write the picture."""
    inputs = frames()
    results = list(remember_sequence(inputs))
    shapes = [polygon(np.array(TRUCK), f"fill='#cbd5e1' stroke='{GREY}'")]
    car_alone, car, alarm_alone, alarm = {}, {}, {}, {}
    for t, ((_, fused), result) in enumerate(zip(inputs, results, strict=True)):
        for box, score in zip(fused.detections.boxes, fused.detections.scores, strict=True):
            if box[1] > 8:
                car_alone[t] = score
            elif box[1] < 3:
                alarm_alone[t] = score
        for box, score, predicted in zip(
            result.detections.boxes, result.detections.scores, result.tracks.predicted, strict=True
        ):
            if box[1] > 8:
                car[t] = (score, bool(predicted))
                if t % 2 == 0 or predicted:
                    look = f"stroke='{AMBER}' stroke-dasharray='4 3'" if predicted else f"stroke='{BLUE}'"
                    shapes.append(polygon(box, f"fill='none' stroke-width='1.5' {look}"))
            elif box[1] < 3:
                alarm[t] = (score, bool(predicted))
                shapes.append(polygon(box, f"fill='none' stroke='{RED}' stroke-width='1.5'"))
    x0 = 470
    axes = "".join(
        f"<line x1='{x0 - 10}' x2='{x0 + 26 * 12 + 10}' y1='{190 - 150 * s}' y2='{190 - 150 * s}' stroke='#e2e8f0'/>"
        + text(x0 - 36, 194 - 150 * s, f"{s:.1f}")
        for s in (0.0, 0.5, 1.0)
    )
    ticks = "".join(text(x0 + 26 * t - 6, 210, f"{0.1 * t:.1f}") for t in range(0, FRAMES, 3))
    labels = (
        text(20, 20, "from above: sensor at the left, 1.2 s of a street")
        + text(20 + 12 * 6.6, 190 - 12 * 4.2, "parked truck")
        + text(20 + 12 * 24, 190 - 12 * 2.6, "false alarm, once", RED)
        + text(20 + 12 * 17, 190 - 12 * 11.2, "predicted while hidden", AMBER)
        + text(x0, 20, "score over seconds: rings the frame alone, dots with memory")
        + f"<circle cx='20' cy='190' r='5' fill='{GREY}'/>"
    )
    body = "".join(shapes) + axes + ticks + score_lines(car_alone, car, BLUE, x0)
    body += score_lines(alarm_alone, alarm, RED, x0) + labels
    svg = (
        "<svg xmlns='http://www.w3.org/2000/svg' viewBox='0 0 840 225' font-family='system-ui, sans-serif'>"
        f"<rect width='840' height='225' fill='white'/>{body}</svg>\n"
    )
    target = Path(__file__).parents[2] / "docs" / "images" / "memory.svg"
    target.write_text(svg, encoding="utf-8")


if __name__ == "__main__":
    main()
