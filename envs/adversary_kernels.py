# mypy: ignore-errors
"""Compiled loops of the adversary's side: labels of points, missions, and what a policy observes.

Arrays and scalars only; nothing here validates or raises. `bank` is `adversary_tables.Tables`: many tasks packed into
flat arrays, a row of offsets each. Column numbers of those rows are the constants below.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from tab_marl.envs.lidar_kernels import free_distance
from tab_marl.mission.kernels import advance
from tab_marl.mission.route_kernels import look_ahead

# Columns of Tables.number.
LOCATIONS, LABELS, PROPOSITIONS, CELLS, ROWS, COLUMNS = 0, 1, 2, 3, 4, 5
GRID_AT, CENTRES_AT, TABLE_AT, LOCATION_AT, REGION_AT, OBSTACLES = 6, 7, 8, 9, 10, 11
DISC_AT, DISCS, EDGE_AT, EDGES, HORIZON_TICKS, INITIAL = 12, 13, 14, 15, 16, 17
VIAS, VIA_HOME, FORBIDS_AT, SUBSTEPS = 18, 19, 20, 21
NUMBERS = 22
# Columns of Tables.field, one row for the plain route and one for the styled one.
SYMBOL_AT, FIELD_LOCATIONS, FIELD_LABELS, FIELD_TABLE_AT, COST_AT, DISTANCE_AT = 0, 1, 2, 3, 4, 5
FIELD_NUMBERS = 6
PLAIN, STYLED = 0, 1
# Columns of Tables.real.
CELL_METRES, WIDTH, HEIGHT, RADIUS, MAX_SPEED, MAX_TURN, TICK_SECONDS = 0, 1, 2, 3, 4, 5, 6
VIA_X, VIA_Y = 7, 9  # two each
SIDE, CAMERA_SHY, EDGE_NOISE, ARRIVAL_FRACTION = 11, 12, 13, 14
REALS = 15
# Columns of Tables.window.
TOTAL_EARLIEST, TOTAL_LATEST = 0, 1

UNBOUNDED = 2**30
LOOK_AHEAD = 1.2
VIA_METRES = 0.17
RAYS = 12
RAY_METRES = 1.0
# A styled route is given up for the plain one when less time than this is left beyond what it needs.
RESERVE_SECONDS = 1.0
RESERVE_SHARE = 0.04
ARRIVAL_RESERVE_SECONDS = 1.5

# Rows of the observation; the table with their meaning is in adversary_observation.py.
O_ROUTE, O_NEAR, O_VISIT, O_LENGTH, O_SLACK, O_TOTAL, O_TARGET, O_SPEED = 0, 2, 3, 4, 5, 7, 9, 13
O_LIMIT, O_VIA, O_STYLED, O_ZONE, O_RAYS, O_LATENTS, O_EGO = 15, 16, 17, 18, 21, 33, 37
OBSERVED = 40


@njit(cache=True)
def region_distance(disc, first, halfplanes, region, x, y):
    """Signed metres to a region's boundary, negative inside (a lower bound near a polygon's corners)."""
    if disc[region, 0] > 0.0:
        return math.hypot(x - disc[region, 1], y - disc[region, 2]) - disc[region, 3]
    worst = -np.inf
    for i in range(first[region], first[region + 1]):
        gap = halfplanes[i, 0] * x + halfplanes[i, 1] * y - halfplanes[i, 2]
        worst = max(worst, gap)
    return worst


@njit(cache=True)
def label(disc, first, halfplanes, start, count, x, y):
    """Bit mask of the regions ``start .. start + count`` that hold the point; their boundaries belong to them."""
    mask = 0
    for p in range(count):
        if region_distance(disc, first, halfplanes, start + p, x, y) <= 1e-9:
            mask |= 1 << p
    return mask


@njit(cache=True)
def task_label(bank, k, x, y):
    """Label of a point in the mission of task k."""
    number = bank.number[k]
    return label(bank.disc, bank.region_first, bank.halfplanes, number[REGION_AT], number[PROPOSITIONS], x, y)


@njit(cache=True)
def task_advance(bank, k, location, clocks, x, y):
    """One tick of task k's mission at a point; moves clocks in place. Returns (location, visit counted)."""
    if location < 0:
        return location, False
    number = bank.number[k]
    u, n = number[LOCATIONS], number[LABELS]
    at, end = number[TABLE_AT], number[TABLE_AT] + u * n
    here, there = number[LOCATION_AT], number[LOCATION_AT] + u
    mask = task_label(bank, k, x, y)
    counted = bank.progress[at + location * n + mask]
    after = advance(
        bank.next_location[at:end].reshape(u, n), bank.forbidden_until[at:end].reshape(u, n),
        bank.progress[at:end].reshape(u, n), bank.patient[here:there], bank.earliest[here:there],
        bank.latest[here:there], bank.resets[at:end].reshape(u, n, 3), location, clocks, mask,
    )  # fmt: skip
    if after >= 0 and clocks[0] > number[HORIZON_TICKS]:
        after = -2
    return after, counted and after != -2


