"""The arena cut into square cells: which are free, which see each other, how far apart they are along a free path."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tab_marl.world import kernels
from tab_marl.world.regions import Region
from tab_marl.world.scenario import Scenario

BLOCKED = -1
"""`GridMap.cell_at` of a blocked square."""
MOST_CELLS = 20_000_000
"""A map is refused beyond this many cells, blocked ones included: its arrays alone would take gigabytes."""


@dataclass(frozen=True, eq=False)
class GridMap:
    """S free cells, numbered row by row from the lower left."""

    cell_metres: float
    cell_at: NDArray[np.int32]
    """``[rows, columns]``: the cell's number, or BLOCKED."""
    centres: NDArray[np.float64]
    """``[S, 2]`` metres."""
    row: NDArray[np.int32]
    """``[S]``."""
    column: NDArray[np.int32]
    """``[S]``."""

    @classmethod
    def from_scenario(cls, scenario: Scenario, cell_metres: float, radius_metres: float | None = None) -> GridMap:
        """Free cells are those whose centre a robot of this radius (default: the adversary's) may occupy.

        Cached: the same scenario and cell size give the same object.
        """
        if not cell_metres > 0:
            raise ValueError(f"cell_metres is {cell_metres}, must be > 0")
        radius = scenario.adversary.radius_metres if radius_metres is None else radius_metres
        return _grid_of(scenario, float(cell_metres), float(radius))

    @classmethod
    def from_array(cls, free: ArrayLike, cell_metres: float = 1.0) -> GridMap:
        """From ``[rows, columns]`` booleans, row 0 at the bottom."""
        where = np.asarray(free, dtype=bool)
        if where.ndim != 2 or not where.any():
            raise ValueError(f"free has shape {where.shape} with {where.sum()} free cells: must be 2-D with some")
        if not cell_metres > 0:
            raise ValueError(f"cell_metres is {cell_metres}, must be > 0")
        row, column = (at.astype(np.int32) for at in np.nonzero(where))
        cell_at = np.full(where.shape, BLOCKED, dtype=np.int32)
        cell_at[where] = np.arange(len(row), dtype=np.int32)
        centres = (np.stack([column, row], axis=1).astype(np.float64) + 0.5) * cell_metres
        return cls(float(cell_metres), cell_at, centres, row, column)

    @property
    def cells(self) -> int:
        return len(self.centres)

    @cached_property
    def index(self) -> NDArray[np.int32]:
        """``[S, 2]`` (row, column)."""
        return np.stack([self.row, self.column], axis=1)

    def cells_of(self, points: ArrayLike) -> NDArray[np.int32]:
        """``[N]``: the free cell nearest to each point ``[N, 2]`` (ties go to the lower number)."""
        p = np.atleast_2d(np.asarray(points, dtype=np.float64))
        rows, columns = self.cell_at.shape
        r = np.clip((p[:, 1] / self.cell_metres).astype(int), 0, rows - 1)
        c = np.clip((p[:, 0] / self.cell_metres).astype(int), 0, columns - 1)
        found = self.cell_at[r, c].astype(np.int32)
        for i in np.flatnonzero(found == BLOCKED):
            found[i] = int(np.argmin(((self.centres - p[i]) ** 2).sum(axis=1)))
        return found

    def inside(self, region: Region) -> NDArray[np.bool_]:
        """``[S]``: whose centre lies in the region."""
        return region.contains(self.centres)

    def distances(self, sources: ArrayLike, cost: NDArray[np.float64] | None = None) -> NDArray[np.float64]:
        """``[S]``: length in metres of the shortest free path to the nearest source cell (16 neighbours); inf if none.

        `cost` ``[S]`` multiplies the length of a move by the mean of its two ends' costs (all > 0).
        """
        weight = np.ones(self.cells) if cost is None else np.asarray(cost, dtype=np.float64)
        return kernels.geodesic(
            self.cell_at, self.row, self.column, np.atleast_1d(np.asarray(sources, dtype=np.int32)), weight
        ) * self.cell_metres  # fmt: skip

    def image(self, values: NDArray[np.float64], blocked: float = np.nan) -> NDArray[np.float64]:
        """``[rows, columns]``: values ``[S]`` laid out on the map, row 0 at the bottom."""
        picture = np.full(self.cell_at.shape, blocked)
        picture[self.row, self.column] = values
        return picture


@lru_cache(maxsize=256)
def _grid_of(scenario: Scenario, cell_metres: float, radius: float) -> GridMap:
    columns = max(1, round(scenario.width_metres / cell_metres))
    rows = max(1, round(scenario.height_metres / cell_metres))
    refuse_too_many([columns, rows], cell_metres)
    x = (np.arange(columns) + 0.5) * cell_metres
    y = (np.arange(rows) + 0.5) * cell_metres
    points = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    free = free_points(scenario, points, radius)
    if not free.any():
        raise ValueError(
            f"scenario {scenario.name!r} has no free cell of {cell_metres} m for a robot of radius {radius} m: "
            "remove obstacles or use smaller cells"
        )
    cell_at = np.full(rows * columns, BLOCKED, dtype=np.int32)
    cell_at[free] = np.arange(int(free.sum()), dtype=np.int32)
    row, column = np.divmod(np.flatnonzero(free).astype(np.int32), np.int32(columns))
    return GridMap(cell_metres, cell_at.reshape(rows, columns), points[free], row, column)


def refuse_too_many(counts: Sequence[int], cell_metres: float) -> None:
    """Raise ValueError if a map of so many cells along each axis is too large to lay out."""
    total = math.prod(counts)
    if total > MOST_CELLS:
        raise ValueError(
            f"cell_metres is {cell_metres}: the map would have {' x '.join(map(str, counts))} = {total:,} cells, more "
            f"than {MOST_CELLS:,}; use larger cells"
        )


def free_points(scenario: Scenario, points: ArrayLike, radius_metres: float) -> NDArray[np.bool_]:
    """``[N]``: where a robot of this radius touches neither wall nor obstacle."""
    p = np.asarray(points, dtype=np.float64)
    r = radius_metres
    free = (
        (p[..., 0] >= r)
        & (p[..., 1] >= r)
        & (p[..., 0] <= scenario.width_metres - r)
        & (p[..., 1] <= scenario.height_metres - r)
    )
    for obstacle in scenario.obstacles:
        free &= obstacle.distance(p) >= r
    return np.asarray(free)
