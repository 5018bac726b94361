# mypy: ignore-errors
"""Compiled loops that find where the adversary can be: which cells belong to each automaton state.

Letters as in `kernels`. Sets of cells are swept 64 automaton states at a time, one bit each. Arrays and scalars only;
nothing here validates or raises. Slow twin: ``tests/field/test_support.py``.
"""

from __future__ import annotations

import numpy as np
from numba import njit

WORD = 64


@njit(cache=True)
def batch_end(order, first, delta, reference_of, most):
    """The end of the longest run of `order` from `first`, at most `most` long, of states that do not follow one another."""
    last = first + 1
    while last < order.shape[0] and last - first < most:
        q = order[last]
        if reference_of[q] != reference_of[order[first]]:
            return last
        for i in range(first, last):
            for symbol in range(delta.shape[1]):
                if delta[order[i], symbol] == q or delta[q, symbol] == order[i]:
                    return last
        last += 1
    return last


@njit(cache=True)
def spread(order, indptr, indices, reference_of, labels, delta, possible):
    """Mark in ``possible[Q, C]`` all that can follow what is marked, `order` by rising rank.

    ``indices[indptr[r * C + c] : ...]``: the cells within one tick of cell c under reference r.
    """
    cells = labels.shape[0]
    here, after = np.zeros(cells, dtype=np.uint64), np.zeros(cells, dtype=np.uint64)
    first = 0
    while first < order.shape[0]:
        last = batch_end(order, first, delta, reference_of, WORD)
        here[:] = 0
        after[:] = 0
        for i in range(first, last):
            bit = np.uint64(1) << np.uint64(i - first)
            row = possible[order[i]]
            for cell in range(cells):
                if row[cell]:
                    here[cell] |= bit
        r = reference_of[order[first]]
        for cell in range(cells):
            word = here[cell]
            if word:
                for k in range(indptr[r * cells + cell], indptr[r * cells + cell + 1]):
                    after[indices[k]] |= word
        for cell in range(cells):
            word = after[cell]
            if word:
                symbol = labels[cell]
                for i in range(first, last):
                    if (word >> np.uint64(i - first)) & np.uint64(1):
                        possible[delta[order[i], symbol], cell] = 1
        first = last


@njit(cache=True)
def prune(order, indptr, indices, reference_of, labels, delta, possible):
    """Keep in ``possible[Q, C]`` of the states in `order` (falling rank) only what leads to something possible."""
    cells = labels.shape[0]
    here, after = np.zeros(cells, dtype=np.uint64), np.zeros(cells, dtype=np.uint64)
    first = 0
    while first < order.shape[0]:
        last = batch_end(order, first, delta, reference_of, WORD)
        here[:] = 0
        after[:] = 0
        for i in range(first, last):
            bit = np.uint64(1) << np.uint64(i - first)
            q = order[i]
            for cell in range(cells):
                symbol = labels[cell]
                if possible[delta[q, symbol], cell]:
                    after[cell] |= bit
                if possible[q, cell]:
                    here[cell] |= bit
        r = reference_of[order[first]]
        for cell in range(cells):
            word = here[cell]
            if word:
                ahead = np.uint64(0)
                for k in range(indptr[r * cells + cell], indptr[r * cells + cell + 1]):
                    ahead |= after[indices[k]]
                    if ahead & word == word:
                        break
                here[cell] = ahead & word
        for i in range(first, last):
            bit = np.uint64(1) << np.uint64(i - first)
            row = possible[order[i]]
            for cell in range(cells):
                if not here[cell] & bit:
                    row[cell] = 0
        first = last
