"""What a planner tells its adversary model, and what it asks of it. Everything else is common to all planners."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from tab_marl.world.grid import GridMap


@dataclass(frozen=True)
class Sighting:
    """The adversary as a camera reported it: metres, rad, m/s."""

    x: float
    y: float
    theta: float
    speed: float
    age_seconds: float = 0.0
    """How long before the tick it was seen; then it was out of all cameras again at the tick itself."""


@dataclass(frozen=True)
class TickObservation:
    """What the ego knows at a tick: where it is itself (so the adversary is not within reach), and what cameras saw."""

    tick: int
    ego: tuple[float, float]
    sighting: Sighting | None = None
    """None: in no camera disc, neither at the tick nor since the one before."""
    track: tuple[tuple[float, float], ...] = ()
    """Where it was seen at each control step since the tick before, oldest first: it may have visited a place meanwhile."""

    @property
    def seen_now(self) -> bool:
        """Whether the adversary is in a camera disc at the tick itself."""
        return self.sighting is not None and self.sighting.age_seconds == 0.0


class SampledPaths(NamedTuple):
    """K adversary futures; tick 0 is now."""

    positions: NDArray[np.float64]
    """``[K, H + 1, 2]`` metres."""
    completed_tick: NDArray[np.int32]
    """``[K]``: when the mission is completed, or -1."""


class AdversaryModel(Protocol):
    """One belief about the adversary during one episode."""

    @property
    def fallbacks(self) -> int:
        """How often an observation contradicted everything the model held possible (it then recovered somehow)."""

    def start(self, observation: TickObservation, rng: np.random.Generator) -> None:
        """Forget everything of earlier episodes but what was learned, and take the observation of tick 0."""

    def observe(self, observation: TickObservation, rng: np.random.Generator) -> None:
        """One tick later: predict, then condition on what was seen and on what was not."""

    def sample(self, count: int, ticks: int, rng: np.random.Generator) -> SampledPaths:
        """Draw futures given everything observed so far.

        Paths whose mission is completed already are left out as long as others are possible: no decision changes them.
        If none is possible the hunt goes on, with `completed_tick` -1. In ego tasks other than interception the mission's
        completion changes nothing, and no path is left out.
        """

    def occupancy(self) -> tuple[GridMap, NDArray[np.float64]]:
        """A grid and the probability ``[S]`` of the adversary being in each of its cells now."""
