"""Every answer of a solved field against the enumeration of all its trajectories."""

from __future__ import annotations

import numpy as np
import pytest

from tab_marl.field import FieldOptions, FieldProblem, IsAt, Passes, SoftConstraint, Tracker, solve
from tab_marl.field.answers.evidence import ImpossibleEvidence, Likelihood, NearZeroEvidence, Seen, Unseen
from tab_marl.mission import Constraint, Mission
from tab_marl.world.regions import Box

HORIZON = 4
DEADLINE = Mission((Constraint("deadline", ("Checkpoint A",), seconds=4),))
SOONER = Mission((Constraint("deadline", ("Checkpoint A",), seconds=3),))
TWO_STAGES = Mission(
    (Constraint("deadline", ("central zone",), seconds=3), Constraint("deadline", ("Checkpoint A",), seconds=4))
)
REFERENCES = {
    "paper_walk": {"reference": "paper_walk"},
    "run_and_tumble": {"reference": "run_and_tumble", "headings": 4, "mean_run_metres": 2.0},
}
CASES = [(n, m, c) for n in REFERENCES for m, c in ((DEADLINE, 1.0), (TWO_STAGES, 1.0), (SOONER, 0.7))]
_KNOWN: dict = {}


@pytest.fixture(params=CASES, ids=lambda case: f"{case[0]}-{len(case[1].constraints)} goals-{case[2]}")
def solved(request, oracle, tiny_scenario):
    """(field, all trajectories, their law, tick at which the mission ends)."""
    if request.param not in _KNOWN:
        _KNOWN[request.param] = everything(*request.param, oracle, tiny_scenario)
    return _KNOWN[request.param]


def everything(reference, mission, completes, oracle, tiny_scenario):
    start = Box(0, 0, 1, 1) if reference == "run_and_tumble" else Box(0, 0, 2, 1)
    scenario = tiny_scenario(adversary_start=start, horizon_seconds=HORIZON)
    options = FieldOptions(
        cell_metres=1.0, goal_marginals=False, precision="double", marginal_tolerance=1e-14,
        completion_probability=completes, **REFERENCES[reference],
    )  # fmt: skip
    problem = FieldProblem.from_mission(mission, scenario, options)
    enumerate_trajectories, mission_runner = oracle
    advance = mission_runner(mission, scenario, problem.grid)
    every = enumerate_trajectories(problem, HORIZON, advance)
    done = every.completed_tick >= 0
    if completes < 1:
        law = every.fit(done[:, None].astype(float), np.array([completes]), np.ones(len(done), bool))
    else:
        law = every.tilted(np.where(done, 0.0, -np.inf))
    return solve(problem), every, law, np.array([end_of(row, advance) for row in every.cells])


def end_of(cells, advance):
    state = None
    for t, cell in enumerate(cells):
        state, status, _ = advance(state, cell)
        if status != "active":
            return t
    return len(cells)


def stopped(every, law, ended):
    """{trajectory up to the mission's end: probability}."""
    paths: dict[tuple, float] = {}
    for states, p, end in zip(every.states, law, ended, strict=True):
        key = tuple(states[: end + 1])
        paths[key] = paths.get(key, 0.0) + p
    return paths


def test_path_entropy_and_likeliest_path(solved):
    field, every, law, ended = solved
    probabilities = np.array([p for p in stopped(every, law, ended).values() if p > 0])
    assert field.path_entropy == pytest.approx(-(probabilities * np.log(probabilities)).sum(), abs=1e-11)
    completing = {k: p for k, p in stopped(every, law * (every.completed_tick >= 0), ended).items() if p > 0}
    best = field.most_likely_path()
    states = tuple(int(c * every.modes + m) for c, m in zip(best.cells, best.modes, strict=True))
    assert best.completes
    assert best.log_probability == pytest.approx(np.log(max(completing.values())), abs=1e-12)
    assert completing[states] == pytest.approx(max(completing.values()), rel=1e-12)
    np.testing.assert_array_equal(best.positions, field.problem.grid.centres[best.cells])


