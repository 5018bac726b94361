"""Intervals, paired tests, aggregates and survival curves. Everything reads rows; every draw is seeded."""

from tab_marl.evaluation.statistics.aggregates import (
    aggregate,
    interquartile_mean,
    mean_of_missions,
    median_of_missions,
    optimality_gap,
    performance_profile,
    probability_of_improvement,
)
from tab_marl.evaluation.statistics.frames import (
    ALL,
    aggregates,
    breakdown,
    frame,
    paired_differences,
    performance_profiles,
    restricted_means,
    survival_curves,
)
from tab_marl.evaluation.statistics.intervals import CONFIDENCE, RESAMPLES, SEED, Interval, bootstrap_mean, share
from tab_marl.evaluation.statistics.paired import Paired, holm, paired_shares, paired_steps, signed_rank_p, stars
from tab_marl.evaluation.statistics.survival import Curve, cumulative_incidence, mean_curve, restricted_mean

__all__ = [
    "ALL",
    "CONFIDENCE",
    "RESAMPLES",
    "SEED",
    "Curve",
    "Interval",
    "Paired",
    "aggregate",
    "aggregates",
    "bootstrap_mean",
    "breakdown",
    "cumulative_incidence",
    "frame",
    "holm",
    "interquartile_mean",
    "mean_curve",
    "mean_of_missions",
    "median_of_missions",
    "optimality_gap",
    "paired_differences",
    "paired_shares",
    "paired_steps",
    "performance_profile",
    "performance_profiles",
    "probability_of_improvement",
    "restricted_mean",
    "restricted_means",
    "share",
    "signed_rank_p",
    "stars",
    "survival_curves",
]
