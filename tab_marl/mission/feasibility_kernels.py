# mypy: ignore-errors
"""Compiled loop of the feasibility check: earliest arrivals on the grid from many cells with different head starts.

Arrays and scalars only; nothing here validates or raises. Slow twin in ``tests/mission``.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from tab_marl.world.kernels import MOVES, _sift_down, _sift_up, free_move


@njit(cache=True)
def arrivals(cell_at, row, column, offset, passable):
    """``[S]`` least of offset + length in cells over the cells with a finite offset; inf if none.

    Only cells with a finite offset and passable cells are left again; others can be arrived at.
    """
    cells = row.shape[0]
    arrival = offset.copy()
    capacity = 17 * cells + 1
    keys = np.empty(capacity)
    items = np.empty(capacity, dtype=np.int32)
    size = 0
    for s in range(cells):
        if offset[s] < np.inf:
            keys[size] = offset[s]
            items[size] = s
            _sift_up(keys, items, size)
            size += 1
    while size > 0:
        key, cell = keys[0], items[0]
        size -= 1
        keys[0], items[0] = keys[size], items[size]
        _sift_down(keys, items, size)
        if key > arrival[cell] or (not passable[cell] and offset[cell] == np.inf):
            continue
        for m in range(16):
            dr, dc = MOVES[m, 0], MOVES[m, 1]
            if not free_move(cell_at, row[cell], column[cell], dr, dc):
                continue
            other = cell_at[row[cell] + dr, column[cell] + dc]
            reached = key + math.sqrt(dr * dr + dc * dc)
            if reached < arrival[other]:
                arrival[other] = reached
                keys[size] = reached
                items[size] = other
                _sift_up(keys, items, size)
                size += 1
    return arrival
