"""What a problem takes is known before it starts: counted by hand, measured, and refused beyond the bound."""

from __future__ import annotations

import time
import tracemalloc
from dataclasses import replace

import numpy as np
import pytest

from tab_marl.field import FieldOptions, FieldProblem, FieldTooLarge, run_and_tumble, solve
from tab_marl.field.messages.support import support_of
from tab_marl.mission import FiniteAutomaton
from tab_marl.world.grid import GridMap
from tab_marl.world.scenario import Scenario

AUTOMATON = FiniteAutomaton([[0, 1, 0], [1, 1, 2], [2, 2, 2]], 0, 2)


def problem_on(side: int, horizon: int, **options: object) -> FieldProblem:
    """A then B in opposite corners of an open square of cells, 8 headings and rest."""
    grid = GridMap.from_array(np.ones((side, side), dtype=bool))
    labels = np.zeros(grid.cells, dtype=int)
    labels[-1], labels[side - 1] = 1, 2
    start = np.eye(grid.cells)[0]
    return FieldProblem.from_arrays(
        run_and_tumble(grid, 1.0, 8, 3.0), labels, AUTOMATON, start, horizon, FieldOptions(**options), grid=grid
    )  # type: ignore[arg-type]


def test_size_counts_what_there_is() -> None:
    problem = problem_on(20, 60)
    size = problem.size()
    assert size.cells == 400 and size.modes == 9
    # Before A: ticks 0 to 58. After A: ticks 1 to 59. The initial state and two absorbing ones.
    assert size.automaton_states == 59 + 59 + 3
    assert size.product_states == 121 * 400 * 9
    assert size.moves == problem.reference.matrix().shape[0] * 4  # at most four ends to a move, padded to four
    assert size.ticks == 60
    assert size.passes == 1
    assert size.memory.messages == 4 * size.product_states
    double = replace(problem, options=replace(problem.options, precision="double")).size()
    assert double.memory.messages == 2 * size.memory.messages
    assert "121 automaton states x 400 cells x 9 modes = 435,600 messages over 60 ticks" in str(size)
    assert size.memory.masses == 0
    # A forward pass holds the rows of at most three automaton states: before and after A, now and a tick later.
    fitted = replace(problem, options=replace(problem.options, completion_probability=0.5)).size()
    assert fitted.passes > 1
    assert 2 <= fitted.memory.masses / (8 * 400 * 9) <= 4


def test_bytes_are_those_that_solving_takes() -> None:
    for options in ({}, {"precision": "double"}, {"completion_probability": 0.7, "marginal_tolerance": 1e-3}):
        problem = problem_on(30, 80, **options)
        solve(problem)  # the reference derives its arrays once
        size = problem.size()
        tracemalloc.start()
        solve(problem)
        taken = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        found_before = size.memory.reference + size.memory.support
        assert 1 / 1.5 < (size.memory.total - found_before) / taken < 1.5, options


def test_a_large_table_is_counted_by_its_pages() -> None:
    """Above `state_budget` only what the motion can reach is solved for; the estimate counts the same pages."""
    rings = np.tile(np.arange(12)[:, None], (1, 3))
    rings[:, 1] = np.minimum(np.arange(12) + 1, 11)  # eleven visits to A, one tick each
    side = 60
    grid = GridMap.from_array(np.ones((side, side), dtype=bool))
    labels = np.zeros(grid.cells, dtype=int)
    labels[-1] = 1
    problem = FieldProblem.from_arrays(
        run_and_tumble(grid, 1.0, 8, 3.0), labels, FiniteAutomaton(rings, 0, 11), np.eye(grid.cells)[0], 120,
        FieldOptions(precision="double", state_budget=1000), grid=grid,
    )  # fmt: skip
    size = problem.size()
    table = 8 * size.product_states
    possible = support_of(problem, True, False).possible
    assert possible.sum() * 9 * 8 < size.memory.messages < 0.9 * table
    first = np.flatnonzero(possible) * 9 * 8
    pages = np.union1d(first // 4096, (first + 9 * 8 - 1) // 4096)
    assert size.memory.messages == pytest.approx(4096 * len(pages), rel=0.15)


def test_seconds_grow_with_the_problem_and_are_about_right() -> None:
    problem = problem_on(40, 150)
    solve(problem)
    taken = []
    for _ in range(3):
        began = time.thread_time()
        solve(problem)
        taken.append(time.thread_time() - began)
    # On a machine to itself within a factor of 2 (benchmarks/field_estimates.py); a busy one is less exact.
    assert 0.2 < problem.size().seconds / min(taken) < 5


def test_too_large_is_refused_with_the_numbers() -> None:
    problem = problem_on(20, 60, memory_gigabytes=0.001)
    with pytest.raises(FieldTooLarge, match=r"needs 0.00\d+ GB \(121 automaton states x 400 cells x 9 modes x 4 bytes.*"
                       r"memory_gigabytes = 0.001: use larger cells.*pruned\(\), or raise the bound"):  # fmt: skip
        solve(problem)
    solve(replace(problem, options=replace(problem.options, memory_gigabytes=0.01)))
    # Single precision would fit, the second try in double does not.
    lab = Scenario.preset("lab")
    with pytest.raises(FieldTooLarge, match=r"needs more than .* 1\d,\d{3} cells x 1[67] modes"):
        FieldProblem.from_mission(
            "Reach Checkpoint A within 50s",
            lab,
            FieldOptions(cell_metres=0.025, memory_gigabytes=0.01, only_reachable=False),
        )
    with pytest.raises(ValueError, match=r"memory_gigabytes is 0.0, must be > 0"):
        FieldOptions(memory_gigabytes=0.0)
