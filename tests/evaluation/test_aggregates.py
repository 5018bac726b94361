"""Aggregates against rliable itself: the figures equal, the intervals as close as two bootstraps can be."""

from unittest import mock

import numpy as np
import pytest

from tab_marl.evaluation import statistics

TAU = np.linspace(0, 1, 21)


@pytest.fixture(scope="module")
def rliable():
    """rliable's library. The `arch` that it needs cannot be imported under pandas 3 for a decorator of a model that
    nobody uses here: the decorator does nothing meanwhile."""
    with mock.patch("pandas.util._decorators.deprecate_kwarg", lambda *_, **__: lambda function: function):
        from rliable import library, metrics
    return library, metrics


@pytest.fixture
def matrix():
    """Scores ``[runs, tasks]`` of two planners."""
    rng = np.random.default_rng(1)
    return rng.beta(4, 2, size=(40, 5)), rng.beta(3, 2, size=(40, 5))


def columns(matrix):
    return [matrix[:, k] for k in range(matrix.shape[1])]


def test_point_estimates_are_rliables(rliable, matrix):
    _, metrics = rliable
    first, second = matrix
    scores = columns(first)
    assert statistics.interquartile_mean(scores) == pytest.approx(metrics.aggregate_iqm(first))
    assert statistics.mean_of_missions(scores) == pytest.approx(metrics.aggregate_mean(first))
    assert statistics.median_of_missions(scores) == pytest.approx(metrics.aggregate_median(first))
    assert statistics.optimality_gap(scores, 0.8) == pytest.approx(metrics.aggregate_optimality_gap(first, 0.8))
    ours = statistics.probability_of_improvement(scores, columns(second))
    assert ours == pytest.approx(metrics.probability_of_improvement(first, second))
    assert statistics.probability_of_improvement(scores, scores) == 0.5


def test_intervals_are_rliables(rliable, matrix):
    library, metrics = rliable
    first, _ = matrix
    np.random.seed(3)  # noqa: NPY002, rliable resamples with the global generator
    _, theirs = library.get_interval_estimates({"x": first}, lambda x: np.array([metrics.aggregate_iqm(x)]), reps=2000)
    low, high = theirs["x"][:, 0]
    ours = statistics.aggregate(columns(first))
    assert abs(ours.low - low) < 0.12 * (high - low) and abs(ours.high - high) < 0.12 * (high - low)
    slow = statistics.aggregate(columns(first), lambda s: statistics.interquartile_mean(s))
    assert (slow.low, slow.high) == pytest.approx((ours.low, ours.high))  # the fast way is the same way


def test_profiles_are_rliables(rliable, matrix):
    library, _ = rliable
    first, _ = matrix
    np.random.seed(4)  # noqa: NPY002
    values, bands = library.create_performance_profile({"x": first}, TAU, reps=1000)
    value, low, high = statistics.performance_profile(columns(first), TAU)
    assert value == pytest.approx(values["x"])
    assert np.max(np.abs(low - bands["x"][0])) < 0.02 and np.max(np.abs(high - bands["x"][1])) < 0.02


def test_unequal_missions_weigh_by_their_episodes():
    scores = [np.zeros(30), np.ones(10)]
    value, low, high = statistics.performance_profile(scores, [0.5])
    assert value == [0.25] and low == high == [0.25]  # no spread within either mission
    assert statistics.interquartile_mean(scores) == 0.0
    with pytest.raises(ValueError, match="at least one episode"):
        statistics.aggregate([np.ones(3), np.array([])])
