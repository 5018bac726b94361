"""The environment of one against one: its registry, options, endings and errors."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import pettingzoo
import pytest
from gymnasium.spaces import Discrete
from pettingzoo.test import api_test, max_cycles_test

from tab_marl.envs import intercept_v0, register_all
from tab_marl.envs.actions import nearest_discrete
from tab_marl.envs.intercept import InterceptEnv
from tab_marl.envs.paper_missions import paper_mission
from tab_marl.mission import MISSIONS, Mission, MissionSyntaxError, parse_mission
from tab_marl.mission.feasibility import InfeasibleMission, check_feasible
from tab_marl.mission.tasks import Task, sample_task
from tab_marl.world.regions import Disc
from tab_marl.world.scenario import Checkpoint, Scenario, UnknownName

FORWARD = np.array([1.0, 0.0], dtype=np.float32)
STILL = np.array([-1.0, 0.0], dtype=np.float32)


def test_the_module_is_what_pettingzoo_expects() -> None:
    """The registered ids take the libraries' tests in test_conformance.py."""
    max_cycles_test(intercept_v0)
    api_test(intercept_v0.raw_env(), num_cycles=20)


def test_registry() -> None:
    register_all()
    register_all()
    parallel = pettingzoo.make("parallel", "tab_marl/intercept-v0", mission="M2", scenario="open")
    assert isinstance(parallel, InterceptEnv)
    parallel.reset(seed=0)
    assert parallel.task.mission_id == "M2" and parallel.task.scenario.name == "open"
    aec = pettingzoo.make("aec", "tab_marl/intercept-v0", max_cycles=3)
    aec.reset(seed=0)
    assert sum(1 for _ in iterate(aec)) == 2 * 3 + 2


def iterate(aec: Any) -> Iterator[str]:
    for agent in aec.agent_iter():
        over = aec.terminations[agent] or aec.truncations[agent]
        aec.step(None if over else STILL)
        yield agent


def run(env: InterceptEnv, ego: np.ndarray, adversary: np.ndarray) -> tuple[int, tuple[Any, ...]]:
    """Constant actions until the end: (steps, last result)."""
    steps = 0
    while env.agents:
        result = env.step({"ego_0": ego, "adversary_0": adversary})
        steps += 1
    return steps, result


def test_horizon_truncates(reach_a: Task) -> None:
    env = InterceptEnv(task=replace(reach_a, scenario=replace(reach_a.scenario, horizon_seconds=4.0)))
    env.reset(seed=1)
    steps, (observations, _, terminations, truncations, infos) = run(env, STILL, STILL)
    assert steps == 40
    assert set(truncations.values()) == {True} and set(terminations.values()) == {False}
    assert infos["ego_0"]["physics_steps"] == 400 and not infos["ego_0"]["intercepted"]
    assert observations["ego_0"][6:8].tolist() == [4.0, 0.0]


def test_interception_terminates(reach_a: Task) -> None:
    env = InterceptEnv(task=reach_a)
    env.reset(seed=1, options={"ego_start": (1.5, 0.6, math.pi), "adversary_start": (1.0, 0.6, 0.0)})
    steps, (_, rewards, terminations, truncations, infos) = run(env, FORWARD, STILL)
    substeps = math.ceil(0.2 / 0.0022 - 1e-9)
    assert infos["adversary_0"]["physics_steps"] == substeps and steps == math.ceil(substeps / 10)
    assert set(terminations.values()) == {True} and set(truncations.values()) == {False}
    assert infos["ego_0"]["intercepted"] and infos["ego_0"]["mission_status"] == "active"
    assert rewards["ego_0"] > 49 and rewards["adversary_0"] < -49


