"""Aggregates over missions as Agarwal et al. (2021, NeurIPS) define them and their library rliable computes them.

Scores are lists of arrays, an array of episodes ``[n]`` per mission ("runs" and "tasks" there); rliable's matrix is the
case of equal n. Resampling is theirs too: episodes within each mission, missions never.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import stats

from tab_marl.evaluation.statistics.intervals import (
    CONFIDENCE,
    SEED,
    Floats,
    Interval,
    quantile_interval,
    resampled_places,
)

AGGREGATE_RESAMPLES = 2000
"""As many as rliable draws for profiles."""

Scores = Sequence[NDArray[np.float64]]


def interquartile_mean(scores: Scores) -> float:
    """IQM: the mean of the middle half of all episodes of all missions together."""
    return float(stats.trim_mean(np.concatenate(scores), 0.25))


def mean_of_missions(scores: Scores) -> float:
    """The mean over missions of the mean over episodes."""
    return float(np.mean([s.mean() for s in scores]))


def median_of_missions(scores: Scores) -> float:
    """The median over missions of the mean over episodes."""
    return float(np.median([s.mean() for s in scores]))


def optimality_gap(scores: Scores, gamma: float = 1.0) -> float:
    """How far the episodes fall short of the score `gamma` on average."""
    return gamma - float(np.mean(np.minimum(np.concatenate(scores), gamma)))


def probability_of_improvement(first: Scores, second: Scores) -> float:
    """P(an episode of the first scores higher than one of the second), ties half, averaged over missions."""
    found = []
    for x, y in zip(first, second, strict=True):
        wins = stats.mannwhitneyu(x, y, alternative="greater").statistic if len(x) and len(y) else np.nan
        found.append(0.5 if np.array_equal(x, y) else float(wins) / (len(x) * len(y)))
    return float(np.mean(found))


def resampled(scores: Scores, rng: np.random.Generator, count: int) -> list[Floats]:
    """Stratified bootstrap: per mission ``[count, n]`` episodes drawn with replacement."""
    return [s[resampled_places(len(s), count, rng)] for s in scores]


def aggregate(scores: Scores, function: Callable[[Scores], float] = interquartile_mean, seed: int = SEED) -> Interval:
    """An aggregate with the percentile interval of its stratified bootstrap."""
    _check(scores)
    drawn = resampled(scores, np.random.default_rng(seed), AGGREGATE_RESAMPLES)
    if function is interquartile_mean:  # the one that every report needs, in one sweep
        pooled = np.concatenate(drawn, axis=1)
        cut = int(0.25 * pooled.shape[1])
        pooled.partition((cut, pooled.shape[1] - cut - 1), axis=1)
        values = pooled[:, cut : pooled.shape[1] - cut].mean(axis=1)
    else:
        values = np.array([function([d[k] for d in drawn]) for k in range(AGGREGATE_RESAMPLES)])
    value = function(scores)
    low, high = quantile_interval(values)
    return Interval(value, min(low, value), max(high, value), sum(len(s) for s in scores))


def performance_profile(scores: Scores, thresholds: ArrayLike, seed: int = SEED) -> tuple[Floats, Floats, Floats]:
    """The share of episodes of all missions that score above each threshold ``[K]``: value, low, high ``[K]`` each.

    rliable's score distribution (its eq. 3). The bands are pointwise percentile intervals of the stratified bootstrap.
    """
    _check(scores)
    tau = np.asarray(thresholds, dtype=np.float64)
    total = sum(len(s) for s in scores)

    def above(sorted_scores: Floats) -> Floats:
        return np.asarray(len(sorted_scores) - np.searchsorted(sorted_scores, tau, side="right"), dtype=np.float64)

    value = above(np.sort(np.concatenate(scores))) / total
    rng = np.random.default_rng(seed)
    counts = np.zeros((AGGREGATE_RESAMPLES, len(tau)))
    for s in scores:
        # How many of n resampled episodes fall between consecutive thresholds is multinomial.
        bins = np.diff(np.concatenate([[len(s)], above(np.sort(s)), [0]])) * -1.0
        drawn = rng.multinomial(len(s), bins / len(s), size=AGGREGATE_RESAMPLES)
        counts += len(s) - np.cumsum(drawn, axis=1)[:, :-1]
    low, high = np.quantile(counts / total, [(1 - CONFIDENCE) / 2, (1 + CONFIDENCE) / 2], axis=0)
    return value, np.minimum(low, value), np.maximum(high, value)


def _check(scores: Scores) -> None:
    if not scores or any(len(s) == 0 for s in scores):
        raise ValueError("an aggregate needs at least one episode of every mission")
