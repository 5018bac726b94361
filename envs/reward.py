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

The adversary's are the plain ones below by default. They are sparse: `SHAPED` ones, which `adversary_rewards="shaped"`
asks for, also pay for every metre of progress along the route, and a learner needs them. The adversary is hunted in
interception only: meeting the ego costs it nothing in the other tasks.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

from tab_marl.envs.physics import Motion
from tab_marl.world.scenario import Scenario, UnknownName


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
    progress: float = 0.0
    """Per metre by which the distance-to-go drops, along the plain route through all remaining visits; what is left is
    paid at completion (potential-based shaping, Ng, Harada and Russell 1999)."""
    excess: float = 0.0
    """Per metre (seconds x top speed) by which the excess time before an arrival time drops: who comes early must wait."""

    @classmethod
    def of(cls, prices: AdversaryRewards | str | None) -> AdversaryRewards:
        """Prices as they are, by name ("plain", "shaped"), or None for the plain ones. Raises UnknownName, TypeError."""
        if prices is None:
            return PLAIN
        if isinstance(prices, str):
            if prices not in PRICES:
                raise UnknownName("adversary_rewards", prices, PRICES)
            return PRICES[prices]
        if not isinstance(prices, cls):
            raise TypeError(
                f"adversary_rewards is {prices!r}, must be an AdversaryRewards, one of {list(PRICES)}, or None"
            )
        return prices


PLAIN = AdversaryRewards()
SHAPED = AdversaryRewards(
    completed=4.0, failed=-3.0, intercepted=-4.0, collision=-0.05, per_step=-0.05, progress=2.0, excess=4.0
)
"""Of the size that the batched training world pays (`batched.Prices`)."""
PRICES = {"plain": PLAIN, "shaped": SHAPED}


class Gained(NamedTuple):
    """What a step brought along the route, in metres (`adversary_kernels.gained`)."""

    metres: float = 0.0
    excess: float = 0.0


NOTHING = Gained()


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


def adversary_reward(
    events: Events, prices: AdversaryRewards, scenario: Scenario, seconds: float, gained: Gained = NOTHING
) -> float:
    """The adversary's reward over a control step of so many seconds."""
    reward = prices.progress * gained.metres + prices.excess * gained.excess
    if events.adversary_collided:
        reward += prices.collision
    if events.mission_active:
        reward += prices.per_step * seconds / scenario.step_seconds
        if events.intercepted:
            reward += prices.intercepted
    if events.completed:
        reward += prices.completed
    if events.failed:
        reward += prices.failed
    return reward
