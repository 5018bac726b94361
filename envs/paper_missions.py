"""The paper's missions on a map of one's own: same words, with times that fit the map.

The paper's times (5 s, 10 s, 30 s) belong to its arena, which is not published. Here they are all stretched by one factor,
such that the shortest way leaves SLACK times the time it needs, and rounded up to half seconds.
"""

from __future__ import annotations

import math
from dataclasses import replace
from functools import lru_cache

import numpy as np

from tab_marl.mission import Constraint, MissionAutomaton, compile_mission, parse_mission
from tab_marl.mission.automaton import COMPLETED, UNBOUNDED
from tab_marl.mission.library import MISSIONS
from tab_marl.mission.route import solve_route
from tab_marl.mission.tasks import PURSUIT_SECONDS, TURN_SECONDS, Task
from tab_marl.world.grid import GridMap
from tab_marl.world.regions import Region
from tab_marl.world.scenario import Scenario, UnknownName

SLACK = 1.5
"""Allowed time / shortest time."""
CELL_METRES = 0.1
TARGET_MARGIN_METRES = 0.1


@lru_cache(maxsize=64)
def paper_mission(mission_id: str, scenario: Scenario) -> Task:
    """The mission of this id (`mission.library`) on this scenario, its times fitted. Cached.

    Raises UnknownName for an id or a place that is not there, ValueError if no way completes the mission.
    """
    if mission_id not in MISSIONS:
        raise UnknownName("mission", mission_id, MISSIONS)
    text = MISSIONS[mission_id]
    target = open_point(scenario) if "[x,y]" in text else None
    literal = parse_mission(text, scenario, target=target, name=mission_id)
    automaton = compile_mission(literal, scenario, 1.0 / scenario.control_hertz)
    needed_share, needed_seconds = _shortest_way(automaton, scenario, mission_id)
    factor = SLACK * needed_share
    mission = replace(literal, constraints=tuple(_stretched(c, factor) for c in literal.constraints))
    horizon = max(scenario.horizon_seconds, math.ceil(SLACK * needed_seconds + PURSUIT_SECONDS))
    return Task(replace(scenario, horizon_seconds=float(horizon)), mission, mission_id, "paper", SLACK)


def open_point(scenario: Scenario) -> tuple[float, float]:
    """A target for "target [x, y]": the free point farthest from checkpoints, central zone and the robots' starts."""
    grid = GridMap.from_scenario(scenario, CELL_METRES)
    regions: list[Region] = [c.region for c in scenario.checkpoints]
    regions += [scenario.region("central zone"), scenario.adversary_start, scenario.ego_start]
    room = np.min([region.distance(grid.centres) for region in regions], axis=0)
    margin = scenario.target_radius_metres + TARGET_MARGIN_METRES
    x, y = grid.centres.T
    to_wall = np.min([x, y, scenario.width_metres - x, scenario.height_metres - y], axis=0)
    room[(room < margin) | (to_wall < margin)] = -np.inf
    best = int(np.argmax(room))
    if not math.isfinite(room[best]):
        raise ValueError(f"scenario {scenario.name!r} has no free place for a target beside its checkpoints")
    return (round(float(grid.centres[best, 0]), 3), round(float(grid.centres[best, 1]), 3))


def _shortest_way(automaton: MissionAutomaton, scenario: Scenario, mission_id: str) -> tuple[float, float]:
    """(largest share of an allowed time that the shortest way needs, seconds that it needs in all)."""
    start = scenario.adversary_start.centre
    home = automaton.first(int(automaton.masks(start)[0])).location
    route = solve_route(automaton, GridMap.from_scenario(scenario, CELL_METRES))
    cells, locations = route.path(max(home, 0), start)
    if home < 0 or len(cells) < 2 or locations[-1] != COMPLETED:
        raise ValueError(
            f"scenario {scenario.name!r}: no way from the adversary's start completes mission {mission_id!r}"
        )
    points = route.grid.centres[cells]
    seconds = np.hypot(*np.diff(points, axis=0).T) / scenario.adversary.max_speed
    counted = automaton.progress[locations[:-1], automaton.masks(points[1:])] & (locations[1:] != locations[:-1])
    share = total = since_visit = 0.0
    for location, step, visit in zip(locations[:-1], seconds, counted, strict=True):
        total += step
        since_visit += step
        if visit:
            total += TURN_SECONDS
            since_visit += TURN_SECONDS
            latest = np.where(automaton.latest[location] >= UNBOUNDED, np.inf, automaton.latest[location])
            allowed = latest * automaton.tick_seconds
            share = max(share, total / allowed[0], since_visit / allowed[1], since_visit / allowed[2])
            since_visit = 0.0
    return share or 1.0 / SLACK, float(total)


def _stretched(constraint: Constraint, factor: float) -> Constraint:
    def fit(seconds: float | None) -> float | None:
        return None if seconds is None else math.ceil(2.0 * factor * seconds - 1e-9) / 2.0

    return replace(constraint, seconds=fit(constraint.seconds), max_gap_seconds=fit(constraint.max_gap_seconds))
