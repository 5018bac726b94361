"""Sampled adversary futures kept from one decision to the next, as long as they agree with what was observed since.

A path drawn from the belief at one tick, given that it agrees with the observation of the next, is a draw from the belief
there. So only what an observation contradicts has to be drawn anew (and a share besides, against unlucky draws).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tab_marl.planning.models.interface import AdversaryModel, SampledPaths, TickObservation
from tab_marl.planning.models.sight import noticed
from tab_marl.world.scenario import Scenario

SPARE_TICKS = 20
"""Paths are drawn so much longer than needed, so that they last for as many ticks."""


@dataclass(frozen=True)
class ReuseOptions:
    """How long sampled paths are kept."""

    renewed_share: float = 0.15
    """So much of them is replaced at every decision; 1: nothing is kept."""

    def __post_init__(self) -> None:
        if not 0 < self.renewed_share <= 1:
            raise ValueError(f"ReuseOptions.renewed_share is {self.renewed_share}, must lie in (0, 1]")


class ScenarioSet:
    """The K paths of one episode."""

    def __init__(self, scenario: Scenario, count: int, options: ReuseOptions | None = None) -> None:
        self.scenario, self.count = scenario, count
        self.options = options or ReuseOptions()
        self._positions: NDArray[np.float64] = np.empty((0, 1, 2))
        self._completed = np.empty(0, dtype=np.int32)

    def advance(self, observation: TickObservation) -> None:
        """A tick has passed: paths move on, and those that disagree with the observation, or are over, are dropped.

        After a sighting all are dropped.
        """
        if observation.sighting is not None or self._positions.shape[1] < 2:
            self._positions, self._completed = np.empty((0, 1, 2)), np.empty(0, dtype=np.int32)
            return
        here = self._positions[:, 1]
        keep = ~noticed(self.scenario, here, observation.ego)
        if self.scenario.ego_task == "interception":
            keep &= (self._completed < 0) | (self._completed > 1)
        self._positions = self._positions[keep, 1:]
        self._completed = np.where(self._completed[keep] > 0, self._completed[keep] - 1, -1).astype(np.int32)

    def draw(self, model: AdversaryModel, ticks: int, ticks_left: int, rng: np.random.Generator) -> SampledPaths:
        """K paths of `ticks` ticks from now, of which the episode has `ticks_left`."""
        longest = min(ticks + SPARE_TICKS, max(ticks_left, ticks))
        kept = 0
        if self._positions.shape[1] > ticks:
            kept = min(len(self._positions), round(self.count * (1 - self.options.renewed_share)))
        fresh = model.sample(self.count - kept, longest, rng)
        if kept:
            # The oldest go first: they stand at the front.
            length = min(self._positions.shape[1], fresh.positions.shape[1])
            self._positions = np.concatenate([self._positions[-kept:, :length], fresh.positions[:, :length]])
            self._completed = np.concatenate([self._completed[-kept:], fresh.completed_tick])
        else:
            self._positions, self._completed = fresh.positions, fresh.completed_tick
        order = rng.permutation(self.count)
        completed = np.where(self._completed <= ticks, self._completed, -1)[order].astype(np.int32)
        return SampledPaths(self._positions[order, : ticks + 1], completed)
