"""What was seen, and where nothing was seen, as likelihoods of cells and modes."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tab_marl.field.belief import BeliefOptions, disc_cover, mode_likelihood, position_kernel
from tab_marl.field.chain import ProductChain
from tab_marl.world.scenario import Checkpoint

if TYPE_CHECKING:
    from tab_marl.field.problem import FieldProblem

Floats = NDArray[np.float64]


class ImpossibleEvidence(ValueError):
    """An observation that the field gives probability 0, given the earlier ones."""


class NearZeroEvidence(UserWarning):
    """An observation that the field holds for all but impossible, given the earlier ones."""


@dataclass(frozen=True, eq=False)
class Seen:
    """The adversary is seen at a point, as `ProductBelief.condition_on_seen` reads it."""

    tick: int
    point: tuple[float, ...]
    """Metres."""
    heading: float | None = None
    """Radians."""
    speed_fraction: float | None = None
    """Speed / full speed."""

    def likelihood(self, problem: FieldProblem, chain: ProductChain, options: BeliefOptions) -> tuple[Floats, Floats]:
        """(``[C]`` of the cells, ``[M]`` of the modes)."""
        point = np.asarray(self.point, dtype=np.float64)
        if point.shape != chain.centres.shape[1:] or not np.isfinite(point).all():
            raise ValueError(f"{self}: point must be {chain.centres.shape[1]} finite numbers, metres")
        away = ((chain.centres - point) ** 2).sum(axis=1)
        cells = position_kernel(away - away.min(), options.position_cells * chain.cell_metres)
        return cells, mode_likelihood(chain, options, self.heading, self.speed_fraction)

    def __str__(self) -> str:
        return f"the sighting at {tuple(round(float(p), 3) for p in self.point)} at tick {self.tick}"


@dataclass(frozen=True, eq=False)
class Unseen:
    """Nobody sees the adversary where the view reaches."""

    tick: int
    cover: ArrayLike | None = None
    """``[C]`` how much of each cell is in view, 0 to 1 or bool. None: the cameras (in space: the sensors) of the checkpoints."""
    ego: tuple[float, ...] | None = None
    """Metres; it is not within `radius_metres` of this point either."""
    radius_metres: float = 0.0

    def likelihood(self, problem: FieldProblem, chain: ProductChain, options: BeliefOptions) -> tuple[Floats, Floats]:
        """(``[C]`` of the cells, ``[M]`` of the modes)."""
        cover = camera_cover(problem, chain) if self.cover is None else np.asarray(self.cover, dtype=np.float64)
        if cover.shape != (chain.cells,) or not ((cover >= 0) & (cover <= 1)).all():
            raise ValueError(f"{self}: cover must be [{chain.cells}] with entries in 0..1, one per cell")
        hidden = 1.0 - cover
        if self.ego is not None and self.radius_metres > 0:
            hidden = hidden * (1.0 - disc_cover(chain, self.ego, self.radius_metres))
        return np.clip(hidden, 0.0, 1.0), np.ones(chain.modes)

    def __str__(self) -> str:
        return f"not seeing it at tick {self.tick}"


@dataclass(frozen=True, eq=False)
class Likelihood:
    """Any other observation of the cell: how likely it is in each."""

    tick: int
    cells: ArrayLike
    """``[C]`` >= 0, up to a common factor (which then multiplies the evidence)."""

    def likelihood(self, problem: FieldProblem, chain: ProductChain, options: BeliefOptions) -> tuple[Floats, Floats]:
        """(``[C]`` of the cells, ``[M]`` of the modes)."""
        cells = np.asarray(self.cells, dtype=np.float64)
        if cells.shape != (chain.cells,) or not (np.isfinite(cells) & (cells >= 0)).all():
            raise ValueError(f"{self}: cells must be [{chain.cells}], finite and >= 0")
        return cells, np.ones(chain.modes)

    def __str__(self) -> str:
        return f"the observation at tick {self.tick}"


Observation = Seen | Unseen | Likelihood


def camera_cover(problem: FieldProblem, chain: ProductChain) -> Floats:
    """``[C]``: about how much of each cell some checkpoint's camera sees."""
    if problem.scenario is None:
        raise ValueError("Unseen needs `cover`: this problem has no scenario whose cameras could be meant")
    cover = np.zeros(chain.cells)
    for checkpoint in problem.scenario.checkpoints:
        sensor = checkpoint.camera if isinstance(checkpoint, Checkpoint) else checkpoint.sensor
        cover = np.maximum(cover, disc_cover(chain, sensor.centre, sensor.radius))
    return cover
