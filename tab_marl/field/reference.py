"""Reference processes Q(s'|s): physically feasible motion on cells, with or without a memory of the heading.

The TAB-Field is the distribution closest to the reference that completes the mission (paper, eq. 1), so the reference
says what motion is like when nothing but the mission is known. Base states are (cell, mode), cell-major.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import sparse

from tab_marl.field import kernels
from tab_marl.world.grid import BLOCKED, GridMap

# Run and tumble: events per mean run length. Small turns go to a neighbouring heading, redraws to any heading or rest.
# Shares that predicted six kinds of purposeful movers best; the optimum is flat.
TURNS_PER_RUN = 0.8
REDRAWS_PER_RUN = 0.5
REST_SHARE = 0.1

UNROLLED_WIDTH = 4
"""Row length for which the kernels are unrolled: a displacement rounded to cells has at most four ends."""


class Motion(NamedTuple):
    """R references as arrays for the kernels."""

    indptr: NDArray[np.int64]
    """``[R * S + 1]``: CSR row ``r * S + s``."""
    indices: NDArray[np.int32]
    data: NDArray[np.float64]
    width: int
    """The length of every row, or 0 if they differ."""
    mix: NDArray[np.float64]
    """``[R, M, M]``."""
    mix_order: NDArray[np.int32]
    """``[R, M, M]`` new modes by falling probability."""
    jump: NDArray[np.float64]
    """``[R, M]`` probability of a jump to a mode drawn from `redraw`."""
    redraw: NDArray[np.float64]
    """``[R, M]``."""
    near_mode: NDArray[np.int32]
    """``[R, M, W]`` the other new modes."""
    near_share: NDArray[np.float64]
    """``[R, M, W]``."""
    row_sum: NDArray[np.float64]
    """``[R * S]`` what one tick keeps."""


@dataclass(frozen=True, eq=False)
class Reference:
    """R stacked references over S = C * M base states.

    One tick of reference r: the mode m is redrawn by ``mix[r, m]``, then (cell, new mode) moves by its CSR row. A row
    that sums to less than 1 loses the rest: that motion ends in a wall and is no feasible trajectory.
    """

    indptr: NDArray[np.int64]
    """``[R * S + 1]``: row ``r * S + s``."""
    indices: NDArray[np.int32]
    data: NDArray[np.float64]
    mix: NDArray[np.float64]
    """``[R, M, M]``, rows sum to 1."""
    headings: NDArray[np.float64]
    """``[M]`` radians; nan for rest and for memoryless references."""
    jump: NDArray[np.float64]
    """``[R, M]``: the part of a row of `mix` that is a jump to a mode drawn from `redraw`; only a shorter way to compute."""
    redraw: NDArray[np.float64]
    """``[R, M]``."""

    @property
    def count(self) -> int:
        return len(self.mix)

    @property
    def modes(self) -> int:
        return self.mix.shape[1]

    @property
    def states(self) -> int:
        return (len(self.indptr) - 1) // self.count

    @cached_property
    def motion(self) -> Motion:
        """Everything the kernels need, derived once."""
        near = self.mix - self.jump[:, :, None] * self.redraw[:, None, :]
        near[np.abs(near) < 1e-15] = 0.0
        width = max(1, int((near != 0).sum(axis=2).max()))
        order = np.argsort(-np.abs(near), axis=2, kind="stable")[:, :, :width]
        lengths = np.diff(self.indptr)
        constant = int(lengths[0]) if len(lengths) and (lengths == lengths[0]).all() else 0
        motion = Motion(
            self.indptr,
            self.indices,
            self.data,
            constant,
            self.mix,
            np.argsort(-self.mix, axis=2, kind="stable").astype(np.int32),
            self.jump,
            self.redraw,
            order.astype(np.int32),
            np.take_along_axis(near, order, axis=2),
            np.zeros(self.count * self.states),
        )
        for r in range(self.count):
            row = motion.row_sum[r * self.states : (r + 1) * self.states]
            kernels.expect_row(motion, r, np.ones(self.states), row)
        return motion

    def mode_shares(self) -> NDArray[np.float64]:
        """``[M]``: the stationary distribution of the mode under reference 0."""
        modes = self.modes
        balance = np.vstack([self.mix[0].T - np.eye(modes), np.ones(modes)])
        shares = np.linalg.lstsq(balance, np.append(np.zeros(modes), 1.0), rcond=None)[0]
        return np.asarray(np.clip(shares, 0.0, None) / np.clip(shares, 0.0, None).sum())

    def matrix(self, r: int = 0) -> sparse.csr_array:
        """``[S, S]``: one whole tick (redraw, then move) of reference r as a sparse matrix."""
        states, modes = self.states, self.modes
        at = self.indptr[r * states : (r + 1) * states + 1]
        moves = sparse.csr_array(
            (self.data[at[0] : at[-1]], self.indices[at[0] : at[-1]], at - at[0]), shape=(states, states)
        )
        redraw = sparse.kron(sparse.eye_array(states // modes), sparse.csr_array(self.mix[r]))
        return sparse.csr_array(redraw @ moves)


def from_matrices(
    transitions: Any,
    mix: ArrayLike | None = None,
    headings: ArrayLike | None = None,
    jump: ArrayLike | None = None,
    redraw: ArrayLike | None = None,
) -> Reference:
    """A reference from ``[S, S]`` matrices (dense or any SciPy sparse), one or a sequence of R.

    Args:
        transitions: rows say where a base state goes; each sums to 1, or to less where motion is lost to walls.
        mix: ``[M, M]`` or ``[R, M, M]``, how the mode is redrawn before the move; default: one mode.
        headings: ``[M]`` radians.
        jump, redraw: ``[M]`` each: ``mix = near + outer(jump, redraw)`` with `near` sparse is computed faster.
    Raises:
        ValueError: an entry is negative or not finite, a row sums to more than 1, or the shapes do not fit.
    """
    stack: Sequence[Any]
    if isinstance(transitions, Sequence):
        stack = transitions
    elif isinstance(transitions, np.ndarray) and transitions.ndim == 3:
        stack = list(transitions)
    else:
        stack = [transitions]
    if not stack:
        raise ValueError("transitions is empty: give at least one [S, S] matrix")
    parts = []
    for r, matrix in enumerate(stack):
        part = sparse.csr_array(matrix, dtype=np.float64)
        part.sum_duplicates()
        part.eliminate_zeros()
        if part.ndim != 2 or part.shape[0] != part.shape[1] or part.shape != sparse.csr_array(stack[0]).shape:
            raise ValueError(f"transitions[{r}] has shape {part.shape}: each must be square, all of the same size")
        _check_rows(part, f"transitions[{r}]")
        parts.append(part)
    states = parts[0].shape[0]
    mixing = np.ones((1, 1, 1)) if mix is None else np.asarray(mix, dtype=np.float64)
    mixing = np.broadcast_to(mixing, (len(parts), *mixing.shape[-2:])).copy()
    modes = mixing.shape[-1]
    if mixing.shape[1] != modes or states % modes:
        raise ValueError(f"mix has shape {mixing.shape}: must be [R, M, M] with M dividing the {states} states")
    if not np.isfinite(mixing).all() or (mixing < 0).any() or np.abs(mixing.sum(axis=2) - 1).max() > 1e-9:
        raise ValueError("mix must be >= 0, finite, and each row must sum to 1")
    angles = np.full(modes, np.nan) if headings is None else np.asarray(headings, dtype=np.float64)
    if angles.shape != (modes,):
        raise ValueError(f"headings has shape {angles.shape}, must be [{modes}], one per mode")
    lengths = np.concatenate([np.diff(p.indptr) for p in parts])
    indices, data = np.concatenate([p.indices for p in parts]), np.concatenate([p.data for p in parts])
    if lengths.max(initial=0) <= UNROLLED_WIDTH:
        lengths, indices, data = _padded(lengths, indices, data)
    return Reference(
        np.concatenate([[0], np.cumsum(lengths)]).astype(np.int64),
        indices.astype(np.int32),
        data,
        mixing,
        angles,
        np.broadcast_to(np.zeros(modes) if jump is None else np.asarray(jump), (len(parts), modes)).astype(np.float64),
        np.broadcast_to(np.zeros(modes) if redraw is None else np.asarray(redraw), (len(parts), modes)).astype(
            np.float64
        ),
    )


def _padded(
    lengths: NDArray[np.int64], indices: NDArray[np.int32], data: NDArray[np.float64]
) -> tuple[NDArray[np.int64], NDArray[np.int32], NDArray[np.float64]]:
    """Rows filled up to UNROLLED_WIDTH with entries of probability 0."""
    at = np.arange(UNROLLED_WIDTH) < lengths[:, None]
    wide_indices, wide_data = np.zeros(at.shape, dtype=np.int32), np.zeros(at.shape)
    wide_indices[at], wide_data[at] = indices, data
    return np.full(len(lengths), UNROLLED_WIDTH), wide_indices.ravel(), wide_data.ravel()


def _check_rows(matrix: sparse.csr_array, name: str) -> None:
    bad = ~np.isfinite(matrix.data) | (matrix.data < 0)
    if bad.any():
        raise ValueError(
            f"{name} has the entry {matrix.data[bad][0]}: transition probabilities must be finite and >= 0"
        )
    sums = np.asarray(matrix.sum(axis=1)).ravel()
    if len(sums) and sums.max() > 1 + 1e-9:
        worst = int(sums.argmax())
        raise ValueError(f"{name}: row {worst} sums to {sums[worst]:.12g}, must be <= 1; divide the row by its sum")


def run_and_tumble(
    grid: GridMap, metres_per_tick: ArrayLike, headings: int = 16, mean_run_metres: float = 0.5
) -> Reference:
    """Straight runs at full speed with small turns, and now and then a new heading or a rest; killed at walls.

    Args:
        metres_per_tick: one per reference (speed limits): ``[R]`` metres.
        headings: how many directions; mode `headings` is rest.
        mean_run_metres: scale of the run length at the first (full) speed.
    """
    if headings < 3:
        raise ValueError(f"headings is {headings}, must be >= 3")
    if not mean_run_metres > 0:
        raise ValueError(f"mean_run_metres is {mean_run_metres}, must be > 0")
    speeds = np.atleast_1d(np.asarray(metres_per_tick, dtype=np.float64))
    angles = 2 * np.pi * np.arange(headings) / headings
    direction = np.append(np.stack([np.cos(angles), np.sin(angles)], axis=1), [[0.0, 0.0]], axis=0)
    modes = headings + 1
    # An event rate per metre of run; many events in one tick saturate at certainty.
    events = min(1.0, speeds[0] / mean_run_metres * (TURNS_PER_RUN + REDRAWS_PER_RUN))
    turn = events * TURNS_PER_RUN / (TURNS_PER_RUN + REDRAWS_PER_RUN)
    redraw = events - turn
    mix = np.zeros((modes, modes))
    for m in range(headings):
        mix[m, (m - 1) % headings] += turn / 2
        mix[m, (m + 1) % headings] += turn / 2
    mix[headings, headings] = turn
    mix += (1 - events) * np.eye(modes)
    anew = np.append(np.full(headings, (1 - REST_SHARE) / headings), REST_SHARE)
    mix += redraw * anew
    parts = []
    for speed in speeds:
        rows, columns, data = [], [], []
        for m in range(modes):
            source, target, share = _rounded_moves(grid, speed * direction[m])
            rows.append(source * modes + m)
            columns.append(target * modes + m)
            data.append(share)
        parts.append(_gather(rows, columns, data, grid.cells * modes))
    return from_matrices(parts, mix, np.append(angles, np.nan), np.full(modes, redraw), anew)


def walk(grid: GridMap, metres_per_tick: ArrayLike, directions: int = 16) -> Reference:
    """Memoryless: each tick a displacement uniform over the disc of full speed, rounded to cells; no walls entered.

    Where walls take a part of a row, the rest is scaled to 1 (paper: the state never enters an obstacle).
    """
    angles = 2 * np.pi * np.arange(directions) / directions
    circle = np.stack([np.cos(angles), np.sin(angles)], axis=1)
    # Rings of equal width carry mass in proportion to their radius; the outermost is full speed itself.
    rings = [(0.0, 1.0)] + [(radius, 8.0 * radius) for radius in (0.5, 1.0)]
    total = sum(mass for _, mass in rings)
    parts = []
    for speed in np.atleast_1d(np.asarray(metres_per_tick, dtype=np.float64)):
        rows, columns, data = [], [], []
        for radius, mass in rings:
            for move in circle if radius else np.zeros((1, 2)):
                source, target, share = _rounded_moves(grid, speed * radius * move)
                rows.append(source)
                columns.append(target)
                data.append(share * (mass / total / (directions if radius else 1)))
        parts.append(_normalised(_gather(rows, columns, data, grid.cells)))
    return from_matrices(parts)


def paper_walk(grid: GridMap, metres_per_tick: ArrayLike) -> Reference:
    """Memoryless, the letter of the paper: uniform over all free cells whose centres lie within one tick's reach."""
    parts = []
    for speed in np.atleast_1d(np.asarray(metres_per_tick, dtype=np.float64)):
        reach = speed / grid.cell_metres + 1e-9
        whole = int(reach)
        rows, columns, data = [], [], []
        for dr in range(-whole, whole + 1):
            for dc in range(-whole, whole + 1):
                if np.hypot(dr, dc) <= reach:
                    source, target = _shifted(grid, dr, dc)
                    rows.append(source)
                    columns.append(target)
                    data.append(np.ones(len(source)))
        parts.append(_normalised(_gather(rows, columns, data, grid.cells)))
    return from_matrices(parts)


