# mypy: ignore-errors
"""Tag (Pineau, Gordon and Thrun, IJCAI 2003) as compiled functions.

The tables are made in `tab_marl.planning.textbook.chase_maps`. The state is ``[robot cell, target cell]``. Everything is one
look-up: the random word's upper half picks one of 5 equal slots of the target's moves, its lower half the robot's action in a rollout.
(``np.uint64(...)`` round a call keeps the type where the functions run interpreted.)
"""

# mypy: allow-untyped-defs, allow-untyped-calls, allow-untyped-decorators, no-check-untyped-defs

from __future__ import annotations

import numpy as np
from numba import njit

from tab_marl.planning.random_kernels import GOLDEN, bits, mixed

TAG = 4
CELLS = 29
SEES_TARGET = 29
"""The observation of standing on the target; otherwise the observation is the robot's cell."""
TARGET_SLOTS = 5
ROLLOUT_SLOTS = 12
_LOW = np.uint64(0xFFFFFFFF)
_SHIFT = np.uint64(32)


@njit(cache=True)
def _high(word, count):
    return np.int64(((word >> _SHIFT) * np.uint64(count)) >> _SHIFT)


@njit(cache=True)
def _low(word, count):
    return np.int64(((word & _LOW) * np.uint64(count)) >> _SHIFT)


def step(state, action, data, rng):
    """One step of Tag; the target answers to where the robot was before it, and moves on after a failed tag too."""
    robot, target = np.int64(state[0]), np.int64(state[1])
    reward = -1.0
    if action == TAG:
        if robot == target:
            return np.int64(SEES_TARGET), 10.0, True
        reward = -10.0
    target = np.int64(
        data.target_moves[(robot * CELLS + target) * TARGET_SLOTS + _high(np.uint64(bits(rng)), TARGET_SLOTS)]
    )
    robot = np.int64(data.robot_moves[robot * 5 + action])
    state[0] = robot
    state[1] = target
    return np.int64(SEES_TARGET) if robot == target else robot, reward, False


def uniform_rollout(state, action, observation, depth, max_depth, discount, data, rng):
    """All five actions alike, to the end."""
    robot, target = np.int64(state[0]), np.int64(state[1])
    word = rng[0]
    total = 0.0
    weight = 1.0
    for _ in range(depth, max_depth):
        word = word + GOLDEN
        random = np.uint64(mixed(word))
        action = _low(random, 5)
        tags = action == TAG
        if tags & (
            robot == target
        ):  # one seldom-taken branch: a fifth of all actions are tags, which no processor foresees
            total += weight * 10.0
            break
        total -= weight * (10.0 if tags else 1.0)
        weight *= discount
        target = np.int64(data.target_moves[(robot * CELLS + target) * TARGET_SLOTS + _high(random, TARGET_SLOTS)])
        robot = np.int64(data.robot_moves[robot * 5 + action])
    rng[0] = word
    return total


def history_rollout(state, action, observation, depth, max_depth, discount, data, rng):
    """Tag when standing on the target, else a random free move that does not double back (Silver and Veness 2010)."""
    robot, target = np.int64(state[0]), np.int64(state[1])
    last = action
    word = rng[0]
    total = 0.0
    weight = 1.0
    for _ in range(depth, max_depth):
        if robot == target:
            total += weight * 10.0
            break
        total -= weight
        weight *= discount
        word = word + GOLDEN
        random = np.uint64(mixed(word))
        target = np.int64(data.target_moves[(robot * CELLS + target) * TARGET_SLOTS + _high(random, TARGET_SLOTS)])
        move = np.int64(data.rollout_moves[(robot * 5 + last) * ROLLOUT_SLOTS + _low(random, ROLLOUT_SLOTS)])
        last = move >> 5
        robot = move & 31
    rng[0] = word
    return total


def preferred(state, action, observation, depth, data, values, counts):
    """Silver and Veness's preferred actions: tag when the target is seen, else free moves that do not double back."""
    if observation == SEES_TARGET:
        values[TAG] = 10.0
        counts[TAG] = 10
        return
    robot = np.int64(state[0])
    last = action if action >= 0 else TAG  # at the start nothing can be doubled back on, as after a tag
    for slot in range(ROLLOUT_SLOTS):
        move = np.int64(data.rollout_moves[(robot * 5 + last) * ROLLOUT_SLOTS + slot])
        values[move >> 5] = 0.0
        counts[move >> 5] = 10


def seen_value(state, depth, max_depth, discount, data):
    """The best return at discount .95 if the target were always seen: no policy can expect more.

    A chase cut short is spared what would follow, which costs no more than the worst chase does.
    """
    # A whole exponent is multiplied out where this is compiled and not where it runs interpreted, which differ in the last bit.
    spared = discount ** np.float64(max_depth - depth) * min(0.0, data.least_seen)
    return data.seen_values[np.int64(state[0]) * CELLS + np.int64(state[1])] - spared
