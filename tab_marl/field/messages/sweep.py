"""The field's law tick by tick: one forward pass in time, with every transition counted."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from tab_marl.field import kernels
from tab_marl.field.belief import BeliefOptions, ProductBelief
from tab_marl.field.chain import ProductChain
from tab_marl.field.problem import COMPLETE, FAILED, FieldProblem

Floats = NDArray[np.float64]


class Moment(NamedTuple):
    """The law at one tick."""

    tick: int
    automaton_states: NDArray[np.int32]
    """``[n]`` with mass, rising."""
    masses: Floats
    """``[n, S]``."""
    sources: NDArray[np.int32]
    """``[m]`` automaton states that were left (or kept) to get here."""
    flux: Floats
    """``[m, L]`` probability of each transition from them at this tick."""


def moments(chain: ProductChain, ticks: int, options: BeliefOptions) -> Iterator[Moment]:
    """Ticks 0 to `ticks`; `options` says which masses are dropped on the way."""
    belief = ProductBelief(chain, options)
    symbols = chain.delta.shape[1]
    first = np.asarray(np.bincount(chain.labels, belief.cell_marginal(), minlength=symbols)[None], dtype=np.float64)
    active, masses = belief.automaton_states, belief.masses
    yield Moment(0, active, masses, np.array([chain.initial], dtype=np.int32), first)
    for tick in range(1, ticks + 1):
        following = np.unique(chain.delta[active]).astype(np.int32)
        slot = np.full(len(chain.delta), -1, dtype=np.int64)
        slot[following] = np.arange(len(following))
        rows = np.zeros((len(following), chain.states))
        flux = np.zeros((len(active), symbols))
        for i, q in enumerate(active):
            kernels.push(masses[i], q, q in (chain.accepting, chain.rejecting), chain, slot, rows, flux[i])
        used = rows.sum(axis=1) > options.drop_row
        sources, active, masses = active, following[used], rows[used] / rows[used].sum()
        yield Moment(tick, active, masses, sources, flux)


@dataclass(frozen=True, eq=False)
class Sweep:
    """Marginals of the law over the horizon, ``T + 1`` ticks."""

    by_status: Floats
    """``[T + 1, 2, C]``: not complete, complete."""
    automaton: Floats
    """``[T + 1, Q]``."""
    stage_done: Floats
    """``[G, T + 1]`` probability that a stage is completed at that tick."""
    failed: Floats
    """``[T + 1]`` probability that the mission has failed by that tick."""


def sweep(problem: FieldProblem, chain: ProductChain, options: BeliefOptions) -> Sweep:
    """One pass."""
    ticks, stage = problem.horizon + 1, np.asarray(problem.stage)
    status = np.asarray(problem.status)
    by_status = np.zeros((ticks, 2, chain.cells))
    automaton = np.zeros((ticks, len(chain.delta)))
    stage_done = np.zeros((len(problem.stage_names), ticks))
    for moment in moments(chain, problem.horizon, options):
        t = moment.tick
        automaton[t, moment.automaton_states] = moment.masses.sum(axis=1)
        for q, mass in zip(moment.automaton_states, moment.masses, strict=True):
            by_status[t, int(status[q] == COMPLETE)] += mass.reshape(chain.cells, -1).sum(axis=1)
        before = stage[moment.sources][:, None]
        after = stage[chain.delta[moment.sources]]
        for g in range(len(stage_done)):
            stage_done[g, t] = moment.flux[(before <= g) & (before >= 0) & (after > g)].sum()
    return Sweep(by_status, automaton, stage_done, automaton[:, status == FAILED].sum(axis=1))
