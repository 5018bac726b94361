"""The field against the enumeration of every trajectory: each constraint type, each reference, each repair."""

from __future__ import annotations

import numpy as np
import pytest

from tab_marl.field import FieldOptions, FieldProblem, ProductBelief, solve
from tab_marl.mission import Constraint, Mission
from tab_marl.world.regions import Box

HORIZON = 5
MISSIONS = {
    "deadline": Mission((Constraint("deadline", ("Checkpoint A",), seconds=4),)),
    "exact": Mission((Constraint("exact", ("Checkpoint A",), seconds=4),)),
    "until": Mission((Constraint("until", ("central zone",), seconds=3, avoid=True), Constraint("eventually", ("Checkpoint B",)))),
    "eventually": Mission((Constraint("eventually", ("Checkpoint C",)),)),
    "always": Mission((Constraint("always", ("central zone",), avoid=True), Constraint("deadline", ("Checkpoint A",), seconds=5))),
    "sequence": Mission((Constraint("deadline", ("Checkpoint C",), seconds=4), Constraint("deadline", ("Checkpoint B",), seconds=5))),
    "recurrence": Mission((Constraint("deadline", ("Checkpoint A", "central zone"), seconds=3, recurrences=2),)),
    "two of three": Mission(
        (Constraint("eventually", ("Checkpoint A", "Checkpoint B", "Checkpoint C"), different=2, max_gap_seconds=4),)
    ),
    "slow stage": Mission(
        (Constraint("eventually", ("central zone",), speed_limit=0.5), Constraint("eventually", ("Checkpoint A",)))
    ),
}  # fmt: skip
REFERENCES = {
    "paper_walk": {"reference": "paper_walk"},
    "walk": {"reference": "walk"},
    "run_and_tumble": {"reference": "run_and_tumble", "headings": 4, "mean_run_metres": 2.0},
    "turning first": {"reference": "run_and_tumble", "headings": 4, "mean_run_metres": 2.0, "begins_at_rest": True},
}


def problem_of(mission, scenario, reference, **options):
    settings = {
        "cell_metres": 1.0,
        "goal_marginals": False,
        "precision": "double",
        "marginal_tolerance": 1e-14,
    } | options
    return FieldProblem.from_mission(mission, scenario, FieldOptions(**(REFERENCES[reference] | settings)))


def agree(field, every, law, horizon=HORIZON):
    """Log-partition aside, everything a law says: marginals, completion, visits, divergence."""
    cells = field.chain.cells
    np.testing.assert_allclose(field.occupancy, every.occupancy(law, cells), rtol=0, atol=1e-12)
    done = np.array(
        [(law * ((every.completed_tick >= 0) & (every.completed_tick <= t))).sum() for t in range(horizon + 1)]
    )
    np.testing.assert_allclose(field.completion_probability, done, rtol=0, atol=1e-12)
    np.testing.assert_allclose(list(field.branch_visits.values()), law @ every.visits, rtol=0, atol=1e-12)


# At half a cell a tick the paper's walk, which rounds reach down to whole cells, cannot move at all.
ALONE = [(n, r) for n in MISSIONS for r in REFERENCES if (n, r) != ("slow stage", "paper_walk")]


@pytest.mark.parametrize(("name", "reference"), ALONE)
def test_mission_alone(name, reference, oracle, tiny_scenario):
    enumerate_trajectories, mission_runner = oracle
    speed = 0.7 if reference == "run_and_tumble" and name in ("deadline", "exact") else 1.0
    start = Box(0, 0, 1, 1) if reference == "run_and_tumble" else Box(0, 0, 2, 1)
    scenario = tiny_scenario(speed, adversary_start=start)
    problem = problem_of(MISSIONS[name], scenario, reference)
    every = enumerate_trajectories(problem, HORIZON, mission_runner(MISSIONS[name], scenario, problem.grid))
    completing = every.completed_tick >= 0
    assert 0 < completing.sum() < len(completing)
    law = every.tilted(np.where(completing, 0.0, -np.inf))
    field = solve(problem)
    agree(field, every, law)
    by_start = [np.log(every.reference[completing & (every.cells[:, 0] == c)].sum() / problem.start[c]) * problem.start[c]
                for c in np.flatnonzero(problem.start)]  # fmt: skip
    assert field.log_partition == pytest.approx(sum(by_start), abs=1e-12)
    assert field.kl_to_reference == pytest.approx(every.divergence(law), abs=1e-12)
    assert field.completes == pytest.approx(1, abs=1e-12)


