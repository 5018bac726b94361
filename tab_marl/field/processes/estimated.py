"""A reference estimated by counting: from any simulator, or from recorded trajectories.

``P(s'|s) = (n(s, s') + k p(s'|s)) / (n(s) + k)``: counted moves, smoothed by `prior_samples` k moves of a prior p
(the mean of a Dirichlet posterior). The prior is what all cells have in common, their displacements pooled, unless one
is given. A cell is taken as a whole: starts are uniform in it, so motion much shorter than a cell looks like diffusion.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import sparse

from tab_marl.field.processes.stencils import Cells, Stencil, normalised, rows_of
from tab_marl.field.reference import Reference, from_matrices
from tab_marl.world.grid import BLOCKED

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

Simulator = Callable[[Floats, np.random.Generator], ArrayLike]
"""One tick for many robots at once: states ``[N, D]`` (x, y, in space z, metres) to those a tick later; nan where the
motion ends. With headings the states are ``[N, 3]`` (x, y, theta in radians)."""

BATCH = 500_000
"""States simulated at once."""


def reference_from_simulator(
    simulate: Simulator | Sequence[Simulator],
    grid: Cells,
    rng: np.random.Generator,
    samples_per_cell: int = 200,
    *,
    headings: int = 0,
    prior_samples: float = 0.0,
    prior: Reference | None = None,
) -> Reference:
    """Start the simulator `samples_per_cell` times in each cell (and heading), and count where it is a tick later.

    A sample that ends in a wall, outside the map or in nan is lost: no feasible motion. A share of p is known to a
    standard error of ``sqrt(p (1 - p) / samples_per_cell)``.

    Args:
        simulate: one, or one per reference (speed limits).
        headings: 0 without memory; else the circle is cut into so many modes, centred on 0, 2 pi / M, ... (plane only).
        prior_samples: k, see above; 0: the counts alone.
        prior: a reference over the same cells and modes; default: the pooled displacements.
    Raises:
        ValueError: the simulator returns another shape, or an argument is out of range.
    """
    if samples_per_cell < 1:
        raise ValueError(f"samples_per_cell is {samples_per_cell}, must be >= 1")
    _check(grid, headings, prior_samples)
    simulators = [simulate] if callable(simulate) else list(simulate)
    modes = max(1, headings)
    each = max(1, BATCH // samples_per_cell)
    parts = []
    for one in simulators:
        counted = sparse.csr_array((grid.cells * modes, grid.cells * modes))
        began = np.full(grid.cells * modes, float(samples_per_cell))
        for first in range(0, grid.cells * modes, each):
            source = np.repeat(np.arange(first, min(first + each, grid.cells * modes)), samples_per_cell)
            before = _drawn_in(grid, source, headings, rng)
            after = np.asarray(one(before.copy(), rng), dtype=np.float64)
            if after.shape != before.shape:
                raise ValueError(f"simulate returned shape {after.shape} for states {before.shape}: must be the same")
            target = _base_states(grid, after, headings, snap=False)
            counted = counted + _counts(source, target, grid.cells * modes)
        parts.append(_smoothed(grid, counted, began, modes, prior_samples, prior))
    return _reference(parts, headings)


def reference_from_trajectories(
    trajectories: Sequence[ArrayLike],
    grid: Cells,
    *,
    headings: int = 0,
    prior_samples: float = 5.0,
    prior: Reference | None = None,
) -> Reference:
    """Count the moves of recorded trajectories, each ``[T_i, D]`` metres (with headings ``[T_i, 3]``), a row per tick.

    A recorded position counts for the nearest free cell. Cells never visited follow the prior alone. Arguments as in
    `reference_from_simulator`. Raises ValueError for a row with nan, or an unvisited cell without a prior.
    """
    _check(grid, headings, prior_samples)
    modes = max(1, headings)
    width = 3 if headings else grid.index.shape[1]
    sources, targets = [], []
    for number, given in enumerate(trajectories):
        states = np.asarray(given, dtype=np.float64)
        if states.ndim != 2 or states.shape[1] != width or not np.isfinite(states).all():
            raise ValueError(
                f"trajectories[{number}] has shape {states.shape}: must be [T, {width}] with finite entries, a row per tick"
            )
        at = _base_states(grid, states, headings, snap=True)
        sources.append(at[:-1])
        targets.append(at[1:])
    if not sources or not sum(map(len, sources)):
        raise ValueError("trajectories hold no move: give at least one trajectory of two rows")
    source, target = np.concatenate(sources), np.concatenate(targets)
    began = np.bincount(source, minlength=grid.cells * modes).astype(np.float64)
    if prior_samples == 0 and not began.all():
        raise ValueError(
            f"{int((began == 0).sum())} of {len(began)} cells (and headings) were never visited: give prior_samples > 0"
        )
    counted = _counts(source, target, grid.cells * modes)
    return _reference([_smoothed(grid, counted, began, modes, prior_samples, prior)], headings)


def _check(grid: Cells, headings: int, prior_samples: float) -> None:
    if headings and (headings < 3 or grid.index.shape[1] != 2):
        raise ValueError(f"headings is {headings}, must be 0, or >= 3 on a map of the plane")
    if not (np.isfinite(prior_samples) and prior_samples >= 0):
        raise ValueError(f"prior_samples is {prior_samples}, must be a finite number >= 0")


def _drawn_in(grid: Cells, source: Ints, headings: int, rng: np.random.Generator) -> Floats:
    """States uniform in their cell and heading."""
    cell, mode = np.divmod(source, max(1, headings))
    points = grid.centres[cell] + (rng.random((len(cell), grid.centres.shape[1])) - 0.5) * grid.cell_metres
    if not headings:
        return np.asarray(points)
    theta = (mode + rng.random(len(mode)) - 0.5) * (2 * np.pi / headings)
    return np.column_stack([points, theta])


def _base_states(grid: Cells, states: Floats, headings: int, snap: bool) -> Ints:
    """``[N]`` (cell, mode), -1 where lost; `snap`: a point beside the free cells counts for the nearest."""
    dimensions = grid.index.shape[1]
    points = states[:, :dimensions]
    finite = np.asarray(np.isfinite(states).all(axis=1))
    if snap:
        cells = grid.cells_of(points).astype(np.int64)
    else:
        at = np.floor(np.where(finite[:, None], points, -1.0)[:, ::-1] / grid.cell_metres).astype(np.int64)
        inside = np.asarray(finite & ((at >= 0) & (at < np.array(grid.cell_at.shape))).all(axis=1))
        cells = np.full(len(points), BLOCKED, dtype=np.int64)
        cells[inside] = grid.cell_at[tuple(at[inside].T)]
    if not headings:
        return cells
    theta = np.where(finite, states[:, 2], 0.0)
    mode = np.round(theta / (2 * np.pi / headings)).astype(np.int64) % headings
    return np.where(cells == BLOCKED, BLOCKED, cells * headings + mode)


def _counts(source: Ints, target: Ints, size: int) -> sparse.csr_array:
    kept = target >= 0
    ones = (np.ones(int(kept.sum())), (source[kept], target[kept]))
    return sparse.csr_array(sparse.coo_array(ones, shape=(size, size)))


def _smoothed(
    grid: Cells, counted: sparse.csr_array, began: Floats, modes: int, strength: float, prior: Reference | None
) -> sparse.csr_array:
    total = counted
    if strength > 0:
        law = _pooled(grid, counted, modes) if prior is None else prior.matrix(0)
        if law.shape != counted.shape:
            raise ValueError(f"prior is over {law.shape[0]} states, must be over the {counted.shape[0]} of this map")
        total = counted + strength * law
    return sparse.csr_array(sparse.diags_array(1 / (began + strength)) @ total)


def _pooled(grid: Cells, counted: sparse.csr_array, modes: int) -> sparse.csr_array:
    """The moves of all cells together, mode by mode, laid out from every cell; walls take no share."""
    moves = sparse.coo_array(counted)
    cell, mode = np.divmod(np.asarray(moves.row, dtype=np.int64), modes)
    other, after = np.divmod(np.asarray(moves.col, dtype=np.int64), modes)
    key = np.column_stack([mode, grid.index[other].astype(np.int64) - grid.index[cell], after])
    unique, inverse = np.unique(key, axis=0, return_inverse=True)
    weight = np.bincount(inverse.ravel(), moves.data, minlength=len(unique))
    stencils = []
    for m in range(modes):
        of_mode = unique[:, 0] == m
        if of_mode.any():
            share = weight[of_mode] / weight[of_mode].sum()
            stencils.append(Stencil(unique[of_mode, 1:-1], unique[of_mode, -1], share))
        else:  # a heading never seen: it stays
            still = np.zeros((1, grid.index.shape[1]), dtype=np.int64)
            stencils.append(Stencil(still, np.array([m]), np.ones(1)))
    return normalised(rows_of(grid, stencils))


def _reference(parts: list[sparse.csr_array], headings: int) -> Reference:
    if not headings:
        return from_matrices(parts)
    return from_matrices(parts, np.eye(headings), 2 * np.pi * np.arange(headings) / headings)
