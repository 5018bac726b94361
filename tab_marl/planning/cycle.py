"""One cycle of belief, plan, act and update, over and over: a game of a planner against a model of the world."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol, TypeVar

import numpy as np

from tab_marl.planning.model import CompiledModel, ContinuousModel, check_model, numbered

Belief = TypeVar("Belief")


class TrackedBelief(Protocol):
    """What `ParticleFilter` and `ExactFilter` have in common."""

    def sample(self, count: int, rng: np.random.Generator) -> Any: ...

    def update(self, action: int, observation: Any) -> Any:
        """Returns the belief after the step (it may be the same object, changed)."""
        ...


@dataclass(frozen=True)
class Game:
    """What happened in a game."""

    actions: tuple[int, ...]
    observations: tuple[Any, ...]
    rewards: tuple[float, ...]
    ended: bool
    """Whether a terminal state was reached (else `max_steps` was)."""

    def discounted(self, discount: float) -> float:
        """The return, counted from the first action."""
        return float(sum(reward * discount**t for t, reward in enumerate(self.rewards)))


def play(
    model: Any,
    start: Any,
    belief: Belief,
    choose: Callable[[Belief, np.random.Generator], int],
    update: Callable[[Belief, int, Any], Belief],
    rng: np.random.Generator | int,
    max_steps: int = 100,
) -> Game:
    """Plays from the hidden state `start` until the process ends or `max_steps` were done.

    `start` is [D] numbers, or for a model in plain Python any object. `model` is the world: a `CompiledModel`, a `ContinuousModel`
    or a plain Python one; it need not be the planner's.
    ``choose(belief, rng) -> action`` sees the belief alone, ``update(belief, action, observation) -> belief`` follows it; with a
    filter that is ``lambda belief, a, o: belief.update(a, o)``, with a planner
    ``lambda belief, rng: planner.plan(belief, rng).action``. The observation of the step that ends the process is recorded as the
    model gave it (not a number where a `ContinuousModel` wrote none), but not believed.
    """
    random = np.random.default_rng(rng)
    step = _stepper(model, random)
    state: Any = start
    if isinstance(model, CompiledModel | ContinuousModel):
        state = np.array(start, dtype=np.float64).reshape(model.state_size)
    actions, observations, rewards = list[int](), list[Any](), list[float]()
    ended = False
    while not ended and len(actions) < max_steps:
        action = int(choose(belief, random))
        state, observation, reward, ended = step(state, action)
        actions.append(action)
        observations.append(observation)
        rewards.append(float(reward))
        if not ended:
            belief = update(belief, action, observation)
    return Game(tuple(actions), tuple(observations), tuple(rewards), bool(ended))


def _stepper(model: Any, random: np.random.Generator) -> Callable[[Any, int], tuple[Any, Any, float, bool]]:
    """``(state, action) -> (next state, observation, reward, terminal)`` of a model of any kind."""
    word = random.integers(2**64, size=1, dtype=np.uint64)

    def counted(state: Any, action: int) -> tuple[Any, Any, float, bool]:
        observation, reward, ended = model.step(state, action, model.data, word)
        return state, numbered(observation, model.step), reward, ended

    def measured(state: Any, action: int) -> tuple[Any, Any, float, bool]:
        observation = np.full(model.observation_size, np.nan)
        reward, ended = model.step(state, action, model.data, word, observation)
        return state, observation, reward, ended

    def plain(state: Any, action: int) -> tuple[Any, Any, float, bool]:
        result: tuple[Any, Any, float, bool] = model.step(state, action, random)
        return result

    if isinstance(model, CompiledModel):
        return counted
    if isinstance(model, ContinuousModel):
        return measured
    check_model(model)
    return plain
