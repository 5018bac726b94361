# mypy: ignore-errors
"""Stepping and weighing the particles of a belief; `tab_marl.planning.beliefs.particle_filter` decides what to do with the weights."""

# mypy: allow-untyped-defs, allow-untyped-calls, allow-untyped-decorators, no-check-untyped-defs

from __future__ import annotations

import numpy as np
from numba import njit

NONE_BROKEN = -1


@njit(cache=True, nogil=True)
def advance(step, likelihood, data, states, action, observation, rng, before, after, weights):
    """Steps `states` [N, D] into `after` [N, D]; `weights` [N] say how well each explains the observation.

    With a `likelihood`, by its value at the states left and reached; without, 1 where the simulated observation is the one
    seen. -1 marks states that ended: the process goes on. `before` [D] is scratch. Returns the first particle whose
    likelihood is broken, and stops there: its value is in `weights`; or NONE_BROKEN.
    """
    for i in range(len(states)):
        after[i] = states[i]
        state = after[i]
        seen, _reward, terminal = step(state, np.int64(action), data, rng)
        if terminal:
            weights[i] = -1.0
        elif likelihood is None:
            weights[i] = 1.0 if seen == observation else 0.0
        else:
            before[:] = states[i]
            weights[i] = likelihood(before, np.int64(action), state, observation, data)
            if not 0.0 <= weights[i] < np.inf:
                return i
    return NONE_BROKEN


@njit(cache=True, nogil=True)
def advance_seeing(step, likelihood, data, states, action, observation, rng, before, after, weights, seen):
    """`advance` for models with continuous observations: ``step(state, action, data, rng, seen) -> (reward, terminal)``."""
    for i in range(len(states)):
        after[i] = states[i]
        state = after[i]
        _reward, terminal = step(state, np.int64(action), data, rng, seen)
        if terminal:
            weights[i] = -1.0
            continue
        before[:] = states[i]
        weights[i] = likelihood(before, np.int64(action), state, observation, data)
        if not 0.0 <= weights[i] < np.inf:
            return i
    return NONE_BROKEN


def table_likelihood(before, action, state, observation, data):
    """P(observation | action, state reached) of a model made by `table_model`, from its cumulative tables."""
    row = action * data.terminal.shape[0] + np.int64(state[0])
    if observation < 0 or observation >= data.observation.shape[1]:
        return 0.0
    below = data.observation[row, observation - 1] if observation > 0 else 0.0
    return max(0.0, data.observation[row, observation] - below)  # a rounding error below 0 is no probability


def sparse_table_likelihood(before, action, state, observation, data):
    """As `table_likelihood`, from sparse tables."""
    rows = data.observation
    row = action * data.terminal.shape[0] + np.int64(state[0])
    below = 0.0
    for entry in range(rows.first[row], rows.first[row + 1]):
        if rows.number[entry] == observation:
            return max(0.0, rows.cumulative[entry] - below)
        below = rows.cumulative[entry]
    return 0.0
