"""Problems of every kind against the enumeration of all their trajectories; none of the field's own tables is trusted."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from scipy import sparse

from tab_marl.field import FieldOptions, FieldProblem, InfeasibleField, TabField, paper_walk, solve, walk
from tab_marl.field.processes import run_and_tumble
from tab_marl.mission import Constraint, FiniteAutomaton, Mission
from tab_marl.world.regions import Box, Disc
from tab_marl.world.scenario import Scenario
from tab_marl.world.solids import Ball, Cuboid
from tab_marl.world.volume import Body, Volume
from tab_marl.world.voxels import VoxelMap

PLAIN = {"goal_marginals": False, "precision": "double"}


def enumerated(
    horizon: int,
    start: np.ndarray,
    law_at: Callable[[tuple[int, ...]], np.ndarray],
    completes: Callable[[tuple[int, ...]], bool],
) -> tuple[np.ndarray, float, float]:
    """(occupancy [T + 1, C], mean log partition, completing share): every path of cells, weighed and judged as a whole.

    `law_at(path)` is the row [C] by which the reference leaves the end of a path; `completes(path)` judges whole paths.
    """
    cells = len(start)
    occupancy = np.zeros((horizon + 1, cells))
    log_partition = 0.0
    completing = 0.0
    kept = {}
    for first in np.flatnonzero(start):
        paths: list[tuple[tuple[int, ...], float]] = [((int(first),), 1.0)]
        for _ in range(horizon):
            paths = [
                ((*path, int(c)), p * row[c])
                for path, p in paths
                for row in (law_at(path),)
                for c in np.flatnonzero(row)
            ]
        kept[first] = [(path, p) for path, p in paths if completes(path)]
        total = sum(p for _, p in kept[first])
        completing += start[first] * total
    possible = {first: sum(p for _, p in found) for first, found in kept.items()}
    mass = sum(start[first] for first, total in possible.items() if total > 0)
    for first, total in possible.items():
        if total > 0:
            log_partition += start[first] / mass * math.log(total)
            for path, p in kept[first]:
                occupancy[np.arange(horizon + 1), path] += start[first] / mass * p / total
    return occupancy, log_partition, completing


def agrees(field: TabField, occupancy: np.ndarray, log_partition: float) -> None:
    np.testing.assert_allclose(field.occupancy, occupancy, rtol=0, atol=1e-12)
    assert field.log_partition == pytest.approx(log_partition, abs=1e-12)


# Raw arrays.


@st.composite
def raw_problems(draw: st.DrawFn) -> tuple[np.ndarray, np.ndarray, FiniteAutomaton, np.ndarray, int]:
    cells, states, symbols = draw(st.integers(2, 4)), draw(st.integers(2, 4)), draw(st.integers(1, 3))
    rng = np.random.default_rng(draw(st.integers(0, 2**32)))
    law = rng.random((cells, cells)) * (rng.random((cells, cells)) < 0.7) + np.eye(cells) * 0.1
    law /= law.sum(axis=1, keepdims=True)
    accept = draw(st.sampled_from(["reached", "at_horizon"]))
    automaton = FiniteAutomaton(rng.integers(0, states, (states, symbols)), 0, states - 1, accept=accept)
    start = rng.random(cells) * (rng.random(cells) < 0.7)
    start[0] += 0.2
    return law, rng.integers(0, symbols, cells), automaton, start / start.sum(), draw(st.integers(0, 4))


@settings(max_examples=120, deadline=None)
@given(raw_problems(), st.sampled_from(["dense", "csr", "csc", "coo"]))
def test_any_automaton_on_any_chain(problem, form: str) -> None:
    law, labels, automaton, start, horizon = problem

    def completes(path: tuple[int, ...]) -> bool:
        q = 0
        for cell in path:
            q = int(automaton.table[q, labels[cell]])
            if automaton.accept == "reached" and q in automaton.accepting:
                return True
        return automaton.accept == "at_horizon" and q in automaton.accepting

    given_as = law if form == "dense" else getattr(sparse, f"{form}_array")(law)
    occupancy, log_partition, completing = enumerated(horizon, start, lambda path: law[path[-1]], completes)
    posed = FieldProblem.from_arrays(given_as, labels, automaton, start, horizon)
    if completing == 0:
        with pytest.raises(InfeasibleField):
            solve(posed)
        return
    field = solve(posed)
    agrees(field, occupancy, log_partition)
    smaller = posed.pruned()
    assert smaller.automaton.states <= posed.automaton.states
    agrees(solve(smaller), occupancy, log_partition)


def test_several_references_for_the_states_of_a_cyclic_automaton() -> None:
    """Visit cell 3 and then cell 0: on the way back the chain drifts the other way."""
    forth = np.array([[0.5, 0.5, 0, 0], [0.1, 0.4, 0.5, 0], [0, 0.1, 0.4, 0.5], [0, 0, 0.5, 0.5]])
    back = forth[::-1, ::-1].copy()
    automaton = FiniteAutomaton([[0, 0, 1], [2, 1, 1], [2, 2, 2]], 0, 2)
    labels = np.array([0, 1, 1, 2])
    start = np.array([0, 1.0, 0, 0])

    def stage(path: tuple[int, ...]) -> int:
        if 3 not in path:
            return 0
        return 2 if 0 in path[path.index(3) :] else 1

    def law_at(path: tuple[int, ...]) -> np.ndarray:
        return (forth, back, forth)[stage(path)][path[-1]]

    occupancy, log_partition, _ = enumerated(8, start, law_at, lambda path: stage(path) == 2)
    posed = FieldProblem.from_arrays([forth, back], labels, automaton, start, 8, reference_of=[0, 1, 0])
    agrees(solve(posed), occupancy, log_partition)


def test_the_example_of_the_page() -> None:
    """docs/field/problems.md, as it stands there."""
    import re
    from pathlib import Path

    page = (Path(__file__).parents[2] / "docs" / "field" / "problems.md").read_text()
    blocks = re.findall(r"```python\n(.*?)```", page, flags=re.DOTALL)
    assert len(blocks) >= 5
    namespace: dict[str, object] = {}
    for block in blocks:
        exec(block, namespace)  # noqa: S102 - the page is ours, in this repository
    field = namespace["field"]
    assert isinstance(field, TabField)
    # The first block by hand: from cell 0 of a ring, 6 ticks, back at 0 an even number of times at the end.
    posed = namespace["parity"]
    assert isinstance(posed, TabField)

    def completes(path: tuple[int, ...]) -> bool:
        return sum(cell == 0 for cell in path) % 2 == 0

    ring = np.array([[0, 0.5, 0, 0.5], [0.5, 0, 0.5, 0], [0, 0.5, 0, 0.5], [0.5, 0, 0.5, 0]])
    occupancy, log_partition, _ = enumerated(6, np.eye(4)[0], lambda path: ring[path[-1]], completes)
    agrees(posed, occupancy, log_partition)


# Missions on maps of two and three dimensions: what each stage allows, judged on the whole path.


def flat(**changes: object) -> Scenario:
    """3 x 2 cells of 1 m."""
    named = (("goal", Disc(0.5, 1.5, 0.2)), ("bog", Disc(1.5, 0.5, 0.2)), ("end", Disc(2.5, 0.5, 0.2)))
    settings_: dict[str, object] = {
        "name": "flat", "checkpoints": (), "ego_start": Box(0, 0, 1, 1), "adversary_start": Box(0, 0, 2, 2),
        "width_metres": 3.0, "height_metres": 2.0, "regions": named, "step_seconds": 1.0, "horizon_seconds": 4.0,
        "central_zone_metres": 0.1,
    }  # fmt: skip
    from tab_marl.world.scenario import Robot

    return Scenario(**(settings_ | {"adversary": Robot(0.01, 1.0)} | changes))  # type: ignore[arg-type]


def deep(**changes: object) -> Volume:
    """2 x 2 x 2 cells of 1 m."""
    named = (("goal", Ball(0.5, 1.5, 0.5, 0.2)), ("bog", Ball(0.5, 0.5, 1.5, 0.2)), ("end", Ball(1.5, 1.5, 1.5, 0.2)))
    settings_: dict[str, object] = {
        "name": "deep", "checkpoints": (), "adversary_start": Cuboid(0, 0, 0, 2, 1, 1),
        "width_metres": 2.0, "depth_metres": 2.0, "height_metres": 2.0, "regions": named, "step_seconds": 1.0,
        "horizon_seconds": 4.0, "central_zone_metres": 0.1, "adversary": Body(0.01, 1.0),
    }  # fmt: skip
    return Volume(**(settings_ | changes))  # type: ignore[arg-type]


def stage_times(path: tuple[int, ...], goal: int, end: int) -> tuple[float, float]:
    """Ticks at which goal, and after it end, are first visited."""
    first = next((t for t, cell in enumerate(path) if cell == goal), math.inf)
    second = next((t for t, cell in enumerate(path) if cell == end and t > first), math.inf)
    return first, second


@pytest.mark.parametrize("reference", ["walk", "paper_walk"])
@pytest.mark.parametrize("world", [flat(), deep()], ids=["2-D", "3-D"])
@pytest.mark.parametrize(
    "rule", ["slow first stage", "slow last stage", "always slow", "zone first", "zone last", "all"]
)
def test_speed_limits_and_zones_of_a_stage(world: Scenario | Volume, rule: str, reference: str) -> None:
    """ "goal then end": limits and zones bind while their stage is current, and not before or after."""
    slow, beside = 0.6, ()
    first, last = {}, {}
    if rule in ("slow first stage", "all"):
        first["speed_limit"] = slow
    if rule == "slow last stage":
        last["speed_limit"] = slow
    if rule in ("zone first",):
        first["restricted"] = ("bog",)
    if rule in ("zone last", "all"):
        last["restricted"] = ("bog",)
    if rule == "always slow":
        beside = (Constraint("always", speed_limit=slow),)
    mission = Mission(
        (Constraint("eventually", ("goal",), **first), Constraint("deadline", ("end",), seconds=4, **last), *beside)
    )
    options = FieldOptions(reference=reference, cell_metres=1.0, **PLAIN)
    problem = FieldProblem.from_mission(mission, world, options)
    grid = problem.grid
    goal, bog, end = (int(grid.cells_of([world.region(name).centre])[0]) for name in ("goal", "bog", "end"))
    process = walk if reference == "walk" else paper_walk
    fast, slowed = (process(grid, speed).matrix().toarray() for speed in (1.0, slow))
    limited = {
        "slow first stage": (slowed, fast), "slow last stage": (fast, slowed), "always slow": (slowed, slowed),
        "all": (slowed, fast),
    }.get(rule, (fast, fast))  # fmt: skip

    def law_at(path: tuple[int, ...]) -> np.ndarray:
        done, over = stage_times(path, goal, end)
        return (fast if over < math.inf else limited[1] if done < math.inf else limited[0])[path[-1]]

    def completes(path: tuple[int, ...]) -> bool:
        done, over = stage_times(path, goal, end)
        if over > 4:
            return False
        # A stage's zone binds from the tick after its predecessor's completion to the one that completes it.
        if rule == "zone first" and bog in path[: int(done) + 1]:
            return False
        return not (rule in ("zone last", "all") and bog in path[int(done) + 1 : int(over) + 1])

    occupancy, log_partition, completing = enumerated(4, problem.start, law_at, completes)
    if completing == 0:  # at 0.6 cells a tick the paper's walk cannot leave its cell
        with pytest.raises(InfeasibleField):
            solve(problem)
        assert reference == "paper_walk" and ("slow" in rule or rule == "all")
        return
    field = solve(problem)
    agrees(field, occupancy, log_partition)
    smaller = problem.pruned()
    assert smaller.automaton.states < problem.automaton.states
    agrees(solve(smaller), occupancy, log_partition)


@pytest.mark.parametrize("world", [flat(), deep()], ids=["2-D", "3-D"])
def test_both_missions_are_completed(world: Scenario | Volume) -> None:
    """ "goal within 3 s" and "end, keeping out of the bog until then": in any order, each with its own rules."""
    one = Mission((Constraint("deadline", ("goal",), seconds=3),))
    other = Mission((Constraint("eventually", ("end",), restricted=("bog",), speed_limit=0.6),))
    options = FieldOptions(reference="walk", cell_metres=1.0, **PLAIN)
    problem = FieldProblem.from_mission([one, other], world, options)
    grid = problem.grid
    goal, bog, end = (int(grid.cells_of([world.region(name).centre])[0]) for name in ("goal", "bog", "end"))
    fast, slowed = (walk(grid, speed).matrix().toarray() for speed in (1.0, 0.6))

    def first(path: tuple[int, ...], cell: int) -> float:
        return next((t for t, at in enumerate(path) if at == cell), math.inf)

    def completes(path: tuple[int, ...]) -> bool:
        arrived = first(path, end)
        return first(path, goal) <= 3 and arrived <= 4 and bog not in path[: int(arrived) + 1]

    def law_at(path: tuple[int, ...]) -> np.ndarray:
        return (fast if first(path, end) < math.inf else slowed)[path[-1]]

    occupancy, log_partition, _ = enumerated(4, problem.start, law_at, completes)
    field = solve(problem)
    agrees(field, occupancy, log_partition)
    assert field.branch_visits == pytest.approx({"goal": 1.0, "end": 1.0})


def test_alternatives_of_joint_missions_do_not_mix() -> None:
    """Any of three here and any of two there: a third each, and a half each."""
    corners = [(0.5, 0.5), (3.5, 0.5), (0.5, 3.5), (3.5, 3.5), (1.5, 3.5)]
    named = tuple((f"place {n}", Disc(x, y, 0.2)) for n, (x, y) in enumerate(corners))
    scenario = flat(width_metres=4.0, height_metres=4.0, regions=named, horizon_seconds=9.0)
    three = Mission((Constraint("eventually", ("place 0", "place 1", "place 2")),))
    two = Mission((Constraint("eventually", ("place 3", "place 4")),))
    options = FieldOptions(reference="walk", cell_metres=1.0, precision="double", marginal_tolerance=1e-9)
    field = solve(FieldProblem.from_mission([three, two], scenario, options))
    visits = list(field.branch_visits.values())
    assert visits == pytest.approx([1 / 3] * 3 + [1 / 2] * 2, abs=1e-6)


# Random maps, missions and starts.

TYPES = st.sampled_from(["deadline", "eventually", "sequence", "any of two", "avoid", "zone", "slow"])


@settings(max_examples=25, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.integers(0, 2**32), TYPES, st.booleans())
def test_random_maps_missions_and_starts(oracle, seed: int, kind: str, memory: bool) -> None:
    """A map with random walls, random places and a random start, with and without a memory of the heading."""
    enumerate_trajectories, mission_runner = oracle
    rng = np.random.default_rng(seed)
    free = rng.random((2, 3)) < 0.8
    free[0, 0] = True
    walls = tuple(Box(x + 0.1, y + 0.1, x + 0.9, y + 0.9) for y, x in np.argwhere(~free).tolist())
    at = rng.permutation(np.argwhere(free))
    places = [tuple(float(v) + 0.5 for v in at[i % len(at)][::-1]) for i in range(3)]
    regions = tuple((name, Disc(*place, 0.2)) for name, place in zip(("one", "two", "three"), places, strict=True))
    x, y = at[-1][::-1].tolist()
    horizon = 3 if memory else 4
    scenario = flat(
        regions=regions, obstacles=walls, adversary_start=Box(x, y, x + 1, y + 1), horizon_seconds=float(horizon)
    )
    bound = float(rng.integers(1, horizon + 1))
    mission = Mission(
        {
            "deadline": (Constraint("deadline", ("one",), seconds=bound),),
            "eventually": (Constraint("eventually", ("one",)),),
            "sequence": (Constraint("eventually", ("one",)), Constraint("deadline", ("two",), seconds=bound)),
            "any of two": (Constraint("deadline", ("one", "two"), seconds=bound),),
            "avoid": (Constraint("always", ("two",), avoid=True), Constraint("eventually", ("one",))),
            "zone": (Constraint("eventually", ("one",), restricted=("three",)), Constraint("eventually", ("two",))),
            "slow": (Constraint("eventually", ("one",), speed_limit=0.5), Constraint("eventually", ("three",))),
        }[kind]
    )
    reference = (
        {"reference": "run_and_tumble", "headings": 4, "mean_run_metres": 2.0} if memory else {"reference": "walk"}
    )
    problem = FieldProblem.from_mission(mission, scenario, FieldOptions(cell_metres=1.0, **PLAIN, **reference))
    assert problem.grid.cells == free.sum()
    every = enumerate_trajectories(problem, horizon, mission_runner(mission, scenario, problem.grid))
    completing = every.completed_tick >= 0
    if not completing.any():
        with pytest.raises(InfeasibleField):
            solve(problem)
        return
    law = every.tilted(np.where(completing, 0.0, -np.inf))
    for posed in (problem, problem.pruned()):
        field = solve(posed)
        np.testing.assert_allclose(field.occupancy, every.occupancy(law, field.chain.cells), rtol=0, atol=1e-12)
        assert field.kl_to_reference == pytest.approx(every.divergence(law), abs=1e-11)


def test_a_reference_of_ones_own_in_a_mission() -> None:
    """`process` replaces the reference; on the same walk it changes nothing, and it must fit the map."""
    world = deep()
    text = "Reach goal then end within 4 s"
    options = FieldOptions(cell_metres=1.0, reference="walk")
    usual = solve(FieldProblem.from_mission(text, world, options))
    own = solve(FieldProblem.from_mission(text, world, options, process=walk))
    np.testing.assert_array_equal(usual.occupancy, own.occupancy)
    other = VoxelMap.from_array(np.ones((3, 3, 3), dtype=bool))
    with pytest.raises(ValueError, match=r"process returned 1 references over 27 cells, must be 1 .* 8 cells"):
        FieldProblem.from_mission(text, world, options, process=lambda grid, speeds: walk(other, speeds))
    tumbling = solve(
        FieldProblem.from_mission(
            text, world, options, process=lambda grid, speeds: run_and_tumble(grid, speeds, 6, 1.0)
        )
    )
    assert tumbling.chain.modes == 7
    assert tumbling.completes == pytest.approx(1, abs=1e-6)
