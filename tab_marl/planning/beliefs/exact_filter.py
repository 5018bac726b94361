"""The exact belief over the states of a model given as tables, by Bayes' rule."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import scipy.sparse
from numpy.typing import ArrayLike, NDArray

from tab_marl.planning.beliefs.filter_report import (
    Deprivation,
    EventLog,
    FilterReport,
    ImpossibleObservation,
    Remedy,
    named,
)
from tab_marl.planning.model import CompiledModel, Particles, action_names, numbered
from tab_marl.planning.tables import SparseData, SparseRows, TableData

_LISTED = 5
"""Observations that a message lists as possible."""
_LEAST = 1e-200
"""The least probability of a state that is possible. Without it a few hundred unlikely steps round a state to zero for good."""


@dataclass(eq=False)
class ExactFilter:
    """The probability of every state of a `table_model`, given what was done and seen. Used like `ParticleFilter`.

    An observation of probability zero contradicts the tables. It is said what was seen and when (`BeliefWarning`, `report`), and
    the belief is made anew: the history is replayed, forgiving, with weight `doubt`, states that do not explain what was seen;
    where no state explains the latest observation, the `fallback` is believed. Once it has replayed, a filter replays too where
    it is likelier that the latest observation misleads than that all those against it did. With `strict`, ImpossibleObservation
    is raised.

    No history is kept for that: what a replay of everything would give is carried along as a second belief, so that a filter
    takes the memory of two beliefs however long it runs.
    """

    model: CompiledModel
    prior: ArrayLike | None = None
    """``[S]``, >= 0, of any scale; None: all states alike that do not end the process."""
    strict: bool = False
    doubt: float = 1e-3
    """In a replay: how well a state that excludes an observation explains it, relative to the state that explains it best."""
    fallback: Callable[[int, int], ArrayLike] | None = None
    """``fallback(action, observation) -> probabilities [S]``; None: the prior, led through the last action."""
    probabilities: NDArray[np.float64] = field(init=False)
    """``[S]``: the belief."""

    def __post_init__(self) -> None:
        data = getattr(self.model, "data", None)
        if not isinstance(data, TableData | SparseData):
            raise TypeError(
                f"an exact filter needs tables, and this {type(self.model).__name__} was not made by table_model: "
                "give it tables, or use ParticleFilter"
            )
        if not 0 <= self.doubt <= 1:
            raise ValueError(f"doubt is {self.doubt}, must be in [0, 1]")
        self._transition = _by_action(data.transition, self.model.actions, len(data.terminal))
        self._observation = _by_action(data.observation, self.model.actions, _columns(data))
        self._goes_on = ~data.terminal
        self._prior = self._distribution("prior", self._goes_on if self.prior is None else self.prior)
        self._names = action_names(self.model)
        self._log = EventLog()
        self.probabilities = self._prior
        self._doubting, self._contradicted = self._prior, False

    def predicted(self, action: int) -> NDArray[np.float64]:
        """``[O]``: the probability of each observation after `action`, given that the process goes on."""
        joint = self._moved(self.probabilities, action) @ self._observation[action]
        return joint / max(joint.sum(), np.finfo(float).tiny)

    def update(self, action: int, observation: int) -> ExactFilter:
        """Takes the step in which `action` was done, `observation` seen, and the process did not end. Returns itself."""
        if not 0 <= action < self.model.actions:
            raise ValueError(f"action is {action}, must be in 0..{self.model.actions - 1}")
        observation, seen = numbered(observation), self._observation[action].shape[1]
        if not 0 <= observation < seen:
            raise ValueError(f"observation is {observation}, must be in 0..{seen - 1}")
        believed = self._after(self.probabilities, action, observation, doubt=0.0)
        if self.strict and believed is None:
            raise ImpossibleObservation(self._event(action, observation, None, self._log.updates + 1))
        doubting = None if self.strict else self._after(self._doubting, action, observation, self.doubt)
        if self._contradicted and believed is not None and doubting is not None and doubting[believed == 0].sum() > 0.5:
            # Explained, but only by states that nothing but the doubt about earlier steps kept possible.
            believed = None
        self._log.updates += 1
        self._log.least_effective = float(len(self.probabilities))
        if believed is None:
            self._recover(action, observation, doubting)
        else:
            self.probabilities, self._doubting = believed, believed if doubting is None else doubting
        return self

    def sample(self, count: int, rng: np.random.Generator) -> NDArray[np.float64]:
        """``[count, 1]`` states; hand this method to a planner as its belief."""
        return rng.choice(len(self.probabilities), size=(count, 1), p=self.probabilities).astype(np.float64)

    @property
    def particles(self) -> Particles:
        """The belief as a planner takes it, without drawing: every state with its probability."""
        return Particles(np.arange(len(self.probabilities), dtype=np.float64), self.probabilities)

    @property
    def entropy(self) -> float:
        """Of the belief, in nats."""
        p = self.probabilities[self.probabilities > 0]
        return max(0.0, float(-(p * np.log(p)).sum()))  # of one state: 0, not -0

    def report(self) -> FilterReport:
        """What happened so far: updates, and every observation that the tables exclude."""
        return self._log.report()

    def _moved(self, belief: NDArray[np.float64], action: int) -> NDArray[np.float64]:
        """``[S]`` unnormalised: the states reached from which the process goes on; none is from a state that has ended."""
        moved: NDArray[np.float64] = ((belief * self._goes_on) @ self._transition[action]) * self._goes_on
        return moved

    def _chance(self, action: int, observation: int) -> NDArray[np.float64]:
        """``[S]``: the probability of the observation in each state reached."""
        column: Any = self._observation[action][:, [observation]]
        return np.asarray(column.toarray() if hasattr(column, "toarray") else column, dtype=np.float64).ravel()

    def _after(
        self, belief: NDArray[np.float64], action: int, observation: int, doubt: float
    ) -> NDArray[np.float64] | None:
        """``[S]``: the belief after a step, in which a state explains the observation at least `doubt` times as well as the one
        reached that explains it best; None where no state reached explains it."""
        moved, chance = self._moved(belief, action), self._chance(action, observation)
        weight = np.maximum(chance, doubt * chance[moved > 0].max(initial=0.0))
        joint = moved * weight
        if not joint.sum() > 0:
            return None
        after: NDArray[np.float64] = np.maximum(joint / joint.sum(), _LEAST * ((moved > 0) & (weight > 0)))
        return after

    def _recover(self, action: int, observation: int, doubting: NDArray[np.float64] | None) -> None:
        """Believes what a forgiving replay gives, or where that explains nothing either, the fallback."""
        remedy: Remedy = "fallback" if doubting is None else "replay"
        event = self._event(action, observation, remedy, self._log.updates)
        self._doubting = self._fallen_back(action, observation) if doubting is None else doubting
        self.probabilities, self._contradicted = self._doubting, doubting is not None
        self._log.lost(event)

    def _fallen_back(self, action: int, observation: int) -> NDArray[np.float64]:
        if self.fallback is not None:
            return self._distribution("fallback", self.fallback(action, observation))
        after = self._after(self._prior, action, observation, doubt=0.0)
        if after is not None:
            return after
        moved = self._moved(self._prior, action)
        return moved / moved.sum() if moved.sum() > 0 else self._prior

    def _event(self, action: int, observation: int, remedy: Remedy | None, step: int) -> Deprivation:
        chances = self.predicted(action)
        likely = [o for o in np.argsort(-chances, kind="stable")[:_LISTED] if chances[o] > 0]
        possible = ", ".join(f"{o} ({chances[o]:.3g})" for o in likely)
        because = f"possible: {possible}" if likely else "the process must have ended before"
        detail = f"probability {chances[observation]:.3g}; {because}"
        return Deprivation(step, named(self._names, action), observation, remedy, detail)

    def _distribution(self, name: str, given: ArrayLike) -> NDArray[np.float64]:
        p = np.asarray(given, dtype=np.float64)
        size = len(self._goes_on)
        if p.shape != (size,) or not np.isfinite(p).all() or (p < 0).any() or not p.sum() > 0:
            raise ValueError(f"{name} must be {size} numbers, finite, >= 0 and not all zero; its shape is {p.shape}")
        return p / p.sum()


def _columns(data: TableData | SparseData) -> int:
    """Observations that the tables have, whether or not they can come."""
    return data.observation.columns if isinstance(data, SparseData) else data.observation.shape[1]


def _by_action(rows: NDArray[np.float64] | SparseRows, actions: int, columns: int) -> list[Any]:
    """Per action the probabilities ``[S, columns]``, dense or sparse as the tables are, from the cumulative ones.

    Differences of rounded sums can fall below 0 by a rounding error; no probability does.
    """
    if not isinstance(rows, SparseRows):
        return list(np.maximum(np.diff(rows.reshape(actions, -1, columns), axis=2, prepend=0.0), 0.0))
    chances = np.diff(rows.cumulative, prepend=0.0)
    starts = rows.first[:-1]
    chances[starts] = rows.cumulative[starts]
    table = scipy.sparse.csr_array(
        (np.maximum(chances, 0.0), rows.number, rows.first), shape=(len(rows.first) - 1, columns)
    )
    size = table.shape[0] // actions
    return [table[a * size : (a + 1) * size] for a in range(actions)]
