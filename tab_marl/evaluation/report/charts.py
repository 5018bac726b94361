"""Plots of the report as SVG text. Colours are CSS classes, so that one picture serves light and dark."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from html import escape

import numpy as np
from numpy.typing import NDArray

from tab_marl.evaluation.settings import short
from tab_marl.evaluation.statistics import Interval

WIDTH = 300
LABELS = 110
"""Width kept for the names of planners."""
ROW = 21
FOOT = 34
TOP = 8
RIGHT = 14
MARKS = 4
"""On each line of a plot of curves."""


def css_name(planner: str) -> str:
    """Class of a planner's marks."""
    return "p-" + short(planner).casefold().replace("+", "-")


@dataclass(frozen=True)
class Dot:
    """One row of an interval plot."""

    planner: str
    interval: Interval
    paper: float | None = None
    """The paper's figure, drawn as a hollow diamond."""


def interval_plot(
    dots: Sequence[Dot],
    maximum: float,
    unit: str,
    title: str,
    scale: float = 1.0,
    digits: int = 1,
    minimum: float = 0.0,
) -> str:
    """Dots with 95 % intervals, one row per planner. `scale` turns the interval's numbers into the axis' ones.

    What lies below the axis' `minimum` is written at its start.
    """
    height = TOP + ROW * len(dots) + FOOT
    span = WIDTH - LABELS - RIGHT

    def x(value: float) -> float:
        return LABELS + span * min(max((value - minimum) / (maximum - minimum), 0.0), 1.0)

    parts = [_open(WIDTH, height, title, "chart dots")]
    bottom = TOP + ROW * len(dots)
    for tick in ticks(maximum, minimum):
        parts.append(
            f'<line class="grid" x1="{x(tick):.1f}" x2="{x(tick):.1f}" y1="{TOP}" y2="{bottom}"/>'
            f'<text class="tick" x="{x(tick):.1f}" y="{bottom + 14}" text-anchor="middle">{tick:g}</text>'
        )
    parts.append(f'<text class="axis" x="{LABELS + span / 2:.0f}" y="{height - 4}" text-anchor="middle">{unit}</text>')
    for i, dot in enumerate(dots):
        y = TOP + ROW * (i + 0.5)
        low, value, high = (scale * v for v in (dot.interval.low, dot.interval.value, dot.interval.high))
        note = (
            f"{dot.planner}: {value:.{digits}f} (95 % {low:.{digits}f} to {high:.{digits}f}), n = {dot.interval.count}"
        )
        if dot.paper is not None:
            note += f"; paper {dot.paper:g}"
        parts.append(
            f'<g class="{css_name(dot.planner)}"><title>{escape(note)}</title>'
            f'<rect class="hit" x="0" y="{y - ROW / 2:.1f}" width="{WIDTH}" height="{ROW}"/>'
            f'<text class="name" x="{LABELS - 8}" y="{y + 4:.1f}" text-anchor="end">{escape(short(dot.planner))}</text>'
        )
        parts.append(
            f'<line class="whisker" x1="{x(low):.1f}" x2="{max(x(high), x(low) + 0.5):.1f}" y1="{y:.1f}" y2="{y:.1f}"/>'
            if high >= minimum
            else f'<text class="tick" x="{LABELS + 3}" y="{y + 4:.1f}">◂ {value:.{digits}f}</text>'
        )
        parts.append(mark(dot.planner, x(value), y) if value >= minimum else "")
        if dot.paper is not None:
            px = x(dot.paper)
            parts.append(f'<path class="paper" d="M{px - 4.5:.1f} {y:.1f}l4.5 -4.5 4.5 4.5 -4.5 4.5z"/>')
        parts.append("</g>")
    return "".join(parts) + "</svg>"


def mark(planner: str, x: float, y: float, size: float = 4.5) -> str:
    """Each planner has a shape beside its colour: filled for those that compete, hollow for the reference rows."""
    s = size
    a, b = 0.45 * s, 1.1 * s
    shapes = {
        "S-POMCP": f'<rect class="mark" x="{x - s:.1f}" y="{y - s:.1f}" width="{2 * s}" height="{2 * s}"/>',
        "FP-POMCP": f'<path class="mark" d="M{x - s - 1:.1f} {y + s:.1f}h{2 * s + 2}l{-s - 1} {-2 * s - 1}z"/>',
        "MLE-POMCP": f'<path class="mark" d="M{x - s - 1:.1f} {y - s:.1f}h{2 * s + 2}l{-s - 1} {2 * s + 1}z"/>',
        "TAB-POMCP": f'<circle class="mark" cx="{x:.1f}" cy="{y:.1f}" r="{s + 1}"/>',
        "TAB-POMCP+precedents": f'<path class="mark" d="M{x - a:.1f} {y - b:.1f}h{2 * a:.1f}v{b - a:.1f}h{b - a:.1f}v{2 * a:.1f}'
        f'h{a - b:.1f}v{b - a:.1f}h{-2 * a:.1f}v{a - b:.1f}h{a - b:.1f}v{-2 * a:.1f}h{b - a:.1f}z"/>',
        "oracle": f'<circle class="mark hollow" cx="{x:.1f}" cy="{y:.1f}" r="{s}"/>',
        "population-POMCP": f'<rect class="mark hollow" x="{x - s:.1f}" y="{y - s:.1f}" width="{2 * s}" height="{2 * s}"/>',
    }
    cross = f'<path class="mark cross" d="M{x - s:.1f} {y - s:.1f}l{2 * s} {2 * s}m0 {-2 * s}l{-2 * s} {2 * s}"/>'
    return shapes.get(planner, cross)


