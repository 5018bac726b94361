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
    """One step: next state by T(s' | s, a), observation by O(o | a, s'), reward R(s, a, s'). A state that has ended earns nothing."""
    size = data.terminal.shape[0]
    before = np.int64(state[0])
    if data.terminal[before]:
        return np.int64(0), 0.0, True
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
    before = np.int64(state[0])
    if data.terminal[before]:
        return np.int64(0), 0.0, True
    entry = draw_sparse(data.transition, action * size + before, rng)
    after = data.transition.number[entry]
    observation = data.observation.number[draw_sparse(data.observation, action * size + after, rng)]
    state[0] = after
    return np.int64(observation), data.reward[entry], data.terminal[after]


@njit(cache=True)
def cumulated(first, chances):
    """Sparse cumulative probabilities: row by row, so that no row loses digits to those before it, and the last entry is 1."""
    cumulative = np.empty(len(chances))
    for row in range(len(first) - 1):
        total = 0.0
        for entry in range(first[row], first[row + 1]):
            total += chances[entry]
            cumulative[entry] = total
        for entry in range(first[row], first[row + 1]):
            cumulative[entry] /= total
    return cumulative


def known_state_bound(state, depth, max_depth, discount, data):
    """The best return of the steps left if the state were always known."""
    row = min(max_depth - depth, data.best.shape[0]) - 1
    return data.best[row, np.int64(state[0])]
