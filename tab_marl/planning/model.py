"""Generative models for the planner: compiled functions, tables, or a plain Python class; and beliefs over their states.

**Compiled** (`CompiledModel`): module-level Python functions that numba can compile,

``step(state, action, data, rng) -> (observation, reward, terminal)``
    Changes `state` in place. `state` is float64[D]: a short vector holds a cell number, a bit mask (exact up to 2**53) or a
    pose alike, so that one search kernel serves every model; a conversion costs about a nanosecond. That the process has
    ended is known from `terminal` alone: no search steps on from there, but a belief may hold a state that has ended before,
    and then it is for `step` to earn nothing and say terminal again (as tables do), or for the caller to leave it out.
``rollout(state, action, observation, depth, max_depth, discount, data, rng) -> float`` (optional)
    The return that follows from `state`, counted from now, in place of random actions: a policy simulated to the end in this
    one call (at most ``max_depth - depth`` steps), or an estimate. `action` and `observation` are the latest. May change `state`.
``prior(state, action, observation, depth, data, values, counts)`` (optional)
    Called when a node gets its actions; all values and counts are 0 before. Writes ``values[a]`` (a return) and ``counts[a]``:
    that many simulations are taken as done (Silver and Veness 2010, section 3.4 "preferred actions"); a count of -1 forbids the
    action there. At a root where nothing was done yet `action` and `observation` are -1, if the caller asks there at all
    (`Pomcp.plan`, ``latest=START``). Read from `state` only what the agent itself can see, or the hidden state leaks into the plan.

``upper(state, depth, max_depth, discount, data) -> float`` (optional, for DESPOT)
    A return that no policy can exceed in the ``max_depth - depth`` steps left from `state` on: often what could be earned if
    the state were known. A bound worked out for one discount says so (`CompiledModel.upper_discount`).

`data` is whatever the functions need: a NamedTuple of arrays and numbers (or a tuple). The search is compiled once per *type*
of data and cached on disk, so keep dtypes, dimensions and memory order the same from call to call, and let arrays be writable
and C-contiguous. Functions compiled by numba do not check indices: `states` says what the states are (`StateRange`), so that
a belief that holds something else is refused and not looked up. `rng` is uint64[1] for `tab_marl.planning.random_kernels`. Return ``np.int64`` observations, float rewards, bool terminals.

**Continuous observations** (`ContinuousModel`, for `tab_marl.planning.search.pomcpow.Pomcpow`): compiled functions again, but

``step(state, action, data, rng, observation) -> (reward, terminal)``
    Changes `state` and writes into `observation`, float64[O].
``likelihood(before, action, after, observation, data) -> float``
    The density (or probability, or a multiple of it) of the observation after that step; > 0 for one that `step` wrote.
``rollout(state, action, observation, depth, max_depth, discount, data, rng) -> float`` (optional)
    As above, with the observation a vector.

**Tables** (`tab_marl.planning.tables.table_model`): transition, observation and reward arrays, dense or sparse; a compiled model.

**Plain Python** (`PythonModel`): any class with ``step``; some hundred times slower, for small problems and for debugging.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Hashable, Sized
from dataclasses import dataclass
from functools import cached_property
from numbers import Integral
from typing import Any, Protocol, TypeAlias

import numba
import numpy as np
from numba import typeof, types
from numpy.typing import ArrayLike, NDArray

from tab_marl.planning.callbacks import callback
from tab_marl.planning.search.bounds import require_whole
from tab_marl.planning.state_kernels import ALL_STATES, first_outside

_STATE = types.Array(types.float64, 1, "C")
_COUNTS = types.Array(types.int64, 1, "C")
_RNG = types.Array(types.uint64, 1, "C")
_STEP_RESULT = types.Tuple((types.int64, types.float64, types.boolean))


@dataclass(frozen=True, eq=False)
class StateRange:
    """What the states of a model are, entry by entry.

    Compiled functions look states up in tables without checking; a plan or a filter refuses what is out of this range first.
    """

    lowest: ArrayLike
    """``[D]``; ``-np.inf`` where there is no bound."""
    highest: ArrayLike
    """``[D]``, itself allowed; ``np.inf`` where there is no bound."""
    whole: ArrayLike = True
    """``[D]`` bool, or one for all: entries that must be whole numbers."""

    @cached_property
    def entries(self) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.bool_]]:
        """(lowest, highest, whole), each ``[D]``."""
        lowest, highest, whole = np.broadcast_arrays(*map(np.atleast_1d, (self.lowest, self.highest, self.whole)))
        return lowest.astype(np.float64), highest.astype(np.float64), whole.astype(np.bool_)


@dataclass(frozen=True, eq=False)
class CompiledModel:
    """A generative model made of functions that numba compiles; see the module's head for their signatures."""

    step: Callable[..., tuple[int, float, bool]]
    actions: int
    """A: actions are 0 .. A-1."""
    state_size: int
    """D: numbers in a state."""
    data: Any = ()
    """Arrays and numbers handed to every function."""
    rollout: Callable[..., float] | None = None
    prior: Callable[..., None] | None = None
    action_names: tuple[str, ...] = ()
    """For people; empty means the numbers."""
    upper: Callable[..., float] | None = None
    """For DESPOT."""
    upper_discount: float | None = None
    """The one discount for which `upper` holds; None: whichever it is called with."""
    states: StateRange | None = None
    """What a belief's states are checked against; None: any D numbers are a state."""

    def __post_init__(self) -> None:
        check_actions(self.actions, self.action_names)
        _check_state_size(self)

    @cached_property
    def functions(self) -> tuple[Any, Any, Any]:
        """step, rollout and prior compiled for this type of data (rollout and prior may be None)."""
        if getattr(numba.config, "DISABLE_JIT", 0):
            return self.step, self.rollout, self.prior
        data = typeof(self.data)
        step = callback(_plain(self.step), _STEP_RESULT(_STATE, types.int64, data, _RNG))
        rollout = prior = None
        if self.rollout is not None:
            rollout = callback(
                _plain(self.rollout),
                types.float64(_STATE, types.int64, types.int64, types.int64, types.int64, types.float64, data, _RNG),
            )
        if self.prior is not None:
            prior = callback(
                _plain(self.prior),
                types.void(_STATE, types.int64, types.int64, types.int64, data, _STATE, _COUNTS),
            )
        return step, rollout, prior

    @cached_property
    def upper_function(self) -> Any:
        """`upper` compiled for this type of data, or None."""
        if self.upper is None or getattr(numba.config, "DISABLE_JIT", False):
            return self.upper
        signature = types.float64(_STATE, types.int64, types.int64, types.float64, typeof(self.data))
        return callback(_plain(self.upper), signature)


