"""The actors of six algorithms in numpy alone, against the models' own `predict`: alone, together, and over episodes."""

from __future__ import annotations

import dataclasses
from functools import cache
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
import torch
from sb3_contrib import TQC, RecurrentPPO
from stable_baselines3 import A2C, DQN, PPO, SAC, TD3

import tab_marl  # noqa: F401, registers the environments
from tab_marl.agents.hunted.egos import Hunters
from tab_marl.agents.opponents import load_model
from tab_marl.agents.policies.actor import Actor, ActorError, Memory, Network
from tab_marl.agents.policies.sb3_actors import actor_of_model, normalised, read_zip
from tab_marl.agents.policies.zoo import PolicyError, load_policy, policy_of, save_policy
from tab_marl.agents.training.settings import TrainingSettings
from tab_marl.envs.adversary_kernels import O_LIMIT
from tab_marl.envs.adversary_observation import OBSERVED, observation_bounds
from tab_marl.envs.batched_env import batched_adversary_env, batched_ego_env
from tab_marl.envs.opponents import Model
from tab_marl.envs.single_agent import adversary_env, ego_env
from tab_marl.mission.tasks import sample_task

OFF = {"buffer_size": 10}
MODELS: dict[str, tuple[type, str, dict[str, Any]]] = {
    "ppo": (PPO, "MlpPolicy", {"policy_kwargs": {"net_arch": [24, 12]}}),
    "ppo-relu": (PPO, "MlpPolicy", {"policy_kwargs": {"net_arch": {"pi": [9], "vf": [4]}, "activation_fn": torch.nn.ReLU}}),
    "ppo-linear": (PPO, "MlpPolicy", {"policy_kwargs": {"net_arch": []}}),
    "ppo-sde": (PPO, "MlpPolicy", {"use_sde": True, "policy_kwargs": {"squash_output": True}}),
    "a2c": (A2C, "MlpPolicy", {}),
    "sac": (SAC, "MlpPolicy", {**OFF, "policy_kwargs": {"net_arch": [16, 16]}}),
    "sac-tanh": (SAC, "MlpPolicy", {**OFF, "policy_kwargs": {"net_arch": [8], "activation_fn": torch.nn.Tanh}}),
    "td3": (TD3, "MlpPolicy", {**OFF, "policy_kwargs": {"net_arch": [16, 8]}}),
    "tqc": (TQC, "MlpPolicy", {**OFF, "policy_kwargs": {"net_arch": [16, 16]}}),
    "ppo_lstm": (RecurrentPPO, "MlpLstmPolicy", {"policy_kwargs": {"lstm_hidden_size": 12, "net_arch": [10]}}),
    "ppo_lstm-shared": (
        RecurrentPPO,
        "MlpLstmPolicy",
        {"policy_kwargs": {"lstm_hidden_size": 7, "shared_lstm": True, "enable_critic_lstm": False}},
    ),
}  # fmt: skip


@cache
def model(name: str) -> Any:
    """An untrained model whose actor's weights are large enough for its nonlinearities to matter."""
    algorithm, policy, options = MODELS[name]
    made = algorithm(policy, adversary_env(), device="cpu", seed=3, **options)
    with torch.no_grad():
        rng = torch.Generator().manual_seed(1)
        for parameter in made.policy.parameters():
            parameter.add_(0.3 * torch.randn(parameter.shape, generator=rng))
    return made


def observations(*shape: int) -> np.ndarray:
    low, high = (np.clip(bound, -2.0, 2.0) for bound in observation_bounds())
    seen = np.random.default_rng(0).uniform(low, high, (*shape, OBSERVED)).astype(np.float32)
    seen[..., O_LIMIT] = 1.0
    return seen


def settings(name: str) -> TrainingSettings:
    return TrainingSettings(name=name)


