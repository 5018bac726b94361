"""Places that can stand for one another, and how often each of them is to be visited."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tab_marl.field.problem import FieldProblem

Floats = NDArray[np.float64]
ONE_VISIT = 1e-6
"""Rounding of the number of visits to a set of places of which one is visited."""


def goal_shares(problem: FieldProblem, group: NDArray[np.int64], free_visits: Floats) -> Floats:
    """``[n]``: which share of the visits to a set of alternatives each branch in `group` is wanted to have.

    `free_visits`: how often each is visited without the constraint.
    """
    options = problem.options
    total = float(free_visits.sum())
    free = free_visits / total if total > 0 else np.full(len(group), 1 / len(group))
    wanted = np.full(len(group), 1 / len(group))
    if options.goal_nearness > 0 and total < 1 + ONE_VISIT and _can_be_first(problem, group):
        metres = branch_metres(problem, group)
        if np.isfinite(metres).all():
            wanted = np.exp(-options.goal_nearness * (metres / metres.min() - 1))
            wanted = wanted / wanted.sum()
    return options.goal_marginals * wanted + (1 - options.goal_marginals) * free


def _can_be_first(problem: FieldProblem, group: NDArray[np.int64]) -> bool:
    """Whether all of these branches are on offer from the beginning."""
    automaton = problem.automaton
    begun = automaton.location == automaton.location[automaton.initial]
    return bool(np.isin(group, automaton.branch[begun]).all())


def branch_metres(problem: FieldProblem, group: NDArray[np.int64]) -> Floats:
    """``[n]``: the shortest way from the start to where each branch is taken, the mean over start cells and at least a
    cell; inf where there is none, or no map."""
    if problem.grid is None:
        return np.full(len(group), np.inf)
    start = np.asarray(problem.start)
    mean = np.array([start[start > 0] @ _ways(problem, b) for b in group])
    return np.maximum(mean, problem.grid.cell_metres)


def _ways(problem: FieldProblem, b: int) -> Floats:
    """Metres of the shortest way from each start cell to where a branch is taken; inf if there is none."""
    assert problem.grid is not None
    started = np.asarray(problem.start) > 0
    goal = np.flatnonzero(np.isin(np.asarray(problem.labels), np.nonzero(problem.automaton.branch == b)[1]))
    return problem.grid.distances(goal)[started] if len(goal) else np.full(int(started.sum()), np.inf)


def alternatives(problem: FieldProblem) -> list[NDArray[np.int64]]:
    """Sets of branches that some location offers side by side, joined where they overlap."""
    automaton = problem.automaton
    occurring = np.unique(np.asarray(problem.labels))
    parent = np.arange(int(automaton.branch.max(initial=-1)) + 1)

    def root(b: int) -> int:
        while parent[b] != b:
            b = int(parent[b])
        return b

    offered = automaton.branch[:, occurring]
    for location in np.unique(automaton.location):
        side_by_side = np.unique(offered[automaton.location == location])
        side_by_side = side_by_side[side_by_side >= 0]
        for b in side_by_side[1:]:
            for other in side_by_side[side_by_side < b]:
                if not automaton.sides or automaton.sides[b] == automaton.sides[other]:
                    parent[root(int(b))] = root(int(other))
    roots = np.array([root(b) for b in range(len(parent))], dtype=np.int64)
    groups = [np.flatnonzero(roots == r) for r in np.unique(roots)]
    return [group for group in groups if len(group) > 1]


def reachable_places(problem: FieldProblem, groups: list[NDArray[np.int64]]) -> list[NDArray[np.int64]]:
    """Leave out places farther from every start than full speed covers until they may last be visited.

    Rounding to cells lets the reference be faster than the robot with a small probability; equal mass would make it large.
    """
    grid, scenario = problem.grid, problem.scenario
    if grid is None or scenario is None or not groups:
        return groups
    automaton = problem.automaton
    tick_metres = scenario.adversary.max_speed * scenario.step_seconds
    kept = []
    for group in groups:
        reachable = []
        for b in group:
            latest = int(automaton.rank[np.nonzero(automaton.branch == b)[0]].max(initial=0))
            reachable.append(_ways(problem, b).min() <= latest * tick_metres + grid.cell_metres)
        if sum(reachable) > 1:
            kept.append(group[reachable])
    return kept
