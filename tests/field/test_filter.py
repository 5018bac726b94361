"""The exact filter and the sampler against enumeration, and what happens when observations contradict the belief."""

from __future__ import annotations

import numpy as np
import pytest

from tab_marl.field import FieldOptions, FieldProblem, ProductBelief, product_chain, run_and_tumble, sample_paths, solve
from tab_marl.field.belief import EXACT, disc_cover
from tab_marl.mission import Constraint, Mission
from tab_marl.world.grid import GridMap
from tab_marl.world.regions import Box
from tab_marl.world.scenario import Scenario

HORIZON = 4
ROAM = Mission((Constraint("eventually", ("Checkpoint A", "Checkpoint B", "Checkpoint C"), different=2),))


@pytest.fixture
def problem(tiny_scenario):
    scenario = tiny_scenario(horizon_seconds=HORIZON, adversary_start=Box(0, 1, 3, 2))
    options = FieldOptions(
        headings=4, cell_metres=1.0, precision="double", mean_run_metres=2.0, marginal_tolerance=1e-13
    )
    return FieldProblem.from_mission(ROAM, scenario, options)


@pytest.fixture
def every(problem, oracle):
    enumerate_trajectories, mission_runner = oracle
    found = enumerate_trajectories(problem, HORIZON, mission_runner(ROAM, problem.scenario, problem.grid))
    completed = found.completed_tick >= 0
    before = found.tilted(np.where(completed, 0.0, -np.inf)) @ found.visits
    law = found.fit(found.visits[:, 1:], np.full(2, before.sum() / 3), completed)
    return found, law


def test_posterior_is_bayes_over_all_trajectories(problem, every):
    found, law = every
    belief = ProductBelief(solve(problem).chain, EXACT)
    grid = problem.grid
    camera = np.zeros(9)
    camera[[6, 8]] = 1.0, 0.6
    posterior = law.copy()
    evidence = 0.0
    seen = np.array([1.8, 1.4])
    for t in range(1, HORIZON + 1):
        belief.predict()
        if t == 2:
            assert belief.condition_on_seen(seen, heading=np.pi / 2 + 0.3)
            away = ((grid.centres - seen) ** 2).sum(axis=1)
            cell = np.exp(-0.5 * (away - away.min()) / 0.75**2)
            angle = np.arange(4) * np.pi / 2
            mode = np.maximum(np.exp(4 * (np.cos(np.pi / 2 + 0.3 - angle) - 1)), 0.05)
            mode = np.append(mode, mode.mean())
            likelihood = cell[found.cells[:, t]] * mode[found.states[:, t] % 5]
        else:
            ego = (2.4, 0.2)
            assert belief.condition_on_unseen(camera, ego, radius_metres=1.0)
            free = (1 - camera) * (1 - np.clip(1.5 - np.hypot(*(grid.centres - ego).T), 0, 1))
            likelihood = free[found.cells[:, t]]
        evidence += np.log((posterior * likelihood).sum())
        posterior = posterior * likelihood / (posterior * likelihood).sum()
        np.testing.assert_allclose(
            belief.cell_marginal(), np.bincount(found.cells[:, t], posterior, minlength=9), rtol=0, atol=1e-12
        )
        done = posterior[(found.completed_tick >= 0) & (found.completed_tick <= t)].sum()
        assert belief.completed == pytest.approx(done, abs=1e-12)
        assert belief.automaton_marginal().sum() == pytest.approx(1, abs=1e-12)
    assert belief.log_evidence == pytest.approx(evidence, abs=1e-11)
    assert belief.fallbacks == 0


def test_dropping_small_masses_changes_little(problem):
    field = solve(problem)
    exact, sparse = ProductBelief(field.chain, EXACT), ProductBelief(field.chain)
    for _ in range(HORIZON):
        for belief in (exact, sparse):
            belief.predict()
            belief.condition_on_unseen(np.eye(9)[4] * 0.5)
        np.testing.assert_allclose(sparse.cell_marginal(), exact.cell_marginal(), atol=1e-8)


def test_futures_from_a_belief_have_the_predicted_marginals(problem):
    field = solve(problem)
    belief = ProductBelief(field.chain)
    belief.predict()
    belief.condition_on_seen((1.5, 1.5))
    count = 40_000
    paths = sample_paths(field.chain, belief, np.random.default_rng(3), count, 6, jitter=False)
    assert paths.positions.shape == (count, 7, 2)
    ahead = belief.copy()
    for t in range(7):
        if t:
            ahead.predict()
        expected = ahead.cell_marginal()
        got = np.bincount(paths.cells[:, t], minlength=9) / count
        np.testing.assert_allclose(got, expected, atol=5 * np.sqrt(0.25 / count))
        done = ((paths.completed_tick >= 0) & (paths.completed_tick <= t)).mean()
        assert done == pytest.approx(ahead.completed, abs=5 * np.sqrt(0.25 / count))
        np.testing.assert_array_equal(paths.positions[:, t], problem.grid.centres[paths.cells[:, t]])
    possible = problem.reference.matrix() > 0
    states = paths.cells * 5 + paths.modes
    assert possible.toarray()[states[:, :-1].ravel(), states[:, 1:].ravel()].all()
    delta, labels = problem.automaton.delta, np.asarray(problem.labels)
    np.testing.assert_array_equal(
        delta[paths.automaton_states[:, :-1], labels[paths.cells[:, 1:]]], paths.automaton_states[:, 1:]
    )


