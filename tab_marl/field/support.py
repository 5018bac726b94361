"""Where the adversary can be: the cells that belong to each automaton state."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from tab_marl.field import support_kernels as kernels
from tab_marl.field.problem import UNDER_WAY, FieldProblem
from tab_marl.field.reference import Reference


class Support(NamedTuple):
    """The cells of each automaton state that lie on some completing (or failing) trajectory, or on more than those."""

    possible: NDArray[np.uint8]
    """``[Q, C]``: 1 where a trajectory can be."""
    low: NDArray[np.int32]
    """``[R, C]``: first cell within one tick of each cell."""
    high: NDArray[np.int32]
    """``[R, C]``: the last."""


def cell_moves(reference: Reference) -> tuple[NDArray[np.int64], NDArray[np.int32]]:
    """CSR rows ``r * C + c``: the cells that some mode reaches from cell c in one tick, rising."""
    states, modes = reference.states, reference.modes
    cells = states // modes
    used = reference.data > 0
    row = np.repeat(np.arange(len(reference.indptr) - 1, dtype=np.int64), np.diff(reference.indptr))[used] // modes
    column = (reference.indices[used] // modes).astype(np.int64)
    pairs = sparse.csr_array((np.ones(len(row), dtype=np.int32), (row, column)), shape=(reference.count * cells, cells))
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
    low, high = np.full(reference.count * cells, cells, dtype=np.int32), np.full(reference.count * cells, -1, np.int32)
    some = np.diff(indptr) > 0
    low[some], high[some] = indices[indptr[:-1][some]], indices[indptr[1:][some] - 1]
    under_way = np.asarray(problem.status) == UNDER_WAY
    under_way[[automaton.accepting, automaton.rejecting, automaton.initial]] = False
    order = np.argsort(automaton.rank, kind="stable")
    order = order[under_way[order]].astype(np.int32)
    tables = indptr, indices, which, labels, automaton.delta
    possible = np.full((count, cells), 0 if reachable else 1, dtype=np.uint8)
    if reachable:
        started = np.flatnonzero(np.asarray(problem.start) > 0)
        possible[automaton.delta[automaton.initial, labels[started]], started] = 1
        kernels.spread(order, *tables, possible)
    possible[~under_way] = 1
    possible[automaton.rejecting] = int(failing)
    possible[automaton.initial] = 0
    kernels.prune(np.ascontiguousarray(order[::-1]), *tables, possible)
    shape = reference.count, cells
    return Support(possible, low.reshape(shape), high.reshape(shape))
