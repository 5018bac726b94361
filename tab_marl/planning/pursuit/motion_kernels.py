# mypy: ignore-errors
"""Compiled loops of the ego's own motion: straightened shortest paths and the unicycle that follows them.

Arrays and scalars only; nothing here validates or raises. Each has a slow twin in ``tests/planning``.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from tab_marl.world.kernels import MOVES, free_move, steer, unicycle_step

ARRIVED_METRES = 0.01
"""A robot this close to its waypoint stands still: it need not creep up on the last millimetres."""


@njit(cache=True)
def clear_line(cell_at, row_a, column_a, row_b, column_b):
    """Whether the straight line between two cell centres stays on free cells, tested every half cell."""
    dr, dc = row_b - row_a, column_b - column_a
    pieces = 2 * max(abs(dr), abs(dc))
    for i in range(1, pieces):
        fraction = i / pieces
        r = math.floor(row_a + fraction * dr + 0.5)
        c = math.floor(column_a + fraction * dc + 0.5)
        if cell_at[r, c] < 0:
            return False
    return True


@njit(cache=True)
def straightened_aims(cell_at, row, column, distance, goal, aim):
    """Fill ``aim[S]``: the cell to drive straight at from each cell so as to reach the goal cell; itself if unreachable.

    `distance` ``[S]`` is the geodesic distance to the goal in cells. A cell aims where its successor on the shortest
    path aims, as long as the line there is free (the post-smoothing of Theta*, Nash et al. 2007), else at the successor.
    """
    cells = row.shape[0]
    order = np.argsort(distance)
    for i in range(cells):
        cell = order[i]
        aim[cell] = cell
        if cell == goal or not np.isfinite(distance[cell]):
            continue
        best, successor = np.inf, cell
        for m in range(16):
            dr, dc = MOVES[m, 0], MOVES[m, 1]
            if free_move(cell_at, row[cell], column[cell], dr, dc):
                other = cell_at[row[cell] + dr, column[cell] + dc]
                through = distance[other] + math.sqrt(dr * dr + dc * dc)
                # Strictly nearer the goal: `aim[other]` is then final.
                if through < best and distance[other] < distance[cell]:
                    best, successor = through, other
        if successor == cell:
            continue
        far = aim[successor]
        visible = clear_line(cell_at, row[cell], column[cell], row[far], column[far])
        aim[cell] = far if visible else successor


@njit(cache=True)
def drive(nearest, cell_metres, centres, aim, goal, goal_x, goal_y, x, y, theta, max_speed, max_turn_rate, seconds):
    """Speed and turn rate of one control step along the route to a waypoint.

    `nearest` ``[rows, columns]`` is the free cell nearest to each square, `aim` ``[S]`` the route's aim per cell, `goal`
    the waypoint's cell.
    """
    r = min(max(int(y / cell_metres), 0), nearest.shape[0] - 1)
    c = min(max(int(x / cell_metres), 0), nearest.shape[1] - 1)
    target = aim[nearest[r, c]]
    if target == goal:
        if math.hypot(goal_x - x, goal_y - y) < ARRIVED_METRES:
            return 0.0, 0.0
        return steer(x, y, theta, goal_x, goal_y, max_speed, max_turn_rate, seconds)
    return steer(x, y, theta, centres[target, 0], centres[target, 1], max_speed, max_turn_rate, seconds)


@njit(cache=True)
def itinerary_table(
    nearest, cell_metres, centres, aims, goals, waypoints, x, y, theta, max_speed, max_turn_rate,
    seconds, steps_per_tick, first, switch, second, positions, effort,
):  # fmt: skip
    """Fill `positions` ``[I, T + 1, 2]`` and `effort` ``[I, T + 1]``: every itinerary driven from one pose.

    Itinerary i takes route ``first[i]`` until tick ``switch[i]``, then ``second[i]``; route W stays. `effort` is the sum of
    v^2 + w^2 over the ticks so far (mean over the control steps of a tick).
    """
    routes, ticks = waypoints.shape[0], positions.shape[1] - 1
    for i in range(first.shape[0]):
        px, py, heading, spent = x, y, theta, 0.0
        positions[i, 0, 0], positions[i, 0, 1] = px, py
        effort[i, 0] = 0.0
        arrived = -1
        for t in range(1, ticks + 1):
            route = first[i] if t <= switch[i] else second[i]
            if route != arrived and route != routes:
                for _ in range(steps_per_tick):
                    v, w = drive(
                        nearest, cell_metres, centres, aims[route], goals[route], waypoints[route, 0],
                        waypoints[route, 1], px, py, heading, max_speed, max_turn_rate, seconds,
                    )  # fmt: skip
                    if v == 0.0 and w == 0.0:
                        arrived = route
                        break
                    px, py, heading = unicycle_step(px, py, heading, v, w, seconds)
                    spent += (v * v + w * w) / steps_per_tick
            positions[i, t, 0], positions[i, t, 1] = px, py
            effort[i, t] = spent


@njit(cache=True)
def shortcut(nearest, cell_metres, centres, aim, goal, goal_x, goal_y, x, y, start, turn_ticks, reach, positions):
    """Fill `positions` ``[T + 1, 2]`` from tick `start` on: along a route without turning circles, after a pause to turn.

    `reach` is the distance driven in a tick. Quick, and within a tick or so of the true motion.
    """
    ticks = positions.shape[0] - 1
    positions[start, 0], positions[start, 1] = x, y
    for t in range(start + 1, ticks + 1):
        left = reach if t > start + turn_ticks else 0.0
        while left > 0.0:
            r = min(max(int(y / cell_metres), 0), nearest.shape[0] - 1)
            c = min(max(int(x / cell_metres), 0), nearest.shape[1] - 1)
            target = aim[nearest[r, c]]
            to_x, to_y = (goal_x, goal_y) if target == goal else (centres[target, 0], centres[target, 1])
            gap = math.hypot(to_x - x, to_y - y)
            if gap > left:
                x, y = x + left / gap * (to_x - x), y + left / gap * (to_y - y)
                left = 0.0
            else:
                x, y = to_x, to_y
                left = 0.0 if target == goal or gap < 1e-9 else left - gap
        positions[t, 0], positions[t, 1] = x, y
