"""The paper's letter: each next state is drawn from the field's marginal at that tick, whatever the present state.

Kept to compare with the bridge kernel. A belief moved like this forgets at every tick what was observed before, and its
trajectories jump about the map; whether the mission is complete is drawn once per trajectory and stays true.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from tab_marl.field.belief import BeliefOptions, ProductBelief
from tab_marl.field.sampling import Trajectories

if TYPE_CHECKING:
    from tab_marl.field.tab_field import TabField

Floats = NDArray[np.float64]


class MarginalBelief(ProductBelief):
    """Two rows of mass: mission under way (kept under the automaton's initial state) and complete."""

    bridges = False

    def __init__(self, field: TabField, options: BeliefOptions | None = None) -> None:
        self._by_tick = field.occupancy_by_status
        self._tick = 0
        super().__init__(field.bridge, options)
        self._load()

    def _load(self) -> None:
        chain = self.chain
        at = min(self._tick, len(self._by_tick) - 1)
        self.automaton_states = np.array([chain.initial, chain.accepting], dtype=np.int32)
        # Modes play no part: a state drawn from a marginal has no heading of its own.
        spread = self._by_tick[at][:, :, None] * chain.mode_shares
        self.masses = spread.reshape(2, chain.states) / spread.sum()

    def predict(self) -> None:
        """One tick passes: the belief is the marginal of the next tick."""
        self._tick += 1
        self._load()

    def _restart(self, cell_weight: Floats, mode_weight: Floats) -> None:
        """A contradicted belief is the sighting alone."""
        chain = self.chain
        done = self.completed
        here = (cell_weight[:, None] * (chain.mode_shares * mode_weight)).ravel()
        self.automaton_states = np.array([chain.initial, chain.accepting], dtype=np.int32)
        self.masses = np.stack([(1 - done) * here, done * here]) / here.sum()

    def futures(self, rng: np.random.Generator, count: int, ticks: int, jitter: bool) -> Trajectories:
        """`sample_paths` for this kernel."""
        chain = self.chain
        table = self._by_tick[np.minimum(self._tick + np.arange(ticks + 1), len(self._by_tick) - 1)].copy()
        present = np.zeros((2, chain.cells))
        for q, mass in zip(self.automaton_states, self.masses, strict=True):
            present[int(q == chain.accepting)] += mass.reshape(chain.cells, chain.modes).sum(axis=1)
        table[0] = present / present.sum()
        complete = np.maximum.accumulate(table[:, 1].sum(axis=1))
        quantile = rng.random(count)
        done = quantile[:, None] < complete  # [K, ticks + 1], stays true once true
        cells = np.empty((count, ticks + 1), dtype=np.int32)
        for t in range(ticks + 1):
            for status in (0, 1):
                of = np.flatnonzero(done[:, t] == status)
                if len(of):
                    weight = table[t, status] if table[t, status].sum() > 0 else table[t].sum(axis=0)
                    cumulative = np.cumsum(weight)
                    drawn = np.searchsorted(cumulative, rng.random(len(of)) * cumulative[-1], side="right")
                    cells[of, t] = np.minimum(drawn, chain.cells - 1)
        positions = chain.centres[cells]
        if jitter:
            positions += (rng.random((count, 1, 2)) - 0.5) * chain.cell_metres
        return Trajectories(
            positions,
            np.where(done.any(axis=1), done.argmax(axis=1), -1).astype(np.int32),
            cells,
            np.zeros_like(cells),
            np.where(done, chain.accepting, chain.initial).astype(np.int32),
        )
