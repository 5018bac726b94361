"""Where the adversary can be: the cells that belong to each automaton state."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from tab_marl.field.messages import support_kernels as kernels
from tab_marl.field.problem import UNDER_WAY, FieldProblem
from tab_marl.field.reference import Reference

FILLED = 8
"""Automaton states per rank from which the search, which treats those of one rank together, saves more than it takes."""


class Support(NamedTuple):
    """The cells of each automaton state that lie on some completing (or failing) trajectory, or on more than those."""

    possible: NDArray[np.uint8]
    """``[Q, C]``: 1 where a trajectory can be."""
    low: NDArray[np.int32]
    """``[R, C]``: first cell within one tick of each cell."""
    high: NDArray[np.int32]
    """``[R, C]``: the last."""


def cell_moves(reference: Reference) -> tuple[NDArray[np.int64], NDArray[np.int32]]:
    """CSR rows ``r * C + c``: the cells that some mode reaches from cell c in one tick."""
    states, modes = reference.states, reference.modes
    if modes == 1:
        return reference.indptr, reference.indices
    cells = states // modes
    used = reference.data > 0
    row = np.repeat(np.arange(len(reference.indptr) - 1, dtype=np.int64), np.diff(reference.indptr))[used] // modes
    column = reference.indices[used] // modes
    pairs = sparse.csr_array((np.ones(len(row), dtype=np.int8), (row, column)), shape=(reference.count * cells, cells))
    pairs.sum_duplicates()
    return pairs.indptr.astype(np.int64), pairs.indices.astype(np.int32)


def support_of(problem: FieldProblem, reachable: bool, failing: bool) -> Support:
    """The cells of each automaton state from which the mission can be completed.

    Args:
        reachable: leave out, too, what cannot be reached from the start.
        failing: trajectories that fail count as well.
    """
    automaton, reference = problem.automaton, problem.reference
    labels, which = np.asarray(problem.labels), np.asarray(problem.reference_of)
    count, cells = len(automaton.delta), len(labels)
    indptr, indices = cell_moves(reference)
    some = np.diff(indptr) > 0
    starts = np.minimum(indptr[:-1], max(len(indices) - 1, 0))
    low = np.where(some, np.minimum.reduceat(indices, starts) if len(indices) else cells, cells).astype(np.int32)
    high = np.where(some, np.maximum.reduceat(indices, starts) if len(indices) else -1, -1).astype(np.int32)
    under_way = np.asarray(problem.status) == UNDER_WAY
    under_way[[automaton.accepting, automaton.rejecting, automaton.initial]] = False
    order = np.argsort(automaton.rank, kind="stable")
    order = order[under_way[order]].astype(np.int32)
    shape = reference.count, cells
    possible = np.ones((count, cells), dtype=np.uint8)
    if len(order) < FILLED * len(np.unique(automaton.rank[order])):
        possible[automaton.rejecting] = int(failing)
        return Support(possible, low.reshape(shape), high.reshape(shape))
    tables = indptr, indices, which, labels, automaton.delta
    if reachable:
        possible[:] = 0
        started = np.flatnonzero(np.asarray(problem.start) > 0)
        possible[automaton.delta[automaton.initial, labels[started]], started] = 1
        kernels.spread(order, *tables, possible)
    possible[~under_way] = 1
    possible[automaton.rejecting] = int(failing)
    possible[automaton.initial] = 0
    kernels.prune(np.ascontiguousarray(order[::-1]), *tables, possible)
    return Support(possible, low.reshape(shape), high.reshape(shape))
