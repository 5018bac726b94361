"""Rewards of both sides, per control step.

The ego's prices are `Scenario.rewards` (the paper's, plus the price of a completed mission and those of the other ego
tasks); those per time step are for one tick of `Scenario.step_seconds` and are charged in proportion to the control step:

==================  ==========================  ==================================================================
term                ego tasks                   when
==================  ==========================  ==================================================================
per_step, control   all                         every control step
collision           all                         each time the ego starts touching a wall or an obstacle
interception        interception                once, at interception
mission_completed   interception                once, when the adversary completes its mission
encounter           avoidance                   once, when the ego meets the adversary
arrival             avoidance                   once, when the ego is in its goal
watched             surveillance                per second, while the ego watches the adversary
==================  ==========================  ==================================================================

The adversary's are the plain default below; learned adversaries are trained with a shaped one. It is hunted in
interception only: meeting the ego costs it nothing in the other tasks.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

from tab_marl.envs.physics import Motion
from tab_marl.world.scenario import Scenario


@dataclass(frozen=True)
class AdversaryRewards:
    """What the adversary is paid."""

    completed: float = 50.0
    """Once, when its mission is completed."""
    failed: float = -25.0
    """Once, when its mission can no longer be completed."""
    intercepted: float = -50.0
    """Once, when it is intercepted before its mission is completed; afterwards being caught costs nothing."""
    collision: float = -5.0
    """Each time it starts touching a wall or an obstacle."""
    per_step: float = -0.1
    """Per tick of `Scenario.step_seconds`, while its mission is under way."""


class Events(NamedTuple):
    """What happened during one control step."""

    intercepted: bool = False
    """Ego task interception: the robots met."""
    completed: bool = False
    """The mission was completed during this step."""
    failed: bool = False
    """The mission failed during this step."""
    ego_collided: bool = False
    """The ego began to touch a wall or an obstacle."""
    adversary_collided: bool = False
    mission_active: bool = True
    """The mission was under way when the step began."""
    encountered: bool = False
    """Ego task avoidance: the robots met."""
    arrived: bool = False
    """Ego task avoidance: the ego is in its goal."""
    watched: bool = False
    """Ego task surveillance: the ego watches the adversary at the end of the step."""


def ego_reward(events: Events, motion: Motion, scenario: Scenario, seconds: float) -> float:
    """The ego's reward (the paper's, section 5, in interception) over a control step of so many seconds."""
    prices = scenario.rewards
    reward = (prices.per_step + prices.control * (motion.v**2 + motion.w**2)) * seconds / scenario.step_seconds
    if events.intercepted:
        reward += prices.interception
    if events.ego_collided:
        reward += prices.collision
    if scenario.ego_task == "interception":
        if events.completed:
            reward += prices.mission_completed
    elif events.encountered:
        reward += prices.encounter
    elif events.arrived:
        reward += prices.arrival
    elif events.watched:
        reward += prices.watched * seconds
    return reward


def adversary_reward(events: Events, prices: AdversaryRewards, scenario: Scenario, seconds: float) -> float:
    """The adversary's plain reward over a control step of so many seconds."""
    reward = prices.collision if events.adversary_collided else 0.0
    if events.mission_active:
        reward += prices.per_step * seconds / scenario.step_seconds
        if events.intercepted:
            reward += prices.intercepted
    if events.completed:
        reward += prices.completed
    if events.failed:
        reward += prices.failed
    return reward
