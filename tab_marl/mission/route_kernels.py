# mypy: ignore-errors
"""Compiled loops of the route fields: Dijkstra on locations x cells, and the any-angle look-ahead along a route.

Arrays and scalars only; nothing here validates or raises. Each has a slow twin in ``tests/mission``.

Letters: `U` locations, `S` cells, `L` distinct labels (symbols) of cells.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from tab_marl.world.kernels import MOVES, _sift_down, _sift_up, free_move

COMPLETED = -1
IMPASSABLE = -2
NO_CELL = -1

# Index of the move that undoes each move.
OPPOSITE = np.array([2, 3, 0, 1, 7, 6, 5, 4, 14, 15, 12, 13, 10, 11, 8, 9], dtype=np.int32)
MOVE_CELLS = np.sqrt((MOVES.astype(np.float64) ** 2).sum(axis=1))
# Unit vectors (x, y) of the moves.
MOVE_X = MOVES[:, 1] / MOVE_CELLS
MOVE_Y = MOVES[:, 0] / MOVE_CELLS


@njit(cache=True)
def neighbourhood(cell_at, row, column):
    """``[S, 16]`` cell reached by each move or NO_CELL, and ``[S, 16, 2]`` the cells it crosses or NO_CELL."""
    cells = row.shape[0]
    reached = np.full((cells, 16), NO_CELL, dtype=np.int32)
    crossed = np.full((cells, 16, 2), NO_CELL, dtype=np.int32)
    for s in range(cells):
        r, c = row[s], column[s]
        for m in range(16):
            dr, dc = MOVES[m, 0], MOVES[m, 1]
            if not free_move(cell_at, r, c, dr, dc):
                continue
            reached[s, m] = cell_at[r + dr, c + dc]
            if abs(dr) + abs(dc) == 2:
                crossed[s, m, 0] = cell_at[r, c + dc]
                crossed[s, m, 1] = cell_at[r + dr, c]
            elif abs(dr) == 2:
                crossed[s, m, 0] = cell_at[r + dr // 2, c]
                crossed[s, m, 1] = cell_at[r + dr // 2, c + dc]
            elif abs(dc) == 2:
                crossed[s, m, 0] = cell_at[r, c + dc // 2]
                crossed[s, m, 1] = cell_at[r + dr, c + dc // 2]
    return reached, crossed


@njit(cache=True)
def edge_costs(reached, cost):
    """``[S, 16]``: mean of both ends' cost ``[S]`` for every move."""
    cells = reached.shape[0]
    out = np.ones((cells, 16))
    for s in range(cells):
        for m in range(16):
            if reached[s, m] >= 0:
                out[s, m] = 0.5 * (cost[s] + cost[reached[s, m]])
    return out


@njit(cache=True)
def product_dijkstra(reached, crossed, symbol, table, progress, extra, cost):
    """Shortest ways to COMPLETED on locations x cells, lengths in cells.

    Being at (u, s) means that the label of s was read. A move to s' (or staying, at no cost) reads its label: the
    location becomes ``table[u, symbol[s']]``. ``extra[u, l]`` (cells) is added when that transition is taken, and
    ``cost[s, m]`` multiplies the length of move m from s.

    Returns ``distance[U, S]`` (with costs), ``next_cell[U, S]`` (NO_CELL: cannot complete), ``length[U, S]`` (the same
    way without costs), ``to_visit[U, S]`` (without costs, until the next transition with ``progress``).
    """
    cells, locations, labels = reached.shape[0], table.shape[0], table.shape[1]
    nodes = locations * cells
    distance = np.full(nodes, np.inf)
    length = np.full(nodes, np.inf)
    to_visit = np.full(nodes, np.inf)
    next_cell = np.full(nodes, NO_CELL, dtype=np.int32)
    # Predecessors of (location, label) in CSR form; row `locations` stands for COMPLETED.
    first = np.zeros((locations + 1) * labels + 1, dtype=np.int64)
    for u in range(locations):
        for l in range(labels):
            v = table[u, l]
            if v != IMPASSABLE:
                first[(locations if v == COMPLETED else v) * labels + l + 1] += 1
    for i in range((locations + 1) * labels):
        first[i + 1] += first[i]
    fill = first[:-1].copy()
    before = np.empty(first[-1], dtype=np.int32)
    for u in range(locations):
        for l in range(labels):
            v = table[u, l]
            if v != IMPASSABLE:
                i = (locations if v == COMPLETED else v) * labels + l
                before[fill[i]] = u
                fill[i] += 1
    capacity = 17 * nodes + 1
    keys = np.empty(capacity)
    items = np.empty(capacity, dtype=np.int32)
    size = 0
    seeds = 0
    while True:
        # All goal entries first (one pass over the cells), then the heap.
        if seeds < cells:
            target, key, after_length, after_visit = seeds, 0.0, 0.0, 0.0
            v = locations
            seeds += 1
        elif size > 0:
            key, node = keys[0], items[0]
            size -= 1
            keys[0], items[0] = keys[size], items[size]
            _sift_down(keys, items, size)
            if key > distance[node]:
                continue
            v, target = node // cells, node % cells
            after_length, after_visit = length[node], to_visit[node]
        else:
            break
        l = symbol[target]
        for i in range(first[v * labels + l], first[v * labels + l + 1]):
            u = before[i]
            base = key + extra[u, l]
            counted = progress[u, l] or v == locations
            for m in range(-1, 16):
                if m < 0:
                    source, step, priced = target, 0.0, 0.0
                else:
                    source = reached[target, m]
                    if source < 0:
                        continue
                    a, b = crossed[target, m, 0], crossed[target, m, 1]
                    if a >= 0 and (table[u, symbol[a]] == IMPASSABLE or table[u, symbol[b]] == IMPASSABLE):
                        continue
                    step = MOVE_CELLS[m]
                    priced = step * cost[source, OPPOSITE[m]]
                node = u * cells + source
                way = base + priced
                if way < distance[node]:
                    distance[node] = way
                    length[node] = after_length + step
                    to_visit[node] = step if counted else after_visit + step
                    next_cell[node] = target
                    keys[size] = way
                    items[size] = node
                    _sift_up(keys, items, size)
                    size += 1
    shape = (locations, cells)
    return distance.reshape(shape), next_cell.reshape(shape), length.reshape(shape), to_visit.reshape(shape)


