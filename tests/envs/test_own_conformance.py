"""What the libraries' tests do not ask, of every id: whole episodes repeat in another process, copies go on exactly, nothing
returned is shared, nothing observed is out of bounds, bad actions are refused, and bodies stay where they belong."""

from __future__ import annotations

import copy
import hashlib
import itertools
import json
import os
import pickle
import subprocess
import sys
from typing import Any

import gymnasium
import numpy as np
import pettingzoo
import pytest
from gymnasium.spaces import Discrete

from tab_marl.envs import register_all
from tab_marl.envs.containment import DRIVINGS, random_episode, together
from tab_marl.envs.registration import ENVIRONMENTS

register_all()

ZOO_IDS = [environment.pettingzoo_id for environment in ENVIRONMENTS]
VIEWS = [name for environment in ENVIRONMENTS for name in environment.gymnasium_ids]
CONTINUOUS = [name for name in ZOO_IDS if "discrete" not in name]


def make(name: str, **arguments: Any) -> Any:
    return pettingzoo.make("parallel", name, **arguments)


def act(env: Any, rng: np.random.Generator) -> dict[str, Any]:
    """Mostly forward, into walls."""
    actions: dict[str, Any] = {}
    for agent in env.agents:
        if isinstance(env.action_space(agent), Discrete):
            actions[agent] = int(rng.integers(8, 15))
        else:
            actions[agent] = np.array([1.0, rng.uniform(-0.3, 0.3)], dtype=np.float32)
    return actions


def play(env: Any, rng: np.random.Generator, steps: int) -> list[Any]:
    """So many steps: everything that they return, floats as exact bytes."""
    record: list[Any] = []
    for _ in range(steps):
        if not env.agents:
            break
        observations, *rest = env.step(act(env, rng))
        shown = {agent: observation.tobytes() for agent, observation in observations.items()}
        record.append((shown, repr(rest), env.state().tobytes()))
    return record


def digest(name: str) -> str:
    env = make(name, max_cycles=60)
    env.reset(seed=5)
    return hashlib.sha256(repr(play(env, np.random.default_rng(1), 60)).encode()).hexdigest()


def test_whole_episodes_repeat_in_another_process() -> None:
    """Another hash seed, another address space, every id."""
    command = (
        f"import sys, json; sys.path.insert(0, {os.path.dirname(__file__)!r}); import test_own_conformance as t; "
        "print(json.dumps({name: t.digest(name) for name in t.ZOO_IDS}))"
    )
    environment = {**os.environ, "PYTHONHASHSEED": "12345"}
    found = subprocess.run(
        [sys.executable, "-c", command], capture_output=True, text=True, check=True, env=environment, timeout=250
    )
    theirs = json.loads(found.stdout.splitlines()[-1])
    assert theirs == {name: digest(name) for name in ZOO_IDS}
    assert len(set(theirs.values())) > len(ZOO_IDS) / 2, "ids that differ in nothing that happens here may agree"


@pytest.mark.parametrize("name", ZOO_IDS)
def test_copies_in_mid_episode_go_on_exactly(name: str) -> None:
    """After 8 s of driving into walls, so that contacts are being solved at that moment."""
    env = make(name, max_cycles=110)
    env.reset(seed=3)
    rng = np.random.default_rng(0)
    play(env, rng, 80)
    copies = [copy.deepcopy(env), pickle.loads(pickle.dumps(env)), pickle.loads(pickle.dumps(copy.deepcopy(env)))]
    drawn = copy.deepcopy(rng)
    expected = play(env, rng, 30)
    for other in copies:
        assert play(other, copy.deepcopy(drawn), 30) == expected
    env.reset(), copies[0].reset()
    assert np.array_equal(env.state(), copies[0].state()), "the next episode is drawn alike"


def test_copies_were_made_in_contact() -> None:
    touching = 0
    for name in ZOO_IDS[:6]:
        env = make(name, max_cycles=110)
        env.reset(seed=3)
        play(env, np.random.default_rng(0), 80)
        touching += any(env.episode.arena.touching)
    assert touching >= 3


