"""How the particles of a filter move and are weighed, for each kind of model."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any, Protocol

import numba
import numpy as np
from numba import typeof, types
from numpy.typing import NDArray

from tab_marl.planning.beliefs import filter_kernels
from tab_marl.planning.callbacks import callback
from tab_marl.planning.model import (
    CompiledModel,
    ContinuousModel,
    belief_objects,
    belief_states,
    check_states,
    draw_particles,
    numbered,
)
from tab_marl.planning.tables import SparseData, TableData

_STATE = types.Array(types.float64, 1, "C")


class ParticleDynamics(Protocol):
    """What a particle filter asks of a model."""

    weighs: bool
    """Whether weights are likelihoods (True), or 1 where the simulated observation is the very one (False)."""

    def draw(self, belief: Any, count: int, rng: np.random.Generator) -> NDArray[Any]:
        """`count` equally weighted states of a belief."""
        ...

    def check(self, states: NDArray[Any]) -> None:
        """ValueError where these cannot be states of the model."""
        ...

    def advance(
        self, states: NDArray[Any], action: int, observation: Any, rng: np.random.Generator
    ) -> tuple[NDArray[Any], NDArray[np.float64]]:
        """(states after the step, weights); the weight of a state in which the process ended is -1.

        Raises TypeError or ValueError for what is no observation of the model, and where a likelihood is not finite or negative.
        """
        ...


def dynamics_of(model: Any, likelihood: Callable[..., float] | None) -> ParticleDynamics:
    """The dynamics of a compiled or a plain Python model; `likelihood` None takes the model's own if it has one."""
    given = likelihood if likelihood is not None else getattr(model, "likelihood", None)
    if isinstance(model, CompiledModel):
        if given is None and isinstance(model.data, TableData):
            given = filter_kernels.table_likelihood
        elif given is None and isinstance(model.data, SparseData):
            given = filter_kernels.sparse_table_likelihood
        return CompiledDynamics(model, given)
    if isinstance(model, ContinuousModel):
        return ContinuousDynamics(model if likelihood is None else replace(model, likelihood=likelihood))
    return PythonDynamics(model, given)


def _drawn(
    model: CompiledModel | ContinuousModel, belief: Any, count: int, rng: np.random.Generator
) -> NDArray[np.float64]:
    """`count` rows of a belief's states, drawn by their weights."""
    states, weights = belief_states(model, belief, count, rng)
    return states[draw_particles(count, len(states), weights, rng)]


def _broken_likelihood(value: float, action: int, observation: Any) -> ValueError:
    """That a likelihood is broken: taken for one that explains nothing, it would pass for a contradiction."""
    return ValueError(
        f"the likelihood of observation {observation} after action {action} is {value}, must be finite and >= 0: a probability or "
        "a density (or a multiple of it), not its logarithm"
    )


class CompiledDynamics:
    """Particles of a `CompiledModel`: rows of an array."""

    def __init__(self, model: CompiledModel, likelihood: Callable[..., float] | None) -> None:
        self.model = model
        self.weighs = likelihood is not None
        self._interpreted = bool(getattr(numba.config, "DISABLE_JIT", 0))
        self._likelihood: Any = likelihood
        if likelihood is not None and not self._interpreted:
            plain = getattr(likelihood, "py_func", likelihood)
            signature = types.float64(_STATE, types.int64, _STATE, types.int64, typeof(model.data))
            self._likelihood = callback(plain, signature)

    def draw(self, belief: Any, count: int, rng: np.random.Generator) -> NDArray[np.float64]:
        return _drawn(self.model, belief, count, rng)

    def check(self, states: NDArray[np.float64]) -> None:
        check_states(self.model, states)

    def advance(
        self, states: NDArray[np.float64], action: int, observation: Any, rng: np.random.Generator
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        observation = numbered(observation)
        word = rng.integers(2**64, size=1, dtype=np.uint64)
        after, weights = np.empty_like(states), np.empty(len(states))
        broken = filter_kernels.advance(
            self.model.functions[0], self._likelihood, self.model.data, states, int(action), observation, word,
            np.empty(self.model.state_size), after, weights,
        )  # fmt: skip
        if broken != filter_kernels.NONE_BROKEN:
            raise _broken_likelihood(weights[broken], action, observation)
        return after, weights


class ContinuousDynamics:
    """Particles of a `ContinuousModel`: rows of an array, weighed by its likelihood."""

    weighs = True

    def __init__(self, model: ContinuousModel) -> None:
        self.model = model

    def draw(self, belief: Any, count: int, rng: np.random.Generator) -> NDArray[np.float64]:
        return _drawn(self.model, belief, count, rng)

    def check(self, states: NDArray[np.float64]) -> None:
        check_states(self.model, states)

    def advance(
        self, states: NDArray[np.float64], action: int, observation: Any, rng: np.random.Generator
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        seen = np.array(observation, dtype=np.float64).reshape(-1)
        if seen.shape != (self.model.observation_size,):
            raise ValueError(
                f"observation has shape {seen.shape}, must be [{self.model.observation_size}] for this model"
            )
        word = rng.integers(2**64, size=1, dtype=np.uint64)
        after, weights = np.empty_like(states), np.empty(len(states))
        step, likelihood, _ = self.model.functions
        broken = filter_kernels.advance_seeing(
            step, likelihood, self.model.data, states, int(action), seen, word, np.empty(self.model.state_size),
            after, weights, np.empty_like(seen),
        )  # fmt: skip
        if broken != filter_kernels.NONE_BROKEN:
            raise _broken_likelihood(weights[broken], action, seen.tolist())
        return after, weights


class PythonDynamics:
    """Particles of a plain Python model: an array of objects. Every step is interpreted."""

    def __init__(self, model: Any, likelihood: Callable[..., float] | None) -> None:
        self.model, self._likelihood = model, likelihood
        self.weighs = likelihood is not None

    def draw(self, belief: Any, count: int, rng: np.random.Generator) -> NDArray[Any]:
        states, weights = belief_objects(belief, count, rng)
        return _objects(states)[draw_particles(count, len(states), weights, rng)]

    def check(self, states: NDArray[Any]) -> None:
        """Any object may be a state."""

    def advance(
        self, states: NDArray[Any], action: int, observation: Any, rng: np.random.Generator
    ) -> tuple[NDArray[Any], NDArray[np.float64]]:
        after, weights = list[Any](), np.empty(len(states))
        for i, state in enumerate(states):
            reached, seen, _reward, terminal = self.model.step(state, action, rng)
            after.append(reached)
            if terminal:
                weights[i] = -1.0
            elif self._likelihood is None:
                weights[i] = float(seen == observation)
            else:
                weights[i] = self._likelihood(state, action, reached, observation)
                if not 0.0 <= weights[i] < np.inf:
                    raise _broken_likelihood(weights[i], action, observation)
        return _objects(after), weights


def _objects(states: list[Any]) -> NDArray[Any]:
    """A one-dimensional array of objects, whatever they are."""
    array = np.empty(len(states), dtype=object)
    for i, state in enumerate(states):  # a slice would take tuples apart
        array[i] = state
    return array
