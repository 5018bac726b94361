"""Opponents by name: policies of the zoo, planners, and models that stable-baselines3 saved.

The environments' `opponent` argument asks here (`envs.registration.register_all`) for every name that is no scripted
player's. A model file is read as plain weights: nothing in it is executed, unlike with stable-baselines3's own `load`.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from tab_marl.agents.planners import PLANNERS, make_planner
from tab_marl.agents.policies.actor import Actor, ActorError, Memory
from tab_marl.agents.policies.cards import is_name
from tab_marl.agents.policies.sb3_actors import read_zip
from tab_marl.agents.policies.zoo import CARD_FILE, SHIPPED, PolicyError, all_policies, find_policy, user_zoo
from tab_marl.envs.opponents import OPPONENTS, Player
from tab_marl.mission.tasks import Task
from tab_marl.world.scenario import UnknownName


def load_opponent(name: str, side: str) -> Player:
    """The player of this name for a side, "ego" or "adversary".

    A zoo policy's name or folder (adversary), a planner's name (ego), or a ``.zip`` that stable-baselines3 or sb3-contrib
    saved (PPO, A2C, SAC, TD3, TQC or RecurrentPPO with a plain policy and no normalisation; either side). Raises UnknownName, PolicyError.
    """
    if name.endswith(".zip"):
        return load_model(name)
    if side == "ego":
        if name in PLANNERS:
            return make_planner(name)
        raise UnknownName(f"scripted {side}", name, [*OPPONENTS[side], *PLANNERS])
    in_zoo = is_name(name) and any((root / name / CARD_FILE).exists() for root in (SHIPPED, user_zoo()))
    if in_zoo or Path(name).exists():
        return find_policy(name)
    raise UnknownName(f"scripted {side}", name, [*OPPONENTS[side], *(policy.name for policy, _ in all_policies())])


class SavedModel:
    """The actor of a saved model as a player: the mean action of a continuous one, the likeliest of a discrete one."""

    def __init__(self, name: str, actor: Actor) -> None:
        self.name, self.actor, self.memory = name, actor, Memory()

    def reset(self, task: Task, rng: np.random.Generator) -> None:
        """Begin an episode."""
        self.memory.clear()

    def begin(self, which: NDArray[np.int64]) -> None:
        """Of the episodes played side by side, these begin anew."""
        self.memory.begin(which)

    def another(self) -> SavedModel:
        """The same actor with a memory of its own."""
        return SavedModel(self.name, self.actor)

    def act(self, observation: NDArray[np.float32]) -> NDArray[np.float32]:
        """Action ``[2]`` (``[N, 2]``) in [-1, 1] for an observation ``[D]`` (``[N, D]``).

        Raises ValueError if the model is for another one.
        """
        seen = np.asarray(observation, dtype=np.float32)
        if seen.shape[-1] != self.actor.network.layers[0]:
            raise ValueError(
                f"{self.name} was trained on {self.actor.network.layers[0]} observed numbers, this side observes "
                f"{seen.shape[-1]}: it is for the other side, or for an environment with another layout"
            )
        return self.actor(seen, self.memory)


def load_model(path: Path | str) -> SavedModel:
    """The actor in a zip that stable-baselines3 saved. Raises PolicyError: no such file, or no actor that is known here."""
    try:
        return SavedModel(Path(path).name, read_zip(path).actor)
    except ActorError as error:
        raise PolicyError(str(error)) from None
