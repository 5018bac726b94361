"""Survival curves against lifelines and SciPy, by hand, and against what simulated episodes truly do."""

import lifelines
import numpy as np
import pytest
from lifelines.utils import restricted_mean_survival_time
from scipy import stats

from tab_marl.evaluation.statistics import survival


@pytest.fixture
def episodes():
    """Times and causes of 120 episodes, no two events at one time (lifelines moves such times)."""
    rng = np.random.default_rng(5)
    completed, met, horizon = rng.exponential(30, 120), rng.exponential(20, 120), rng.uniform(10, 60, 120)
    times = np.minimum(np.minimum(completed, met), horizon)
    causes = np.select([times == completed, times == met], [1, 2], 0)
    return times, causes


def test_competing_risks_are_lifelines(episodes):
    times, causes = episodes
    theirs = lifelines.AalenJohansenFitter().fit(times, causes, event_of_interest=1)
    ours = survival.cumulative_incidence(times, causes, 1)
    index = theirs.cumulative_density_.index.to_numpy()
    value, low, high = ours.at(index)
    assert value == pytest.approx(theirs.cumulative_density_.to_numpy()[:, 0], abs=1e-12)
    # From the first event on, lifelines' bounds (its "upper" column is the lower one).
    bounds = np.sort(theirs.confidence_interval_.to_numpy(), axis=1)
    later = (value > 0) & np.isfinite(bounds).all(axis=1)
    assert later.sum() > 80
    assert low[later] == pytest.approx(bounds[later, 0], abs=1e-9)
    assert high[later] == pytest.approx(bounds[later, 1], abs=1e-9)


def test_one_cause_is_kaplan_meier_of_scipy_and_lifelines(episodes):
    times, causes = episodes
    met = causes == 2
    ours = survival.cumulative_incidence(times, met)
    sample = stats.CensoredData(uncensored=times[met], right=times[~met])
    theirs = stats.ecdf(sample)
    value, _, _ = ours.at(theirs.cdf.quantiles)
    assert value == pytest.approx(theirs.cdf.probabilities, abs=1e-12)
    km = lifelines.KaplanMeierFitter().fit(times, met)
    index = km.cumulative_density_.index.to_numpy()[1:]
    assert ours.at(index)[0] == pytest.approx(km.cumulative_density_.to_numpy()[1:, 0], abs=1e-12)
    # Greenwood's variance, which lifelines shows through the bounds of log(-log S).
    bounds = km.confidence_interval_.to_numpy()[1:]
    survived = km.survival_function_.to_numpy()[1:, 0]
    inside = (survived < 1) & (survived > 0)
    spread = np.log(np.log(bounds[inside, 0]) / np.log(bounds[inside, 1])) / (2 * stats.norm.ppf(0.975))
    variance = (spread * survived[inside] * np.log(survived[inside])) ** 2
    found = ours.variance[np.searchsorted(ours.times, index[inside])]
    assert found == pytest.approx(variance, rel=1e-6)


def test_restricted_mean_is_lifelines(episodes):
    times, causes = episodes
    curve = survival.cumulative_incidence(times, causes != 0)
    km = lifelines.KaplanMeierFitter().fit(times, causes != 0)
    for until in (5.0, 20.0, 40.0):
        mean, error = survival.restricted_mean(curve, until)
        assert mean == pytest.approx(restricted_mean_survival_time(km, t=until), rel=1e-9)
        assert 0 < error < until
    # Without censoring it is the mean of the times cut at `until`, and its error the usual one.
    whole = survival.cumulative_incidence(times, np.ones(len(times), dtype=int))
    mean, error = survival.restricted_mean(whole, 15.0)
    cut = np.minimum(times, 15.0)
    assert mean == pytest.approx(cut.mean())
    assert error == pytest.approx(cut.std() / np.sqrt(len(cut)), rel=1e-9)