@pytest.mark.parametrize("name", MODELS)
def test_every_algorithm_acts_as_the_model_itself(name: str, tmp_path: Path) -> None:
    """Exported, saved and loaded, and from the model's own zip; for one observation, a batch, and along an episode."""
    save_policy(policy_of(model(name), settings(name), 7), tmp_path / name)
    model(name).save(tmp_path / "model.zip")
    for policy in (load_policy(tmp_path / name), load_model(tmp_path / "model.zip")):
        batch = observations(12)
        expected, _ = model(name).predict(batch, deterministic=True)
        actions = policy.act(batch)
        assert actions.dtype == np.float32 and np.ptp(actions) > 0.1
        np.testing.assert_allclose(actions, expected, atol=1e-5)
        policy.reset(None, None)  # type: ignore[arg-type]
        state = None
        for observation in observations(6):
            expected, state = model(name).predict(observation, state, deterministic=True)
            np.testing.assert_allclose(policy.act(observation), expected, atol=1e-5)


def test_the_card_says_what_the_network_is() -> None:
    cards = {name: policy_of(model(name), settings(name), 7).card for name in MODELS}
    networks = {name: card.network for name, card in cards.items()}
    assert networks["ppo"] == Network(layers=(OBSERVED, 24, 12, 2))
    assert networks["ppo-relu"] == Network(activation="relu", layers=(OBSERVED, 9, 2))
    assert networks["ppo-linear"].layers == (OBSERVED, 2)
    assert networks["ppo-sde"].squashed and networks["sac"].squashed and networks["td3"].squashed
    assert networks["ppo_lstm"].kind == "lstm" and networks["ppo_lstm"].lstm_units == 12
    assert networks["ppo_lstm"].layers == (OBSERVED, 10, 2)
    assert [cards[n].algorithm.split(" ")[0] for n in ("a2c", "tqc", "ppo_lstm")] == ["A2C", "TQC", "RecurrentPPO"]
    assert cards["tqc"].algorithm.startswith("TQC (sb3-contrib ") and cards["sac"].algorithm.startswith("SAC (stable")
    assert all(card.steps == 7 and card.split == "development" for card in cards.values())


def test_a_zip_tells_which_algorithm_it_is(tmp_path: Path) -> None:
    for name in ("ppo", "a2c", "sac", "td3", "tqc", "ppo_lstm"):
        model(name).save(tmp_path / f"{name}.zip")
        assert read_zip(tmp_path / f"{name}.zip").algorithm == MODELS[name][0].__name__


def test_a_governor_keeps_the_missions_speed_limit_and_nothing_else() -> None:
    policy = policy_of(model("sac"), settings("x"), 0)
    seen = observations(50)
    free = policy.act(seen)
    for limit in (0.3, 0.8):
        seen[:, O_LIMIT] = limit
        network, action = policy.actor(seen, Memory()), policy.act(seen)
        np.testing.assert_array_equal(action[:, 1], network[:, 1])
        np.testing.assert_allclose(action[:, 0], np.minimum(network[:, 0], 2 * limit - 1), atol=1e-6)
        assert (action[:, 0] < free[:, 0]).any()


def test_a_governor_leaves_the_table_of_discrete_actions_as_it_was() -> None:
    """One observation at a time, as the environment asks: an action must not be a row of the table itself."""
    learner = PPO("MlpPolicy", adversary_env(actions="discrete"), device="cpu", seed=3)
    policy = policy_of(learner, settings("x"), 0)
    seen = observations(20)
    before = [policy.act(o).copy() for o in seen]
    governed = seen.copy()
    governed[:, O_LIMIT] = 0.1
    assert max(policy.act(o)[0] for o in governed) <= 2 * 0.1 - 1
    np.testing.assert_array_equal([policy.act(o) for o in seen], before)
    assert max(action[0] for action in before) > 2 * 0.1 - 1


