"""Intervals against SciPy's own bootstrap, coverage by simulation, tests against hand-made tables."""

import dataclasses
import itertools
import math

import numpy as np
import pytest
from scipy import stats
from statsmodels.stats.multitest import multipletests

from tab_marl.evaluation import statistics
from tab_marl.evaluation.statistics import paired


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
    found = statistics.paired_shares(first, second)
    assert found.difference.value == pytest.approx(0.08)
    # Two-sided by hand: 2 * P(at least 9 of 10 heads).
    assert found.p_value == pytest.approx(2 * (10 + 1) / 2**10)
    assert found.verdict == 1
    assert statistics.paired_shares(second, first).verdict == -1


def test_four_pairs_are_no_verdict():
    found = statistics.paired_shares([1] * 4, [0] * 4)
    assert found.difference.low > 0 and found.p_value == pytest.approx(0.125)
    assert found.verdict == 0


def test_paired_shares_without_a_difference():
    same = statistics.paired_shares([1, 0, 1], [1, 0, 1])
    assert same.p_value == 1 and same.verdict == 0
    assert same.difference.high > 0.5  # three pairs exclude little


def test_pairing_matters():
    rng = np.random.default_rng(4)
    hard = rng.normal(0, 500, size=100)
    first, second = 1000 + hard, 1000 + hard - 30 + rng.normal(0, 20, size=100)
    found = statistics.paired_steps(first, second)
    assert found.verdict == 1 and found.p_value < 1e-6
    unpaired = stats.mannwhitneyu(first, second).pvalue
    assert unpaired > 0.05


def test_paired_steps_all_equal():
    assert statistics.paired_steps([5, 6], [5, 6]).p_value == 1


def test_unequal_lengths_are_refused():
    with pytest.raises(ValueError, match="equal lengths"):
        statistics.paired_shares([1], [1, 0])
    with pytest.raises(ValueError, match="at least one"):
        statistics.bootstrap_mean([])


def brute_signed_rank(d):
    """Every assignment of signs to the ranks of what differs, counted."""
    d = np.asarray(d, dtype=float)
    ranks = stats.rankdata(np.abs(d))[d != 0]
    seen = stats.rankdata(np.abs(d))[d > 0].sum()
    sums = np.array([np.dot(signs, ranks) for signs in itertools.product((0, 1), repeat=len(ranks))])
    centre = ranks.sum() / 2
    return np.mean(np.abs(sums - centre) >= abs(seen - centre) - 1e-9)


@pytest.mark.parametrize("seed", range(6))
def test_signed_rank_counts_every_sign(seed):
    rng = np.random.default_rng(seed)
    tied = rng.integers(-4, 6, size=11)  # ties and zeros in plenty
    assert statistics.signed_rank_p(tied) == pytest.approx(brute_signed_rank(tied), rel=1e-12)


def test_signed_rank_is_scipys_where_scipy_is_exact():
    d = np.random.default_rng(0).normal(0.2, 1, size=40)
    assert statistics.signed_rank_p(d) == pytest.approx(stats.wilcoxon(d, method="exact").pvalue, rel=1e-9)


def test_signed_rank_of_many_pairs_meets_the_exact_one(monkeypatch):
    d = np.rint(np.random.default_rng(1).normal(0.25, 3, size=300))
    exact = statistics.signed_rank_p(d)
    monkeypatch.setattr(paired, "EXACT_PAIRS", 10)
    assert statistics.signed_rank_p(d) == pytest.approx(exact, rel=0.03)
    assert exact == pytest.approx(stats.wilcoxon(d, zero_method="pratt", method="approx").pvalue, rel=0.03)


def test_holm_is_statsmodels():
    rng = np.random.default_rng(2)
    p = np.concatenate([rng.random(9) ** 4, [0.01, 0.01]])
    ours = statistics.holm(dict(enumerate(p)))
    theirs = multipletests(p, method="holm")[1]
    assert [ours[k] for k in range(len(p))] == pytest.approx(theirs.tolist())
    assert statistics.holm({}) == {}


def test_correction_can_take_a_verdict_away():
    alone = statistics.paired_shares([1] * 9 + [0] * 41, [0] * 50)
    assert alone.verdict == 1
    assert dataclasses.replace(alone, adjusted=0.06, comparisons=15).verdict == 0


def test_same_input_same_figures():
    values = [1.0, 2.0, 7.0]
    assert statistics.bootstrap_mean(values) == statistics.bootstrap_mean(values)


@pytest.mark.parametrize(("p", "text"), [(0.0004, "< .001"), (0.042, ".042"), (1.0, "1")])
def test_p_as_text(p, text):
    assert statistics.stars(p) == text
    assert math.isfinite(p)
