"""A guard against believing too much: any adversary model, mixed with "it may be anywhere, and goes straight for it".

A model that is sure of a wrong path sends the ego away from the one place worth guarding. The guard holds a second
hypothesis with a small prior: the adversary is where it is seen, or at any point that it could have reached unseen since,
and takes the shortest path from there. Bayes' rule weighs it up as observations contradict the model, and down never below
the prior.
"""

from __future__ import annotations

import math
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from tab_marl.planning.models import walk_kernels as kernels
from tab_marl.planning.models.interface import AdversaryModel, SampledPaths, TickObservation
from tab_marl.planning.models.mission_map import MissionMap
from tab_marl.planning.models.sight import noticed
from tab_marl.world.grid import GridMap


class EvidentModel(AdversaryModel, Protocol):
    """A model that says how well it foresaw what was observed."""

    @property
    def log_evidence(self) -> float:
        """Log-likelihood of the observations since the last sighting (not included)."""


class Guarded:
    """A model and its guard."""

    def __init__(self, model: EvidentModel, mission_map: MissionMap, prior: float) -> None:
        if not 0 < prior < 1:
            raise ValueError(f"the guard's prior is {prior}, must lie strictly between 0 and 1")
        self.model, self.map, self.prior = model, mission_map, prior
        self._seen_tick = 0
        self._tick = 0
        self._location = 0
        self._clocks = np.full(3, -1, dtype=np.int32)
        self._metres = np.empty(0)
        self._possible: NDArray[np.int64] = np.empty(0, dtype=np.int64)

    @property
    def fallbacks(self) -> int:
        return self.model.fallbacks

    @property
    def share(self) -> float:
        """Probability of the second hypothesis."""
        if len(self._possible) == 0:
            return 0.0
        odds = (1.0 - self.prior) / self.prior * math.exp(min(0.0, self.model.log_evidence))
        return 1.0 / (1.0 + odds)

    def start(self, observation: TickObservation, rng: np.random.Generator) -> None:
        self.model.start(observation, rng)
        grid, scenario = self.map.grid, self.map.scenario
        self._location, self._clocks = self.map.automaton.initial, np.full(3, -1, dtype=np.int32)
        inside = np.flatnonzero(grid.inside(scenario.adversary_start))
        sources = inside if len(inside) else grid.cells_of([scenario.adversary_start.centre])
        self._metres = grid.distances(sources)
        self._seen_tick = self._tick = 0
        self._read(*grid.centres[sources[0]])
        self._update(observation)

    def observe(self, observation: TickObservation, rng: np.random.Generator) -> None:
        self.model.observe(observation, rng)
        self._tick = observation.tick
        if observation.sighting is None and self._location >= 0:
            self._clocks += 1
        self._update(observation)

    def sample(self, count: int, ticks: int, rng: np.random.Generator) -> SampledPaths:
        anywhere = int(rng.binomial(count, self.share))
        if anywhere == 0:
            return self.model.sample(count, ticks, rng)
        positions = np.empty((anywhere, ticks + 1, 2))
        completed = np.empty(anywhere, dtype=np.int32)
        m, locations, states = self.map, np.empty(ticks + 1, dtype=np.int32), np.empty((ticks + 1, 3), dtype=np.int32)
        cells = rng.choice(self._possible, size=anywhere)
        points = m.grid.centres[cells] + (rng.random((anywhere, 2)) - 0.5) * m.grid.cell_metres
        for i, (x, y) in enumerate(points):
            completed[i] = kernels.follow_way(
                x, y, self._location, self._clocks, 0, 1.0, m.reach_metres, m.rules, m.ways, m.ground,
                positions[i], locations, states,
            )  # fmt: skip
        if self._tick > m.mission_latest:  # too late for any mission: it just drives about
            completed[:] = -1
            for i in range(anywhere):
                kernels.wander(positions[i], 0, m.reach_metres, m.ground, rng)
        if anywhere == count:
            return SampledPaths(positions, completed)
        usual = self.model.sample(count - anywhere, ticks, rng)
        return SampledPaths(
            np.concatenate([usual.positions, positions]), np.concatenate([usual.completed_tick, completed])
        )

    def occupancy(self) -> tuple[GridMap, NDArray[np.float64]]:
        grid, usual = self.model.occupancy()
        share = self.share
        if share == 0.0:
            return grid, usual
        anywhere = np.bincount(grid.cells_of(self.map.grid.centres[self._possible]), minlength=grid.cells)
        return grid, (1 - share) * usual + share * anywhere / anywhere.sum()

    def learned_state(self) -> dict[str, Any] | None:
        learned: dict[str, Any] | None = getattr(self.model, "learned_state", lambda: None)()
        return learned

    def _read(self, x: float, y: float, track: tuple[tuple[float, float], ...] = ()) -> None:
        mask = self.map.label(self._location, (x, y), track)
        self._location = int(kernels.read_label(self._location, self._clocks, mask, self.map.rules))

    def _update(self, observation: TickObservation) -> None:
        """Where it could be: within reach since it was last seen, under no camera and not beside the ego."""
        grid, scenario = self.map.grid, self.map.scenario
        seen = observation.sighting
        if seen is not None:
            self._metres = grid.distances(grid.cells_of([(seen.x, seen.y)]))
            self._seen_tick = observation.tick
            if observation.tick > 0:
                self._read(seen.x, seen.y, observation.track)
        if self._location < 0:
            self._possible = np.empty(0, dtype=np.int64)
            return
        if observation.seen_now and seen is not None:
            self._possible = grid.cells_of([(seen.x, seen.y)]).astype(np.int64)
            return
        reach = (observation.tick - self._seen_tick + 1) * self.map.reach_metres
        possible = self._metres <= reach
        possible &= ~noticed(scenario, grid.centres, observation.ego)
        self._possible = np.flatnonzero(possible)
