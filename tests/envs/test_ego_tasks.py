"""Avoidance and surveillance: what ends an episode, what is paid, what is seen; by hand on an open floor."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from tab_marl.envs.ego_observation import parse_ego_observation
from tab_marl.envs.intercept import InterceptEnv
from tab_marl.mission.tasks import Task
from tab_marl.world.ego_tasks import far_goal
from tab_marl.world.grid import free_points
from tab_marl.world.presets import PRESETS
from tab_marl.world.regions import Box, Disc
from tab_marl.world.scenario import Rewards, Scenario, UnknownName

FORWARD = np.array([1.0, 0.0], dtype=np.float32)
STILL = np.array([-1.0, 0.0], dtype=np.float32)
PER_STEP = -1.0 / 5
"""The price of a control step of 0.1 s, a fifth of a tick."""
DRIVING = PER_STEP - 0.1 * 0.22**2 / 5


def playing(task: Task, scenario: Scenario, **start: tuple[float, float, float]) -> InterceptEnv:
    env = InterceptEnv(task=replace(task, scenario=scenario))
    env.reset(seed=0, options=start)
    return env


def until_the_end(env: InterceptEnv, ego: np.ndarray, adversary: np.ndarray) -> tuple[list[float], list[float], dict]:
    """Rewards of the ego and of the adversary, and the last infos with both endings."""
    egos, adversaries = [], []
    while env.agents:
        _, rewards, terminations, truncations, infos = env.step({"ego_0": ego, "adversary_0": adversary})
        egos.append(rewards["ego_0"]), adversaries.append(rewards["adversary_0"])
    return egos, adversaries, {**infos["ego_0"], "terminated": terminations["ego_0"], "truncated": truncations["ego_0"]}


def test_avoidance_ends_at_the_goal(reach_a: Task) -> None:
    scenario = reach_a.scenario.for_task("avoidance", Disc(2.0, 0.4, 0.2))
    env = playing(reach_a, scenario, ego_start=(2.6, 0.4, math.pi), adversary_start=(0.4, 0.4, 0.0))
    paid, _, end = until_the_end(env, FORWARD, STILL)
    assert len(paid) == math.ceil(0.4 / 0.022 - 1e-9), "0.4 m to the goal's edge at 0.22 m/s"
    assert paid[:-1] == pytest.approx([DRIVING] * (len(paid) - 1))
    assert paid[-1] == pytest.approx(DRIVING + 50.0)
    assert end["arrived"] and not end["encountered"] and not end["intercepted"]
    assert end["terminated"] and not end["truncated"]


def test_avoidance_ends_at_an_encounter(reach_a: Task) -> None:
    """At the substep in which the centres are within 0.3 m; it costs the ego, and the adversary nothing."""
    scenario = reach_a.scenario.for_task("avoidance", Disc(2.0, 0.4, 0.2))
    env = playing(reach_a, scenario, ego_start=(1.5, 0.6, math.pi), adversary_start=(1.0, 0.6, 0.0))
    paid, others, end = until_the_end(env, FORWARD, STILL)
    assert end["physics_steps"] == math.ceil(0.2 / 0.0022 - 1e-9)
    assert paid[-1] == pytest.approx(DRIVING - 50.0)
    assert end["encountered"] and not end["arrived"] and not end["intercepted"] and end["terminated"]
    assert others == pytest.approx([-0.02] * len(others))


def test_a_completed_mission_costs_only_the_interceptor(reach_a: Task) -> None:
    totals = {}
    for scenario in (reach_a.scenario, reach_a.scenario.for_task("avoidance", Disc(2.0, 0.4, 0.2)),
                     reach_a.scenario.for_task("surveillance")):  # fmt: skip
        env = playing(reach_a, scenario, adversary_start=(0.5, 1.9, math.pi / 2), ego_start=(2.6, 2.6, 0.0))
        paid, _, end = until_the_end(env, STILL, FORWARD)
        assert end["mission_status"] == "completed" and end["truncated"]
        totals[scenario.ego_task] = sum(paid)
    assert totals == pytest.approx({"interception": -110.0, "avoidance": -60.0, "surveillance": -60.0})


def test_surveillance_pays_by_the_second_in_sight(reach_a: Task) -> None:
    """The adversary drives away from a standing ego: watched up to 0.8 m, whether a camera sees it or not."""
    scenario = replace(reach_a.scenario.for_task("surveillance"), rewards=Rewards(per_step=0.0, watched=3.0))
    env = playing(reach_a, scenario, ego_start=(1.2, 0.4, 0.0), adversary_start=(1.6, 0.4, 0.0))
    gaps, watched, shown, paid = [], [], [], []
    while env.agents:
        observations, rewards, _, _, infos = env.step({"ego_0": STILL, "adversary_0": FORWARD})
        ego, adversary = env.episode.motion
        gaps.append(math.hypot(adversary.x - ego.x, adversary.y - ego.y))
        watched.append(infos["ego_0"]["watched"])
        shown.append(parse_ego_observation(observations["ego_0"]).adversary is not None)
        paid.append(rewards["ego_0"])
    assert watched == [gap <= 0.8 for gap in gaps] and 0 < sum(watched) < len(watched)
    assert paid == pytest.approx([0.3 * now for now in watched])
    assert infos["ego_0"]["watched_seconds"] == pytest.approx(sum(watched) / 10)
    cameras = [bool(scenario.seen([[1.6 + 0.022 * (i + 1), 0.4]])[0]) for i in range(20)]
    assert shown[:20] == [w or c for w, c in zip(watched[:20], cameras, strict=True)]
    assert len(paid) == 300, "it runs to the horizon"


def test_surveillance_needs_a_free_line_and_survives_an_encounter(reach_a: Task) -> None:
    scenario = reach_a.scenario.for_task("surveillance")
    env = playing(reach_a, scenario, ego_start=(1.3, 1.4, 0.0), adversary_start=(0.4, 1.4, 0.0))
    assert not env.episode.watched, "0.9 m away"
    env.reset(options={"ego_start": (1.2, 1.4, 0.0), "adversary_start": (0.42, 1.4, 0.0)})
    assert not env.episode.watched, "the disc stands between them"
    env.reset(options={"ego_start": (1.0, 0.5, math.pi), "adversary_start": (0.5, 0.5, 0.0)})
    paid, _, end = until_the_end(env, FORWARD, FORWARD)
    assert len(paid) == 300 and end["truncated"] and not end["terminated"] and not end["intercepted"]
    ego, adversary = env.episode.motion
    assert math.hypot(ego.x - adversary.x, ego.y - adversary.y) == pytest.approx(0.21, abs=2e-3), "they push each other"
    assert end["watched_seconds"] == pytest.approx(30.0)


def test_the_goal_is_observed(reach_a: Task) -> None:
    scenario = reach_a.scenario.for_task("avoidance", Box(1.9, 0.3, 2.1, 0.6))
    for rays in (0, 4):
        world = replace(scenario, sensors=replace(scenario.sensors, lidar_rays=rays))
        env = InterceptEnv(task=replace(reach_a, scenario=world))
        observations, _ = env.reset(seed=1)
        assert env.observation_space("ego_0").contains(observations["ego_0"])
        view = parse_ego_observation(observations["ego_0"], world)
        assert view.goal == pytest.approx((2.0, 0.45)) and view.lidar.shape == (rays,)
    with pytest.raises(ValueError, match=r"has shape \[17\], got \[21\]"):
        parse_ego_observation(observations["ego_0"], scenario)


@pytest.mark.parametrize("name", [name for name in PRESETS if "-" not in name])
def test_a_far_goal_can_be_reached_and_stood_in(name: str) -> None:
    scenario = Scenario.preset(name)
    goal = far_goal(scenario)
    around = [(goal.x + goal.radius * math.cos(a), goal.y + goal.radius * math.sin(a)) for a in np.arange(0, 6.3, 0.1)]
    assert free_points(scenario, around, 0.049).all()
    assert scenario.for_task("avoidance").ego_goal == goal
    apart = math.dist(goal.centre, scenario.ego_start.centre)
    assert apart > 0.6 * min(scenario.width_metres, scenario.height_metres)


def test_contradictory_ego_tasks_are_refused() -> None:
    lab = Scenario.preset("lab")
    with pytest.raises(UnknownName, match="did you mean 'avoidance'"):
        lab.for_task("avoidence")  # type: ignore[arg-type]
    with pytest.raises(ValueError, match=r"'interception' and ego_goal is Disc.*only avoidance has a goal"):
        lab.for_task("interception", Disc(1, 1, 0.2))
    with pytest.raises(ValueError, match="give the region that it must reach, or use"):
        replace(lab, ego_task="avoidance")
    with pytest.raises(ValueError, match=r"centre of ego_goal \(4, 1\) lies outside the 3.0 x 3.0 m arena"):
        lab.for_task("avoidance", Disc(4, 1, 0.2))
    with pytest.raises(ValueError, match="watch_metres is 0"):
        lab.for_task("surveillance", watch_metres=0)
    env = InterceptEnv()
    with pytest.raises(ValueError, match="is for surveillance, the environment was made for interception"):
        env.reset(options={"task": InterceptEnv(scenario="lab-surveillance")._source(np.random.default_rng())})