def _shifted(grid: GridMap, rows_up: int, columns_right: int) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """(source cells, target cells) of one whole-cell offset, blocked targets left out."""
    row, column = grid.row + rows_up, grid.column + columns_right
    height, width = grid.cell_at.shape
    inside = (row >= 0) & (row < height) & (column >= 0) & (column < width)
    target = np.full(grid.cells, BLOCKED, dtype=np.int64)
    target[inside] = grid.cell_at[row[inside], column[inside]]
    free = target != BLOCKED
    return np.flatnonzero(free), target[free]


def _rounded_moves(
    grid: GridMap, metres: NDArray[np.float64]
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.float64]]:
    """One displacement from every cell, rounded at random to the four cells around its end so that the mean is exact."""
    across, up = metres / grid.cell_metres
    column, row = int(np.floor(across + 1e-9)), int(np.floor(up + 1e-9))
    share_right, share_up = max(0.0, across - column), max(0.0, up - row)
    sources, targets, shares = [], [], []
    for dr, part_up in ((row, 1 - share_up), (row + 1, share_up)):
        for dc, part_right in ((column, 1 - share_right), (column + 1, share_right)):
            if part_up * part_right > 1e-12:
                source, target = _shifted(grid, dr, dc)
                sources.append(source)
                targets.append(target)
                shares.append(np.full(len(source), part_up * part_right))
    return np.concatenate(sources), np.concatenate(targets), np.concatenate(shares)


def _gather(
    rows: list[NDArray[np.int64]], columns: list[NDArray[np.int64]], data: list[NDArray[np.float64]], states: int
) -> sparse.csr_array:
    entries = (np.concatenate(data), (np.concatenate(rows), np.concatenate(columns)))
    return sparse.csr_array(sparse.coo_array(entries, shape=(states, states)))


def _normalised(matrix: sparse.csr_array) -> sparse.csr_array:
    return sparse.csr_array(sparse.diags_array(1 / np.asarray(matrix.sum(axis=1)).ravel()) @ matrix)
