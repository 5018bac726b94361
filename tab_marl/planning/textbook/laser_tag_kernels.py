# mypy: ignore-errors
"""LaserTag (Somani, Ye, Hsu and Lee, NeurIPS 2013) as compiled functions. The state is ``[robot cell, target cell]``.

An observation packs eight readings of four bits each, direction 0 lowest; see `tab_marl.planning.textbook.laser_tag`.
"""

# mypy: allow-untyped-defs, allow-untyped-calls, allow-untyped-decorators, no-check-untyped-defs

from __future__ import annotations

import numpy as np
from numba import njit

from tab_marl.planning.random_kernels import below, uniform

TAG = 4
BEAMS = 8
READING_BITS = 4
SEES_TARGET = 1 << (BEAMS * READING_BITS)
"""The observation of standing on the target."""
STRIDE = 128
"""In the rollout's moves: ``action * STRIDE + cell``."""


@njit(cache=True)
def moved(state, action, data, rng):
    """Applies the action to `state`, the target fleeing; returns (reward, terminal)."""
    robot, target = np.int64(state[0]), np.int64(state[1])
    reward = -1.0
    if action == TAG:
        if robot == target:
            return 10.0, True
        reward = -10.0
    state[0] = data.robot_moves[robot * 5 + action]
    state[1] = data.target_moves[(robot * data.cells + target) * 5 + below(rng, 5)]
    return reward, False


@njit(cache=True)
def reading(state, direction, data, rng):
    """A noisy distance along one beam, in whole units."""
    beam = data.beams[(np.int64(state[0]) * data.cells + np.int64(state[1])) * BEAMS + direction]
    u = uniform(rng)
    r = 0
    while data.readings[beam, r] <= u:
        r += 1
    return r


def step(state, action, data, rng):
    """One step of LaserTag."""
    reward, terminal = moved(state, action, data, rng)
    if terminal or state[0] == state[1]:
        return np.int64(SEES_TARGET), reward, terminal
    seen = np.int64(0)
    for direction in range(BEAMS):
        seen |= np.int64(reading(state, direction, data, rng)) << (READING_BITS * direction)
    return seen, reward, False


def likelihood(before, action, state, observation, data):
    """P(observation | state reached)."""
    if state[0] == state[1]:
        return 1.0 if observation == SEES_TARGET else 0.0
    if observation == SEES_TARGET:
        return 0.0
    chance = 1.0
    first = (np.int64(state[0]) * data.cells + np.int64(state[1])) * BEAMS
    for direction in range(BEAMS):
        r = (observation >> (READING_BITS * direction)) & 15
        beam = data.beams[first + direction]
        chance *= data.readings[beam, r] - (data.readings[beam, r - 1] if r > 0 else 0.0)
    return chance


def history_rollout(state, action, observation, depth, max_depth, discount, data, rng):
    """Tag when standing on the target, else a random free move that does not double back."""
    robot, target = np.int64(state[0]), np.int64(state[1])
    last = action
    total = 0.0
    weight = 1.0
    for _ in range(depth, max_depth):
        if robot == target:
            return total + weight * 10.0
        total -= weight
        weight *= discount
        target = np.int64(data.target_moves[(robot * data.cells + target) * 5 + below(rng, 5)])
        move = np.int64(data.rollout_moves[(robot * 5 + last) * 12 + below(rng, 12)])
        last = move // STRIDE
        robot = move % STRIDE
    return total


def seen_leaf(state, action, observation, depth, max_depth, discount, data, rng):
    """The best return if the target were seen from now on: the leaf value of POMCPOW's experiments."""
    return data.seen_values[np.int64(state[0]) * data.cells + np.int64(state[1])]


def seen_value(state, depth, max_depth, discount, data):
    """The same as an upper bound, at discount .95: a chase cut short is spared no more than the worst chase costs."""
    # A whole exponent is multiplied out where this is compiled and not where it runs interpreted, which differ in the last bit.
    spared = discount ** np.float64(max_depth - depth) * min(0.0, data.least_seen)
    return data.seen_values[np.int64(state[0]) * data.cells + np.int64(state[1])] - spared
