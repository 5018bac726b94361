"""The exact filter over (mission-automaton state, base state): what is known of the adversary after all seen and unseen.

Sparse in the automaton state: rows are kept only for states that hold mass. A belief that an observation contradicts
never crashes: it falls back, and counts.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tab_marl.field import kernels
from tab_marl.field.chain import ProductChain

if TYPE_CHECKING:
    from tab_marl.field.sampling import Trajectories


@dataclass(frozen=True)
class BeliefOptions:
    """How observations are read, and what is dropped."""

    position_cells: float = 0.75
    """A sighting's position kernel: standard deviation of a Gaussian, in cells."""
    wide_cells: float = 3.0
    """The same in the first fallback."""
    heading_concentration: float = 4.0
    """Von Mises concentration of a seen heading about the mode's (4: about 30 degrees)."""
    heading_floor: float = 0.05
    """Least likelihood of a mode relative to the likeliest: turning on the spot shows any heading."""
    still_fraction: float = 0.25
    """A speed below this share of full speed speaks for rest."""
    depleted: float = 1e-9
    """An observation less likely than this contradicts the belief."""
    drop_row: float = 1e-9
    """Automaton states with less mass are dropped."""
    drop_entry: float = 1e-13
    """Base states with less mass are dropped."""

    def __post_init__(self) -> None:
        for name in ("position_cells", "wide_cells", "depleted"):
            if not getattr(self, name) > 0:
                raise ValueError(f"BeliefOptions.{name} is {getattr(self, name)}, must be > 0")
        for name in ("heading_concentration", "heading_floor", "drop_row", "drop_entry"):
            if not getattr(self, name) >= 0:
                raise ValueError(f"BeliefOptions.{name} is {getattr(self, name)}, must be >= 0")


EXACT = BeliefOptions(drop_row=0.0, drop_entry=0.0)
"""Nothing dropped."""