@dataclass(frozen=True, eq=False)
class ContinuousModel:
    """A compiled generative model whose observations are vectors of numbers; see the module's head for its functions."""

    step: Callable[..., tuple[float, bool]]
    likelihood: Callable[..., float]
    actions: int
    """A: actions are 0 .. A-1."""
    state_size: int
    """D: numbers in a state."""
    observation_size: int = 1
    """O: numbers in an observation."""
    data: Any = ()
    """Arrays and numbers handed to every function."""
    rollout: Callable[..., float] | None = None
    action_names: tuple[str, ...] = ()
    """For people; empty means the numbers."""
    states: StateRange | None = None
    """As in `CompiledModel`."""

    def __post_init__(self) -> None:
        check_actions(self.actions, self.action_names)
        _check_state_size(self)
        require_whole("observation_size", self.observation_size)
        if self.observation_size < 1:
            raise ValueError(f"observation_size is {self.observation_size}, must be >= 1")

    @cached_property
    def functions(self) -> tuple[Any, Any, Any]:
        """step, likelihood and rollout compiled for this type of data (rollout may be None)."""
        if getattr(numba.config, "DISABLE_JIT", 0):
            return self.step, self.likelihood, self.rollout
        data = typeof(self.data)
        result = types.Tuple((types.float64, types.boolean))
        step = callback(_plain(self.step), result(_STATE, types.int64, data, _RNG, _STATE))
        likelihood = callback(_plain(self.likelihood), types.float64(_STATE, types.int64, _STATE, _STATE, data))
        rollout = None
        if self.rollout is not None:
            signature = types.float64(_STATE, types.int64, _STATE, types.int64, types.int64, types.float64, data, _RNG)
            rollout = callback(_plain(self.rollout), signature)
        return step, likelihood, rollout