def test_completion_ends_only_on_request(reach_a: Task) -> None:
    start = {"adversary_start": (0.5, 1.9, math.pi / 2)}
    endings = {}
    for ends in (False, True):
        env = InterceptEnv(task=reach_a, end_on_completion=ends)
        env.reset(seed=3, options=start)
        total = 0.0
        while env.agents:
            _, rewards, _, _, infos = env.step({"ego_0": STILL, "adversary_0": FORWARD})
            total += rewards["ego_0"]
        endings[ends] = infos["ego_0"]["physics_steps"]
        assert infos["ego_0"]["mission_status"] == "completed"
        assert infos["ego_0"]["completed_seconds"] == pytest.approx(2.0)
        assert total == pytest.approx(-50.0 - 2.0 * endings[ends] / 100, abs=0.1)
    assert endings == {False: 3000, True: 200}


def test_a_missed_deadline_leaves_the_episode_running(reach_a: Task) -> None:
    env = InterceptEnv(task=reach_a)
    env.reset(seed=3)
    _, (_, _, terminations, truncations, infos) = run(env, STILL, STILL)
    assert truncations["ego_0"] and not terminations["ego_0"]
    assert infos["ego_0"]["mission_status"] == "failed"
    assert "deadline 20 s" in infos["ego_0"]["why_failed"]
    env = InterceptEnv(task=reach_a, end_on_completion=True)
    env.reset(seed=3)
    steps, _ = run(env, STILL, STILL)
    assert steps == 201


def test_the_adversary_is_seen_in_cameras_only(reach_a: Task) -> None:
    scenario = reach_a.scenario
    env, oracle = InterceptEnv(task=reach_a), InterceptEnv(task=reach_a, full_observation=True)
    options = {"adversary_start": (0.5, 1.9, math.pi / 2)}
    env.reset(seed=0, options=options), oracle.reset(seed=0, options=options)
    seen = []
    for _ in range(60):
        actions = {"ego_0": STILL, "adversary_0": FORWARD}
        shown, always = env.step(actions)[0]["ego_0"], oracle.step(actions)[0]["ego_0"]
        adversary = env.episode.motion[1]
        inside = bool(scenario.seen([[adversary.x, adversary.y]])[0])
        assert bool(shown[8]) == inside
        assert always[8] == 1.0 and always[9:11] == pytest.approx(adversary[:2], abs=1e-6)
        assert shown[9:15].tolist() == (always[9:15].tolist() if inside else [0.0] * 6)
        seen.append(inside)
    assert 0 < sum(seen) < 60


def test_an_aware_adversary_sees_the_ego_in_range_and_in_sight(reach_a: Task) -> None:
    scenario = replace(reach_a.scenario, sensors=replace(reach_a.scenario.sensors, adversary_sees_ego_metres=1.2))
    env = InterceptEnv(task=replace(reach_a, scenario=scenario))
    for ego, expected in (((1.4, 0.4, 0.0), 1.0), ((1.7, 0.4, 0.0), 0.0), ((0.35, 2.2, 0.0), 0.0)):
        observations, _ = env.reset(seed=0, options={"adversary_start": (0.4, 0.4, 0.0), "ego_start": ego})
        assert observations["adversary_0"][37] == expected, ego
    observations, _ = env.reset(seed=0, options={"adversary_start": (0.4, 1.4, 0.0), "ego_start": (1.3, 1.4, 0.0)})
    assert observations["adversary_0"][37] == 0.0, "the disc stands between them"


def test_observations_stay_in_their_spaces(reach_a: Task) -> None:
    for task in (reach_a, sample_task(np.random.default_rng(5), "M5"), sample_task(np.random.default_rng(6), "M3")):
        env = InterceptEnv(task=task, adversary_style="side")
        rng = np.random.default_rng(0)
        for seed in range(3):
            observations, _ = env.reset(seed=seed)
            while env.agents:
                for agent, observation in observations.items():
                    assert env.observation_space(agent).contains(observation), (agent, observation)
                observations, *_ = env.step({a: rng.uniform(-1, 1, 2) for a in env.agents})