def test_jitter_is_one_offset_per_trajectory_within_the_cell(problem):
    paths = solve(problem).sample(np.random.default_rng(0), 50)
    offset = paths.positions - problem.grid.centres[paths.cells]
    np.testing.assert_allclose(offset, np.broadcast_to(offset[:, :1], offset.shape), atol=1e-12)
    assert np.abs(offset).max() <= 0.5 and len(np.unique(offset[:, 0, 0])) == 50


def test_same_seed_same_paths(problem):
    field = solve(problem)
    a, b, c = (field.sample(np.random.default_rng(seed), 20) for seed in (1, 1, 2))
    np.testing.assert_array_equal(a.positions, b.positions)
    assert (a.cells != c.cells).any()


@pytest.mark.parametrize(("metres", "how"), [(0.8, "wider kernel"), (1.9, "restart")])
def test_a_sighting_out_of_reach_falls_back(metres, how):
    """Two ticks after the start the adversary has gone at most 0.3 m; it is seen farther up the arena."""
    scenario = Scenario.preset("open")
    options = FieldOptions(headings=8, cell_metres=0.1)
    mission = Mission((Constraint("deadline", ("Checkpoint A",), seconds=25),))
    field = solve(FieldProblem.from_mission(mission, scenario, options))
    belief = field.belief()
    belief.predict()
    belief.predict()
    seen = (1.5, 0.45 + metres)
    assert not belief.condition_on_seen(seen)
    assert belief.fallbacks == 1 and belief.log_evidence == -np.inf
    assert belief.masses.sum() == pytest.approx(1)
    grid = field.problem.grid
    away = np.hypot(*(grid.centres - seen).T)
    mean_away = belief.cell_marginal() @ away
    assert (mean_away < 0.1) == (how == "restart") and mean_away < 0.7
    assert field.problem.automaton.mission_ticks[belief.automaton_states].tolist() == [2]
    for _ in range(3):
        belief.predict()
        assert belief.condition_on_unseen(np.zeros(grid.cells))
    assert belief.masses.sum() == pytest.approx(1)


def test_no_sighting_where_all_mass_is_in_view_keeps_the_belief(problem):
    belief = ProductBelief(solve(problem).chain)
    belief.predict()
    before = belief.cell_marginal()
    assert not belief.condition_on_unseen(np.ones(9))
    np.testing.assert_array_equal(belief.cell_marginal(), before)
    assert belief.fallbacks == 1


def test_when_the_mission_cannot_be_completed_any_more_the_reference_goes_on(tiny_scenario):
    """Three ticks left and five cells to go: h is 0 there, and motion is the reference's, scaled where it would die."""
    scenario = tiny_scenario(adversary_start=Box(1, 1, 2, 2))
    mission = Mission((Constraint("deadline", ("Checkpoint A",), seconds=3),))
    options = FieldOptions(reference="paper_walk", cell_metres=1.0, precision="double")
    problem = FieldProblem.from_mission(mission, scenario, options)
    belief = ProductBelief(solve(problem).chain)
    belief.predict()
    belief.predict()
    belief.condition_on_seen((2.5, 0.5))
    belief._restart(np.eye(9)[2], np.ones(1))
    belief.predict()
    np.testing.assert_allclose(belief.cell_marginal(), problem.reference.matrix().toarray()[2])


def test_plain_chain_of_a_killed_reference_keeps_all_mass(tiny_scenario):
    """h = 1 on run-and-tumble: walls renormalise, so nothing is lost (the reference process of S-POMCP)."""
    scenario = tiny_scenario()
    grid = GridMap.from_scenario(scenario, 0.25)
    motion = run_and_tumble(grid, 0.6, headings=8, mean_run_metres=1.0)

    class Trivial:
        delta = np.array([[0], [1], [2]], dtype=np.int32)
        initial, accepting, rejecting = 0, 1, 2

    start = np.zeros(grid.cells)
    start[0] = 1.0
    chain = product_chain(motion, np.zeros(grid.cells, int), Trivial(), start, centres=grid.centres, cell_metres=0.25)
    assert motion.motion.row_sum.min() < 0.9
    belief = ProductBelief(chain, EXACT)
    dense = motion.matrix().toarray()
    dense /= dense.sum(axis=1, keepdims=True)
    law = np.zeros(motion.states)
    law[:9] = motion.mode_shares()
    for _ in range(12):
        belief.predict()
        law = law @ dense
    np.testing.assert_allclose(belief.masses[0], law, rtol=1e-6)  # the default table is single precision


def test_disc_cover_softens_the_edge_over_one_cell(problem):
    cover = disc_cover(solve(problem).chain, (1.5, 1.5), 1.0)
    np.testing.assert_allclose(cover.reshape(3, 3)[1], [0.5, 1.0, 0.5])
    assert cover[0] == pytest.approx(1.0 - np.sqrt(2) + 0.5)
