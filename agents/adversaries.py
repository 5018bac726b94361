"""Adversaries as objects: the trained policies' common interface, and the scripted follower they are compared with."""

from __future__ import annotations

from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from tab_marl.envs import adversary_kernels as rows
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

    WAIT_SECONDS = 0.2
    """Excess time beyond which it waits."""

    def __init__(self, style: Style | None = None, name: str = "scripted") -> None:
        self.name = name
        self.style = style or Style()
        self._turn_per_step = 0.182

    def reset(self, task: Task, rng: np.random.Generator) -> None:
        """Take over the robot's turn rate and the control rate."""
        self._turn_per_step = task.scenario.adversary.max_turn_rate / task.scenario.control_hertz

    def act(self, observation: NDArray[np.float32]) -> NDArray[np.float32]:
        o = np.atleast_2d(observation)
        forward, left = o[:, rows.O_ROUTE], o[:, rows.O_ROUTE + 1]
        waits = (o[:, rows.O_TARGET] > 0.5) & (10.0 * o[:, rows.O_TARGET + 1] > self.WAIT_SECONDS)
        nowhere = (forward == 0) & (left == 0)
        speed = np.where((forward < 0.5) | waits | nowhere, 0.0, np.minimum(forward, o[:, rows.O_LIMIT]))
        turn = np.clip(np.arctan2(left, forward) / self._turn_per_step, -1.0, 1.0)
        action = np.stack([2.0 * speed - 1.0, np.where(nowhere, 0.0, turn)], axis=1).astype(np.float32)
        return action if np.ndim(observation) == 2 else action[0]