def test_stage_times_and_occupancy_by_state(solved, oracle):
    field, every, law, _ = solved
    central = field.problem.grid.inside(field.problem.scenario.region("central zone"))[every.cells]
    stages = field.stage_times
    at = [every.completed_tick]
    if len(stages) == 2:
        reached = np.where(central[:, :4].any(axis=1), central[:, :4].argmax(axis=1), -1)
        at = [reached, every.completed_tick]
    assert list(stages) == (["goal 1", "goal 2"] if len(at) == 2 else ["mission"])
    for times, tick in zip(stages.values(), at, strict=True):
        np.testing.assert_allclose(times, [law[tick == t].sum() for t in range(HORIZON + 1)], rtol=0, atol=1e-12)
    for t in range(HORIZON + 1):
        states, by_cell = field.occupancy_by_state(t)
        np.testing.assert_allclose(by_cell.sum(axis=0), field.occupancy[t], atol=1e-13)
        np.testing.assert_allclose(by_cell.sum(axis=1), field.automaton_occupancy[t, states], atol=1e-13)
        complete = field.bridge.complete[states]
        np.testing.assert_allclose(by_cell[complete].sum(axis=0), field.occupancy_by_status[t, 1], atol=1e-13)
    np.testing.assert_allclose(field.automaton_occupancy.sum(axis=1), 1, atol=1e-12)


def test_probability_of_events_and_the_tracked_law(solved):
    field, every, law, ended = solved
    ticks = np.arange(HORIZON + 1)

    def inside(place):
        return field.problem.grid.inside(field.problem.scenario.place(place))[every.cells]

    passed = (inside((0.5, 1.5)) & (ticks <= ended[:, None])).any(axis=1)
    late = inside("central zone")[:, 3:5].any(axis=1)
    assert field.probability(Passes((0.5, 1.5))) == pytest.approx(law @ passed, abs=1e-12)
    tracked = field.track(Passes((0.5, 1.5)), IsAt("central zone", 3, 4))
    np.testing.assert_allclose(tracked.event_probabilities, [law @ passed, law @ late], rtol=0, atol=1e-12)
    np.testing.assert_allclose(tracked.occupancy, field.occupancy, rtol=0, atol=1e-12)
    np.testing.assert_allclose(tracked.completion_probability, field.completion_probability, rtol=0, atol=1e-12)
    assert tracked.kl_to_reference == pytest.approx(field.kl_to_reference, abs=1e-11)
    assert tracked.path_entropy == pytest.approx(field.path_entropy, abs=1e-11)
    assert tracked.most_likely_path().log_probability == pytest.approx(
        field.most_likely_path().log_probability, abs=1e-12
    )
    if 0 < law @ late < 1:
        given = tracked.given_latest_event()
        conditioned = law * late / (law @ late)
        np.testing.assert_allclose(given.occupancy, every.occupancy(conditioned, 9), rtol=0, atol=1e-12)


def test_smoother_is_bayes_over_all_trajectories(solved):
    field, every, law, ended = solved
    grid, modes = field.problem.grid, every.modes
    cover = np.zeros(9)
    cover[[6, 4]] = 0.5, 0.7
    vague = np.linspace(0.2, 1.0, 9)
    seen = Seen(2, (1.2, 1.4), heading=np.pi / 2 if modes > 1 else None)
    observations = (Unseen(3, cover), seen, Unseen(1, cover, ego=(2.5, 0.5), radius_metres=0.8), Likelihood(4, vague))
    result = field.condition(*observations)
    away = ((grid.centres - seen.point) ** 2).sum(axis=1)
    cell = np.where(away - away.min() <= 9, np.exp(-0.5 * (away - away.min()) / 0.75**2), 0.0)
    mode = np.ones(modes)
    if modes > 1:
        mode[:4] = np.maximum(np.exp(4 * (np.cos(np.pi / 2 - np.arange(4) * np.pi / 2) - 1)), 0.05)
        mode[4] = mode[:4].mean()
    near = np.clip((0.8 - np.hypot(*(grid.centres - (2.5, 0.5)).T)) + 0.5, 0, 1)
    each = [
        ((1 - cover) * (1 - near))[every.cells[:, 1]],
        cell[every.cells[:, 2]] * mode[every.states[:, 2] % modes],
        (1 - cover)[every.cells[:, 3]],
        vague[every.cells[:, 4]],
    ]
    weight = law.copy()
    for tick, likelihood in enumerate(each, 1):
        before = weight.sum()
        weight = weight * likelihood
        assert result.log_likelihoods[tick - 1] == pytest.approx(np.log(weight.sum() / before), abs=1e-11)
        filtered = np.bincount(every.cells[:, tick], weight / weight.sum(), minlength=9)
        np.testing.assert_allclose(result.filtered[tick], filtered, rtol=0, atol=1e-12)
    posterior = weight / weight.sum()
    np.testing.assert_allclose(result.occupancy, every.occupancy(posterior, 9), rtol=0, atol=1e-12)
    done = [posterior @ ((every.completed_tick >= 0) & (every.completed_tick <= t)) for t in range(HORIZON + 1)]
    np.testing.assert_allclose(result.completion_probability, done, rtol=0, atol=1e-12)
    assert result.log_evidence == pytest.approx(np.log(weight.sum()), abs=1e-11)
    passed = (grid.inside(Box(0, 1, 1, 2))[every.cells] & (np.arange(HORIZON + 1) <= ended[:, None])).any(axis=1)
    assert result.probability(Passes((0.5, 1.5))) == pytest.approx(posterior @ passed, abs=1e-11)


