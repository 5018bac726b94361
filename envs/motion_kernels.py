# mypy: ignore-errors
"""Compiled motion of the batched worlds: unicycles, pushed out of walls and obstacles without friction.

Arrays and scalars only; nothing here validates or raises. `bank` is `adversary_tables.Tables`.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from tab_marl.envs.adversary_kernels import HEIGHT, OBSTACLES, PROPOSITIONS, REGION_AT, WIDTH
from tab_marl.world.kernels import unicycle_step, wrap_angle


@njit(cache=True)
def drive(bank, k, x, y, theta, v, w, radius, seconds, substeps):
    """A robot's motion on the map of task k for so many substeps of `seconds` each: (x, y, theta, speed, touched).

    One exact arc where nothing solid is in reach, else an arc per substep, each pushed out of what it sank into: what
    remains of the command is its part along the surface, as behind the motor of `physics.Arena`. `speed` is the speed
    along the heading that a wall leaves.
    """
    reach = radius + abs(v) * seconds * substeps
    if free_metres(bank, k, x, y, reach) > reach:
        x, y, theta = unicycle_step(x, y, theta, v, w, seconds * substeps)
        return x, y, theta, v, False
    # A substep's chord, turned by w * seconds from one substep to the next.
    turn = w * seconds
    chord = v * seconds
    if abs(turn) > 1e-9:
        chord *= math.sin(0.5 * turn) / (0.5 * turn)
    along_x, along_y = chord * math.cos(theta + 0.5 * turn), chord * math.sin(theta + 0.5 * turn)
    cos, sin = math.cos(turn), math.sin(turn)
    touched = pushed = False
    from_x, from_y = x, y
    for _ in range(substeps):
        from_x, from_y = x, y
        x, y, pushed = push_out(bank, k, x + along_x, y + along_y, radius)
        touched = touched or pushed
        along_x, along_y = along_x * cos - along_y * sin, along_x * sin + along_y * cos
    theta = wrap_angle(theta + turn * substeps)
    speed = v
    if pushed:
        speed = ((x - from_x) * math.cos(theta) + (y - from_y) * math.sin(theta)) / seconds
    return x, y, theta, speed, touched


@njit(cache=True)
def free_metres(bank, k, x, y, enough):
    """Metres from a point to the nearest wall or obstacle, or any lower bound of it above `enough`."""
    number, real = bank.number[k], bank.real[k]
    free = min(min(x, real[WIDTH] - x), min(y, real[HEIGHT] - y))
    for i in range(number[OBSTACLES]):
        region = number[REGION_AT] + number[PROPOSITIONS] + i
        dx, dy = bank.region_centre[region, 0] - x, bank.region_centre[region, 1] - y
        beyond = enough + bank.region_reach[region]
        if dx * dx + dy * dy > beyond * beyond:
            continue
        _, _, gap = outward(bank.disc, bank.region_first, bank.halfplanes, bank.corners, region, x, y)
        free = min(free, gap)
    return free


@njit(cache=True)
def push_out(bank, k, x, y, radius):
    """The nearest place where a disc of this radius is free: (x, y, whether it was moved)."""
    number, real = bank.number[k], bank.real[k]
    touched = False
    for _ in range(2):
        at_x, at_y = x, y
        for i in range(number[OBSTACLES]):
            region = number[REGION_AT] + number[PROPOSITIONS] + i
            dx, dy = bank.region_centre[region, 0] - x, bank.region_centre[region, 1] - y
            near = radius + bank.region_reach[region]
            if dx * dx + dy * dy >= near * near:
                continue
            nx, ny, gap = outward(bank.disc, bank.region_first, bank.halfplanes, bank.corners, region, x, y)
            if gap < radius:
                x += (radius - gap) * nx
                y += (radius - gap) * ny
        x = min(max(x, radius), real[WIDTH] - radius)
        y = min(max(y, radius), real[HEIGHT] - radius)
        if x == at_x and y == at_y:
            break
        touched = True
    return x, y, touched


@njit(cache=True)
def outward(disc, first, halfplanes, corners, region, x, y):
    """Unit vector away from a region's nearest boundary point, and the signed distance to it."""
    if disc[region, 0] > 0.0:
        dx, dy = x - disc[region, 1], y - disc[region, 2]
        far = max(math.hypot(dx, dy), 1e-9)
        return dx / far, dy / far, far - disc[region, 3]
    best, side = -np.inf, first[region]
    for i in range(first[region], first[region + 1]):
        gap = halfplanes[i, 0] * x + halfplanes[i, 1] * y - halfplanes[i, 2]
        if gap > best:
            best, side = gap, i
    if best > 0.0:
        # Outside: beyond a corner of the nearest side the corner itself is the nearest point.
        ax, ay, bx, by = corners[side, 0], corners[side, 1], corners[side, 2], corners[side, 3]
        ex, ey = bx - ax, by - ay
        along = ((x - ax) * ex + (y - ay) * ey) / (ex * ex + ey * ey)
        if along < 0.0 or along > 1.0:
            cx, cy = (ax, ay) if along < 0.0 else (bx, by)
            far = max(math.hypot(x - cx, y - cy), 1e-9)
            return (x - cx) / far, (y - cy) / far, far
    return halfplanes[side, 0], halfplanes[side, 1], best
