# mypy: ignore-errors
"""Compiled ray casts against discs and edges. Arrays and scalars only; nothing here validates or raises."""

from __future__ import annotations

import math

import numpy as np
from numba import njit


@njit(cache=True)
def free_distance(x, y, dx, dy, longest, discs, edges):
    """Metres from (x, y) along the unit vector (dx, dy) to the first disc or edge; `longest` if there is none before.

    `discs` ``[D, 3]`` (x, y, radius); `edges` ``[E, 4]`` (x0, y0, x1, y1). A ray from inside a disc reads 0.
    """
    nearest = longest
    for i in range(discs.shape[0]):
        cx, cy, radius = discs[i, 0] - x, discs[i, 1] - y, discs[i, 2]
        outside = cx * cx + cy * cy - radius * radius
        if outside <= 0.0:
            return 0.0
        along = cx * dx + cy * dy
        inside = along * along - outside
        if along > 0.0 and inside >= 0.0:
            hit = along - math.sqrt(inside)
            nearest = min(nearest, hit)
    for i in range(edges.shape[0]):
        ax, ay = edges[i, 0] - x, edges[i, 1] - y
        ex, ey = edges[i, 2] - edges[i, 0], edges[i, 3] - edges[i, 1]
        cross = dx * ey - dy * ex
        if cross == 0.0:
            continue
        hit = (ax * ey - ay * ex) / cross
        share = (ax * dy - ay * dx) / cross
        if 0.0 <= hit < nearest and 0.0 <= share <= 1.0:
            nearest = hit
    return nearest


@njit(cache=True)
def scan(x, y, theta, rays, longest, discs, edges):
    """``[rays]`` metres: free distance in `rays` directions, anticlockwise from the heading theta."""
    ranges = np.empty(rays)
    for i in range(rays):
        angle = theta + 2.0 * math.pi * i / rays
        ranges[i] = free_distance(x, y, math.cos(angle), math.sin(angle), longest, discs, edges)
    return ranges