def test_a_recurrent_policy_remembers_its_episode_and_nothing_of_the_last_one() -> None:
    policy = policy_of(model("ppo_lstm"), settings("x"), 0)
    first = [policy.act(o) for o in observations(4)]
    assert np.abs(policy.act(observations(4)[0]) - first[0]).max() > 1e-3, "it remembers"
    policy.reset(None, None)  # type: ignore[arg-type]
    np.testing.assert_array_equal([policy.act(o) for o in observations(4)], first)
    with pytest.raises(ValueError, match="call reset when other episodes begin"):
        policy.act(observations(3))
    other = policy.another()
    np.testing.assert_array_equal(other.act(observations(4)[0]), first[0])


def test_a_live_recurrent_model_remembers_its_episodes_as_its_policy_does() -> None:
    policy, player = policy_of(model("ppo_lstm"), settings("x"), 0), Model(model("ppo_lstm"))
    for _ in range(2):
        policy.reset(None, None)  # type: ignore[arg-type]
        player.reset(None, None)  # type: ignore[arg-type]
        for observation in observations(4):
            np.testing.assert_allclose(player.act(observation), policy.act(observation), atol=1e-5)
    policy, player = policy.another(), Model(model("ppo_lstm"))
    for step, batch in enumerate(observations(6, 5)):
        begun = np.flatnonzero([step == 0, step == 2, step == 0, step in (2, 4), False])
        policy.begin(begun)
        player.begin(begun)
        np.testing.assert_allclose(player.act(batch), policy.act(batch), atol=1e-5)


def test_environments_that_are_given_one_recurrent_policy_do_not_share_its_memory(tmp_path: Path) -> None:
    """Two in turn, as in a vector of environments, act as each does alone; so do the egos of the hunted arenas."""
    policy = policy_of(model("ppo_lstm"), settings("x"), 0)
    still = np.array([-1.0, 0.0], dtype=np.float32)

    def seen(envs: list[gymnasium.Env[Any, Any]]) -> list[np.ndarray]:
        for i, env in enumerate(envs):
            env.reset(seed=i)
        for _ in range(8):
            for env in envs:
                env.step(still)
        return [env.inner.state() for env in envs]  # type: ignore[attr-defined]

    together = seen([ego_env(policy, max_cycles=20) for _ in range(2)])
    np.testing.assert_array_equal(together[0], seen([ego_env(policy, max_cycles=20)])[0])
    learner = RecurrentPPO("MlpLstmPolicy", ego_env(), device="cpu", seed=3, policy_kwargs={"lstm_hidden_size": 6})
    learner.save(tmp_path / "ego.zip")
    task = sample_task(np.random.default_rng(0), "M1")
    given = np.random.default_rng(1).uniform(-1, 1, (5, 2, 27)).astype(np.float32)
    hunters, alone = Hunters([str(tmp_path / "ego.zip")], 2), load_model(tmp_path / "ego.zip")
    for arena in (0, 1):
        hunters.begin(arena, 0, task, 0)
    for both in given:
        np.testing.assert_array_equal(hunters.act(both)[1], alone.act(both[1]))
    hunters.begin(0, 0, task, 0)
    np.testing.assert_array_equal(hunters.act(given[0])[1], alone.act(given[0][1]))


def test_rows_that_begin_anew_forget_and_the_others_do_not() -> None:
    """As stable-baselines3's `episode_start` says it."""
    policy = policy_of(model("ppo_lstm"), settings("x"), 0)
    state, starts = None, np.zeros(5)
    for step, batch in enumerate(observations(6, 5)):
        starts = np.array([0, step == 2, 0, step in (2, 4), 0], dtype=bool)
        policy.begin(np.flatnonzero(starts))
        expected, state = model("ppo_lstm").predict(batch, state, starts, deterministic=True)
        np.testing.assert_allclose(policy.act(batch), expected, atol=1e-5)


