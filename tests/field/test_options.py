"""What the options do on real maps: dawdling, equal goals, cell sizes, the marginal kernel, pictures."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tab_marl.field import FieldOptions, FieldProblem, sample_paths, solve
from tab_marl.field.constraints.fitting import reweighting_step
from tab_marl.mission import Constraint, Mission
from tab_marl.world.grid import GridMap
from tab_marl.world.regions import Box, Disc
from tab_marl.world.scenario import Scenario

LAB = Scenario.preset("lab")
PLACES = tuple(f"Checkpoint {letter}" for letter in "ABCDE")


def shortest_seconds(scenario: Scenario, place: str) -> float:
    grid = GridMap.from_scenario(scenario, 0.05)
    goal = np.flatnonzero(grid.inside(scenario.region(place)))
    start = grid.cells_of([scenario.adversary_start.centre])[0]
    return float(grid.distances(goal)[start]) / scenario.adversary.max_speed


def reach(place: str, seconds: float) -> Mission:
    return Mission((Constraint("deadline", (place,), seconds=seconds),))


def late_share(**options) -> float:
    """Share of arrivals in the last tenth of an allowance of 1.8 times the shortest time."""
    seconds = round(2 * 1.8 * shortest_seconds(LAB, "Checkpoint A")) / 2
    field = solve(
        FieldProblem.from_mission(reach("Checkpoint A", seconds), LAB, FieldOptions(cell_metres=0.1, **options))
    )
    last = int(seconds / LAB.step_seconds)
    return float(1 - field.completion_probability[last - round(last / 10)])


def test_the_literal_field_dawdles_and_run_and_tumble_does_not():
    assert late_share(reference="walk") > 0.7
    assert late_share(reference="run_and_tumble") < 0.2
    assert late_share(reference="walk", timing_prior=True) < 0.3  # uniform over the feasible 44 % of the time


def test_goal_marginals_make_the_far_goal_as_likely_as_the_near():
    mission = Mission((Constraint("deadline", PLACES[:4], seconds=24),))
    shares = {}
    for equal in (False, True):
        problem = FieldProblem.from_mission(mission, LAB, FieldOptions(cell_metres=0.1, goal_marginals=equal))
        shares[equal] = solve(problem).branch_shares
    assert min(shares[False].values()) < 0.05
    np.testing.assert_allclose(list(shares[True].values()), 0.25, rtol=0.05)


def test_half_equal_goal_marginals_are_the_mixture_of_equal_and_free_ones():
    """Where a mission ends at one of several goals, a weight on the goal is all that differs between the three laws."""
    mission = Mission((Constraint("deadline", PLACES[:4], seconds=24),))
    settings = {"cell_metres": 0.1, "marginal_tolerance": 1e-9, "precision": "double"}
    laws = []
    for share in (0.0, 0.5, 1.0):
        problem = FieldProblem.from_mission(mission, LAB, FieldOptions(goal_marginals=share, **settings))
        one = np.zeros(problem.cells)  # with several starts the weights also shift what goes from where to where
        one[np.argmax(problem.start)] = 1.0
        laws.append(solve(replace(problem, start=one)))
    free, half, equal = laws
    for name, share in half.branch_shares.items():
        assert share == pytest.approx((free.branch_shares[name] + equal.branch_shares[name]) / 2, abs=1e-7)
    for tick in (5, 20, 40):
        mixed = (free.occupancy[tick] + equal.occupancy[tick]) / 2
        np.testing.assert_allclose(half.occupancy[tick], mixed, atol=1e-7)


def test_nearer_goals_are_visited_more_often_where_one_is_visited_first():
    """exp(-1.5 (x - 1)) with x the ratio of the shortest ways, also where the motion itself would prefer another."""
    mission = Mission((Constraint("deadline", PLACES[:4], seconds=24),))
    options = FieldOptions(cell_metres=0.1, marginal_tolerance=1e-6, goal_nearness=1.5)
    field = solve(FieldProblem.from_mission(mission, LAB, options))
    grid = field.problem.grid
    start = field.problem.start > 0
    metres = np.array([
        grid.distances(np.flatnonzero(grid.inside(LAB.region(p))))[start].mean() for p in field.branch_shares
    ])  # fmt: skip
    wanted = np.exp(-1.5 * (metres / metres.min() - 1))
    assert 0.02 < wanted.min() < 0.5
    np.testing.assert_allclose(list(field.branch_shares.values()), wanted / wanted.sum(), rtol=1e-5)


@pytest.mark.parametrize(
    "constraints",
    [
        # Two of four: a share above a half could not be had.
        (Constraint("eventually", PLACES[:4], different=2),),
        # What is near to the start need not be near to the first goal.
        (Constraint("eventually", ("central zone",)), Constraint("eventually", PLACES[:2])),
    ],
)
def test_all_other_alternatives_are_visited_equally_often(constraints):
    options = FieldOptions(cell_metres=0.2, headings=8, marginal_tolerance=1e-4, goal_nearness=1.5)
    field = solve(FieldProblem.from_mission(Mission(constraints), LAB, options))
    shares = [field.branch_shares[p] for p in constraints[-1].places]
    np.testing.assert_allclose(shares, 1 / len(shares), rtol=1e-3)


def test_nearness_of_goals_needs_a_number_that_is_not_negative():
    with pytest.raises(ValueError, match=r"goal_nearness is -1\.0, must be finite and >= 0"):
        FieldOptions(goal_nearness=-1.0)


def test_run_and_tumble_first_turns_on_the_spot():
    """After one tick as many have left as turn a quarter of a circle in a tick; without the option all are under way."""
    mission = Mission((Constraint("eventually", PLACES[:1]),))
    for begins_at_rest, modes in ((True, 18), (False, 17)):
        options = FieldOptions(cell_metres=0.05, begins_at_rest=begins_at_rest)
        motion = FieldProblem.from_mission(mission, LAB, options).reference
        assert motion.modes == modes and motion.first.sum() == (1 if begins_at_rest else modes)
        first = motion.first_mode_shares()
        assert first.sum() == pytest.approx(1)
        after = first @ motion.mix[0]
        leaves = LAB.adversary.max_turn_rate * LAB.step_seconds / (np.pi / 2)
        moving = after[:16].sum()
        assert moving == pytest.approx(0.9 * leaves if begins_at_rest else motion.mode_shares()[:16].sum())
        assert motion.mode_shares()[16:].sum() == pytest.approx(0.1)  # rest alone: nobody comes back to the first mode


def test_shares_of_goals_need_a_number_between_0_and_1():
    with pytest.raises(ValueError, match=r"goal_marginals is 1\.5, must lie in \[0, 1\]"):
        FieldOptions(goal_marginals=1.5)


def test_goals_out_of_reach_get_no_equal_share():
    """Within 7 s, C and D can be reached; A and B only by a walker that cell rounding lets run."""
    seconds = {place: shortest_seconds(LAB, place) for place in PLACES[:4]}
    assert max(seconds["Checkpoint C"], seconds["Checkpoint D"]) < 6.0 and seconds["Checkpoint A"] > 8.5
    mission = Mission((Constraint("deadline", PLACES[:4], seconds=7),))
    shares = solve(FieldProblem.from_mission(mission, LAB, FieldOptions(cell_metres=0.1))).branch_shares
    assert 0 < shares["Checkpoint A"] < 1e-4
    np.testing.assert_allclose([shares["Checkpoint C"], shares["Checkpoint D"]], 0.5, rtol=0.05)


def test_cells_grow_with_the_automaton():
    fine = FieldProblem.from_mission(reach("Checkpoint A", 20), LAB)
    assert fine.grid.cell_metres == 0.05 and fine.reference.modes == 17 and fine.rough is None
    many = Mission((Constraint("eventually", PLACES, different=3, max_gap_seconds=14.0),))
    coarse = FieldProblem.from_mission(many, LAB)
    assert coarse.grid.cell_metres == 0.1
    assert coarse.reference.states * len(coarse.automaton.delta) <= coarse.options.state_budget
    assert coarse.rough is not None


def test_a_first_fit_on_rough_cells_changes_the_way_not_the_result():
    many = Mission((Constraint("eventually", PLACES, different=2, max_gap_seconds=12.0),))
    problem = FieldProblem.from_mission(many, LAB, FieldOptions(marginal_tolerance=1e-6))
    assert problem.rough is not None
    assisted, alone = solve(problem), solve(replace(problem, rough=None))
    assert max(assisted.marginal_error, alone.marginal_error) <= 1e-6
    np.testing.assert_allclose(assisted.tilt.log_branch, alone.tilt.log_branch, atol=1e-4)
    assert assisted.log_partition == pytest.approx(alone.log_partition, abs=1e-4)
    np.testing.assert_allclose(list(assisted.branch_shares.values()), 0.2, atol=1e-6)


def test_reweighting_step_solves_the_sampled_problem():
    rng = np.random.default_rng(1)
    visits = np.stack([rng.permuted([1, 1, 0, 0, 0]) for _ in range(400)]).astype(float)
    visits = visits[rng.random(400) < np.where(visits[:, 0] > 0, 0.2, 1.0)]
    residual = np.log(0.4 / visits.mean(axis=0))
    move = reweighting_step(visits, residual, [5])
    weight = np.exp(visits @ move)
    np.testing.assert_allclose(weight @ visits / weight.sum(), 0.4, atol=1e-9)


def test_start_is_uniform_over_the_free_cells_of_the_region():
    problem = FieldProblem.from_mission(reach("Checkpoint A", 25), LAB, FieldOptions(cell_metres=0.05))
    used = problem.start > 0
    np.testing.assert_array_equal(used, LAB.adversary_start.contains(problem.grid.centres))
    np.testing.assert_allclose(problem.start[used], 1 / used.sum())
    field = solve(problem)
    np.testing.assert_allclose(field.occupancy[0], problem.start, atol=1e-12)
    tiny = replace(LAB, adversary_start=Disc(1.52, 0.41, 0.01))
    alone = FieldProblem.from_mission(reach("Checkpoint A", 25), tiny, FieldOptions(cell_metres=0.1))
    assert alone.start.max() == 1 and np.hypot(*(alone.grid.centres[alone.start.argmax()] - (1.52, 0.41))) < 0.08


def test_text_in_arrows_out():
    problem = FieldProblem.from_mission("Reach Checkpoint A within 25s", LAB, FieldOptions(cell_metres=0.15))
    assert problem.branch_places == ("Checkpoint A",)


@pytest.fixture(scope="module")
def jumping():
    options = FieldOptions(reference="walk", cell_metres=0.1, kernel="marginal")
    return solve(FieldProblem.from_mission(reach("Checkpoint E", 9), LAB, options))


def test_marginal_kernel_keeps_the_marginals_and_jumps(jumping):
    count = 20_000
    paths = jumping.sample(np.random.default_rng(2), count, 20)
    for t in (0, 5, 12, 18):
        got = np.bincount(paths.cells[:, t], minlength=jumping.chain.cells) / count
        assert np.abs(got - jumping.occupancy[t]).sum() < 0.2
        done = ((paths.completed_tick >= 0) & (paths.completed_tick <= t)).mean()
        assert done == pytest.approx(jumping.completion_probability[t], abs=0.02)
    step = np.hypot(*np.moveaxis(np.diff(paths.positions, axis=1), 2, 0))
    bridge = solve(replace(jumping.problem, options=replace(jumping.problem.options, kernel="bridge")))
    smooth = bridge.sample(np.random.default_rng(2), 500, 20)
    longest = np.hypot(*np.moveaxis(np.diff(smooth.positions, axis=1), 2, 0)).max()
    assert longest < 0.29 and step[:, 5:15].max() > 0.4


def test_marginal_belief_forgets_what_was_seen(jumping):
    belief = jumping.belief()
    for _ in range(6):
        belief.predict()
    assert belief.condition_on_seen((1.3, 0.45))
    assert belief.cell_marginal() @ np.hypot(*(jumping.problem.grid.centres - (1.3, 0.45)).T) < 0.15
    paths = sample_paths(jumping.chain, belief, np.random.default_rng(0), 50, 3)
    assert np.hypot(*(paths.positions[:, 0] - (1.3, 0.45)).T).max() < 0.5
    belief.predict()
    np.testing.assert_allclose(belief.cell_marginal(), jumping.occupancy[7], atol=1e-12)
    belief.condition_on_seen((2.8, 2.8))
    assert belief.fallbacks == 1 and belief.masses.sum() == pytest.approx(1)


def test_picture(tmp_path, jumping):
    path = tmp_path / "field.png"
    figure = jumping.plot(path, panels=5)
    assert path.read_bytes()[:8] == b"\x89PNG\r\n\x1a\n"
    titles = [axis.get_title() for axis in figure.axes]
    assert titles[0].startswith("0 s") and any(title.startswith("40 samples") for title in titles)
    bare = replace(jumping.problem, grid=None, scenario=None)
    with pytest.raises(ValueError, match="this one has no planar map"):
        solve(bare).plot(tmp_path / "no.png")


def test_speed_limits_get_references_of_their_own():
    slow = Mission(
        (
            Constraint("deadline", ("Checkpoint E",), seconds=20, speed_limit=0.1),
            Constraint("deadline", PLACES[:1], seconds=45),
        )
    )
    field = solve(FieldProblem.from_mission(slow, LAB, FieldOptions(cell_metres=0.1, headings=8)))
    assert field.problem.reference.count == 2
    assert set(field.problem.reference_of) == {0, 1}
    paths = field.sample(np.random.default_rng(0), 200, 80)
    before = field.problem.automaton.speed_limit[paths.automaton_states[:, :-1]] < 0.2
    # Rounded to cells a single tick says little; over ten the mean does.
    length = np.hypot(*np.moveaxis(np.diff(paths.positions, axis=1), 2, 0))
    assert length[before].mean() < 0.075
    assert length[~before].mean() > 0.09


def test_start_region_may_be_a_box():
    boxed = replace(LAB, adversary_start=Box(1.2, 0.2, 1.8, 0.6))
    problem = FieldProblem.from_mission(reach("Checkpoint A", 25), boxed, FieldOptions(cell_metres=0.1))
    assert (problem.start > 0).sum() == 24
