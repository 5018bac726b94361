"""How well a model predicts where adversaries really go: log-likelihood and calibration of its occupancy.

The outcome at a moment is the cell the adversary is in, or that its mission is complete. Forecasts on any grid are scored
as densities over the same reference area, so that coarse and fine cells can be compared.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.ndimage import gaussian_filter

from tab_marl.world.grid import GridMap

Floats = NDArray[np.float64]

REFERENCE_CELL_METRES = 0.05
"""The area over which densities are taken."""
FLOOR = 0.01
"""Share of every forecast that is spread evenly over all outcomes: no finite sample rules anything out."""
BANDWIDTHS_METRES = (0.04, 0.07, 0.1, 0.15, 0.22)


@dataclass(frozen=True, eq=False)
class Forecast:
    """Where an adversary will be at one moment."""

    grid: GridMap
    mass: Floats
    """``[S]``: probability of each cell while the mission is under way."""
    completed: float
    """Probability that the mission is complete by then."""

    def __post_init__(self) -> None:
        total = float(self.mass.sum()) + self.completed
        if self.mass.shape != (self.grid.cells,) or not abs(total - 1.0) < 1e-3:
            raise ValueError(
                f"Forecast.mass has shape {self.mass.shape} and with completed sums to {total:.6g}; "
                f"must be [{self.grid.cells}] and 1"
            )

    @property
    def _outcomes(self) -> float:
        """Number of outcomes in units of the reference area, and completion."""
        return self.grid.cells * (self.grid.cell_metres / REFERENCE_CELL_METRES) ** 2 + 1.0

    def _probability(self, raw: ArrayLike, area: float) -> Floats:
        return (1.0 - FLOOR) * np.asarray(raw, dtype=np.float64) / area + FLOOR / self._outcomes

    def log_score(self, points: ArrayLike, completed: ArrayLike) -> Floats:
        """``[N]`` nats: log-probability of each true outcome (completed, or the point ``[N, 2]`` in metres)."""
        area = (self.grid.cell_metres / REFERENCE_CELL_METRES) ** 2
        inside = self._probability(self.mass[self.grid.cells_of(points)], area)
        return np.asarray(np.log(np.where(completed, self._probability(self.completed, 1.0), inside)))

    def covered(
        self, points: ArrayLike, completed: ArrayLike, level: float, rng: np.random.Generator
    ) -> NDArray[np.bool_]:
        """``[N]``: whether each true outcome lies in the smallest set of outcomes that holds `level` of the forecast.

        The outcome at the set's edge is let in with the probability that makes the set hold exactly `level`.
        """
        area = (self.grid.cell_metres / REFERENCE_CELL_METRES) ** 2
        density = np.append(self._probability(self.mass, area), self._probability(self.completed, 1.0))
        weight = np.append(density[:-1] * area, density[-1])
        order = np.argsort(-density, kind="stable")
        before = np.empty(len(order))
        before[order] = np.concatenate([[0.0], np.cumsum(weight[order])[:-1]])
        outcome = np.where(completed, len(self.mass), self.grid.cells_of(points))
        share = (level - before[outcome]) / weight[outcome]
        return np.asarray(rng.random(len(outcome)) < share)


def kernel_forecast(
    grid: GridMap, points: Floats, completed: NDArray[np.bool_], weights: Floats | None = None
) -> Forecast:
    """A kernel density estimate from N sampled outcomes: points ``[N, 2]`` metres, completed ``[N]``, weights ``[N]``.

    Gaussian kernels, cut off at walls; of BANDWIDTHS_METRES the one that predicts each sample from the others best.
    """
    share = np.full(len(points), 1.0 / len(points)) if weights is None else weights / weights.sum()
    alive = ~np.asarray(completed, dtype=bool)
    done = float(share[~alive].sum())
    if done > 1.0 - 1e-12:
        return Forecast(grid, np.zeros(grid.cells), 1.0)
    cells, share = grid.cells_of(points[alive]), share[alive] / (1.0 - done)
    image = np.nan_to_num(grid.image(np.bincount(cells, weights=share, minlength=grid.cells).astype(np.float64)))
    best, table = -np.inf, np.zeros(grid.cells)
    for bandwidth in BANDWIDTHS_METRES:
        sigma = bandwidth / grid.cell_metres
        mass = gaussian_filter(image, sigma, mode="constant", truncate=4.0)[grid.row, grid.column]
        mass /= mass.sum()
        own = _peak(sigma)
        others = np.maximum(mass[cells] - share * own, 0.0) / np.maximum(1.0 - share, 1e-12)
        score = float(share @ np.log((1 - FLOOR) * others + FLOOR / grid.cells))
        if score > best:
            best, table = score, mass
    return Forecast(grid, (1.0 - done) * table, done)


def _peak(sigma: float) -> float:
    """What a kernel puts on its own cell."""
    unit = np.zeros(8 * int(np.ceil(sigma)) + 3)
    unit[len(unit) // 2] = 1.0
    return float(gaussian_filter(unit, sigma, mode="constant", truncate=4.0).max() ** 2)


def mixed(forecasts: Sequence[Forecast], weights: Sequence[float]) -> Forecast:
    """The mixture of forecasts on one grid."""
    share = np.asarray(weights, dtype=np.float64) / np.sum(weights)
    first = forecasts[0].grid
    if any(f.grid is not first and not np.array_equal(f.grid.centres, first.centres) for f in forecasts):
        raise ValueError("mixed forecasts must lie on one grid")
    mass = sum(w * f.mass for w, f in zip(share, forecasts, strict=True))
    return Forecast(forecasts[0].grid, np.asarray(mass), float(share @ [f.completed for f in forecasts]))
