"""What is said before a run: against closed forms, other libraries and simulated intervals."""

import math

import numpy as np
import pytest
from scipy import stats

from tab_marl.evaluation import planning_ahead as ahead
from tab_marl.evaluation.rows import Timing


@pytest.mark.parametrize("share", [0.0, 0.02, 0.1, 0.5, 0.93])
@pytest.mark.parametrize("episodes", [1, 10, 150, 4000])
def test_wilson_as_scipy_has_it(share, episodes):
    successes = round(share * episodes)
    bound = stats.binomtest(successes, episodes).proportion_ci(0.95, method="wilson")
    assert ahead.wilson_half_width(successes / episodes, episodes) == pytest.approx((bound.high - bound.low) / 2)


@pytest.mark.parametrize("share", [0.0, 0.1, 0.5])
@pytest.mark.parametrize("half_width", [0.2, 0.05, 0.011])
def test_episodes_for_a_share_are_just_enough(share, half_width):
    n = ahead.episodes_for_share(half_width, share)
    assert ahead.wilson_half_width(share, n) <= half_width
    assert n == 1 or ahead.wilson_half_width(share, n - 1) > half_width


def test_textbook_sizes():
    assert ahead.episodes_for_share(0.05, 0.5) == 381  # 384.1 of the normal interval, less z squared
    assert ahead.episodes_for_mean(0.1, 1.0) == math.ceil(1.959964**2 * 100) == 385
    assert ahead.episodes_for_mean(10.0, 0.0) == 2
    for bad in (0.0, 0.5, -1):
        with pytest.raises(ValueError, match="half_width"):
            ahead.episodes_for_share(bad, 0.5)


def test_the_promised_interval_covers_as_promised():
    rng = np.random.default_rng(3)
    deviation = 200.0
    n = ahead.episodes_for_mean(40.0, deviation)
    means = rng.normal(0.0, deviation, size=(4000, n)).mean(axis=1)
    assert np.mean(np.abs(means) <= 40.0) == pytest.approx(0.95, abs=0.012)


def test_spread_of_stored_pairs(synthetic):
    rng = np.random.default_rng(1)
    rows = []
    for seed in range(30):
        both = rng.integers(200, 900, size=2)
        for planner, steps in zip(("S-POMCP", "TAB-POMCP"), both, strict=True):
            rows.append(synthetic.row(planner, seed, completed=bool(steps > 700), steps=int(steps)))
    rows.append(synthetic.row("FP-POMCP", 0))  # too few pairs to tell
    (found,) = ahead.spreads(rows)
    a, b = ([r for r in rows if r.planner == p] for p in ("S-POMCP", "TAB-POMCP"))
    differences = [x.physics_steps - y.physics_steps for x, y in zip(a, b, strict=True)]
    assert (found.planner, found.pairs) == ("S-POMCP", 30)
    assert found.steps == pytest.approx(np.std(differences, ddof=1))
    assert 0 < found.completed < 1


def timing(seconds):
    return Timing(10, 5.0, 9.0, 9 * seconds, processor_seconds=seconds)


def test_time_from_stored_episodes_from_measuring_and_from_nothing():
    missing = [("M1", "point", "TAB-POMCP", s) for s in range(10)] + [("M2", "point", "S-POMCP", s) for s in range(10)]
    stored = {("M1", "point", "TAB-POMCP", 90): timing(2 * 0.78), ("M1", "point", "TAB-POMCP", 91): timing(4 * 0.78)}
    known = ahead.estimate(missing, stored)
    # M1's mean is three times the reference, so M2 of another planner is taken to be as well.
    assert known.processor_seconds == pytest.approx(3 * (10 * 0.78 + 10 * 1.00))
    assert known.seconds(2) == pytest.approx(known.processor_seconds / 2) and "2 stored" in known.source
    assert ahead.estimate(missing, {}, speed=2.0).processor_seconds == pytest.approx(2 * (10 * 0.78 + 10 * 1.00))
    assert ahead.estimate(missing, {}).source == "from another machine's figures"
    assert ahead.speed_of(2 * ahead.REFERENCE_DECISION_MILLISECONDS) == 2.0


def test_every_planner_and_mission_has_a_reference():
    from tab_marl.evaluation.settings import MISSIONS, PLANNERS

    assert set(ahead.COSTS) == set(PLANNERS)
    assert all(len(costs) == len(MISSIONS) and min(costs) > 0 for costs in ahead.COSTS.values())


def test_forecast_in_words(synthetic):
    rows = [
        synthetic.row(p, s, steps=300 + 10 * s * (p == "S-POMCP")) for s in range(20) for p in ("S-POMCP", "TAB-POMCP")
    ]
    lines = ahead.forecast(150, 0.05, rows, ahead.Cost(900, 1800.0, "from 9 stored episodes"), 2)
    assert lines[0].startswith("to play: 900 episodes, about 15 min with 2 workers (2.00 s of processor time each")
    assert "50 % to +- 7.9" in lines[1] and "381 at 50 %" in lines[1]
    assert "20 stored pairs" in lines[2] and "StI (S-POMCP, M1 point)" in lines[3]
    assert "workers" not in ahead.forecast(150, 0.05, [], ahead.Cost(9, 18.0, ""), 0)[0]


@pytest.mark.parametrize(("seconds", "text"), [(0.2, "1 s"), (80, "80 s"), (600, "10 min"), (6600, "1 h 50 min")])
def test_durations(seconds, text):
    assert ahead.words(seconds) == text