@njit(cache=True)
def _way(bank, k, field, location, route_location, x, y):
    """Along one route field: (target x, y, plain metres to completion, plain metres to the next counted visit)."""
    number, row = bank.number[k], bank.field[k, field]
    s, u, n = number[CELLS], row[FIELD_LOCATIONS], row[FIELD_LABELS]
    rows, columns = number[ROWS], number[COLUMNS]
    g = number[GRID_AT]
    cell_at = bank.cell_at[g : g + rows * columns].reshape(rows, columns)
    nearest = bank.nearest[g : g + rows * columns].reshape(rows, columns)
    c = number[CENTRES_AT]
    centres = bank.centres[c : c + s]
    symbol = bank.symbol[row[SYMBOL_AT] : row[SYMBOL_AT] + s]
    table = bank.route_table[row[FIELD_TABLE_AT] : row[FIELD_TABLE_AT] + u * n].reshape(u, n)
    cost = bank.cost[row[COST_AT] : row[COST_AT] + s]
    d = row[DISTANCE_AT]
    distance = bank.distance[d : d + u * s].reshape(u, s)
    next_cell = bank.next_cell[d : d + u * s].reshape(u, s)
    cell, after, changes = look_ahead(
        x, y, route_location, cell_at, nearest, bank.real[k, CELL_METRES], centres, symbol, table, cost, distance,
        next_cell, LOOK_AHEAD,
    )  # fmt: skip
    if cell < 0:
        return x, y, np.inf, np.inf
    tx, ty = centres[cell, 0], centres[cell, 1]
    straight = math.hypot(tx - x, ty - y)
    counted = False
    if changes and route_location < number[LOCATIONS]:
        # The location changes where the region begins, not at the cell's centre: bisect for that point.
        at = number[TABLE_AT] + location * number[LABELS]
        counted = bank.progress[at + task_label(bank, k, tx, ty)]
        low, high = 0.0, 1.0
        for _ in range(8):
            middle = 0.5 * (low + high)
            mask = task_label(bank, k, x + middle * (tx - x), y + middle * (ty - y))
            if bank.next_location[at + mask] != location:
                high = middle
            else:
                low = middle
        near = high * straight
    else:
        near = straight
    if after < 0:
        return tx, ty, near, near
    rest, visit = bank.length[d + after * s + cell], bank.to_visit[d + after * s + cell]
    # What follows is measured from the cell's centre, so the way there is walked in full.
    return tx, ty, straight + rest, near if counted else straight + visit


@njit(cache=True)
def _seconds_left(bank, k, location, clocks):
    """(own, total, own target, total target): seconds until the windows of this visit and of the mission's end close,
    and until the middle of their exact windows; inf where there is none (targets: -1)."""
    number = bank.number[k]
    tick = bank.real[k, TICK_SECONDS]
    at = number[LOCATION_AT] + location
    own, own_target = np.inf, -1.0
    for c in range(3):
        latest = bank.latest[at, c]
        if latest < UNBOUNDED:
            own = min(own, (latest - clocks[c]) * tick)
            if bank.earliest[at, c] > 0 and not bank.patient[at]:
                own_target = (0.5 * (latest + bank.earliest[at, c]) - clocks[c]) * tick
    total, total_target = np.inf, -1.0
    if bank.window[at, TOTAL_LATEST] < UNBOUNDED:
        total = (bank.window[at, TOTAL_LATEST] - clocks[0]) * tick
        if bank.window[at, TOTAL_EARLIEST] > 0:
            total_target = (0.5 * (bank.window[at, TOTAL_LATEST] + bank.window[at, TOTAL_EARLIEST]) - clocks[0]) * tick
    return own, total, own_target, total_target


