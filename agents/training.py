"""Training of mission-conditioned adversary policies with stable-baselines3's PPO in the batched world.

A run lives in one folder: its settings, its checkpoint, its TensorBoard log and, at the end, the exported policy. It may
be killed at any moment; the same call continues it and ends with the same weights as an undisturbed run.
"""

from __future__ import annotations

import json
import math
import os
import time
from collections.abc import Callable
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
import torch
from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import configure

from tab_marl.agents.training_env import TRAINING, BatchedVecEnv, build_bank, draw_tasks
from tab_marl.agents.training_settings import TrainingError, TrainingSettings

SETTINGS_FILE = "settings.toml"
CHECKPOINT_FILE = "checkpoint.pt"
LOG_FOLDER = "tensorboard"
CHECKPOINT_VERSION = 1
EXACT_MISSION = "M2"


@dataclass(frozen=True)
class Progress:
    """Where a run stands; given to the progress callback after every update and while the tasks are built."""

    phase: str
    """ "tasks" while the bank is built, then "training"."""
    done: int
    """Tasks, or control steps."""
    total: int
    steps_per_second: float
    """Learning included, since this process began or continued the run; 0 while building."""
    success: dict[str, float]
    """Share of completed missions per mission type over the last episodes, action noise on; nan before the first."""


OnProgress = Callable[[Progress], None]


def train(settings: TrainingSettings, out_dir: Path | str, on_progress: OnProgress | None = None) -> PPO:
    """Train, or continue, the run in `out_dir`; returns the trained model (export it with `zoo.export_policy`).

    Writes ``settings.toml``, ``checkpoint.pt`` (replaced atomically, read back without unpickling code) and
    ``tensorboard/`` in `out_dir`. A finished run returns at once.

    Raises TrainingError if the folder holds a run with other settings or an unreadable checkpoint, OSError if it
    cannot be written.
    """
    folder = Path(out_dir)
    _claim(folder, settings)
    threads = torch.get_num_threads()
    torch.set_num_threads(1)  # the networks are small: one thread is fastest, and results do not depend on the machine
    try:
        return _train(settings, folder, on_progress)
    finally:
        torch.set_num_threads(threads)


def _claim(folder: Path, settings: TrainingSettings) -> None:
    """Write the settings into a new folder, or check that those there are the same."""
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / SETTINGS_FILE
    if path.exists():
        theirs = TrainingSettings.from_toml(path)
        for f in fields(settings):
            mine, their = getattr(settings, f.name), getattr(theirs, f.name)
            if mine != their and f.name != "checkpoint_seconds":
                raise TrainingError(
                    f"{folder} holds a run with {f.name} = {their!r}, asked for {mine!r}: "
                    "continue it with its own settings or choose another folder"
                )
        return
    _write_atomically(path, settings.to_toml().encode())


def _train(settings: TrainingSettings, folder: Path, on_progress: OnProgress | None) -> PPO:
    def built(done: int, total: int) -> None:
        if on_progress is not None and (done % 20 == 0 or done == total):
            on_progress(Progress("tasks", done, total, 0.0, {}))

    tasks = draw_tasks(TRAINING, settings.seed, settings.tasks, settings.missions, settings.families)
    bank = build_bank(tasks, settings.style, settings.seed, built)
    kinds = [task.mission_id for task in tasks]
    env = BatchedVecEnv(bank, kinds, settings.robots, settings.seed, settings.ego_seen_metres)
    model = _model(settings, env)
    checkpoint = folder / CHECKPOINT_FILE
    continues = checkpoint.exists()
    if continues:
        _restore(model, env, checkpoint)
    model.set_logger(configure(str(folder / LOG_FOLDER), ["tensorboard"]))
    remaining = settings.steps - model.num_timesteps
    if remaining > 0:
        watch = _Watch(settings, env, checkpoint, on_progress)
        model.learn(remaining, callback=watch, log_interval=1, reset_num_timesteps=False)
        model.logger.close()
        _save(model, env, checkpoint)
    return model


def _model(settings: TrainingSettings, env: BatchedVecEnv) -> PPO:
    first, last = settings.learning_rate, settings.final_learning_rate
    return PPO(
        "MlpPolicy",
        env,
        learning_rate=lambda remaining: last + (first - last) * max(remaining, 0.0),
        n_steps=settings.rollout_steps,
        batch_size=min(settings.batch, settings.robots * settings.rollout_steps),
        n_epochs=settings.epochs,
        gamma=settings.discount,
        gae_lambda=settings.gae_lambda,
        clip_range=settings.clip,
        ent_coef=settings.entropy,
        policy_kwargs={"net_arch": list(settings.layers), "activation_fn": torch.nn.Tanh},
        seed=settings.seed,
        device="cpu",
    )