class ProductBelief:
    """Probability mass on (q, s), normalised after every call."""

    bridges = True
    """Whether the chain's own kernel moves it; else `sample_paths` asks the belief for its futures."""

    def __init__(self, chain: ProductChain, options: BeliefOptions | None = None) -> None:
        """The belief at tick 0: cells by `chain.start`, modes and feasibility by h (the law P(s0) = mu0 binds cells)."""
        self.chain = chain
        self.options = options or BeliefOptions()
        self.fallbacks = 0
        """How often an observation contradicted the belief."""
        self.log_evidence = 0.0
        """Log-likelihood of the observations so far; -inf once one was contradicted."""
        self.automaton_states: NDArray[np.int32]
        """``[n]`` automaton states with mass, rising."""
        self.masses: NDArray[np.float64]
        """``[n, S]``."""
        self._previous: tuple[NDArray[np.int32], NDArray[np.float64]]
        self._start()

    def copy(self) -> ProductBelief:
        twin = object.__new__(ProductBelief)
        twin.__dict__.update(self.__dict__)
        twin.masses = self.masses.copy()
        return twin

    def _start(self) -> None:
        chain = self.chain
        per_cell = chain.delta[chain.initial, chain.labels]
        tilted = np.zeros((chain.cells, chain.modes))
        for q in np.unique(per_cell[chain.start > 0]):
            here = np.flatnonzero((per_cell == q) & (chain.start > 0))
            h = chain.value[q].reshape(chain.cells, chain.modes)[here].astype(np.float64)
            if q == chain.accepting:
                h = np.ones_like(h)
            share = chain.first_mode_shares * h * (chain.factor[chain.initial, chain.labels[here]] > 0)[:, None]
            norm = share.sum(axis=1, keepdims=True)
            tilted[here] = np.where(norm > 0, share / np.maximum(norm, 1e-300), 0.0)
        mass = tilted * chain.start[:, None]
        if mass.sum() <= 0:  # no start can complete the mission: the reference process
            mass = chain.start[:, None] * chain.first_mode_shares
        self._set_by_cell(per_cell, (mass / mass.sum()).ravel())
        # Before tick 0 nothing was read: a contradiction then restarts from the initial state.
        self._previous = (np.array([chain.initial], dtype=np.int32), np.ones(1))

    def _set_by_cell(self, automaton_state_of_cell: NDArray[np.int32], mass: NDArray[np.float64]) -> None:
        of_state = np.repeat(automaton_state_of_cell, self.chain.modes)
        self.automaton_states = np.unique(of_state[mass > 0]).astype(np.int32)
        self.masses = np.where(of_state == self.automaton_states[:, None], mass, 0.0)

    def predict(self) -> None:
        """One tick passes."""
        chain, options = self.chain, self.options
        active = self.automaton_states
        totals = self.masses.sum(axis=1)
        keep = totals > options.drop_row
        if not keep.all() and keep.any():
            active, totals, self.masses = active[keep], totals[keep], self.masses[keep]
        self._previous = (active, totals)
        following = np.unique(chain.delta[active]).astype(np.int32)
        slot = np.full(len(chain.delta), -1, dtype=np.int64)
        slot[following] = np.arange(len(following))
        rows = np.zeros((len(following), chain.states))
        kernels.push_all(active, self.masses, options.drop_entry, chain, slot, rows)
        totals = rows.sum(axis=1)
        used = totals > options.drop_row
        if not used.all() and used.any():
            following, rows, totals = following[used], rows[used], totals[used]
        rows /= totals.sum()
        self.automaton_states, self.masses = following, rows

    def condition_on_seen(
        self, point: ArrayLike, heading: float | None = None, speed_fraction: float | None = None
    ) -> bool:
        """The adversary is seen at `point` (x, y) metres.

        Args:
            heading: radians, if seen; weighs the modes.
            speed_fraction: speed / full speed, if seen: tells rest from motion.
        Returns:
            False if the belief had to fall back.
        """
        chain, options = self.chain, self.options
        away = ((chain.centres - np.asarray(point, dtype=np.float64)) ** 2).sum(axis=1)
        nearest = float(away.min())  # relative to the nearest cell: a point inside a wall is the wall's edge
        modes = mode_likelihood(chain, options, heading, speed_fraction)
        for cells in (options.position_cells, options.wide_cells):
            likelihood = position_kernel(away - nearest, cells * chain.cell_metres)
            if self._reweigh(likelihood, modes):
                if cells != options.position_cells:
                    self._fell_back()
                return cells == options.position_cells
        self._restart(position_kernel(away - nearest, options.position_cells * chain.cell_metres), modes)
        self._fell_back()
        return False

    def condition_on_unseen(
        self, camera_cover: ArrayLike | None = None, ego: ArrayLike | None = None, radius_metres: float = 0.0
    ) -> bool:
        """No camera sees the adversary and the ego has not met it.

        Args:
            camera_cover: ``[C]`` how much of each cell some camera sees, 0 to 1 (or bool).
            ego: (x, y) metres; the adversary is not within `radius_metres` of it (edge softened over one cell).
        Returns:
            False if the belief had to fall back (all its mass lay in view): then it stays as it was.
        """
        chain = self.chain
        visible = np.zeros(chain.cells) if camera_cover is None else np.asarray(camera_cover, dtype=np.float64)
        if visible.shape != (chain.cells,):
            raise ValueError(f"camera_cover has shape {visible.shape}, must be [{chain.cells}], one entry per cell")
        hidden = 1.0 - visible
        if ego is not None and radius_metres > 0:
            hidden = hidden * (1.0 - disc_cover(chain, ego, radius_metres))
        if self._reweigh(np.clip(hidden, 0.0, 1.0), np.ones(chain.modes)):
            return True
        self._fell_back()
        return False

    def _fell_back(self) -> None:
        self.fallbacks += 1
        self.log_evidence = -np.inf

    def _reweigh(self, cell_weight: NDArray[np.float64], mode_weight: NDArray[np.float64]) -> bool:
        """Multiply by a likelihood and normalise; leave the belief as it was and return False if hardly any is left."""
        masses = self.masses.copy()
        totals = kernels.reweight(masses, np.ascontiguousarray(cell_weight), mode_weight)
        total = float(totals.sum())
        if not total > self.options.depleted:
            return False
        used = totals > self.options.drop_row * total
        if not used.all():
            masses, self.automaton_states = masses[used], self.automaton_states[used]
        masses /= total
        self.masses = masses
        self.log_evidence += float(np.log(total))
        return True

    def _restart(self, cell_weight: NDArray[np.float64], mode_weight: NDArray[np.float64]) -> None:
        """Start anew at a sighting, from every automaton state possible a tick ago; feasible states first."""
        chain = self.chain
        states, totals = self._previous
        base = (cell_weight[:, None] * (chain.mode_shares * mode_weight)).ravel()
        following = chain.delta[states][:, chain.labels]  # [n, C]
        targets = np.unique(following[:, cell_weight > 0]).astype(np.int32)
        rows = np.zeros((len(targets), chain.states))
        for i, q in enumerate(targets):
            per_cell = totals @ (following == q)
            rows[i] = base * np.repeat(per_cell, chain.modes)
        absorbing = (targets == chain.accepting) | (targets == chain.rejecting)
        possible = np.where(absorbing[:, None], (targets == chain.accepting)[:, None], chain.norm[targets] > 0)
        feasible = rows * possible
        masses = feasible if feasible.sum() > 0 else rows
        used = masses.sum(axis=1) > 0
        self.automaton_states = targets[used]
        self.masses = masses[used] / masses.sum()

    def cell_marginal(self) -> NDArray[np.float64]:
        """``[C]``: probability of each cell."""
        out = np.zeros(self.chain.cells)
        kernels.cell_marginal(self.masses, self.chain.modes, out)
        return out

    def automaton_marginal(self) -> NDArray[np.float64]:
        """``[Q]``."""
        out = np.zeros(len(self.chain.delta))
        out[self.automaton_states] = self.masses.sum(axis=1)
        return out

    def futures(self, rng: np.random.Generator, count: int, ticks: int, jitter: bool) -> Trajectories:
        """`sample_paths` for beliefs that do not bridge."""
        raise NotImplementedError

    @property
    def completed(self) -> float:
        """Probability that the mission is complete."""
        return float(self.masses[self.chain.complete[self.automaton_states]].sum())