@pytest.mark.parametrize("name", ["tab_marl/Ego-v0", "tab_marl/Adversary-random-discrete-v0", "tab_marl/Ego-team-v0"])
def test_views_copy_with_their_opponents(name: str) -> None:
    env = gymnasium.make(name).unwrapped
    env.reset(seed=2)
    env.action_space.seed(0)
    actions = [env.action_space.sample() for _ in range(60)]
    for action in actions[:40]:
        env.step(action)
    twin = pickle.loads(pickle.dumps(env))
    for action in actions[40:]:
        (one, *rest), (other, *others) = env.step(action), twin.step(action)
        assert np.array_equal(one, other) and rest == others
        if rest[1] or rest[2]:
            break


@pytest.mark.parametrize("name", ZOO_IDS)
def test_nothing_returned_is_shared(name: str) -> None:
    env, twin = make(name), make(name)
    rng = np.random.default_rng(0)
    returned: list[np.ndarray] = [*env.reset(seed=1)[0].values(), env.state()]
    twin.reset(seed=1)
    for _ in range(4):
        actions = act(env, rng)
        returned += [*env.step(actions)[0].values(), env.state()]
        twin.step(actions)
        for array in returned:
            array[:] = np.nan  # whoever keeps what it was given may do with it what it likes
        assert np.array_equal(env.state(), twin.state())
    assert not any(np.shares_memory(a, b) for a, b in itertools.combinations(returned, 2))


@pytest.mark.parametrize("name", CONTINUOUS)
def test_random_and_extreme_driving_keeps_bounds_and_walls(name: str) -> None:
    """The same episodes by the ten thousand: benchmarks/random_episodes.py."""
    env = make(name, max_cycles=150)
    found = together([random_episode(env, seed, driving) for seed, driving in enumerate(DRIVINGS)])
    assert found.sound, found
    assert found.longest_metres < 1.5


def test_random_driving_does_reach_walls() -> None:
    found = random_episode(make("tab_marl/intercept-v0"), 0, "ram")
    assert found.touches > 0.3 * found.steps and found.deepest_metres > 0.0


@pytest.mark.parametrize("name", ZOO_IDS)
def test_bad_actions_are_refused_and_change_nothing(name: str) -> None:
    env = make(name)
    env.reset(seed=0)
    before = env.state()
    rng = np.random.default_rng(0)
    for agent in env.possible_agents:
        if isinstance(env.action_space(agent), Discrete):
            wrong = [(15, "is 15, must lie in 0..14"), (-1, "is -1"), (0.5, "whole number in 0..14"), ([0, 1], "whole")]
        else:
            wrong = [
                (np.array([np.nan, 0.0]), "its speed must be a finite number in"),
                (np.array([0.0, np.inf]), "its turn rate must be a finite number in"),
                (np.array([-1.01, 0.0]), r"its speed -1.01 lies outside \[-1, 1\]"),
                (np.array([0.0, 3.0]), r"its turn rate 3 lies outside \[-1, 1\]"),
                (np.zeros(3), r"has shape \[3\], must be \[2\]"),
                (0, r"has shape \[\], must be \[2\]"),
            ]
        for action, message in wrong:
            with pytest.raises(ValueError, match=f"the action of '{agent}'.* {message}"):
                env.step({**act(env, rng), agent: action})
        with pytest.raises(ValueError, match=f"actions lack '{agent}'"):
            env.step({a: action for a, action in act(env, rng).items() if a != agent})
    assert np.array_equal(env.state(), before)


@pytest.mark.parametrize("name", VIEWS)
def test_views_refuse_bad_actions(name: str) -> None:
    env = gymnasium.make(name, disable_env_checker=True).unwrapped
    env.reset(seed=0)
    with pytest.raises(ValueError, match=r"the action of '(ego|adversary)_0'"):
        env.step(15 if isinstance(env.action_space, Discrete) else np.array([0.0, np.nan], dtype=np.float32))


def test_the_table_of_ids_is_consistent() -> None:
    assert len(set(ZOO_IDS)) == len(ZOO_IDS) and len(set(VIEWS)) == len(VIEWS)
    assert {"tab_marl/Ego-v0", "tab_marl/Adversary-v0", "tab_marl/Ego-M3-v0", "tab_marl/Ego-avoidance-v0"} <= set(VIEWS)
    assert "tab_marl/Adversary-avoidance-v0" not in VIEWS, "nobody is hunted there"
    for environment in ENVIRONMENTS:
        assert environment.meaning.endswith(".")
        env = make(environment.pettingzoo_id)
        assert environment.pettingzoo_id.endswith("-v0")
        assert env.metadata["name"] == (
            "tab_marl_team_v0" if environment.module == "team_v0" else "tab_marl_intercept_v0"
        )