def test_batched_arenas_tell_a_recurrent_player_which_episodes_begin() -> None:
    """Arenas that end at different times act as each would alone: a player that never forgets drives elsewhere."""
    policy = policy_of(model("ppo_lstm"), settings("x"), 0)
    env = batched_ego_env(3, policy, max_cycles=9)
    policy = env._crowd._player  # type: ignore[attr-defined]
    env.reset(seed=1)
    still = np.tile(np.array([-1.0, 0.0], dtype=np.float32), (3, 1))
    for _ in range(9):
        env.step(still)
    assert policy.memory.hidden is not None
    np.testing.assert_array_equal(policy.memory.hidden, 0.0)
    env.step(still)
    assert np.abs(policy.memory.hidden).max() > 0.0
    assert batched_adversary_env is not batched_ego_env


def test_a_vectorised_normalisation_is_part_of_the_actor() -> None:
    from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

    venv = VecNormalize(DummyVecEnv([adversary_env]), clip_obs=1.5)
    seen = observations(200) * 3
    seen[:, O_LIMIT] = np.linspace(-1.0, 1.0, 200)
    venv.obs_rms.update(seen)
    actor, _ = actor_of_model(model("ppo"))
    behind = normalised(actor, venv.obs_rms.mean, venv.obs_rms.var, venv.clip_obs, venv.epsilon)
    expected, _ = model("ppo").predict(venv.normalize_obs(seen), deterministic=True)
    np.testing.assert_allclose(behind(seen, Memory()), expected, atol=1e-5)
    for variance in (np.full(OBSERVED, -1.0), np.full(OBSERVED, np.nan), np.ones(3)):
        with pytest.raises(ActorError, match=r"observation\.deviation"):
            normalised(actor, venv.obs_rms.mean, variance, 10.0)


def test_models_that_are_not_known_are_refused_by_name(tmp_path: Path) -> None:
    from stable_baselines3.common.torch_layers import FlattenExtractor

    class Learned(FlattenExtractor):
        def __init__(self, space: gymnasium.Space) -> None:
            super().__init__(space)
            self.extra = torch.nn.Linear(1, 1)

    cases = [
        (PPO("MlpPolicy", adversary_env(), policy_kwargs={"features_extractor_class": Learned}), "features_extractor"),
        (PPO("MlpPolicy", adversary_env(), policy_kwargs={"activation_fn": torch.nn.ELU}), "activation function ELU"),
        (SAC("MlpPolicy", adversary_env(), use_sde=True, buffer_size=10), "actor.mu is not a plain linear layer"),
        (
            SAC("MlpPolicy", adversary_env(), use_sde=True, buffer_size=10, policy_kwargs={"net_arch": []}),
            "no actor of",
        ),
        (
            RecurrentPPO("MlpLstmPolicy", adversary_env(), policy_kwargs={"n_lstm_layers": 2, "lstm_hidden_size": 4}),
            "several layers",
        ),
        (DQN("MlpPolicy", adversary_env(actions="discrete"), buffer_size=10), "no actor of PPO, A2C, RecurrentPPO"),
    ]
    for made, said in cases:
        with pytest.raises(PolicyError, match=said):
            policy_of(made, settings("x"), 0)
        made.save(tmp_path / "m.zip")
        with pytest.raises(PolicyError, match=said):
            load_model(tmp_path / "m.zip")


def test_an_actor_checks_what_it_is_given() -> None:
    actor, _ = actor_of_model(model("ppo_lstm"))
    for changed, said in (
        ({"lstm_units": 11}, r"lstm\.input is float32"),
        ({"kind": "mlp"}, "lstm_units is 12 in a network of kind mlp"),
        ({"layers": (OBSERVED, 10, 3)}, "must end with 2"),
    ):
        with pytest.raises(ActorError, match=said):
            Actor(actor.network.model_copy(update=changed), actor.tensors)
    with pytest.raises(ActorError, match=r"layers\.0\.bias is missing"):
        dataclasses.replace(actor, tensors={k: v for k, v in actor.tensors.items() if k != "layers.0.bias"})
