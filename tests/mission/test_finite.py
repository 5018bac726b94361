"""Any finite automaton, and products of automata, against running the word one symbol at a time."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tab_marl.mission import (
    NO_BRANCH,
    AutomatonTooLarge,
    Constraint,
    FiniteAutomaton,
    Mission,
    Monitor,
    TickAutomaton,
    compile_joint,
    compile_mission,
    conjunction,
    unroll,
)
from tab_marl.mission import unroll as unroll_module  # the function; the module is reached through sys.modules
from tab_marl.world.regions import Box
from tab_marl.world.scenario import Checkpoint, Robot, Scenario
from tab_marl.world.solids import Ball, Cuboid
from tab_marl.world.volume import BallCheckpoint, Volume


def verdict_of_word(automaton: FiniteAutomaton, word: tuple[int, ...]) -> bool:
    """The textbook's definition, symbol by symbol."""
    q = automaton.initial
    for symbol in word:
        q = int(automaton.table[q, symbol])
        if automaton.accept == "reached" and q in automaton.accepting:
            return True
        if q in automaton.rejecting:
            return False
    return automaton.accept == "at_horizon" and q in automaton.accepting


def verdict_unrolled(ticked: TickAutomaton, word: tuple[int, ...]) -> bool:
    q = ticked.initial
    for symbol in word:
        q = int(ticked.delta[q, symbol])
    assert q in (ticked.accepting, ticked.rejecting) or not word
    return q == ticked.accepting


@st.composite
def automata(draw: st.DrawFn) -> FiniteAutomaton:
    states, symbols = draw(st.integers(2, 5)), draw(st.integers(1, 3))
    delta = draw(
        st.lists(
            st.lists(st.integers(0, states - 1), min_size=symbols, max_size=symbols), min_size=states, max_size=states
        )
    )
    accept = draw(st.sampled_from(["reached", "at_horizon"]))
    kinds = draw(st.lists(st.sampled_from("..ar"), min_size=states, max_size=states))
    kinds[-1] = "a"
    accepting = [q for q in range(states) if kinds[q] == "a"]
    rejecting = [q for q in range(states) if kinds[q] == "r"]
    begin = [q for q in range(states) if accept == "at_horizon" or kinds[q] != "a"] or [0]
    if kinds[begin[0]] == "a" and accept == "reached":
        accept = "at_horizon"
    return FiniteAutomaton(np.array(delta), begin[0], accepting, rejecting, accept)


def is_sound(ticked: TickAutomaton) -> None:
    """Ranks rise, every transient state is reached, and each can still be accepted."""
    inner = ~np.isin(np.arange(ticked.states), [ticked.accepting, ticked.rejecting])
    onward = inner[ticked.delta] & inner[:, None]
    assert (ticked.rank[ticked.delta] > ticked.rank[:, None])[onward].all()
    reached = {ticked.initial}
    for q in np.argsort(ticked.rank, kind="stable"):
        if q in reached:
            reached |= set(ticked.delta[q].tolist())
    assert set(np.flatnonzero(inner)) <= reached
    hopeful = {ticked.accepting}
    for q in np.argsort(-ticked.rank, kind="stable"):
        if inner[q] and set(ticked.delta[q].tolist()) & hopeful:
            hopeful.add(q)
    assert set(np.flatnonzero(inner)) - {ticked.initial} <= hopeful


@settings(max_examples=150, deadline=None)
@given(automata(), st.integers(0, 4))
def test_unrolled_accepts_the_same_words(automaton: FiniteAutomaton, horizon: int) -> None:
    ticked = automaton.unrolled(horizon)
    for word in itertools.product(range(automaton.table.shape[1]), repeat=horizon + 1):
        assert verdict_unrolled(ticked, word) == verdict_of_word(automaton, word)
    is_sound(ticked)


@settings(max_examples=80, deadline=None)
@given(automata(), automata(), st.integers(0, 3))
def test_a_conjunction_accepts_what_both_accept(a: FiniteAutomaton, b: FiniteAutomaton, horizon: int) -> None:
    symbols = min(a.table.shape[1], b.table.shape[1])
    cut = [FiniteAutomaton(x.table[:, :symbols], x.initial, x.accepting, x.rejecting, x.accept) for x in (a, b)]
    both = conjunction(*(x.unrolled(horizon) for x in cut))
    for word in itertools.product(range(symbols), repeat=horizon + 1):
        assert verdict_unrolled(both, word) == all(verdict_of_word(x, word) for x in cut)


