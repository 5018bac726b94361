"""Moves that are the same from every cell: a shorter way to compute, found in the moves themselves.

Where each mode keeps to itself and moves by fixed offsets, and only what ends in a blocked cell is lost, one tick is a few
shifted sums over a padded lattice, and no list of moves has to be read.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from tab_marl.field.reference import Reference

LARGEST_WIDTH = 8
"""Offsets per mode: a displacement rounded to the cells of a 3-D grid."""


class Stencil(NamedTuple):
    """Shifts on a padded lattice, for the kernels; `size` 0 if the moves have no such form."""

    size: int
    """Points of the padded lattice."""
    position: NDArray[np.int64]
    """``[C]``: the point of each cell, rising with the cell's number."""
    shift: NDArray[np.int64]
    """``[R, M, W]``."""
    share: NDArray[np.float64]
    """``[R, M, W]``: probability of each shift; 0 fills up."""


def no_stencil() -> Stencil:
    return Stencil(0, np.zeros(0, dtype=np.int64), np.zeros((1, 1, 1), dtype=np.int64), np.zeros((1, 1, 1)))


def stencil_of(reference: Reference, centres: NDArray[np.float64] | None, cell_metres: float) -> Stencil:
    """The stencil of these moves between cells with these centres ``[C, D]``, or `no_stencil`."""
    modes, count = reference.modes, reference.count
    if centres is None or modes == 1:  # with one mode there is little to gain
        return no_stencil()
    lattice = np.rint((centres - centres.min(axis=0)) / cell_metres).astype(np.int64)
    used = reference.data > 0
    row = np.repeat(np.arange(len(reference.indptr) - 1, dtype=np.int64), np.diff(reference.indptr))[used]
    data = reference.data[used]
    cell, mode = np.divmod(row % reference.states, modes)
    to_cell, to_mode = np.divmod(reference.indices[used].astype(np.int64), modes)
    if len(row) == 0 or (mode != to_mode).any():
        return no_stencil()
    move = lattice[to_cell] - lattice[cell]
    pad = np.abs(move).max(axis=0)
    # The last axis of the cell numbering varies slowest: strides from the order in which the cells are numbered.
    extent = lattice.max(axis=0) + 1 + 2 * pad
    order = np.argsort([np.abs(np.diff(lattice[:, d])).sum() for d in range(lattice.shape[1])])[::-1]
    stride = np.zeros(lattice.shape[1], dtype=np.int64)
    step = 1
    for d in order:
        stride[d] = step
        step *= extent[d]
    position = (lattice + pad) @ stride
    if (np.diff(position) <= 0).any():
        return no_stencil()
    shift = move @ stride
    kind = (row // reference.states) * modes + mode  # [nnz] which (r, m)
    keys, first = np.unique(np.stack([kind, shift], axis=1), axis=0, return_index=True)
    width = int(np.bincount(keys[:, 0], minlength=count * modes).max())
    if width > LARGEST_WIDTH:
        return no_stencil()
    shifts, shares = np.zeros((count * modes, width), dtype=np.int64), np.zeros((count * modes, width))
    column = np.arange(len(keys)) - np.searchsorted(keys[:, 0], keys[:, 0])
    shifts[keys[:, 0], column], shares[keys[:, 0], column] = keys[:, 1], data[first]
    free = np.zeros(step, dtype=bool)
    free[position] = True
    expected = sum(int(free[position + s].sum()) for s in keys[:, 1])
    same = np.searchsorted(_code(keys[:, 0], keys[:, 1], step), _code(kind, shift, step))
    if expected != len(row) or not np.allclose(data, data[first][same], rtol=1e-12, atol=0):
        return no_stencil()
    shape = (count, modes, width)
    return Stencil(int(step), position, shifts.reshape(shape), shares.reshape(shape))


def _code(kind: NDArray[np.int64], shift: NDArray[np.int64], size: int) -> NDArray[np.int64]:
    """One number per (kind, shift), rising as rows of the two do."""
    return kind * (2 * size + 1) + shift + size
