"""Compilation and unrolling: hand-made cases of each decision, sizes, the horizon, and the tables' laws."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from mission_oracle import KINDS, random_mission

from tab_marl.mission.automaton import COMPLETED, FAILED, NO_BRANCH
from tab_marl.mission.compile import compile_mission
from tab_marl.mission.model import Constraint, ConstraintType, Mission
from tab_marl.mission.parse import parse_mission
from tab_marl.mission.propositions import MOST_PROPOSITIONS, grown
from tab_marl.mission.unroll import UNTRACKED, unroll
from tab_marl.world.grid import GridMap
from tab_marl.world.regions import Box, Disc, Polygon
from tab_marl.world.scenario import Checkpoint, Scenario, UnknownName

OPEN = Scenario.preset("open")
LAB = Scenario.preset("lab")
A, B, D = (0.5, 2.5), (2.5, 2.45), (1.5, 1.5)
OUT = (0.3, 1.4)
NEAR_A = (0.5, 2.25)
"""Outside Checkpoint A, within `leave_metres` of it."""


def verdict(text_or_mission, points, scenario=OPEN, tick=0.5):
    """(status, tick) after reading the points."""
    mission = parse_mission(text_or_mission, scenario) if isinstance(text_or_mission, str) else text_or_mission
    automaton = compile_mission(mission, scenario, tick)
    for t in range(len(points)):
        state = automaton.run(automaton.masks(points[: t + 1]))
        if state.location in (COMPLETED, FAILED):
            return "completed" if state.location == COMPLETED else "failed", t
    return "active", None


@pytest.mark.parametrize(
    ("text", "points", "expected"),
    [
        # A deadline is met on its last tick, and missed on the next; being there at tick 0 counts.
        ("Reach Checkpoint A within 1s", [OUT, OUT, A], ("completed", 2)),
        ("Reach Checkpoint A within 1s", [OUT, OUT, OUT, A], ("failed", 3)),
        ("Reach Checkpoint A within 1s", [A], ("completed", 0)),
        # A bound between two ticks binds at the tick before it.
        ("Reach Checkpoint A within 1.4s", [OUT, OUT, OUT, A], ("failed", 3)),
        # Exact: first entry within +-0.5 s.
        ("Reach Checkpoint A in exactly 2s", [OUT, OUT, A], ("failed", 2)),
        ("Reach Checkpoint A in exactly 2s", [OUT, OUT, OUT, A], ("completed", 3)),
        ("Reach Checkpoint A in exactly 2s", [OUT] * 5 + [A], ("completed", 5)),
        ("Reach Checkpoint A in exactly 2s", [OUT] * 6 + [A], ("failed", 6)),
        ("Reach Checkpoint A present at exactly 2s", [A, A, A, A], ("completed", 3)),
        ("Reach Checkpoint A present at exactly 2s", [A] + [OUT] * 6, ("failed", 6)),
        # +-10 % where that is more.
        ("Reach Checkpoint A in exactly 10s", [OUT] * 18 + [A], ("completed", 18)),
        ("Reach Checkpoint A in exactly 10s", [OUT] * 17 + [A], ("failed", 17)),
        # Inside when the stage begins counts as an entry then, one tick later at the earliest.
        ("Reach the top left, then Checkpoint A in exactly 3s", [(0.5, 2.5), (0.5, 2.5)], ("failed", 1)),
        ("Reach the top left, then Checkpoint A within 3s", [(0.5, 2.5), (0.5, 2.5)], ("completed", 1)),
        # A later goal's deadline fails the mission while an earlier goal is still current.
        ("Reach Checkpoint A, then Checkpoint B within 1s", [OUT] * 4, ("failed", 3)),
        # Recurrence: the next visit counts after leaving by leave_metres.
        ("Reach Checkpoint A every 5s twice", [A, NEAR_A, A, A, OUT, A], ("completed", 5)),
        ("Reach Checkpoint A every 1s twice", [A, OUT, OUT, OUT], ("failed", 3)),
        ("Reach Checkpoint A every 5s", [A, OUT, A, OUT, A], ("completed", 4)),
        # Two places of one recurrence: going from one to the other is leaving.
        ("Visit Checkpoint A or Checkpoint B every 5s twice", [A, B], ("completed", 1)),
        # Forbidden wins over progress at the same tick; until ends strictly before.
        ("Reach Checkpoint D while avoiding the center", [OUT, D], ("failed", 1)),
        ("Reach Checkpoint D while avoiding the center until 1s", [OUT, OUT, D], ("completed", 2)),
        ("Reach Checkpoint D while avoiding the center until 1.1s", [OUT, OUT, D], ("failed", 2)),
        ("Reach Checkpoint D while avoiding the center until reaching Checkpoint D", [OUT, D], ("completed", 1)),
        ("Reach Checkpoint B while staying in the left half until reaching Checkpoint B", [OUT, B], ("completed", 1)),
        (
            "Reach Checkpoint A while staying in the left half until reaching Checkpoint A",
            [OUT, B, A],
            ("failed", 1),
        ),
        # Restricted binds only while its goal is current.
        ("Reach Checkpoint A without entering the center, then Checkpoint D", [OUT, A, D], ("completed", 2)),
        ("Reach Checkpoint A without entering the center, then Checkpoint D", [OUT, D], ("failed", 1)),
        # k of n: the same place does not count twice, and room is kept for those to be included.
        ("Visit any two different checkpoints", [A, OUT, A, B], ("completed", 3)),
        ("Visit any two different checkpoints including Checkpoint D", [A, B, D], ("completed", 2)),
        ("Visit any two different checkpoints including Checkpoint D", [A, B, OUT, OUT], ("active", None)),
        # Gaps: from the start to the first visit, then from visit to visit.
        ("Visit any two different checkpoints, taking no more than 1s between checkpoints", [OUT] * 4, ("failed", 3)),
        (
            "Visit any two different checkpoints, taking no more than 1s between checkpoints",
            [OUT, OUT, A, OUT, B],
            ("completed", 4),
        ),
    ],
)
def test_decisions_by_hand(text, points, expected):
    assert verdict(text, points) == expected


def test_a_mission_without_goals_completes_at_the_horizon():
    scenario = replace(OPEN, horizon_seconds=2.0)
    assert verdict("Avoid the center", [OUT] * 8, scenario) == ("completed", 4)
    assert verdict("Avoid the center", [OUT, OUT, D], scenario) == ("failed", 2)
    assert verdict("Avoid the center until 1s", [OUT, OUT, D], scenario) == ("completed", 2)
    assert verdict("Never go faster than 0.1 m/s", [OUT] * 8, scenario) == ("completed", 4)


def test_m5_has_one_location_per_set_of_visited_checkpoints():
    automaton = compile_mission(
        parse_mission(
            "Reach [1.2, 2.4] after visiting any three different checkpoints, taking no more than 10s between "
            "checkpoints, while avoiding the center",
            LAB,
        ),
        LAB,
    )
    assert automaton.locations == 1 + 5 + 10 + 1
    assert automaton.branch_places == (*(f"Checkpoint {c}" for c in "ABCDE"), "[1.2, 2.4]")
    masks = automaton.masks(GridMap.from_scenario(LAB, 0.05).centres)
    unrolled = unroll(automaton, LAB.horizon_ticks, masks)
    # Only the visit clock matters: its four runs of 20 ticks end within the horizon of 120.
    assert (unrolled.mission_ticks == UNTRACKED).all()
    # Checkpoint D lies in the zone, so sets of the other four (1 + 4 + 6) and the last leg, ticks 0..20 each; the
    # state before tick 0 and the two absorbing ones.
    assert unrolled.states == (1 + 4 + 6 + 1) * 21 + 3
    assert unrolled.stage_ticks.max() == 20


def test_regions_of_the_same_shape_share_a_bit():
    mission = parse_mission("Reach Checkpoint A, then Checkpoint B, then Checkpoint A", OPEN)
    assert len(compile_mission(mission, OPEN).regions) == 2


def test_too_many_regions_are_refused_with_their_number():
    checkpoints = tuple(Checkpoint(f"Checkpoint {i}", 0.2 + 0.2 * i, 1.0, 0.05) for i in range(13))
    scenario = replace(OPEN, checkpoints=checkpoints)
    mission = Mission((Constraint(ConstraintType.EVENTUALLY, tuple(c.name for c in checkpoints)),))
    with pytest.raises(ValueError, match=f"more than {MOST_PROPOSITIONS} distinct regions"):
        compile_mission(mission, scenario)


def test_compile_refuses_what_it_cannot_mean():
    with pytest.raises(UnknownName, match="did you mean 'Checkpoint A'"):
        compile_mission(Mission((Constraint(ConstraintType.EVENTUALLY, ("Checkpiont A",)),)), OPEN)
    with pytest.raises(ValueError, match=r"target \[4, 1\] lies outside the 3.0 x 3.0 m arena"):
        compile_mission(Mission((Constraint(ConstraintType.EVENTUALLY, ((4.0, 1.0),)),)), OPEN)
    with pytest.raises(ValueError, match=r"no tick of 5 s lies in \[6.3, 7.7\] s"):
        compile_mission(Mission((Constraint(ConstraintType.EXACT, ("Checkpoint A",), 7.0),)), OPEN, 5.0)
    with pytest.raises(ValueError, match=r"tick_seconds is 0\.0, must be"):
        compile_mission(Mission((Constraint(ConstraintType.EVENTUALLY, ("Checkpoint A",)),)), OPEN, 0.0)
    presence = Constraint(ConstraintType.EXACT, ("Checkpoint A",), 7.0, presence=True, since="previous")
    until = Constraint(ConstraintType.UNTIL, ("left half",), until_goal=0)
    with pytest.raises(ValueError, match="has no fixed end"):
        compile_mission(Mission((presence, until)), OPEN)


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"type": "deadline", "places": ("A",)}, "seconds is None, must be given"),
        ({"type": "eventually", "places": ("A",), "seconds": 5.0}, "eventually has no bound"),
        ({"type": "eventually"}, "must name at least one place"),
        ({"type": "eventually", "places": ("A", "A")}, "must not repeat a place"),
        ({"type": "eventually", "places": ("A",), "avoid": True}, "only always and until can avoid"),
        ({"type": "eventually", "places": ("A",), "different": 2}, "must be <= the number of places, 1"),
        ({"type": "deadline", "places": ("A", "B"), "seconds": 5.0, "recurrences": 3, "different": 2}, "must be 1 or"),
        ({"type": "deadline", "places": ("A",), "seconds": float("nan")}, "seconds is nan, must be a finite number"),
        ({"type": "deadline", "places": ("A",), "seconds": 5.0, "presence": True}, "only exact without recurrence"),
        ({"type": "always", "places": ("A",), "seconds": 5.0}, "always never ends"),
        ({"type": "always", "places": ("A",), "speed_limit": 0.1}, "of its own, without places"),
        ({"type": "until", "places": ("A",)}, "exactly one of seconds and until_goal"),
        ({"type": "until", "places": ("A",), "seconds": 5.0, "recurrences": 2}, "only goals"),
        ({"type": "eventually", "places": ((1.0, float("inf")),)}, "must be region names or finite"),
    ],
)
def test_a_constraint_checks_itself(fields, message):
    with pytest.raises(ValueError, match=message):
        Constraint(**fields)


def test_a_mission_checks_itself():
    goal = Constraint(ConstraintType.EVENTUALLY, ("Checkpoint A",))
    until = Constraint(ConstraintType.UNTIL, ("left half",), until_goal=1)
    with pytest.raises(ValueError, match=r"constraints\[1\].until_goal is 1, must be the index of a goal"):
        Mission((goal, until))
    with pytest.raises(ValueError, match="is empty"):
        Mission(())


@pytest.mark.parametrize("region", [Disc(1.0, 2.0, 0.3), Box(0.5, 0.5, 1.0, 2.0), Polygon(((0, 0), (2, 0), (1, 1)))])
def test_grown_regions_hold_all_points_that_near(region):
    points = np.random.default_rng(0).uniform(-1, 3, size=(4000, 2))
    near = region.distance(points) <= 0.15
    far = region.distance(points) > 0.15 * 3  # corners stay corners: the sharpest here reaches 0.15 / sin(22.5 deg)
    inside = grown(region, 0.15).contains(points)
    assert inside[near].all()
    assert not inside[far].any()
    if isinstance(region, Disc):
        assert np.array_equal(inside, near)


@pytest.mark.parametrize("kind", KINDS)
def test_laws_of_the_unrolled_automaton(kind):
    rng = np.random.default_rng(KINDS.index(kind))
    for _ in range(6):
        automaton = compile_mission(random_mission(rng, kind), OPEN)
        masks = automaton.masks(rng.uniform(0, 3, size=(300, 2)))
        horizon = int(rng.integers(0, 60))
        unrolled = unroll(automaton, horizon, masks)
        transient = np.arange(unrolled.states) < unrolled.accepting
        # Acyclic: rank rises along every transition between transient states.
        for state in np.flatnonzero(transient):
            following = unrolled.delta[state][unrolled.delta[state] < unrolled.accepting]
            assert (unrolled.rank[following] > unrolled.rank[state]).all()
        for absorbing in (unrolled.accepting, unrolled.rejecting):
            assert (unrolled.delta[absorbing] == absorbing).all()
        # A branch is given exactly where a visit was counted.
        visited = unrolled.branch != NO_BRANCH
        assert visited[: unrolled.accepting][unrolled.delta[: unrolled.accepting] == unrolled.accepting].all() or (
            automaton.goal[0] == -1
        )
        assert not visited[unrolled.delta == unrolled.rejecting].any()
        # However long it goes on, it is over by the tick after the horizon, and a trajectory's end is the automaton's.
        for _ in range(20):
            symbols = rng.integers(len(unrolled.masks), size=horizon + 2)
            state, reference = unrolled.initial, None
            for t, symbol in enumerate(symbols):
                state = unrolled.delta[state, symbol]
                reference = (
                    automaton.first(unrolled.masks[symbol])
                    if reference is None
                    else automaton.advance(reference, unrolled.masks[symbol])
                )
                if t <= horizon:
                    expected = {COMPLETED: unrolled.accepting, FAILED: unrolled.rejecting}.get(reference.location)
                    if expected is None:
                        assert unrolled.location[state] == reference.location
                        assert unrolled.speed_limit[state] == automaton.speed_limit[reference.location]
                    else:
                        assert state == expected
            assert state in (unrolled.accepting, unrolled.rejecting)


def test_unroll_refuses_labels_it_was_not_given():
    automaton = compile_mission(parse_mission("Reach Checkpoint A, then Checkpoint B", OPEN), OPEN)
    unrolled = unroll(automaton, 10, [0, 1])
    assert unrolled.symbols([1, 0, 1]).tolist() == [1, 0, 1]
    with pytest.raises(ValueError, match=r"labels \[2\] were not among those unrolled \(\[0, 1\]\)"):
        unrolled.symbols([0, 2])
    with pytest.raises(ValueError, match="masks must be a non-empty set"):
        unroll(automaton, 10, [4])
    with pytest.raises(ValueError, match="horizon_ticks is -1"):
        unroll(automaton, -1)
