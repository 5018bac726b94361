# mypy: ignore-errors
"""Compiled loops of sight: whether straight lines between points are free.

Arrays and scalars only; nothing here validates or raises. Each has a slow twin in ``tests/planning``.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit


@njit(cache=True)
def sees(open_squares, square_metres, x, y, to_x, to_y):
    """Whether the line between two points stays on open squares ``[rows, columns]``, tested every half square or less."""
    rows, columns = open_squares.shape
    pieces = max(1, math.ceil(2.0 * math.hypot(to_x - x, to_y - y) / square_metres))
    for i in range(pieces + 1):
        s = i / pieces
        r = min(max(int((y + s * (to_y - y)) / square_metres), 0), rows - 1)
        c = min(max(int((x + s * (to_x - x)) / square_metres), 0), columns - 1)
        if not open_squares[r, c]:
            return False
    return True


@njit(cache=True)
def watched(open_squares, square_metres, radius, x, y, points):
    """``[N]``: which points ``[N, 2]`` are within `radius` of (x, y) and in its sight."""
    found = np.zeros(points.shape[0], dtype=np.bool_)
    for i in range(points.shape[0]):
        dx, dy = points[i, 0] - x, points[i, 1] - y
        if dx * dx + dy * dy <= radius * radius:
            found[i] = sees(open_squares, square_metres, x, y, points[i, 0], points[i, 1])
    return found
