"""Plots as SVG text, small enough to write by hand, so that a report is one file that needs nothing else."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from html import escape

import numpy as np

from lcf3d.structures import FloatArray

PALETTE = ("#2563eb", "#d97706", "#059669", "#9333ea", "#dc2626", "#0891b2", "#65a30d", "#db2777", "#475569", "#a16207")

_LEFT, _RIGHT, _TOP, _BOTTOM = 46, 14, 12, 40
_LEGEND_ROW = 18
_FONT = "font-family='system-ui, sans-serif' font-size='11'"


@dataclass(frozen=True)
class Line:
    """One line of a chart.

    Attributes:
        label: shown in the legend.
        x: (K,) positions.
        y: (K,) values.
        color: CSS colour.
        dashed: drawn with dashes.
    """

    label: str
    x: Sequence[float] | FloatArray
    y: Sequence[float] | FloatArray
    color: str
    dashed: bool = False


def line_chart(
    lines: Sequence[Line],
    x_label: str,
    y_label: str,
    x_range: tuple[float, float],
    y_range: tuple[float, float],
    width: int = 400,
    height: int = 280,
    markers: bool = False,
) -> str:
    """A chart of lines over common axes, with a legend below, as one ``<svg>`` element."""
    rows = math.ceil(len(lines) / 2)
    total = height + rows * _LEGEND_ROW
    plot_width, plot_height = width - _LEFT - _RIGHT, height - _TOP - _BOTTOM

    def px(value: float) -> float:
        return _LEFT + (value - x_range[0]) / (x_range[1] - x_range[0]) * plot_width

    def py(value: float) -> float:
        return _TOP + plot_height - (value - y_range[0]) / (y_range[1] - y_range[0]) * plot_height

    parts = [f"<svg viewBox='0 0 {width} {total}' width='{width}' height='{total}' role='img' {_FONT}>"]
    for tick in _ticks(*y_range):
        parts.append(
            f"<line x1='{_LEFT}' x2='{width - _RIGHT}' y1='{py(tick):.1f}' y2='{py(tick):.1f}' stroke='#e2e8f0'/>"
        )
        parts.append(
            f"<text x='{_LEFT - 6}' y='{py(tick) + 4:.1f}' text-anchor='end' fill='#475569'>{_tick_text(tick)}</text>"
        )
    for tick in _ticks(*x_range):
        parts.append(
            f"<line x1='{px(tick):.1f}' x2='{px(tick):.1f}' y1='{_TOP}' y2='{_TOP + plot_height}' stroke='#e2e8f0'/>"
        )
        parts.append(
            f"<text x='{px(tick):.1f}' y='{_TOP + plot_height + 15}' text-anchor='middle' fill='#475569'>"
            f"{_tick_text(tick)}</text>"
        )
    centre, middle = _LEFT + plot_width / 2, _TOP + plot_height / 2
    parts.append(f"<text x='{centre}' y='{height - 8}' text-anchor='middle' fill='#0f172a'>{escape(x_label)}</text>")
    parts.append(
        f"<text x='12' y='{middle}' text-anchor='middle' fill='#0f172a' transform='rotate(-90 12 {middle})'>"
        f"{escape(y_label)}</text>"
    )
    for index, line in enumerate(lines):
        points = [(px(float(x)), py(float(y))) for x, y in zip(line.x, line.y, strict=True)]
        path = " ".join(f"{x:.1f},{y:.1f}" for x, y in _thinned(points))
        dash = " stroke-dasharray='5 3'" if line.dashed else ""
        parts.append(
            f"<polyline points='{path}' fill='none' stroke='{line.color}' stroke-width='1.8' "
            f"stroke-linejoin='round'{dash}/>"
        )
        if markers:
            parts += [f"<circle cx='{x:.1f}' cy='{y:.1f}' r='2.6' fill='{line.color}'/>" for x, y in points]
        x0, y0 = _LEFT + (index % 2) * plot_width / 2, height + (index // 2) * _LEGEND_ROW + 8
        parts.append(
            f"<line x1='{x0}' x2='{x0 + 20}' y1='{y0}' y2='{y0}' stroke='{line.color}' stroke-width='2'{dash}/>"
            f"<text x='{x0 + 26}' y='{y0 + 4}' fill='#0f172a'>{escape(line.label)}</text>"
        )
    parts.append("</svg>")
    return "".join(parts)


def _ticks(low: float, high: float) -> FloatArray:
    """About five round numbers from ``low`` to ``high``."""
    rough = (high - low) / 5
    power = 10 ** math.floor(math.log10(rough))
    step = next(step * power for step in (1, 2, 2.5, 5, 10) if step * power >= rough * 0.999)
    first = math.ceil(low / step - 1e-9)
    return np.asarray(np.arange(first, math.floor(high / step + 1e-9) + 1) * step)


def _tick_text(value: float) -> str:
    return f"{value:.10g}" if abs(value) > 1e-12 else "0"


def _thinned(points: list[tuple[float, float]]) -> list[tuple[float, float]]:
    """Without the points that lie within a third of a pixel of the last one kept; first and last stay."""
    kept = points[:1]
    for point in points[1:-1]:
        if math.hypot(point[0] - kept[-1][0], point[1] - kept[-1][1]) > 0.33:
            kept.append(point)
    return kept + points[-1:] if len(points) > 1 else kept