# Bounds of 4 ticks: every trajectory of 5 ticks has completed or failed.
FAILING = {
    "deadline": MISSIONS["deadline"],
    "sequence": Mission(
        (Constraint("deadline", ("Checkpoint C",), seconds=3), Constraint("deadline", ("Checkpoint B",), seconds=4))
    ),
    "always": Mission(
        (Constraint("always", ("central zone",), avoid=True), Constraint("deadline", ("Checkpoint A",), seconds=4))
    ),
}


@pytest.mark.parametrize("reference", REFERENCES)
@pytest.mark.parametrize("name", FAILING)
def test_completes_with_probability_c(name, reference, oracle, tiny_scenario):
    enumerate_trajectories, mission_runner = oracle
    scenario = tiny_scenario()
    mission = FAILING[name]
    problem = problem_of(mission, scenario, reference, completion_probability=0.7)
    every = enumerate_trajectories(problem, HORIZON, mission_runner(mission, scenario, problem.grid))
    completed = every.completed_tick >= 0
    assert (completed | every.failed).all()
    law = every.fit(completed[:, None].astype(float), np.array([0.7]), np.ones(len(completed), dtype=bool))
    field = solve(problem)
    assert field.completes == pytest.approx(0.7, abs=1e-12)
    agree(field, every, law)
    assert field.kl_to_reference == pytest.approx(every.divergence(law), abs=1e-11)


@pytest.mark.parametrize("reference", REFERENCES)
@pytest.mark.parametrize("name", ["any of three", "two of three", "recurrence"])
@pytest.mark.parametrize("equality", [1.0, 0.4])
def test_goal_marginals(equality, name, reference, oracle, tiny_scenario):
    missions = MISSIONS | {
        "any of three": Mission((Constraint("deadline", ("Checkpoint A", "Checkpoint B", "Checkpoint C"), seconds=5),))
    }
    enumerate_trajectories, mission_runner = oracle
    scenario = tiny_scenario()
    problem = problem_of(missions[name], scenario, reference, goal_marginals=equality)
    every = enumerate_trajectories(problem, HORIZON, mission_runner(missions[name], scenario, problem.grid))
    completed = every.completed_tick >= 0
    before = every.tilted(np.where(completed, 0.0, -np.inf)) @ every.visits
    target = equality * before.mean() + (1 - equality) * before
    assert np.abs(before - target).max() > 1e-3
    law = every.fit(every.visits[:, 1:], target[1:], completed)
    field = solve(problem)
    np.testing.assert_allclose(list(field.branch_visits.values()), target, atol=1e-12)
    agree(field, every, law)
    assert field.kl_to_reference == pytest.approx(every.divergence(law), abs=1e-11)


@pytest.mark.parametrize("reference", REFERENCES)
def test_nearer_goals_are_likelier(reference, oracle, tiny_scenario):
    enumerate_trajectories, mission_runner = oracle
    scenario = tiny_scenario()
    places = ("Checkpoint A", "Checkpoint B", "Checkpoint C")
    mission = Mission((Constraint("deadline", places, seconds=5),))
    problem = problem_of(mission, scenario, reference, goal_marginals=0.8, goal_nearness=2.0)
    every = enumerate_trajectories(problem, HORIZON, mission_runner(mission, scenario, problem.grid))
    completed = every.completed_tick >= 0
    before = every.tilted(np.where(completed, 0.0, -np.inf)) @ every.visits
    grid, start = problem.grid, problem.start
    metres = np.array([start @ grid.distances(np.flatnonzero(grid.inside(scenario.region(p)))) for p in places])
    wanted = np.exp(-2.0 * (metres / metres.min() - 1))
    target = 0.8 * wanted / wanted.sum() + 0.2 * before
    assert np.ptp(target) > 0.1
    law = every.fit(every.visits[:, 1:], target[1:], completed)
    agree(solve(problem), every, law)