class _Watch(BaseCallback):
    """Between updates: the final phase, checkpoints, the log and the progress callback."""

    def __init__(
        self, settings: TrainingSettings, env: BatchedVecEnv, checkpoint: Path, on_progress: OnProgress | None
    ) -> None:
        super().__init__()
        self._settings, self._env, self._checkpoint, self._on_progress = settings, env, checkpoint, on_progress
        self._began = self._saved = time.monotonic()
        self._first_step: int | None = None

    def _on_step(self) -> bool:
        return True

    def _on_rollout_start(self) -> None:
        if self._first_step is None:
            self._first_step = self.num_timesteps
        elif time.monotonic() - self._saved >= self._settings.checkpoint_seconds:
            assert isinstance(self.model, PPO)
            _save(self.model, self._env, self._checkpoint)
            self._saved = time.monotonic()
        if self.num_timesteps >= (1.0 - self._settings.final_share) * self._settings.steps:
            self._finish()

    def _finish(self) -> None:
        """The last part: little action noise, and exact-time missions twice as often."""
        policy: Any = self.model.policy
        policy.log_std.data.fill_(math.log(self._settings.final_std))
        weights = np.where(np.array(self._env.kinds) == EXACT_MISSION, 2.0, 1.0)
        self._env.weights = weights / weights.sum()

    def _on_rollout_end(self) -> None:
        success = self._env.success()
        for mission, share in success.items():
            if not math.isnan(share):
                self.logger.record(f"success/{mission}", share)
        if self._on_progress is not None:
            assert self._first_step is not None
            rate = (self.num_timesteps - self._first_step) / max(time.monotonic() - self._began, 1e-9)
            self._on_progress(Progress("training", self.num_timesteps, self._settings.steps, rate, success))


def _save(model: PPO, env: BatchedVecEnv, path: Path) -> None:
    """Everything that the rest of the run depends on, as tensors and one JSON text."""
    world = env.world
    arrays = {
        "task": world.task, "state": world.state, "location": world.location, "clocks": world.clocks,
        "memory": world.memory, "ghost": world.ghost, "potential": world.potential, "observation": world.observation,
        "returns": env.returns, "ticks": env.ticks, "episode_starts": model._last_episode_starts,
    }  # fmt: skip
    record = {
        "version": CHECKPOINT_VERSION,
        "steps": model.num_timesteps,
        "updates": model._n_updates,
        "policy": model.policy.state_dict(),
        "optimizer": model.policy.optimizer.state_dict(),
        "torch_random": torch.get_rng_state(),
        "arrays": {name: torch.from_numpy(np.array(array)) for name, array in arrays.items()},
        "text": json.dumps(
            {
                "world_random": world.rng.bit_generator.state,
                "shuffle_random": _global_random(),
                "recent": env.recent,
            }
        ),
    }
    temporary = path.with_suffix(".tmp")
    with temporary.open("wb") as file:
        torch.save(record, file)
        file.flush()
        os.fsync(file.fileno())
    os.replace(temporary, path)


def _global_random() -> tuple[Any, ...]:
    # stable-baselines3 shuffles its minibatches with numpy's global generator, which it seeds itself.
    name, keys, position, has_gauss, cached = np.random.get_state()  # noqa: NPY002
    return name, [int(key) for key in keys], int(position), int(has_gauss), float(cached)


def _restore(model: PPO, env: BatchedVecEnv, path: Path) -> None:
    try:
        record = torch.load(path, weights_only=True)
        text = json.loads(record["text"])
        version = record["version"]
    except Exception as error:  # noqa: BLE001, a damaged file makes torch raise almost anything
        raise TrainingError(
            f"cannot read the checkpoint {path} ({type(error).__name__}): delete it to begin the run anew"
        ) from None
    if version != CHECKPOINT_VERSION:
        raise TrainingError(f"{path} is a version {version} checkpoint, this program reads {CHECKPOINT_VERSION}")
    model.policy.load_state_dict(record["policy"])
    model.policy.optimizer.load_state_dict(record["optimizer"])
    model.num_timesteps, model._n_updates = record["steps"], record["updates"]
    arrays = {name: tensor.numpy() for name, tensor in record["arrays"].items()}
    for name in ("task", "state", "location", "clocks", "memory", "ghost", "potential", "observation"):
        getattr(env.world, name)[:] = arrays[name]
    env.returns[:], env.ticks[:] = arrays["returns"], arrays["ticks"]
    env.recent = text["recent"]
    env.world.rng.bit_generator.state = text["world_random"]
    model._last_obs = env.world.observation.copy()
    model._last_episode_starts = arrays["episode_starts"].copy()
    torch.set_rng_state(record["torch_random"])
    name, keys, position, has_gauss, cached = text["shuffle_random"]
    np.random.set_state((name, np.array(keys, dtype=np.uint32), position, has_gauss, cached))  # noqa: NPY002


def _write_atomically(path: Path, content: bytes) -> None:
    temporary = path.with_name(path.name + ".tmp")
    temporary.write_bytes(content)
    os.replace(temporary, path)
