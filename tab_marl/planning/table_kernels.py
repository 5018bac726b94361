"""A POMDP given as tables, as a compiled generative model."""

# mypy: allow-untyped-defs, allow-untyped-calls, allow-untyped-decorators, no-check-untyped-defs

from __future__ import annotations

import numpy as np
from numba import njit

from tab_marl.planning.random_kernels import uniform


@njit(cache=True)
def draw(cumulative, row, rng):
    """An index drawn from row `row` of cumulative probabilities [rows, n] (the last entry is 1): binary search."""
    target = uniform(rng)
    low = 0
    high = cumulative.shape[1] - 1
    while low < high:
        middle = (low + high) // 2
        if cumulative[row, middle] > target:
            high = middle
        else:
            low = middle + 1
    return low


def step(state, action, data, rng):
    """One step: next state by T(s' | s, a), observation by O(o | a, s'), reward R(s, a, s')."""
    size = data.terminal.shape[0]
    before = np.int64(state[0])
    after = draw(data.transition, action * size + before, rng)
    observation = np.int64(draw(data.observation, action * size + after, rng))
    state[0] = after
    return observation, data.reward[action * size + before, after], data.terminal[after]