def test_by_hand_with_ties():
    # 1 completed at 1; 1 completed and 1 met at 2; censored at 3; met at 4.
    curve = survival.cumulative_incidence([1, 2, 2, 3, 4], [1, 1, 2, 0, 2], 1)
    assert curve.times.tolist() == [1, 2, 3, 4]
    assert curve.at_risk.tolist() == [5, 4, 2, 1]
    assert curve.value == pytest.approx([0.2, 0.4, 0.4, 0.4])
    other = survival.cumulative_incidence([1, 2, 2, 3, 4], [1, 1, 2, 0, 2], 2)
    assert other.value == pytest.approx([0, 0.2, 0.2, 0.6])


def test_censoring_is_not_a_bias():
    """Of an exponential race cut at random, half as many complete as are met: the naive share says too few."""
    rng = np.random.default_rng(6)
    completed, met, horizon = rng.exponential(2, 4000), rng.exponential(1, 4000), rng.exponential(1, 4000)
    times = np.minimum(np.minimum(completed, met), horizon)
    causes = np.select([times == completed, times == met], [1, 2], 0)
    truth = (1 - np.exp(-1.5)) / 3
    _, low, high = survival.cumulative_incidence(times, causes, 1).at(1.0)
    assert low < truth < high and high - low < 0.05
    assert np.mean((causes == 1) & (times <= 1)) < truth - 0.03


def test_bands_cover_about_95_times_in_100():
    rng = np.random.default_rng(7)
    hits = 0
    for _ in range(300):
        completed, met, horizon = rng.exponential(2, 60), rng.exponential(1, 60), rng.uniform(0.5, 3, 60)
        times = np.minimum(np.minimum(completed, met), horizon)
        causes = np.select([times == completed, times == met], [1, 2], 0)
        _, low, high = survival.cumulative_incidence(times, causes, 1).at(1.0)
        hits += low <= (1 - np.exp(-1.5)) / 3 <= high
    assert 270 <= hits <= 298


def test_nothing_happened_is_not_certainty():
    curve = survival.cumulative_incidence([5.0] * 30, [2] * 29 + [0], 1)
    assert curve.value.tolist() == [0] and curve.low.tolist() == [0]
    assert curve.high[0] == pytest.approx(1 - 0.025 ** (1 / 29))  # one fate is unknown
    every = survival.cumulative_incidence([1.0] * 20, [1] * 20, 1)
    assert every.value[-1] == 1 and every.low[-1] == pytest.approx(0.025 ** (1 / 20))


@pytest.mark.parametrize("count", [3, 49, 60, 291])
def test_a_share_that_rounds_to_one_is_one(count):
    """Steps of 1/n seldom add up to 1 exactly; on the scale log(-log F) what is missing would open the band to [0, 1]."""
    curve = survival.cumulative_incidence(np.arange(1.0, count + 1), np.ones(count, dtype=int))
    mean = survival.mean_curve([curve] * 3, [count + 1.0])
    for low, high, known in ((curve.low, curve.high, count), (mean.low, mean.high, 3 * count)):
        assert low[-1] == pytest.approx(0.025 ** (1 / known)) and high[-1] == 1
    nothing = survival.mean_curve([survival.cumulative_incidence([1.0] * count, [2] * count)], [2.0])
    assert nothing.low[0] == 0 and nothing.high[0] == pytest.approx(1 - 0.025 ** (1 / count))


def test_mean_of_curves_weighs_missions_equally():
    many = survival.cumulative_incidence(np.ones(90), np.ones(90, dtype=int))
    few = survival.cumulative_incidence(np.full(10, 3.0), np.zeros(10, dtype=int))
    mean = survival.mean_curve([many, few], [0.0, 1.0, 2.0])
    assert mean.value.tolist() == [0, 0.5, 0.5]
    assert mean.at_risk.tolist() == [100, 100, 10]


def test_nonsense_is_refused():
    with pytest.raises(ValueError, match="one time and one cause"):
        survival.cumulative_incidence([1, 2], [1])
    with pytest.raises(ValueError, match="finite"):
        survival.cumulative_incidence([np.nan], [1])
    with pytest.raises(ValueError, match="until is 0"):
        survival.restricted_mean(survival.cumulative_incidence([1.0], [1]), 0)
