"""Soft constraints and timing priors against the enumeration of every trajectory, and against a convex solver on eq. 1."""

from __future__ import annotations

import cvxpy as cp
import numpy as np
import pytest

from tab_marl.field import (
    Completes,
    ContradictoryConstraints,
    FieldOptions,
    FieldProblem,
    IsAt,
    Passes,
    SoftConstraint,
    TimingPrior,
    Tracker,
    solve,
)
from tab_marl.mission import Constraint, Mission
from tab_marl.world.regions import Box

HORIZON = 5
DEADLINE = Mission((Constraint("deadline", ("Checkpoint A",), seconds=4),))
ALTERNATIVES = Mission((Constraint("deadline", ("Checkpoint A", "Checkpoint C"), seconds=4),))
TWO_STAGES = Mission(
    (Constraint("deadline", ("Checkpoint C",), seconds=3), Constraint("deadline", ("Checkpoint B",), seconds=2, since="previous"))
)  # fmt: skip
SECOND = Mission((Constraint("eventually", ("Checkpoint B",)),))
REFERENCES = {
    "paper_walk": {"reference": "paper_walk"},
    "run_and_tumble": {"reference": "run_and_tumble", "headings": 4, "mean_run_metres": 2.0},
}


def make(mission, scenario, reference, constraints=(), **options):
    settings = {
        "cell_metres": 1.0, "goal_marginals": False, "precision": "double", "marginal_tolerance": 1e-13,
        "constraint_tolerance": 1e-13,
    }  # fmt: skip
    return FieldProblem.from_mission(
        mission, scenario, FieldOptions(**(REFERENCES[reference] | settings | options)), constraints=constraints
    )


class Truth:
    """Every trajectory of the mission, with plain-Python events."""

    def __init__(self, oracle, mission, scenario, problem):
        enumerate_trajectories, mission_runner = oracle
        self.scenario, self.grid = scenario, problem.grid
        self.every = enumerate_trajectories(problem, HORIZON, mission_runner(mission, scenario, problem.grid))
        self.cells = self.every.cells
        self.completed = self.every.completed_tick >= 0
        self.ended = np.array([self._end(row, mission_runner(mission, scenario, problem.grid)) for row in self.cells])

    def _end(self, row, advance):
        state = None
        for t, cell in enumerate(row):
            state, status, _ = advance(state, cell)
            if status != "active":
                return t
        return len(row) - 1

    def inside(self, place):
        return self.grid.inside(self.scenario.place(place))[self.cells]

    def passes(self, place):
        return (self.inside(place) & (np.arange(HORIZON + 1) <= self.ended[:, None])).any(axis=1)

    def is_at(self, place, first, last, throughout=False):
        window = self.inside(place)[:, first : last + 1]
        return window.all(axis=1) if throughout else window.any(axis=1)


CASES = {
    "passes": ([SoftConstraint(Passes("central zone"), 0.3)], DEADLINE),
    "two events": (
        [SoftConstraint(Passes("central zone"), 0.3), SoftConstraint(IsAt("Checkpoint B", 3, 5), 0.25)],
        DEADLINE,
    ),
    "throughout": ([SoftConstraint(IsAt((0.5, 1.5), 1, 2, throughout=True), 0.2)], DEADLINE),
    "four at once": (
        [
            SoftConstraint(Completes(), 0.9),
            SoftConstraint(Passes("central zone"), 0.3),
            SoftConstraint(IsAt("Checkpoint C", 2, 5), 0.3),
            SoftConstraint(Completes(SECOND), 0.5),
        ],
        DEADLINE,
    ),
}


def features_of(truth, constraints):
    columns = []
    for c in constraints:
        match c.event:
            case Completes(mission=None):
                columns.append(truth.completed)
            case Completes():
                columns.append(truth.inside("Checkpoint B").any(axis=1))
            case Passes(place=place):
                columns.append(truth.passes(place))
            case IsAt() as e:
                columns.append(truth.is_at(e.place, int(e.from_seconds), int(e.to_seconds), e.throughout))
    return np.stack(columns, axis=1).astype(float)


