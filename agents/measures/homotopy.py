"""On which side of the obstacles a path goes, where there are two sides to go.

The first leg of a path (start to the first place visited) is compared with the shortest way there. Two sides exist at an
obstacle (or a zone that is always forbidden) if the shortest way around its other side is at most half as long again and
still fits into the allowed time.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from tab_marl.mission.model import ConstraintType, Place
from tab_marl.mission.tasks import TURN_SECONDS, Task, Travel
from tab_marl.world.grid import GridMap
from tab_marl.world.regions import Region
from tab_marl.world.sampling import PLANNING_CELL_METRES

Array = NDArray[np.float64]
CUT_METRES = 0.15
"""Half the width of the cut that closes one side of an obstacle."""
TIME_SHARE = 0.9
"""The way around may need this share of the time that is allowed."""
MOST_DETOUR = 0.5
"""The way around may be so much longer, as a share of the shortest way: beyond that it is a detour, not another side."""


class Sides:
    """Sides of one task; found as they are asked for, and kept."""

    def __init__(self, task: Task, allowed_seconds: float) -> None:
        self.task, self.allowed_seconds = task, allowed_seconds
        self._grid = GridMap.from_scenario(task.scenario, PLANNING_CELL_METRES)
        self._found: dict[str, tuple[Array, list[Array]]] = {}

    def two_sided(self, place: Place) -> list[Array]:
        """Centres ``[2]`` of the obstacles between the start and this place that can be passed on either side in time."""
        return self._of(place)[1]

    def took_shortest(self, path: Array, place: str) -> float:
        """1.0 if the path ``[K + 1, 2]`` passed every such obstacle as the shortest way to `place` does, 0.0 if not; nan if
        there is none."""
        shortest, centres = self._of(place)
        if not centres:
            return math.nan
        inside = self.task.scenario.place(place).contains(path)
        leg = path[: int(np.argmax(inside)) + 1] if inside.any() else path
        loop = np.concatenate([leg, shortest[::-1], leg[:1]])
        return float(all(winding_number(loop, centre) == 0 for centre in centres))

    def _of(self, place: Place) -> tuple[Array, list[Array]]:
        key = str(place)
        if key not in self._found:
            self._found[key] = self._search(place)
        return self._found[key]

    def _search(self, place: Place) -> tuple[Array, list[Array]]:
        task, scenario = self.task, self.task.scenario
        avoided = [
            scenario.region(p) if isinstance(p, str) else scenario.place(p)
            for constraint in task.mission.beside
            if constraint.type is ConstraintType.ALWAYS and constraint.avoid
            for p in constraint.places
        ]
        travel = Travel(scenario, self._grid, avoided)
        start = scenario.adversary_start.centre
        way = travel.walk(start, (place,))
        if not math.isfinite(way.seconds):
            return way.path, []
        spare = TIME_SHARE * self.allowed_seconds - self._least_seconds(travel)
        home = int(self._grid.cells_of([start])[0])
        direct = float(travel.to((place,))[home])
        centres = []
        for region in (*scenario.obstacles, *avoided):
            centre = np.asarray(region.centre)
            around = self._around(region, centre, way.path, place, avoided)[home]
            detour = float(around) - direct
            if detour <= min(MOST_DETOUR * direct, scenario.adversary.max_speed * spare):
                centres.append(centre)
        return way.path, centres

    def _least_seconds(self, travel: Travel) -> float:
        """Of the whole mission, about: legs between the nearest places in order."""
        scenario, goals = self.task.scenario, self.task.mission.goals
        at, seconds = scenario.adversary_start.centre, 0.0
        for goal in goals:
            for _ in range(goal.visits):
                cell = int(self._grid.cells_of([at])[0])
                nearest = min(goal.places, key=lambda p: float(travel.to((p,))[cell]))
                seconds += TURN_SECONDS + float(travel.to((nearest,))[cell]) / scenario.adversary.max_speed
                at = scenario.place(nearest).centre
        return seconds

    def _around(self, region: Region, centre: Array, shortest: Array, place: Place, avoided: list[Region]) -> Array:
        """``[S]`` metres to the place where the side of the region on which the shortest way passes is closed by a cut."""
        nearest = shortest[int(np.argmin(region.distance(shortest)))]
        arm = nearest - centre
        length = float(np.hypot(*arm))
        offset = self._grid.centres - centre
        if length == 0.0:
            return np.full(self._grid.cells, math.inf)
        along = offset @ arm / length
        across = np.abs(offset[:, 0] * arm[1] - offset[:, 1] * arm[0]) / length
        cost = np.where((along >= 0) & (across <= CUT_METRES), 1e6, 1.0)
        for zone in avoided:
            cost = np.where(self._grid.inside(zone), 1e6, cost)
        goal = np.flatnonzero(self._grid.inside(self.task.scenario.place(place)))
        return self._grid.distances(goal, cost) if len(goal) else np.full(self._grid.cells, math.inf)


def winding_number(loop: Array, point: Array) -> int:
    """How often a closed path ``[K, 2]`` (first point last) goes anticlockwise around a point that is not on it."""
    x, y = (loop - point).T
    turned = np.diff(np.arctan2(y, x))
    return round(float(((turned + math.pi) % (2 * math.pi) - math.pi).sum()) / (2 * math.pi))
