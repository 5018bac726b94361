"""The words for an impossible mission: what is in the way, and the numbers."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from tab_marl.mission.automaton import MISSION_CLOCK, VISIT_CLOCK, MissionAutomaton
from tab_marl.mission.compile import exact_window_seconds
from tab_marl.mission.model import Constraint, ConstraintType, Mission, Place, place_name
from tab_marl.mission.propositions import region_of
from tab_marl.world.grid import GridMap
from tab_marl.world.scenario import Scenario


class InfeasibleMission(ValueError):
    """A mission that no robot of this scenario can complete; the message says why, with numbers."""


@dataclass(frozen=True, eq=False)
class Obstacle:
    """Why one location cannot be followed by another."""

    location: int
    kind: str
    following: int = 0
    clock: int = MISSION_CLOCK
    needs: float = np.inf
    """Seconds on that clock."""
    allows: float = 0.0
    """Seconds on that clock."""
    cells: NDArray[np.int64] = field(default_factory=lambda: np.empty(0, dtype=np.int64))


def words_for(
    mission: Mission, scenario: Scenario, automaton: MissionAutomaton, grid: GridMap, obstacles: list[Obstacle]
) -> str:
    """One sentence on the obstacle that came nearest to being overcome: farthest in the mission, smallest excess."""
    last = max((int(automaton.goals_done[o.location]), int(automaton.visits[o.location])) for o in obstacles)
    farthest = [
        o for o in obstacles if (int(automaton.goals_done[o.location]), int(automaton.visits[o.location])) == last
    ]
    nearest = min(farthest, key=lambda o: o.needs - o.allows)
    return "the mission is impossible: " + _Words(mission, scenario, automaton, grid).sentence(nearest)


class _Words:
    def __init__(self, mission: Mission, scenario: Scenario, automaton: MissionAutomaton, grid: GridMap) -> None:
        self.mission, self.scenario, self.automaton, self.grid = mission, scenario, automaton, grid

    def sentence(self, obstacle: Obstacle) -> str:
        u = obstacle.location
        goal = self._goal(u)
        target = self._target(obstacle)
        if obstacle.kind.startswith("start"):
            return self._start(obstacle)
        if obstacle.kind == "no target":
            return self._no_target(u, self._places(obstacle))
        if obstacle.kind == "walled off":
            return f"obstacles wall off {target}: no free path leads there{self._origin(u)}"
        if obstacle.kind == "forbidden way":
            return f"every way to {target}{self._origin(u)} leads through {self._forbidden_words(u)}"
        if obstacle.kind == "contradictory":
            later = "" if goal is None or goal.visits > 1 else ", for a later goal's bound ends then"
            return (
                f"contradictory times: {target} counts only from {obstacle.needs:.4g} s on, "
                f"but must be done by {obstacle.allows:.4g} s{later}"
            )
        if obstacle.kind == "opens late":
            return f"{target} is forbidden until {obstacle.needs:.4g} s, but must be reached by {obstacle.allows:.4g} s"
        speed = min(self.scenario.adversary.max_speed, float(self.automaton.speed_limit[u]))
        bound = f"the mission allows {obstacle.allows:.4g} s"
        bounded = int(self.automaton.latest[u, obstacle.clock]) * self.automaton.tick_seconds
        if obstacle.clock == MISSION_CLOCK and bounded > self.scenario.horizon_seconds:
            bound = f"the episode ends at {obstacle.allows:.4g} s"
        elif obstacle.clock == MISSION_CLOCK and (binding := self._binding(u, bounded)):
            bound += f", for {binding} must be done by then"
        since = " from the start" if obstacle.clock == MISSION_CLOCK else self._after(u, obstacle.clock)
        return f"{target} needs {obstacle.needs:.1f} s{since} at {speed:g} m/s, {bound}"

    def _binding(self, location: int, seconds: float) -> str:
        """The later goal whose bound from the start is this one's; empty if it is this goal's own."""
        later = [i for i in self.mission.goal_indices if i >= int(self.automaton.goal[location])]
        bounds = {
            i: abs(_latest_from_start(self.mission.constraints[i], self.scenario) - seconds) for i in reversed(later)
        }
        index = min(bounds, key=lambda i: bounds[i], default=later[0])
        return "" if index == later[0] else _names(self.mission.constraints[index].places)

    def _goal(self, location: int) -> Constraint | None:
        index = int(self.automaton.goal[location])
        return None if index < 0 else self.mission.constraints[index]

    def _places(self, obstacle: Obstacle) -> tuple[Place, ...]:
        """The places whose visit this step would count."""
        u, automaton = obstacle.location, self.automaton
        goal = self._goal(u)
        if goal is None:
            return ()
        there = (automaton.next_location[u] == obstacle.following) & automaton.progress[u]
        names = {automaton.branch_places[b] for b in np.unique(automaton.branch[u, there]) if b >= 0}
        return tuple(p for p in goal.places if place_name(p) in names)

    def _target(self, obstacle: Obstacle) -> str:
        places = self._places(obstacle)
        if not places:
            goal = self._goal(obstacle.location)
            return "leaving " + _names(goal.places) if goal is not None and goal.recurrences > 1 else "staying allowed"
        goal = self._goal(obstacle.location)
        visit = ""
        if goal is not None and goal.visits > 1:
            visit = f" (visit {int(self.automaton.visits[obstacle.location]) + 1} of {goal.visits})"
        return _names(places) + visit

    def _origin(self, location: int) -> str:
        return " from the start" if not self._begun(location) else " from the goal before"

    def _begun(self, location: int) -> bool:
        return bool(self.automaton.goals_done[location] or self.automaton.visits[location])

    def _after(self, location: int, clock: int) -> str:
        if not self._begun(location):
            return " from the start"
        visited = clock == VISIT_CLOCK and self.automaton.visits[location] > 0
        return " after the previous visit" if visited else " after the previous goal"

    def _forbidding(self, location: int) -> list[tuple[tuple[Place, ...], bool]]:
        """(places, whether to keep out of them) that bind throughout this location."""
        goal = self._goal(location)
        found: list[tuple[tuple[Place, ...], bool]] = []
        if goal is not None and goal.restricted:
            found.append((goal.restricted, True))
        index = int(self.automaton.goal[location])
        for constraint in self.mission.beside:
            over = constraint.until_goal is not None and index > constraint.until_goal
            if constraint.places and constraint.seconds is None and not over:
                found.append((constraint.places, constraint.avoid))
        return found

    def _forbidden_words(self, location: int) -> str:
        words = [_names(places) if avoid else f"places outside {_names(places)}" for places, avoid in
                 self._forbidding(location)]  # fmt: skip
        return f"{' or '.join(words) or 'a place'}, which the mission forbids"

    def _no_target(self, location: int, places: tuple[Place, ...]) -> str:
        """No cell makes this progress: each place is covered by obstacles or lies in what is forbidden."""
        sentences = []
        for place in places:
            cells = self.grid.centres[self.grid.inside(region_of(place, self.scenario))]
            name = _names((place,))
            if not len(cells):
                sentences.append(f"{name} has no free position: obstacles or walls cover it")
                continue
            for forbidden, avoid in self._forbidding(location):
                inside = np.zeros(len(cells), dtype=np.bool_)
                for other in forbidden:
                    inside |= region_of(other, self.scenario).contains(cells)
                if avoid and inside.all():
                    sentences.append(f"{name} lies inside {_names(forbidden)}, which the mission forbids")
                elif not avoid and not inside.any():
                    sentences.append(f"{name} lies outside {_names(forbidden)}, where the mission must stay")
        if not sentences:
            return f"no position inside {_names(places)} is allowed: together, {self._forbidden_words(location)}"
        return "; ".join(dict.fromkeys(sentences))

    def _start(self, obstacle: Obstacle) -> str:
        point = self.grid.centres[obstacle.cells[0]]
        at = f"({point[0]:.2f}, {point[1]:.2f})"
        if obstacle.kind == "start early":
            goal = self._goal(obstacle.location)
            places = () if goal is None else goal.places
            inside = tuple(p for p in places if region_of(p, self.scenario).contains(point))
            return (
                f"the robot begins inside {_names(inside)} at {at}, which counts as its first entry, "
                f"before the time window opens at {obstacle.allows:.4g} s"
            )
        reasons = []
        bindings = self._forbidding(obstacle.location)
        bindings += [(c.places, c.avoid) for c in self.mission.beside if c.places and c.seconds is not None]
        for places, avoid in bindings:
            inside = tuple(p for p in places if region_of(p, self.scenario).contains(point))
            if avoid and inside:
                reasons.append(f"inside {_names(inside)}, which the mission forbids")
            elif not avoid and not inside:
                reasons.append(f"outside {_names(places)}, where the mission must stay")
        return f"the robot begins at {at} {' and '.join(reasons)}"


def _latest_from_start(goal: Constraint, scenario: Scenario) -> float:
    if goal.seconds is None or goal.since != "start" or goal.recurrences > 1:
        return np.inf
    return exact_window_seconds(goal.seconds, scenario)[1] if goal.type is ConstraintType.EXACT else goal.seconds


def _names(places: tuple[Place, ...]) -> str:
    names = [f"the {p}" if isinstance(p, str) and p[0].islower() else place_name(p) for p in places]
    return names[0] if len(names) == 1 else f"{', '.join(names[:-1])} or {names[-1]}"
