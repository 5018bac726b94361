"""Goals for an ego whose task is avoidance."""

from __future__ import annotations

import numpy as np

from tab_marl.world.grid import GridMap
from tab_marl.world.regions import Disc
from tab_marl.world.scenario import Scenario

CELL_METRES = 0.1
GOAL_RADIUS_METRES = 0.2
GOAL_MARGIN_METRES = 0.05
"""Between the goal disc and walls or obstacles, at least."""


def far_goal(scenario: Scenario, radius_metres: float = GOAL_RADIUS_METRES) -> Disc:
    """A disc as far as the ego can drive from its start, clear of walls, obstacles and the adversary's start.

    Raises ValueError if there is no room for it.
    """
    grid = GridMap.from_scenario(scenario, CELL_METRES, radius_metres + GOAL_MARGIN_METRES)
    # Distances are over the cells that the ego itself can stand on; the goal's own disc needs more room than that.
    drivable = GridMap.from_scenario(scenario, CELL_METRES, scenario.ego.radius_metres)
    away = scenario.adversary_start.distance(grid.centres) > scenario.interception_metres + radius_metres
    metres = drivable.distances(drivable.cells_of([scenario.ego_start.centre]))[drivable.cells_of(grid.centres)]
    metres = np.where(away & np.isfinite(metres), metres, -np.inf)
    if not np.isfinite(metres).any():
        raise ValueError(
            f"scenario {scenario.name!r} has no room for a goal disc of radius {radius_metres} m that the ego can reach: "
            "give Scenario.ego_goal"
        )
    x, y = grid.centres[int(np.argmax(metres))]
    return Disc(round(float(x), 3), round(float(y), 3), radius_metres)