def test_no_observation_changes_nothing_and_long_horizons_are_smoothed_in_blocks(tiny_scenario):
    scenario = tiny_scenario(horizon_seconds=30.0)
    mission = Mission((Constraint("deadline", ("Checkpoint A",), seconds=20),))
    options = FieldOptions(headings=4, cell_metres=1.0, precision="double")
    field = solve(FieldProblem.from_mission(mission, scenario, options))
    nothing = field.condition()
    np.testing.assert_allclose(nothing.occupancy, field.occupancy, atol=1e-13)
    assert nothing.log_evidence == 0 and nothing.weakest is None
    # The chain run backwards from a known end equals one smoothing pass of any block size.
    late = field.condition(Seen(17, (2.5, 2.5)), Unseen(5))
    assert late.occupancy[17].argmax() == field.problem.grid.cells_of([(2.5, 2.5)])[0]
    np.testing.assert_allclose(late.occupancy.sum(axis=1), 1, atol=1e-12)
    np.testing.assert_allclose(late.filtered[30], late.occupancy[30], atol=1e-12)
    np.testing.assert_allclose(late.filtered[17], field.condition(Unseen(5), Seen(17, (2.5, 2.5))).filtered[17])


def test_weak_and_impossible_evidence_are_named(tiny_scenario):
    scenario = tiny_scenario(adversary_start=Box(0, 0, 1, 1))
    field = solve(FieldProblem.from_mission(DEADLINE, scenario, FieldOptions(reference="paper_walk", cell_metres=1.0)))
    with pytest.raises(
        ImpossibleEvidence, match=r"not seeing it at tick 0 has probability 0.*leave the observation out"
    ):
        field.condition(Unseen(0, np.ones(9)))
    with pytest.warns(
        NearZeroEvidence, match=r"the observation at tick 2 has likelihood 1\.0e-20 .* all but impossible"
    ):
        result = field.condition(Seen(1, (1.5, 0.5)), Likelihood(2, np.full(9, 1e-20)))
    assert result.weakest is result.observations[1] and result.log_evidence < -40
    for bad, says in (
        (Seen(99, (0, 0)), "must lie in 0..5"),
        (Seen(1, (0, 0, 0)), "must be 2 finite numbers"),
        (Unseen(1, np.full(9, 2.0)), r"entries in 0\.\.1"),
        (Likelihood(1, np.full(9, np.nan)), "finite and >= 0"),
    ):
        with pytest.raises(ValueError, match=says):
            field.condition(bad)


def test_samples_pass_places_as_often_as_the_field_says(tiny_scenario):
    scenario = tiny_scenario(horizon_seconds=8.0)
    mission = Mission((Constraint("deadline", ("Checkpoint B",), seconds=8),))
    problem = FieldProblem.from_mission(mission, scenario, FieldOptions(headings=4, cell_metres=1.0))
    field = solve(problem.constrained(SoftConstraint(Passes("central zone"), 0.3)))
    paths = field.sample(np.random.default_rng(4), 8000)
    before = np.arange(9) <= paths.completed_tick[:, None]
    inside = problem.grid.inside(scenario.region("central zone"))[paths.cells]
    assert (inside & before).any(axis=1).mean() == pytest.approx(0.3, abs=0.02)
    looped = Tracker("leaves at once", (~problem.grid.inside(scenario.adversary_start)).astype(int),
                     [[1, 1], [3, 2], [2, 2], [3, 3]], 0, 2, 3)  # fmt: skip
    start = problem.grid.inside(scenario.adversary_start)
    assert field.probability(looped) == pytest.approx((~start[paths.cells[:, 1]]).mean(), abs=0.02)
