"""Trajectories drawn from a product chain."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from tab_marl.field import sampling_kernels as kernels
from tab_marl.field.chain import ProductChain

if TYPE_CHECKING:
    from tab_marl.field.belief import ProductBelief


@dataclass(frozen=True, eq=False)
class Trajectories:
    """K trajectories; column 0 is now, one column per tick."""

    positions: NDArray[np.float64]
    """``[K, ticks + 1, D]`` metres: cell centres, moved by one offset per trajectory, uniform within the cell."""
    completed_tick: NDArray[np.int32]
    """``[K]`` tick at which the mission completes (0: it is complete now), -1 if not within these ticks."""
    cells: NDArray[np.int32]
    """``[K, ticks + 1]``."""
    modes: NDArray[np.int32]
    """``[K, ticks + 1]``."""
    automaton_states: NDArray[np.int32]
    """``[K, ticks + 1]``."""

    def __len__(self) -> int:
        return len(self.positions)


def sample_paths(
    chain: ProductChain, belief: ProductBelief, rng: np.random.Generator, count: int, ticks: int, jitter: bool = True
) -> Trajectories:
    """Draw `count` futures of `ticks` ticks from the belief.

    The present states are drawn systematically (evenly spread over the belief's mass), the futures independently.
    """
    if count < 1 or ticks < 0:
        raise ValueError(f"count is {count} and ticks is {ticks}: need count >= 1 and ticks >= 0")
    if not belief.bridges:
        return belief.futures(rng, count, ticks, jitter)
    masses = belief.masses
    slots, first = np.empty(count, dtype=np.int64), np.empty(count, dtype=np.int64)
    kernels.draw_states(masses, float(masses.sum(dtype=np.float64)), count, rng.random(), slots, first)
    automaton_states = np.empty((count, ticks + 1), dtype=np.int32)
    base_states = np.empty((count, ticks + 1), dtype=np.int32)
    automaton_states[:, 0] = belief.automaton_states[slots]
    base_states[:, 0] = first
    completed_tick = np.empty(count, dtype=np.int32)
    streams = rng.integers(0, 2**64, size=count, dtype=np.uint64)
    kernels.sample_paths(chain, streams, automaton_states, base_states, completed_tick)
    cells, modes = np.divmod(base_states, np.int32(chain.modes))
    positions = chain.centres[cells]
    if jitter:
        positions += (rng.random((count, 1, positions.shape[2])) - 0.5) * chain.cell_metres
    return Trajectories(positions, completed_tick, cells, modes, automaton_states)
