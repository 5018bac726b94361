# mypy: ignore-errors
"""Compiled loops of interception: when two moving points first come within a radius, and what a route is then worth.

Arrays and scalars only; nothing here validates or raises. Each has a slow twin in ``tests/planning``.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from tab_marl.planning.pursuit.motion_kernels import shortcut

NEVER = -1.0
"""No meeting."""


@njit(cache=True)
def meeting_fraction(ax, ay, bx, by, radius):
    """First s in [0, 1] at which the point a + s (b - a) lies within `radius` of the origin, or NEVER.

    a and b are the relative positions at the two ends of a tick during which both robots move straight.
    """
    inside = ax * ax + ay * ay - radius * radius
    if inside <= 0.0:
        return 0.0
    dx, dy = bx - ax, by - ay
    squared = dx * dx + dy * dy
    half = ax * dx + ay * dy
    if squared < 1e-18 or half >= 0.0:
        return NEVER
    root = half * half - squared * inside
    if root < 0.0:
        return NEVER
    s = (-half - math.sqrt(root)) / squared
    return s if s <= 1.0 else NEVER


@njit(cache=True)
def first_meeting(route, path, last, radius, closing):
    """Ticks until a route ``[T + 1, 2]`` first meets a path ``[H + 1, 2]``, at most `last`, or NEVER.

    `closing` bounds how much nearer the two can come in a tick; far apart, that many ticks are skipped at once.
    """
    t = 0
    while t < last:
        ax, ay = route[t, 0] - path[t, 0], route[t, 1] - path[t, 1]
        gap = math.sqrt(ax * ax + ay * ay) - radius
        if gap > closing:
            t += int(gap / closing)
            continue
        s = meeting_fraction(ax, ay, route[t + 1, 0] - path[t + 1, 0], route[t + 1, 1] - path[t + 1, 1], radius)
        if s >= 0.0:
            return t + s
        t += 1
    return NEVER


@njit(cache=True)
def largest_step(paths):
    """The longest displacement in one tick among paths ``[K, H + 1, 2]``."""
    longest = 0.0
    for k in range(paths.shape[0]):
        for t in range(paths.shape[1] - 1):
            dx = paths[k, t + 1, 0] - paths[k, t, 0]
            dy = paths[k, t + 1, 1] - paths[k, t, 1]
            longest = max(longest, dx * dx + dy * dy)
    return math.sqrt(longest)


@njit(cache=True)
def route_returns(routes, effort, paths, completed, radius, reward_met, reward_tick, reward_effort, reward_completed):
    """``[W, K]`` returns of "drive route w, then wait" against path k, and ``[W, K]`` ticks to the meeting (or NEVER).

    `completed` ``[K]`` is the tick at which path k completes its mission, or -1. Whichever of meeting, completion and
    the last tick comes first ends the scenario.
    """
    count, scenarios = routes.shape[0], paths.shape[0]
    ticks = min(routes.shape[1], paths.shape[1]) - 1
    closing = largest_step(paths) + largest_step(routes) + 1e-9
    returns = np.empty((count, scenarios), dtype=np.float32)
    met = np.empty((count, scenarios), dtype=np.float32)
    for w in range(count):
        for k in range(scenarios):
            ends = 0 <= completed[k] <= ticks
            last = completed[k] if ends else ticks
            at = first_meeting(routes[w], paths[k], last, radius, closing)
            met[w, k] = at
            if at >= 0.0:
                low = int(at)
                high = min(low + 1, ticks)
                spent = effort[w, low] + (at - low) * (effort[w, high] - effort[w, low])
                returns[w, k] = reward_met + reward_tick * at + reward_effort * spent
            else:
                returns[w, k] = reward_tick * last + reward_effort * effort[w, last]
                if ends:
                    returns[w, k] += reward_completed
    return returns, met


@njit(cache=True)
def detour_returns(
    routes, returns, met, paths, completed, switch, second, nearest, cell_metres, centres, aims, goals, waypoints,
    turn_ticks, reach, radius, reward_met, reward_tick, reward_completed, values,
):  # fmt: skip
    """Fill `values` ``[F, N, E]``: mean return of "first leg f until tick n, then route e", its second leg's effort left
    aside.

    `routes` ``[F, T + 1, 2]``, `returns` and `met` ``[F, K]`` are those of the first legs as plain routes
    (`route_returns`). The second leg is driven by `motion_kernels.shortcut`.
    """
    scenarios = paths.shape[0]
    ticks = min(routes.shape[1], paths.shape[1]) - 1
    closing = largest_step(paths) + reach + 1e-9
    leg = np.empty((ticks + 1, 2))
    for f in range(routes.shape[0]):
        for n in range(switch.shape[0]):
            start = min(switch[n], ticks)
            for j in range(second.shape[0]):
                e = second[j]
                shortcut(
                    nearest, cell_metres, centres, aims[e], goals[e], waypoints[e, 0], waypoints[e, 1],
                    routes[f, start, 0], routes[f, start, 1], start, turn_ticks, reach, leg,
                )  # fmt: skip
                total = 0.0
                for k in range(scenarios):
                    ends = 0 <= completed[k] <= ticks
                    last = completed[k] if ends else ticks
                    if (0.0 <= met[f, k] <= start) or last <= start:
                        total += returns[f, k]
                        continue
                    at = first_meeting(leg[start:], paths[k, start:], last - start, radius, closing)
                    if at >= 0.0:
                        total += reward_met + reward_tick * (start + at)
                    else:
                        total += reward_tick * last + (reward_completed if ends else 0.0)
                values[f, n, j] = total / scenarios