class PythonModel(Protocol):
    """A generative model in plain Python. Slow: every step is interpreted, some thousand simulations a second at best.

    May also have ``rollout(state, action, observation, depth, max_depth, discount, rng) -> float``,
    ``prior(state, action, observation, depth) -> (values [A], counts [A])``, ``upper(state, depth, max_depth, discount)``, for continuous
    observations ``likelihood(state, action, state reached, observation) -> float``, and ``action_names``, as in `CompiledModel`.
    """

    actions: int

    def step(self, state: Any, action: int, rng: np.random.Generator) -> tuple[Any, Hashable, float, bool]:
        """(next state, observation, reward, terminal). `state` belongs to the belief: return a new one, do not change it."""
        ...


def check_actions(actions: Any, names: tuple[str, ...]) -> None:
    """ValueError unless `actions` is how many there are, and there is a name for each or none."""
    counted = isinstance(actions, Integral)
    if not counted:
        listed = isinstance(actions, Sized) and not isinstance(actions, str)
        remedy = f": write actions = {len(actions)}, and what they are as action_names" if listed else ""
        raise ValueError(f"actions is {actions!r}, must be the number of actions, a whole one{remedy}")
    if actions < 1:
        raise ValueError(f"actions is {actions}, must be >= 1")
    if names and len(names) != actions:
        raise ValueError(f"action_names has {len(names)} names for {actions} actions: give one each, or none")


def _check_state_size(model: CompiledModel | ContinuousModel) -> None:
    require_whole("state_size", model.state_size)
    if model.state_size < 1:
        raise ValueError(f"state_size is {model.state_size}, must be >= 1")
    if model.states is not None and len(model.states.entries[0]) != model.state_size:
        raise ValueError(
            f"states gives the range of {len(model.states.entries[0])} numbers, must be of state_size = {model.state_size}"
        )


def check_model(model: Any) -> None:
    """Raises TypeError when this is no model, ValueError when its actions are wrong."""
    if isinstance(model, type):
        raise TypeError(f"the model is the class {model.__name__}: give an instance of it, {model.__name__}(...)")
    if not callable(getattr(model, "step", None)) or not hasattr(model, "actions"):
        raise TypeError(f"the model, a {type(model).__name__}, needs `actions` and `step`: see tab_marl.planning.model")
    check_actions(model.actions, _names(model))


def check_numbered(model: Any) -> None:
    """Raises TypeError when the model's observations are vectors, which a search that tells observations apart cannot use."""
    if isinstance(model, ContinuousModel):
        raise TypeError(
            "the model is a ContinuousModel, whose observations hardly ever repeat: plan with Pomcpow, or sort its observations "
            "into numbered bins in a CompiledModel"
        )


def numbered(observation: Any, step: Callable[..., Any] | None = None) -> int:
    """An observation of a model that numbers them, from its `step` that runs interpreted, or handed to a filter: a whole
    number by type, as compiled functions insist on.

    Raises TypeError for anything else: a reading cut to a whole number would be another observation.
    """
    if isinstance(observation, int | np.integer | np.bool_):
        return int(observation)
    wrong = f"observation is {observation!r}, must be a whole number"
    if step is not None:
        name = getattr(step, "__name__", "step")
        wrong = f"{name} returned {observation!r} as its observation, which would be cut to a whole number"
    raise TypeError(
        f"{wrong}: give np.int64(...) of a number that stands for what is seen; for observations that are measured, see "
        "ContinuousModel"
    )


class PlainPythonWarning(UserWarning):
    """A model is searched in plain Python."""


_said_slow: set[type] = set()


def warn_of_plain_python(kind: type) -> None:
    """Says once per class of model that it is slow, and what to do."""
    if kind in _said_slow:
        return
    _said_slow.add(kind)
    warnings.warn(
        f"{kind.__name__} is a model in plain Python: every step is interpreted, a hundred to a thousand times slower than "
        "compiled. Once it is right, write its step as a function for CompiledModel, or give table_model its tables",
        PlainPythonWarning,
        stacklevel=3,
    )


def _plain(function: Callable[..., Any]) -> Callable[..., Any]:
    """The Python function behind a jitted one."""
    plain: Callable[..., Any] = getattr(function, "py_func", function)
    return plain


@dataclass(frozen=True, eq=False)
class Particles:
    """A belief as a sample of states."""

    states: NDArray[np.float64]
    """``[P, D]`` for a compiled model (``[P]`` is taken as ``[P, 1]``)."""
    weights: NDArray[np.float64] | None = None
    """``[P]``, >= 0, not all zero, of any scale; None: all alike."""