@pytest.mark.parametrize("reference", REFERENCES)
@pytest.mark.parametrize("name", CASES)
def test_events_have_their_probabilities_and_the_law_is_the_tilted_one(name, reference, oracle, tiny_scenario):
    constraints, mission = CASES[name]
    start = Box(0, 0, 1, 1) if reference == "run_and_tumble" else Box(0, 0, 2, 1)
    scenario = tiny_scenario(adversary_start=start, horizon_seconds=HORIZON)
    problem = make(mission, scenario, reference, constraints)
    truth = Truth(oracle, mission, scenario, make(mission, scenario, reference))
    soft = any(isinstance(c.event, Completes) and c.event.mission is None for c in constraints)
    features, targets = features_of(truth, constraints), np.array([c.probability for c in constraints])
    law = truth.every.fit(features, targets, np.ones(len(features), bool) if soft else truth.completed)
    np.testing.assert_allclose(law @ features, targets, atol=1e-13)
    field = solve(problem)
    np.testing.assert_allclose(field.occupancy, truth.every.occupancy(law, 9), rtol=0, atol=1e-12)
    assert field.completes == pytest.approx(law @ truth.completed, abs=1e-12)
    np.testing.assert_allclose(
        field.completion_probability[-1], law @ (truth.completed & (truth.every.completed_tick <= HORIZON)), atol=1e-12
    )
    assert field.kl_to_reference == pytest.approx(truth.every.divergence(law), abs=1e-11)
    report = field.report
    assert report.worst <= 1 and report.passes < 40
    assert report.dual == pytest.approx(field.kl_to_reference, abs=1e-11)  # no duality gap
    assert all(abs(c.residual) <= 1e-13 for c in report.constraints)
    events = iter(field.event_probabilities)
    for c in constraints:
        if not (isinstance(c.event, Completes) and c.event.mission is None):
            assert next(events) == pytest.approx(c.probability, abs=1e-12)
    paths = field.sample(np.random.default_rng(0), 4000)
    assert (paths.completed_tick >= 0).mean() == pytest.approx(field.completes, abs=0.03)


def test_a_convex_solver_on_the_primal_finds_the_same_law(oracle, tiny_scenario):
    """min KL(P || Q) over all trajectories, subject to P(s0) = mu0 and E_P[f] = c: the paper's eq. 1 as it stands."""
    constraints, mission = CASES["four at once"]
    scenario = tiny_scenario(adversary_start=Box(0, 0, 2, 1), horizon_seconds=HORIZON)
    truth = Truth(oracle, mission, scenario, make(mission, scenario, "paper_walk"))
    features, targets = features_of(truth, constraints), np.array([c.probability for c in constraints])
    # Trajectories with the same start and the same events have the same density: one variable for each such class.
    keys, kind = np.unique(np.column_stack([truth.cells[:, 0], features]), axis=0, return_inverse=True)
    reference = np.bincount(kind.ravel(), truth.every.reference)
    law = cp.Variable(len(keys), nonneg=True)
    cells = np.unique(keys[:, 0])
    starts = np.stack([keys[:, 0] == c for c in cells]).astype(float)
    found = cp.Problem(
        cp.Minimize(cp.sum(cp.rel_entr(law, reference))),
        [starts @ law == [truth.every.reference_start[int(c)] for c in cells], keys[:, 1:].T @ law == targets],
    )
    found.solve(solver="CLARABEL")
    field = solve(make(mission, scenario, "paper_walk", constraints))
    assert field.kl_to_reference == pytest.approx(found.value, abs=1e-6)
    whole = law.value[kind.ravel()] * truth.every.reference / reference[kind.ravel()]
    np.testing.assert_allclose(field.occupancy, truth.every.occupancy(whole, 9), atol=1e-4)


