"""The zoo: what ships, what is refused, and that nothing in a file is ever executed."""

from __future__ import annotations

import hashlib
import json
import pickle
import shutil
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors.numpy import load as load_tensors
from safetensors.numpy import save as save_tensors

from tab_marl.agents.policies.zoo import (
    CARD_FILE,
    SHIPPED,
    WEIGHTS_FILE,
    PolicyError,
    export_policy,
    find_policy,
    load_policy,
    load_zoo,
    save_policy,
)
from tab_marl.agents.training.settings import TrainingSettings
from tab_marl.envs.adversary_kernels import O_LIMIT
from tab_marl.envs.adversary_observation import LAYOUT_VERSION, OBSERVED, observation_bounds
from tab_marl.world.scenario import UnknownName


@pytest.fixture(scope="module")
def zoo():
    return load_zoo()


@pytest.fixture
def copy(tmp_path):
    """A copy of a shipped policy that may be damaged."""
    shutil.copytree(SHIPPED / "direct", tmp_path / "direct")
    return tmp_path / "direct"


def observations(count, seed=0):
    low, high = observation_bounds()
    return np.random.default_rng(seed).uniform(low, high, (count, OBSERVED)).astype(np.float32)


def edit_card(folder, **changes):
    path = folder / CARD_FILE
    card = json.loads(path.read_text())
    card.update(changes)
    path.write_text(json.dumps(card))


def test_what_ships(zoo):
    names = [policy.name for policy in zoo]
    assert len(names) >= 4 and names == sorted(names)
    assert {"direct", "side", "via", "camera-shy"} <= {policy.style.name for policy in zoo}
    assert {policy.split for policy in zoo} == {"development", "final"}
    assert [p.name for p in load_zoo(split="final")] == [p.name for p in zoo if p.split == "final"]
    for policy in zoo:
        assert policy.card.layout_version == LAYOUT_VERSION
        assert policy.card.algorithm.split(" (")[1].startswith(("stable-baselines3", "sb3-contrib"))
        assert policy.card.command and policy.card.steps >= policy.card.settings["steps"] > 0
        assert policy.card.settings["style"]["name"] == policy.style.name
        assert policy.card.missions, "a policy claims at least one mission type"
    assert sum(p.stat().st_size for p in SHIPPED.rglob("*")) < 5e6


def test_claims_are_backed_by_what_the_card_reports(zoo):
    """In both worlds; the cards of a zoo that ships were measured on sampled compositions, too."""
    for policy in zoo:
        assert policy.card.missions and not policy.card.exceptions
        for record in policy.card.success:
            assert 0 <= record.low <= record.share <= record.high <= 1
        for mission in policy.card.missions:
            worlds = [r for r in policy.card.success if r.mission == mission]
            assert {r.world for r in worlds} == {"batched", "physics"}
            assert all(r.claimable for r in worlds), (policy.name, mission)


def test_actions_are_bounded_float32_and_deterministic(zoo):
    seen = observations(64)
    for policy in zoo:
        policy.reset(None, None)
        together = policy.act(seen)
        policy.reset(None, None)
        assert together.shape == (64, 2) and together.dtype == np.float32
        assert np.abs(together).max() <= 1
        one = policy.act(seen[3])
        policy.reset(None, None)
        assert one.shape == (2,) and one.dtype == np.float32
        np.testing.assert_allclose(one, together[3], atol=1e-5)
        np.testing.assert_array_equal(one, policy.act(seen[3]))


def test_acting_leaves_the_observation_and_the_weights_alone(zoo):
    seen = observations(1)[0]
    for policy in zoo:
        kept, tensors = seen.copy(), {name: array.copy() for name, array in policy.actor.tensors.items()}
        policy.act(seen)
        np.testing.assert_array_equal(seen, kept)
        for name, array in tensors.items():
            np.testing.assert_array_equal(policy.actor.tensors[name], array)


def test_noise_has_the_spread_of_training(zoo):
    policy = next(policy for policy in zoo if policy.log_std is not None)
    seen = np.zeros((4000, OBSERVED), dtype=np.float32)
    seen[:, O_LIMIT] = 1.0
    mean = policy.act(seen)[0]
    noisy = policy.act(seen, np.random.default_rng(0))
    inside = np.abs(mean) < 0.5
    assert (noisy.std(axis=0) > 0).all()
    if inside.any():
        expected = np.exp(policy.log_std)[inside]
        np.testing.assert_allclose(noisy.std(axis=0)[inside], expected, rtol=0.1)


@pytest.fixture(scope="module")
def model():
    """An untrained PPO model of the shape that policies have."""
    from stable_baselines3 import PPO

    from tab_marl.agents.training.env import TRAINING, BatchedVecEnv, build_bank, draw_tasks
    from tab_marl.envs.styles import Style

    bank = build_bank(draw_tasks(TRAINING, 0, 1, ("M1",), ("point",)), Style(), 0)
    env = BatchedVecEnv(bank, ["M1"], 2, 0)
    kwargs = {"net_arch": [24, 12], "activation_fn": torch.nn.Tanh}
    return PPO("MlpPolicy", env, policy_kwargs=kwargs, seed=3, device="cpu", n_steps=8, batch_size=16)


