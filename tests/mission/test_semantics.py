"""Monitor, automaton, kernel and unrolled automaton against the declarative oracle, same verdict at the same tick."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace

import numpy as np
import pytest
from mission_oracle import KINDS, Oracle, random_mission, random_trajectory

from tab_marl.mission import kernels
from tab_marl.mission.automaton import BEFORE_START, COMPLETED, FAILED, AutomatonState
from tab_marl.mission.compile import compile_mission
from tab_marl.mission.monitor import Monitor
from tab_marl.mission.unroll import UNTRACKED, unroll
from tab_marl.world.scenario import Scenario

SCENARIO = replace(Scenario.preset("open"), horizon_seconds=15.0)
TICK = 0.5
TICKS = 50
NAMES = {COMPLETED: "completed", FAILED: "failed"}


def verdicts(mission, points):
    """{realisation: (status, tick)}."""
    automaton = compile_mission(mission, SCENARIO, TICK)
    masks = automaton.masks(points)
    found = {}

    state = AutomatonState(automaton.initial, BEFORE_START)
    found["automaton"] = ("active", None)
    for t, mask in enumerate(masks):
        state = automaton.advance(state, int(mask))
        if state.location < 0:
            found["automaton"] = (NAMES[state.location], t)
            break

    location, clocks = automaton.initial, np.full(3, -1, dtype=np.int32)
    found["kernel"] = ("active", None)
    for t, mask in enumerate(masks):
        location = kernels.advance(*automaton.tables, location, clocks, mask)
        if location < 0:
            found["kernel"] = (NAMES[location], t)
            break
    assert tuple(clocks) == state.clocks or state.location < 0

    monitor = Monitor(mission, SCENARIO, TICK, automaton)
    found["monitor"] = ("active", None)
    for t, point in enumerate(points):
        status = monitor.step(point) if t else monitor.reset(point)
        if status != "active":
            found["monitor"] = (status, t)
            break
    assert bool(monitor.why_failed) == (monitor.status == "failed")

    unrolled = unroll(automaton, TICKS, masks)
    symbols = unrolled.symbols(masks)
    at = unrolled.initial
    found["unrolled"] = ("active", None)
    for t, symbol in enumerate(symbols):
        at = unrolled.delta[at, symbol]
        if at in (unrolled.accepting, unrolled.rejecting):
            found["unrolled"] = ("completed" if at == unrolled.accepting else "failed", t)
            break
        assert unrolled.mission_ticks[at] in (t, UNTRACKED) or unrolled.mission_ticks[at] < t  # saturated
    return found


@pytest.mark.parametrize("kind", KINDS)
def test_all_realisations_agree_with_the_oracle(kind):
    rng = np.random.default_rng(KINDS.index(kind))
    tally = Counter()
    for _ in range(25 if kind != "mixed" else 60):
        mission = random_mission(rng, kind)
        for _ in range(6):
            points = random_trajectory(rng, mission, SCENARIO, TICKS, TICK)
            expected = Oracle(mission, SCENARIO, TICK, points).verdict()
            for name, verdict in verdicts(mission, points).items():
                assert verdict == expected, (name, mission, points.tolist())
            tally[expected[0]] += 1
    # The trajectories must be worth something: both ends occur where both can.
    assert tally["completed"] >= 10, tally
    assert tally["failed"] >= 10 or kind in ("eventually", "order", "k_of_n_including"), tally