def mode_likelihood(
    chain: ProductChain, options: BeliefOptions, heading: float | None, speed_fraction: float | None
) -> NDArray[np.float64]:
    """``[M]``: of a seen heading and speed in each mode."""
    likelihood = np.ones(chain.modes)
    moving = np.isfinite(chain.headings)
    if not moving.any():
        return likelihood
    if heading is not None:
        peaked = np.exp(options.heading_concentration * (np.cos(heading - chain.headings[moving]) - 1))
        likelihood[moving] = np.maximum(peaked, options.heading_floor)
        likelihood[~moving] = likelihood[moving].mean()  # at rest any heading is equally likely
    if speed_fraction is not None and not moving.all():
        still = speed_fraction < options.still_fraction
        likelihood[moving if still else ~moving] *= options.heading_floor
    return likelihood


def position_kernel(squared_metres: NDArray[np.float64], deviation: float) -> NDArray[np.float64]:
    """Gaussian, cut off at 4 deviations."""
    return np.where(squared_metres <= 16 * deviation**2, np.exp(-0.5 * squared_metres / deviation**2), 0.0)


def disc_cover(chain: ProductChain, centre: ArrayLike, radius_metres: float) -> NDArray[np.float64]:
    """``[C]``: about how much of each cell a disc covers, 0 to 1, from the distance of the cell's centre to its edge."""
    away = np.linalg.norm(chain.centres - np.asarray(centre, dtype=np.float64), axis=1)
    return np.clip((radius_metres - away) / chain.cell_metres + 0.5, 0.0, 1.0)