def test_the_exported_actor_equals_stable_baselines3s(model, tmp_path):
    settings = TrainingSettings(name="fresh", layers=(24, 12))
    folder = export_policy(model, settings, tmp_path)
    policy = load_policy(folder)
    seen = observations(50)
    seen[:, O_LIMIT] = 1.0
    theirs, _ = model.predict(seen, deterministic=True)
    np.testing.assert_allclose(policy.act(seen), theirs, atol=1e-5)
    assert policy.style == settings.style and policy.card.network.layers == (OBSERVED, 24, 12, 2)
    assert policy.card.settings["seed"] == settings.seed and policy.card.settings["style"]["name"] == "direct"
    assert policy.card.command == "tab-marl train --config settings.toml"


def test_the_command_of_a_usual_run_names_its_style(model, tmp_path):
    settings = TrainingSettings.for_style("via", seed=4, layers=(24, 12))
    assert "settings.toml" in load_policy(export_policy(model, settings, tmp_path / "a")).card.command
    usual = TrainingSettings.for_style("via", seed=4, steps=5)
    assert "--style via" in load_policy(export_policy(model, usual, tmp_path / "b")).card.command


def test_saving_and_loading_keeps_everything(zoo, tmp_path):
    save_policy(zoo[0], tmp_path / "again")
    again = load_policy(tmp_path / "again")
    assert again.card == zoo[0].card
    assert again.actor.tensors.keys() == zoo[0].actor.tensors.keys()
    for name, array in again.actor.tensors.items():
        np.testing.assert_array_equal(array, zoo[0].actor.tensors[name])
    save_policy(zoo[1], tmp_path / "again")
    assert load_policy(tmp_path / "again").card == zoo[1].card
    assert [path.name for path in tmp_path.iterdir()] == ["again"]
    assert sorted(path.name for path in (tmp_path / "again").iterdir()) == [CARD_FILE, WEIGHTS_FILE]


class Trap:
    """Makes a folder when unpickled."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self):
        import os

        return (os.mkdir, (str(self.path),))


@pytest.mark.parametrize("with_checksum", [False, True])
def test_a_pickle_in_place_of_the_weights_is_refused_and_does_not_run(copy, tmp_path, with_checksum):
    """Also when whoever planted it corrected the checksum in the card."""
    content = pickle.dumps(Trap(tmp_path / "sprung"))
    pickle.loads(pickle.dumps(Trap(tmp_path / "proof")))
    assert (tmp_path / "proof").exists(), "the trap works when unpickled"
    (copy / WEIGHTS_FILE).write_bytes(content)
    if with_checksum:
        edit_card(copy, sha256=hashlib.sha256(content).hexdigest())
    with pytest.raises(PolicyError, match="not a safetensors file" if with_checksum else "checksum"):
        load_policy(copy)
    assert not (tmp_path / "sprung").exists()


def test_a_pickle_in_place_of_the_card_is_refused_and_does_not_run(copy, tmp_path):
    (copy / CARD_FILE).write_bytes(pickle.dumps(Trap(tmp_path / "sprung")))
    with pytest.raises(PolicyError, match=r"card\.json"):
        load_policy(copy)
    assert not (tmp_path / "sprung").exists()


def test_missing_and_changed_files_are_named(copy, tmp_path):
    with pytest.raises(PolicyError, match="is not a policy: expected a folder"):
        load_policy(tmp_path / "nothing")
    content = bytearray((copy / WEIGHTS_FILE).read_bytes())
    content[-1] ^= 1
    (copy / WEIGHTS_FILE).write_bytes(bytes(content))
    with pytest.raises(PolicyError, match="does not match the checksum"):
        load_policy(copy)
    (copy / WEIGHTS_FILE).unlink()
    with pytest.raises(PolicyError, match=r"cannot read .*weights\.safetensors"):
        load_policy(copy)
    (copy / CARD_FILE).unlink()
    with pytest.raises(PolicyError, match=r"cannot read .*card\.json"):
        load_policy(copy)
    with pytest.raises(PolicyError, match="not a folder of policies"):
        load_zoo(tmp_path / "nothing")


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"layout_version": LAYOUT_VERSION + 1}, f"version {LAYOUT_VERSION + 1} of the adversary's observation"),
        ({"network": {"layers": [OBSERVED - 1, 128, 128, 2]}}, f"must begin with {OBSERVED}"),
        ({"network": {"layers": [OBSERVED, 64, 128, 2]}}, "layers.0.weight is float32"),
        ({"network": {"layers": [OBSERVED, 128, 128, 128, 2]}}, "layers.2.weight"),
        ({"sha256": "xyz"}, "sha256"),
        ({"surprise": 1}, "surprise"),
        ({"steps": "many"}, "steps"),
    ],
)
def test_cards_that_do_not_fit_are_refused_in_one_line(copy, changes, said):
    edit_card(copy, **changes)
    with pytest.raises(PolicyError, match=said) as caught:
        load_policy(copy)
    assert "\n" not in str(caught.value)


def test_weights_that_are_not_finite_are_refused(copy):
    tensors = dict(load_tensors((copy / WEIGHTS_FILE).read_bytes()))
    tensors["layers.1.bias"] = np.full_like(tensors["layers.1.bias"], np.nan)
    content = save_tensors(tensors)
    (copy / WEIGHTS_FILE).write_bytes(content)
    edit_card(copy, sha256=hashlib.sha256(content).hexdigest())
    with pytest.raises(PolicyError, match=r"layers\.1\.bias is float32 .*must be finite"):
        load_policy(copy)


def test_policies_are_found_by_name_or_folder(copy):
    assert find_policy("direct").name == "direct"
    assert find_policy(str(copy)).name == "direct"
    with pytest.raises(UnknownName, match="did you mean 'direct'"):
        find_policy("dierct")
    with pytest.raises(PolicyError, match="is not a policy"):
        find_policy("no/such/folder")
