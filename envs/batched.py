"""The batched world: many adversaries at once, unopposed, on a bank of tasks. Kinematic, for training and statistics.

Robots are exact unicycles pushed out of walls and obstacles; missions are the timed automata that the physics
environment's monitor runs, at the same rate; observations are the same function. What it leaves out is contact
dynamics and the ego.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from tab_marl.envs import batched_kernels as kernels
from tab_marl.envs.adversary_observation import OBSERVED, AdversaryTask
from tab_marl.envs.adversary_tables import Tables, pack
from tab_marl.mission.automaton import COMPLETED, FAILED
from tab_marl.world.grid import free_points
from tab_marl.world.regions import sample_in
from tab_marl.world.scenario import STRICT

GHOST_SHARE = 0.25
"""Of the bank's episodes show the robot an ego that does nothing, so that it learns to take no notice."""


@dataclass(frozen=True)
class Prices:
    """The reward of the batched world."""

    metre: float = 2.0
    """Per metre by which the plain distance-to-go through all remaining stages drops."""
    excess_metre: float = 4.0
    """Per metre (seconds x top speed) by which excess time before an arrival time drops: what arrives early forfeits it."""
    visit: float = 1.0
    completed: float = 4.0
    failed: float = -3.0
    touch: float = -0.05
    tick: float = -0.01
    """Per control step without excess time."""

    __pydantic_config__: ClassVar = STRICT

    def array(self) -> NDArray[np.float64]:
        return np.array([self.metre, self.excess_metre, self.visit, self.completed, self.failed, self.touch, self.tick])


@dataclass(frozen=True, eq=False)
class Bank:
    """Tasks built once and used over and over."""

    tasks: tuple[AdversaryTask, ...]
    tables: Tables

    @classmethod
    def of(cls, tasks: Sequence[AdversaryTask]) -> Bank:
        """Raises ValueError for no tasks."""
        if not tasks:
            raise ValueError("a bank needs at least one task, got none")
        return cls(tuple(tasks), pack([task.parts for task in tasks]))

    def __len__(self) -> int:
        return len(self.tasks)


class BatchedWorld:
    """N robots. `reset` and `step` like a vector environment; finished robots stand still until `begin` is called."""

    def __init__(self, bank: Bank, robots: int, rng: np.random.Generator, prices: Prices | None = None) -> None:
        if robots < 1:
            raise ValueError(f"robots is {robots}, must be >= 1")
        self.bank = bank
        self.robots = robots
        self.rng = rng
        self.prices = (prices or Prices()).array()
        self.seen_metres = 0.0
        """Range in which a ghost ego is seen; 0: none."""
        self.task = np.zeros(robots, dtype=np.int64)
        self.state = np.zeros((robots, 5))
        """``[N, 5]`` x, y, theta, v, w."""
        self.location = np.full(robots, FAILED, dtype=np.int64)
        self.clocks = np.full((robots, 3), -1, dtype=np.int32)
        self.memory = np.zeros((robots, 2), dtype=np.int32)
        """``[N, 2]`` via points passed, whether the styled route was dropped."""
        self.ghost = np.zeros((robots, 5))
        self.potential = np.zeros((robots, 2))
        self.observation = np.zeros((robots, OBSERVED), dtype=np.float32)
        self.reward = np.zeros(robots)
        self.visited = np.zeros(robots, dtype=bool)
        self.touched = np.zeros(robots, dtype=bool)

    def begin(self, which: NDArray[np.int64], tasks: NDArray[np.int64]) -> None:
        """Start these robots on these tasks, at points drawn from the tasks' start regions."""
        start = np.full((self.robots, 3), np.nan)
        for i, k in zip(which, tasks, strict=True):
            self.task[i] = k
            start[i] = draw_start(self.bank.tasks[k], self.rng)
        if self.seen_metres > 0:
            shown = self.rng.random(len(which)) < GHOST_SHARE
            drawn = self.rng.uniform((0.3, 0.3, 0.1, -3.0, -2.0), (2.7, 2.7, 0.8, 3.0, 2.0), (len(which), 5))
            self.ghost[which] = np.where(shown[:, None], drawn, (1e6, 1e6, 0, 0, 0))
        kernels.start_many(
            self.bank.tables, self.task, start, self.state, self.location, self.clocks, self.memory, self.ghost,
            self.seen_metres, self.potential, self.observation,
        )  # fmt: skip

    def step(self, action: NDArray[np.float32]) -> None:
        """One control step; results are in `observation`, `reward`, `visited`, `touched`, `location`."""
        kernels.step_many(
            self.bank.tables, self.task, action, self.state, self.location, self.clocks, self.memory, self.ghost,
            self.seen_metres, self.potential, self.prices, self.reward, self.visited, self.touched, self.observation,
        )  # fmt: skip

    @property
    def finished(self) -> NDArray[np.bool_]:
        return np.asarray(self.location < 0)

    @property
    def completed(self) -> NDArray[np.bool_]:
        return np.asarray(self.location == COMPLETED)


def draw_start(task: AdversaryTask, rng: np.random.Generator) -> tuple[float, float, float]:
    """A pose uniform in the free part of the adversary's start region. Raises ValueError if nothing of it is free."""
    scenario = task.scenario
    for _ in range(20):
        points = sample_in(scenario.adversary_start, rng, 16)
        free = np.flatnonzero(free_points(scenario, points, scenario.adversary.radius_metres))
        if len(free):
            x, y = points[free[0]].tolist()
            return x, y, float(rng.uniform(-np.pi, np.pi))
    raise ValueError(
        f"scenario {scenario.name!r}: adversary_start {scenario.adversary_start} has no free point for a robot of "
        f"radius {scenario.adversary.radius_metres} m: move it off the walls and obstacles"
    )