def test_labels_that_do_not_occur_and_states_that_cannot_accept_are_pruned() -> None:
    """A ring of 10: symbol 0 waits, 1 advances, 2 jumps to a part of 90 states from which nothing is accepted."""
    delta = np.tile(np.arange(100)[:, None], (1, 3))
    delta[:10, 1] = (np.arange(10) + 1) % 10
    delta[:10, 2] = 10
    delta[10:, 1] = np.minimum(np.arange(10, 100) + 1, 99)
    ring = FiniteAutomaton(delta, 0, accepting=4)
    everything = len(delta) * 21
    ticked = ring.unrolled(20)
    # Layers 0 to 19 of states 0 to 3; state k not before tick k - 1, and with the way left before the horizon.
    live = sum(1 for t in range(20) for k in range(4) if k <= t + 1 and 20 - t >= 4 - k)
    assert ticked.states == live + 3 < everything / 20
    assert ring.unrolled(20, labels=[1]).states == 3 + 3  # it can only march
    assert ring.unrolled(20, first_labels=[1]).states == ticked.states - 17  # state 0 is left at once, for good
    hopeless = FiniteAutomaton(delta, 50, accepting=4)
    assert hopeless.unrolled(20).states == 3


def test_branches_and_references_follow_their_states() -> None:
    branch = np.full((3, 2), NO_BRANCH)
    branch[0, 1] = 0
    automaton = FiniteAutomaton([[0, 1], [1, 2], [2, 2]], 0, accepting=2, branch=branch)
    ticked = automaton.unrolled(4)
    taken = ticked.branch == 0
    assert set(ticked.location[np.nonzero(taken)[0]]) == {0}
    assert (ticked.delta[taken] != ticked.rejecting).all()
    which = automaton.of_states([0, 1, 0], ticked.location, "reference_of")
    assert (which[ticked.location == 1] == 1).all() and not which[ticked.location != 1].any()


@pytest.mark.parametrize(
    ("settings_", "says"),
    [
        ({"delta": [[0, 2], [1, 1]]}, r"entries in 0..2, must lie in 0..1"),
        ({"delta": [0, 1]}, r"must be \[Q, L\] integers"),
        ({"delta": [[0.5, 1.0], [1.0, 1.0]]}, "integers, got float64"),
        ({"initial": 5}, "initial is 5, must be a state in 0..1"),
        ({"accepting": 2}, "accepting holds 2, must be states in 0..1"),
        ({"accepting": ()}, "accepting is empty"),
        ({"accepting": 1, "rejecting": 1}, "state 1 is both"),
        ({"accepting": 0}, "done before anything is read"),
        ({"accept": "sometimes"}, "accept is 'sometimes'"),
        ({"branch": [[0, 0]]}, r"branch must be \[2, 2\]"),
    ],
)
def test_bad_tables(settings_: dict[str, object], says: str) -> None:
    good: dict[str, object] = {"delta": [[0, 1], [1, 1]], "initial": 0, "accepting": 1}
    with pytest.raises(ValueError, match=says):
        FiniteAutomaton(**(good | settings_))  # type: ignore[arg-type]


def test_bad_calls() -> None:
    automaton = FiniteAutomaton([[0, 1], [1, 1]], 0, 1)
    with pytest.raises(ValueError, match="horizon_ticks is -1"):
        automaton.unrolled(-1)
    with pytest.raises(ValueError, match=r"set of symbols in 0..1"):
        automaton.unrolled(3, labels=[2])
    with pytest.raises(ValueError, match=r"reference_of has shape \(3,\), must be \[2\]"):
        automaton.of_states([0, 0, 0], automaton.unrolled(2).location, "reference_of")
    with pytest.raises(ValueError, match="different symbols"):
        conjunction(automaton.unrolled(3), FiniteAutomaton([[0], [1]], 0, 1).unrolled(3))
    with pytest.raises(ValueError, match="at least one"):
        conjunction()


