"""A unicycle that takes any speed and turn rate it has, afresh each tick: cell x heading."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tab_marl.field.processes.isotropic import speeds_of
from tab_marl.field.processes.stencils import Cells, Stencil, rounded, rows_of
from tab_marl.field.reference import Reference, from_matrices
from tab_marl.world.kernels import unicycle_step

SPEEDS = ((0.0, 1 / 6), (0.5, 4 / 6), (1.0, 1 / 6))
"""Shares of full speed with Simpson's weights: mean and variance of a uniform speed, and full speed itself."""
TURNS_PER_HEADING = 4
"""Turn rates tried per heading that a tick can cover, so that no heading in between is left out."""


def unicycle(grid: Cells, metres_per_tick: ArrayLike, radians_per_tick: float, headings: int = 16) -> Reference:
    """Each tick a speed uniform in [0, full] and a turn rate uniform within the limit, driven as `unicycle_step` does.

    Positions are rounded at random to cells and headings to the nearest two, so that the mean displacement and turn are
    exact; what would end in a wall is lost. Turning on the spot is speed 0.

    Args:
        metres_per_tick: one per reference (speed limits): ``[R]`` metres.
        radians_per_tick: the largest turn in a tick, either way.
        headings: modes, evenly around the circle.
    Raises:
        ValueError: fewer than 3 headings, a turn < 0, or a map in space.
    """
    if grid.index.shape[1] != 2:
        raise ValueError("unicycle moves in the plane: in space use run_and_tumble or walk")
    if headings < 3:
        raise ValueError(f"headings is {headings}, must be >= 3")
    if not (math.isfinite(radians_per_tick) and radians_per_tick >= 0):
        raise ValueError(f"radians_per_tick is {radians_per_tick}, must be a finite number >= 0")
    angles = 2 * np.pi * np.arange(headings) / headings
    parts = []
    for speed in speeds_of(metres_per_tick):
        stencils = [_stencil(speed, radians_per_tick, angle, headings, grid.cell_metres) for angle in angles]
        parts.append(rows_of(grid, stencils))
    return from_matrices(parts, np.eye(headings), angles)


def _stencil(speed: float, turn: float, heading: float, headings: int, cell_metres: float) -> Stencil:
    moves, modes, shares = [], [], []
    for rate, share_of_rate in zip(*_turns(turn, headings), strict=True):
        for part, share_of_speed in SPEEDS:
            x, y, after = unicycle_step(0.0, 0.0, heading, speed * part, rate, 1.0)
            at = after / (2 * math.pi / headings)
            below = math.floor(at + 1e-9)
            above = max(0.0, at - below)
            for mode, rounding in ((below, 1 - above), (below + 1, above)):
                moves.append((x, y))
                modes.append(mode % headings)
                shares.append(share_of_rate * share_of_speed * rounding)
    return rounded(moves, shares, cell_metres, modes)


def _turns(turn: float, headings: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Turn rates within +-turn and their shares: Simpson's rule for a uniform one."""
    if turn == 0:
        return np.zeros(1), np.ones(1)
    covered = turn / (2 * math.pi / headings)
    count = 2 * max(2, math.ceil(TURNS_PER_HEADING * covered))
    weight = np.where(np.arange(count + 1) % 2, 4.0, 2.0)
    weight[[0, -1]] = 1.0
    return np.linspace(-turn, turn, count + 1), weight / weight.sum()
