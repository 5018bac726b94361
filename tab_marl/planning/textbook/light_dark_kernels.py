# mypy: ignore-errors
"""Light-dark on a line (Sunberg and Kochenderfer, ICAPS 2018) as compiled functions. The state is ``[position]``, a whole number."""

# mypy: allow-untyped-defs, allow-untyped-calls, allow-untyped-decorators, no-check-untyped-defs

from __future__ import annotations

import math

import numpy as np
from numba import njit

from tab_marl.planning.random_kernels import normal, uniform


@njit(cache=True)
def moved(state, action, data):
    """Applies the action to `state`; returns (reward, terminal)."""
    move = data.moves[action]
    if move == 0.0:
        return data.hit if state[0] == 0.0 else data.miss, True
    state[0] = min(max(state[0] + move, -data.radius), data.radius)
    return -1.0, False


@njit(cache=True)
def spread(position, data):
    """The standard deviation of a reading at `position`."""
    return abs(position - data.light) + data.least_noise


def step(state, action, data, rng, seen):
    """One step; writes the reading into `seen` float64[1]. Returns (reward, terminal)."""
    reward, terminal = moved(state, action, data)
    seen[0] = state[0] + spread(state[0], data) * normal(rng)
    return reward, terminal


def likelihood(before, action, state, observation, data):
    """The density of the reading ``observation[0]`` in `state`, the state reached."""
    sigma = spread(state[0], data)
    z = (observation[0] - state[0]) / sigma
    return math.exp(-0.5 * z * z) / (sigma * 2.5066282746310002)


def binned_step(state, action, data, rng):
    """One step with the reading rounded down to bins of `data.bin_width`; the observation is the bin's number."""
    reward, terminal = moved(state, action, data)
    reading = state[0] + spread(state[0], data) * normal(rng)
    return np.int64(math.floor(reading / data.bin_width)), reward, terminal


def full_view_value(state, action, observation, depth, max_depth, discount, data, rng):
    """The return from `state` if the position were known from now on: the leaf value that POMCPOW's experiments use."""
    return data.full_view_values[np.int64(state[0]) + np.int64(data.radius)]


def random_walk(state, action, observation, depth, max_depth, discount, data, rng):
    """Uniformly random actions to the end."""
    total = 0.0
    weight = 1.0
    for _ in range(depth, max_depth):
        reward, terminal = moved(state, np.int64(uniform(rng) * len(data.moves)), data)
        total += weight * reward
        if terminal:
            break
        weight *= discount
    return total
