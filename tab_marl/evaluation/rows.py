"""What one episode leaves behind: a row that depends on its seed alone, and how long it took."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class EpisodeRow:
    """One episode. Every column is a function of (settings, mission, family, planner, seed): never of time or machine load."""

    mission: str
    family: str
    planner: str
    seed: int
    """Index of the episode, from 0: the same index is the same task, adversary and noise for every planner."""
    adversary: str
    """Name of the zoo policy; empty if the task could not be drawn."""
    slack: float
    """Allowed time over shortest time; nan if the task has none."""
    intercepted: bool
    completed: bool
    """The adversary completed its mission before it was intercepted."""
    failed: bool
    """The adversary broke its mission (a deadline missed, a zone entered) before it was intercepted."""
    physics_steps: int
    """100 Hz steps until interception, or the horizon if there was none."""
    horizon_steps: int
    completed_step: int | None = None
    """Physics step of completion."""
    ego_first: bool = False
    """The mission has one goal region, and the ego can be there before the adversary."""
    fallbacks: int = 0
    """How often the planner's belief was contradicted and had to start again."""
    error: str | None = None
    """What went wrong, if the episode could not be played to its end. Scored as the planner's worst case."""
    learned: str | None = None
    """JSON that the planner carries to its next episode of this mission and family."""

    @property
    def censored(self) -> bool:
        """No interception within the horizon."""
        return not self.intercepted

    @property
    def key(self) -> tuple[str, str, str, int]:
        return (self.mission, self.family, self.planner, self.seed)


@dataclass(frozen=True)
class Timing:
    """How long an episode took on this machine; kept apart from the row, which must not depend on it."""

    decisions: int
    mean_decision_milliseconds: float
    max_decision_milliseconds: float
    seconds: float
    traceback: str | None = None
    processor_seconds: float = float("nan")
    """Of the whole episode; processor time, which other jobs on the machine do not lengthen."""
    preparation_processor_seconds: float = float("nan")
    """Of the planner before its first decision: fields, routes, rollouts (what planners on one task share is paid by the first)."""
    decision_processor_seconds: float = float("nan")
    """Of all decisions together, belief updates included."""
    planner_processor_seconds: float = float("nan")
    """Of everything that the planner did: preparation, decisions, steering."""
    simulation_processor_seconds: float = float("nan")
    """Of the environment and the adversary's policy."""


def scored_completed(row: EpisodeRow) -> bool:
    """Whether the episode counts as a completed mission: an episode that broke down counts against its planner."""
    return row.completed or row.error is not None


def scored_steps(row: EpisodeRow) -> int:
    """Steps to interception, censored at the horizon."""
    return row.horizon_steps if row.error is not None else row.physics_steps


def finite(value: float) -> float | None:
    """The value, or None where it is not a finite number (SQLite and JSON have no nan)."""
    return float(value) if np.isfinite(value) else None