Sampler: TypeAlias = Callable[[int, np.random.Generator], ArrayLike]
"""``sampler(count, rng) -> [count, D]`` states drawn from the belief."""


def belief_states(
    model: CompiledModel | ContinuousModel, belief: Any, count: int, rng: np.random.Generator
) -> tuple[NDArray[np.float64], NDArray[np.float64] | None]:
    """(states ``[P, D]``, weights ``[P]`` or None) of any kind of belief; a sampler is asked for `count` states."""
    belief, weights = _opened(belief, count, rng)
    states = np.ascontiguousarray(belief, dtype=np.float64)
    if states.ndim == 1:
        states = states.reshape(-1, 1)
    if states.ndim != 2 or states.shape[1] != model.state_size:
        raise ValueError(
            f"the belief's states have shape {states.shape}, must be [P, {model.state_size}] for this model"
        )
    if len(states) == 0:
        raise ValueError(
            "the belief is empty: give at least one state (an updater that lost all particles must refill)"
        )
    check_states(model, states)
    return states, check_weights(weights, len(states))


def check_states(model: CompiledModel | ContinuousModel, states: NDArray[np.float64]) -> None:
    """ValueError naming the first row of `states` [P, D] that is out of the model's range of states, if it gives one."""
    if model.states is None:
        return
    lowest, highest, whole = model.states.entries
    at = int(first_outside(states, lowest, highest, whole))
    if at == ALL_STATES:
        return
    row, entry = divmod(at, model.state_size)
    raise ValueError(
        f"state {row} of the belief is {states[row].tolist()}: its number {entry} must be "
        f"{'whole and ' * bool(whole[entry])}in [{lowest[entry]:.16g}, {highest[entry]:.16g}] for this model. A belief is a list "
        "of states, not of probabilities: give those as weights, Particles(states, weights), or to ExactFilter"
    )


def is_sampler(belief: Any) -> bool:
    """Whether the belief is a function that is asked for states."""
    return callable(getattr(belief, "particles", belief))


def belief_objects(belief: Any, count: int, rng: np.random.Generator) -> tuple[list[Any], NDArray[np.float64] | None]:
    """(states, weights) of a belief over states that are any objects, for a model in plain Python."""
    belief, weights = _opened(belief, count, rng)
    states = list(belief)
    if not states:
        raise ValueError(
            "the belief is empty: give at least one state (an updater that lost all particles must refill)"
        )
    return states, check_weights(weights, len(states))


def _opened(belief: Any, count: int, rng: np.random.Generator) -> tuple[Any, Any]:
    """(states, weights or None) of states, `Particles`, a filter, or a sampler, which is asked for `count` states."""
    belief = getattr(belief, "particles", belief)
    if isinstance(belief, Particles):
        return belief.states, belief.weights
    return belief(count, rng) if callable(belief) else belief, None


def check_weights(weights: ArrayLike | None, count: int) -> NDArray[np.float64] | None:
    if weights is None:
        return None
    w = np.asarray(weights, dtype=np.float64)
    if w.shape != (count,):
        raise ValueError(f"the belief has weights of shape {w.shape} for {count} states")
    if not np.isfinite(w).all() or (w < 0).any() or not w.sum() > 0:
        raise ValueError("the belief's weights must be finite, >= 0 and not all zero")
    return w


def draw_particles(
    count: int, states: int, weights: NDArray[np.float64] | None, rng: np.random.Generator
) -> NDArray[np.int64]:
    """Which particle each of `count` simulations starts from: systematic resampling, then shuffled.

    Each particle is used as often as its weight says, to within one, which is unbiased and steadier than independent draws.
    """
    at = (np.arange(count) + rng.random()) / count
    if weights is None:
        chosen = np.minimum((at * states).astype(np.int64), states - 1)
    else:
        cumulative = np.cumsum(weights)
        chosen = np.searchsorted(cumulative, at * cumulative[-1], side="right").astype(np.int64)
        chosen = np.minimum(chosen, int(np.flatnonzero(weights)[-1]))
    rng.shuffle(chosen)
    return chosen


def action_names(model: Any) -> tuple[str, ...]:
    """Names of the model's actions, or their numbers."""
    return _names(model) or tuple(str(a) for a in range(model.actions))


def _names(model: Any) -> tuple[str, ...]:
    names = getattr(model, "action_names", None)
    return () if names is None else tuple(names)
