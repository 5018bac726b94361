"""Fields whose answer is known: a walk on a line, a rare event, a convex program."""

from __future__ import annotations

from math import comb, log

import numpy as np
import pytest
from scipy.optimize import minimize

from tab_marl.field import FieldOptions, FieldProblem, InfeasibleField, from_matrices, run_and_tumble, solve, walk
from tab_marl.field.constraints.tilt import Tilt, ticks_of
from tab_marl.mission import Constraint, Mission
from tab_marl.mission.unroll import TickAutomaton
from tab_marl.world.grid import GridMap
from tab_marl.world.scenario import Scenario


def reach_within(ticks: int) -> TickAutomaton:
    """Be at symbol 1 at some tick <= `ticks`; state t is "not yet, tick t - 1 has been read"."""
    count = ticks + 1
    accepting, rejecting = count, count + 1
    delta = np.array(
        [[t + 1 if t + 1 < count else rejecting, accepting] for t in range(count)] + [[accepting] * 2, [rejecting] * 2]
    )
    branch = np.full(delta.shape, -1)
    branch[:count, 1] = 0
    zeros = np.zeros(count + 2, dtype=np.int32)
    return TickAutomaton(
        delta.astype(np.int32), np.array([0, 1], dtype=np.int32), 0, accepting, rejecting,
        np.arange(count + 2, dtype=np.int32), zeros, branch.astype(np.int32), zeros, zeros,
        np.full(count + 2, np.inf), np.zeros((count + 2, 3), dtype=np.int32),
    )  # fmt: skip


def line_problem(cells: int, start: int, ticks: int, **options) -> FieldProblem:
    step = np.diag(np.full(cells - 1, 0.5), 1) + np.diag(np.full(cells - 1, 0.5), -1)
    labels = np.zeros(cells, dtype=int)
    labels[0] = 1
    return FieldProblem(
        step, labels, reach_within(ticks), np.eye(cells)[start], ticks, FieldOptions(precision="double", **options)
    )


