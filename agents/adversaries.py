"""Adversaries as objects: the trained policies' common interface, and the scripted follower they are compared with."""

from __future__ import annotations

from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from tab_marl.envs.opponents import follow_route
from tab_marl.envs.styles import Style
from tab_marl.mission.tasks import Task


class AdversaryPolicy(Protocol):
    """What plays the adversary: from its observation (layout: `tab_marl.envs.adversary_observation`) to an action."""

    @property
    def name(self) -> str: ...

    @property
    def style(self) -> Style:
        """How its route fields are bent; the environment builds the observation from it."""
        ...

    def reset(self, task: Task, rng: np.random.Generator) -> None:
        """Called before every episode."""
        ...

    def act(self, observation: NDArray[np.float32]) -> NDArray[np.float32]:
        """Action ``[2]`` in [-1, 1] for ``[D]``, or ``[N, 2]`` for ``[N, D]``."""
        ...


class ScriptedAdversary:
    """Turns towards the route and drives along it, and waits where it would be too early. Nothing is learned.

    It follows the same route field as the trained policies, styles included: the baseline that shows what learning adds.
    """

    def __init__(self, style: Style | None = None, name: str = "scripted") -> None:
        self.name = name
        self.style = style or Style()
        self._turn_per_step = 0.182

    def reset(self, task: Task, rng: np.random.Generator) -> None:
        """Take over the robot's turn rate and the control rate."""
        self._turn_per_step = task.scenario.adversary.max_turn_rate / task.scenario.control_hertz

    def act(self, observation: NDArray[np.float32]) -> NDArray[np.float32]:
        return follow_route(observation, self._turn_per_step)
