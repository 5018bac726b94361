"""Opponents by name: zoo policies, planners, and models that stable-baselines3 saved, read without executing anything."""

from __future__ import annotations

import zipfile
from pathlib import Path

import gymnasium
import numpy as np
import pytest
import torch
from stable_baselines3 import A2C, PPO, SAC

from tab_marl.agents.opponents import load_model, load_opponent
from tab_marl.agents.policies.zoo import SHIPPED, PolicyError, ZooPolicy, load_zoo
from tab_marl.envs.opponents import Model
from tab_marl.envs.single_agent import adversary_env, ego_env
from tab_marl.world.scenario import UnknownName

STILL = np.array([-1.0, 0.0], dtype=np.float32)


def test_a_zoo_policy_is_one_argument() -> None:
    """By name through Gymnasium, as it is, or by its folder; its style comes with it."""
    policy = next(p for p in load_zoo() if p.style.name == "side")
    ends = []
    for opponent in (policy.name, policy):
        env = gymnasium.make("tab_marl/Ego-M4-v0", opponent=opponent).unwrapped
        env.reset(seed=4)
        for _ in range(60):
            env.step(STILL)
        assert env.inner.adversary_style == policy.style  # type: ignore[attr-defined]
        ends.append(env.inner.episode.motion)  # type: ignore[attr-defined]
    assert ends[0] == ends[1] and ends[0][1].v > 0
    folder = SHIPPED / policy.name
    assert isinstance(load_opponent(str(folder), "adversary"), ZooPolicy)


def test_a_planner_is_one_argument() -> None:
    """Its play is tested with the planners; here, that it is the one that was asked for, with what it must see."""
    env = adversary_env("TAB-POMCP")
    assert env._players["ego_0"].name == "TAB-POMCP" and not env.inner.full_observation  # type: ignore[attr-defined]
    assert adversary_env("oracle").inner.full_observation


def observations(size: int) -> np.ndarray:
    return np.random.default_rng(0).uniform(-1, 1, (20, size)).astype(np.float32)


@pytest.mark.parametrize(
    ("algorithm", "options"),
    [
        (PPO, {"policy_kwargs": {"net_arch": [16, 16]}}),
        (PPO, {"policy_kwargs": {"net_arch": {"pi": [8], "vf": [4]}, "activation_fn": torch.nn.ReLU}}),
        (A2C, {}),
        (SAC, {"policy_kwargs": {"net_arch": [16, 16]}, "buffer_size": 10}),
        (SAC, {"policy_kwargs": {"net_arch": [8], "activation_fn": torch.nn.Tanh}, "buffer_size": 10}),
    ],
)
def test_a_saved_model_acts_as_the_original(algorithm: type, options: dict, tmp_path: Path) -> None:
    model = algorithm("MlpPolicy", adversary_env(), device="cpu", seed=1, **options)
    model.save(tmp_path / "model.zip")
    loaded = load_opponent(str(tmp_path / "model.zip"), "adversary")
    for observation in observations(40):
        expected, _ = model.predict(observation, deterministic=True)
        assert loaded.act(observation) == pytest.approx(expected, abs=2e-6)


def test_a_saved_discrete_model_acts_as_the_original(tmp_path: Path) -> None:
    env = ego_env(actions="discrete")
    model = PPO("MlpPolicy", env, device="cpu", seed=1)
    model.save(tmp_path / "model")
    loaded = load_model(tmp_path / "model.zip")
    for observation in 3.0 * observations(27):
        number, _ = model.predict(observation, deterministic=True)
        assert loaded.act(observation) == pytest.approx(env._continuous(number))


def test_self_play_against_a_frozen_copy_is_one_argument(tmp_path: Path) -> None:
    """From its file, which later training does not touch, or the live model itself."""
    model = PPO("MlpPolicy", adversary_env(), device="cpu", seed=2, n_steps=32, batch_size=32)
    model.save(tmp_path / "frozen.zip")
    motions = {}
    for name, opponent in (("file", str(tmp_path / "frozen.zip")), ("model", model)):
        env = ego_env(opponent)
        env.reset(seed=5)
        for _ in range(30):
            env.step(STILL)
        motions[name] = env.inner.episode.motion[1]
    assert motions["file"] == pytest.approx(motions["model"], abs=1e-5)
    assert isinstance(env._players["adversary_0"], Model)
    with pytest.raises(ValueError, match="was trained on 40 observed numbers, this side observes 27"):
        env = adversary_env(str(tmp_path / "frozen.zip"))
        env.reset(seed=0)
        env.step(STILL)


def test_nothing_in_a_model_file_is_executed(tmp_path: Path) -> None:
    """A pickle in place of the weights is refused; the pickled parts of the settings are not looked at."""
    model = PPO("MlpPolicy", adversary_env(), device="cpu", policy_kwargs={"net_arch": [4]})
    model.save(tmp_path / "model.zip")
    touched = tmp_path / "touched"

    class Evil:
        def __reduce__(self) -> tuple:
            return (touched.write_text, ("x",))

    torch.save(Evil(), tmp_path / "evil.pth")
    for member, content in (("policy.pth", (tmp_path / "evil.pth").read_bytes()), ("data", b"not json")):
        with zipfile.ZipFile(tmp_path / "model.zip") as good, zipfile.ZipFile(tmp_path / "bad.zip", "w") as bad:
            for name in good.namelist():
                bad.writestr(name, content if name == member else good.read(name))
        with pytest.raises(PolicyError, match=r"bad.zip is not a model that stable-baselines3 saved"):
            load_model(tmp_path / "bad.zip")
    assert not touched.exists()
    with pytest.raises(PolicyError, match=r"missing.zip is not a model"):
        load_model(tmp_path / "missing.zip")


def test_unknown_names_are_answered_with_the_nearest_right_one() -> None:
    with pytest.raises(UnknownName, match="did you mean 'camera-shy'"):
        ego_env("camera-shi")
    with pytest.raises(UnknownName, match="did you mean 'TAB-POMCP'"):
        adversary_env("TAB-POMPC")
