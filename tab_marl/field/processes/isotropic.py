"""Memoryless motion that prefers no direction, within the speed limit, in the plane and in space."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tab_marl.field.processes.stencils import Cells, Stencil, normalised, rounded, rows_of
from tab_marl.field.reference import Reference, from_matrices

Floats = NDArray[np.float64]

# Radii as shares of full speed, and the mass of each: in the plane rings carry mass in proportion to their radius, in
# space each shell takes the part of the ball that is nearest to it. The outermost is full speed itself.
RINGS = ((0.0, 1 / 13), (0.5, 4 / 13), (1.0, 8 / 13))
SHELLS = ((0.0, 1 / 64), (0.5, 26 / 64), (1.0, 37 / 64))


def walk(grid: Cells, metres_per_tick: ArrayLike, directions: int = 16) -> Reference:
    """Each tick a displacement spread over the disc (or ball) of full speed, rounded to cells; no walls entered.

    Where walls take a part of a row, the rest is scaled to 1 (paper: the state never enters an obstacle).

    Args:
        metres_per_tick: one per reference (speed limits): ``[R]`` metres.
        directions: of each ring, in the plane; in space they are the points of a cube's surface, about one per cell
            of full reach.
    """
    parts = []
    for speed in speeds_of(metres_per_tick):
        parts.append(normalised(rows_of(grid, [walk_stencil(grid, speed, directions)])))
    return from_matrices(parts)


def walk_stencil(grid: Cells, metres: float, directions: int = 16) -> Stencil:
    """The moves of `walk` from a cell far from walls."""
    if grid.index.shape[1] == 2:
        angles = 2 * np.pi * np.arange(directions) / directions
        unit, weight = np.stack([np.cos(angles), np.sin(angles)], axis=1), np.full(directions, 1 / directions)
        radii = RINGS
    else:
        unit, weight = sphere(min(8, max(2, math.ceil(metres / grid.cell_metres))))
        radii = SHELLS
    moves = np.concatenate([metres * radius * unit for radius, _ in radii])
    return rounded(moves, np.concatenate([mass * weight for _, mass in radii]), grid.cell_metres)


def sphere(steps: int) -> tuple[Floats, Floats]:
    """Directions ``[N, 3]`` through the points of a cube's surface, ``2 * steps`` intervals to an edge, with their
    shares ``[N]`` of the sphere: symmetric under every symmetry of the cube, hence isotropic in the second moment."""
    axis = np.arange(-steps, steps + 1)
    points = np.array(np.meshgrid(axis, axis, axis, indexing="ij")).reshape(3, -1).T
    faces = (np.abs(points) == steps).sum(axis=1)
    points, faces = points[faces > 0], faces[faces > 0]
    length = np.linalg.norm(points, axis=1)
    # A patch of the surface at distance `length`, seen from the centre; edges and corners belong to parts of faces.
    share = np.array([0.0, 1.0, 1.0, 0.75])[faces] / length**3
    return points / length[:, None], share / share.sum()


def paper_walk(grid: Cells, metres_per_tick: ArrayLike) -> Reference:
    """Memoryless, the letter of the paper: uniform over all free cells whose centres lie within one tick's reach."""
    parts = []
    for speed in speeds_of(metres_per_tick):
        reach = speed / grid.cell_metres + 1e-9
        axis = np.arange(-int(reach), int(reach) + 1)
        dimensions = grid.index.shape[1]
        offset = np.array(np.meshgrid(*[axis] * dimensions, indexing="ij")).reshape(dimensions, -1).T
        offset = offset[np.linalg.norm(offset, axis=1) <= reach]
        uniform = Stencil(offset, np.zeros(len(offset), dtype=np.int64), np.full(len(offset), 1 / len(offset)))
        parts.append(normalised(rows_of(grid, [uniform])))
    return from_matrices(parts)


def speeds_of(metres_per_tick: ArrayLike) -> list[float]:
    """``[R]`` as a list. Raises ValueError for a speed that is not finite and >= 0."""
    speeds = np.atleast_1d(np.asarray(metres_per_tick, dtype=np.float64))
    if speeds.ndim != 1 or len(speeds) == 0 or not (np.isfinite(speeds).all() and (speeds >= 0).all()):
        raise ValueError(f"metres_per_tick is {metres_per_tick!r}, must be one or more finite numbers >= 0")
    return speeds.tolist()