@njit(cache=True)
def _allowed(bank, k, location, clocks):
    """(seconds allowed for this visit by its tightest clock, seconds since that clock started); inf if unbounded."""
    number = bank.number[k]
    tick = bank.real[k, TICK_SECONDS]
    at = number[LOCATION_AT] + location
    allowed, spent, left = np.inf, 0.0, np.inf
    for c in range(3):
        latest = bank.latest[at, c]
        if latest < UNBOUNDED and latest - clocks[c] < left:
            allowed, spent, left = latest * tick, clocks[c] * tick, latest - clocks[c]
    return allowed, spent


@njit(cache=True)
def _tanh_clip(out, at, seconds):
    """Two rows for a time: in tens of seconds within -0.5..2, and its tanh."""
    out[at] = min(max(seconds, -5.0), 20.0) / 10.0
    out[at + 1] = math.tanh(seconds)


@njit(cache=True)
def observe(bank, k, x, y, theta, v, w, location, clocks, memory, ego_seen, ego_x, ego_y, out):
    """Write the observation ``out[OBSERVED]`` of task k, and move ``memory`` int32[2] (via points passed, style dropped).

    Returns (plain metres to completion, metres of excess time) of the route in use, for the reward.
    """
    number, real = bank.number[k], bank.real[k]
    speed = real[MAX_SPEED]
    out[:] = 0.0
    if location < 0:
        return 0.0, 0.0
    # Which route: the styled one until time runs short, over the via points that are still ahead.
    vias = number[VIAS]
    if memory[0] < vias:
        if location != number[VIA_HOME]:
            memory[0] = vias
        else:
            i = memory[0]
            if math.hypot(x - real[VIA_X + i], y - real[VIA_Y + i]) <= VIA_METRES:
                memory[0] += 1
    limit = bank.speed_limit[number[LOCATION_AT] + location]
    pace = min(speed, limit)
    own, total, own_target, total_target = _seconds_left(bank, k, location, clocks)
    field = PLAIN if memory[1] else STYLED
    route_location = location
    if field == STYLED and memory[0] < vias:
        route_location = number[LOCATIONS] + memory[0]
    tx, ty, length, visit = _way(bank, k, field, location, route_location, x, y)
    if field == STYLED:
        reserve = RESERVE_SECONDS + RESERVE_SHARE * length / pace
        if not (visit / pace + reserve <= own and length / pace + reserve <= total):
            memory[1] = 1
            tx, ty, length, visit = _way(bank, k, PLAIN, location, location, x, y)
    if not length < np.inf:
        length = visit = 20.0
    cos, sin = math.cos(theta), math.sin(theta)
    dx, dy = tx - x, ty - y
    near = math.hypot(dx, dy)
    if near > 1e-6:
        out[O_ROUTE] = (dx * cos + dy * sin) / near
        out[O_ROUTE + 1] = (dy * cos - dx * sin) / near
    out[O_NEAR] = min(near, LOOK_AHEAD) / LOOK_AHEAD
    out[O_VISIT] = min(visit, 4.0) / 2.0
    out[O_LENGTH] = min(length, 8.0) / 4.0
    _tanh_clip(out, O_SLACK, min(own - visit / pace, 20.0))
    _tanh_clip(out, O_TOTAL, min(total - length / pace, 20.0))
    # When to arrive: in the middle of an exact window, or at the drawn share of what is allowed.
    excess, has_target, exact = 0.0, False, 0.0
    if own_target >= 0.0:
        excess, has_target, exact = own_target - visit / pace, True, 1.0
    elif total_target >= 0.0:
        excess, has_target, exact = total_target - length / pace, True, 1.0
    elif real[ARRIVAL_FRACTION] > 0.0 and not memory[1]:
        share = real[ARRIVAL_FRACTION]
        window = bank.window[number[LOCATION_AT] + location, TOTAL_LATEST]
        allowed, spent = _allowed(bank, k, location, clocks)
        if window < number[HORIZON_TICKS] or not allowed < np.inf:
            allowed = min(window, number[HORIZON_TICKS]) * real[TICK_SECONDS]
            target = min(share * allowed, allowed - ARRIVAL_RESERVE_SECONDS) - clocks[0] * real[TICK_SECONDS]
            excess = target - length / pace
        else:
            excess = min(share * allowed, allowed - ARRIVAL_RESERVE_SECONDS) - spent - visit / pace
        has_target = True
    if has_target:
        out[O_TARGET] = 1.0
        _tanh_clip(out, O_TARGET + 1, excess)
        out[O_TARGET + 3] = exact
    out[O_SPEED] = min(max(v / speed, -1.0), 1.0)
    out[O_SPEED + 1] = min(max(w / real[MAX_TURN], -1.0), 1.0)
    out[O_LIMIT] = min(limit / speed, 1.0)
    out[O_VIA] = 1.0 if memory[0] < vias and not memory[1] else 0.0
    out[O_STYLED] = 0.0 if memory[1] else 1.0
    _observe_zone(bank, k, location, x, y, cos, sin, out)
    discs = bank.ray_discs[number[DISC_AT] : number[DISC_AT] + number[DISCS]]
    edges = bank.ray_edges[number[EDGE_AT] : number[EDGE_AT] + number[EDGES]]
    for i in range(RAYS):
        a = theta + 2.0 * math.pi * i / RAYS
        out[O_RAYS + i] = free_distance(x, y, math.cos(a), math.sin(a), RAY_METRES, discs, edges) / RAY_METRES
    out[O_LATENTS] = real[SIDE]
    out[O_LATENTS + 1] = real[CAMERA_SHY]
    out[O_LATENTS + 2] = real[EDGE_NOISE]
    out[O_LATENTS + 3] = real[ARRIVAL_FRACTION]
    if ego_seen:
        dx, dy = ego_x - x, ego_y - y
        out[O_EGO] = 1.0
        out[O_EGO + 1] = min(max(dx * cos + dy * sin, -2.0), 2.0)
        out[O_EGO + 2] = min(max(dy * cos - dx * sin, -2.0), 2.0)
    return length, max(excess, 0.0) * pace


