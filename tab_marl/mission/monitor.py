"""A mission watched on continuous positions: the automaton stepped once per tick, with words for what went wrong."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any, Literal

import numpy as np

from tab_marl.mission import kernels
from tab_marl.mission.automaton import (
    BEFORE_START,
    COMPLETED,
    FAILED,
    MISSION_CLOCK,
    STAGE_CLOCK,
    UNBOUNDED,
    VISIT_CLOCK,
    AutomatonState,
    MissionAutomaton,
)
from tab_marl.mission.compile import compile_mission
from tab_marl.mission.model import Constraint, ConstraintType, Mission, Place, place_name
from tab_marl.mission.places import MissionWorld
from tab_marl.mission.propositions import region_of
from tab_marl.world.regions import BOUNDARY_METRES, Box, Disc, Region

# A body that is commanded at the limit overshoots a little; this share above the limit is no violation.
SPEED_TOLERANCE = 0.02

Point = Sequence[float] | np.ndarray[tuple[int], np.dtype[np.float64]]
"""x, y (in space also z) in metres."""
Status = Literal["active", "completed", "failed"]


class Monitor:
    """Steps the mission's automaton on positions: call `reset` with tick 0's position, then `step` once per tick."""

    def __init__(
        self,
        mission: Mission,
        scenario: MissionWorld,
        tick_seconds: float,
        automaton: MissionAutomaton | None = None,
    ) -> None:
        """`automaton`: one compiled before for the same mission, scenario and tick, to save time."""
        self.mission = mission
        self.scenario = scenario
        self.automaton = compile_mission(mission, scenario, tick_seconds) if automaton is None else automaton
        self.tick_seconds = tick_seconds
        if self.automaton.tick_seconds != tick_seconds:
            raise ValueError(
                f"automaton.tick_seconds is {self.automaton.tick_seconds}, must equal the monitor's {tick_seconds}"
            )
        self._inside_proposition = [_membership(region) for region in self.automaton.regions]
        self._clocks = np.array(BEFORE_START, dtype=np.int32)
        self._state = AutomatonState(self.automaton.initial, BEFORE_START)
        self._tick = -1
        self._done = 0
        self._why = ""

    def __getstate__(self) -> dict[str, Any]:
        return {name: value for name, value in self.__dict__.items() if name != "_inside_proposition"}

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Closures do not travel; they follow from the regions."""
        self.__dict__.update(state)
        self._inside_proposition = [_membership(region) for region in self.automaton.regions]

    @property
    def status(self) -> Status:
        if self._state.location == COMPLETED:
            return "completed"
        return "failed" if self._state.location == FAILED else "active"

    @property
    def location(self) -> int:
        """The automaton's location; COMPLETED or FAILED at the end."""
        return self._state.location

    @property
    def clocks(self) -> tuple[int, int, int]:
        """Ticks on the (mission, stage, visit) clocks; they stand still at the end."""
        return self._state.clocks

    @property
    def why_failed(self) -> str:
        """E.g. "entered the central zone at 3.2 s"; empty unless failed."""
        return self._why

    @property
    def progress(self) -> tuple[int, int]:
        """(goals completed, goals in all)."""
        return self._done, len(self.mission.goals)

    @property
    def seconds_left(self) -> float:
        """Until the nearest bound of the current goal; inf if it has none, 0 when the mission is over."""
        if self.location < 0:
            return 0.0
        latest = self.automaton.latest[self.location]
        ticks = [int(b) - c for b, c in zip(latest, self.clocks, strict=True) if b < UNBOUNDED]
        return min(ticks) * self.tick_seconds if ticks else math.inf

    @property
    def speed_limit(self) -> float:
        """m/s, inf if none or over."""
        return float(self.automaton.speed_limit[self.location]) if self.location >= 0 else math.inf

    def reset(self, point: Point) -> Status:
        """Begin with the robot's centre at `point` metres at tick 0."""
        self._clocks[:] = BEFORE_START
        self._state = AutomatonState(self.automaton.initial, BEFORE_START)
        self._tick, self._done, self._why = -1, 0, ""
        return self._read(point, None)

    def step(self, point: Point, speed: float | None = None) -> Status:
        """One tick later the robot is at `point`, and drove at `speed` m/s (None: no speed limit is checked)."""
        if self._tick < 0:
            raise RuntimeError("Monitor.step was called before Monitor.reset: reset it with the position at tick 0")
        return self._read(point, speed)

    def _read(self, point: Point, speed: float | None) -> Status:
        if self.location < 0:
            return self.status
        self._tick += 1
        before = self._state
        limit = self.speed_limit
        if speed is not None and speed > limit * (1.0 + SPEED_TOLERANCE):
            self._state = AutomatonState(FAILED, before.clocks)
            self._why = f"drove {speed:.2f} m/s at {self._now}, where at most {limit:g} m/s is allowed"
            return self.status
        at = (*point,)
        mask = 0
        for bit, inside in enumerate(self._inside_proposition):
            if inside(*at):
                mask |= 1 << bit
        location = kernels.advance(*self.automaton.tables, before.location, self._clocks, mask)
        first, second, third = self._clocks.tolist()
        self._state = AutomatonState(int(location), (first, second, third))
        if self.location == FAILED:
            self._why = self._explain(before.location, mask, point)
        elif self.location == COMPLETED:
            self._done = len(self.mission.goals)
        else:
            self._done = int(self.automaton.goals_done[self.location])
        return self.status

    @property
    def _now(self) -> str:
        return f"{self._tick * self.tick_seconds:.4g} s"

    def _explain(self, location: int, mask: int, point: Point) -> str:
        automaton, clocks = self.automaton, self.clocks
        if clocks[MISSION_CLOCK] < automaton.forbidden_until[location, mask]:
            return self._explain_forbidden(location, point)
        goal = self.mission.constraints[int(automaton.goal[location])]
        for clock in (MISSION_CLOCK, STAGE_CLOCK, VISIT_CLOCK):
            if clocks[clock] > automaton.latest[location, clock]:
                return self._explain_late(location, clock)
        clock = next(k for k in range(3) if clocks[k] < automaton.earliest[location, k])
        opened = (self._tick - clocks[clock] + int(automaton.earliest[location, clock])) * self.tick_seconds
        inside = [p for p in goal.places if self._inside(p, point)]
        return f"entered {_the(inside[0])} at {self._now}, before its time window opened at {opened:.4g} s"

    def _inside(self, place: Place, point: Point) -> bool:
        return bool(region_of(place, self.scenario).contains(np.asarray(point)))

    def _explain_forbidden(self, location: int, point: Point) -> str:
        goal_index = int(self.automaton.goal[location])
        seconds = self._tick * self.tick_seconds
        avoided: list[Place] = []
        if goal_index >= 0:
            avoided += self.mission.constraints[goal_index].restricted
        for constraint in self.mission.beside:
            if constraint.seconds is not None and seconds >= constraint.seconds - 1e-9:
                continue
            if constraint.until_goal is not None and goal_index > constraint.until_goal:
                continue
            if constraint.avoid:
                avoided += constraint.places
            elif constraint.places and not any(self._inside(p, point) for p in constraint.places):
                return f"left {' or '.join(_the(p) for p in constraint.places)} at {self._now}"
        entered = next(p for p in avoided if self._inside(p, point))
        return f"{'began inside' if self._tick == 0 else 'entered'} {_the(entered)} at {self._now}"

    def _explain_late(self, location: int, clock: int) -> str:
        goal_index = int(self.automaton.goal[location])
        goal = self.mission.constraints[goal_index]
        allowed = f"{int(self.automaton.latest[location, clock]) * self.tick_seconds:.4g} s"
        if clock == MISSION_CLOCK:
            # A later goal's bound may be the one that ran out.
            later = [self.mission.constraints[i] for i in self.mission.goal_indices if i >= goal_index]
            bound = min((c for c in later if _counts_from_start(c)), key=lambda c: c.seconds or math.inf)
            kind = "deadline" if bound.type is ConstraintType.DEADLINE else "time window closed at"
            return f"missed {_goal_words(bound)}: {kind} {allowed}"
        visit = f" (visit {int(self.automaton.visits[location]) + 1} of {goal.visits})" if goal.visits > 1 else ""
        counted = int(self.automaton.visits[location]) > 0 and clock == VISIT_CLOCK
        since = "the previous visit" if counted else "the previous goal" if self._done else "the start"
        return f"missed {_goal_words(goal)}{visit}: at most {allowed} after {since}"


def _membership(region: Region) -> Callable[..., bool]:
    """`Region.contains` for one point at a time, without the cost of small arrays: an environment asks at every step."""
    if isinstance(region, Disc):
        x, y, reach = region.x, region.y, region.radius + BOUNDARY_METRES
        return lambda px, py: math.hypot(px - x, py - y) <= reach
    if isinstance(region, Box):
        left, bottom, right, top = region.bounds()

        def in_box(px: float, py: float) -> bool:
            if left <= px <= right and bottom <= py <= top:
                return True
            return math.hypot(max(left - px, px - right, 0.0), max(bottom - py, py - top, 0.0)) <= BOUNDARY_METRES

        return in_box
    return lambda *point: bool(region.contains(point))


def _counts_from_start(constraint: Constraint) -> bool:
    return constraint.seconds is not None and constraint.since == "start" and constraint.recurrences == 1


def _goal_words(goal: Constraint) -> str:
    return " or ".join(_the(p) for p in goal.places)


def _the(place: Place) -> str:
    name = place_name(place)
    return f"the {name}" if name[0].islower() else name
