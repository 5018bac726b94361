"""Run and tumble: motion that keeps its heading for a while, in the plane and in space."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tab_marl.field.processes.isotropic import speeds_of
from tab_marl.field.processes.stencils import Cells, rounded, rows_of
from tab_marl.field.reference import Reference, from_matrices

Floats = NDArray[np.float64]

# Events per mean run length. Small turns go to a neighbouring heading, redraws to any heading or rest.
# Shares that predicted six kinds of purposeful movers best; the optimum is flat.
TURNS_PER_RUN = 0.8
REDRAWS_PER_RUN = 0.5
REST_SHARE = 0.1

TYPICAL_TURN = math.pi / 2
"""Radians between one run's heading and the next's, on average, if all are as likely."""

SPATIAL_HEADINGS = (6, 14, 26)
"""Directions in space: towards a cube's faces; and its corners; and its edges."""


def run_and_tumble(
    grid: Cells,
    metres_per_tick: ArrayLike,
    headings: int = 16,
    mean_run_metres: float = 0.5,
    radians_per_tick: float | None = None,
) -> Reference:
    """Straight runs at full speed with small turns, and now and then a new heading or a rest; killed at walls.

    Turns take no time, except before the first run if `radians_per_tick` is given.

    Args:
        metres_per_tick: one per reference (speed limits): ``[R]`` metres.
        headings: how many directions, evenly around the circle; in space the next of SPATIAL_HEADINGS. The mode after
            them is rest.
        mean_run_metres: scale of the run length at the first (full) speed.
        radians_per_tick: the largest turn in a tick; then motion begins in one more mode, at rest and facing anywhere, and
            stays there as long as a quarter of a circle takes on average. None: it begins in full motion.
    Raises:
        ValueError: a number is not finite or not > 0.
    """
    for name, value in (("mean_run_metres", mean_run_metres), ("radians_per_tick", radians_per_tick)):
        if value is not None and not (math.isfinite(value) and value > 0):
            raise ValueError(f"{name} is {value}, must be finite and > 0")
    speeds = speeds_of(metres_per_tick)
    direction, angles, beside = compass(grid, headings)
    headings = len(direction)
    # An event rate per metre of run; many events in one tick saturate at certainty.
    events = min(1.0, speeds[0] / mean_run_metres * (TURNS_PER_RUN + REDRAWS_PER_RUN))
    turn = events * TURNS_PER_RUN / (TURNS_PER_RUN + REDRAWS_PER_RUN)
    redraw = events - turn
    mix = np.zeros((headings + 1, headings + 1))
    mix[:headings, :headings] = turn * beside / beside.sum(axis=1).max()
    # What a small turn does not take stays: rest, and in space headings with fewer neighbours. So the matrix stays
    # symmetric, and no heading is preferred.
    np.fill_diagonal(mix, 1 - redraw - mix.sum(axis=1))
    anew = np.append(np.full(headings, (1 - REST_SHARE) / headings), REST_SHARE)
    mix += redraw * anew
    leave = np.full(headings + 1, redraw)
    still = np.zeros((1 if radians_per_tick is None else 2, direction.shape[1]))
    angles = np.append(angles, np.full(len(still), np.nan))
    first = None
    if radians_per_tick is not None:
        leave, anew = np.append(leave, min(1.0, radians_per_tick / TYPICAL_TURN)), np.append(anew, 0.0)
        mix = np.pad(mix, (0, 1))
        mix[-1] = leave[-1] * anew
        mix[-1, -1] = 1 - leave[-1]
        first = np.arange(len(leave)) == len(leave) - 1
    parts = []
    for speed in speeds:
        moves = np.concatenate([speed * direction, still])
        parts.append(rows_of(grid, [rounded(move, 1.0, grid.cell_metres, m) for m, move in enumerate(moves)]))
    return from_matrices(parts, mix, angles, leave, anew, first)


def compass(grid: Cells, headings: int) -> tuple[Floats, Floats, Floats]:
    """Unit vectors ``[H, D]``, their angles ``[H]`` in radians (nan in space), and which are neighbours, ``[H, H]``."""
    if headings < 3:
        raise ValueError(f"headings is {headings}, must be >= 3")
    if grid.index.shape[1] != 2:
        direction = spatial_directions(headings)
        return direction, np.full(len(direction), np.nan), _nearest(direction)
    angles = 2 * np.pi * np.arange(headings) / headings
    beside = np.roll(np.eye(headings), 1, axis=1) + np.roll(np.eye(headings), -1, axis=1)
    return np.stack([np.cos(angles), np.sin(angles)], axis=1), angles, beside


def spatial_directions(headings: int) -> Floats:
    """``[N, 3]`` unit vectors: the smallest of SPATIAL_HEADINGS that is not below `headings` (26 beyond)."""
    wanted = next((n for n in SPATIAL_HEADINGS if n >= headings), SPATIAL_HEADINGS[-1])
    moves = np.array(np.meshgrid([-1, 0, 1], [-1, 0, 1], [-1, 0, 1], indexing="ij")).reshape(3, -1).T
    kind = np.abs(moves).sum(axis=1)
    kinds = {6: (1,), 14: (1, 3), 26: (1, 2, 3)}[wanted]
    moves = moves[np.isin(kind, kinds)]
    return np.asarray(moves / np.linalg.norm(moves, axis=1)[:, None])


def _nearest(direction: Floats) -> Floats:
    """``[N, N]`` 1 between directions that are neighbours: some direction is no nearer to either."""
    cosine = direction @ direction.T
    np.fill_diagonal(cosine, -2)
    nearest = cosine >= cosine.max(axis=1)[:, None] - 1e-9
    return np.asarray((nearest | nearest.T).astype(np.float64))
