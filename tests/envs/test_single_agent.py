"""The Gymnasium views pass Gymnasium's and stable-baselines3's checkers, and scripted players do what they say."""

from __future__ import annotations

import math
import subprocess
import sys
import warnings
from dataclasses import replace

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

from tab_marl.envs import register_all
from tab_marl.envs.opponents import OPPONENTS, Follow, Pursue, make_opponent
from tab_marl.envs.single_agent import SingleAgentEnv, adversary_env, ego_env
from tab_marl.mission.tasks import Task, sample_task
from tab_marl.world.scenario import UnknownName

IDS = ("tab_marl/Ego-v0", "tab_marl/Adversary-v0")


@pytest.mark.parametrize("name", IDS)
def test_gymnasium_checker_with_pictures(name: str) -> None:
    """Without pictures, and stable-baselines3's: every id, in test_conformance.py."""
    register_all()
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_env(gymnasium.make(name, render_mode="rgb_array").unwrapped)


def test_vectorised() -> None:
    register_all()
    venv = gymnasium.make_vec(IDS[1], num_envs=2, vectorization_mode="sync", mission="M4")
    observations, _ = venv.reset(seed=3)
    assert observations.shape == (2, 40)
    assert not np.array_equal(observations[0], observations[1])
    venv.close()


def test_make_by_module_name_in_a_fresh_process() -> None:
    command = (
        "import tab_marl.envs as e; e.register_all(); import gymnasium, sys; "
        "assert 'pygame' not in sys.modules and 'torch' not in sys.modules and 'pymunk' not in sys.modules; "
        "env = gymnasium.make('tab_marl/Ego-v0', mission='M1'); env.reset(seed=0); assert 'pygame' not in sys.modules"
    )
    subprocess.run([sys.executable, "-c", command], check=True, timeout=120)


@pytest.mark.parametrize("mission", ["M1", "M2", "M3", "M4", "M5"])
def test_follower_completes_missions_when_left_alone(mission: str) -> None:
    """On three sampled maps each; the ego stands in a corner of its own start region."""
    done = 0
    for seed in range(3):
        task = sample_task(np.random.default_rng(seed), mission, slack=1.8)
        far = replace(task, scenario=replace(task.scenario, interception_metres=1e-3))
        env = ego_env(task=far)
        env.reset(seed=seed)
        over = False
        while not over:
            *_, terminated, truncated, info = env.step(np.array([-1.0, 0.0], dtype=np.float32))
            over = terminated or truncated
        done += info["mission_status"] == "completed"
    assert done >= 2, f"{mission}: {done} of 3, last: {info['why_failed']}"


def test_pursuer_catches_a_waiting_adversary_it_has_seen(reach_a: Task) -> None:
    """The adversary stands under camera A, with obstacles on the straight way there."""
    env = SingleAgentEnv("adversary", "pursue", task=reach_a, end_on_completion=False)
    env.reset(seed=0, options={"adversary_start": (0.5, 2.5, 0.0), "ego_start": (2.6, 0.9, 0.0)})
    info, over = {}, False
    while not over:
        *_, terminated, truncated, info = env.step(np.array([-1.0, 0.0], dtype=np.float32))
        over = terminated or truncated
    assert info["intercepted"]
    straight = math.dist((0.5, 2.5), (2.6, 0.9)) - 0.3
    assert info["physics_steps"] / 100 < 1.4 * straight / 0.22
    assert not env.inner.episode.arena.touching[0]


def test_static_and_random(reach_a: Task) -> None:
    for name, moves in (("static", False), ("random", True)):
        env = ego_env(name, task=reach_a)
        env.reset(seed=0)
        before = env.inner.episode.motion[1]
        for _ in range(20):
            env.step(np.array([-1.0, 0.0], dtype=np.float32))
        assert (env.inner.episode.motion[1][:3] != before[:3]) == moves
        assert env.inner.episode.motion[0].v == 0.0


def test_random_opponent_follows_the_seed(reach_a: Task) -> None:
    ends = []
    for _ in range(2):
        env = ego_env("random", task=reach_a)
        env.reset(seed=4)
        for _ in range(30):
            env.step(np.array([0.0, 0.0], dtype=np.float32))
        ends.append(env.inner.episode.motion)
    assert ends[0] == ends[1]


def test_policies_and_functions_play(reach_a: Task) -> None:
    class Policy:
        style = "direct"
        seen: list[np.ndarray]

        def reset(self, task: Task, rng: np.random.Generator) -> None:
            self.task, self.seen = task, []

        def act(self, observation: np.ndarray) -> np.ndarray:
            self.seen.append(observation)
            return np.array([1.0, 0.0], dtype=np.float32)

    policy = Policy()
    env = ego_env(policy, task=reach_a)
    env.reset(seed=0)
    for _ in range(3):
        env.step(np.array([-1.0, 0.0], dtype=np.float32))
    assert policy.task is reach_a
    assert [o.shape for o in policy.seen] == [(40,)] * 3
    env = adversary_env(lambda observation: (1.0, 0.0), task=reach_a)
    env.reset(seed=0)
    env.step(np.array([-1.0, 0.0], dtype=np.float32))
    assert env.inner.episode.motion[0].v == pytest.approx(0.22)


def test_bad_opponents() -> None:
    with pytest.raises(UnknownName, match="did you mean 'pursue'"):
        adversary_env("persue")
    with pytest.raises(UnknownName, match="no scripted ego named 'follow'"):
        make_opponent("follow", "ego")
    with pytest.raises(TypeError, match="must be one of"):
        make_opponent(3, "ego")  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="side is 'both'"):
        SingleAgentEnv("both", "static")
    with pytest.raises(RuntimeError, match="call reset first"):
        ego_env().step(np.zeros(2, dtype=np.float32))
    assert OPPONENTS["ego"]["pursue"] is Pursue and OPPONENTS["adversary"]["follow"] is Follow
