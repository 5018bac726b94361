"""From constraint tuples to the timed automaton."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tab_marl.mission.automaton import (
    ALWAYS_FORBIDDEN,
    COMPLETED,
    MISSION_CLOCK,
    NO_BRANCH,
    STAGE_CLOCK,
    UNBOUNDED,
    VISIT_CLOCK,
    MissionAutomaton,
)
from tab_marl.mission.model import Constraint, ConstraintType, Mission, place_name
from tab_marl.mission.places import MissionWorld
from tab_marl.mission.propositions import Propositions

# Bounds are compared in ticks; this absorbs the rounding of seconds / tick_seconds.
TICK_ROUNDING = 1e-9


def ticks_at_most(seconds: float, tick_seconds: float) -> int:
    """The last tick not after `seconds`."""
    return math.floor(seconds / tick_seconds + TICK_ROUNDING)


def ticks_at_least(seconds: float, tick_seconds: float) -> int:
    """The first tick not before `seconds`."""
    return max(0, math.ceil(seconds / tick_seconds - TICK_ROUNDING))


def exact_window_seconds(seconds: float, scenario: MissionWorld) -> tuple[float, float]:
    """The window that `exact` means: +- max(exact_seconds, exact_fraction * seconds)."""
    tolerance = max(scenario.exact_seconds, scenario.exact_fraction * seconds)
    return seconds - tolerance, seconds + tolerance


@dataclass(frozen=True)
class _Location:
    """How far a mission has come, but for its clocks."""

    goal: int
    """Goals completed."""
    visited: tuple[int, ...] = ()
    """Places that may not count again, indices into the goal's places, rising (`different` > 1)."""
    visits: int = 0
    within: int = -1
    """The place just visited and not left yet (recurrence), or -1."""


def compile_mission(mission: Mission, scenario: MissionWorld, tick_seconds: float | None = None) -> MissionAutomaton:
    """The mission's automaton on this scenario at this tick (default: the scenario's `step_seconds`).

    Raises UnknownName for a place the scenario lacks, ValueError for a window that holds no tick or too many regions.
    """
    tick = scenario.step_seconds if tick_seconds is None else tick_seconds
    if not (math.isfinite(tick) and tick > 0):
        raise ValueError(f"tick_seconds is {tick}, must be a finite number > 0")
    propositions = _propositions(mission, scenario)
    if not mission.goals:
        return _without_goals(mission, scenario, tick, propositions)
    return _Compilation(mission, scenario, tick, propositions).automaton()


def _propositions(mission: Mission, scenario: MissionWorld) -> Propositions:
    found = Propositions(scenario)
    for constraint in mission.constraints:
        for place in (*constraint.places, *constraint.restricted):
            found.add(place)
        if constraint.recurrences > 1 and constraint.different == 1:
            for place in constraint.places:
                found.add_leaving(place)
    return found


def _violation(constraint: Constraint, propositions: Propositions) -> NDArray[np.bool_]:
    """``[2**P]``: labels that an always/until constraint does not admit."""
    if not constraint.places:
        return np.zeros(len(propositions.masks), dtype=np.bool_)
    inside = propositions.inside_any(constraint.places)
    return inside if constraint.avoid else ~inside


def _without_goals(
    mission: Mission, scenario: MissionWorld, tick: float, propositions: Propositions
) -> MissionAutomaton:  # fmt: skip
    """always/until only: completed when everything held to the horizon (or to the last `until`, if all are)."""
    labels = len(propositions.masks)
    forbidden = np.zeros((1, labels), dtype=np.int32)
    last = 0
    for constraint in mission.constraints:
        if constraint.seconds is None:
            last, until = max(last, ticks_at_most(scenario.horizon_seconds, tick)), ALWAYS_FORBIDDEN
        else:
            until = ticks_at_least(constraint.seconds, tick)
            last = max(last, until)
        forbidden[0, _violation(constraint, propositions)] = until
    return MissionAutomaton(
        tick_seconds=tick,
        regions=tuple(propositions.regions),
        region_names=tuple(propositions.names),
        next_location=np.full((1, labels), COMPLETED, dtype=np.int32),
        forbidden_until=forbidden,
        progress=np.ones((1, labels), dtype=np.bool_),
        patient=np.ones(1, dtype=np.bool_),
        earliest=np.array([[last, 0, 0]], dtype=np.int32),
        latest=np.array([[last, UNBOUNDED, UNBOUNDED]], dtype=np.int32),
        resets=np.zeros((1, labels, 3), dtype=np.bool_),
        branch=np.full((1, labels), NO_BRANCH, dtype=np.int32),
        branch_places=(),
        speed_limit=np.array([_standing_speed_limit(mission)]),
        goal=np.array([-1], dtype=np.int32),
        visits=np.zeros(1, dtype=np.int32),
        goals_done=np.zeros(1, dtype=np.int32),
    )


