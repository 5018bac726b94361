"""Several models of one adversary, each believed as far as it foresaw what was observed (Bayesian model averaging)."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tab_marl.planning.models.guarded import EvidentModel
from tab_marl.planning.models.interface import SampledPaths, TickObservation
from tab_marl.world.grid import GridMap


class Mixture:
    """A prior over models; the weights are the posterior, given what was observed since the last sighting.

    A sighting makes all models agree on where the adversary is, so it starts the count anew: how well models foresee is then
    a matter of where it goes next.
    """

    def __init__(self, models: Sequence[EvidentModel], priors: ArrayLike) -> None:
        """`priors`: one per model, > 0, sum 1. Raises ValueError."""
        self.models = tuple(models)
        self.priors = np.asarray(priors, dtype=np.float64)
        if self.priors.shape != (len(self.models),) or not (self.priors > 0).all() or abs(self.priors.sum() - 1) > 1e-9:
            raise ValueError(
                f"priors are {self.priors}: must be one per model ({len(self.models)}), each > 0, of sum 1"
            )

    @property
    def weights(self) -> NDArray[np.float64]:
        """``[n]``, sum 1."""
        log_weight = np.log(self.priors) + [model.log_evidence for model in self.models]
        weight = np.exp(log_weight - log_weight.max())
        return np.asarray(weight / weight.sum())

    @property
    def log_evidence(self) -> float:
        """Log-likelihood of the observations since the last sighting."""
        return float(np.logaddexp.reduce(np.log(self.priors) + [model.log_evidence for model in self.models]))

    @property
    def fallbacks(self) -> int:
        """Of the model that was contradicted least often."""
        return min(model.fallbacks for model in self.models)

    def start(self, observation: TickObservation, rng: np.random.Generator) -> None:
        for model in self.models:
            model.start(observation, rng)

    def observe(self, observation: TickObservation, rng: np.random.Generator) -> None:
        for model in self.models:
            model.observe(observation, rng)

    def sample(self, count: int, ticks: int, rng: np.random.Generator) -> SampledPaths:
        counts = rng.multinomial(count, self.weights)
        parts = [model.sample(int(n), ticks, rng) for model, n in zip(self.models, counts, strict=True) if n]
        return SampledPaths(
            np.concatenate([part.positions for part in parts]), np.concatenate([part.completed_tick for part in parts])
        )

    def occupancy(self) -> tuple[GridMap, NDArray[np.float64]]:
        """On the first model's grid; what another grid says of a cell is spread evenly over the cells within it."""
        grid, total = self.models[0].occupancy()
        weights = self.weights
        total = weights[0] * total
        for model, weight in zip(self.models[1:], weights[1:], strict=True):
            other, occupancy = model.occupancy()
            within = other.cells_of(grid.centres)
            spread = occupancy[within] / np.bincount(within, minlength=other.cells)[within]
            total = total + weight * spread / max(spread.sum(), 1e-300)
        return grid, np.asarray(total / total.sum())
