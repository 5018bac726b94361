"""What a mission is: an ordered sequence of constraint tuples (goal region, time constraint, type, extras).

Goal constraints (`exact`, `deadline`, `eventually`) are stages, done one after another; `always` and `until` run beside
them. Times are in seconds, speeds in m/s, points in metres (paper, section "Problem formulation").
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from enum import StrEnum
from typing import ClassVar, Literal

import numpy as np

Place = str | tuple[float, float]
"""The name of a region, or a bare target point: a disc of `Scenario.target_radius_metres` around it."""


class ConstraintType(StrEnum):
    """The five time constraints."""

    EXACT = "exact"
    DEADLINE = "deadline"
    UNTIL = "until"
    EVENTUALLY = "eventually"
    ALWAYS = "always"

    @property
    def is_goal(self) -> bool:
        """Whether it is a stage of the mission (else it runs beside the stages)."""
        return self in (ConstraintType.EXACT, ConstraintType.DEADLINE, ConstraintType.EVENTUALLY)


STRICT: dict[str, str] = {"extra": "forbid"}


@dataclass(frozen=True)
class Constraint:
    """One tuple of the paper's mission. A stage sees labels from the tick after the one that completed its predecessor."""

    type: ConstraintType
    places: tuple[Place, ...] = ()
    """Any of these. Empty only for `always` with a speed limit."""
    seconds: float | None = None
    """The bound: `deadline` at most, `exact` about, `until` strictly before. Required there, forbidden elsewhere."""
    avoid: bool = False
    """always/until: stay out of every place (True) or stay in one of them (False)."""
    different: int = 1
    """How many different places must be visited, in any order."""
    including: tuple[Place, ...] = ()
    """These must be among the places visited."""
    since: Literal["start", "previous"] = "start"
    """What `seconds` counts from: the mission's start, or the completion of the previous goal."""
    max_gap_seconds: float | None = None
    """Between consecutive counted visits; the first gap counts from when this constraint became current."""
    recurrences: int = 1
    """Above 1: so many visits, `seconds` apart (`deadline`: at most, `exact`: about); the first counts from when this
    constraint became current, and a visit to the same place counts only after leaving it by `Scenario.leave_metres`.
    With `different` equal to it, each visit is to another place."""
    presence: bool = False
    """exact: be there at that time, however early the robot came (else its first entry must fall into the window)."""
    speed_limit: float | None = None
    """m/s, while this constraint is current (`always`, in a constraint of its own: throughout)."""
    restricted: tuple[Place, ...] = ()
    """Places to keep out of while this constraint is current."""
    until_goal: int | None = None
    """until, without seconds: holds at every tick before the one that completes the goal with this index."""

    __pydantic_config__: ClassVar = STRICT

    def __post_init__(self) -> None:
        object.__setattr__(self, "type", ConstraintType(self.type))
        for name in ("places", "including", "restricted"):
            object.__setattr__(self, name, tuple(_as_place(p, name) for p in getattr(self, name)))
        self._check_numbers()
        self._check_places()
        if self.type.is_goal:
            self._check_goal()
        else:
            self._check_beside()

    @property
    def visits(self) -> int:
        """How many visits complete this goal."""
        return max(self.different, self.recurrences)

    def _fail(self, name: str, must: str) -> None:
        raise ValueError(f"{self.type} constraint: {name} is {getattr(self, name)!r}, {must}")

    def _check_numbers(self) -> None:
        for name in ("seconds", "max_gap_seconds", "speed_limit"):
            value = getattr(self, name)
            if value is not None and not (math.isfinite(value) and value > 0):
                self._fail(name, "must be a finite number > 0 (or left out)")
        for name in ("different", "recurrences"):
            if getattr(self, name) < 1:
                self._fail(name, "must be >= 1")
        if self.since not in ("start", "previous"):
            self._fail("since", "must be 'start' or 'previous'")

    def _check_places(self) -> None:
        if len(set(self.places)) < len(self.places):
            self._fail("places", "must not repeat a place (for repeated visits use recurrences)")
        if not self.places and not (self.type is ConstraintType.ALWAYS and self.speed_limit is not None):
            self._fail("places", "must name at least one place")
        stray = [p for p in self.including if p not in self.places]
        if stray:
            self._fail("including", f"must be among places: {place_name(stray[0])} is not")

    def _check_goal(self) -> None:
        if self.avoid:
            self._fail("avoid", "only always and until can avoid; for a goal use restricted")
        if self.until_goal is not None:
            self._fail("until_goal", "only until has it")
        if self.different > len(self.places):
            self._fail("different", f"must be <= the number of places, {len(self.places)}")
        if len(self.including) > self.different:
            self._fail("including", f"must name at most `different` places, {self.different}")
        if self.including and self.different == 1 and len(self.places) > 1:
            self._fail("including", "needs different > 1 (or name that place alone)")
        if self.recurrences > 1 and self.different not in (1, self.recurrences):
            self._fail("different", f"must be 1 or equal to recurrences, {self.recurrences}")
        timed = self.type is not ConstraintType.EVENTUALLY
        if timed and self.seconds is None:
            self._fail("seconds", "must be given")
        if not timed and self.seconds is not None:
            self._fail("seconds", "eventually has no bound: use deadline or exact, or leave it out")
        if not timed and self.since == "previous":
            self._fail("since", "counts nothing without seconds: leave it out")
        if self.recurrences > 1 and self.since == "previous":
            self._fail("since", "recurring visits always count from the previous visit: leave it out")
        if self.presence and (self.type is not ConstraintType.EXACT or self.recurrences > 1):
            self._fail("presence", "only exact without recurrence has it")

    def _check_beside(self) -> None:
        only_goals: dict[str, object] = {
            "different": 1, "including": (), "since": "start", "max_gap_seconds": None, "recurrences": 1,
            "presence": False, "restricted": (),
        }  # fmt: skip
        for name, default in only_goals.items():
            if getattr(self, name) != default:
                self._fail(name, "only goals (exact, deadline, eventually) have it")
        if self.type is ConstraintType.ALWAYS:
            if self.speed_limit is not None and self.places:
                self._fail("speed_limit", "must stand in an always constraint of its own, without places")
            for name in ("seconds", "until_goal"):
                if getattr(self, name) is not None:
                    self._fail(name, "always never ends: use until, or leave it out")
            return
        if self.speed_limit is not None:
            self._fail("speed_limit", "only goals and always have it")
        if (self.seconds is None) == (self.until_goal is None):
            self._fail("seconds", f"until needs exactly one of seconds and until_goal ({self.until_goal!r})")


