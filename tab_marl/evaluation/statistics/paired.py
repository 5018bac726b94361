"""Differences of two planners over the episodes that both played: intervals, exact tests, and many of them at once."""

from __future__ import annotations

import math
from collections.abc import Hashable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import stats

from tab_marl.evaluation.statistics.intervals import CONFIDENCE, SEED, Floats, Interval, bootstrap_mean

EXACT_PAIRS = 800
"""Up to so many pairs that differ the signed-rank test's law is counted out; beyond, the normal one is as good."""


@dataclass(frozen=True)
class Paired:
    """The mean difference of two planners over the episodes both played, with its interval and a test of no difference."""

    difference: Interval
    p_value: float
    pairs: int
    adjusted: float | None = None
    """The p-value after Holm's correction for the comparisons that are made together; None if it stands alone."""
    comparisons: int = 1
    """How many are made together."""

    @property
    def verdict(self) -> int:
        """-1 or 1 if the interval lies on one side of zero and the (corrected) test agrees (p < .05), else 0.

        Both, because a bootstrap of few pairs is too narrow, and the test alone says nothing of the size.
        """
        if (self.p_value if self.adjusted is None else self.adjusted) >= 1 - CONFIDENCE:
            return 0
        return int(self.difference.low > 0) - int(self.difference.high < 0)


def paired_shares(
    first: ArrayLike, second: ArrayLike, strata: Sequence[object] | None = None, seed: int = SEED
) -> Paired:
    """first - second, of two 0/1 columns over the same episodes: bootstrap over pairs, and McNemar's exact test.

    McNemar (1947), exact form: among the pairs that differ, is either direction as likely? A binomial test at 1/2.
    """
    a, b = _pairs(first, second)
    only_first, only_second = int(np.sum(a > b)), int(np.sum(a < b))
    discordant = only_first + only_second
    if discordant == 0:
        # No pair differs: bound what share of pairs could differ, in either direction.
        bound = float(stats.binomtest(0, len(a)).proportion_ci(CONFIDENCE, method="exact").high)
        return Paired(Interval(0.0, -bound, bound, len(a), exact=True), 1.0, len(a))
    p = float(stats.binomtest(only_first, discordant, 0.5).pvalue)
    return Paired(bootstrap_mean(a - b, strata, seed), p, len(a))


def paired_steps(
    first: ArrayLike, second: ArrayLike, strata: Sequence[object] | None = None, seed: int = SEED
) -> Paired:
    """first - second, of two columns of step counts over the same episodes: bootstrap over pairs, and Wilcoxon's test.

    Ties are ranked with the differences and then dropped (Pratt 1959): with censoring at the horizon many pairs are equal.
    """
    a, b = _pairs(first, second)
    return Paired(bootstrap_mean(a - b, strata, seed), signed_rank_p(a - b), len(a))


def _pairs(first: ArrayLike, second: ArrayLike) -> tuple[Floats, Floats]:
    a, b = np.asarray(first, dtype=np.float64), np.asarray(second, dtype=np.float64)
    if a.shape != b.shape:
        raise ValueError(f"pairs need equal lengths, got {a.shape} and {b.shape}")
    return a, b


def signed_rank_p(differences: ArrayLike) -> float:
    """Two-sided p-value of Wilcoxon's signed-rank test, exact with ties and zeros (Pratt 1959) up to EXACT_PAIRS.

    Under no difference every sign is a fair coin given the sizes; the law of the sum of the positive ranks is counted
    out. SciPy's own exact form knows neither ties nor zeros, and falls back on the normal law.
    """
    d = np.asarray(differences, dtype=np.float64)
    doubled = np.rint(2 * stats.rankdata(np.abs(d))).astype(np.int64)  # midranks are halves: count in halves
    ranks, positive = doubled[d != 0], d[d != 0] > 0
    if not len(ranks):
        return 1.0
    if len(ranks) > EXACT_PAIRS:
        # The same law's mean and variance; the continuity correction is half a step.
        total, spread = ranks.sum() / 2, math.sqrt(float(np.sum(ranks.astype(np.float64) ** 2)) / 4)
        distance = max(abs(float(ranks[positive].sum()) - total) - float(np.gcd.reduce(ranks)) / 2, 0.0)
        return min(1.0, 2 * float(stats.norm.sf(distance / spread)))
    ranks = ranks // np.gcd.reduce(ranks)
    law = sign_sum_law(np.sort(ranks))
    seen, total_rank = int(ranks[positive].sum()), len(law) - 1
    tail = min(seen, total_rank - seen)  # the law is symmetric
    return min(1.0, 2 * float(law[: tail + 1].sum()))


def sign_sum_law(ranks: NDArray[np.int64]) -> Floats:
    """Probabilities ``[sum + 1]`` of the sum of those ranks (ascending) whose fair coin shows heads."""
    law = np.zeros(int(ranks.sum()) + 1)
    law[0], reached = 1.0, 0
    for rank in ranks.tolist():
        before = law[: reached + 1].copy()
        law[rank : rank + reached + 1] += before
        reached += rank
        law[: reached + 1] *= 0.5
    return law


def holm(p_values: Mapping[Hashable, float]) -> dict[Hashable, float]:
    """Holm's (1979) step-down p-values of comparisons that are made together, under the same names.

    The probability that any true null among them falls below .05 is at most .05, however they depend on each other.
    """
    names = sorted(p_values, key=lambda name: p_values[name])
    adjusted, running = {}, 0.0
    for rank, name in enumerate(names):
        running = max(running, min(1.0, (len(names) - rank) * p_values[name]))
        adjusted[name] = running
    return adjusted


def stars(p_value: float) -> str:
    """p as text."""
    return "< .001" if p_value < 0.001 else f"{p_value:.3f}".lstrip("0") if p_value < 0.9995 else "1"
