"""A belief over whole trajectories: a pool of them, weighted by how well each agrees with what was seen and what was not.

Weights never vanish: the evidence of one observation is bounded, so that a pool without the true trajectory still points
to the least wrong ones (population-POMCP, with trajectories of trained adversaries).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tab_marl.planning.models import walk_kernels
from tab_marl.planning.models.interface import SampledPaths, TickObservation
from tab_marl.planning.models.mission_map import MissionMap
from tab_marl.planning.models.sight import noticed
from tab_marl.world.grid import GridMap
from tab_marl.world.scenario import Scenario


@dataclass(frozen=True)
class PoolOptions:
    """How observations weigh. Lengths in metres."""

    sight_metres: float = 0.12
    """Standard deviation allowed between a trajectory and a sighting."""
    least_evidence: float = 0.02
    """The likelihood of an observation that a trajectory excludes, relative to one it explains."""
    forget: float = 0.97
    """Power to which weights are raised each tick: old evidence fades, since trajectories repeat it tick by tick."""
    offset_seconds: float = 4.0
    """After a sighting, sampled paths start where the adversary was seen and join their trajectory over this time."""
    cell_metres: float = 0.1
    """Of the belief image."""


class TrajectoryPool:
    """N trajectories of the same scenario and mission."""

    def __init__(
        self,
        scenario: Scenario,
        positions: NDArray[np.floating],
        completed_tick: NDArray[np.int32],
        options: PoolOptions | None = None,
    ) -> None:
        """positions: ``[N, T + 1, 2]`` metres per tick; completed_tick: ``[N]`` or -1. Raises ValueError on other shapes."""
        if positions.ndim != 3 or positions.shape[2] != 2 or len(positions) == 0:
            raise ValueError(f"positions has shape {positions.shape}, must be [N, T + 1, 2] with N >= 1")
        if completed_tick.shape != positions.shape[:1]:
            raise ValueError(f"completed_tick has shape {completed_tick.shape}, must be ({len(positions)},)")
        self.scenario = scenario
        self.options = options or PoolOptions()
        self.positions = np.array(positions, dtype=np.float64)
        self.completed_tick = np.asarray(completed_tick, dtype=np.int32)
        self.fallbacks = 0
        self.log_evidence = 0.0
        self._tick = 0
        self._log_weight = np.zeros(len(positions))
        self._seen: tuple[int, NDArray[np.float64]] | None = None

    def wander_after_completion(self, mission_map: MissionMap, rng: np.random.Generator) -> None:
        """Replace what the trajectories hold after their mission's completion by uniform random moves."""
        for path, done in zip(self.positions, self.completed_tick, strict=True):
            if done >= 0:
                walk_kernels.wander(path, int(done), mission_map.reach_metres, mission_map.ground, rng)

    @property
    def weights(self) -> NDArray[np.float64]:
        """``[N]``, sum 1."""
        weight = np.exp(self._log_weight - self._log_weight.max())
        return np.asarray(weight / weight.sum())

    def start(self, observation: TickObservation, rng: np.random.Generator) -> None:
        self.fallbacks, self._tick, self._seen, self.log_evidence = 0, 0, None, 0.0
        self._log_weight[:] = 0.0
        self._condition(observation)

    def observe(self, observation: TickObservation, rng: np.random.Generator) -> None:
        self._tick = observation.tick
        self._log_weight *= self.options.forget
        self._condition(observation)

    def _now(self, ahead: int = 0) -> NDArray[np.float64]:
        """``[N, 2]`` positions so many ticks from now."""
        return self.positions[:, min(self._tick + ahead, self.positions.shape[1] - 1)]

    def _condition(self, observation: TickObservation) -> None:
        here, least = self._now(), math.log(self.options.least_evidence)
        seen = observation.sighting
        if seen is not None:
            travelled = seen.speed * seen.age_seconds
            point = np.array([seen.x + travelled * math.cos(seen.theta), seen.y + travelled * math.sin(seen.theta)])
            squared = ((here - point) ** 2).sum(axis=1)
            evidence = np.maximum(-squared / (2 * self.options.sight_metres**2), least)
            self._seen, self.log_evidence = (self._tick, point), 0.0
        else:
            evidence = np.where(noticed(self.scenario, here, observation.ego), least, 0.0)
            self.log_evidence += math.log(float(self.weights @ np.exp(evidence)))
        self.fallbacks += bool(evidence.max() <= least)
        self._log_weight += evidence

    def sample(self, count: int, ticks: int, rng: np.random.Generator) -> SampledPaths:
        weight = self.weights
        done = (self.completed_tick >= 0) & (self.completed_tick <= self._tick)
        if self.scenario.ego_task == "interception" and not done.all():
            weight = np.where(done, 0.0, weight)
        chosen = rng.choice(len(weight), size=count, p=weight / weight.sum())
        index = np.minimum(self._tick + np.arange(ticks + 1), self.positions.shape[1] - 1)
        paths = self.positions[chosen][:, index]
        completed = self.completed_tick[chosen] - self._tick
        completed = np.where(completed > 0, completed, -1).astype(np.int32)
        if self._seen is not None:
            since, point = self._seen
            seconds = (self._tick - since + np.arange(ticks + 1)) * self.scenario.step_seconds
            fade = np.maximum(0.0, 1.0 - seconds / self.options.offset_seconds)
            offset = point - self.positions[chosen, min(since, self.positions.shape[1] - 1)]
            paths = paths + fade[None, :, None] * offset[:, None, :]
        return SampledPaths(paths, completed)

    def occupancy(self) -> tuple[GridMap, NDArray[np.float64]]:
        grid = GridMap.from_scenario(self.scenario, self.options.cell_metres)
        return grid, np.asarray(
            np.bincount(grid.cells_of(self._now()), weights=self.weights, minlength=grid.cells), dtype=np.float64
        )
