"""The adversary's side of an episode: its task under a style, and what it observes at every step."""

from __future__ import annotations

import math

import numpy as np
from gymnasium.spaces import Box
from numpy.typing import NDArray

from tab_marl.envs.adversary_observation import AdversaryObserver, AdversaryTask, observation_bounds
from tab_marl.envs.lidar import Lidar
from tab_marl.envs.physics import Motion
from tab_marl.envs.reward import Gained
from tab_marl.envs.styles import Style
from tab_marl.mission.monitor import Monitor
from tab_marl.mission.tasks import Task
from tab_marl.world.scenario import Scenario


def adversary_space() -> Box:
    """The Box of the adversary's observation (layout: `adversary_observation`), float32."""
    low, high = observation_bounds()
    return Box(low, high, dtype=np.float32)


def as_style(style: Style | str | None) -> Style:
    """A style by name or as it is; None is the direct one. Raises UnknownName, TypeError."""
    if style is None:
        return Style()
    if isinstance(style, str):
        return Style.preset(style)
    if not isinstance(style, Style):
        raise TypeError(f"adversary_style is {style!r}, must be a Style, the name of one, or None")
    return style


def notices_ego(scenario: Scenario, adversary: Motion, ego: Motion) -> bool:
    """Whether the adversary is aware of the ego: within its range of sight and with a free line between them."""
    reach = scenario.sensors.adversary_sees_ego_metres
    if reach == 0.0 or math.hypot(ego.x - adversary.x, ego.y - adversary.y) > reach:
        return False
    return Lidar.of(scenario).sees(adversary.x, adversary.y, ego.x, ego.y)


class AdversarySide:
    """What one adversary knows in one episode. Observing has a memory (via points passed), so observe once per step."""

    def __init__(self, task: Task, style: Style, rng: np.random.Generator) -> None:
        self.task = AdversaryTask.build(task.scenario, task.mission, style, rng)
        self.monitor = Monitor(
            task.mission, task.scenario, 1.0 / task.scenario.control_hertz, automaton=self.task.automaton
        )
        self._observer = AdversaryObserver(self.task)
        self.gained = Gained()
        """Between the last two observations."""

    def observe(self, own: Motion, ego: Motion | None) -> NDArray[np.float32]:
        """``[OBSERVED]``; `ego` is None while it is not noticed. Zeros once the mission is over."""
        noticed = None if ego is None else (ego.x, ego.y)
        observation = self._observer.observe(*own, self.monitor.location, self.monitor.clocks, noticed)
        self.gained = self._observer.gained
        return observation
