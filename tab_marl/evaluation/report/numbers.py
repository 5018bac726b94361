"""Figures as text, the same in every table: page, Markdown and LaTeX."""

from __future__ import annotations

from dataclasses import dataclass

from tab_marl.evaluation.statistics import Interval, Paired, stars

ALIKE = "†"
"""Marks an exact bound where all episodes ended alike."""


@dataclass(frozen=True)
class Shown:
    """A figure with what belongs to it: "12.3", "[4, 21]†", and a p-value or nothing."""

    value: str
    interval: str
    p: str = ""
    verdict: int = 0
    """1: TAB-POMCP is better; -1: the other; 0: not clear."""


def percent(interval: Interval) -> Shown:
    """A share in percent."""
    mark = ALIKE if interval.exact else ""
    return Shown(f"{100 * interval.value:.1f}", f"[{100 * interval.low:.0f}, {100 * interval.high:.0f}]{mark}")


def steps(interval: Interval) -> Shown:
    """Physics steps."""
    return Shown(f"{interval.value:.0f}", f"[{interval.low:.0f}, {interval.high:.0f}]")


def score(value: float, low: float, high: float) -> Shown:
    """A score between 0 and 1."""
    return Shown(f"{value:.3f}", f"[{low:.3f}, {high:.3f}]")


def difference(paired: Paired | None, scale: float = 1.0) -> Shown | None:
    """A paired difference with its p-value, Holm's where it is one of several."""
    if paired is None:
        return None
    d = paired.difference
    p = paired.p_value if paired.adjusted is None else paired.adjusted
    return Shown(f"{scale * d.value:+.0f}", f"[{scale * d.low:+.0f}, {scale * d.high:+.0f}]", stars(p), paired.verdict)
