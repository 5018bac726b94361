"""Training rates: PPO in the pymunk environment and in the batched arenas, learning included, in one run on one core.

An adversary learns M4 while the ego stands still; two layers of 64, four epochs, in both worlds. The pymunk environment is
trained by stable-baselines3 (8 copies, batches of 1024), and by the plain PyTorch example with the same settings; the arenas
by that example with 2048 of them and batches of 16,384, on one core and on all. Beside that the bare rates of stepping with
random actions. Rates are per CPU second, except on all cores: per second of the clock.

Run: python benchmarks/training_speed.py
"""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import torch
from rich.console import Console
from rich.table import Table
from stable_baselines3 import PPO
from stable_baselines3.common.env_util import make_vec_env

import tab_marl  # noqa: F401, registers the environments

sys.path.insert(0, str(Path(__file__).resolve().parent.parent / "scripts" / "examples"))
import ppo_torch

ARGUMENTS = {"mission": "M4", "opponent": "static"}
COPIES, ARENAS = 8, 2048
PYMUNK_STEPS, BATCHED_STEPS = 16_384, 393_216
EPOCHS, PYMUNK_BATCH, BATCHED_BATCH = 4, 1024, 16_384


def stepping(envs: gymnasium.vector.VectorEnv[Any, Any, Any], steps: int) -> float:
    """Environment steps per CPU second under random actions."""
    envs.reset(seed=0)
    actions = np.random.default_rng(0).uniform(-1, 1, (50, envs.num_envs, 2)).astype(np.float32)
    envs.step(actions[0])
    began = time.process_time()
    for i in range(steps // envs.num_envs):
        envs.step(actions[i % 50])
    return steps / (time.process_time() - began)


def stable_baselines3() -> float:
    envs = make_vec_env("tab_marl/Adversary-v0", COPIES, seed=0, env_kwargs=ARGUMENTS)
    model = PPO("MlpPolicy", envs, n_steps=512, batch_size=PYMUNK_BATCH, n_epochs=EPOCHS, device="cpu", seed=0)
    model.learn(512 * COPIES)
    began = time.process_time()
    model.learn(PYMUNK_STEPS)
    return PYMUNK_STEPS / (time.process_time() - began)


def plain_pytorch(
    envs: gymnasium.vector.VectorEnv[Any, Any, Any], steps: int, rollout: int, batch: int,
    clock: Callable[[], float] = time.process_time,
) -> float:  # fmt: skip
    ppo_torch.train(envs, rollout * envs.num_envs, rollout=rollout, batch=batch, epochs=EPOCHS)
    began = clock()
    ppo_torch.train(envs, steps, rollout=rollout, batch=batch, epochs=EPOCHS)
    return steps / (clock() - began)


def on_all_cores() -> float:
    """Environment steps per second of the clock, threads in the arenas and in PyTorch."""
    cores = os.cpu_count() or 1
    torch.set_num_threads(cores)
    envs = gymnasium.make_vec("tab_marl/BatchedAdversary-v0", num_envs=ARENAS, workers=cores, **ARGUMENTS)
    return plain_pytorch(envs, BATCHED_STEPS, 32, BATCHED_BATCH, time.perf_counter)


def main() -> None:
    torch.set_num_threads(1)
    copies = gymnasium.make_vec("tab_marl/Adversary-v0", num_envs=COPIES, vectorization_mode="sync", **ARGUMENTS)
    arenas = gymnasium.make_vec("tab_marl/BatchedAdversary-v0", num_envs=ARENAS, **ARGUMENTS)
    found = {
        "pymunk, stepping": stepping(copies, 4_000),
        "batched, stepping": stepping(arenas, 40 * ARENAS),
        "pymunk, PPO of stable-baselines3": stable_baselines3(),
        "pymunk, PPO in plain PyTorch": plain_pytorch(copies, PYMUNK_STEPS, 512, PYMUNK_BATCH),
        "batched, PPO in plain PyTorch": plain_pytorch(arenas, BATCHED_STEPS, 32, BATCHED_BATCH),
        f"batched, PPO in plain PyTorch, {os.cpu_count()} cores": on_all_cores(),
    }
    base = found["pymunk, PPO of stable-baselines3"]
    table = Table("", "environment steps/s", "times pymunk with stable-baselines3")
    for name, rate in found.items():
        table.add_row(name, f"{rate:,.0f}", f"{rate / base:.1f}")
    Console(width=100).print(table)


if __name__ == "__main__":
    main()
