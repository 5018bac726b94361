"""rl-baselines3-zoo trains and plays our ids, with the hyperparameters that ship."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest
import yaml

HYPERPARAMETERS = Path(__file__).parent.parent / "agents" / "hyperparameters"
ENV_ID = "tab_marl/Adversary-v0"
SMALL = ("n_envs:2", "n_steps:32", "batch_size:64", "n_epochs:1")


def rl_zoo(folder: Path, module: str, *arguments: str) -> str:
    common = ("--algo", "ppo", "--env", ENV_ID, "--gym-packages", "tab_marl", "--device", "cpu", "--seed", "0")
    run = subprocess.run(
        [sys.executable, "-m", f"rl_zoo3.{module}", *common, *arguments],
        cwd=folder, env={**os.environ, "OMP_NUM_THREADS": "1", "SDL_VIDEODRIVER": "dummy"},
        capture_output=True, text=True, check=False, timeout=250,
    )  # fmt: skip
    assert run.returncode == 0, run.stdout[-3000:] + run.stderr[-3000:]
    return run.stdout


def test_rl_zoo_trains_and_enjoys(tmp_path: Path) -> None:
    trained = rl_zoo(
        tmp_path, "train", "--conf-file", str(HYPERPARAMETERS / "ppo.yml"), "--n-timesteps", "128", "--eval-freq", "-1",
        "--log-folder", "logs", "-params", *SMALL,
    )  # fmt: skip
    assert "adversary_rewards" in trained, "the settings of the id were read"
    assert (tmp_path / "logs" / "ppo" / "tab_marl-Adversary-v0_1" / "tab_marl-Adversary-v0.zip").is_file()
    played = rl_zoo(tmp_path, "enjoy", "--folder", "logs", "--no-render", "--n-timesteps", "20")
    assert "Loading" in played


@pytest.mark.parametrize("path", sorted(HYPERPARAMETERS.glob("*.yml")), ids=lambda path: path.stem)
def test_every_algorithm_has_settings_for_the_pymunk_id(path: Path) -> None:
    settings = yaml.safe_load(path.read_text())[ENV_ID]
    assert settings["env_kwargs"] == {"mission": "M4", "opponent": "static", "adversary_rewards": "shaped"}
