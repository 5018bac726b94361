# mypy: ignore-errors
"""Compiled loops of the world: geodesic distances on a grid and the kinematic unicycle.

Arrays and scalars only; nothing here validates or raises. Each has a slow twin in ``tests/world``.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

# (row, column) moves of the 16-neighbourhood: 4 straight, 4 diagonal, 8 knight moves.
MOVES = np.array(
    [(0, 1), (1, 0), (0, -1), (-1, 0), (1, 1), (1, -1), (-1, 1), (-1, -1),
     (1, 2), (2, 1), (-1, 2), (-2, 1), (1, -2), (2, -1), (-1, -2), (-2, -1)],
    dtype=np.int32,
)  # fmt: skip


@njit(cache=True)
def free_move(cell_at, row, column, move_row, move_column):
    """Whether the squares that a 16-neighbour move crosses are all free."""
    rows, columns = cell_at.shape
    r, c = row + move_row, column + move_column
    if r < 0 or c < 0 or r >= rows or c >= columns or cell_at[r, c] < 0:
        return False
    if abs(move_row) + abs(move_column) == 2:
        return cell_at[row, c] >= 0 and cell_at[r, column] >= 0
    if abs(move_row) == 2:
        half = row + move_row // 2
        return cell_at[half, column] >= 0 and cell_at[half, c] >= 0
    if abs(move_column) == 2:
        half = column + move_column // 2
        return cell_at[row, half] >= 0 and cell_at[r, half] >= 0
    return True


@njit(cache=True)
def _sift_down(keys, items, size):
    parent = 0
    while True:
        child = 2 * parent + 1
        if child >= size:
            return
        if child + 1 < size and keys[child + 1] < keys[child]:
            child += 1
        if keys[parent] <= keys[child]:
            return
        keys[parent], keys[child] = keys[child], keys[parent]
        items[parent], items[child] = items[child], items[parent]
        parent = child


@njit(cache=True)
def _sift_up(keys, items, last):
    child = last
    while child > 0:
        parent = (child - 1) // 2
        if keys[parent] <= keys[child]:
            return
        keys[parent], keys[child] = keys[child], keys[parent]
        items[parent], items[child] = items[child], items[parent]
        child = parent


@njit(cache=True)
def geodesic(cell_at, row, column, sources, cost):
    """``[S]`` distances in cells to the nearest source: Dijkstra with a binary heap over the 16-neighbourhood."""
    cells = row.shape[0]
    distance = np.full(cells, np.inf)
    capacity = 17 * cells + sources.shape[0] + 1
    keys = np.empty(capacity)
    items = np.empty(capacity, dtype=np.int32)
    size = 0
    for s in sources:
        distance[s] = 0.0
        keys[size] = 0.0
        items[size] = s
        size += 1
    while size > 0:
        key, cell = keys[0], items[0]
        size -= 1
        keys[0], items[0] = keys[size], items[size]
        _sift_down(keys, items, size)
        if key > distance[cell]:
            continue
        for m in range(16):
            dr, dc = MOVES[m, 0], MOVES[m, 1]
            if not free_move(cell_at, row[cell], column[cell], dr, dc):
                continue
            other = cell_at[row[cell] + dr, column[cell] + dc]
            reached = key + math.sqrt(dr * dr + dc * dc) * 0.5 * (cost[cell] + cost[other])
            if reached < distance[other]:
                distance[other] = reached
                keys[size] = reached
                items[size] = other
                _sift_up(keys, items, size)
                size += 1
    return distance


@njit(cache=True)
def wrap_angle(angle):
    """The same angle in [-pi, pi)."""
    return (angle + math.pi) % (2.0 * math.pi) - math.pi


@njit(cache=True)
def unicycle_step(x, y, theta, v, w, seconds):
    """Exact motion of a unicycle under constant speed v [m/s] and turn rate w [rad/s] (Thrun et al. 2005, eq. 5.9)."""
    if abs(w) < 1e-9:
        return x + v * seconds * math.cos(theta), y + v * seconds * math.sin(theta), theta
    end = theta + w * seconds
    return (
        x + v / w * (math.sin(end) - math.sin(theta)),
        y - v / w * (math.cos(end) - math.cos(theta)),
        wrap_angle(end),
    )


@njit(cache=True)
def steer(x, y, theta, target_x, target_y, max_speed, max_turn_rate, seconds):
    """Speed and turn rate that bring a unicycle to a target point: turn towards it, drive as far as the heading allows.

    Drives at full speed when aligned, turns on the spot beyond 60 degrees, and slows down so as to stop at the target.
    """
    dx, dy = target_x - x, target_y - y
    distance = math.hypot(dx, dy)
    if distance < 1e-6:
        return 0.0, 0.0
    error = wrap_angle(math.atan2(dy, dx) - theta)
    w = min(max(error / seconds, -max_turn_rate), max_turn_rate)
    aligned = math.cos(error)
    v = 0.0 if aligned < 0.5 else max_speed * aligned
    return min(v, distance / seconds), w
