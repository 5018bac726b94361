# mypy: ignore-errors
"""Compiled loops that value itineraries for an ego that avoids the adversary or watches it.

Arrays and scalars only; nothing here validates or raises. Each has a slow twin in ``tests/planning``.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from tab_marl.planning.models.sight_kernels import sees
from tab_marl.planning.pursuit.interception_kernels import first_meeting, largest_step


@njit(cache=True)
def avoidance_returns(
    routes, effort, arrived, paths, radius, reward_met, reward_tick, reward_effort, reward_arrived, returns, met
):
    """Fill `returns` and `met` ``[W, K]`` of routes ``[W, T + 1, 2]`` that end at tick ``arrived[w]`` (-1: never).

    Meeting the adversary before that ends them too, and is what `met` says: ticks until then, or -1.
    """
    ticks = min(routes.shape[1], paths.shape[1]) - 1
    closing = largest_step(paths) + largest_step(routes) + 1e-9
    for w in range(routes.shape[0]):
        there = 0 <= arrived[w] <= ticks
        last = arrived[w] if there else ticks
        for k in range(paths.shape[0]):
            at = first_meeting(routes[w], paths[k], last, radius, closing)
            met[w, k] = at
            if at >= 0.0:
                low = int(at)
                high = min(low + 1, ticks)
                spent = effort[w, low] + (at - low) * (effort[w, high] - effort[w, low])
                returns[w, k] = reward_met + reward_tick * at + reward_effort * spent
            else:
                returns[w, k] = reward_tick * last + reward_effort * effort[w, last]
                if there:
                    returns[w, k] += reward_arrived


@njit(cache=True)
def watch_returns(
    routes,
    effort,
    paths,
    open_squares,
    square_metres,
    radius,
    reward_tick,
    reward_effort,
    reward_watched,
    returns,
    first,
):
    """Fill `returns` and `first` ``[W, K]``: a reward for every tick at whose end the ego watches the adversary, that is
    has it within `radius` and in sight; `first` is the first such tick, or -1.
    """
    ticks = min(routes.shape[1], paths.shape[1]) - 1
    closing = largest_step(paths) + largest_step(routes) + 1e-9
    for w in range(routes.shape[0]):
        for k in range(paths.shape[0]):
            seen, first[w, k] = 0, -1.0
            t = 1
            while t <= ticks:
                dx, dy = routes[w, t, 0] - paths[k, t, 0], routes[w, t, 1] - paths[k, t, 1]
                gap = np.sqrt(dx * dx + dy * dy) - radius
                if gap > 0.0:
                    t += max(1, int(gap / closing))
                    continue
                if sees(open_squares, square_metres, routes[w, t, 0], routes[w, t, 1], paths[k, t, 0], paths[k, t, 1]):
                    seen += 1
                    if first[w, k] < 0.0:
                        first[w, k] = t
                t += 1
            returns[w, k] = reward_tick * ticks + reward_effort * effort[w, ticks] + reward_watched * seen
