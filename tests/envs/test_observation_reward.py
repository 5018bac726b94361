"""The ego's observation by name, and both rewards by hand."""

from __future__ import annotations

import math
from dataclasses import replace

import gymnasium
import numpy as np
import pytest

from tab_marl.envs.ego_observation import ego_rows, ego_space, observe_ego, parse_ego_observation
from tab_marl.envs.opponents import follow_route
from tab_marl.envs.physics import Motion
from tab_marl.envs.reward import SHAPED, AdversaryRewards, Events, adversary_reward, ego_reward
from tab_marl.world.scenario import Scenario, Sensors, UnknownName

OWN = Motion(0.7, 1.9, 2.5, 0.11, -0.6)
OTHER = Motion(2.2, 0.3, -1.2, 0.2, 1.1)
LIMITS = (0.22, 0.22)


def test_parsing_returns_what_was_observed(mixed: Scenario) -> None:
    scenario = replace(mixed, sensors=Sensors(lidar_rays=5))
    ranges = np.linspace(0.1, 1.4, 5)
    observation = observe_ego(OWN, 3.2, 26.8, OTHER, ranges, LIMITS)
    assert observation.shape == (len(ego_rows(scenario)),)
    assert ego_space(scenario).contains(observation)
    view = parse_ego_observation(observation)
    assert (view.x, view.y, view.theta, view.v, view.w) == pytest.approx(OWN, abs=1e-6)
    assert (view.seconds, view.seconds_left) == pytest.approx((3.2, 26.8), abs=1e-6)
    assert view.adversary is not None
    a = view.adversary
    assert (a.x, a.y, a.theta, a.v, a.w) == pytest.approx(OTHER, abs=1e-6)
    assert view.lidar == pytest.approx(ranges, abs=1e-6)


def test_rows_are_where_their_names_say(mixed: Scenario) -> None:
    scenario = replace(mixed, sensors=Sensors(lidar_rays=1))
    row = {r.name: i for i, r in enumerate(ego_rows(scenario))}
    observation = observe_ego(OWN, 3.2, 26.8, OTHER, np.array([0.9]), LIMITS)
    expected = {
        "x": 0.7, "cos": math.cos(2.5), "w": -0.6, "elapsed": 3.2, "left": 26.8, "seen": 1.0, "adversary y": 0.3,
        "adversary sin": math.sin(-1.2), "adversary v": 0.2, "lidar 0": 0.9,
    }  # fmt: skip
    assert {name: float(observation[row[name]]) for name in expected} == pytest.approx(expected, abs=1e-6)


def test_unseen_shows_nothing_of_the_adversary() -> None:
    observation = observe_ego(OWN, 0.0, 30.0, None, None, LIMITS)
    assert observation[8:].tolist() == [0.0] * 7
    assert parse_ego_observation(observation).adversary is None


def test_pushed_beyond_top_speed_stays_in_the_space(mixed: Scenario) -> None:
    observation = observe_ego(OWN._replace(v=-0.3), 0.0, 30.0, OTHER._replace(v=0.4), None, LIMITS)
    assert ego_space(mixed).contains(observation)


@pytest.mark.parametrize("wrong", [np.zeros(7), np.zeros((1, 15)), 3.0])
def test_a_wrong_shape_is_refused(wrong: object) -> None:
    with pytest.raises(ValueError, match=r"shape \[15 \+ lidar rays\]"):
        parse_ego_observation(wrong)  # type: ignore[arg-type]


def test_ego_reward_is_the_papers(mixed: Scenario) -> None:
    """A control step of 0.1 s is a fifth of a tick of 0.5 s."""
    motion = Motion(0, 0, 0, 0.2, -1.0)
    plain = (-1.0 - 0.1 * (0.04 + 1.0)) / 5
    assert ego_reward(Events(), motion, mixed, 0.1) == pytest.approx(plain)
    assert ego_reward(Events(intercepted=True), motion, mixed, 0.1) == pytest.approx(plain + 50)
    assert ego_reward(Events(ego_collided=True), motion, mixed, 0.1) == pytest.approx(plain - 30)
    assert ego_reward(Events(adversary_collided=True, failed=True), motion, mixed, 0.1) == pytest.approx(plain)
    assert ego_reward(Events(completed=True), motion, mixed, 0.1) == pytest.approx(plain - 50)
    paper = Scenario.preset("paper")
    assert ego_reward(Events(completed=True), motion, paper, 0.1) == pytest.approx(plain)


@pytest.mark.parametrize("world", ["lab", "random"])
def test_shaped_reward_telescopes_to_the_way_that_was_to_go(world: str) -> None:
    """Whatever way a follower takes, progress pays the distance-to-go of its start, and nothing is left at the end."""
    env = gymnasium.make("tab_marl:tab_marl/Adversary-v0", mission="M3", scenario=world, opponent="static",
                         adversary_rewards=AdversaryRewards(0.0, 0.0, 0.0, 0.0, 0.0, progress=1.0))  # fmt: skip
    observation, _ = env.reset(seed=5)
    inner = env.unwrapped.inner  # type: ignore[attr-defined]
    side, start = inner._side, inner.episode.motion[1]
    plain = side.task.parts.plain
    to_go = float(plain.metres(side.monitor.location, np.array([start.x, start.y]))[0])
    turn = inner.episode.scenario.adversary.max_turn_rate / inner.episode.scenario.control_hertz
    total, over = 0.0, False
    while not over:
        observation, reward, terminated, truncated, info = env.step(follow_route(observation, turn))
        total += float(reward)
        over = terminated or truncated
    assert info["mission_status"] == "completed"
    # The way is read off at the point looked ahead to, so it may differ from the field's own by a cell.
    assert total == pytest.approx(to_go, abs=0.1)


def test_prices_by_name() -> None:
    assert AdversaryRewards.of("shaped") is SHAPED and AdversaryRewards.of(None) == AdversaryRewards()
    with pytest.raises(UnknownName, match="shaped"):
        AdversaryRewards.of("shapd")
    with pytest.raises(TypeError, match="adversary_rewards"):
        AdversaryRewards.of(3.0)  # type: ignore[arg-type]


def test_adversary_reward(mixed: Scenario) -> None:
    prices = AdversaryRewards(
        completed=10.0, failed=-3.0, intercepted=-7.0, collision=-2.0, per_step=-0.5
    )  # fmt: skip
    pay = lambda **happened: adversary_reward(Events(**happened), prices, mixed, 0.1)
    assert pay() == pytest.approx(-0.1)
    assert pay(completed=True) == pytest.approx(9.9)
    assert pay(failed=True, adversary_collided=True) == pytest.approx(-5.1)
    assert pay(intercepted=True) == pytest.approx(-7.1)
    assert pay(intercepted=True, mission_active=False) == 0.0, "caught after the mission costs nothing"
    assert pay(ego_collided=True, mission_active=False) == 0.0