@pytest.mark.parametrize("reference", REFERENCES)
def test_timing_prior(reference, oracle, tiny_scenario):
    enumerate_trajectories, mission_runner = oracle
    scenario = tiny_scenario()
    mission = Mission((Constraint("deadline", ("Checkpoint C",), seconds=5),))
    problem = problem_of(mission, scenario, reference, timing_prior=True)
    every = enumerate_trajectories(problem, HORIZON, mission_runner(mission, scenario, problem.grid))
    first = problem.earliest_tick[problem.start > 0].min()
    assert first == 2
    ticks = np.arange(first, HORIZON + 1)
    allowed = every.completed_tick >= first
    features = (every.completed_tick[:, None] == ticks).astype(float)
    # Each start cell brings a uniform share over its own feasible ticks.
    earliest = problem.earliest_tick[problem.start > 0]
    uniform = np.mean([(ticks >= e) / (HORIZON + 1 - e) for e in earliest], axis=0)
    law = every.fit(features[:, 1:], uniform[1:], allowed)
    field = solve(problem)
    agree(field, every, law)
    np.testing.assert_allclose(np.diff(field.completion_probability)[first - 1 :], uniform, atol=1e-12)
    assert field.kl_to_reference == pytest.approx(every.divergence(law), abs=1e-11)


def test_everything_at_once(oracle, tiny_scenario):
    enumerate_trajectories, mission_runner = oracle
    scenario = tiny_scenario()
    mission = Mission((Constraint("deadline", ("Checkpoint A", "Checkpoint C"), seconds=4),))
    problem = problem_of(mission, scenario, "walk", goal_marginals=True, timing_prior=True, completion_probability=0.8)
    every = enumerate_trajectories(problem, HORIZON, mission_runner(mission, scenario, problem.grid))
    earliest = problem.earliest_tick[problem.start > 0]
    ticks = np.arange(earliest.min(), 5)
    completed = every.completed_tick >= earliest.min()
    features = np.column_stack([completed[:, None] * every.visits[:, :1], every.completed_tick[:, None] == ticks])
    uniform = np.mean([(ticks >= e) / (5 - e) for e in earliest], axis=0)
    targets = np.append(0.4, 0.8 * uniform)
    law = every.fit(features.astype(float), targets, completed | every.failed)
    field = solve(problem)
    agree(field, every, law)
    assert field.kl_to_reference == pytest.approx(every.divergence(law), abs=1e-11)


def test_sinkhorn_reaches_the_same_timing(oracle, tiny_scenario):
    """The timing prior is a bridge between two marginals, start cell and completion tick: plain Sinkhorn on the matrix."""
    enumerate_trajectories, mission_runner = oracle
    scenario = tiny_scenario(adversary_start=Box(0, 0, 3, 2))
    mission = Mission((Constraint("deadline", ("Checkpoint A",), seconds=5),))
    problem = problem_of(mission, scenario, "paper_walk", timing_prior=True)
    every = enumerate_trajectories(problem, HORIZON, mission_runner(mission, scenario, problem.grid))
    cells = np.flatnonzero(problem.start)
    earliest = problem.earliest_tick[cells]
    assert len(set(earliest)) > 1
    ticks = np.arange(earliest.min(), HORIZON + 1)
    uniform = np.mean([(ticks >= e) / (HORIZON + 1 - e) for e in earliest], axis=0)
    joint = np.array(
        [[every.reference[(every.cells[:, 0] == c) & (every.completed_tick == t)].sum() for t in ticks] for c in cells]
    )
    for _ in range(3000):
        joint *= (problem.start[cells] / joint.sum(axis=1))[:, None]
        joint *= uniform / joint.sum(axis=0)
    field = solve(problem)
    for row, cell in zip(joint, cells, strict=True):
        alone = np.zeros(problem.grid.cells)
        alone[cell] = 1.0
        belief = ProductBelief(field.chain._replace(start=alone))
        done = []
        for _ in range(HORIZON):
            belief.predict()
            done.append(belief.completed)
        share = np.diff(np.append(0.0, done))[ticks[0] - 1 :]
        np.testing.assert_allclose(share, row / row.sum(), atol=1e-9)