@pytest.mark.parametrize(
    ("mission", "stage", "shares"),
    [(TWO_STAGES, 0, {2: 0.3, 3: 0.7}), (TWO_STAGES, 1, {3: 0.5, 4: 0.3, 5: 0.2}), (DEADLINE, -1, None)],
)
def test_timing_prior_of_a_stage(mission, stage, shares, oracle, tiny_scenario):
    scenario = tiny_scenario(adversary_start=Box(1, 0, 2, 1), horizon_seconds=HORIZON)
    bare = make(mission, scenario, "paper_walk")
    field = solve(bare.constrained(TimingPrior(stage, shares), SoftConstraint(Passes("central zone"), 0.4)))
    truth = Truth(oracle, mission, scenario, bare)
    if mission is TWO_STAGES:
        first = truth.inside("Checkpoint C").argmax(axis=1)
        at = first if stage == 0 else truth.every.completed_tick
    else:
        at = truth.every.completed_tick
        shares = dict.fromkeys((3, 4), 0.5)
    allowed = truth.completed & np.isin(at, list(shares))
    features = np.column_stack([at == t for t in list(shares)[1:]] + [truth.passes("central zone")]).astype(float)
    law = truth.every.fit(features, np.append(list(shares.values())[1:], 0.4), allowed)
    times = list(field.stage_times.values())[stage]
    np.testing.assert_allclose([times[t] for t in shares], list(shares.values()), atol=1e-12)
    assert times.sum() == pytest.approx(1, abs=1e-12)
    np.testing.assert_allclose(field.occupancy, truth.every.occupancy(law, 9), rtol=0, atol=1e-12)
    assert field.kl_to_reference == pytest.approx(truth.every.divergence(law), abs=1e-11)


def test_everything_at_once(oracle, tiny_scenario):
    scenario = tiny_scenario(adversary_start=Box(1, 0, 2, 1), horizon_seconds=HORIZON)
    constraints = (
        SoftConstraint(Completes(), 0.8),
        SoftConstraint(Passes("central zone"), 0.3),
        TimingPrior(shares={2: 0.25, 3: 0.25, 4: 0.5}),
    )
    problem = make(ALTERNATIVES, scenario, "paper_walk", constraints, goal_marginals=True)
    truth = Truth(oracle, ALTERNATIVES, scenario, make(ALTERNATIVES, scenario, "paper_walk"))
    done = truth.every.completed_tick
    features = np.column_stack(
        [truth.every.visits[:, 0], *(done == t for t in (2, 3, 4)), truth.passes("central zone")]
    ).astype(float)  # fmt: skip
    law = truth.every.fit(features, np.array([0.4, 0.2, 0.2, 0.4, 0.3]), ~np.isin(done, [0, 1, 5]))
    field = solve(problem)
    np.testing.assert_allclose(field.occupancy, truth.every.occupancy(law, 9), rtol=0, atol=1e-12)
    assert field.kl_to_reference == pytest.approx(truth.every.divergence(law), abs=1e-11)
    assert [c.target for c in field.report.constraints[:2]] == [0.8, 0.3]
    assert "80" not in str(field.report) or "passes central zone" in str(field.report)


def test_contradictions_name_the_constraints_and_what_is_attainable(tiny_scenario):
    scenario = tiny_scenario(adversary_start=Box(0, 0, 2, 1), horizon_seconds=HORIZON)
    problem = make(DEADLINE, scenario, "paper_walk")
    beside = SoftConstraint(Passes((0.5, 1.5)), 0.6)
    with pytest.raises(ContradictoryConstraints, match="contradict one another") as error:
        twice = (SoftConstraint(Passes("central zone"), 0.3), SoftConstraint(Passes((1.5, 1.5)), 0.6))
        solve(problem.constrained(beside, *twice))
    assert "'passes central zone' with probability 0.3" in str(error.value)
    assert "0.5, 1.5" not in str(error.value)  # a smallest set of constraints that conflict
    assert "together the nearest is" in str(error.value)
    # Half of the starts lie in the lower middle cell, so it is passed with probability 0.5 at least.
    with pytest.raises(ContradictoryConstraints, match=r"can have 0\.5 to 1; change the target"):
        solve(problem.constrained(SoftConstraint(Passes((1.5, 0.5)), 0.4)))
    with pytest.raises(ContradictoryConstraints, match=r"mission at 1 s .* between 2 and 4 s"):
        solve(problem.constrained(TimingPrior(shares={1: 0.5, 3: 0.5})))