@pytest.mark.parametrize(("start", "ticks"), [(1, 1), (3, 9), (5, 40), (2, 300)])
def test_first_passage_of_the_simple_walk_by_reflection(start, ticks):
    """P(hit 0 by tick T from x) = P(S_T >= x) + P(S_T > x), S the free walk (reflection principle)."""
    field = solve(line_problem(start + ticks + 1, start, ticks))
    weight = {2 * k - ticks: comb(ticks, k) / 2**ticks for k in range(ticks + 1)}
    hit = sum(p for s, p in weight.items() if s >= start) + sum(p for s, p in weight.items() if s > start)
    assert field.log_partition == pytest.approx(log(hit), rel=1e-12)
    # First passage at tick t: (x / t) C(t, (t + x) / 2) / 2^t (ballot theorem).
    first = [start / t * comb(t, (t + start) // 2) / 2**t if t >= start and (t + start) % 2 == 0 else 0.0
             for t in range(1, ticks + 1)]  # fmt: skip
    np.testing.assert_allclose(np.diff(field.completion_probability), np.array(first) / hit, atol=1e-13)


@pytest.mark.parametrize("precision", ["single", "double"])
def test_three_hundred_ticks_of_a_rare_event_do_not_underflow(precision):
    """One way only, each step of probability 0.02: log Z = 300 log 0.02, 200 decades below the smallest double."""
    cells = 301
    step = np.diag(np.full(cells - 1, 0.02), -1) + np.diag(np.full(cells, 0.9))
    labels = np.zeros(cells, dtype=int)
    labels[0] = 1
    problem = FieldProblem(
        step,
        labels,
        reach_within(300),
        np.eye(cells)[300],
        300,
        FieldOptions(precision=precision, goal_marginals=False),
    )
    field = solve(problem)
    assert field.log_partition == pytest.approx(300 * log(0.02), rel=1e-9)
    np.testing.assert_allclose(field.occupancy[np.arange(301), np.arange(300, -1, -1)], 1.0)
    paths = field.sample(np.random.default_rng(0), 5)
    np.testing.assert_array_equal(paths.cells, np.tile(np.arange(300, -1, -1), (5, 1)))
    np.testing.assert_array_equal(paths.completed_tick, 300)


def test_completion_probability_in_closed_form():
    """One start: odds c / (1 - c) = exp(lambda) Z / (1 - Z), and KL is that of the two coins."""
    hit = np.exp(solve(line_problem(12, 2, 6)).log_partition)
    field = solve(line_problem(12, 2, 6, completion_probability=0.35, marginal_tolerance=1e-14))
    assert field.completes == pytest.approx(0.35, abs=1e-13)
    assert -field.tilt.log_failure == pytest.approx(log(0.35 / 0.65 * (1 - hit) / hit), abs=1e-12)
    coins = 0.35 * log(0.35 / hit) + 0.65 * log(0.65 / (1 - hit))
    assert field.kl_to_reference == pytest.approx(coins, abs=1e-12)
    assert field.completion_probability[-1] == pytest.approx(0.35, abs=1e-12)


def test_a_convex_solver_finds_the_same_distribution(oracle):
    """Equation 1 itself, over the probabilities of all trajectories of a ring of three cells, by SLSQP."""
    enumerate_trajectories, _ = oracle
    ring = np.array([[0.2, 0.5, 0.3], [0.3, 0.2, 0.5], [0.6, 0.3, 0.1]])
    problem = FieldProblem(
        ring, [0, 0, 1], reach_within(3), [0.7, 0.3, 0.0], 3,
        FieldOptions(precision="double", completion_probability=0.6, marginal_tolerance=1e-13),
    )  # fmt: skip
    every = enumerate_trajectories(problem, 3)
    done = (every.completed_tick >= 0).astype(float)
    assert len(done) == 54
    constraints = [
        {"type": "eq", "fun": lambda p: p @ done - 0.6, "jac": lambda p: done},
        *(
            {"type": "eq", "fun": lambda p, a=a, m=m: p @ a - m, "jac": lambda p, a=a: a}
            for a, m in (((every.cells[:, 0] == c).astype(float), problem.start[c]) for c in (0, 1))
        ),
    ]
    found = minimize(
        lambda p: p @ np.log(p / every.reference),
        every.reference,
        jac=lambda p: np.log(p / every.reference) + 1,
        bounds=[(1e-12, 1)] * len(done),
        constraints=constraints,
        method="SLSQP",
        options={"maxiter": 500, "ftol": 1e-14},
    )
    field = solve(problem)
    assert found.fun == pytest.approx(field.kl_to_reference, abs=1e-8)
    np.testing.assert_allclose(every.occupancy(found.x, 3), field.occupancy, atol=1e-5)


def test_single_precision_agrees_with_double():
    scenario = Scenario.preset("lab")
    mission = Mission((Constraint("deadline", ("Checkpoint A", "Checkpoint B"), seconds=18.0),))
    single, double = (
        solve(FieldProblem.from_mission(
            mission, scenario, FieldOptions(cell_metres=0.15, headings=8, precision=precision, marginal_tolerance=1e-5)
        ))
        for precision in ("single", "double")
    )  # fmt: skip
    assert single.log_partition == pytest.approx(double.log_partition, abs=1e-4)
    np.testing.assert_allclose(single.occupancy, double.occupancy, atol=1e-5)
    assert single.branch_shares["Checkpoint A"] == pytest.approx(0.5, abs=1e-4)


def test_displacements_are_exact_in_the_mean_and_reach_full_speed():
    grid = GridMap.from_scenario(Scenario.preset("open"), 0.05)
    middle = int(grid.cells_of([(1.5, 1.5)])[0])
    speed = 0.11
    motion = run_and_tumble(grid, speed, headings=16)
    moves = motion.motion
    for m in range(17):
        row = middle * 17 + m
        at = slice(moves.indptr[row], moves.indptr[row + 1])
        mean = moves.data[at] @ (grid.centres[moves.indices[at] // 17] - grid.centres[middle])
        angle = motion.headings[m]
        expected = (0, 0) if np.isnan(angle) else (speed * np.cos(angle), speed * np.sin(angle))
        np.testing.assert_allclose(mean, expected, atol=1e-12)
    np.testing.assert_allclose(motion.mix.sum(axis=2), 1)
    assert motion.mode_shares()[16] == pytest.approx(0.1)
    rows = walk(grid, speed).matrix()
    np.testing.assert_allclose(np.asarray(rows.sum(axis=1)), 1)
    reach = np.hypot(*(grid.centres[rows[[middle]].indices] - grid.centres[middle]).T)
    assert reach.max() > speed


def test_ticks_of_states_and_a_mission_that_hides_them():
    problem = line_problem(5, 2, 4)
    np.testing.assert_array_equal(ticks_of(problem)[:5], np.arange(-1, 4))
    lab = Scenario.preset("lab")
    places = ("Checkpoint A", "Checkpoint B", "Checkpoint C", "Checkpoint D", "Checkpoint E")
    gaps = Mission((Constraint("eventually", places, different=2, max_gap_seconds=14),))
    with pytest.raises(ValueError, match="timing_prior needs a mission whose automaton tells the tick"):
        Tilt.of(FieldProblem.from_mission(gaps, lab, FieldOptions(cell_metres=0.15, timing_prior=True)))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"transitions": np.eye(3) * 1.1}, r"row 0 sums to 1.1, must be <= 1"),
        ({"transitions": -np.eye(3)}, r"entry -1.0: transition probabilities must be finite and >= 0"),
        ({"transitions": np.full((3, 3), np.nan)}, r"must be finite and >= 0"),
        ({"transitions": np.ones((3, 2)) / 3}, r"shape \(3, 2\)"),
        ({"labels": [0, 1]}, r"labels has shape \(2,\), must be \[3\]"),
        ({"labels": [0, 1, 2]}, r"labels lie in 0..2, must lie in 0..1"),
        ({"start": [0.5, 0.2, 0.2]}, r"start sums to 0.9, must sum to 1"),
        ({"start": [1.5, -0.5, 0.0]}, r"entry -0.5"),
        ({"horizon": -1}, r"horizon is -1"),
        ({"reference_of": [0]}, r"reference_of must be \[6\]"),
    ],
)
def test_bad_input_is_named(change, message):
    good = {
        "transitions": np.eye(3),
        "labels": [0, 0, 1],
        "automaton": reach_within(3),
        "start": [1.0, 0, 0],
        "horizon": 3,
    }
    with pytest.raises(ValueError, match=message):
        FieldProblem(**(good | change))


