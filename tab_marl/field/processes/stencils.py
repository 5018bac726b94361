"""Moves that are the same from every cell, laid out on a map as rows of a sparse matrix. Any dimension.

A displacement in metres is rounded at random to the cells around its end, so that its mean is exact.
"""

from __future__ import annotations

from itertools import product
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import sparse

from tab_marl.world.grid import BLOCKED
from tab_marl.world.voxels import neighbour

Floats = NDArray[np.float64]

LEAST_SHARE = 1e-12
"""Smaller parts of a rounded displacement are left out."""


class Cells(Protocol):
    """What a map of cells must tell: `GridMap` (D = 2) and `VoxelMap` (D = 3) do."""

    @property
    def cell_metres(self) -> float: ...

    @property
    def cells(self) -> int: ...

    @property
    def cell_at(self) -> NDArray[np.int32]:
        """``[rows, columns]`` or ``[layers, rows, columns]``: the cell's number, or BLOCKED."""

    @property
    def index(self) -> NDArray[np.int32]:
        """``[S, D]``: where each cell lies in `cell_at`."""

    @property
    def centres(self) -> NDArray[np.float64]:
        """``[S, D]`` metres, x first."""

    def cells_of(self, points: ArrayLike) -> NDArray[np.int32]:
        """``[N]``: the free cell nearest to each point ``[N, D]``."""


class Stencil(NamedTuple):
    """Where one cell's mass goes, relative to it."""

    offset: NDArray[np.int64]
    """``[K, D]`` cells, in the order of `Cells.index`."""
    mode: NDArray[np.int64]
    """``[K]`` the mode afterwards."""
    share: Floats
    """``[K]`` sum 1."""


def rounded(moves: ArrayLike, shares: ArrayLike, cell_metres: float, modes: ArrayLike = 0) -> Stencil:
    """The stencil of displacements ``[N, D]`` metres (x first) with these shares ``[N]`` and new modes."""
    cells = np.atleast_2d(np.asarray(moves, dtype=np.float64))[:, ::-1] / cell_metres
    weight, mode = np.broadcast_to(shares, len(cells)), np.broadcast_to(modes, len(cells))
    whole = np.floor(cells + 1e-9).astype(np.int64)
    part = np.maximum(0.0, cells - whole)
    offsets, new_modes, parts = [], [], []
    for corner in product((0, 1), repeat=cells.shape[1]):
        offsets.append(whole + corner)
        new_modes.append(mode)
        parts.append(weight * np.prod(np.where(corner, part, 1 - part), axis=1))
    key = np.column_stack([np.concatenate(offsets), np.concatenate(new_modes)])
    merged, inverse = np.unique(key, axis=0, return_inverse=True)
    share = np.bincount(inverse.ravel(), np.concatenate(parts), minlength=len(merged)).astype(np.float64)
    kept = share > LEAST_SHARE
    return Stencil(merged[kept, :-1], merged[kept, -1], share[kept])


def rows_of(grid: Cells, stencils: list[Stencil]) -> sparse.csr_array:
    """``[C * M, C * M]``: stencil m from every cell in mode m; what would end in a wall is lost.

    Entries are laid out directly, so that memory stays near that of the result.
    """
    cells, modes = grid.cells, len(stencils)
    width = sum(len(s.share) for s in stencils)
    target = np.empty((cells, width), dtype=np.int32)
    share = np.concatenate([s.share for s in stencils])
    column = 0
    for stencil in stencils:
        known: dict[tuple[int, ...], NDArray[np.int32]] = {}
        for offset, mode in zip(stencil.offset, stencil.mode, strict=True):
            key = tuple(offset.tolist())
            if key not in known:
                known[key] = neighbour(grid.cell_at, grid.index, offset)
            reached = known[key]
            target[:, column] = np.where(reached == BLOCKED, BLOCKED, reached * modes + int(mode))
            column += 1
    free = target != BLOCKED
    row_ends = np.cumsum([len(s.share) for s in stencils])[:-1]
    lengths = np.stack([part.sum(axis=1) for part in np.split(free, row_ends, axis=1)], axis=1).ravel()
    indptr = np.concatenate([[0], np.cumsum(lengths)]).astype(np.int64)
    data = np.broadcast_to(share, target.shape)[free]
    size = cells * modes
    return sparse.csr_array((data, target[free], indptr), shape=(size, size))


def normalised(matrix: sparse.csr_array) -> sparse.csr_array:
    """Each row scaled to sum to 1; an empty one (a cell that cannot be left nor kept) stays empty."""
    sums = np.asarray(matrix.sum(axis=1)).ravel()
    matrix.data = matrix.data * np.repeat(1 / np.where(sums > 0, sums, 1.0), np.diff(matrix.indptr))
    return matrix
