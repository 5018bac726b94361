"""What may happen to a trajectory, told by a small automaton over cells, and how likely it shall be.

SoftConstraint(Passes("Checkpoint B"), 0.3)
SoftConstraint(IsAt("Checkpoint B", 3.0, 5.0), 0.5)
SoftConstraint(Completes(), 0.9)
SoftConstraint(Completes("Reach Checkpoint C within 20s"), 0.7)
TimingPrior(stage=0, shares={6.0: 0.5, 8.0: 0.5})
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from tab_marl.mission.compile import compile_mission, ticks_at_least, ticks_at_most
from tab_marl.mission.model import Mission, place_name
from tab_marl.mission.unroll import unroll

if TYPE_CHECKING:
    from tab_marl.field.problem import FieldProblem

Where = "str | tuple[float, float] | Region | ArrayLike"
"""A place of the scenario by name, a point, a region, or ``[C]`` bool (which cells)."""

LAST_STAGE = -1


@dataclass(frozen=True, eq=False)
class Tracker:
    """A deterministic automaton that watches the cells of a trajectory, tick by tick, and decides at some tick.

    Raises ValueError when the arrays do not fit.
    """

    name: str
    labels: NDArray[np.integer[Any]]
    """``[C]`` symbol of each cell."""
    delta: NDArray[np.integer[Any]]
    """``[E, L]`` next state."""
    initial: int
    """State before tick 0 is read."""
    happened: int
    """Absorbing."""
    ruled_out: int
    """Absorbing."""
    with_mission: bool = True
    """It is decided at the latest when the mission ends: what has not happened by that tick does not count.
    Else every path of `delta` must decide by itself within finitely many ticks."""

    def __post_init__(self) -> None:
        labels = np.ascontiguousarray(self.labels, dtype=np.int32)
        delta = np.ascontiguousarray(self.delta, dtype=np.int32)
        object.__setattr__(self, "labels", labels)
        object.__setattr__(self, "delta", delta)
        if delta.ndim != 2 or delta.min(initial=0) < 0 or delta.max(initial=0) >= len(delta):
            raise ValueError(f"Tracker.delta must be [E, L] with entries in 0..{len(delta) - 1}")
        if labels.ndim != 1 or labels.min(initial=0) < 0 or labels.max(initial=0) >= delta.shape[1]:
            raise ValueError(f"Tracker.labels must be [C] with entries in 0..{delta.shape[1] - 1}")
        for name in ("initial", "happened", "ruled_out"):
            if not 0 <= getattr(self, name) < len(delta):
                raise ValueError(f"Tracker.{name} is {getattr(self, name)}, must be a state, 0..{len(delta) - 1}")
        for name in ("happened", "ruled_out"):
            if (delta[getattr(self, name)] != getattr(self, name)).any():
                raise ValueError(f"Tracker.{name} ({getattr(self, name)}) must lead to itself under every symbol")
        if self.happened == self.ruled_out:
            raise ValueError("Tracker.happened and Tracker.ruled_out must be two states")

    def tracker(self, problem: FieldProblem) -> Tracker:
        """Itself; raises ValueError if it labels another number of cells."""
        if len(self.labels) != problem.cells:
            raise ValueError(f"Tracker.labels has {len(self.labels)} entries, the problem has {problem.cells} cells")
        return self


@dataclass(frozen=True, eq=False)
class Passes:
    """In the place at some tick, up to and including the tick at which the mission ends."""

    place: Where  # type: ignore[valid-type]

    def tracker(self, problem: FieldProblem) -> Tracker:
        inside = cells_of(self.place, problem)
        name = f"passes {_spoken(self.place)}"
        return Tracker(name, inside.astype(np.int32), np.array([[0, 1], [1, 1], [2, 2]]), 0, 1, 2)


@dataclass(frozen=True, eq=False)
class IsAt:
    """In the place at some tick of [from_seconds, to_seconds], whether the mission is over by then or not."""

    place: Where  # type: ignore[valid-type]
    from_seconds: float
    to_seconds: float
    throughout: bool = False
    """At every tick of the window instead."""

    def __post_init__(self) -> None:
        if not (math.isfinite(self.to_seconds) and 0 <= self.from_seconds <= self.to_seconds):
            raise ValueError(
                f"IsAt: the window is {self.from_seconds} to {self.to_seconds} s, must satisfy 0 <= from <= to"
            )

    def tracker(self, problem: FieldProblem) -> Tracker:
        step = problem.step_seconds
        first, last = ticks_at_least(self.from_seconds, step), ticks_at_most(self.to_seconds, step)
        name = f"is at {_spoken(self.place)} {'throughout' if self.throughout else 'during'} " + (
            f"{self.from_seconds:g} to {self.to_seconds:g} s"
        )
        if first > last:
            raise ValueError(f"{name}: no tick of {step:g} s lies in the window; widen it")
        if last > problem.horizon:
            raise ValueError(
                f"{name}: ends after the horizon of {problem.horizon * step:g} s; end it earlier or give more horizon"
            )
        happened, ruled_out = last + 1, last + 2
        # State t has read t ticks and reads tick t next.
        delta = np.repeat(np.arange(1, last + 4)[:, None], 2, axis=1)
        delta[last] = ruled_out
        if self.throughout:
            delta[first : last + 1, 0] = ruled_out
            delta[last, 1] = happened
        else:
            delta[first : last + 1, 1] = happened
        delta[happened], delta[ruled_out] = happened, ruled_out
        inside = cells_of(self.place, problem).astype(np.int32)
        return Tracker(name, inside, delta, 0, happened, ruled_out, with_mission=False)


@dataclass(frozen=True)
class Completes:
    """The mission (None: the field's own) is completed."""

    mission: Mission | str | None = None
    """A second one, or its English text. It is watched beside the field's own and ends by the same horizon."""

    def tracker(self, problem: FieldProblem) -> Tracker:
        """Of a second mission; the field's own is part of every problem."""
        from tab_marl.mission.english import to_english
        from tab_marl.mission.parse import parse_mission

        if self.mission is None:
            raise ValueError("Completes(): the field's own mission is tracked by the field itself")
        if problem.scenario is None or problem.grid is None:
            raise ValueError(
                "Completes(mission) needs a problem made by FieldProblem.from_mission: this one has no map"
            )
        scenario = problem.scenario
        mission = parse_mission(self.mission, scenario) if isinstance(self.mission, str) else self.mission
        name = f'completes "{to_english(mission, scenario)}"'
        if any(c.speed_limit is not None for c in mission.constraints):
            raise ValueError(f"{name}: a speed limit cannot be read off the cells; leave it out of the second mission")
        compiled = compile_mission(mission, scenario, scenario.step_seconds)
        masks = compiled.masks(problem.grid.centres)
        automaton = unroll(compiled, problem.horizon, masks)
        return Tracker(
            name, automaton.symbols(masks), automaton.delta, automaton.initial, automaton.accepting,
            automaton.rejecting, with_mission=False,
        )  # fmt: skip


Event = Passes | IsAt | Completes | Tracker


@dataclass(frozen=True)
class SoftConstraint:
    """The event happens with this probability (an expectation E_P[f] = c of the paper's eq. 1)."""

    event: Event
    probability: float
    """0 < probability < 1: what must always or never happen belongs into the mission."""

    def __post_init__(self) -> None:
        if not isinstance(self.event, Event):
            raise TypeError(f"SoftConstraint.event is {self.event!r}, must be Passes, IsAt, Completes or a Tracker")
        if not 0 < self.probability < 1:
            raise ValueError(
                f"SoftConstraint.probability is {self.probability}, must lie strictly between 0 and 1; "
                "what must always or never happen belongs into the mission"
            )


@dataclass(frozen=True)
class TimingPrior:
    """When a stage of the mission is completed: these shares of the trajectories that complete it, tick by tick."""

    stage: int = LAST_STAGE
    """0, 1, ... as in `FieldProblem.stage_names`; -1 is the last."""
    shares: Mapping[float, float] | None = None
    """Seconds -> share, summing to 1. None: uniform over the feasible ticks (of each start cell)."""

    def __post_init__(self) -> None:
        if self.shares is None:
            return
        values = list(self.shares.values())
        if not values or min(values) < 0 or not math.isfinite(sum(values)) or abs(sum(values) - 1) > 1e-9:
            raise ValueError(f"TimingPrior.shares must be >= 0 and sum to 1, they sum to {sum(values):.12g}")
        if min(self.shares) < 0:
            raise ValueError(f"TimingPrior.shares has the time {min(self.shares)} s, must be >= 0")


def cells_of(where: object, problem: FieldProblem) -> NDArray[np.bool_]:
    """``[C]``: the cells of a place. Raises ValueError if there is none, or the problem has no map to find it on."""
    if isinstance(where, np.ndarray | list):
        inside = np.asarray(where)
        if inside.shape != (problem.cells,) or inside.dtype != np.bool_:
            raise ValueError(f"a place given by cells must be [{problem.cells}] bool, one entry per cell")
    else:
        if problem.grid is None or problem.scenario is None:
            raise ValueError(
                f"the place {_spoken(where)} needs a problem made by FieldProblem.from_mission (this one has no map); "
                "give the cells as [C] bool instead"
            )
        region = problem.scenario.place(where) if isinstance(where, str | tuple) else where
        inside = np.asarray(problem.grid.inside(region))  # type: ignore[arg-type]
    if not inside.any():
        raise ValueError(
            f"no free cell lies in {_spoken(where)}: the map's cells are too large, or it is inside a wall"
        )
    return inside


def _spoken(where: object) -> str:
    if isinstance(where, str | tuple):
        return place_name(where)
    return "the given cells" if isinstance(where, np.ndarray | list) else str(where)
