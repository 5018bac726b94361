"""What planners compute from a task alone, kept where the same tasks are played again and again (training)."""

from __future__ import annotations

from collections.abc import Sequence

from tab_marl.field.options import FieldOptions
from tab_marl.field.problem import FieldProblem
from tab_marl.field.solve import solve
from tab_marl.field.tab_field import TabField
from tab_marl.mission.model import Mission
from tab_marl.planning.pursuit.routes import RouteMap, RouteOptions
from tab_marl.world.scenario import Scenario


class PlannerMemory:
    """Fields and route maps by task: 0.3 to 1.1 s of computing and 15 to 40 MB each, for as long as this object lives.

    The planners' own caches hold few tasks, since an evaluation leaves each behind for good. A decision is the same, bit
    for bit, with and without it.
    """

    def __init__(self) -> None:
        self._routes: dict[tuple[Scenario, tuple[tuple[float, float], ...], RouteOptions], RouteMap] = {}
        self._fields: dict[tuple[Scenario, Mission, FieldOptions], TabField] = {}

    def routes(self, scenario: Scenario, places: Sequence[tuple[float, float]], options: RouteOptions) -> RouteMap:
        """`RouteMap.build`."""
        key = (scenario, tuple(places), options)
        if key not in self._routes:
            self._routes[key] = RouteMap.build(scenario, places, options)
        return self._routes[key]

    def field(self, scenario: Scenario, mission: Mission, options: FieldOptions) -> TabField:
        """The task's field, solved when it is first asked for."""
        key = (scenario, mission, options)
        if key not in self._fields:
            self._fields[key] = solve(FieldProblem.from_mission(mission, scenario, options))
        return self._fields[key]
