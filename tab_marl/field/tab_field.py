"""A solved TAB-Field and the questions it answers."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from tab_marl.field import kernels
from tab_marl.field.belief import EXACT, ProductBelief
from tab_marl.field.chain import ProductChain, Table
from tab_marl.field.sampling import Trajectories, sample_paths

if TYPE_CHECKING:
    from pathlib import Path

    from matplotlib.figure import Figure

    from tab_marl.field.constraints import Tilt
    from tab_marl.field.problem import FieldProblem
    from tab_marl.field.report import FitReport

Floats = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class TabField:
    """The maximum-entropy distribution over trajectories that complete the mission: a Markov chain on (q, s)."""

    problem: FieldProblem
    bridge: ProductChain
    """The field's own law: P*(s'|s, q) = Q(s'|s) w h[q', s'] / h[q, s] (design, section 4)."""
    tilt: Tilt
    """The weights of the constraints beyond the mission."""
    fitted_transitions: Floats | None
    """``[Q, L]`` expected transitions, where the fit computed them."""
    marginal_error: float
    """Largest relative error of a constrained expectation; 0 if there was nothing to fit."""
    rounds: int
    """Backward passes made."""
    report: FitReport | None = None
    """How well soft constraints hold; None without any."""

    @property
    def chain(self) -> ProductChain:
        """What a planner filters and samples."""
        return self.bridge

    @property
    def backward(self) -> tuple[Table, Floats]:
        """(value ``[Q, S]``, log_scale ``[Q]``): h = value * exp(log_scale)."""
        return self.bridge.value, self.bridge.log_scale - np.log(float(self.bridge.value[self.bridge.accepting, 0]))

    @cached_property
    def log_partition(self) -> float:
        """sum over s0 of mu0(s0) log Z(s0), Z the tilted reference's mass of completing trajectories from s0.

        With the mission alone, the mean log-probability that the reference process completes it.
        """
        log_z = start_log_partition(self.bridge)
        used = self.bridge.start > 0
        return float(self.bridge.start[used] @ log_z[used])

    @cached_property
    def transitions(self) -> Floats:
        """``[Q, L]``: how often each transition of the automaton is taken, in expectation, until the mission ends."""
        if self.fitted_transitions is not None:
            return self.fitted_transitions
        return expected_transitions(self.bridge, self.problem.automaton.rank)

    @cached_property
    def kl_to_reference(self) -> float:
        """KL(P || Q) in nats over trajectories up to completion or failure, Q started from the same cells."""
        weights = self.tilt.log_weight()
        flux = self.transitions
        used = flux > 0
        tilted = float((flux[used] * weights[used]).sum())
        if np.isfinite(self.tilt.log_failure):
            tilted += self.tilt.log_failure * (1.0 - self.completes)
        return tilted - self.log_partition

    @property
    def completes(self) -> float:
        """Probability that the mission is ever completed: 1, or the c asked for."""
        return self.tilt.completed(self.transitions)

    @cached_property
    def branch_visits(self) -> dict[str, float]:
        """Place -> expected number of counted visits."""
        visits = self.tilt.visits(self.transitions)
        names = self.problem.branch_places or tuple(str(b) for b in range(len(visits)))
        return {names[b]: float(visits[b]) for b in range(len(visits))}

    @cached_property
    def branch_shares(self) -> dict[str, float]:
        """Place -> share of all counted visits at places that can stand for one another (1 where nothing can)."""
        from tab_marl.field.constraints import alternatives

        visits = self.tilt.visits(self.transitions)
        total = visits.copy()
        for group in alternatives(self.problem):
            total[group] = visits[group].sum()
        names = list(self.branch_visits)
        return {name: float(v / t) if t > 0 else 0.0 for name, v, t in zip(names, visits, total, strict=True)}

    @cached_property
    def occupancy_by_status(self) -> Floats:
        """``[T + 1, 2, C]``: probability of each cell at each tick with the mission under way (0) or complete (1)."""
        belief = ProductBelief(self.bridge, EXACT if self.problem.options.precision == "double" else None)
        table = np.zeros((self.problem.horizon + 1, 2, self.bridge.cells))
        for t in range(self.problem.horizon + 1):
            if t:
                belief.predict()
            for q, mass in zip(belief.automaton_states, belief.masses, strict=True):
                table[t, int(q == self.bridge.accepting)] += mass.reshape(self.bridge.cells, -1).sum(axis=1)
        return table

    @cached_property
    def occupancy(self) -> Floats:
        """``[T + 1, C]``: probability of each cell at each tick; after completion the reference process goes on."""
        return self.occupancy_by_status.sum(axis=1)

    @cached_property
    def completion_probability(self) -> Floats:
        """``[T + 1]``: probability that the mission is complete by each tick."""
        return self.occupancy_by_status[:, 1].sum(axis=1)

    def belief(self) -> ProductBelief:
        """A fresh filter at tick 0."""
        if self.problem.options.kernel == "marginal":
            from tab_marl.field.marginal import MarginalBelief

            return MarginalBelief(self)
        return ProductBelief(self.chain)

    def sample(self, rng: np.random.Generator, count: int, ticks: int | None = None) -> Trajectories:
        """Draw trajectories from the start."""
        return sample_paths(self.chain, self.belief(), rng, count, self.problem.horizon if ticks is None else ticks)

    def plot(self, path: str | Path | None = None, panels: int = 8) -> Figure:
        """Small multiples of the occupancy over time on the map; written to `path` if given. Needs matplotlib."""
        from tab_marl.field.drawing import draw_field

        return draw_field(self, path, panels)


def start_log_partition(chain: ProductChain) -> Floats:
    """``[C]``: log Z(s0) of each start cell, -inf elsewhere: the tilted reference's mass of completions from there."""
    out = np.full(chain.cells, -np.inf)
    first = chain.delta[chain.initial, chain.labels]
    table = chain.value.reshape(len(chain.value), chain.cells, chain.modes)
    peak = float(chain.value[chain.accepting, 0])
    for cell in np.flatnonzero(chain.start > 0):
        total = float(table[first[cell], cell].astype(np.float64) @ chain.mode_shares)
        factor = chain.factor[chain.initial, chain.labels[cell]]
        if total > 0 and factor > 0:
            out[cell] = np.log(total) - np.log(peak) + np.log(factor) + chain.log_scale[chain.initial]
    return out


def expected_transitions(chain: ProductChain, rank: NDArray[np.int32]) -> Floats:
    """``[Q, L]``: expected number of times each transition is taken until acceptance or rejection (forward pass).

    `rank` ``[Q]`` rises along transitions between transient states, so each of them is visited at most once.
    """
    count, symbols = chain.delta.shape
    belief = ProductBelief(chain, EXACT)
    mass = np.zeros(chain.value.shape, dtype=chain.value.dtype)
    mass[belief.automaton_states] = belief.masses
    flux = np.zeros((count, symbols))
    by_cell = belief.cell_marginal()
    flux[chain.initial] = np.bincount(chain.labels, by_cell, minlength=symbols)
    slot = np.arange(count)
    absorbing = [chain.accepting, chain.rejecting]
    slot[absorbing] = -1
    order = np.argsort(rank, kind="stable").astype(np.int32)
    kernels.forward(order[~np.isin(order, [*absorbing, chain.initial])], chain, slot, mass, flux)
    return flux