def test_a_cyclic_automaton_is_refused():
    automaton = reach_within(3)
    automaton.delta[2, 0] = 1
    with pytest.raises(ValueError, match=r"not acyclic: state 2 \(rank 2\) leads to 1 \(rank 1\)"):
        FieldProblem(np.eye(3), [0, 0, 1], automaton, [1.0, 0, 0], 3)


def test_an_impossible_mission_says_so():
    with pytest.raises(InfeasibleField, match="no trajectory of the reference process completes the mission"):
        solve(FieldProblem(np.eye(3), [0, 0, 1], reach_within(3), [1.0, 0, 0], 3))


def test_start_cells_that_cannot_complete_are_left_out():
    field = solve(FieldProblem(np.eye(3), [0, 1, 0], reach_within(3), [0.5, 0.25, 0.25], 3))
    np.testing.assert_allclose(field.occupancy[0], [0, 1, 0])
    assert field.log_partition == 0


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"reference": "run"}, "run"),
        ({"kernel": "bridges"}, "bridge"),
        ({"completion_probability": 0.0}, r"completion_probability is 0.0, must lie in \(0, 1\]"),
        ({"cell_metres": -1.0}, "cell_metres is -1.0"),
        ({"headings": 2}, "headings is 2"),
    ],
)
def test_bad_options_are_named(change, message):
    with pytest.raises((ValueError, KeyError), match=message):
        FieldOptions(**change)


def test_presets():
    assert FieldOptions.preset("paper").reference == "walk" and not FieldOptions.preset("paper").goal_marginals
    with pytest.raises(KeyError, match="default"):
        FieldOptions.preset("defualt")


def test_matrices_need_equal_sizes():
    with pytest.raises(ValueError, match=r"transitions\[1\] has shape \(2, 2\)"):
        from_matrices([np.eye(3), np.eye(2)])
