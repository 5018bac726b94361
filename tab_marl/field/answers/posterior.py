"""The field given observations at any ticks: filter, smoother, evidence (forward-backward on the product)."""

from __future__ import annotations

import math
import warnings
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from tab_marl.field import kernels
from tab_marl.field.answers import smoothing_kernels
from tab_marl.field.answers.evidence import ImpossibleEvidence, NearZeroEvidence, Observation
from tab_marl.field.belief import BeliefOptions, ProductBelief

if TYPE_CHECKING:
    from tab_marl.field.constraints.events import Event
    from tab_marl.field.tab_field import TabField

Floats = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Posterior:
    """What is known at every tick, from the observations up to it (filtered) and from all of them (smoothed)."""

    field: TabField
    observations: tuple[Observation, ...]
    """By rising tick."""
    log_likelihoods: tuple[float, ...]
    """Of each observation given the earlier ones, in nats."""
    filtered: Floats
    """``[T + 1, C]`` probability of each cell given the observations up to that tick."""
    occupancy: Floats
    """``[T + 1, C]`` the same given all observations."""
    automaton_occupancy: Floats
    """``[T + 1, Q]`` probability of each automaton state given all observations."""
    options: BeliefOptions

    @property
    def log_evidence(self) -> float:
        """Log-likelihood of all observations together, in nats."""
        return float(sum(self.log_likelihoods))

    @property
    def weakest(self) -> Observation | None:
        """The observation that the field found least likely, given the earlier ones; None without observations."""
        if not self.observations:
            return None
        return self.observations[int(np.argmin(self.log_likelihoods))]

    @property
    def completion_probability(self) -> Floats:
        """``[T + 1]``: probability that the mission is complete by each tick, given all observations."""
        return np.asarray(self.automaton_occupancy[:, self.field.bridge.complete].sum(axis=1))

    def probability(self, event: Event) -> float:
        """Of an event, given all observations: P(event) P(observations | event) / P(observations)."""
        tracked = self.field.track(event)
        chance = tracked.event_probabilities[-1]
        if chance <= 0:
            return 0.0
        given = tracked.given_latest_event()
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", NearZeroEvidence)
                log_evidence = sum(log_likelihoods(given, self.observations, self.options))
        except ImpossibleEvidence:
            return 0.0
        return float(min(1.0, chance * math.exp(log_evidence - self.log_evidence)))


class _Tick(NamedTuple):
    tick: int
    states: NDArray[np.int32]
    masses: Floats


def posterior(field: TabField, observations: Sequence[Observation], options: BeliefOptions) -> Posterior:
    """Forward-backward over the horizon. Raises ImpossibleEvidence; warns NearZeroEvidence below `options.depleted`."""
    chain, horizon = field.bridge, field.problem.horizon
    observations = _sorted(observations, horizon)
    weights = _weights(field, observations, options)
    likelihoods: list[float] = []
    block = max(1, math.isqrt(horizon + 1))
    kept: dict[int, ProductBelief] = {}
    filtered = np.zeros((horizon + 1, chain.cells))
    for belief, tick in _forward(ProductBelief(chain, options), 0, horizon, observations, weights, likelihoods):
        filtered[tick] = belief.cell_marginal()
        if tick % block == 0:
            kept[tick] = belief.copy()
    smoothed = np.zeros_like(filtered)
    automaton = np.zeros((horizon + 1, len(chain.delta)))
    ahead: tuple[NDArray[np.int32], Floats] | None = None  # automaton states and rows of the tick after
    for first in sorted(kept, reverse=True):
        # Only every block's first belief was kept; the others are made again.
        last = min(first + block - 1, horizon)
        again = kept[first].copy()
        ticks = [_Tick(first, again.automaton_states, again.masses.copy())]
        for belief, tick in _forward(again, first + 1, last, observations, weights, []):
            ticks.append(_Tick(tick, belief.automaton_states, belief.masses.copy()))
        for tick, states, masses in reversed(ticks):
            rows = np.ones_like(masses)
            if ahead is not None:
                slot = np.full(len(chain.delta), -1, dtype=np.int64)
                slot[ahead[0]] = np.arange(len(ahead[0]))
                for i, q in enumerate(states):
                    free = q in (chain.accepting, chain.rejecting)
                    smoothing_kernels.pull(masses[i], q, free, chain, slot, ahead[1], rows[i])
                rows /= max(float(rows.max()), 1e-300)
            joint = masses * rows
            joint /= joint.sum()
            automaton[tick, states] = joint.sum(axis=1)
            kernels.cell_marginal(joint, chain.modes, smoothed[tick])
            for cells, modes in weights.get(tick, ()):
                kernels.reweight(rows, cells, modes)
            ahead = states, rows
    return Posterior(field, observations, tuple(likelihoods), filtered, smoothed, automaton, options)


def log_likelihoods(field: TabField, observations: Sequence[Observation], options: BeliefOptions) -> list[float]:
    """Of each observation given the earlier ones, without smoothing. Raises ImpossibleEvidence."""
    observations = _sorted(observations, field.problem.horizon)
    found: list[float] = []
    last = max((o.tick for o in observations), default=0)
    weights = _weights(field, observations, options)
    for _ in _forward(ProductBelief(field.bridge, options), 0, last, observations, weights, found):
        pass
    return found


def _sorted(observations: Sequence[Observation], horizon: int) -> tuple[Observation, ...]:
    for o in observations:
        if not 0 <= o.tick <= horizon:
            raise ValueError(f"{o}: the tick must lie in 0..{horizon}, the field's horizon")
    return tuple(sorted(observations, key=lambda o: o.tick))


Weights = dict[int, list[tuple[Floats, Floats]]]


def _weights(field: TabField, observations: Sequence[Observation], options: BeliefOptions) -> Weights:
    """Tick -> (``[C]``, ``[M]``) likelihoods of its observations."""
    found: Weights = {}
    for o in observations:
        cells, modes = o.likelihood(field.problem, field.bridge, options)
        found.setdefault(o.tick, []).append((np.ascontiguousarray(cells), np.ascontiguousarray(modes)))
    return found


def _forward(
    belief: ProductBelief,
    first: int,
    last: int,
    observations: Sequence[Observation],
    weights: Weights,
    likelihoods: list[float],
) -> Iterator[tuple[ProductBelief, int]]:
    """The filter from tick `first` on (it stands at the tick before, or at 0); likelihoods are appended as they come."""
    for tick in range(first, last + 1):
        if tick:
            belief.predict()
        here = [o for o in observations if o.tick == tick]
        for observation, (cells, modes) in zip(here, weights.get(tick, ()), strict=True):
            totals = kernels.reweight(belief.masses, cells, modes)
            total = float(totals.sum())
            if not total > 0:
                raise ImpossibleEvidence(
                    f"{observation} has probability 0 given the field and what was observed before: widen "
                    "BeliefOptions.position_cells, check the tick and the map, or leave the observation out"
                )
            if total <= belief.options.depleted:
                warnings.warn(
                    f"{observation} has likelihood {total:.1e} given the field and what was observed before: the "
                    "posterior rests on trajectories that the field holds for all but impossible",
                    NearZeroEvidence,
                    stacklevel=4,
                )
            likelihoods.append(math.log(total))
            belief.masses /= total
            used = totals > 0
            belief.masses, belief.automaton_states = belief.masses[used], belief.automaton_states[used]
        yield belief, tick
