"""Laws that hold on any map, for any mission and start: random ones, drawn by hypothesis."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from tab_marl.field import FieldOptions, FieldProblem, InfeasibleField, solve
from tab_marl.field.solve import layout
from tab_marl.mission import Constraint, Mission, Monitor
from tab_marl.world.regions import Box
from tab_marl.world.scenario import Checkpoint, Robot, Scenario

SIDE = 7
"""Cells to a side, of one metre."""
QUICK = settings(
    max_examples=25, deadline=None, derandomize=True, suppress_health_check=[HealthCheck.filter_too_much, HealthCheck.too_slow]
)  # fmt: skip
spot = st.tuples(st.integers(0, SIDE - 1), st.integers(0, SIDE - 1))
seconds = st.integers(3, 12).map(float)


@st.composite
def worlds(draw) -> Scenario:
    """Blocked cells anywhere, checkpoints and start in different free cells."""
    places = draw(st.lists(spot, min_size=4, max_size=4, unique=True))
    blocked = draw(st.lists(spot, max_size=12, unique=True))
    boxes = tuple(Box(x + 0.01, y + 0.01, x + 0.99, y + 0.99) for x, y in blocked if (x, y) not in places)
    (x, y), *goals = places
    width = draw(st.integers(1, 2))
    return Scenario(
        name="random",
        width_metres=SIDE,
        height_metres=SIDE,
        checkpoints=tuple(
            Checkpoint(f"Checkpoint {name}", a + 0.5, b + 0.5, 0.3, 0.5)
            for name, (a, b) in zip("ABC", goals, strict=True)
        ),
        obstacles=boxes,
        ego_start=Box(0, 0, SIDE, SIDE),
        adversary_start=Box(x, y, min(x + width, SIDE), y + 1),
        adversary=Robot(radius_metres=0.01, max_speed=draw(st.sampled_from([0.8, 1.0, 1.7]))),
        step_seconds=1.0,
        horizon_seconds=12.0,
        central_zone_metres=0.4,
    )


@st.composite
def missions(draw) -> Mission:
    names = draw(st.permutations(["Checkpoint A", "Checkpoint B", "Checkpoint C"]))
    first = draw(
        st.sampled_from(
            [
                Constraint("deadline", (names[0],), draw(seconds)),
                Constraint("deadline", tuple(names[:2]), draw(seconds)),
                Constraint("exact", (names[0],), draw(seconds)),
                Constraint("eventually", tuple(names), different=2, max_gap_seconds=draw(seconds)),
                Constraint("deadline", (names[0],), draw(seconds), recurrences=2),
            ]
        )
    )
    rest = draw(
        st.sampled_from(
            [
                (),
                (Constraint("eventually", (names[2],), restricted=(names[1],)),),
                (Constraint("always", ("top half",), avoid=True),),
                (Constraint("until", ("left half",), draw(seconds), avoid=True),),
                (Constraint("eventually", (names[1],), speed_limit=0.8),),
            ]
        )
    )
    return Mission((first, *rest))


references = st.sampled_from(["walk", "paper_walk", "run_and_tumble"])


def solved(world: Scenario, mission: Mission, reference: str, **options):
    choice = {"cell_metres": 1.0, "headings": 4, "precision": "double", "goal_marginals": False} | options
    problem = FieldProblem.from_mission(mission, world, FieldOptions(reference=reference, **choice))
    try:
        return solve(problem)
    except InfeasibleField:
        return None


@QUICK
@given(worlds(), missions(), references)
def test_the_law_completes_the_mission_on_the_free_map(world, mission, reference):
    field = solved(world, mission, reference)
    if field is None:
        return
    np.testing.assert_allclose(field.occupancy.sum(axis=1), 1, atol=1e-12)
    assert np.all(field.occupancy >= 0)
    assert np.all(np.diff(field.completion_probability) >= -1e-12)
    assert abs(field.completion_probability[-1] - 1) < 1e-12
    assert field.log_partition <= 1e-12
    assert abs(field.kl_to_reference + field.log_partition) < 1e-9
    # h is its own expectation under the reference wherever it counts.
    chain = field.bridge
    labels = chain.symbol_of
    support, _ = layout(field.problem, False)
    for q in range(len(chain.delta)):
        if q in (chain.initial, chain.accepting, chain.rejecting) or not np.isfinite(chain.log_scale[q]):
            continue
        ahead = chain.factor[q, labels] * chain.value[chain.delta[q, labels], np.arange(chain.states)]
        expected = field.problem.reference.matrix(int(chain.reference_of[q])) @ ahead
        np.testing.assert_allclose(
            chain.value[q], np.where(np.repeat(support.possible[q], chain.modes), expected, 0), rtol=1e-9, atol=1e-250
        )
    # Every sampled path does it, says the monitor, which knows nothing of fields.
    paths = field.sample(np.random.default_rng(0), 8)
    centres = chain.centres[paths.cells]
    for positions, completed in zip(centres, paths.completed_tick, strict=True):
        monitor = Monitor(mission, world, 1.0)
        status, tick = monitor.reset(positions[0]), 0
        while status == "active":
            tick += 1
            status = monitor.step(positions[tick])
        assert (status, tick) == ("completed", completed)


@QUICK
@given(worlds(), missions(), references)
def test_leaving_out_what_cannot_be_changes_nothing(world, mission, reference):
    everywhere = solved(world, mission, reference, only_reachable=False)
    reachable = solved(world, mission, reference, only_reachable=True)
    assert (everywhere is None) == (reachable is None)
    if everywhere is None:
        return
    np.testing.assert_allclose(reachable.occupancy, everywhere.occupancy, rtol=0, atol=1e-12)
    assert abs(reachable.log_partition - everywhere.log_partition) < 1e-11
    assert (reachable.bridge.value > 0).sum() <= (everywhere.bridge.value > 0).sum()


def test_shifted_sums_are_the_moves():
    """The same problem without its grid has no lattice and is solved from the rows of moves."""
    shifted = []

    @QUICK
    @given(worlds(), missions(), st.sampled_from(["walk", "run_and_tumble"]))
    def compare(world, mission, reference):
        by_shifts = solved(world, mission, reference)
        if by_shifts is None:
            return
        by_rows = solve(replace(by_shifts.problem, grid=None, scenario=None))
        assert layout(by_rows.problem, False)[1].size == 0
        np.testing.assert_allclose(by_rows.bridge.value, by_shifts.bridge.value, rtol=1e-10)
        np.testing.assert_allclose(by_rows.occupancy, by_shifts.occupancy, atol=1e-12)
        # Where walls cut every row short there is no stencil to be found.
        shifted.append(layout(by_shifts.problem, False)[1].size > 0)

    compare()
    assert sum(shifted) >= 5
