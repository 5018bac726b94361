"""Intervals of means and shares. Every bootstrap is seeded: the same rows give the same figures."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import stats

CONFIDENCE = 0.95
RESAMPLES = 4000
SEED = 20250101
"""Of every bootstrap that is given no other."""

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Interval:
    """An estimate with its 95 % interval."""

    value: float
    low: float
    high: float
    count: int
    exact: bool = False
    """The sample had no spread, where a bootstrap would claim certainty: an exact binomial bound is given instead."""

    def __post_init__(self) -> None:
        if self.count < 1:
            raise ValueError("an interval needs at least one observation")


def bootstrap_mean(values: ArrayLike, strata: Sequence[object] | None = None, seed: int = SEED) -> Interval:
    """Percentile bootstrap of the mean; with strata, of the mean of the strata's means, resampled within each.

    Percentile rather than BCa: at 150 episodes they agree to within a fifth of the interval's width, and the
    percentile interval exists for every sample.
    """
    data = np.asarray(values, dtype=np.float64)
    groups = split(data, strata)
    if not groups:
        raise ValueError("a bootstrap needs at least one value")
    rng = np.random.default_rng(seed)
    total = np.zeros(RESAMPLES)
    for group in groups:
        total += _resampled_means(group, rng)
    low, high = quantile_interval(total / len(groups))
    value = float(np.mean([group.mean() for group in groups]))
    return Interval(value, min(low, value), max(high, value), len(data))


def _resampled_means(group: Floats, rng: np.random.Generator) -> Floats:
    """Means ``[RESAMPLES]`` of resamples. Few distinct values (0 and 1, say) are drawn as counts: the same law, faster."""
    values, counts = np.unique(group, return_counts=True)
    if len(values) <= 4:
        times = rng.multinomial(len(group), counts / len(group), size=RESAMPLES)
        return np.asarray(times @ values / len(group))
    return np.asarray(group[resampled_places(len(group), RESAMPLES, rng)].mean(axis=1))


def resampled_places(size: int, count: int, rng: np.random.Generator) -> NDArray[np.integer]:
    """Which of `size` values each of `count` resamples holds, ``[count, size]``; small integers, which are drawn faster."""
    kind = np.int16 if size <= np.iinfo(np.int16).max else np.int64
    return rng.integers(size, size=(count, size), dtype=kind)


def quantile_interval(resampled: Floats) -> tuple[float, float]:
    """The 2.5 % and 97.5 % quantiles of resampled estimates ``[R]``."""
    low, high = np.quantile(resampled, [(1 - CONFIDENCE) / 2, (1 + CONFIDENCE) / 2])
    return float(low), float(high)


def split(data: Floats, strata: Sequence[object] | None) -> list[Floats]:
    """The values of each stratum, strata in the order of their names; all in one without strata."""
    if not len(data):
        return []
    if strata is None:
        return [data]
    _, labels = np.unique(np.array([str(s) for s in strata]), return_inverse=True)
    return [data[labels == g] for g in range(int(labels.max()) + 1)]


def share(successes: ArrayLike, strata: Sequence[object] | None = None, seed: int = SEED) -> Interval:
    """Bootstrap interval of a share; where all or none succeed (in every stratum), the exact (Clopper-Pearson) one.

    A bootstrap of 150 zeros says [0, 0]; what 150 zeros really say is [0, 2.4 %].
    """
    data = np.asarray(successes, dtype=np.float64)
    groups = split(data, strata)
    if groups and all(np.all(group == group[0]) for group in groups):
        bound = stats.binomtest(int(data.sum()), len(data)).proportion_ci(CONFIDENCE, method="exact")
        value = float(np.mean([group[0] for group in groups]))
        return Interval(value, min(value, float(bound.low)), max(value, float(bound.high)), len(data), exact=True)
    return bootstrap_mean(data, strata, seed)
