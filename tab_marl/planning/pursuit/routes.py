"""The ego's routes: waypoints on a map, straightened shortest paths to them, and how the ego drives along these."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from tab_marl.planning.pursuit import motion_kernels
from tab_marl.world.grid import BLOCKED, GridMap
from tab_marl.world.scenario import Scenario, require_positive

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class RouteOptions:
    """Where the ego may want to stand."""

    spacing_metres: float = 0.3
    """Between neighbouring waypoints."""
    cell_metres: float = 0.05
    """Of the grid on which shortest paths are found."""
    clearance_metres: float = 0.02
    """Kept from walls and obstacles beyond the ego's radius, since it cuts corners by about that much."""

    def __post_init__(self) -> None:
        for name in ("spacing_metres", "cell_metres"):
            require_positive(self, name)
        if self.clearance_metres < 0:
            raise ValueError(f"RouteOptions.clearance_metres is {self.clearance_metres}, must be >= 0")


class Itinerary(NamedTuple):
    """A route, and another one to change to at some tick; a plain route changes to itself."""

    first: int
    switch_tick: int
    """Ticks from now; the first route is taken up to it."""
    second: int

    @classmethod
    def plain(cls, route: int) -> Itinerary:
        return cls(route, 0, route)

    def later(self, ticks: int) -> Itinerary:
        """The same plan when so many ticks have gone by."""
        if self.switch_tick <= ticks:
            return Itinerary.plain(self.second)
        return Itinerary(self.first, self.switch_tick - ticks, self.second)

    @property
    def now(self) -> int:
        """The route to drive next."""
        return self.first if self.switch_tick > 0 else self.second


class RouteTable(NamedTuple):
    """Routes or itineraries driven from one pose."""

    positions: Floats
    """``[I, T + 1, 2]`` metres, tick 0 is now."""
    effort: Floats
    """``[I, T + 1]``: v^2 + w^2 summed over the ticks so far."""


@dataclass(frozen=True, eq=False)
class RouteMap:
    """W waypoints and the shortest paths to them from any of S cells of the ego's grid."""

    scenario: Scenario
    grid: GridMap
    nearest: NDArray[np.int32]
    """``[rows, columns]``: the free cell nearest to each square, blocked squares included."""
    waypoints: Floats
    """``[W, 2]`` metres."""
    goals: NDArray[np.int32]
    """``[W]``: the waypoints' cells."""
    aims: NDArray[np.int32]
    """``[W, S]``: the cell to drive straight at from each cell."""
    distances: Floats
    """``[W, S]`` metres along the shortest path; inf if there is none."""

    @classmethod
    def build(
        cls, scenario: Scenario, places: Sequence[tuple[float, float]] = (), options: RouteOptions | None = None
    ) -> RouteMap:
        """Waypoints on a grid, at every checkpoint and at these places (moved to the nearest free cell); cached."""
        return _build(scenario, tuple((float(x), float(y)) for x, y in places), options or RouteOptions())

    @property
    def stay(self) -> int:
        """The number of the route that stays where it is: the last row of a `RouteTable`."""
        return len(self.waypoints)

    @property
    def control_steps_per_tick(self) -> int:
        return round(self.scenario.step_seconds * self.scenario.control_hertz)

    def control(self, pose: tuple[float, float, float], route: int) -> tuple[float, float]:
        """Speed [m/s] and turn rate [rad/s] of the next control step from (x, y, theta) along a route."""
        if route == self.stay:
            return 0.0, 0.0
        x, y, theta = pose
        robot = self.scenario.ego
        goal_x, goal_y = self.waypoints[route]
        v, w = motion_kernels.drive(
            self.nearest, self.grid.cell_metres, self.grid.centres, self.aims[route], self.goals[route],
            goal_x, goal_y, x, y, theta, robot.max_speed, robot.max_turn_rate, 1.0 / self.scenario.control_hertz,
        )  # fmt: skip
        return float(v), float(w)

    def table(self, pose: tuple[float, float, float], ticks: int) -> RouteTable:
        """Drive every route from (x, y, theta) for so many ticks; the last row stays where the ego is."""
        return self.itinerary_table(pose, ticks, [Itinerary.plain(route) for route in range(self.stay + 1)])

    def itinerary_table(
        self, pose: tuple[float, float, float], ticks: int, itineraries: Sequence[Itinerary]
    ) -> RouteTable:
        """Drive each of these itineraries from (x, y, theta) for so many ticks."""
        x, y, theta = pose
        robot = self.scenario.ego
        first, switch, second = np.array(itineraries, dtype=np.int64).T.copy()
        positions = np.empty((len(first), ticks + 1, 2))
        effort = np.empty((len(first), ticks + 1))
        motion_kernels.itinerary_table(
            self.nearest, self.grid.cell_metres, self.grid.centres, self.aims, self.goals, self.waypoints,
            float(x), float(y), float(theta), robot.max_speed, robot.max_turn_rate,
            1.0 / self.scenario.control_hertz, self.control_steps_per_tick, first, switch, second, positions, effort,
        )  # fmt: skip
        return RouteTable(positions, effort)


