"""Another researcher's model joins with one command if it does what it claims, and what is measured stands on its card."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from stable_baselines3 import PPO
from typer.testing import CliRunner

from tab_marl.agents.measures.measuring import Sheet, claimed, gap, measured_policy, sampled_tasks, worlds_gap
from tab_marl.agents.measures.release import release, summary
from tab_marl.agents.policies.cards import CLAIM, MissionRecord
from tab_marl.agents.policies.joining import BelowClaim, Joining, join
from tab_marl.agents.policies.zoo import ZOO_VARIABLE, PolicyError, all_policies, find_policy, load_policy, load_zoo
from tab_marl.cli import app
from tab_marl.envs.single_agent import adversary_env
from tab_marl.mission.compositions import COMPOSITIONS, SAMPLED
from tab_marl.world.scenario import UnknownName


@pytest.fixture(scope="module")
def good_zip(tmp_path_factory) -> Path:
    """What somebody may have trained: here, with the weights of a policy that ships."""
    actor = find_policy("direct").actor
    layers = actor.network.layers
    kwargs = {"net_arch": list(layers[1:-1]), "activation_fn": torch.nn.Tanh}
    model = PPO("MlpPolicy", adversary_env(), device="cpu", policy_kwargs=kwargs)
    state = model.policy.state_dict()
    names = [*(f"mlp_extractor.policy_net.{2 * i}" for i in range(len(layers) - 2)), "action_net"]
    for i, name in enumerate(names):
        state[f"{name}.weight"] = torch.from_numpy(actor.tensors[f"layers.{i}.weight"].T.copy())
        state[f"{name}.bias"] = torch.from_numpy(actor.tensors[f"layers.{i}.bias"].copy())
    model.policy.load_state_dict(state)
    path = tmp_path_factory.mktemp("theirs") / "good.zip"
    model.save(path)
    return path


@pytest.fixture(scope="module")
def bad_zip(tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("theirs") / "bad.zip"
    PPO("MlpPolicy", adversary_env(), device="cpu", seed=0, policy_kwargs={"net_arch": [4]}).save(path)
    return path


def test_one_command_is_enough(good_zip, tmp_path, monkeypatch) -> None:
    """Then it is listed, shown, verified, found by name, and sits beside those that ship."""
    monkeypatch.setenv(ZOO_VARIABLE, str(tmp_path / "mine"))
    run = CliRunner()
    added = run.invoke(
        app,
        [
            "zoo",
            "add",
            str(good_zip),
            "--name",
            "theirs",
            "--episodes",
            "2",
            "--author",
            "A. Nother",
            "--command",
            "x.py",
        ],
    )
    assert added.exit_code == 0, added.output
    assert "added theirs (PPO)" in added.output and "M5       2 of 2 [34, 100] %" in added.output
    assert [path.name for path in (tmp_path / "mine").iterdir()] == ["theirs"]
    card = load_policy(tmp_path / "mine" / "theirs").card
    assert (card.author, card.command, card.split, card.exceptions) == ("A. Nother", "x.py", "development", ())
    assert {r.world for r in card.success} == {"batched", "physics"} and SAMPLED in {r.mission for r in card.success}
    seen = np.random.default_rng(0).uniform(-1, 1, (5, 40)).astype(np.float32)
    np.testing.assert_allclose(find_policy("theirs").act(seen), find_policy("direct").act(seen), atol=1e-6)
    assert "theirs" in {policy.name for policy, _ in all_policies("development")}
    assert "theirs *" in run.invoke(app, ["zoo", "list"]).output
    shown = run.invoke(app, ["zoo", "show", "theirs"]).output
    assert "by A. Nother" in shown and card.sha256 in shown and "M1 to M5 less sampled compositions" in shown
    assert run.invoke(app, ["zoo", "verify", "theirs", "--episodes", "1"]).exit_code == 0
    taken = run.invoke(app, ["zoo", "add", str(good_zip), "--name", "theirs"])
    assert taken.exit_code == 1 and "there is a policy named theirs already" in str(taken.exception)


def test_a_model_that_falls_short_is_refused_or_marked(bad_zip, tmp_path) -> None:
    with pytest.raises(
        BelowClaim, match=r"M1: \d of 1 completed in .*below 90 %.*--missions.*--normalisation.*--anyway"
    ):
        join(bad_zip, Joining("theirs"), tmp_path / "zoo", episodes=1)
    assert not (tmp_path / "zoo").exists(), "nothing of it is written"
    policy, folder = join(bad_zip, Joining("theirs", missions=("M1",)), tmp_path / "zoo", anyway=True, episodes=1)
    kept = load_policy(folder).card
    assert kept.exceptions and kept.exceptions == policy.card.exceptions and kept.missions[0] == "M1"
    assert all(said.startswith("M1:") for said in kept.exceptions), "only what it claims is held against it"


def test_wrong_words_are_answered(good_zip, tmp_path) -> None:
    for joining, error, said in (
        (Joining("direct"), PolicyError, "there is a policy named direct already"),
        (Joining("x", style="sdie"), UnknownName, "did you mean 'side'"),
        (Joining("x", missions=("M7",)), UnknownName, "M7"),
        (Joining("x", missions=()), PolicyError, "missions is empty"),
        (Joining("x", author="a\x1b[2J"), PolicyError, "author"),
    ):
        with pytest.raises(error, match=said):
            join(good_zip, joining, tmp_path, episodes=1)
    other = tmp_path / "ego.zip"
    PPO("MlpPolicy", "CartPole-v1", device="cpu").save(other)
    with pytest.raises(PolicyError, match=r"on 4 observed numbers|must end with 2"):
        join(other, Joining("x"), tmp_path, episodes=1)


def record(mission: str, world: str, completed: int, episodes: int = 20) -> MissionRecord:
    return MissionRecord(mission=mission, world=world, completed=completed, episodes=episodes, low=0, high=1)


def test_claims_need_nine_tenths_in_both_worlds_and_gaps_are_told() -> None:
    records = [
        record("M1", "batched", 20), record("M1", "physics", 18), record("M2", "batched", 20), record("M2", "physics", 17),
        record("sampled", "batched", 20), record("sampled", "physics", 15),
    ]  # fmt: skip
    assert CLAIM == 0.9 and claimed(records) == ("M1",)
    assert gap(records) == pytest.approx(35 / 40 - 15 / 20)
    assert worlds_gap(records) == pytest.approx(1 - 50 / 60)


def test_sampled_tasks_go_through_all_compositions() -> None:
    tasks = sampled_tasks(len(COMPOSITIONS), 3)
    assert [task.mission.name for task in tasks] == list(COMPOSITIONS)
    assert tasks[:2] == sampled_tasks(2, 3) != sampled_tasks(2, 4)


def test_a_release_measures_and_writes_cards(tmp_path, monkeypatch) -> None:
    """With the shipped direct policy twice for its controls, which nothing can move against."""
    monkeypatch.setattr("tab_marl.agents.measures.release.MOVES_TASKS", 2)
    direct = find_policy("direct")
    late = next(policy for policy in load_zoo(split="development") if policy.style.name == "late")
    sheet = Sheet.draw(5, 2, 5)
    lines = list(release([late], [direct, direct], tmp_path, sheet))
    assert lines[0].startswith(late.name) and lines[1].startswith("MLE-POMCP: ")
    card = load_policy(tmp_path / late.name).card
    assert (
        card.style_test is not None and card.style_test.figure == "time used / allowed" and card.style_test.moved > 0.15
    )
    assert {(r.mission, r.world) for r in card.success} >= {("sampled", "physics"), ("M2", "batched")}
    assert card.statistics["occupancy distance between controls"] == 0.0
    assert 0 < card.statistics["time used / allowed, q10"] <= card.statistics["time used / allowed, q90"] <= 1.1
    plain, _ = measured_policy(direct, sheet, [])
    assert plain.card.style_test is None and "counts" not in summary(plain)