def test_reset_options(reach_a: Task) -> None:
    env = InterceptEnv(scenario="lab", mission="M1")
    env.reset(seed=0, options={"options": 1, "something": None})
    other = sample_task(np.random.default_rng(1), "M2")
    env.reset(seed=0, options={"task": other, "ego_start": (*other.scenario.ego_start.centre, 0.5)})
    assert env.task is other
    ego = env.episode.motion[0]
    assert ego[:3] == pytest.approx((*other.scenario.ego_start.centre, 0.5))
    with pytest.raises(ValueError, match="0 lidar rays, the environment was made for 12"):
        env.reset(options={"task": reach_a})
    with pytest.raises(ValueError, match=r"needs x up to 6, the environment was made for 3"):
        env.reset(options={"task": replace(other, scenario=Scenario.preset("reef"))})
    with pytest.raises(ValueError, match="never farther apart than"):
        env.reset(options={"ego_start": (1.0, 0.5, 0.0), "adversary_start": (1.1, 0.5, 0.0)})


@pytest.mark.parametrize(
    ("action", "message"),
    [
        (np.array([np.nan, 0.0]), r"'ego_0' is \[nan, 0.0\]: its speed must be a finite number in \[-1, 1\]"),
        (np.array([0.0, np.inf]), "its turn rate must be a finite number"),
        (np.array([0.5, -1.001]), r"'ego_0' is .*its turn rate -1.001 lies outside \[-1, 1\]; clip"),
        (np.array([1e6, 0.0]), r"its speed 1e\+06 lies outside"),
        (np.zeros(3), r"'ego_0' has shape \[3\], must be \[2\]"),
        (np.zeros((1, 2)), r"shape \[1, 2\], must be \[2\]"),
        (np.array([True, False]), "dtype bool, must be two real numbers"),
        (np.array(["1", "0"]), "dtype <U1, must be two real numbers"),
    ],
)
def test_bad_actions(reach_a: Task, action: np.ndarray, message: str) -> None:
    env = InterceptEnv(task=reach_a)
    env.reset(seed=0)
    before = env.state()
    with pytest.raises(ValueError, match=message):
        env.step({"ego_0": action, "adversary_0": STILL})
    with pytest.raises(ValueError, match=message.replace("ego_0", "adversary_0")):
        env.step({"ego_0": STILL, "adversary_0": action})
    assert np.array_equal(env.state(), before), "a refused step changes nothing"


def test_rounding_beyond_the_bounds_is_forgiven(reach_a: Task) -> None:
    motions = []
    for beyond in (0.0, 5e-7):
        env = InterceptEnv(task=reach_a)
        env.reset(seed=0)
        for _ in range(5):
            corner = (1.0 + beyond) * np.array([1.0, -1.0])
            env.step({"ego_0": corner, "adversary_0": -corner})
        motions.append(env.episode.motion)
    assert motions[0] == motions[1]


def test_discrete_actions_are_a_table_of_continuous_ones(reach_a: Task) -> None:
    discrete, continuous = InterceptEnv(task=reach_a, actions="discrete"), InterceptEnv(task=reach_a)
    space = discrete.action_space("ego_0")
    assert isinstance(space, Discrete) and space.n == 15
    discrete.reset(seed=0), continuous.reset(seed=0)
    for number, (speed, turn) in enumerate(itertools.product((0.0, 0.5, 1.0), (-1.0, -0.25, 0.0, 0.25, 1.0))):
        same = np.array([2.0 * speed - 1.0, turn])
        discrete.step({"ego_0": number, "adversary_0": np.int64(number)})
        continuous.step({"ego_0": same, "adversary_0": same})
        assert discrete.episode.motion == continuous.episode.motion
        assert nearest_discrete(same.astype(np.float32)) == number
    for wrong, message in ((15, r"'adversary_0' is 15, must lie in 0..14"), (-1, "is -1"), (1.0, "one whole number"),
                           ([1, 2], "one whole number in 0..14"), (True, "whole number")):  # fmt: skip
        with pytest.raises(ValueError, match=message):
            discrete.step({"ego_0": 0, "adversary_0": wrong})
    with pytest.raises(UnknownName, match="did you mean 'discrete'"):
        InterceptEnv(actions="discret")  # type: ignore[arg-type]