@njit(cache=True)
def straight_cost(x, y, to_x, to_y, location, cell_at, cell_metres, symbol, table, cost):
    """Cost in metres of the straight way between two points at a location.

    inf when it crosses a blocked or impassable square, or a square whose label changes the location before the end
    (a place that the route goes around: the way may enter the last place, but not leave one).
    """
    dx, dy = to_x - x, to_y - y
    far = math.hypot(dx, dy)
    if far < 1e-9:
        return 0.0
    heading, best = 0, -2.0
    for m in range(16):
        along = MOVE_X[m] * dx + MOVE_Y[m] * dy
        if along > best:
            heading, best = m, along
    rows, columns = cell_at.shape
    steps = int(far / (0.5 * cell_metres)) + 1
    total, entered = 0.0, False
    for k in range(1, steps + 1):
        f = k / steps
        r, c = int((y + f * dy) / cell_metres), int((x + f * dx) / cell_metres)
        if r < 0 or c < 0 or r >= rows or c >= columns:
            return np.inf
        s = cell_at[r, c]
        if s < 0 or table[location, symbol[s]] == IMPASSABLE:
            return np.inf
        changes = table[location, symbol[s]] != location
        if entered and not changes:
            return np.inf
        entered = changes
        total += cost[s, heading]
    return total / steps * far


# A straight way may cost this much more than the route's own before the route is followed instead.
STRAIGHT_TOLERANCE = 1.02


@njit(cache=True)
def look_ahead(
    x, y, location, cell_at, nearest, cell_metres, centres, symbol, table, cost, distance, next_cell, max_metres
):
    """The farthest cell along the route that a straight line reaches at no greater cost, up to the next transition.

    Returns (cell, location after reading it, whether that reading changes the location); cell is NO_CELL when the
    mission cannot be completed from here.
    """
    rows, columns = cell_at.shape
    r = min(max(int(y / cell_metres), 0), rows - 1)
    c = min(max(int(x / cell_metres), 0), columns - 1)
    here = nearest[r, c]
    chosen, after, changes = NO_CELL, location, False
    at = here
    start_cost = distance[location, here]
    while True:
        following = next_cell[location, at]
        if following < 0:
            break
        tx, ty = centres[following, 0], centres[following, 1]
        if chosen != NO_CELL:
            if math.hypot(tx - x, ty - y) > max_metres:
                break
            straight = straight_cost(x, y, tx, ty, location, cell_at, cell_metres, symbol, table, cost)
            on_route = start_cost - distance[location, following]
            # The first move is measured from a cell's centre, the line from the point: allow half a cell.
            if straight > STRAIGHT_TOLERANCE * on_route + 0.5 * cell_metres:
                break
        v = table[location, symbol[following]]
        chosen, after, changes = following, v, v != location
        if changes or following == at:
            break
        at = following
    return chosen, after, changes


@njit(cache=True)
def look_ahead_many(
    points, location, cell_at, nearest, cell_metres, centres, symbol, table, cost, distance, next_cell, max_metres
):
    """`look_ahead` for points ``[N, 2]``: cells ``[N]`` and locations after reading them ``[N]``."""
    count = points.shape[0]
    cell = np.empty(count, dtype=np.int32)
    after = np.empty(count, dtype=np.int32)
    for i in range(count):
        cell[i], after[i], _ = look_ahead(
            points[i, 0], points[i, 1], location, cell_at, nearest, cell_metres, centres, symbol, table, cost,
            distance, next_cell, max_metres,
        )  # fmt: skip
    return cell, after


@njit(cache=True)
def nearest_free(cell_at, centres, cell_metres):
    """``[rows, columns]``: the free cell whose centre is nearest to each square's (ties go to the lower number)."""
    rows, columns = cell_at.shape
    nearest = np.empty((rows, columns), dtype=np.int32)
    for r in range(rows):
        for c in range(columns):
            nearest[r, c] = cell_at[r, c]
            if cell_at[r, c] >= 0:
                continue
            x, y = (c + 0.5) * cell_metres, (r + 0.5) * cell_metres
            best = np.inf
            for s in range(centres.shape[0]):
                gap = (centres[s, 0] - x) ** 2 + (centres[s, 1] - y) ** 2
                if gap < best - 1e-12:
                    nearest[r, c], best = s, gap
    return nearest