def legend_mark(planner: str) -> str:
    """The mark alone, for legends."""
    return (
        f'<svg class="key {css_name(planner)}" viewBox="0 0 16 16" width="16" height="16" aria-hidden="true">'
        f"{mark(planner, 8, 8)}</svg>"
    )


@dataclass(frozen=True)
class Track:
    """One planner's line: values ``[N]`` (shares) over x ``[N]``, with a band where one is drawn."""

    planner: str
    x: NDArray[np.float64]
    value: NDArray[np.float64]
    low: NDArray[np.float64] | None = None
    high: NDArray[np.float64] | None = None


def curve_plot(
    tracks: Sequence[Track],
    title: str,
    x_label: str,
    x_range: tuple[float, float],
    x_ticks: Sequence[float] = (),
    named: bool = True,
    top_share: float = 1.0,
) -> str:
    """Shares over x, one line per planner with its marks, `named` at its end; bands as pale areas."""
    width, height, left, top, foot = 400, 232, 32, 10, 34
    right = LABELS + 16 if named else 12
    w, h = width - left - right, height - top - foot
    start, end = x_range

    def across(x: NDArray[np.float64]) -> NDArray[np.float64]:
        return left + w * np.clip((x - start) / (end - start), 0, 1)

    def down(share: NDArray[np.float64]) -> NDArray[np.float64]:
        return top + h * (1 - np.clip(share / top_share, 0, 1))

    parts = [_open(width, height, title)]
    for share in np.linspace(0, top_share, 5):
        level = float(down(share))
        parts.append(
            f'<line class="grid" x1="{left}" x2="{left + w}" y1="{level:.1f}" y2="{level:.1f}"/>'
            f'<text class="tick" x="{left - 5}" y="{level + 4:.1f}" text-anchor="end">{100 * share:g}</text>'
        )
    for tick in x_ticks or ticks(end):
        place = left + w * (tick - start) / (end - start)
        parts.append(f'<text class="tick" x="{place:.1f}" y="{top + h + 15}" text-anchor="middle">{tick:g}</text>')
    parts.append(f'<text class="axis" x="{left + w / 2:.0f}" y="{height - 4}" text-anchor="middle">{x_label}</text>')
    for track in tracks:
        if track.low is not None and track.high is not None:
            x = across(np.concatenate([track.x, track.x[::-1]]))
            y = down(np.concatenate([track.high, track.low[::-1]]))
            parts.append(f'<g class="{css_name(track.planner)}"><polygon class="band" points="{_points(x, y)}"/></g>')
    ends = spread_labels({t.planner: float(down(t.value)[-1]) for t in tracks}, 14, top + 4, top + h)
    for number, track in enumerate(tracks):
        x, y = across(track.x), down(track.value)
        note = f"{track.planner}: {100 * track.value[-1]:.1f} % at the end"
        if track.low is not None and track.high is not None:
            note += f" (95 % {100 * track.low[-1]:.1f} to {100 * track.high[-1]:.1f})"
        parts.append(
            f'<g class="{css_name(track.planner)}"><title>{escape(note)}</title>'
            f'<polyline class="curve" points="{_points(x, y)}"/>'
        )
        # Marks at places of its own, so that lines that lie on each other can still be told apart, and without colour.
        places = left + w * (np.arange(MARKS) + (number + 0.5) / len(tracks)) / MARKS
        parts += [mark(track.planner, float(p), float(np.interp(p, x, y)), 2.8) for p in places]
        if not named:
            parts.append("</g>")
            continue
        parts.append(
            f'<path class="leader" d="M{left + w} {y[-1]:.1f}L{left + w + 9} {ends[track.planner]:.1f}"/>'
            f'<text class="name" x="{left + w + 12}" y="{ends[track.planner] + 4:.1f}">{escape(short(track.planner))}</text></g>'
        )
    return "".join(parts) + "</svg>"


def _points(x: NDArray[np.float64], y: NDArray[np.float64]) -> str:
    """Points of a line in pixels, without those that lie on a straight level between their neighbours."""
    keep = np.ones(len(x), dtype=bool)
    if len(x) > 2:
        level = (np.abs(np.diff(y)) < 0.05)  # fmt: skip
        keep[1:-1] = ~(level[:-1] & level[1:])
    return " ".join(f"{a:.1f},{b:.1f}" for a, b in zip(x[keep], y[keep], strict=True))


def spread_labels(wanted: Mapping[str, float], gap: float, low: float, high: float) -> dict[str, float]:
    """Heights at least `gap` apart, within [low, high] as far as there is room, in the order and near those wanted."""
    names = sorted(wanted, key=lambda n: wanted[n])
    placed: list[float] = []
    for name in names:
        placed.append(max(wanted[name], low if not placed else placed[-1] + gap))
    for i in range(len(placed) - 1, -1, -1):
        ceiling = high if i == len(placed) - 1 else placed[i + 1] - gap
        placed[i] = min(placed[i], ceiling)
    return dict(zip(names, placed, strict=True))


def ticks(maximum: float, minimum: float = 0.0) -> list[float]:
    """About five round values from the minimum to the maximum."""
    raw = (maximum - minimum) / 4
    magnitude = 10.0 ** np.floor(np.log10(raw))
    step = min((m * magnitude for m in (1, 2, 2.5, 5, 10)), key=lambda s: abs(s - raw))
    first = np.ceil(minimum / step - 1e-6) * step
    return [float(v) + 0.0 for v in np.arange(first, maximum + step * 1e-6, step)]


def _open(width: int, height: int, title: str, name: str = "chart") -> str:
    return f'<svg class="{name}" viewBox="0 0 {width} {height}" role="img" aria-label="{escape(title)}">'
