"""A mission on a map, tabulated for adversary models that move continuous points: labels, walls, and the way ahead."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from tab_marl.mission.automaton import FAILED, UNBOUNDED, MissionAutomaton
from tab_marl.mission.compile import compile_mission
from tab_marl.mission.model import Mission
from tab_marl.mission.route import RouteField, solve_route
from tab_marl.world.grid import GridMap, free_points
from tab_marl.world.scenario import Scenario

SQUARES_PER_CELL = 3
"""Labels and walls are read on squares this much finer than route cells; odd, so that a cell's centre is a square's."""


class Rules(NamedTuple):
    """The automaton's tables, in the order in which `mission.kernels.advance` takes them."""

    next_location: NDArray[np.int32]
    forbidden_until: NDArray[np.int32]
    progress: NDArray[np.bool_]
    patient: NDArray[np.bool_]
    earliest: NDArray[np.int32]
    latest: NDArray[np.int32]
    resets: NDArray[np.bool_]


class Ways(NamedTuple):
    """The way to completion by location and route cell."""

    nearest: NDArray[np.int32]
    """``[rows, columns]`` free cell nearest to each square of the route grid."""
    cell_metres: float
    centres: NDArray[np.float64]
    target: NDArray[np.int32]
    """``[U, S]`` cell to move straight at, -1 where the mission cannot be completed."""
    to_visit: NDArray[np.float64]
    """``[U, S]`` metres to the next counted visit."""
    length: NDArray[np.float64]
    """``[U, S]`` metres to completion."""


class Ground(NamedTuple):
    """Walls and labels by raster square."""

    free: NDArray[np.bool_]
    """``[rows, columns]``."""
    mask: NDArray[np.int32]
    """``[rows, columns]`` the automaton's label."""
    square_metres: float


@dataclass(frozen=True, eq=False)
class MissionMap:
    """Everything that depends on the task only; cached, and shared by the planners."""

    scenario: Scenario
    mission: Mission
    automaton: MissionAutomaton
    route: RouteField
    rules: Rules
    ways: Ways
    ground: Ground
    mission_latest: int
    """The last tick of the mission at which any bound still lets it be completed, at most the horizon."""

    @classmethod
    def build(cls, scenario: Scenario, mission: Mission, cell_metres: float = 0.1) -> MissionMap:
        """Route cells of `cell_metres`, or of half that where the coarse grid finds no way from the start."""
        return _build(scenario, mission, float(cell_metres))

    @property
    def grid(self) -> GridMap:
        return self.route.grid

    @property
    def reach_metres(self) -> float:
        """How far the adversary gets in a tick."""
        return self.scenario.adversary.max_speed * self.scenario.step_seconds

    def mask_at(self, x: float, y: float) -> int:
        """The label of a point."""
        rows, columns = self.ground.mask.shape
        r = min(max(int(y / self.ground.square_metres), 0), rows - 1)
        c = min(max(int(x / self.ground.square_metres), 0), columns - 1)
        return int(self.ground.mask[r, c])

    def label(self, location: int, point: tuple[float, float], track: tuple[tuple[float, float], ...] = ()) -> int:
        """The label that counts at a tick: that of the first point seen since the last tick that moves the mission on, else
        that of the point where it is now.
        """
        here = int(self.automaton.masks(point)[0])
        if location < 0:
            return here
        for mask in self.automaton.masks(np.array(track).reshape(-1, 2)):
            following = int(self.automaton.next_location[location, mask])
            if following not in (location, FAILED):
                return int(mask)
        return here


@lru_cache(maxsize=64)
def _build(scenario: Scenario, mission: Mission, cell_metres: float) -> MissionMap:
    automaton = compile_mission(mission, scenario, scenario.step_seconds)
    route = _route(scenario, automaton, cell_metres)
    locations, cells = route.distance.shape
    target = np.empty((locations, cells), dtype=np.int32)
    for u in range(locations):
        target[u], _ = route.targets(u, route.grid.centres)
    bounded = automaton.latest[:, 0][automaton.latest[:, 0] < UNBOUNDED]
    return MissionMap(
        scenario=scenario,
        mission=mission,
        automaton=automaton,
        route=route,
        rules=Rules(*automaton.tables),
        ways=Ways(route.nearest, route.grid.cell_metres, route.grid.centres, target, route.to_visit, route.length),
        ground=_ground(scenario, automaton, route.grid.cell_metres / SQUARES_PER_CELL),
        mission_latest=min(int(bounded.max(initial=0)) or UNBOUNDED, scenario.horizon_ticks),
    )


def _route(scenario: Scenario, automaton: MissionAutomaton, cell_metres: float) -> RouteField:
    route = solve_route(automaton, GridMap.from_scenario(scenario, cell_metres))
    start = route.grid.cells_of([scenario.adversary_start.centre])
    if np.isfinite(route.distance[automaton.initial, start]).all():
        return route
    return solve_route(automaton, GridMap.from_scenario(scenario, cell_metres / 2))


def _ground(scenario: Scenario, automaton: MissionAutomaton, square: float) -> Ground:
    columns = max(1, round(scenario.width_metres / square))
    rows = max(1, round(scenario.height_metres / square))
    x = (np.arange(columns) + 0.5) * square
    y = (np.arange(rows) + 0.5) * square
    points = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    free = free_points(scenario, points, scenario.adversary.radius_metres).reshape(rows, columns)
    mask = np.asarray(automaton.masks(points), dtype=np.int32).reshape(rows, columns)
    return Ground(free, mask, square)
