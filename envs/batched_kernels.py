# mypy: ignore-errors
"""Compiled loops of the batched world: N robots, each on a task of a bank, one control step at a time.

Arrays and scalars only; nothing here validates or raises.
"""

from __future__ import annotations

import math

from numba import njit

from tab_marl.envs.adversary_kernels import (
    INITIAL,
    LOCATION_AT,
    MAX_SPEED,
    MAX_TURN,
    RADIUS,
    SUBSTEPS,
    TICK_SECONDS,
    gained,
    observe,
    task_advance,
)
from tab_marl.envs.motion_kernels import drive

COMPLETED, FAILED = -1, -2


@njit(cache=True)
def observe_ghost(bank, k, state, clocks, location, memory, ghost, seen_metres, out):
    """`observe` with a ghost ego on a circle, seen within `seen_metres` (0: never)."""
    seen = False
    gx, gy = ghost[0], ghost[1]
    if seen_metres > 0.0:
        angle = ghost[3] + 0.02 * ghost[4] * clocks[0]
        gx, gy = ghost[0] + ghost[2] * math.cos(angle), ghost[1] + ghost[2] * math.sin(angle)
        seen = math.hypot(gx - state[0], gy - state[1]) <= seen_metres
    return observe(
        bank, k, state[0], state[1], state[2], state[3], state[4], location, clocks, memory, seen, gx, gy, out
    )


@njit(cache=True)
def start_many(bank, task, start, state, location, clocks, memory, ghost, seen_metres, potential, out):
    """Begin episodes: ``start[N, 3]`` poses, tick 0 read; fills everything else. Robots with ``start`` nan are left alone."""
    for i in range(task.shape[0]):
        if math.isnan(start[i, 0]):
            continue
        state[i, :3] = start[i]
        state[i, 3:] = 0.0
        memory[i, :] = 0
        clocks[i, :] = -1
        location[i], _ = task_advance(bank, task[i], bank.number[task[i], INITIAL], clocks[i], state[i, 0], state[i, 1])
        potential[i, 0], potential[i, 1] = observe_ghost(
            bank, task[i], state[i], clocks[i], location[i], memory[i], ghost[i], seen_metres, out[i]
        )


@njit(cache=True)
def step_many(
    bank, task, action, state, location, clocks, memory, ghost, seen_metres, potential, price, reward, visited, touched,
    out,
):  # fmt: skip
    """One control step of N robots under actions ``[N, 2]`` in [-1, 1]; robots whose mission ended stand still.

    price: (per metre of distance-to-go, per metre of excess time, per visit, completed, failed, touch, tick).
    reward: 2 x the drop of distance-to-go and so on (`BatchedWorld`); excess time is a debt that only waiting pays back.
    """
    for i in range(task.shape[0]):
        k = task[i]
        reward[i] = 0.0
        visited[i] = touched[i] = False
        if location[i] < 0:
            continue
        real = bank.real[k]
        pace = min(real[MAX_SPEED], bank.speed_limit[bank.number[k, LOCATION_AT] + location[i]])
        v = min(0.5 * (min(max(action[i, 0], -1.0), 1.0) + 1.0) * real[MAX_SPEED], pace)
        w = min(max(action[i, 1], -1.0), 1.0) * real[MAX_TURN]
        substeps = bank.number[k, SUBSTEPS]
        x, y, theta, v, hit = drive(
            bank, k, state[i, 0], state[i, 1], state[i, 2], v, w, real[RADIUS], real[TICK_SECONDS] / substeps, substeps
        )
        state[i, 0], state[i, 1], state[i, 2], state[i, 3], state[i, 4] = x, y, theta, v, w
        touched[i] = hit
        before, dropped = location[i], memory[i, 1]
        via = memory[i, 0]
        after, counted = task_advance(bank, k, before, clocks[i], x, y)
        visited[i] = counted
        location[i] = after
        value = price[2] if counted else 0.0
        if hit:
            value += price[5]
        if after == COMPLETED:
            reward[i] = value + price[3] + price[0] * potential[i, 0]
            continue
        if after == FAILED:
            reward[i] = value + price[4]
            continue
        length, excess = observe_ghost(bank, k, state[i], clocks[i], after, memory[i], ghost[i], seen_metres, out[i])
        metres, waited = gained(
            before, after, via, dropped, memory[i], potential[i, 0], potential[i, 1], length, excess
        )  # fmt: skip
        value += price[0] * metres + price[1] * waited
        if excess <= 0.0:
            value += price[6]
        potential[i, 0], potential[i, 1] = length, excess
        reward[i] = value