@njit(cache=True)
def gained(before, after, via, dropped, memory, owed_length, owed_excess, length, excess):
    """What a step brought in metres: (drop of the distance-to-go, drop of the excess time x pace).

    `before`, `after`: locations; `via`, `dropped`: `memory` before the step; `owed_*` and the last two: what `observe`
    returned before and after it. Nothing is gained or lost where the route itself changed, or by a failure.
    """
    if before < 0 or after == -2:
        return 0.0, 0.0
    if after == -1:
        return owed_length, 0.0
    same_route = memory[1] == dropped
    metres = owed_length - length if same_route and memory[0] == via else 0.0
    return metres, owed_excess - excess if same_route and after == before else 0.0


@njit(cache=True)
def _observe_zone(bank, k, location, x, y, cos, sin, out):
    """Direction (body frame) and metres, at most 1, to the nearest region that fails the mission at this location."""
    number = bank.number[k]
    props = number[PROPOSITIONS]
    closest, zone = 1.0, -1
    for p in range(props):
        if bank.forbids[number[FORBIDS_AT] + location * props + p]:
            gap = region_distance(bank.disc, bank.region_first, bank.halfplanes, number[REGION_AT] + p, x, y)
            if gap < closest:
                closest, zone = gap, p
    out[O_ZONE + 2] = max(closest, -0.2)
    if zone >= 0:
        cx, cy = bank.region_centre[number[REGION_AT] + zone, 0], bank.region_centre[number[REGION_AT] + zone, 1]
        away = max(math.hypot(cx - x, cy - y), 1e-9)
        out[O_ZONE] = ((cx - x) * cos + (cy - y) * sin) / away
        out[O_ZONE + 1] = ((cy - y) * cos - (cx - x) * sin) / away
