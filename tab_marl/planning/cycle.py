"""One cycle of belief, plan, act and update, over and over: a game of a planner against a model of the world."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol, TypeVar

import numpy as np
from numpy.typing import ArrayLike

from tab_marl.planning.model import CompiledModel, ContinuousModel

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
    model: CompiledModel | ContinuousModel,
    start: ArrayLike,
    belief: Belief,
    choose: Callable[[Belief, np.random.Generator], int],
    update: Callable[[Belief, int, Any], Belief],
    rng: np.random.Generator | int,
    max_steps: int = 100,
) -> Game:
    """Plays from the hidden state `start` [D] until the process ends or `max_steps` were done.

    ``choose(belief, rng) -> action`` sees the belief alone, ``update(belief, action, observation) -> belief`` follows it; with a
    filter that is ``lambda belief, a, o: belief.update(a, o)``, with a planner
    ``lambda belief, rng: planner.plan(belief.sample, rng).action``.
    """
    random = np.random.default_rng(rng)
    state = np.array(start, dtype=np.float64).reshape(model.state_size)
    word = random.integers(2**64, size=1, dtype=np.uint64)
    actions, observations, rewards = list[int](), list[Any](), list[float]()
    ended = False
    while not ended and len(actions) < max_steps:
        action = int(choose(belief, random))
        observation: Any
        if isinstance(model, ContinuousModel):
            observation = np.empty(model.observation_size)
            reward, ended = model.step(state, action, model.data, word, observation)
        else:
            observation, reward, ended = model.step(state, action, model.data, word)
        actions.append(action)
        observations.append(observation)
        rewards.append(float(reward))
        if not ended:
            belief = update(belief, action, observation)
    return Game(tuple(actions), tuple(observations), tuple(rewards), bool(ended))
