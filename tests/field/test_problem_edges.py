"""Problems by hand: what pruning leaves, a mission in space from words to samples, what is refused, a closed form."""

from __future__ import annotations

import itertools
import math
from dataclasses import replace

import numpy as np
import pytest

from tab_marl.field import FieldOptions, FieldProblem, InfeasibleField, TimingPrior, paper_walk, solve
from tab_marl.mission import FiniteAutomaton
from tab_marl.world.grid import GridMap
from tab_marl.world.solids import Cuboid
from tab_marl.world.volume import BallCheckpoint, Volume


def test_pruning_leaves_out_what_motion_cannot_do() -> None:
    """On a corridor of 12 cells, one cell a tick: A at cell 3, then B at cell 9 within 10 ticks. How many states matter
    can be counted: A at tick 3 or later with 6 ticks left for the way to B."""
    free = np.ones((1, 12), dtype=bool)
    grid = GridMap.from_array(free)
    labels = np.zeros(12, dtype=int)
    labels[3], labels[9] = 1, 2
    automaton = FiniteAutomaton([[0, 1, 0], [1, 1, 2], [2, 2, 2]], 0, 2)
    start = np.eye(12)[0]
    problem = FieldProblem.from_arrays(paper_walk(grid, 1.0), labels, automaton, start, 10, grid=grid)
    smaller = problem.pruned()
    # By labels alone: before A at ticks 0 to 8, after A at ticks 1 to 9 (no start lies in A), three more.
    assert problem.automaton.states == 9 + 9 + 3
    # Before A: ticks 0 to 3 (A by tick 4, for B is 6 away). After A: ticks 3 to 9.
    assert smaller.automaton.states == 4 + 7 + 3
    a, b = solve(problem), solve(smaller)
    np.testing.assert_allclose(a.occupancy, b.occupancy, atol=1e-13)
    assert a.kl_to_reference == pytest.approx(b.kl_to_reference, abs=1e-12)
    uncertain = FieldProblem.from_arrays(
        paper_walk(grid, 1.0),
        labels,
        automaton,
        start,
        10,
        FieldOptions(completion_probability=0.5, precision="double"),
    )
    with pytest.raises(ValueError, match="prune first"):
        uncertain.constrained(TimingPrior()).pruned()
    # Where it may fail, what can only fail stays: A too late for B. Nothing is before A at tick 9 but by never going there.
    for posed in (uncertain, uncertain.pruned()):
        assert solve(posed).completes == pytest.approx(0.5)
    assert uncertain.pruned().automaton.states > smaller.automaton.states
    np.testing.assert_allclose(solve(uncertain).occupancy, solve(uncertain.pruned()).occupancy, atol=1e-12)
    short = FieldProblem.from_arrays(paper_walk(grid, 1.0), labels, automaton, start, 8)
    with pytest.raises(InfeasibleField, match="nothing to keep"):
        short.pruned()


def test_a_field_in_space_answers() -> None:
    """The whole way from words to samples and a filter, in three dimensions."""
    volume = Volume(
        "tank",
        (BallCheckpoint("Ball 1", 2, 8, 1, 0.6), BallCheckpoint("Ball 2", 8, 8, 4, 0.6)),
        Cuboid(1, 1, 1, 2, 2, 2),
    )
    text = "Reach Ball 1 then Ball 2 within 20 s while avoiding the central ball"
    for reference in ("walk", "run_and_tumble"):
        field = solve(
            FieldProblem.from_mission(text, volume, FieldOptions(reference=reference, headings=6, cell_metres=0.5))
        )
        grid = field.problem.grid
        np.testing.assert_allclose(field.occupancy.sum(axis=1), 1)
        before = field.occupancy_by_status[:, 0]
        assert before[:, grid.inside(volume.region("central zone"))].max() < 1e-12
        assert field.completion_probability[40] == pytest.approx(1, abs=1e-6)
        assert field.completion_probability[15] == 0
        paths = field.sample(np.random.default_rng(0), 30)
        assert paths.positions.shape == (30, 121, 3)
        assert (paths.completed_tick > 20).all() and (paths.completed_tick <= 40).all()
        for cells, done in zip(paths.cells, paths.completed_tick, strict=True):
            inside = [
                grid.inside(volume.region(name))[cells[: done + 1]] for name in ("Ball 1", "Ball 2", "central zone")
            ]
            assert inside[0].any() and inside[1][-1] and not inside[2].any()
            assert np.argmax(inside[0]) < done
        belief = field.belief()
        for _ in range(10):
            belief.predict()
        assert belief.condition_on_seen(paths.positions[0, 10])
        assert belief.cell_marginal() @ grid.centres == pytest.approx(paths.positions[0, 10], abs=0.6)
    with pytest.raises(ValueError, match="moves in the plane"):
        FieldProblem.from_mission(text, volume, FieldOptions(reference="unicycle", cell_metres=0.5))


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"labels": [0, 0, 3, 1]}, r"labels must be a non-empty set of symbols in 0..2"),
        ({"labels": [0, 0, 2]}, r"labels has shape \(3,\), must be \[4\]"),
        ({"start": [0.5, 0.0, 0.0, 0.0]}, "start sums to 0.5, must sum to 1"),
        ({"start": [1.5, -0.5, 0.0, 0.0]}, "start has the entry -0.5"),
        ({"horizon": -2}, "horizon_ticks is -2"),
        ({"transitions": np.full((4, 4), 0.3)}, "row 0 sums to 1.2, must be <= 1"),
        ({"transitions": np.ones((4, 3))}, "must be square"),
        ({"reference_of": [0, 1]}, r"reference_of has shape \(2,\), must be \[3\]"),
        ({"reference_of": [0, 1, 0]}, r"entries in 0..0"),
    ],
)
def test_bad_arrays(changes: dict[str, object], says: str) -> None:
    good = {
        "transitions": np.full((4, 4), 0.25), "labels": [0, 0, 1, 2],
        "automaton": FiniteAutomaton([[0, 1, 0], [1, 1, 2], [2, 2, 2]], 0, 2), "start": [1, 0, 0, 0], "horizon": 5,
    }  # fmt: skip
    with pytest.raises(ValueError, match=says):
        FieldProblem.from_arrays(**(good | changes))  # type: ignore[arg-type]


def test_an_automaton_with_cycles_is_refused_with_the_size_it_needs() -> None:
    automaton = FiniteAutomaton([[0, 1], [1, 1]], 0, 1).unrolled(5)
    looping = replace(automaton, delta=np.where(automaton.delta == 1, 0, automaton.delta))
    with pytest.raises(
        ValueError, match=r"not acyclic.* up to 8 x 41 ticks = 328 states; give it as a FiniteAutomaton"
    ):
        FieldProblem(np.full((2, 2), 0.5), [0, 1], looping, [1.0, 0.0], 40)


def test_words_of_a_walk_on_a_ring_are_counted() -> None:
    """A closed form: an even number of visits to one cell of two, each tick a fair coin: half of all words."""
    even = FiniteAutomaton([[0, 1], [1, 0]], 0, 0, accept="at_horizon")
    for horizon in range(1, 8):
        field = solve(FieldProblem.from_arrays(np.full((2, 2), 0.5), [0, 1], even, [1.0, 0.0], horizon))
        assert field.log_partition == pytest.approx(math.log(0.5), abs=1e-13)
        words = [w for w in itertools.product((0, 1), repeat=horizon) if sum(w) % 2 == 0]
        assert field.occupancy[1, 1] == pytest.approx(np.mean([w[0] for w in words]))