def test_any_automaton_can_be_an_event_on_raw_arrays():
    """A walk on five cells that must reach the right end within 12 ticks; it enters cell 1 twice with probability 0.5."""
    from tab_marl.mission import compile_mission, unroll
    from tab_marl.world.scenario import Scenario

    compiled = compile_mission(
        Mission((Constraint("deadline", ("Checkpoint A",), seconds=12),)), Scenario.preset("open"), 1.0
    )
    automaton = unroll(compiled, 12, [0, 1])
    step = np.diag(np.full(4, 0.5), 1) + np.diag(np.full(4, 0.5), -1)
    step[0, 1] = step[4, 3] = 1.0
    problem = FieldProblem(step, [0, 0, 0, 0, 1], automaton, [0, 0, 1, 0, 0], 12)
    # States: count * 2 + (in cell 1 now); symbols: elsewhere, cell 1.
    twice = Tracker("enters cell 1 twice", [0, 1, 0, 0, 0], [[0, 1], [2, 1], [2, 4], [3, 3], [4, 4]], 0, 4, 3)
    bare = solve(problem)
    chance = bare.probability(twice)
    rng = np.random.default_rng(1)
    paths = bare.sample(rng, 20_000)
    before = np.arange(13) <= paths.completed_tick[:, None]
    entered = ((paths.cells == 1) & before)[:, 1:] & (paths.cells[:, :-1] != 1)
    assert chance == pytest.approx((entered.sum(axis=1) >= 2).mean(), abs=0.012)
    field = solve(problem.constrained(SoftConstraint(twice, 0.5)))
    assert field.event_probabilities == pytest.approx((0.5,), abs=1e-9)
    with pytest.raises(ValueError, match=r"has no map.*give the cells"):
        bare.probability(Passes("Checkpoint A"))
    assert bare.probability(Passes([False, True, False, False, False])) > chance


@pytest.mark.parametrize(
    ("make_it", "says"),
    [
        (lambda: SoftConstraint(Passes("A"), 1.0), "strictly between 0 and 1"),
        (lambda: SoftConstraint("A", 0.5), "must be Passes, IsAt"),
        (lambda: IsAt("A", 5, 3), "0 <= from <= to"),
        (lambda: TimingPrior(shares={3.0: 0.7}), "sum to 0.7"),
        (lambda: TimingPrior(shares={-1.0: 1.0}), "must be >= 0"),
        (lambda: Tracker("t", [0], [[1], [1]], 0, 1, 0), r"ruled_out \(0\) must lead to itself"),
        (lambda: Tracker("t", [0], [[5]], 0, 0, 0), r"entries in 0\.\.0"),
    ],
)
def test_bad_constraints_are_named(make_it, says):
    with pytest.raises((ValueError, TypeError), match=says):
        make_it()


@pytest.mark.parametrize(
    ("constraints", "says"),
    [
        ([SoftConstraint(Passes("Checkpoint Q"), 0.5)], "Checkpoint Q"),
        ([SoftConstraint(IsAt("Checkpoint A", 1, 99), 0.5)], "after the horizon of 5 s"),
        ([SoftConstraint(IsAt("Checkpoint A", 1.2, 1.4), 0.5)], "no tick of 1 s"),
        ([TimingPrior(3)], "must be one of 0"),
        ([TimingPrior(), TimingPrior(0)], "twice"),
        ([SoftConstraint(Completes(), 0.5), SoftConstraint(Completes(), 0.6)], "constrained twice"),
        (["Checkpoint A"], "must be a SoftConstraint"),
        ([SoftConstraint(Completes(Mission((Constraint("eventually", ("Checkpoint B",), speed_limit=0.5),))), 0.5)], "speed limit"),
    ],
)  # fmt: skip
def test_constraints_that_cannot_be_watched_are_named(constraints, says, tiny_scenario):
    with pytest.raises((ValueError, TypeError, KeyError), match=says):
        make(DEADLINE, tiny_scenario(), "paper_walk", constraints)
