"""Impossible missions say why with numbers; missions that a robot did complete are never called impossible."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from mission_oracle import NEUTRAL, random_mission, region_of
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import dijkstra

from tab_marl.mission.feasibility import check_feasible
from tab_marl.mission.feasibility_kernels import arrivals
from tab_marl.mission.impossible import InfeasibleMission
from tab_marl.mission.library import MISSIONS
from tab_marl.mission.model import Constraint, ConstraintType, Mission
from tab_marl.mission.monitor import Monitor
from tab_marl.mission.parse import parse_mission
from tab_marl.world.grid import BLOCKED, GridMap
from tab_marl.world.kernels import MOVES, free_move
from tab_marl.world.regions import Box, Disc
from tab_marl.world.scenario import Scenario

LAB = Scenario.preset("lab")
OPEN = Scenario.preset("open")
SPEED = OPEN.adversary.max_speed


def why(text, scenario=LAB, start=None):
    mission = parse_mission(text, scenario) if isinstance(text, str) else text
    with pytest.raises(InfeasibleMission) as caught:
        check_feasible(mission, scenario, start)
    return str(caught.value).removeprefix("the mission is impossible: ")


def numbers(sentence):
    """(needs, allows) of a sentence."""
    needs = float(sentence.split("needs ")[1].split(" s")[0])
    allows = float(sentence.split("allows ")[1].split(" s")[0])
    return needs, allows


def test_too_little_time_gives_both_numbers():
    start = (2.5, 2.45)
    sentence = why("Reach Checkpoint A within 5s", OPEN, start)
    assert sentence.startswith("Checkpoint A needs ")
    assert sentence.endswith(" s from the start at 0.22 m/s, the mission allows 5 s")
    shortest = (math.dist(start, (0.5, 2.5)) - 0.18) / SPEED
    needs, allows = numbers(sentence)
    assert allows == 5.0
    assert shortest - 0.6 <= needs <= shortest


@pytest.mark.parametrize("share", [0.5, 0.8, 0.9])
def test_the_bound_is_tight_on_a_straight_way(share):
    start = (2.5, 2.5)
    shortest = (2.0 - 0.18) / SPEED
    possible = Mission((Constraint(ConstraintType.DEADLINE, ("Checkpoint A",), 1.1 * shortest),))
    assert check_feasible(possible, OPEN, start) <= shortest
    tight = Mission((Constraint(ConstraintType.DEADLINE, ("Checkpoint A",), share * shortest),))
    assert "Checkpoint A needs" in why(tight, OPEN, start)


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        (
            "Reach Checkpoint D while avoiding the center",
            "Checkpoint D lies inside the central zone, which the mission",
        ),
        (
            "Reach Checkpoint E, then Checkpoint B while staying in the left half",
            "Checkpoint B lies outside the left half, where the mission must stay",
        ),
        ("Reach [1.05, 2.05]", "[1.05, 2.05] has no free position: obstacles or walls cover it"),
        (
            "Reach Checkpoint A, then Checkpoint B without entering the left half",
            "every way to Checkpoint B from the goal before leads through the left half, which the mission forbids",
        ),
        (
            "Reach Checkpoint A in exactly 20s, then Checkpoint B within 15s",
            "contradictory times: Checkpoint A counts only from 18 s on, but must be done by 15 s",
        ),
        (
            "Reach Checkpoint B within 20s while avoiding Checkpoint B until 25s",
            "Checkpoint B is forbidden until 25 s, but must be reached by 20 s",
        ),
        ("Avoid the bottom half", "inside the bottom half, which the mission forbids"),
        ("Stay in the top half", "outside the top half, where the mission must stay"),
        ("Reach Checkpoint A no faster than 0.02 m/s", "from the start at 0.02 m/s, the episode ends at 60 s"),
        ("Reach Checkpoint A exactly every 20s four times", "Checkpoint A (visit 4 of 4) needs"),
        (MISSIONS["M2"], "the mission allows 5.5 s, for Checkpoint B must be done by then"),
    ],
)
def test_why_a_mission_is_impossible(text, sentence):
    assert sentence in why(text)


def test_a_gap_too_far():
    sentence = why("Reach Checkpoint A, then Checkpoint C, taking no more than 9s between checkpoints")
    assert sentence.startswith("Checkpoint C needs ")
    assert " after the previous goal at 0.22 m/s, the mission allows 9 s" in sentence
    needs, allows = numbers(sentence)
    assert needs > allows == 9.0
    straight = (math.dist((0.5, 2.5), (2.5, 0.55)) - 2 * 0.18) / SPEED
    assert needs > straight - 0.7
    visits = why("Visit any three different checkpoints, taking no more than 4s between checkpoints")
    assert "(visit 3 of 3) needs" in visits
    assert "after the previous visit" in visits


def test_walled_off():
    walls = (Box(0.0, 1.9, 1.2, 2.0), Box(1.1, 1.9, 1.2, 3.0))
    walled = replace(LAB, obstacles=(*LAB.obstacles, *walls))
    assert why("Reach Checkpoint A", walled) == (
        "obstacles wall off Checkpoint A: no free path leads there from the start"
    )
    assert check_feasible(parse_mission("Visit Checkpoint A or Checkpoint B", walled), walled) > 0


def test_beginning_inside_an_exact_goal():
    sentence = why("Reach Checkpoint E in exactly 8s", LAB, (0.9, 0.5))
    assert "begins inside Checkpoint E" in sentence
    assert "before the time window opens at 7.5 s" in sentence
    assert check_feasible(parse_mission("Reach Checkpoint E present at exactly 8s", LAB), LAB, (0.9, 0.5)) == 7.5


def test_waits_are_counted():
    text = "Reach Checkpoint E in exactly 10s, then Checkpoint C in exactly 10s after the previous goal"
    assert check_feasible(parse_mission(text, LAB), LAB) == pytest.approx(9.0 + 9.0)
    too_soon = why(text + ", then Checkpoint B within 15s")
    assert "Checkpoint C needs 18.0 s from the start" in too_soon
    assert "the mission allows 15 s, for Checkpoint B must be done by then" in too_soon


def test_some_start_is_enough():
    mission = parse_mission("Reach Checkpoint A within 4s", OPEN)
    with pytest.raises(InfeasibleMission):
        check_feasible(mission, OPEN, (2.5, 0.5))
    assert check_feasible(mission, OPEN, [(2.5, 0.5), (0.5, 2.0)]) < 4
    assert check_feasible(mission, OPEN, Disc(0.6, 2.0, 0.2)) < 4


def drive(rng, mission, scenario, start, tick):
    """Positions of a robot that drives straight to goal after goal, dawdling a little; one per tick."""
    points = [np.array(start)]
    for goal in mission.goals:
        for visit in range(goal.visits):
            stops = [region_of(goal.places[visit % len(goal.places)], scenario).centre]
            if goal.recurrences > 1 and goal.different == 1:
                stops.append(NEUTRAL)
            if goal.type is ConstraintType.EXACT and rng.random() < 0.8:
                since = len(points) - 1 if goal.since == "previous" or goal.recurrences > 1 else 0
                away = max(0.0, math.dist(points[-1], stops[0]) - 0.18) / SPEED
                arrival = since + (goal.seconds - away) / tick
                points += [points[-1]] * max(0, round(arrival) - len(points) + 1)
            for stop in stops:
                points += [points[-1]] * int(rng.integers(0, 3) * (rng.random() < 0.2))
                legs = max(1, math.ceil(math.dist(points[-1], stop) / (SPEED * tick)))
                begin = points[-1]
                points += [begin + (np.array(stop) - begin) * (i + 1) / legs for i in range(legs)]
    return points


def test_what_a_robot_completes_is_never_called_impossible():
    scenario = replace(OPEN, horizon_seconds=90.0)
    rng = np.random.default_rng(3)
    completed = 0
    for _ in range(250):
        mission = random_mission(rng, str(rng.choice(["mixed", "deadline_chain", "recurrence_any", "max_gap"])))
        if mission.beside and mission.beside[0].speed_limit is not None:
            continue
        mission = Mission(tuple(replace(c, speed_limit=None) if c.places else c for c in mission.constraints))
        # Give more time than drawn, so that many can be completed.
        mission = Mission(
            tuple(
                replace(c, seconds=c.seconds and 3 * c.seconds, max_gap_seconds=c.max_gap_seconds and 12.0)
                if c.type.is_goal
                else c
                for c in mission.constraints
            )
        )
        start = rng.uniform(0.2, 2.8, size=2)
        monitor = Monitor(mission, scenario, scenario.step_seconds)
        points = drive(rng, mission, scenario, start, scenario.step_seconds)
        ticks = 0
        for ticks, point in enumerate(points):
            status = monitor.step(point) if ticks else monitor.reset(point)
            if status != "active":
                break
        if monitor.status == "completed" and ticks * scenario.step_seconds <= scenario.horizon_seconds:
            completed += 1
            least = check_feasible(mission, scenario, start, cell_metres=0.1)
            assert least <= ticks * scenario.step_seconds + 1e-9
    assert completed >= 40


def test_arrivals_against_scipy():
    grid = GridMap.from_scenario(LAB, 0.15)
    rng = np.random.default_rng(0)
    passable = rng.random(grid.cells) < 0.8
    offset = np.where(rng.random(grid.cells) < 0.02, rng.uniform(0, 10, grid.cells), np.inf)
    rows, columns, lengths = [], [], []
    for s in range(grid.cells):
        if not (passable[s] or np.isfinite(offset[s])):
            continue
        for dr, dc in MOVES:
            if free_move(grid.cell_at, grid.row[s], grid.column[s], dr, dc):
                other = grid.cell_at[grid.row[s] + dr, grid.column[s] + dc]
                assert other != BLOCKED
                rows.append(s)
                columns.append(other)
                lengths.append(math.hypot(dr, dc))
    source = grid.cells  # one more node, with the head starts as edges
    for s in np.flatnonzero(np.isfinite(offset)):
        rows.append(source)
        columns.append(s)
        lengths.append(offset[s])
    graph = coo_matrix((lengths, (rows, columns)), shape=(source + 1, source + 1)).tocsr()
    expected = dijkstra(graph, indices=source)[:source]
    found = arrivals(grid.cell_at, grid.row, grid.column, offset, passable)
    np.testing.assert_allclose(found, expected, rtol=1e-12)