@lru_cache(maxsize=16)
def _build(scenario: Scenario, places: tuple[tuple[float, float], ...], options: RouteOptions) -> RouteMap:
    radius = scenario.ego.radius_metres
    try:
        grid = GridMap.from_scenario(scenario, options.cell_metres, radius + options.clearance_metres)
    except ValueError:
        grid = GridMap.from_scenario(scenario, options.cell_metres, radius)
    _, (rows, columns) = ndimage.distance_transform_edt(grid.cell_at == BLOCKED, return_indices=True)
    home = int(grid.cells_of([scenario.ego_start.centre])[0])
    reachable = np.isfinite(grid.distances([home]))
    goals = _waypoint_cells(scenario, grid, reachable, places, options.spacing_metres)
    aims = np.empty((len(goals), grid.cells), dtype=np.int32)
    distances = np.empty((len(goals), grid.cells))
    for i, goal in enumerate(goals):
        distances[i] = grid.distances([goal])
        motion_kernels.straightened_aims(
            grid.cell_at, grid.row, grid.column, distances[i] / grid.cell_metres, int(goal), aims[i]
        )
    nearest = grid.cell_at[rows, columns]
    return RouteMap(scenario, grid, nearest, grid.centres[goals].copy(), goals, aims, distances)


def _waypoint_cells(
    scenario: Scenario,
    grid: GridMap,
    reachable: NDArray[np.bool_],
    places: tuple[tuple[float, float], ...],
    spacing: float,
) -> NDArray[np.int32]:
    """The cells of the named places first, then a lattice that leaves out what lies close to one of them."""
    free = np.flatnonzero(reachable)

    def nearest_free(points: Floats) -> NDArray[np.int64]:
        gaps = ((grid.centres[free][None] - points[:, None]) ** 2).sum(-1)
        return free[np.argmin(gaps, axis=1)]

    named = nearest_free(np.array([(c.x, c.y) for c in scenario.checkpoints] + list(places)).reshape(-1, 2))
    chosen = list(dict.fromkeys(int(cell) for cell in named))
    columns = max(1, round(scenario.width_metres / spacing))
    rows = max(1, round(scenario.height_metres / spacing))
    x = (np.arange(columns) + 0.5) * scenario.width_metres / columns
    y = (np.arange(rows) + 0.5) * scenario.height_metres / rows
    lattice = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    for cell, point in zip(nearest_free(lattice), lattice, strict=True):
        centre = grid.centres[cell]
        apart = np.min(np.hypot(*(grid.centres[chosen] - centre).T), initial=np.inf)
        if apart >= spacing / 2 and np.hypot(*(centre - point)) <= spacing / 2:
            chosen.append(int(cell))
    return np.array(chosen, dtype=np.int32)
