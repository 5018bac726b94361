# mypy: ignore-errors
"""Compiled loops of adversary models that move points: random walks along or across the way ahead, and the way itself.

Arrays and scalars only; nothing here validates or raises. Each has a slow twin in ``tests/planning``. `rules`, `ways`
and `ground` are the tuples of arrays of `mission_map`.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from tab_marl.mission.kernels import advance

DRAWS = 12
"""Moves drawn before a walker that finds no allowed one takes the way ahead (or stays)."""

RESERVE_CELLS = 3.0
"""Route cells by which a walker must be ahead of its deadline to take a random move."""


@njit(cache=True)
def square_of(x, y, metres, rows, columns):
    """Row and column of the square that holds a point, clipped to the map."""
    return min(max(int(y / metres), 0), rows - 1), min(max(int(x / metres), 0), columns - 1)


@njit(cache=True)
def can_move(x, y, to_x, to_y, ground):
    """Whether a short straight move ends on the map and crosses free squares (tested half-way and at its end)."""
    free, _mask, metres = ground
    rows, columns = free.shape
    if to_x < 0.0 or to_y < 0.0 or to_x >= columns * metres or to_y >= rows * metres:
        return False
    r, c = square_of(to_x, to_y, metres, rows, columns)
    if not free[r, c]:
        return False
    r, c = square_of(0.5 * (x + to_x), 0.5 * (y + to_y), metres, rows, columns)
    return free[r, c]


@njit(cache=True)
def mask_of(x, y, ground):
    """The automaton's label at a point."""
    _free, mask, metres = ground
    r, c = square_of(x, y, metres, mask.shape[0], mask.shape[1])
    return mask[r, c]


@njit(cache=True)
def read_label(location, clocks, mask, rules):
    """One tick of the automaton; moves `clocks` int32[3] in place and returns the next location."""
    next_location, forbidden_until, progress, patient, earliest, latest, resets = rules
    return advance(
        next_location, forbidden_until, progress, patient, earliest, latest, resets, location, clocks, mask
    )  # fmt: skip


@njit(cache=True)
def read_labels(x, y, location, clocks, rules, ground):
    """One tick of the automaton for N points; moves `location` ``[N]`` and `clocks` ``[N, 3]`` in place."""
    for i in range(x.shape[0]):
        location[i] = read_label(location[i], clocks[i], mask_of(x[i], y[i], ground), rules)


@njit(cache=True)
def read_same_label(location, clocks, mask, rules):
    """`read_labels` where all N points have the same label."""
    for i in range(location.shape[0]):
        location[i] = read_label(location[i], clocks[i], mask, rules)


@njit(cache=True)
def wander(positions, start, reach, ground, rng):
    """From tick `start` on, uniform random moves in place of what `positions` ``[T + 1, 2]`` held."""
    for t in range(start + 1, positions.shape[0]):
        x, y = positions[t - 1, 0], positions[t - 1, 1]
        positions[t, 0], positions[t, 1] = x, y
        for _ in range(DRAWS):
            angle, distance = 2.0 * math.pi * rng.random(), reach * math.sqrt(rng.random())
            to_x, to_y = x + distance * math.cos(angle), y + distance * math.sin(angle)
            if can_move(x, y, to_x, to_y, ground):
                positions[t, 0], positions[t, 1] = to_x, to_y
                break


@njit(cache=True)
def in_time(x, y, location, clocks, rules, ways, mission_latest, reach):
    """Whether the next visit and the whole mission can still be reached in the time left, clocks and metres only."""
    if location < 0:
        return location == -1
    _next, _forbidden, _progress, _patient, _earliest, latest, _resets = rules
    nearest, cell_metres, _centres, _target, to_visit, length = ways
    r, c = square_of(x, y, cell_metres, nearest.shape[0], nearest.shape[1])
    cell = nearest[r, c]
    left = mission_latest - clocks[0]
    # A distance is that of the cell's centre, and the way ahead is followed in whole ticks: keep a reserve. Who has no time
    # left for a random move takes the way ahead at full speed, which is all that can be done.
    reserve = RESERVE_CELLS * cell_metres
    if length[location, cell] + reserve > left * reach:
        return False
    for k in range(3):
        if latest[location, k] < mission_latest:
            left = min(left, latest[location, k] - clocks[k])
    return to_visit[location, cell] + reserve <= left * reach


@njit(cache=True)
def way_angle(x, y, location, ways):
    """Direction of the way ahead [rad] and the distance to its next aim, 0 and 0 where there is none."""
    nearest, cell_metres, centres, target, _to_visit, _length = ways
    if location < 0:
        return 0.0, 0.0
    r, c = square_of(x, y, cell_metres, nearest.shape[0], nearest.shape[1])
    aim = target[location, nearest[r, c]]
    if aim < 0:
        return 0.0, 0.0
    dx, dy = centres[aim, 0] - x, centres[aim, 1] - y
    return math.atan2(dy, dx), math.hypot(dx, dy)


