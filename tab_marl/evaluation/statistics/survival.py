"""Over the course of an episode: who was met, and who had completed the mission first, with right censoring.

An episode ends by interception or at its horizon, which differs from task to task; what has not happened by then is
censored. Completion and interception compete: an adversary that is met cannot complete any more.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import stats

from tab_marl.evaluation.statistics.intervals import CONFIDENCE, Floats

CENSORED = 0
"""The cause of an episode in which nothing happened up to its horizon."""

ROUNDING = 1e-9
"""What a sum of steps may be off by; one episode in a million is a thousand times as much."""


@dataclass(frozen=True)
class Curve:
    """A share of episodes over time, as a step function that is 0 before ``times[0]``."""

    times: Floats
    """``[N]``, ascending."""
    value: Floats
    """``[N]``, from each time on."""
    low: Floats
    high: Floats
    """``[N]``: pointwise 95 % intervals."""
    at_risk: NDArray[np.int64]
    """``[N]``: episodes in which nothing had happened just before each time."""
    variance: Floats

    def at(self, when: ArrayLike) -> tuple[Floats, Floats, Floats]:
        """Value, low and high at the times given (any shape)."""
        index = np.searchsorted(self.times, np.asarray(when, dtype=np.float64), side="right")
        return tuple(np.concatenate([[0.0], part])[index] for part in (self.value, self.low, self.high))  # type: ignore[return-value]


def cumulative_incidence(times: ArrayLike, causes: ArrayLike, cause: int = 1) -> Curve:
    """Aalen and Johansen's (1978) estimate of the share of episodes that have ended by `cause`, others competing.

    `causes` is CENSORED where nothing was seen up to the time. With a single cause this is one minus Kaplan and Meier's
    (1958) survival curve, and its variance Greenwood's. Variance: Marubini and Valsecchi (1995, eq. 10.12), by the delta
    method; intervals: on log(-log F), so that they stay within 0 and 1. Where F is still 0 that method has no interval,
    and the upper bound is the exact one of no event among the episodes whose fate is known by then.
    """
    t, c = np.asarray(times, dtype=np.float64), np.asarray(causes, dtype=np.int64)
    if t.shape != c.shape or t.ndim != 1 or not len(t):
        raise ValueError(f"needs one time and one cause per episode, got shapes {t.shape} and {c.shape}")
    if not np.all(np.isfinite(t)) or np.any(t < 0):
        raise ValueError("times must be finite and >= 0")
    moments, place = np.unique(t, return_inverse=True)
    size = len(moments)
    ended = np.bincount(place, c != CENSORED, size)
    of_cause = np.bincount(place, c == cause, size)
    gone = np.bincount(place, minlength=size)
    at_risk = len(t) - np.concatenate([[0], np.cumsum(gone)[:-1]])
    survival = np.cumprod(1 - ended / at_risk)
    before = np.concatenate([[1.0], survival[:-1]])
    step = before * of_cause / at_risk
    value = np.cumsum(step)
    # With nobody left afterwards the term's factor (F(t) - F_i)^2 is 0 for ever: leave it out instead of dividing by 0.
    left = at_risk - ended
    a = np.divide(ended, at_risk * left, out=np.zeros(size), where=left > 0)
    b = before**2 * of_cause * (at_risk - of_cause) / at_risk.astype(np.float64) ** 3
    d = before * of_cause / at_risk.astype(np.float64) ** 2
    variance = (
        value**2 * np.cumsum(a) - 2 * value * np.cumsum(value * a) + np.cumsum(value**2 * a)
        + np.cumsum(b) - 2 * (value * np.cumsum(d) - np.cumsum(value * d))
    )  # fmt: skip
    variance = np.maximum(variance, 0.0)
    known = len(t) - np.cumsum(np.bincount(place, c == CENSORED, size))
    low, high = log_log_bounds(value, variance, known)
    return Curve(moments, value, low, high, at_risk, variance)


def log_log_bounds(value: Floats, variance: Floats, known: ArrayLike) -> tuple[Floats, Floats]:
    """95 % bounds of shares on the scale log(-log F); exact binomial bounds of `known` episodes where F is 0 or 1."""
    z = float(stats.norm.ppf((1 + CONFIDENCE) / 2))
    count = np.maximum(np.asarray(known, dtype=np.float64), 1.0)
    # A share that is 0 or 1 but for the rounding of its sum has no interval on that scale: log(-log F) runs away.
    nothing, everything = value < ROUNDING, value > 1 - ROUNDING
    inside = ~(nothing | everything)
    f = np.where(inside, value, 0.5)
    spread = np.exp(z * np.sqrt(variance) / (f * np.abs(np.log(f))))
    tail = ((1 - CONFIDENCE) / 2) ** (1 / count)
    low = np.where(inside, f**spread, np.where(everything, tail, 0.0))
    high = np.where(inside, f ** (1 / spread), np.where(nothing, 1 - tail, 1.0))
    return low, high


def mean_curve(curves: Sequence[Curve], grid: ArrayLike) -> Curve:
    """The mean of independent curves on a grid of times, each with equal weight, with the interval of that mean."""
    if not curves:
        raise ValueError("a mean of no curve")
    when = np.asarray(grid, dtype=np.float64)
    value, variance, at_risk = np.zeros(len(when)), np.zeros(len(when)), np.zeros(len(when), dtype=np.int64)
    total = 0
    for curve in curves:
        index = np.searchsorted(curve.times, when, side="right")
        value += np.concatenate([[0.0], curve.value])[index] / len(curves)
        variance += np.concatenate([[0.0], curve.variance])[index] / len(curves) ** 2
        at_risk += np.concatenate([curve.at_risk, [0]])[np.searchsorted(curve.times, when, side="left")]
        total += int(curve.at_risk[0])
    value = np.minimum(value, 1.0)
    low, high = log_log_bounds(value, variance, np.full(len(when), total))
    return Curve(when, value, low, high, at_risk, variance)


def restricted_mean(curve: Curve, until: float) -> tuple[float, float]:
    """Mean time to the event, counted up to `until`, and its standard error: the area under 1 - F (Irwin 1949).

    For a curve with a single cause. Unlike the mean of censored times it does not depend on when episodes were cut off.
    """
    if until <= 0:
        raise ValueError(f"until is {until}, must be > 0")
    inside = curve.times < until
    edges = np.concatenate([[0.0], curve.times[inside], [until]])
    survival = 1 - np.concatenate([[0.0], curve.value[inside]])
    areas = survival * np.diff(edges)
    # Greenwood's terms: var = sum over events of (area to the right)^2 d / (n (n - d)).
    right = np.cumsum(areas[::-1])[::-1][1:]
    fraction = np.diff(np.concatenate([[0.0], curve.value[inside]])) / np.maximum(survival[:-1], 1e-300)
    at_risk = curve.at_risk[inside]
    remaining = 1 - fraction
    terms = np.divide(fraction, at_risk * remaining, out=np.zeros(len(fraction)), where=remaining > 1e-12)
    return float(areas.sum()), float(np.sqrt(np.sum(right**2 * terms)))
