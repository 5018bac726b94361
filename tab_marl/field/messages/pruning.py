"""Leaving out automaton states that the motion cannot visit, or from which it cannot complete the mission in time."""

from __future__ import annotations

from dataclasses import fields, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from tab_marl.field.infeasible import InfeasibleField

if TYPE_CHECKING:
    from tab_marl.field.problem import FieldProblem
    from tab_marl.mission.unroll import TickAutomaton

Bools = NDArray[np.bool_]


def pruned(problem: FieldProblem) -> FieldProblem:
    """See `FieldProblem.pruned`. Raises InfeasibleField when nothing is left."""
    if problem.constraints or problem.tracking is not None:
        raise ValueError("pruned() needs a problem without soft constraints: prune first, then add them")
    automaton = problem.automaton
    neighbours = _neighbours(problem)
    possible = _completing(problem, neighbours, _visited(problem, neighbours))
    started = np.flatnonzero(np.asarray(problem.start) > 0)
    if not possible[automaton.delta[automaton.initial, np.asarray(problem.labels)[started]], started].any():
        raise InfeasibleField("no feasible motion from any start cell completes the mission: there is nothing to keep")
    kept = np.asarray(possible.any(axis=1))
    kept[[automaton.initial, automaton.accepting, automaton.rejecting]] = True
    rough = None if problem.rough is None else pruned(problem.rough)
    of_states = {name: np.asarray(getattr(problem, name))[kept] for name in ("reference_of", "stage", "status")}
    settings: dict[str, Any] = {"automaton": restricted(automaton, kept), "rough": rough, **of_states}
    return replace(problem, **settings)


def restricted(automaton: TickAutomaton, kept: Bools) -> TickAutomaton:
    """The automaton without the other states ``[Q]``: what leads to them leads to rejection."""
    number = np.where(kept, np.cumsum(kept) - 1, 0)
    number[~kept] = number[automaton.rejecting]
    changes: dict[str, Any] = {
        one.name: value[kept]
        for one in fields(automaton)
        if isinstance(value := getattr(automaton, one.name), np.ndarray)
        and len(value) == len(kept)
        and one.name != "masks"
    }
    delta = number[automaton.delta][kept].astype(np.int32)
    changes["delta"] = delta
    changes["branch"] = np.where(delta == number[automaton.rejecting], -1, automaton.branch[kept]).astype(np.int32)
    for name in ("initial", "accepting", "rejecting"):
        changes[name] = int(number[getattr(automaton, name)])
    return replace(automaton, **changes)


def _neighbours(problem: FieldProblem) -> list[sparse.csr_array]:
    """Per reference ``[C, C]``: which cells a tick can lead to, whatever the mode."""
    motion = problem.reference
    cells = problem.cells
    found = []
    for r in range(motion.count):
        at = motion.indptr[r * motion.states : (r + 1) * motion.states + 1]
        entries = slice(int(at[0]), int(at[-1]))
        source = np.repeat(np.arange(motion.states) // motion.modes, np.diff(at))
        target = motion.indices[entries] // motion.modes
        possible = motion.data[entries] > 0
        # In a tick any mode may be drawn before the move, so cells alone reach at least as far as (cell, mode) do.
        pairs = (np.ones(int(possible.sum()), dtype=np.int32), (source[possible], target[possible]))
        found.append(sparse.csr_array(sparse.coo_array(pairs, shape=(cells, cells))))
    return found


def _visited(problem: FieldProblem, neighbours: list[sparse.csr_array]) -> Bools:
    """``[Q, C]``: which cells the motion can be in when the automaton enters each transient state."""
    automaton, labels = problem.automaton, np.asarray(problem.labels)
    which = np.asarray(problem.reference_of)
    inside = np.zeros((len(automaton.delta), problem.cells), dtype=bool)
    absorbing = {automaton.accepting, automaton.rejecting}
    started = np.flatnonzero(np.asarray(problem.start) > 0)
    inside[automaton.delta[automaton.initial, labels[started]], started] = True
    transposed = [sparse.csr_array(matrix.T) for matrix in neighbours]
    for q in np.argsort(automaton.rank, kind="stable"):
        if q in absorbing or not inside[q].any():
            continue
        ahead = np.flatnonzero(transposed[which[q]] @ inside[q].astype(np.int32))
        inside[automaton.delta[q, labels[ahead]], ahead] = True
    return inside


def _completing(problem: FieldProblem, neighbours: list[sparse.csr_array], visited: Bools) -> Bools:
    """``[Q, C]``: visited there, and from there the motion can still lead to an end that counts."""
    automaton, labels = problem.automaton, np.asarray(problem.labels)
    which = np.asarray(problem.reference_of)
    hopeful = np.zeros_like(visited)
    hopeful[automaton.accepting] = True
    hopeful[automaton.rejecting] = problem.options.completion_probability < 1  # then failing is an end, too
    absorbing = {automaton.accepting, automaton.rejecting}
    cells = np.arange(problem.cells)
    for q in np.argsort(-automaton.rank, kind="stable"):
        if q in absorbing or q == automaton.initial or not visited[q].any():
            continue
        ahead = hopeful[automaton.delta[q, labels], cells]
        hopeful[q] = visited[q] & ((neighbours[which[q]] @ ahead.astype(np.int32)) > 0)
    return hopeful