@njit(cache=True)
def walk_once(
    x, y, location, clocks, cumulative, speeds, feasible, mission_latest, reach, rules, ways, ground, trial, rng
):
    """One random move of one walker; moves `clocks` in place and returns (x, y, location).

    `cumulative` ``[A * V]`` is the distribution over (angle from the way ahead, speed) bins, `speeds` the number V of
    speed bins. With `feasible`, moves after which the mission cannot be completed in time are drawn again.
    """
    angles = cumulative.shape[0] // speeds
    ahead, gap = way_angle(x, y, location, ways)
    active = location >= 0
    for _ in range(DRAWS):
        bin_ = min(np.searchsorted(cumulative, rng.random() * cumulative[-1], side="right"), cumulative.shape[0] - 1)
        angle = ahead + (bin_ // speeds + rng.random() - 0.5) * 2.0 * math.pi / angles
        low, high = (bin_ % speeds) / speeds, (bin_ % speeds + 1) / speeds
        # Uniform over the ring's area.
        distance = reach * math.sqrt(low * low + rng.random() * (high * high - low * low))
        to_x, to_y = x + distance * math.cos(angle), y + distance * math.sin(angle)
        if not can_move(x, y, to_x, to_y, ground):
            continue
        trial[:] = clocks
        following = read_label(location, trial, mask_of(to_x, to_y, ground), rules)
        if feasible and active and not in_time(to_x, to_y, following, trial, rules, ways, mission_latest, reach):
            continue
        clocks[:] = trial
        return to_x, to_y, following
    if feasible and active:
        distance = min(reach, gap)
        to_x, to_y = x + distance * math.cos(ahead), y + distance * math.sin(ahead)
        trial[:] = clocks
        following = read_label(location, trial, mask_of(to_x, to_y, ground), rules)
        if following != -2:
            clocks[:] = trial
            return to_x, to_y, following
    following = read_label(location, clocks, mask_of(x, y, ground), rules)
    return x, y, following


@njit(cache=True)
def walk(
    x, y, location, clocks, cumulative, speeds, feasible, mission_latest, reach, rules, ways, ground, positions, completed,
    rng,
):  # fmt: skip
    """Walk N points for T ticks; fill `positions` ``[N, T + 1, 2]`` and `completed` ``[N]``; the state ends at tick T."""
    trial = np.empty(3, dtype=np.int32)
    for i in range(x.shape[0]):
        positions[i, 0, 0], positions[i, 0, 1] = x[i], y[i]
        completed[i] = -1
        for t in range(1, positions.shape[1]):
            before = location[i]
            x[i], y[i], location[i] = walk_once(
                x[i], y[i], before, clocks[i], cumulative, speeds, feasible, mission_latest, reach, rules, ways, ground,
                trial, rng,
            )  # fmt: skip
            if before >= 0 and location[i] == -1:
                completed[i] = t
            positions[i, t, 0], positions[i, t, 1] = x[i], y[i]


@njit(cache=True)
def too_early(location, clocks, mask, rules):
    """Whether entering a place with this label at the next tick would fail for coming before its window."""
    _next, _forbidden, progress, patient, earliest, _latest, _resets = rules
    if not progress[location, mask] or patient[location]:
        return False
    early = False
    for k in range(3):
        early |= clocks[k] + 1 < earliest[location, k]
    return early


@njit(cache=True)
def spare_ticks(x, y, location, clocks, rules, ways, mission_latest, reach):
    """How many ticks a robot may idle before its next visit, or its mission, is out of reach; 0 if none or hopeless."""
    if location < 0:
        return 0
    _next, _forbidden, _progress, _patient, _earliest, latest, _resets = rules
    nearest, cell_metres, _centres, _target, to_visit, length = ways
    r, c = square_of(x, y, cell_metres, nearest.shape[0], nearest.shape[1])
    cell = nearest[r, c]
    if not np.isfinite(length[location, cell]):
        return 0
    spare = mission_latest - clocks[0] - math.ceil(length[location, cell] / reach)
    for k in range(3):
        if latest[location, k] < mission_latest:
            spare = min(spare, latest[location, k] - clocks[k] - math.ceil(to_visit[location, cell] / reach))
    return max(0, spare - 1)


@njit(cache=True)
def follow_way(
    x, y, location, clocks, delay, pace, reach, rules, ways, ground, positions, locations, states
):  # fmt: skip
    """Follow the way ahead for T ticks after waiting `delay` ticks; returns the tick of completion or -1.

    Moves at `pace` times full speed, and stays outside while it would be too early. Fills `positions` ``[T + 1, 2]``,
    `locations` ``[T + 1]`` and `states` ``[T + 1, 3]`` (clocks); the given location and clocks are those of tick 0.
    """
    ticks = positions.shape[0] - 1
    done = -1
    positions[0, 0], positions[0, 1] = x, y
    locations[0] = location
    states[0, :] = clocks
    moving = clocks.copy()
    for t in range(1, ticks + 1):
        if location >= 0 and t > delay:
            left = reach * pace
            for _ in range(4):
                ahead, gap = way_angle(x, y, location, ways)
                if left < 1e-9 or gap < 1e-9:
                    break
                step = min(left, gap)
                to_x, to_y = x + step * math.cos(ahead), y + step * math.sin(ahead)
                mask = mask_of(to_x, to_y, ground)
                if too_early(location, moving, mask, rules):
                    break
                x, y, left = to_x, to_y, left - step
                # A label that moves the mission on must be read at a tick: stop there.
                if rules[0][location, mask] != location:
                    break
        before = location
        location = read_label(location, moving, mask_of(x, y, ground), rules)
        if before >= 0 and location == -1:
            done = t
        positions[t, 0], positions[t, 1] = x, y
        locations[t] = location
        states[t, :] = moving
    return done
