"""Tasks by difficulty: one number from 0 (easy) to 1 (hard) instead of a handful of map and mission options."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from tab_marl.mission.tasks import Task, sample_task
from tab_marl.world.sampling import MapOptions
from tab_marl.world.scenario import STRICT, Scenario

SPACING_SHARE = 0.8 / 3.0
"""Checkpoints are this share of the arena's side apart, as on the default map."""
FEW_CHECKPOINTS_METRES = 2.8
"""Smaller arenas have room for four checkpoints beside the central zone, not five."""


@dataclass(frozen=True)
class Curriculum:
    """What difficulty means: each field holds its value at difficulty 0 and at difficulty 1, linear in between.

    Harder is harder for both sides: less time, longer ways, more corners. Difficulty 0.5 is about the default map.
    """

    slack: tuple[float, float] = (3.0, 1.2)
    """Allowed time / shortest time."""
    side_metres: tuple[float, float] = (2.4, 3.6)
    """Of the square arena."""
    obstacles: tuple[float, float] = (0.0, 6.0)
    """Boxes in the arena, rounded."""
    far_metres: tuple[float, float] = (0.6, 1.4)
    """Between the adversary's start and its first goal, and between the two starts, at least."""

    __pydantic_config__: ClassVar = STRICT

    def __post_init__(self) -> None:
        if not min(self.slack) > 1:
            raise ValueError(
                f"Curriculum.slack is {self.slack}, must be > 1 at both ends (allowed time / shortest time)"
            )
        for name in ("side_metres", "far_metres"):
            if not min(getattr(self, name)) > 0:
                raise ValueError(f"Curriculum.{name} is {getattr(self, name)}, must be > 0 at both ends")
        if min(self.obstacles) < 0:
            raise ValueError(f"Curriculum.obstacles is {self.obstacles}, must be >= 0 at both ends")

    def map_options(self, difficulty: float) -> MapOptions:
        """Options of the maps of this difficulty."""
        side = round(_between(self.side_metres, difficulty), 2)
        boxes = round(_between(self.obstacles, difficulty))
        return MapOptions(
            width_metres=side,
            height_metres=side,
            checkpoints=4 if side < FEW_CHECKPOINTS_METRES else 5,
            obstacles_min=boxes,
            obstacles_max=boxes,
            checkpoint_spacing=SPACING_SHARE * side,
        )

    def sample_task(
        self,
        rng: np.random.Generator,
        difficulty: float,
        mission_id: str = "M1",
        family: str = "point",
        scenario: Scenario | None = None,
    ) -> Task:
        """A task of this difficulty; on a given scenario, its slack and its distances only.

        Raises ValueError for a difficulty outside 0..1, and whatever `sample_task` raises.
        """
        difficulty = check_difficulty(difficulty)
        options = None if scenario is not None else self.map_options(difficulty)
        slack, far = _between(self.slack, difficulty), _between(self.far_metres, difficulty)
        return sample_task(rng, mission_id, family, slack, options, scenario=scenario, far_metres=far)

    @property
    def hardest_map(self) -> float:
        """The difficulty whose arena is the largest: 0.0 or 1.0."""
        return float(self.side_metres[1] >= self.side_metres[0])


def check_difficulty(difficulty: object) -> float:
    """The difficulty as a float. Raises TypeError, ValueError unless it is a number in 0..1."""
    if isinstance(difficulty, bool) or not isinstance(difficulty, int | float | np.integer | np.floating):
        raise TypeError(f"difficulty is {difficulty!r}, must be a number in 0..1")
    value = float(difficulty)
    if not 0.0 <= value <= 1.0:
        raise ValueError(f"difficulty is {value:g}, must lie in 0..1 (0: easy, 1: hard)")
    return value


def _between(ends: tuple[float, float], difficulty: float) -> float:
    return ends[0] + difficulty * (ends[1] - ends[0])
