"""Reference processes Q(s'|s): physically feasible motion on cells, with or without a memory of the heading.

The TAB-Field is the distribution closest to the reference that completes the mission (paper, eq. 1), so the reference
says what motion is like when nothing but the mission is known. Base states are (cell, mode), cell-major. `processes`
builds references; `from_matrices` takes any.
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

LEAST_SHARE = 1e-9
"""Modes with less of the time are left for good: rounding gives them a little."""
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
    first: NDArray[np.bool_]
    """``[M]``: the modes in which motion may begin."""

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

    @cached_property
    def span(self) -> int:
        """The largest difference between the numbers of two cells one tick apart."""
        cell = np.repeat(np.arange(self.count * self.states) % self.states // self.modes, np.diff(self.indptr))
        away = np.abs(self.indices // self.modes - cell)[self.data > 0]
        return int(away.max(initial=0))

    def mode_shares(self) -> NDArray[np.float64]:
        """``[M]``: the stationary distribution of the mode under reference 0."""
        modes = self.modes
        balance = np.vstack([self.mix[0].T - np.eye(modes), np.ones(modes)])
        shares = np.linalg.lstsq(balance, np.append(np.zeros(modes), 1.0), rcond=None)[0]
        return np.asarray(np.clip(shares, 0.0, None) / np.clip(shares, 0.0, None).sum())

    def first_mode_shares(self) -> NDArray[np.float64]:
        """``[M]``: the distribution of the mode at tick 0: `mode_shares` among `first`, or even among them where they only
        occur at the beginning."""
        shares = self.mode_shares() * self.first
        if shares.sum() < LEAST_SHARE:
            shares = self.first.astype(np.float64)
        return np.asarray(shares / shares.sum())

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
    first: ArrayLike | None = None,
) -> Reference:
    """A reference from ``[S, S]`` matrices (dense or any SciPy sparse), one or a sequence of R.

    Args:
        transitions: rows say where a base state goes; each sums to 1, or to less where motion is lost to walls.
        mix: ``[M, M]`` or ``[R, M, M]``, how the mode is redrawn before the move; default: one mode.
        headings: ``[M]`` radians.
        jump, redraw: ``[M]`` each: ``mix = near + outer(jump, redraw)`` with `near` sparse is computed faster.
        first: ``[M]``, the modes in which motion may begin; default: all.
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
    beginning = np.ones(modes, dtype=bool) if first is None else np.asarray(first, dtype=bool)
    if beginning.shape != (modes,) or not beginning.any():
        raise ValueError(f"first has shape {beginning.shape}, must be [{modes}] with at least one mode True")
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
        beginning,
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
