"""The example scripts run, at a small size, and the plain PyTorch one learns."""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path
from types import ModuleType

import gymnasium
import numpy as np
import pytest
import torch

import tab_marl  # noqa: F401, registers the environments

FOLDER = Path(__file__).parent.parent / "scripts" / "examples"


@pytest.fixture
def example(monkeypatch: pytest.MonkeyPatch):
    """Loads an example by name, as Python would run it, and forgets it afterwards."""
    monkeypatch.syspath_prepend(str(FOLDER))
    threads = torch.get_num_threads()

    def load(name: str) -> ModuleType:
        spec = importlib.util.spec_from_file_location(name, FOLDER / f"{name}.py")
        assert spec is not None and spec.loader is not None
        module = importlib.util.module_from_spec(spec)
        monkeypatch.setitem(sys.modules, name, module)
        spec.loader.exec_module(module)
        return module

    yield load
    torch.set_num_threads(threads)


def test_every_example_is_tested_and_short() -> None:
    names = {path.stem for path in FOLDER.glob("*.py")}
    assert names == {"ppo_torch", "sb3_single_agent", "torchrl_ppo", "shared_parameters", "other_tasks"}
    for name in names:
        text = (FOLDER / f"{name}.py").read_text()
        assert len(text.splitlines()) <= 170 and f"scripts/examples/{name}.py" in text, "it says how it is run"


def test_plain_pytorch_learns(example) -> None:
    """In the batched world, M1: much better after 160,000 steps than before, also in the pymunk world."""
    ppo = example("ppo_torch")
    torch.set_num_threads(1)
    envs = gymnasium.make_vec("tab_marl/BatchedAdversary-v0", num_envs=128, mission="M1")
    returns: list[float] = []
    agent, rate = ppo.train(
        envs, 160_000, rollout=32, batch=1024, report=lambda done, updates, returned: returns.append(returned)
    )
    assert rate > 0 and len(returns) == 39
    env = gymnasium.make("tab_marl/Adversary-v0", mission="M1", opponent="static")
    fresh = ppo.Agent(env.observation_space)
    before, after = (ppo.evaluate(env, policy, 6)["return"] for policy in (fresh, agent))
    assert after > before + 10, (before, after, np.round(returns, 1))


def test_stable_baselines3_and_self_play(example, capsys) -> None:
    """The adversary learns its mission in 16,384 steps of the pymunk world; then the ego's side runs against it."""
    sb3 = example("sb3_single_agent")
    torch.set_num_threads(1)
    sb3.SETTINGS = {**sb3.SETTINGS, "n_steps": 128, "batch_size": 256}
    adversary = sb3.learn("Adversary", "static", 16_384, episodes=4)
    assert "4 of 4 missions completed" in capsys.readouterr().out
    sb3.SETTINGS = {**sb3.SETTINGS, "n_steps": 32, "batch_size": 64, "n_epochs": 1}
    sb3.learn("Ego", sb3.frozen(adversary), 128, copies=2, episodes=1)
    assert "of 1 adversaries intercepted" in capsys.readouterr().out


def test_torchrl(example, capsys) -> None:
    example("torchrl_ppo").main(steps=128, frames=64, epochs=1, batch=32, mission="M1")
    assert "one new episode without noise" in capsys.readouterr().out


def test_shared_parameters(example, capsys) -> None:
    example("shared_parameters").main(steps=700, rollout=700, mission="M1")
    assert "mission completed" in capsys.readouterr().out


def test_other_tasks(example, capsys) -> None:
    example("other_tasks").main("avoidance,surveillance", planners="scripted,TAB-POMCP", episodes=1)
    out = capsys.readouterr().out
    assert "avoidance: M1 ambiguous" in out and "surveillance: M1 ambiguous" in out and out.count("TAB-POMCP") == 2
