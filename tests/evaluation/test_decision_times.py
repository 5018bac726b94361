"""Decision times of TAB-POMCP over S-POMCP's: a ratio of known times, its interval, and what is left out."""

import dataclasses

import numpy as np
import pytest

from tab_marl.evaluation.decision_times import compare, summary
from tab_marl.evaluation.rows import Timing

MEASURED = Timing(10, 5.0, 9.0, 1.0, processor_seconds=1.0, preparation_processor_seconds=0.1)


def timings(ratio, noise, pairs=40, mission="M1"):
    """TAB's decisions cost `ratio` times those of S, with independent noise per episode; episodes differ in length."""
    rng = np.random.default_rng(7)
    found = {}
    for seed in range(pairs):
        for planner, each in (("S-POMCP", 0.02), ("TAB-POMCP", 0.02 * ratio)):
            decisions = int(rng.integers(5, 40))
            spent = decisions * each * float(np.exp(noise * rng.standard_normal()))
            found[mission, "point", planner, seed] = dataclasses.replace(
                MEASURED, decisions=decisions, decision_processor_seconds=spent
            )
    return found


def test_a_known_ratio_is_found_and_bracketed():
    (found,) = compare(timings(0.9, 0.1))
    assert found.ratio.low < 0.9 < found.ratio.high and found.ratio.high - found.ratio.low < 0.1
    assert found.ratio.count == 40 and found.verdict == "<= 1.05"
    assert found.plain_milliseconds == pytest.approx(20.0, rel=0.1)


@pytest.mark.parametrize(("ratio", "noise", "verdict"), [(1.4, 0.05, "> 1.05"), (1.05, 0.3, "not clear of 1.05")])
def test_verdicts(ratio, noise, verdict):
    (found,) = compare(timings(ratio, noise))
    assert found.verdict == verdict


def test_without_noise_the_interval_is_a_point_and_preparation_counts_apart():
    (found,) = compare(timings(1.2, 0.0))
    assert (found.ratio.value, found.ratio.low, found.ratio.high) == pytest.approx((1.2, 1.2, 1.2))
    assert found.with_preparation != pytest.approx(1.2)


def test_what_was_not_measured_or_has_no_pair_is_left_out():
    known = timings(1.0, 0.1, pairs=3)
    old = {k: dataclasses.replace(t, decision_processor_seconds=float("nan")) for k, t in timings(1.0, 0.1).items()}
    alone = {k: t for k, t in timings(1.0, 0.1, mission="M2").items() if k[2] == "S-POMCP"}
    assert [c.mission for c in compare({**alone, **known})] == ["M1"]
    assert compare(old) == [] and summary(old) == []
    lines = summary({**known, **timings(1.5, 0.01, mission="M3")})
    assert len(lines) == 3 and lines[2].strip().startswith("M3  1.5") and "> 1.05" in lines[2]
