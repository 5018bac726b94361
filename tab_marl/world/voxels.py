"""A volume cut into cubic cells: the 3-D counterpart of `GridMap`."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property, lru_cache

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import sparse
from scipy.sparse.csgraph import dijkstra
from scipy.spatial import KDTree

from tab_marl.world.grid import BLOCKED, refuse_too_many
from tab_marl.world.solids import Solid
from tab_marl.world.volume import Volume

NEIGHBOURS = np.array(np.meshgrid([-1, 0, 1], [-1, 0, 1], [-1, 0, 1], indexing="ij")).reshape(3, -1).T[14:]
"""``[13, 3]`` one of each pair of opposite (layer, row, column) moves to the 26 neighbours."""


@dataclass(frozen=True, eq=False)
class VoxelMap:
    """S free cells, numbered layer by layer, row by row, from the lowest corner at the origin."""

    cell_metres: float
    cell_at: NDArray[np.int32]
    """``[layers, rows, columns]`` (along z, y, x): the cell's number, or BLOCKED."""
    centres: NDArray[np.float64]
    """``[S, 3]`` metres (x, y, z)."""
    index: NDArray[np.int32]
    """``[S, 3]`` (layer, row, column)."""

    @classmethod
    def from_volume(cls, volume: Volume, cell_metres: float) -> VoxelMap:
        """Free cells are those whose centre the adversary may occupy. Cached. Raises ValueError if there is none."""
        if not cell_metres > 0:
            raise ValueError(f"cell_metres is {cell_metres}, must be > 0")
        return _voxels_of(volume, float(cell_metres))

    @classmethod
    def from_array(cls, free: ArrayLike, cell_metres: float = 1.0) -> VoxelMap:
        """From ``[layers, rows, columns]`` booleans."""
        where = np.asarray(free, dtype=bool)
        if where.ndim != 3 or not where.any():
            raise ValueError(f"free has shape {where.shape} with {where.sum()} free cells: must be 3-D with some")
        if not cell_metres > 0:
            raise ValueError(f"cell_metres is {cell_metres}, must be > 0")
        index = np.argwhere(where).astype(np.int32)
        cell_at = np.full(where.shape, BLOCKED, dtype=np.int32)
        cell_at[where] = np.arange(len(index), dtype=np.int32)
        return cls(float(cell_metres), cell_at, (index[:, ::-1].astype(np.float64) + 0.5) * cell_metres, index)

    @property
    def cells(self) -> int:
        return len(self.centres)

    @cached_property
    def _tree(self) -> KDTree:
        return KDTree(self.centres)

    def cells_of(self, points: ArrayLike) -> NDArray[np.int32]:
        """``[N]``: the free cell nearest to each point ``[N, 3]``."""
        p = np.atleast_2d(np.asarray(points, dtype=np.float64))
        at = (p[:, ::-1] / self.cell_metres).astype(int)
        at = np.clip(at, 0, np.array(self.cell_at.shape) - 1)
        found = self.cell_at[tuple(at.T)].astype(np.int32)
        lost = found == BLOCKED
        if lost.any():
            found[lost] = self._tree.query(p[lost])[1]
        return found

    def inside(self, region: Solid) -> NDArray[np.bool_]:
        """``[S]``: whose centre lies in the solid."""
        return region.contains(self.centres)

    def distances(self, sources: ArrayLike) -> NDArray[np.float64]:
        """``[S]``: metres of the shortest free path over the 26 neighbours to the nearest source cell; inf if none."""
        of = np.atleast_1d(np.asarray(sources, dtype=np.int32))
        if len(of) == 0:
            return np.full(self.cells, np.inf)
        return np.asarray(dijkstra(self._graph, directed=False, indices=of, min_only=True))

    @cached_property
    def _graph(self) -> sparse.csr_array:
        """``[S, S]`` metres between free neighbours, one direction of each pair."""
        rows, columns, metres = [], [], []
        for move in NEIGHBOURS:
            target = neighbour(self.cell_at, self.index, move)
            free = np.flatnonzero(target != BLOCKED)
            rows.append(free)
            columns.append(target[free])
            metres.append(np.full(len(free), np.linalg.norm(move) * self.cell_metres))
        entries = (np.concatenate(metres), (np.concatenate(rows), np.concatenate(columns)))
        return sparse.csr_array(sparse.coo_array(entries, shape=(self.cells, self.cells)))

    def image(self, values: NDArray[np.float64], blocked: float = np.nan) -> NDArray[np.float64]:
        """``[layers, rows, columns]``: values ``[S]`` laid out in space, the lowest corner first."""
        picture = np.full(self.cell_at.shape, blocked)
        picture[tuple(self.index.T)] = values
        return picture


def neighbour(cell_at: NDArray[np.int32], index: NDArray[np.int32], move: NDArray[np.int64]) -> NDArray[np.int32]:
    """``[S]``: the cell one whole-cell move ``[D]`` away from each cell, BLOCKED where there is none. Any dimension."""
    at = index + np.asarray(move)
    inside = ((at >= 0) & (at < np.array(cell_at.shape))).all(axis=1)
    target = np.full(len(index), BLOCKED, dtype=np.int32)
    target[inside] = cell_at[tuple(at[inside].T)]
    return target


@lru_cache(maxsize=16)
def _voxels_of(volume: Volume, cell_metres: float) -> VoxelMap:
    counts = [max(1, round(size / cell_metres)) for size in volume.size_metres]
    refuse_too_many(counts, cell_metres)
    x, y, z = ((np.arange(count) + 0.5) * cell_metres for count in counts)
    points = np.stack(np.broadcast_arrays(x, y[:, None], z[:, None, None]), axis=-1)
    radius = volume.adversary.radius_metres
    free = ((points >= radius) & (points <= np.array(volume.size_metres) - radius)).all(axis=-1)
    for obstacle in volume.obstacles:
        free &= obstacle.distance(points) >= radius
    if not free.any():
        raise ValueError(
            f"volume {volume.name!r} has no free cell of {cell_metres} m for a robot of radius {radius} m: "
            "remove obstacles or use smaller cells"
        )
    return VoxelMap.from_array(free, cell_metres)
