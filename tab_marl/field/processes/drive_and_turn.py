"""Drive and turn: straight runs, stops to turn on the spot, and now and then a rest, as a differential drive does."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike

from tab_marl.field.processes.isotropic import speeds_of
from tab_marl.field.processes.stencils import Cells, rounded, rows_of
from tab_marl.field.processes.tumble import TURNS_PER_RUN, TYPICAL_TURN, compass
from tab_marl.field.reference import Reference, from_matrices

STOPS_PER_RUN = 0.5
RESTS_PER_STOP = 0.1


def drive_and_turn(
    grid: Cells,
    metres_per_tick: ArrayLike,
    radians_per_tick: float,
    rest_ticks: float,
    headings: int = 16,
    mean_run_metres: float = 1.0,
) -> Reference:
    """As `run_and_tumble`, but a new heading takes the time to turn on the spot, and motion begins at rest.

    The last two modes are turning and resting. A run ends by stopping; of the stops RESTS_PER_STOP are rests, and the
    others turns that last as long as a quarter of a circle does on average. A run that ends in a wall is lost.

    Args:
        metres_per_tick: one per reference (speed limits): ``[R]`` metres.
        radians_per_tick: the largest turn in a tick.
        rest_ticks: mean length of a rest.
        headings: how many directions, evenly around the circle; in space the next of SPATIAL_HEADINGS.
        mean_run_metres: scale of the run length at the first (full) speed.
    Raises:
        ValueError: a number is not finite or too small.
    """
    for name, value, least in (
        ("radians_per_tick", radians_per_tick, 0.0), ("mean_run_metres", mean_run_metres, 0.0), ("rest_ticks", rest_ticks, 1.0)
    ):  # fmt: skip
        if not (math.isfinite(value) and value >= least and value > 0):
            raise ValueError(f"{name} is {value}, must be finite and {'>=' if least else '>'} {least:g}")
    speeds = speeds_of(metres_per_tick)
    direction, angles, beside = compass(grid, headings)
    headings = len(direction)
    events = min(1.0, speeds[0] / mean_run_metres * (TURNS_PER_RUN + STOPS_PER_RUN))
    veer = events * TURNS_PER_RUN / (TURNS_PER_RUN + STOPS_PER_RUN)
    stop = events - veer
    turned = min(1.0, radians_per_tick / TYPICAL_TURN)
    turning, resting = headings, headings + 1
    mix = np.zeros((headings + 2, headings + 2))
    mix[:headings, :headings] = veer * beside / beside.sum(axis=1).max()
    mix[:headings, turning], mix[:headings, resting] = stop * (1 - RESTS_PER_STOP), stop * RESTS_PER_STOP
    leave = np.zeros(headings + 2)
    leave[turning], leave[resting] = turned, 1 / rest_ticks
    anew = np.append(np.full(headings, 1 / headings), [0.0, 0.0])
    mix += np.outer(leave, anew)
    # What a run keeps: its heading, and in space also what headings with fewer neighbours do not turn.
    mix[np.diag_indices(headings + 2)] += 1 - mix.sum(axis=1)
    still = np.zeros((2, direction.shape[1]))
    parts = []
    for speed in speeds:
        moves = np.concatenate([speed * direction, still])
        parts.append(rows_of(grid, [rounded(move, 1.0, grid.cell_metres, m) for m, move in enumerate(moves)]))
    return from_matrices(
        parts, mix, np.append(angles, [np.nan, np.nan]), leave, anew, first=np.arange(headings + 2) >= headings
    )
