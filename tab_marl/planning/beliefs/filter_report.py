"""What a belief filter says about itself: how often it lost track, when, on seeing what, and what it did then."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, TypeAlias

Remedy: TypeAlias = Literal["replay", "fallback"]


class BeliefWarning(RuntimeWarning):
    """A belief was contradicted by what was observed and had to be made anew."""


class ImpossibleObservation(ValueError):
    """What was observed has probability zero under the belief; raised by filters that are strict."""

    def __init__(self, event: Deprivation) -> None:
        super().__init__(f"{event}: the model or the belief is wrong; a filter that is not strict replays its history")
        self.event = event


@dataclass(frozen=True)
class Deprivation:
    """One observation that nothing in the belief explained."""

    step: int
    """The update at which it happened, counted from 1."""
    action: str
    observation: object
    remedy: Remedy | None
    """How the belief was made anew: from the history, or by the fallback; None where the filter is strict."""
    detail: str
    """What was possible instead, or how many particles were tried."""

    def __str__(self) -> str:
        said = "" if self.remedy is None else f"; belief made anew by {self.remedy}"
        return f"step {self.step}: observation {self.observation!r} after action {self.action} ({self.detail}){said}"


@dataclass(frozen=True)
class FilterReport:
    """Totals of a filter's life so far."""

    updates: int
    least_effective: float
    """The smallest effective sample size after an update (particle filters; else the number of states)."""
    events: tuple[Deprivation, ...]
    """The latest losses of track, at most `EVENTS_KEPT`."""
    replays: int
    """Losses repaired by replaying the history with weights."""
    fallbacks: int
    """Losses that only the fallback repaired."""

    def __str__(self) -> str:
        head = f"{self.updates} updates, {self.replays} replays, {self.fallbacks} fallbacks"
        return "\n".join([head, *(f"  {event}" for event in self.events)])


EVENTS_KEPT = 100


class EventLog:
    """Counts losses of track and warns of each."""

    def __init__(self) -> None:
        self.updates = 0
        self.least_effective = float("inf")
        self._events: list[Deprivation] = []
        self._counts: dict[Remedy, int] = {"replay": 0, "fallback": 0}

    def lost(self, event: Deprivation) -> None:
        """Notes the event and emits a `BeliefWarning` that says what was seen and when."""
        if event.remedy is not None:
            self._counts[event.remedy] += 1
        self._events = [*self._events[1 - EVENTS_KEPT :], event]
        warnings.warn(str(event), BeliefWarning, stacklevel=4)

    def report(self) -> FilterReport:
        return FilterReport(
            self.updates,
            self.least_effective,
            tuple(self._events),
            self._counts["replay"],
            self._counts["fallback"],
        )


def named(names: Sequence[str], action: int) -> str:
    """The action's name if it has one."""
    return names[action] if 0 <= action < len(names) else str(action)