WORLD = Scenario(
    "three",
    (Checkpoint("Checkpoint A", 0.5, 0.5, 0.3), Checkpoint("Checkpoint B", 2.5, 0.5, 0.3), Checkpoint("Checkpoint C", 1.5, 2.5, 0.3)),
    Box(0, 0, 1, 1),
    Box(1, 1, 2, 2),
    step_seconds=1.0,
    control_hertz=10,
    horizon_seconds=12.0,
    adversary=Robot(0.05, 1.0),
)  # fmt: skip
PAIRS = [
    (Constraint("deadline", ("Checkpoint A",), seconds=6), Constraint("deadline", ("Checkpoint B",), seconds=9)),
    (Constraint("eventually", ("Checkpoint A", "Checkpoint B"), different=2, max_gap_seconds=5), Constraint("exact", ("Checkpoint C",), seconds=4)),
    (Constraint("deadline", ("Checkpoint C",), seconds=4, recurrences=2), Constraint("until", ("central zone",), seconds=5, avoid=True)),
    (Constraint("eventually", ("Checkpoint A",), restricted=("Checkpoint C",)), Constraint("eventually", ("Checkpoint C",))),
]  # fmt: skip


@pytest.mark.parametrize("pair", PAIRS, ids=range(len(PAIRS)))
def test_joint_missions_agree_with_a_monitor_for_each(pair: tuple[Constraint, Constraint]) -> None:
    """Random visits: complete when both monitors are, failed as soon as one is."""
    missions = [Mission((constraint,)) for constraint in pair]
    joint = compile_joint(missions, WORLD)
    assert len(joint.regions) <= sum(len(part.regions) for part in joint.parts)
    ticked = unroll(joint, 12)
    rng = np.random.default_rng(0)
    seen = {"completed": 0, "failed": 0, "active": 0}
    for _ in range(300):
        places = np.array([(0.5, 0.5), (2.5, 0.5), (1.5, 2.5), (0.2, 2.8)])
        points = places[rng.choice(4, 13, p=[0.1, 0.1, 0.1, 0.7])]
        monitors = [Monitor(mission, WORLD, 1.0) for mission in missions]
        symbols = ticked.symbols(joint.masks(points))
        q, expected = ticked.initial, "active"
        for t, point in enumerate(points):
            verdicts = [m.reset(point) if t == 0 else m.step(point) for m in monitors]
            q = int(ticked.delta[q, symbols[t]])
            if expected == "active":
                expected = (
                    "failed" if "failed" in verdicts else "completed" if set(verdicts) == {"completed"} else "active"
                )
            assert {ticked.accepting: "completed", ticked.rejecting: "failed"}.get(q, "active") == expected
        seen[expected] += 1
    assert seen["completed"] >= 3 and seen["failed"] >= 3, seen


def test_joint_speed_limits_and_branches() -> None:
    slow = Mission((Constraint("eventually", ("Checkpoint A",), speed_limit=0.4),))
    slower = Mission(
        (Constraint("eventually", ("Checkpoint B",), speed_limit=0.2), Constraint("eventually", ("Checkpoint A",)))
    )
    joint = compile_joint([slow, slower], WORLD)
    assert joint.branch_places == ("Checkpoint A", "Checkpoint B", "Checkpoint A (mission 2)")
    ticked = unroll(joint, 8)
    assert ticked.sides == (0, 1, 1)
    for q in range(ticked.states - 2):
        parts = [unroll(part, 8) for part in joint.parts]
        assert ticked.speed_limit[q] in {0.2, 0.4, np.inf}
    a_then_b = [int(joint.masks([[0.5, 0.5]])[0]), int(joint.masks([[2.5, 0.5]])[0])]
    q = ticked.initial
    limits = []
    for mask in a_then_b:
        q = int(ticked.delta[q, ticked.symbols([mask])[0]])
        limits.append(ticked.speed_limit[q])
    assert limits == [0.2, np.inf]  # A done: the slower limit holds until B is
    assert len(parts) == 2
    with pytest.raises(ValueError, match="at least one"):
        compile_joint([], WORLD)


def test_joint_missions_with_too_many_regions() -> None:
    places = [tuple(((x + 0.5) / 5, (y + 0.5) / 5) for x in range(10)) for y in range(4)]
    missions = [Mission((Constraint("eventually", row),)) for row in places]
    with pytest.raises(ValueError, match="40 distinct regions, at most 31"):
        compile_joint(missions, WORLD)


