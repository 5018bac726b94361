"""Route fields: how far it still is to the end of a mission, and which way, from every location and cell.

A route field is the shortest-path function of a mission on locations x cells, clocks left aside: what FP-POMCP follows,
what feasibility compares the deadlines with, and what the learned adversaries observe. Costs bend the routes (a style);
lengths without costs are kept beside them, because time is spent in metres and not in costs.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tab_marl.mission import route_kernels as kernels
from tab_marl.world.grid import GridMap

if TYPE_CHECKING:
    from tab_marl.mission.automaton import MissionAutomaton

LOOK_AHEAD_METRES = 1.2
"""How far ahead along a route the straight line is tried."""


@dataclass(frozen=True, eq=False)
class RouteField:
    """Shortest ways to the end of a mission. U locations (the automaton's, then one per via point), S cells.

    Being at (u, s) means that the label of cell s has been read. Distances are in metres, inf where the mission cannot
    be completed any more.
    """

    grid: GridMap
    automaton: MissionAutomaton
    distance: NDArray[np.float64]
    """``[U, S]`` cost-weighted metres to completion; plain metres when no cost was given."""
    next_cell: NDArray[np.int32]
    """``[U, S]`` the next cell on the way (the cell itself: wait there, its label is what is needed), -1 if none."""
    length: NDArray[np.float64]
    """``[U, S]`` plain metres along the same way to completion."""
    to_visit: NDArray[np.float64]
    """``[U, S]`` plain metres along the same way to the next counted visit."""
    symbol: NDArray[np.int32]
    """``[S]`` label of each cell: a column of `table`."""
    table: NDArray[np.int32]
    """``[U, L]`` next location, -1 completed, -2 forbidden (or fails)."""
    cost: NDArray[np.float64]
    """``[S, 16]`` factor on the length of each move."""
    via_locations: tuple[int, ...] = ()
    """Extra locations in which the first, second ... via point is still ahead."""
    nearest: NDArray[np.int32] = field(repr=False, default_factory=lambda: np.empty((0, 0), dtype=np.int32))
    """``[rows, columns]`` nearest free cell of every square."""

    def targets(
        self, location: int, points: ArrayLike, max_metres: float = LOOK_AHEAD_METRES
    ) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
        """Cells ``[N]`` to head for in a straight line from points ``[N, 2]`` (-1: no way), and locations then ``[N]``."""
        p = np.ascontiguousarray(np.atleast_2d(np.asarray(points, dtype=np.float64)))
        return kernels.look_ahead_many(
            p, location, self.grid.cell_at, self.nearest, self.grid.cell_metres, self.grid.centres, self.symbol,
            self.table, self.cost, self.distance, self.next_cell, max_metres,
        )  # fmt: skip

    def direction(self, location: int, points: ArrayLike, max_metres: float = LOOK_AHEAD_METRES) -> NDArray[np.float64]:
        """Unit vectors ``[N, 2]`` along the way from points ``[N, 2]`` (metres); zero where there is none or none needed."""
        p = np.atleast_2d(np.asarray(points, dtype=np.float64))
        cells, _ = self.targets(location, p, max_metres)
        towards = np.where(cells[:, None] >= 0, self.grid.centres[cells] - p, 0.0)
        norm = np.hypot(towards[:, 0], towards[:, 1])
        return np.asarray(towards / np.maximum(norm, 1e-9)[:, None])

    def metres(self, location: int, points: ArrayLike, max_metres: float = LOOK_AHEAD_METRES) -> NDArray[np.float64]:
        """``[N]`` plain metres to completion along the way from points ``[N, 2]``, free of the grid's zigzag nearby."""
        p = np.atleast_2d(np.asarray(points, dtype=np.float64))
        cells, after = self.targets(location, p, max_metres)
        rest = np.where(after >= 0, self.length[np.maximum(after, 0), cells], 0.0)
        straight = np.hypot(*(self.grid.centres[cells] - p).T)
        return np.asarray(np.where(cells >= 0, straight + rest, np.inf))

    def path(self, location: int, point: ArrayLike) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
        """Cells ``[K]`` and the locations after reading them ``[K]`` on the way to completion, the start's cell first."""
        cell = int(self.grid.cells_of(np.asarray(point, dtype=np.float64))[0])
        cells, locations = [cell], [location]
        while location >= 0:
            cell = int(self.next_cell[location, cell])
            if cell < 0:
                break
            location = int(self.table[location, self.symbol[cell]])
            cells.append(cell)
            locations.append(location)
        return np.array(cells, dtype=np.int32), np.array(locations, dtype=np.int32)


def solve_route(
    automaton: MissionAutomaton,
    grid: GridMap,
    cost: NDArray[np.float64] | None = None,
    *,
    place_metres: Mapping[str, float] | None = None,
    via: Sequence[tuple[float, float]] = (),
    via_location: int | None = None,
    via_radius_metres: float = 0.15,
) -> RouteField:
    """Distances to completion through all remaining stages of a mission.

    Labels that fail the mission are impassable, also those forbidden for a while only. Time windows are not looked at.

    cost: ``[S]`` (mean of a move's two ends) or ``[S, 16]`` (per move), factors > 0 on the length of moves.
    place_metres: metres added for choosing a place, by its name in ``automaton.branch_places``.
    via: points to pass first, in this order, before anything counted is visited; they add locations
        (`RouteField.via_locations`), for a robot whose mission is at `via_location` (default: the initial location).

    Raises ValueError for costs of the wrong shape or sign.
    """
    symbol, table, progress, extra = _symbols(automaton, grid, place_metres or {})
    reached, crossed = _neighbourhood(grid)
    if cost is None:
        edges = np.ones((grid.cells, 16))
    else:
        given = np.asarray(cost, dtype=np.float64)
        if given.shape not in ((grid.cells,), (grid.cells, 16)):
            raise ValueError(f"cost has shape {given.shape}, must be ({grid.cells},) or ({grid.cells}, 16)")
        if not given.min() > 0:
            raise ValueError(f"cost has the value {given.min()}, all must be > 0")
        edges = kernels.edge_costs(reached, given) if given.ndim == 1 else np.ascontiguousarray(given)
    locations = len(table)
    if via:
        home = automaton.initial if via_location is None else via_location
        symbol, table, progress, extra = _with_via(
            grid, symbol, table, progress, extra, np.asarray(via, dtype=np.float64), home, via_radius_metres
        )
    distance, next_cell, length, to_visit = kernels.product_dijkstra(
        reached, crossed, symbol, table, progress, extra / grid.cell_metres, edges
    )
    return RouteField(
        grid=grid,
        automaton=automaton,
        distance=distance * grid.cell_metres,
        next_cell=next_cell,
        length=length * grid.cell_metres,
        to_visit=to_visit * grid.cell_metres,
        symbol=symbol,
        table=table,
        cost=edges,
        via_locations=tuple(range(locations, locations + len(via))),
        nearest=nearest_cells(grid),
    )


Tables = tuple[NDArray[np.int32], NDArray[np.int32], NDArray[np.bool_], NDArray[np.float64]]


def _symbols(automaton: MissionAutomaton, grid: GridMap, place_metres: Mapping[str, float]) -> Tables:
    """Labels of cells as symbols ``[S]``, and per location and symbol: next location, progress, added metres."""
    distinct, symbol, table, progress = _labels(automaton, grid)
    extra = np.zeros(table.shape)
    for name, metres in place_metres.items():
        if metres < 0:
            raise ValueError(f"place_metres[{name!r}] is {metres}, must be >= 0")
        if name in automaton.branch_places:
            extra[automaton.branch[:, distinct] == automaton.branch_places.index(name)] = metres
    return symbol, table, progress, extra


@lru_cache(maxsize=16)
def _labels(
    automaton: MissionAutomaton, grid: GridMap
) -> tuple[NDArray[np.int32], NDArray[np.int32], NDArray[np.int32], NDArray[np.bool_]]:
    """The labels on the map ``[L]``, their numbers ``[S]``, and per location and label: next location, progress."""
    distinct, symbol = np.unique(automaton.masks(grid.centres), return_inverse=True)
    fails = (automaton.next_location[:, distinct] == kernels.IMPASSABLE) | (automaton.forbidden_until[:, distinct] > 0)
    table = np.where(fails, kernels.IMPASSABLE, automaton.next_location[:, distinct]).astype(np.int32)
    return distinct, symbol.reshape(-1).astype(np.int32), table, np.ascontiguousarray(automaton.progress[:, distinct])


def _with_via(
    grid: GridMap,
    symbol: NDArray[np.int32],
    table: NDArray[np.int32],
    progress: NDArray[np.bool_],
    extra: NDArray[np.float64],
    via: NDArray[np.float64],
    home: int,
    radius: float,
) -> Tables:
    """A location per via point, ahead of `home`, in which nothing else is visited; symbols split by "at via i"."""
    locations, labels = table.shape
    at = np.zeros(grid.cells, dtype=np.int32)
    for i, point in enumerate(via):
        gap = np.hypot(*(grid.centres - point).T)
        at |= np.where((gap <= radius) | (gap == gap.min()), 1 << i, 0).astype(np.int32)
    split, columns = np.unique(symbol.astype(np.int64) + labels * at.astype(np.int64), return_inverse=True)
    label, bits = split % labels, split // labels
    table, progress, extra = table[:, label], progress[:, label], extra[:, label]
    # While a via point is ahead, the mission must stay where it is: whatever changes its location is walked around.
    stays = table[home] == home
    rows = np.full((len(via), len(split)), kernels.IMPASSABLE, dtype=np.int32)
    for i in range(len(via)):
        following = home if i + 1 == len(via) else locations + i + 1
        rows[i, stays] = np.where((bits[stays] >> i) & 1, following, locations + i)
    nothing = np.zeros(rows.shape)
    return (
        columns.reshape(-1).astype(np.int32),
        np.ascontiguousarray(np.concatenate([table, rows])),
        np.ascontiguousarray(np.concatenate([progress, nothing.astype(bool)])),
        np.ascontiguousarray(np.concatenate([extra, nothing])),
    )


@lru_cache(maxsize=64)
def _neighbourhood(grid: GridMap) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
    reached, crossed = kernels.neighbourhood(grid.cell_at, grid.row, grid.column)
    return reached, crossed


@lru_cache(maxsize=64)
def nearest_cells(grid: GridMap) -> NDArray[np.int32]:
    """``[rows, columns]``: the nearest free cell of every square of the map, itself where it is free."""
    nearest: NDArray[np.int32] = kernels.nearest_free(grid.cell_at, grid.centres, grid.cell_metres)
    return nearest
