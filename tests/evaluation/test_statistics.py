"""Intervals against SciPy's own bootstrap, coverage by simulation, tests against hand-made tables."""

import math

import numpy as np
import pytest
from scipy import stats

from tab_marl.evaluation import statistics


def test_bootstrap_agrees_with_scipy():
    values = np.random.default_rng(1).exponential(300, size=150)
    ours = statistics.bootstrap_mean(values)
    theirs = stats.bootstrap((values,), np.mean, n_resamples=20000, method="percentile", rng=np.random.default_rng(2))
    assert ours.value == pytest.approx(values.mean())
    width = theirs.confidence_interval.high - theirs.confidence_interval.low
    assert abs(ours.low - theirs.confidence_interval.low) < 0.05 * width
    assert abs(ours.high - theirs.confidence_interval.high) < 0.05 * width


def test_stratified_mean_weighs_strata_equally_and_is_narrower_than_pooling():
    values = np.concatenate([np.full(90, 10.0), np.full(10, 1000.0)]) + np.random.default_rng(0).normal(size=100)
    strata = ["a"] * 90 + ["b"] * 10
    inside = statistics.bootstrap_mean(values, strata)
    assert inside.value == pytest.approx(505, abs=1)  # not the pooled mean of 109
    assert inside.high - inside.low < 2


def test_interval_covers_the_truth_about_95_times_in_100():
    rng = np.random.default_rng(3)
    hits = 0
    for _ in range(200):
        interval = statistics.share(rng.random(150) < 0.3)
        hits += interval.low <= 0.3 <= interval.high
    assert 178 <= hits <= 200  # binomial(200, .95) lies there with probability .999


def test_no_spread_is_not_certainty():
    none = statistics.share([False] * 150)
    assert none.exact and none.value == 0 and none.low == 0
    assert none.high == pytest.approx(1 - 0.025 ** (1 / 150))  # Clopper-Pearson at zero successes
    every = statistics.share([True] * 20)
    assert every.low == pytest.approx(0.025 ** (1 / 20)) and every.high == 1
    halves = statistics.share([True] * 4 + [False] * 4, ["a"] * 4 + ["b"] * 4)
    assert halves.exact and halves.value == 0.5 and halves.low < 0.2 and halves.high > 0.8


def test_paired_shares_is_mcnemar_on_the_pairs_that_differ():
    first = [1] * 9 + [0] * 1 + [1] * 40 + [0] * 50
    second = [0] * 9 + [1] * 1 + [1] * 40 + [0] * 50
    paired = statistics.paired_shares(first, second)
    assert paired.difference.value == pytest.approx(0.08)
    # Two-sided by hand: 2 * P(at least 9 of 10 heads).
    assert paired.p_value == pytest.approx(2 * (10 + 1) / 2**10)
    assert paired.verdict == 1
    assert statistics.paired_shares(second, first).verdict == -1


def test_four_pairs_are_no_verdict():
    paired = statistics.paired_shares([1] * 4, [0] * 4)
    assert paired.difference.low > 0 and paired.p_value == pytest.approx(0.125)
    assert paired.verdict == 0


def test_paired_shares_without_a_difference():
    same = statistics.paired_shares([1, 0, 1], [1, 0, 1])
    assert same.p_value == 1 and same.verdict == 0
    assert same.difference.high > 0.5  # three pairs exclude little


def test_pairing_matters():
    rng = np.random.default_rng(4)
    hard = rng.normal(0, 500, size=100)
    first, second = 1000 + hard, 1000 + hard - 30 + rng.normal(0, 20, size=100)
    paired = statistics.paired_steps(first, second)
    assert paired.verdict == 1 and paired.p_value < 1e-6
    unpaired = stats.mannwhitneyu(first, second).pvalue
    assert unpaired > 0.05


def test_paired_steps_all_equal():
    assert statistics.paired_steps([5, 6], [5, 6]).p_value == 1


def test_unequal_lengths_are_refused():
    with pytest.raises(ValueError, match="equal lengths"):
        statistics.paired_shares([1], [1, 0])
    with pytest.raises(ValueError, match="at least one"):
        statistics.bootstrap_mean([])


def test_cumulative_share_counts_by_hand():
    curve = statistics.cumulative_share([10, 20, 30, 99], [True, True, True, False], [0, 10, 25, 100])
    assert curve.tolist() == [0, 0.25, 0.5, 0.75]


def test_same_input_same_figures():
    values = [1.0, 2.0, 7.0]
    assert statistics.bootstrap_mean(values) == statistics.bootstrap_mean(values)


@pytest.mark.parametrize(("p", "text"), [(0.0004, "< .001"), (0.042, ".042"), (1.0, "1")])
def test_p_as_text(p, text):
    assert statistics.stars(p) == text
    assert math.isfinite(p)