def test_missions_without_a_bound_are_refused_with_their_size() -> None:
    endless = compile_mission(Mission((Constraint("eventually", ("Checkpoint A",)),)), WORLD)
    with pytest.raises(AutomatonTooLarge, match=r"no bound .* 104 states for a horizon of 100 ticks, 204 for 200"):
        unroll(endless, None)
    bounded = compile_mission(Mission((Constraint("deadline", ("Checkpoint A",), seconds=7),)), WORLD)
    assert unroll(bounded, None).states == unroll(bounded, 100).states == 7 + 1 + 1 + 2


def test_too_many_states_are_refused_with_their_number(monkeypatch: pytest.MonkeyPatch) -> None:
    import sys

    module = sys.modules[unroll_module.__module__]
    gaps = Constraint("eventually", ("Checkpoint A", "Checkpoint B", "Checkpoint C"), different=3, max_gap_seconds=50)
    compiled = compile_mission(Mission((gaps,)), WORLD)
    real = unroll(compiled, 60).states
    monkeypatch.setattr(module, "MOST_STATES", 300)
    with pytest.raises(
        AutomatonTooLarge, match=r"more than 300 states, and up to ([\d,]+): its clocks run to"
    ) as refused:
        unroll(compiled, 60)
    at_most = int(str(refused.value).split("up to ")[1].split(":")[0].replace(",", ""))
    assert real <= at_most + 2 <= 3 * real
    ring = FiniteAutomaton([[0, 1], [1, 2], [2, 0], [3, 3]], 0, 2)
    finite = sys.modules[FiniteAutomaton.__module__]
    monkeypatch.setattr(finite, "MOST_STATES", 50)
    with pytest.raises(AutomatonTooLarge, match=r"more than 50 states by tick \d+ and up to \d+ in all"):
        ring.unrolled(100)
    monkeypatch.setattr(finite, "MOST_LAYERED", 100)
    with pytest.raises(AutomatonTooLarge, match="may need 404, beyond the 100"):
        ring.unrolled(100)
    joint = sys.modules[conjunction.__module__]
    monkeypatch.setattr(finite, "MOST_STATES", 4_000_000)
    monkeypatch.setattr(finite, "MOST_LAYERED", 10**9)
    monkeypatch.setattr(joint, "MOST_STATES", 20)
    with pytest.raises(AutomatonTooLarge, match="product of automata of"):
        conjunction(ring.unrolled(30), ring.unrolled(30))


def test_a_mission_in_space_reads_as_english_and_means_the_same() -> None:
    from tab_marl.mission import parse_mission, to_english

    volume = Volume(
        "tank",
        (BallCheckpoint("Ball 1", 2, 8, 1, 0.6), BallCheckpoint("Ball 2", 8, 8, 4, 0.6)),
        Cuboid(1, 1, 1, 2, 2, 2),
        regions=(("kelp", Cuboid(4, 6, 0, 6, 9, 2)),),
    )
    mission = parse_mission("Reach Ball 1 then Ball 2 within 20 s while avoiding the central ball", volume)
    assert [c.places for c in mission.constraints] == [("Ball 1",), ("Ball 2",), ("central zone",)]
    assert parse_mission(to_english(mission, volume), volume) == mission
    automaton = compile_mission(mission, volume)
    assert automaton.regions == (Ball(2, 8, 1, 0.6), Ball(8, 8, 4, 0.6), Ball(5, 5, 2.5, 1.0))
    path = [(1.5, 1.5, 1.5), (2, 8, 1.2), (5, 8, 2), (8, 8, 4)]
    assert automaton.run(automaton.masks(path)).location == -1
    assert automaton.run(automaton.masks([*path[:2], (5, 5, 2), path[3]])).location == -2
    monitor = Monitor(mission, volume, 0.5)
    monitor.reset(path[0])
    assert [monitor.step(p) for p in path[1:]] == ["active", "active", "completed"]
    with pytest.raises(ValueError, match="name a region"):
        compile_mission(Mission((Constraint("eventually", ((1.0, 2.0),)),)), volume)
    recurring = compile_mission(Mission((Constraint("deadline", ("kelp",), seconds=9, recurrences=2),)), volume)
    assert recurring.regions[1] == Cuboid(3.5, 5.5, -0.5, 6.5, 9.5, 2.5)
