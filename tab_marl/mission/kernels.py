# mypy: ignore-errors
"""Compiled loops of missions: one tick of the automaton, and its clocks unrolled.

Arrays and scalars only; nothing here validates or raises. Slow twins: `MissionAutomaton.advance`, and the tests'.
"""

from __future__ import annotations

import numpy as np
from numba import njit

COMPLETED = -1
FAILED = -2


@njit(cache=True)
def advance(
    next_location, forbidden_until, progress, patient, earliest, latest, resets, location, clocks, mask
):  # fmt: skip
    """One tick: returns the next location and moves ``clocks`` int32[3] (mission, stage, visit) in place.

    Before tick 0 the location is the automaton's `initial` and every clock is -1, so the same call reads tick 0.
    COMPLETED and FAILED absorb. Tables as in `MissionAutomaton`.
    """
    if location < 0:
        return location
    for k in range(3):
        clocks[k] += 1
    if clocks[0] < forbidden_until[location, mask]:
        return FAILED
    counted = progress[location, mask]
    for k in range(3):
        if clocks[k] > latest[location, k]:
            return FAILED
        if counted and clocks[k] < earliest[location, k]:
            if not patient[location]:
                return FAILED
            counted = False
    if progress[location, mask] and not counted:
        return location
    following = next_location[location, mask]
    for k in range(3):
        if resets[location, mask, k]:
            clocks[k] = 0
    return following


@njit(cache=True)
def _slot(keys, key):
    """Where `key` lies or belongs in an open-addressing table of a power-of-two size (-1: empty)."""
    size = keys.shape[0]
    slot = ((key % 2147483647) * 40503 >> 8) & (size - 1)
    while keys[slot] != -1 and keys[slot] != key:
        slot = (slot + 1) & (size - 1)
    return slot


@njit(cache=True)
def unroll(
    next_location, forbidden_until, progress, patient, earliest, latest, resets, initial, caps, masks, capacity
):  # fmt: skip
    """Breadth-first search over (location, clocks), clocks kept only up to ``caps[U, 3]`` (larger values are alike).

    Returns ``(Q, location[Q], clocks[Q, 3], delta[Q, L], branch source mask)``: state 0 precedes tick 0; states
    numbered in order of discovery; delta is -1 completed, -2 failed. Q = -1 if more than `capacity` states.
    """
    symbols = masks.shape[0]
    size = 1
    while size < 2 * capacity + 2:
        size *= 2
    keys = np.full(size, -1, dtype=np.int64)
    ids = np.empty(size, dtype=np.int32)
    location = np.empty(capacity, dtype=np.int32)
    clocks = np.empty((capacity, 3), dtype=np.int32)
    delta = np.empty((capacity, symbols), dtype=np.int32)
    span = np.ones(3, dtype=np.int64)
    for k in range(3):
        for u in range(caps.shape[0]):
            span[k] = max(span[k], caps[u, k] + 2)
    location[0] = initial
    clocks[0, :] = -1
    count = 1
    moving = np.empty(3, dtype=np.int32)
    state = 0
    while state < count:
        for symbol in range(symbols):
            moving[:] = clocks[state]
            u = advance(
                next_location, forbidden_until, progress, patient, earliest, latest, resets, location[state], moving,
                masks[symbol],
            )  # fmt: skip
            if u < 0:
                delta[state, symbol] = u
                continue
            key = np.int64(u)
            for k in range(3):
                moving[k] = min(moving[k], caps[u, k])
                key = key * span[k] + moving[k]
            slot = _slot(keys, key)
            if keys[slot] == -1:
                if count == capacity:
                    return -1, location, clocks, delta
                keys[slot] = key
                ids[slot] = count
                location[count] = u
                clocks[count] = moving
                count += 1
            delta[state, symbol] = ids[slot]
        state += 1
    return count, location[:count].copy(), clocks[:count].copy(), delta[:count].copy()


@njit(cache=True)
def longest_depth(delta, order):
    """``[Q]`` length of the longest path from state 0, given the states in a topological order; -1 if not reached."""
    depth = np.full(delta.shape[0], -1, dtype=np.int32)
    depth[0] = 0
    for state in order:
        for symbol in range(delta.shape[1]):
            following = delta[state, symbol]
            if following >= 0 and depth[following] < depth[state] + 1:
                depth[following] = depth[state] + 1
    return depth