def _standing_speed_limit(mission: Mission) -> float:
    return min((c.speed_limit for c in mission.beside if c.speed_limit is not None), default=math.inf)


class _Compilation:
    """Numbers the locations of a mission with goals and fills their tables."""

    def __init__(self, mission: Mission, scenario: MissionWorld, tick: float, propositions: Propositions) -> None:
        self.mission, self.scenario, self.tick, self.propositions = mission, scenario, tick, propositions
        self.goals = mission.goals
        self.locations = self._enumerate()
        self.number = {location: u for u, location in enumerate(self.locations)}
        self.inside = [[propositions.inside(p) for p in goal.places] for goal in self.goals]
        self.places = tuple(dict.fromkeys(place_name(p) for goal in self.goals for p in goal.places))
        self.mission_windows = self._mission_windows()

    def _enumerate(self) -> list[_Location]:
        """Every location, sorted so that transitions lead to later ones."""
        found = {_Location(0)}
        frontier = [_Location(0)]
        while frontier:
            location = frontier.pop()
            following = {self._after(location, place) for place in self._eligible(location)}
            if location.within >= 0:
                following.add(_Location(location.goal, visits=location.visits))
            for other in following:
                if other is not None and other not in found:
                    found.add(other)
                    frontier.append(other)
        return sorted(found, key=lambda u: (u.goal, u.visits, u.within < 0, u.visited, u.within))

    def _eligible(self, location: _Location) -> list[int]:
        """Places whose visit would count: not visited before, and leaving room for those that must be included."""
        goal = self.goals[location.goal]
        if goal.different == 1:
            return list(range(len(goal.places)))
        found = []
        for place in range(len(goal.places)):
            if place in location.visited:
                continue
            visited = {goal.places[p] for p in (*location.visited, place)}
            missing = sum(p not in visited for p in goal.including)
            if len(visited) + missing <= goal.different:
                found.append(place)
        return found

    def _after(self, location: _Location, place: int) -> _Location | None:
        """Where a counted visit leads; None when it completes the mission."""
        goal = self.goals[location.goal]
        visits = location.visits + 1
        if visits == goal.visits:
            return _Location(location.goal + 1) if location.goal + 1 < len(self.goals) else None
        if goal.different > 1:
            return _Location(location.goal, tuple(sorted((*location.visited, place))), visits)
        return _Location(location.goal, visits=visits, within=place)

    def _window(self, seconds: float, what: str) -> tuple[int, int]:
        low, high = exact_window_seconds(seconds, self.scenario)
        earliest, latest = ticks_at_least(low, self.tick), ticks_at_most(high, self.tick)
        if earliest > latest:
            raise ValueError(
                f"{what} in exactly {seconds:g} s: no tick of {self.tick:g} s lies in [{low:g}, {high:g}] s; "
                "use a shorter tick or a larger Scenario.exact_seconds"
            )
        return earliest, latest

    def _mission_windows(self) -> list[tuple[int, int]]:
        """Per goal (earliest, latest) on the mission clock; a later goal's bound already binds the earlier goals."""
        windows = []
        latest = UNBOUNDED
        for goal in reversed(self.goals):
            earliest = 0
            if goal.seconds is not None and goal.since == "start" and goal.recurrences == 1:
                if goal.type is ConstraintType.EXACT:
                    earliest, own = self._window(goal.seconds, place_name(goal.places[0]))
                else:
                    own = ticks_at_most(goal.seconds, self.tick)
                latest = min(latest, own)
            windows.append((earliest, latest))
        return windows[::-1]

    def _windows(self, location: _Location) -> tuple[list[int], list[int]]:
        """(earliest[3], latest[3]) of one location."""
        goal = self.goals[location.goal]
        final = location.visits + 1 == goal.visits
        earliest, latest = [0, 0, 0], [UNBOUNDED] * 3
        own_earliest, latest[MISSION_CLOCK] = self.mission_windows[location.goal]
        if final:
            earliest[MISSION_CLOCK] = own_earliest
        recurring = goal.recurrences > 1
        if goal.seconds is not None and (recurring or goal.since == "previous"):
            clock = VISIT_CLOCK if recurring else STAGE_CLOCK
            if goal.type is ConstraintType.EXACT:
                low, latest[clock] = self._window(goal.seconds, place_name(goal.places[0]))
                earliest[clock] = low if final or recurring else 0
            else:
                latest[clock] = ticks_at_most(goal.seconds, self.tick)
        if goal.max_gap_seconds is not None:
            latest[VISIT_CLOCK] = min(latest[VISIT_CLOCK], ticks_at_most(goal.max_gap_seconds, self.tick))
        return earliest, latest

    def _forbidden(self, location: _Location, completing: NDArray[np.bool_], earliest: int) -> NDArray[np.int32]:
        """``[2**P]``: see `MissionAutomaton.forbidden_until`."""
        goal = self.goals[location.goal]
        index = self.mission.goal_indices[location.goal]
        forbidden = np.zeros(len(completing), dtype=np.int32)
        for constraint in self.mission.beside:
            violated = _violation(constraint, self.propositions)
            if constraint.seconds is not None:
                until = ticks_at_least(constraint.seconds, self.tick)
                forbidden[violated] = np.maximum(forbidden[violated], until)
            elif constraint.until_goal is None:
                forbidden[violated] = ALWAYS_FORBIDDEN
            elif index <= constraint.until_goal:
                ends_here = completing & (index == constraint.until_goal)
                forbidden[violated & ~ends_here] = ALWAYS_FORBIDDEN
                if goal.presence:  # a visit before the window does not complete the goal
                    forbidden[violated & ends_here] = np.maximum(forbidden[violated & ends_here], earliest)
        forbidden[self.propositions.inside_any(goal.restricted)] = ALWAYS_FORBIDDEN
        return forbidden

    def automaton(self) -> MissionAutomaton:
        count, labels = len(self.locations), len(self.propositions.masks)
        following = np.repeat(np.arange(count, dtype=np.int32)[:, None], labels, axis=1)
        forbidden = np.zeros((count, labels), dtype=np.int32)
        progress = np.zeros((count, labels), dtype=np.bool_)
        resets = np.zeros((count, labels, 3), dtype=np.bool_)
        branch = np.full((count, labels), NO_BRANCH, dtype=np.int32)
        earliest = np.zeros((count, 3), dtype=np.int32)
        latest = np.full((count, 3), UNBOUNDED, dtype=np.int32)
        self._check_until_presence()
        for u, location in enumerate(self.locations):
            goal = self.goals[location.goal]
            open_labels = np.ones(labels, dtype=np.bool_)
            if location.within >= 0:
                open_labels = ~self.propositions.not_left(goal.places[location.within])
                following[u, open_labels] = self.number[_Location(location.goal, visits=location.visits)]
            for place in reversed(self._eligible(location)):  # where two overlap, the first place named counts
                visit = self.inside[location.goal][place] & open_labels
                after = self._after(location, place)
                following[u, visit] = COMPLETED if after is None else self.number[after]
                branch[u, visit] = self.places.index(place_name(goal.places[place]))
                progress[u] |= visit
            final = location.visits + 1 == goal.visits
            resets[u, progress[u], VISIT_CLOCK] = True
            resets[u, progress[u], STAGE_CLOCK] = final
            earliest[u], latest[u] = self._windows(location)
            completing = progress[u] if final else np.zeros(labels, dtype=np.bool_)
            forbidden[u] = self._forbidden(location, completing, int(earliest[u, MISSION_CLOCK]))
        standing = _standing_speed_limit(self.mission)
        goals = [self.goals[location.goal] for location in self.locations]
        return MissionAutomaton(
            tick_seconds=self.tick,
            regions=tuple(self.propositions.regions),
            region_names=tuple(self.propositions.names),
            next_location=following,
            forbidden_until=forbidden,
            progress=progress,
            patient=np.array([goal.presence for goal in goals], dtype=np.bool_),
            earliest=earliest,
            latest=latest,
            resets=resets,
            branch=branch,
            branch_places=self.places,
            speed_limit=np.array([min(standing, g.speed_limit or math.inf) for g in goals]),
            goal=np.array([self.mission.goal_indices[u.goal] for u in self.locations], dtype=np.int32),
            visits=np.array([u.visits for u in self.locations], dtype=np.int32),
            goals_done=np.array([u.goal for u in self.locations], dtype=np.int32),
        )

    def _check_until_presence(self) -> None:
        for constraint in self.mission.beside:
            if constraint.until_goal is None:
                continue
            goal = self.mission.constraints[constraint.until_goal]
            if goal.presence and goal.since == "previous":
                raise ValueError(
                    f"until_goal {constraint.until_goal} is an exact goal with presence counted from the previous "
                    "goal, which has no fixed end: use since='start' or presence=False there"
                )