def test_misuse_is_told(reach_a: Task) -> None:
    env = InterceptEnv(task=reach_a, max_cycles=1)
    with pytest.raises(RuntimeError, match="call reset first"):
        env.step({})
    env.reset(seed=0)
    with pytest.raises(ValueError, match="actions lack 'adversary_0'"):
        env.step({"ego_0": STILL})
    run(env, STILL, STILL)
    with pytest.raises(RuntimeError, match="the episode is over"):
        env.step({"ego_0": STILL, "adversary_0": STILL})
    with pytest.raises(RuntimeError, match="needs a render_mode"):
        env.render()
    with pytest.raises(ValueError, match="render_mode is 'ansi'"):
        InterceptEnv(render_mode="ansi")
    with pytest.raises(ValueError, match="max_cycles is 0"):
        InterceptEnv(max_cycles=0)


def test_what_is_played() -> None:
    assert InterceptEnv(mission="Reach Checkpoint B within 30s").reset(seed=0)
    with pytest.raises(UnknownName, match="did you mean 'lab'"):
        InterceptEnv(scenario="labb")
    with pytest.raises(MissionSyntaxError):
        InterceptEnv(mission="Reach the moon")
    with pytest.raises(InfeasibleMission, match=r"Checkpoint A needs [\d.]+ s .* allows 5 s"):
        InterceptEnv(mission="Reach Checkpoint A within 5s")
    with pytest.raises(UnknownName, match="did you mean 'ambiguous'"):
        InterceptEnv(scenario="random", family="ambigous")
    with pytest.raises(ValueError, match="with scenario 'random' it must be one of"):
        InterceptEnv(scenario="random", mission="Reach Checkpoint B within 30s")
    with pytest.raises(TypeError, match="mission is 3"):
        InterceptEnv(mission=3)  # type: ignore[arg-type]
    with pytest.raises(UnknownName, match="style"):
        InterceptEnv(adversary_style="drunk")


def test_random_scenarios_differ_between_episodes_and_follow_the_seed() -> None:
    env, twin = (InterceptEnv(scenario="random", mission="M1", family="ambiguous") for _ in range(2))
    tasks = []
    for seed in (5, None, None):
        env.reset(seed=seed), twin.reset(seed=seed)
        assert env.task == twin.task
        tasks.append(env.task)
    assert len(set(tasks)) == 3


@pytest.mark.parametrize("preset", ["lab", "open", "reef"])
def test_the_papers_missions_fit_every_map(preset: str) -> None:
    """At a slack of 1.5 by the shortest path; feasibility, which knows clocks, must agree with room to spare."""
    scenario = Scenario.preset(preset)
    for mission_id in ("M1", "M2", "M3", "M4", "M5"):
        task = paper_mission(mission_id, scenario)
        assert mission_id == task.mission.name
        assert check_feasible(task.mission, task.scenario) + 10.0 <= task.scenario.horizon_seconds
        literal = [(c.type, c.places) for c in parse_mission(MISSIONS[mission_id], scenario, target=(1.0, 1.0)).goals]
        assert [t for t, _ in literal] == [c.type for c in task.mission.goals]
    within = paper_mission("M1", scenario).mission.goals[0].seconds
    assert within is not None
    tight = replace(paper_mission("M1", scenario).mission.goals[0], seconds=within / 1.5 - 2.5)
    with pytest.raises(InfeasibleMission):
        check_feasible(Mission((tight,)), scenario, scenario.adversary_start.centre)


def test_mission_object(mixed: Scenario, reach_a: Task) -> None:
    tiny = replace(mixed, checkpoints=(Checkpoint("Home", 0.5, 2.5),), ego_start=Disc(2.0, 0.5, 0.1))
    env = InterceptEnv(mission=Mission((replace(reach_a.mission.constraints[0], places=("Home",)),)), scenario=tiny)
    env.reset(seed=0)
    assert env.task.scenario is tiny
