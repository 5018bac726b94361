"""Any deterministic finite automaton as a mission: its table, cycles and all, unrolled over a horizon."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass
from functools import cached_property
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tab_marl.mission.automaton import COMPLETED, FAILED, NO_BRANCH
from tab_marl.mission.unroll import MOST_STATES, AutomatonTooLarge, TickAutomaton

Ints = NDArray[np.int32]
Bools = NDArray[np.bool_]

MOST_LAYERED = 1_000_000_000
"""States x ticks that are searched for those that matter (a byte each)."""


@dataclass(frozen=True, eq=False)
class FiniteAutomaton:
    """A deterministic finite automaton over the symbols 0..L-1. Raises ValueError when the table does not fit."""

    delta: ArrayLike
    """``[Q, L]`` next state when the symbol is read. Rows of accepting and rejecting states are never used where
    reaching them ends the mission."""
    initial: int
    """The state before the first symbol, that of the cell at tick 0."""
    accepting: int | Collection[int]
    rejecting: int | Collection[int] = ()
    """States that end the mission in failure. May be left out: states that cannot lead to acceptance are found."""
    accept: Literal["reached", "at_horizon"] = "reached"
    """`reached`: done the first time an accepting state is entered. `at_horizon`: the word of the ticks 0..horizon is
    accepted, so the state entered at the horizon counts alone."""
    branch: ArrayLike | None = None
    """``[Q, L]`` the place that a transition visits, 0..B-1 or NO_BRANCH, for equal goal marginals; default: none."""

    def __post_init__(self) -> None:
        delta = np.asarray(self.delta)
        if delta.ndim != 2 or 0 in delta.shape or not np.issubdtype(delta.dtype, np.integer):
            raise ValueError(f"FiniteAutomaton.delta must be [Q, L] integers, got {delta.dtype} {delta.shape}")
        states = len(delta)
        if delta.min() < 0 or delta.max() >= states:
            raise ValueError(
                f"FiniteAutomaton.delta has entries in {delta.min()}..{delta.max()}, must lie in 0..{states - 1}"
            )
        object.__setattr__(self, "delta", np.ascontiguousarray(delta, dtype=np.int32))
        for name in ("accepting", "rejecting"):
            given = getattr(self, name)
            members = tuple(given) if isinstance(given, Collection) else (int(given),)
            outside = [q for q in members if not 0 <= q < states]
            if outside:
                raise ValueError(f"FiniteAutomaton.{name} holds {outside[0]}, must be states in 0..{states - 1}")
            object.__setattr__(self, name, members)
        if not 0 <= self.initial < states:
            raise ValueError(f"FiniteAutomaton.initial is {self.initial}, must be a state in 0..{states - 1}")
        if not self.accepting:
            raise ValueError("FiniteAutomaton.accepting is empty: name at least one state")
        both = set(self._members("accepting")) & set(self._members("rejecting"))
        if both:
            raise ValueError(f"FiniteAutomaton: state {both.pop()} is both accepting and rejecting")
        if self.accept not in ("reached", "at_horizon"):
            raise ValueError(f"FiniteAutomaton.accept is {self.accept!r}, must be 'reached' or 'at_horizon'")
        if self.accept == "reached" and self.initial in self._members("accepting"):
            raise ValueError(
                f"FiniteAutomaton.initial ({self.initial}) is accepting: done before anything is read; use "
                "accept='at_horizon', or another initial state"
            )
        if self.branch is not None:
            branch = np.asarray(self.branch, dtype=np.int32)
            if branch.shape != delta.shape or branch.min() < NO_BRANCH:
                raise ValueError(
                    f"FiniteAutomaton.branch must be {list(delta.shape)} with entries >= {NO_BRANCH} (NO_BRANCH), "
                    f"got {branch.shape}"
                )
            object.__setattr__(self, "branch", branch)

    def _members(self, name: str) -> tuple[int, ...]:
        return getattr(self, name)

    @property
    def table(self) -> Ints:
        """`delta`."""
        return np.asarray(self.delta, dtype=np.int32)

    @cached_property
    def _kinds(self) -> tuple[Bools, Bools]:
        """``[Q]`` accepting, ``[Q]`` rejecting."""
        kinds = np.zeros((2, len(self.table)), dtype=bool)
        kinds[0, list(self._members("accepting"))] = True
        kinds[1, list(self._members("rejecting"))] = True
        return kinds[0], kinds[1]

    def of_states(self, values: ArrayLike, location: Ints, name: str) -> NDArray[np.int32]:
        """``[Q]`` values of this automaton's states, for the states of its unrolled form (absorbing ones: 0)."""
        given = np.asarray(values, dtype=np.int32)
        if given.shape != (len(self.table),):
            raise ValueError(f"{name} has shape {given.shape}, must be [{len(self.table)}], one per automaton state")
        return np.where(location >= 0, given[np.maximum(location, 0)], 0).astype(np.int32)

    def unrolled(
        self, horizon_ticks: int, labels: ArrayLike | None = None, first_labels: ArrayLike | None = None
    ) -> TickAutomaton:
        """One state per (state, tick) from which words of these labels can still be accepted by the horizon.

        Args:
            horizon_ticks: the last tick whose symbol is read.
            labels: those that occur (any shape, repeats allowed); default all.
            first_labels: those that occur at tick 0; default `labels`.
        Raises:
            AutomatonTooLarge: more than `MOST_STATES` states would be needed.
        """
        if horizon_ticks < 0:
            raise ValueError(f"horizon_ticks is {horizon_ticks}, must be >= 0")
        layers = len(self.table) * (horizon_ticks + 1)
        if layers > MOST_LAYERED:
            raise AutomatonTooLarge(
                f"unrolled over {horizon_ticks:,} ticks the automaton of {len(self.table):,} states may need "
                f"{layers:,}, beyond the {MOST_LAYERED:,} that can be searched: minimise it, use a shorter horizon or "
                "longer ticks"
            )
        symbols = self._symbols(labels, "labels")
        first = symbols if first_labels is None else self._symbols(first_labels, "first_labels")
        alive = self._alive(horizon_ticks, symbols)
        reached = self._reached(alive, first, symbols)
        return self._layered(reached, alive)

    def _symbols(self, labels: ArrayLike | None, name: str) -> NDArray[np.int64]:
        count = self.table.shape[1]
        found = np.unique(np.arange(count) if labels is None else np.asarray(labels))
        if len(found) == 0 or found[0] < 0 or found[-1] >= count:
            raise ValueError(f"{name} must be a non-empty set of symbols in 0..{count - 1}, got {found.tolist()[:20]}")
        return found.astype(np.int64)

    def _alive(self, horizon: int, symbols: NDArray[np.int64]) -> Bools:
        """``[T + 1, Q]``: entered at this tick, the state is under way and acceptance by the horizon is possible.

        The last row stays empty: by then every word is accepted or not.
        """
        accepting, rejecting = self._kinds
        table = self.table[:, symbols]
        ended = accepting | rejecting if self.accept == "reached" else rejecting
        alive = np.zeros((horizon + 1, len(table)), dtype=bool)
        ahead = accepting
        for t in range(horizon - 1, -1, -1):
            alive[t] = ahead[table].any(axis=1) & ~ended
            ahead = alive[t] | accepting if self.accept == "reached" else alive[t]
        return alive

    def _reached(self, alive: Bools, first: NDArray[np.int64], symbols: NDArray[np.int64]) -> list[NDArray[np.int64]]:
        """Per tick, the live states that some word reaches. Raises AutomatonTooLarge."""
        layers, total = [], 1
        following = np.unique(self.table[self.initial, first])
        for t, open_states in enumerate(alive):
            layer = following[open_states[following]].astype(np.int64)
            layers.append(layer)
            total += len(layer)
            if total > MOST_STATES:
                at_most = int(alive.sum()) + 3
                raise AutomatonTooLarge(
                    f"unrolled over {len(alive) - 1} ticks the automaton of {len(self.table):,} states has more than "
                    f"{MOST_STATES:,} states by tick {t} and up to {at_most:,} in all: minimise it, use a shorter "
                    "horizon or longer ticks"
                )
            following = np.unique(self.table[layer][:, symbols])
        return layers

    def _layered(self, layers: list[NDArray[np.int64]], alive: Bools) -> TickAutomaton:
        accepts, _ = self._kinds
        horizon = len(layers) - 1
        offsets = np.concatenate([[1], 1 + np.cumsum([len(layer) for layer in layers])])
        accepting = int(offsets[-1])
        rejecting = accepting + 1
        symbols = self.table.shape[1]
        given = np.full_like(self.table, NO_BRANCH) if self.branch is None else np.asarray(self.branch)
        delta = np.full((rejecting + 1, symbols), rejecting, dtype=np.int32)
        delta[accepting] = accepting
        branch = np.full(delta.shape, NO_BRANCH, dtype=np.int32)
        number = np.zeros(len(self.table), dtype=np.int32)
        for t in range(-1, horizon):
            source = np.array([self.initial]) if t < 0 else layers[t]
            rows = slice(0, 1) if t < 0 else slice(int(offsets[t]), int(offsets[t + 1]))
            number[:] = rejecting
            number[layers[t + 1]] = np.arange(offsets[t + 1], offsets[t + 2])
            if self.accept == "reached" or t + 1 == horizon:
                number[accepts] = accepting
            delta[rows] = number[self.table[source]]
            branch[rows] = np.where(delta[rows] == rejecting, NO_BRANCH, given[source])
        ticks = np.repeat(np.arange(horizon + 1), [len(layer) for layer in layers])
        ticks = np.concatenate([[-1], ticks, [horizon, horizon]]).astype(np.int32)
        location = np.concatenate([[self.initial], *layers, [COMPLETED, FAILED]]).astype(np.int32)
        clocks = np.zeros((rejecting + 1, 3), dtype=np.int32)
        clocks[:accepting] = ticks[:accepting, None]
        return TickAutomaton(
            delta=delta,
            masks=np.arange(symbols, dtype=np.int32),
            initial=0,
            accepting=accepting,
            rejecting=rejecting,
            rank=(ticks + 1).astype(np.int32),
            location=location,
            branch=branch,
            mission_ticks=np.where(location >= 0, ticks, -1).astype(np.int32),
            stage_ticks=np.maximum(clocks[:, 1], 0),
            speed_limit=np.full(rejecting + 1, np.inf),
            clocks=clocks,
        )
