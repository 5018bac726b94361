"""Intervals, paired tests, aggregates and survival curves. Everything reads rows; every draw is seeded."""

from tab_marl.evaluation.statistics.intervals import (
    CONFIDENCE,
    RESAMPLES,
    Interval,
    Paired,
    bootstrap_mean,
    cumulative_share,
    paired_shares,
    paired_steps,
    share,
    stars,
)

__all__ = [
    "CONFIDENCE",
    "RESAMPLES",
    "Interval",
    "Paired",
    "bootstrap_mean",
    "cumulative_share",
    "paired_shares",
    "paired_steps",
    "share",
    "stars",
]
