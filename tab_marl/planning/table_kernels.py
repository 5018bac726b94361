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


@njit(cache=True)
def draw_sparse(rows, row, rng):
    """A number drawn from row `row` of sparse cumulative probabilities: binary search among the entries."""
    target = uniform(rng)
    low = rows.first[row]
    high = rows.first[row + 1] - 1
    while low < high:
        middle = (low + high) // 2
        if rows.cumulative[middle] > target:
            high = middle
        else:
            low = middle + 1
    return low


def sparse_step(state, action, data, rng):
    """As `step`, from sparse tables."""
    size = data.terminal.shape[0]
    entry = draw_sparse(data.transition, action * size + np.int64(state[0]), rng)
    after = data.transition.number[entry]
    observation = data.observation.number[draw_sparse(data.observation, action * size + after, rng)]
    state[0] = after
    return np.int64(observation), data.reward[entry], data.terminal[after]


def known_state_bound(state, depth, max_depth, discount, data):
    """The best return if the state were always known."""
    return data.best[np.int64(state[0])]