@dataclass(frozen=True)
class Mission:
    """Constraints in order. The name is for people and does not take part in comparisons."""

    constraints: tuple[Constraint, ...]
    name: str = field(default="", compare=False)

    __pydantic_config__: ClassVar = STRICT

    def __post_init__(self) -> None:
        object.__setattr__(self, "constraints", tuple(self.constraints))
        if not self.constraints:
            raise ValueError("Mission.constraints is empty, must hold at least one constraint")
        for number, constraint in enumerate(self.constraints):
            goal = constraint.until_goal
            if goal is not None and not (0 <= goal < len(self.constraints) and self.constraints[goal].type.is_goal):
                raise ValueError(
                    f"Mission.constraints[{number}].until_goal is {goal}, must be the index of a goal constraint: "
                    f"one of {list(self.goal_indices)}"
                )

    @property
    def goal_indices(self) -> tuple[int, ...]:
        """Indices of the stages, in order."""
        return tuple(i for i, c in enumerate(self.constraints) if c.type.is_goal)

    @property
    def goals(self) -> tuple[Constraint, ...]:
        """The stages, in order."""
        return tuple(c for c in self.constraints if c.type.is_goal)

    @property
    def beside(self) -> tuple[Constraint, ...]:
        """The `always` and `until` constraints."""
        return tuple(c for c in self.constraints if not c.type.is_goal)


def place_name(place: Place) -> str:
    """How people read it: the region's name, or "[1.2, 2.4]"."""
    if isinstance(place, str):
        return place
    return f"[{plain_number(place[0])}, {plain_number(place[1])}]"


def plain_number(value: float) -> str:
    """The shortest decimal without an exponent that reads back as the same number: "5", "0.25"."""
    return np.format_float_positional(value, trim="-")


def _as_place(place: object, name: str) -> Place:
    if isinstance(place, str):
        if place.strip():
            return place
    elif isinstance(place, (tuple, list)) and len(place) == 2:
        x, y = (float(v) for v in place)
        if math.isfinite(x) and math.isfinite(y):
            return (x, y)
    raise ValueError(f"Constraint.{name} holds {place!r}, must be region names or finite [x, y] points in metres")
