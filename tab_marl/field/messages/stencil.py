"""Moves that are the same from every cell: a shorter way to compute, found in the moves themselves.

Where each mode keeps to itself and moves by fixed offsets, and what ends in a blocked cell is lost or shared out, one tick
is a few shifted sums over a padded lattice, and no list of moves has to be read.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from tab_marl.field.reference import Reference

AGREEMENT = 1e-12
"""Relative difference up to which two sums of the same numbers may differ by rounding."""


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
    scale: NDArray[np.float64]
    """``[R, C]``: factor on what the shifts give, where walls take a part of a row and the rest is scaled up."""


def no_stencil() -> Stencil:
    return Stencil(
        0, np.zeros(0, dtype=np.int64), np.zeros((1, 1, 1), dtype=np.int64), np.zeros((1, 1, 1)), np.zeros((1, 0))
    )


def stencil_of(reference: Reference, centres: NDArray[np.float64], cell_metres: float) -> Stencil:
    """The stencil of these moves between cells with these centres ``[C, D]``, or `no_stencil`.

    Each mode's longest row is taken for the stencil; it is one if it gives what the rows give, on random numbers.
    """
    modes, count, states = reference.modes, reference.count, reference.states
    lattice = np.rint((centres - centres.min(axis=0)) / cell_metres).astype(np.int64)
    if len(reference.data) == 0:
        return no_stencil()
    entries = _sums(reference, (reference.data > 0).astype(np.int32))
    found = []
    for r in range(count):
        lengths = entries[r * states : (r + 1) * states].reshape(-1, modes)
        for m in range(modes):
            cell = int(lengths[:, m].argmax())
            row = r * states + cell * modes + m
            at = slice(int(reference.indptr[row]), int(reference.indptr[row + 1]))
            used = reference.data[at] > 0
            to_cell, to_mode = np.divmod(reference.indices[at][used], modes)
            if (to_mode != m).any():
                return no_stencil()
            found.append((lattice[to_cell] - lattice[cell], reference.data[at][used]))
    pad = np.max([np.abs(moves).max(axis=0, initial=0) for moves, _ in found], axis=0)
    extent = lattice.max(axis=0) + 1 + 2 * pad
    # The coordinate that changes most from cell to cell varies fastest on the lattice, too.
    stride = np.zeros(len(extent), dtype=np.int64)
    size = 1
    for axis in np.argsort(-np.abs(np.diff(lattice, axis=0)).sum(axis=0), kind="stable"):
        stride[axis] = size
        size *= int(extent[axis])
    position = (lattice + pad) @ stride
    if (np.diff(position) <= 0).any():
        return no_stencil()
    width = max(len(shares) for _, shares in found)
    shift, share = np.zeros((count, modes, width), dtype=np.int64), np.zeros((count, modes, width))
    for i, (moves, shares) in enumerate(found):
        shift.reshape(-1, width)[i, : len(shares)] = moves @ stride
        share.reshape(-1, width)[i, : len(shares)] = shares
    stencil = Stencil(size, position, shift, share, np.ones((count, len(lattice))))
    if modes == 1:
        kept = _applied(stencil, np.ones(states))
        all_kept = _sums(reference, reference.data).reshape(count, states)
        stencil.scale[:] = np.divide(all_kept, kept, out=np.zeros_like(kept), where=kept > 0)
    numbers = np.random.default_rng(0).random(states) + 0.5
    rows = _sums(reference, reference.data * numbers[reference.indices]).reshape(count, states)
    return stencil if np.allclose(_applied(stencil, numbers), rows, rtol=AGREEMENT, atol=0) else no_stencil()


def _applied(stencil: Stencil, ahead: NDArray[np.float64]) -> NDArray[np.float64]:
    """``[R, S]``: what the moves make of ``ahead[S]``, by shifts."""
    count, modes, width = stencil.shift.shape
    out = np.zeros((count, len(stencil.position), modes))
    for m in range(modes):
        plane = np.zeros(stencil.size)
        plane[stencil.position] = ahead.reshape(-1, modes)[:, m]
        for r in range(count):
            for k in range(width):
                if stencil.share[r, m, k] > 0:
                    out[r, :, m] += stencil.share[r, m, k] * plane[stencil.position + stencil.shift[r, m, k]]
            out[r, :, m] *= stencil.scale[r]
    return out.reshape(count, -1)


def _sums(reference: Reference, entries: NDArray[np.generic]) -> NDArray[np.float64]:
    """``[R * S]``: sums over rows of one number per entry."""
    sums = np.add.reduceat(np.append(entries, np.zeros(1, entries.dtype)), reference.indptr[:-1])
    return np.asarray(np.where(np.diff(reference.indptr) > 0, sums, 0))
