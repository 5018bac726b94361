"""Targets that contradict one another: which ones, what could be had instead.

What K events can do together is a finite matter: each trajectory ends with a pattern (mission completed or not, each
event happened or not). Which patterns have positive mass from which start cell is read off backward passes, one per pattern;
the attainable probabilities are then a polytope, and linear programming finds the conflict.
"""

from __future__ import annotations

from collections.abc import Callable
from itertools import product
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from scipy import optimize

from tab_marl.field.chain import ProductChain
from tab_marl.field.constraints.events import Completes, SoftConstraint
from tab_marl.field.constraints.tilt import Tilt
from tab_marl.field.infeasible import InfeasibleField
from tab_marl.field.problem import COMPLETE, FieldProblem
from tab_marl.field.tab_field import start_log_partition

if TYPE_CHECKING:
    from tab_marl.field.constraints.tracking import Tracking

Floats = NDArray[np.float64]
MOST_EVENTS = 8
"""Beyond it 2^K patterns take too long to enumerate."""
MISSED = 1e-7
"""A deviation of the targets that counts as a conflict."""


class ContradictoryConstraints(InfeasibleField):
    """No distribution over trajectories has all these probabilities."""


def explain(
    problem: FieldProblem, message: Callable[[FieldProblem, Tilt], ProductChain], soft: bool, completion: float
) -> str | None:
    """One sentence that names the conflicting constraints and what is attainable; None if there is no conflict."""
    tracking = problem.tracking
    columns, names, wanted = _constrained(problem, soft, completion)
    if not names or (tracking is not None and len(tracking.trackers) > MOST_EVENTS):
        return None
    patterns, possible = reachable_patterns(problem, message, soft)
    happened = patterns[:, columns].astype(np.float64)
    start = np.asarray(problem.start)[np.asarray(problem.start) > 0]
    keep = possible.any(axis=1)
    law = _Law(happened, possible[keep], start[keep] / start[keep].sum())
    every = list(range(len(names)))
    miss, nearest = law.nearest(every, wanted)
    if miss <= MISSED:
        return None
    conflict = every
    for k in every:  # a smallest set that still conflicts
        fewer = [i for i in conflict if i != k]
        if fewer and law.nearest(fewer, wanted)[0] > MISSED:
            conflict = fewer
    asked = " and ".join(f"'{names[k]}' with probability {wanted[k]:g}" for k in conflict)
    ranges = "; ".join(f"'{names[k]}' can have {_range(*law.range(k))}" for k in conflict)
    closest = ", ".join(f"{nearest[k]:.4g} for '{names[k]}'" for k in conflict)
    if len(conflict) == 1:
        return f"no trajectories of this mission on this map give {asked}: {ranges}; change the target"
    return (
        f"{asked} contradict one another on this map: {ranges}; together the nearest is {closest}; "
        "move the targets there or drop one"
    )


def _constrained(problem: FieldProblem, soft: bool, completion: float) -> tuple[list[int], list[str], Floats]:
    """(column of each constrained event in a pattern, its name, its target)."""
    columns, names, wanted = [], [], []
    if soft:
        columns.append(0)
        names.append("completes the mission")
        wanted.append(completion)
    events = [
        c for c in problem.constraints
        if isinstance(c, SoftConstraint) and not (isinstance(c.event, Completes) and c.event.mission is None)
    ]  # fmt: skip
    if problem.tracking is not None:
        at = [k for k, name in enumerate(problem.tracking.names) if name != "clock"]
        for k, constraint in zip(at, events, strict=False):
            columns.append(k + 1)
            names.append(problem.tracking.names[k])
            wanted.append(constraint.probability)
    return columns, names, np.array(wanted)


def reachable_patterns(
    problem: FieldProblem, message: Callable[[FieldProblem, Tilt], ProductChain], soft: bool
) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """(``[P, 1 + K]`` patterns: completed, happened...; ``[starts, P]`` whether it is possible from each start cell)."""
    automaton, tracking = problem.automaton, problem.tracking
    count, symbols = automaton.delta.shape
    ending = np.isin(automaton.delta, [automaton.accepting, automaton.rejecting])
    ending[[automaton.accepting, automaton.rejecting]] = False
    done = np.asarray(problem.status) == COMPLETE
    outcome = [done[automaton.delta]]
    if tracking is not None:
        outcome += list(_happened_after(tracking))
    stacked = np.stack(outcome)  # [1 + K, Q, L]
    used = np.flatnonzero(np.asarray(problem.start) > 0)
    patterns, possible = [], []
    for pattern in product((False, True), repeat=len(stacked)):
        if not (pattern[0] or soft):
            continue
        fits = (stacked == np.array(pattern)[:, None, None]).all(axis=0)
        if not (fits & ending).any():
            continue
        weight = np.zeros((count, symbols))
        weight[ending & ~fits] = -np.inf
        try:
            chain = message(problem, Tilt.given(problem, weight, 0.0 if soft else -np.inf))
        except InfeasibleField:
            continue
        patterns.append(pattern)
        possible.append(np.isfinite(start_log_partition(chain))[used])
    return np.array(patterns, dtype=np.bool_).reshape(-1, len(stacked)), np.array(possible).reshape(-1, len(used)).T


def _happened_after(tracking: Tracking) -> NDArray[np.bool_]:
    """``[K, Q, L]``: event k has happened once this transition is taken."""
    from tab_marl.field.constraints.tracking import HAPPENED

    return np.asarray((tracking.decided == HAPPENED)[:, :, None] | tracking.happens)


class _Law:
    """All joint laws of start cell and pattern: ``[starts, P]`` masses with the start's marginal given."""

    def __init__(self, happened: Floats, possible: NDArray[np.bool_], start: Floats) -> None:
        self.start, self.happened = start, happened
        self.cell, self.pattern = np.nonzero(possible)
        self.rows = np.zeros((len(start), len(self.cell)))
        self.rows[self.cell, np.arange(len(self.cell))] = 1.0

    def nearest(self, which: list[int], wanted: Floats) -> tuple[float, Floats]:
        """(least total deviation from the targets of these constraints, the probabilities of all events there)."""
        n, k = len(self.cell), len(which)
        events = self.happened[self.pattern][:, which].T
        cost = np.concatenate([np.zeros(n), np.ones(2 * k)])
        equal = np.block([[self.rows, np.zeros((len(self.start), 2 * k))], [events, np.eye(k), -np.eye(k)]])
        found = optimize.linprog(cost, A_eq=equal, b_eq=np.concatenate([self.start, wanted[which]]), bounds=(0, None))
        assert found.fun is not None and found.x is not None  # the slacks make it feasible
        return float(found.fun), np.asarray(found.x[:n] @ self.happened[self.pattern])

    def range(self, k: int) -> tuple[float, float]:
        """The least and the largest probability of event k alone."""
        cost = self.happened[self.pattern, k]
        ends = []
        for sign in (1.0, -1.0):
            found = optimize.linprog(sign * cost, A_eq=self.rows, b_eq=self.start, bounds=(0, None))
            assert found.fun is not None  # every start cell has a pattern
            ends.append(sign * float(found.fun))
        return ends[0], ends[1]


def _range(low: float, high: float) -> str:
    return f"only {low:.4g}" if high - low < 1e-9 else f"{low:.4g} to {high:.4g}"
