"""Adversaries that take random moves: uniform ones (S-POMCP), and moves learned by counting (MLE-POMCP).

Both are particle filters over (point, mission location, clocks). A sighting moves every particle to where the adversary
was seen, weighted by how near it had been predicted, so the belief cannot be lost.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tab_marl.planning.models import walk_kernels as kernels
from tab_marl.planning.models.interface import SampledPaths, Sighting, TickObservation
from tab_marl.planning.models.mission_map import MissionMap
from tab_marl.planning.models.sight import noticed
from tab_marl.world.grid import GridMap
from tab_marl.world.regions import sample_in

SIGHT_METRES = 0.08
"""How far a prediction one tick ahead may reasonably be off."""
GONE_SHARE = 0.02
"""When fewer than this share of the particles agree with an observation, the rest are kept as well (a fallback)."""


@dataclass
class MoveCounts:
    """How often a move of each kind was seen: angle from the mission's way ahead x share of full speed.

    Maximum likelihood of a distribution over bins is the share of each bin. `prior_moves` moves are added before any was
    seen: uniform ones, so that everything stays possible, and a share that the mission's constraints make likeliest,
    straight along the way at full speed.
    """

    angles: int = 16
    speeds: int = 4
    prior_moves: float = 8.0
    along_share: float = 0.0
    """Of the prior moves."""
    counts: NDArray[np.float64] = field(default_factory=lambda: np.empty(0))
    """``[angles, speeds]``."""

    def __post_init__(self) -> None:
        if self.counts.size == 0:
            self.counts = np.zeros((self.angles, self.speeds))
        if self.counts.shape != (self.angles, self.speeds) or not (self.counts >= 0).all():
            raise ValueError(
                f"MoveCounts.counts has shape {self.counts.shape}, must be ({self.angles}, {self.speeds}) and >= 0"
            )

    def cumulative(self) -> NDArray[np.float64]:
        """``[angles * speeds]`` cumulative probabilities."""
        edges = np.arange(self.speeds + 1) / self.speeds
        uniform = np.tile(np.diff(edges**2) / self.angles, (self.angles, 1))
        prior = self.prior_moves * (1 - self.along_share) * uniform
        prior[0, -1] += self.prior_moves * self.along_share
        return np.cumsum((self.counts + prior).ravel() / (self.counts.sum() + self.prior_moves))

    def add(self, angle: float, speed_share: float, weight: float = 1.0) -> None:
        """Count a move at `angle` [rad] from the way ahead at this share of full speed."""
        a = round(angle / (2 * math.pi) * self.angles) % self.angles
        v = min(int(speed_share * self.speeds), self.speeds - 1)
        self.counts[a, v] += weight

    def to_json(self) -> dict[str, Any]:
        """Plain lists and numbers."""
        return {"prior_moves": self.prior_moves, "along_share": self.along_share, "counts": self.counts.tolist()}

    @classmethod
    def from_json(cls, state: Mapping[str, Any]) -> MoveCounts:
        """The inverse of `to_json`. Raises ValueError if the counts do not form a table."""
        counts = np.asarray(state["counts"], dtype=np.float64)
        if counts.ndim != 2:
            raise ValueError(f"MoveCounts state: counts has {counts.ndim} dimensions, must have 2 (angles, speeds)")
        return cls(counts.shape[0], counts.shape[1], float(state["prior_moves"]), float(state["along_share"]), counts)


class Walker:
    """A particle belief over an adversary that draws every move anew."""

    def __init__(
        self,
        mission_map: MissionMap,
        moves: MoveCounts | None = None,
        *,
        feasible: bool = False,
        learns: bool = False,
        particles: int = 3000,
    ) -> None:
        """`feasible`: only moves after which the mission can still be completed in time. `learns`: count what is seen."""
        self.map = mission_map
        self.moves = MoveCounts() if moves is None else moves
        self.feasible, self.learns, self.particles = feasible, learns, particles
        self.fallbacks = 0
        self.log_evidence = 0.0
        self._cumulative = self.moves.cumulative()
        self._last: tuple[int, Sighting] | None = None
        self._xy = np.empty((0, 2))
        self._location = np.empty(0, dtype=np.int32)
        self._clocks = np.empty((0, 3), dtype=np.int32)

    def start(self, observation: TickObservation, rng: np.random.Generator) -> None:
        scenario, n = self.map.scenario, self.particles
        self.fallbacks, self._last, self.log_evidence = 0, None, 0.0
        self._cumulative = self.moves.cumulative()
        self._xy = sample_in(scenario.adversary_start, rng, n)
        if observation.sighting is not None:
            self._xy[:] = observation.sighting.x, observation.sighting.y
        self._location = np.full(n, self.map.automaton.initial, dtype=np.int32)
        self._clocks = np.full((n, 3), -1, dtype=np.int32)
        self._read_labels()
        if observation.sighting is None:
            self._forget_contradicted(observation, rng)
        self._remember(observation)

    def observe(self, observation: TickObservation, rng: np.random.Generator) -> None:
        before = (self._xy.copy(), self._location.copy(), self._clocks.copy())
        self._learn(observation)
        self._walk(1, rng)
        if observation.sighting is None:
            self._forget_contradicted(observation, rng)
        else:
            self._take_sighting(observation, before, rng)
        self._remember(observation)

    def sample(self, count: int, ticks: int, rng: np.random.Generator) -> SampledPaths:
        live = np.flatnonzero((self._location != -1) | (self.map.scenario.ego_task != "interception"))
        chosen = rng.choice(live if len(live) else len(self._xy), size=count)
        kept = self._xy, self._location, self._clocks
        self._xy, self._location, self._clocks = (array[chosen] for array in kept)
        positions, completed = self._walk(ticks, rng)
        self._xy, self._location, self._clocks = kept
        return SampledPaths(positions, completed)

    def occupancy(self) -> tuple[GridMap, NDArray[np.float64]]:
        grid = self.map.grid
        cells = grid.cells_of(self._xy)
        return grid, np.bincount(cells, minlength=grid.cells) / len(cells)

    def learned_state(self) -> dict[str, Any] | None:
        """What was learned so far, as plain JSON values; None if this model does not learn."""
        return self.moves.to_json() if self.learns else None

    def _walk(self, ticks: int, rng: np.random.Generator) -> tuple[NDArray[np.float64], NDArray[np.int32]]:
        m, n = self.map, len(self._xy)
        positions = np.empty((n, ticks + 1, 2))
        completed = np.empty(n, dtype=np.int32)
        x, y = self._xy[:, 0].copy(), self._xy[:, 1].copy()
        kernels.walk(
            x, y, self._location, self._clocks, self._cumulative, self.moves.speeds, self.feasible, m.mission_latest,
            m.reach_metres, m.rules, m.ways, m.ground, positions, completed, rng,
        )  # fmt: skip
        self._xy = np.stack([x, y], axis=1)
        return positions, completed

    def _read_labels(self) -> None:
        x, y = np.ascontiguousarray(self._xy.T)
        kernels.read_labels(x, y, self._location, self._clocks, self.map.rules, self.map.ground)

    def _forget_contradicted(self, observation: TickObservation, rng: np.random.Generator) -> None:
        """Drop particles in a camera disc (it would have been seen) or within reach of the ego (it would be over)."""
        possible = ~noticed(self.map.scenario, self._xy, observation.ego)
        weight = possible.astype(np.float64)
        self.log_evidence += math.log(max(float(possible.mean()), GONE_SHARE))
        if possible.mean() < GONE_SHARE:
            self.fallbacks += 1
            weight += GONE_SHARE
        self._resample(weight, rng)

    def _take_sighting(
        self,
        observation: TickObservation,
        before: tuple[NDArray[np.float64], NDArray[np.int32], NDArray[np.int32]],
        rng: np.random.Generator,
    ) -> None:
        """Weight particles by how near they came, then put them where the adversary was seen and read the label there."""
        seen = observation.sighting
        assert seen is not None
        self.log_evidence = 0.0
        travelled = seen.speed * seen.age_seconds
        point = np.array([seen.x + travelled * math.cos(seen.theta), seen.y + travelled * math.sin(seen.theta)])
        gap = np.hypot(*(self._xy - point).T)
        # If all are far off, the nearest few decide.
        width = max(SIGHT_METRES, float(np.quantile(gap, GONE_SHARE)))
        self.fallbacks += width > 5 * SIGHT_METRES
        self._location, self._clocks = before[1], before[2]
        if seen.age_seconds == 0:
            self._xy = np.tile(point, (self.particles, 1))
        else:
            self._xy = point + rng.normal(0.0, 0.5 * travelled / 2 + 0.01, (self.particles, 2))
        for u in np.unique(self._location):
            mask = self.map.label(int(u), (seen.x, seen.y), observation.track)
            members = np.flatnonzero(self._location == u)
            location, clocks = self._location[members], self._clocks[members]
            kernels.read_same_label(location, clocks, mask, self.map.rules)
            self._location[members], self._clocks[members] = location, clocks
        self._resample(np.exp(-0.5 * (gap / width) ** 2), rng)

    def _resample(self, weight: NDArray[np.float64], rng: np.random.Generator) -> None:
        """Systematic resampling."""
        if weight.min() == weight.max():
            return
        edges = np.cumsum(weight)
        at = (np.arange(len(weight)) + rng.random()) / len(weight) * edges[-1]
        chosen = np.minimum(np.searchsorted(edges, at, side="right"), len(weight) - 1)
        self._xy, self._location, self._clocks = self._xy[chosen], self._location[chosen], self._clocks[chosen]

    def _remember(self, observation: TickObservation) -> None:
        self._last = (observation.tick, observation.sighting) if observation.seen_now and observation.sighting else None

    def _learn(self, observation: TickObservation) -> None:
        """Count the move between two sightings one tick apart, shared among the locations the mission may be in."""
        seen, last = observation.sighting, self._last
        if not self.learns or seen is None or last is None or not observation.seen_now:
            return
        if last[0] != observation.tick - 1:
            return
        x, y = last[1].x, last[1].y
        dx, dy = seen.x - x, seen.y - y
        share = math.hypot(dx, dy) / self.map.reach_metres
        locations, numbers = np.unique(self._location[self._location >= 0], return_counts=True)
        for location, number in zip(locations, numbers, strict=True):
            ahead, _gap = kernels.way_angle(x, y, int(location), self.map.ways)
            self.moves.add(math.atan2(dy, dx) - ahead, share, number / numbers.sum())
        self._cumulative = self.moves.cumulative()
