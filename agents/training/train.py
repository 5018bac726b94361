"""Training of mission-conditioned adversary policies with stable-baselines3 and sb3-contrib in the batched world.

A run lives in one folder: its settings, its checkpoint, its TensorBoard and CSV logs and, at the end, the exported policy.
It may be killed at any moment; the same call continues it and ends with the same weights as an undisturbed run.
"""

from __future__ import annotations

import math
import os
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
import torch
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import configure

from tab_marl.agents.training.algorithms import ALGORITHMS
from tab_marl.agents.training.checkpoint import CHECKPOINT_FILE, Checkpoint, Exploration
from tab_marl.agents.training.env import TRAINING, BatchedVecEnv, build_bank, difficulties, draw_tasks
from tab_marl.agents.training.hyperparameters import HyperparameterError, arguments, check
from tab_marl.agents.training.initial import begin_with
from tab_marl.agents.training.log import LOG_FILE, ROWS, LearningLog
from tab_marl.agents.training.settings import UNOPPOSED, TrainingError, TrainingSettings
from tab_marl.mission.tasks import Task

try:
    import fcntl
except ImportError:
    fcntl = None  # type: ignore[assignment]

__all__ = ["CHECKPOINT_FILE", "LOG_FILE", "LOG_FOLDER", "SETTINGS_FILE", "OnProgress", "Progress", "train"]

SETTINGS_FILE = "settings.toml"
LOG_FOLDER = "tensorboard"
LOCK_FILE = "lock"
EXACT_MISSION = "M2"
NOT_PART_OF_A_RUN = ("checkpoint_seconds", "description", "split")
"""Settings that may differ when a run is continued."""


@dataclass(frozen=True)
class Progress:
    """Where a run stands; given to the progress callback after every row of the log and while the tasks are built."""

    phase: str
    """ "tasks" while the bank is built, then "training", then "habits" where those are learned."""
    done: int
    """Tasks, control steps, or rounds of hunted episodes."""
    total: int
    steps_per_second: float
    """Learning included, since this process began or continued the run; 0 while building."""
    success: dict[str, float]
    """Share of completed missions per mission type over the last episodes, action noise on; nan before the first."""
    cpu_seconds: float = 0.0
    """Of the whole run so far."""


OnProgress = Callable[[Progress], None]


def train(settings: TrainingSettings, out_dir: Path | str, on_progress: OnProgress | None = None) -> Any:
    """Train, or continue, the run in `out_dir`; returns the trained model (export it with `zoo.export_policy`).

    Writes ``settings.toml``, ``checkpoint.pt`` (replaced atomically, read back without unpickling code), ``replay/``
    while an off-policy algorithm learns, ``log.csv`` and ``tensorboard/`` in `out_dir`. A finished run returns at once.

    Raises TrainingError if the folder holds a run with other settings or an unreadable checkpoint, if another process
    trains there, or for a hyperparameter that the algorithm does not have; OSError if the folder cannot be written.
    """
    folder = Path(out_dir)
    try:
        check(settings.algorithm, settings.hyperparameters)
    except HyperparameterError as error:
        raise TrainingError(str(error)) from None
    folder.mkdir(parents=True, exist_ok=True)
    with _alone_in(folder), _one_thread():
        _claim(folder, settings)
        model = _train(settings, folder, on_progress)
        if settings.habits_against:
            _learn_habits(settings, model, folder, on_progress)
        return model


@contextmanager
def _one_thread() -> Iterator[None]:
    """The networks are small: one thread is fastest, and results do not depend on the machine."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)


@contextmanager
def _alone_in(folder: Path) -> Iterator[None]:
    """Hold the folder's lock, which the system takes back from a process that dies. Raises TrainingError."""
    if fcntl is None:  # no such locks on this system
        yield
        return
    with (folder / LOCK_FILE).open("w") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            raise TrainingError(f"another process trains in {folder}: wait for it, or choose another folder") from None
        yield


def _claim(folder: Path, settings: TrainingSettings) -> None:
    """Write the settings into a new folder, or check that those there are the same."""
    path = folder / SETTINGS_FILE
    if path.exists():
        theirs = TrainingSettings.from_toml(path)
        for f in fields(settings):
            mine, their = getattr(settings, f.name), getattr(theirs, f.name)
            if mine != their and f.name not in NOT_PART_OF_A_RUN:
                raise TrainingError(
                    f"{folder} holds a run with {f.name} = {their!r}, asked for {mine!r}: "
                    "continue it with its own settings or choose another folder"
                )
    temporary = path.with_name(path.name + ".tmp")
    temporary.write_bytes(settings.to_toml().encode())
    os.replace(temporary, path)


def _train(settings: TrainingSettings, folder: Path, on_progress: OnProgress | None) -> Any:
    clock = _Clock()
    env = _environment(settings, on_progress)
    model = build_model(settings, env)
    checkpoint = Checkpoint(folder)
    if checkpoint.exists():
        clock.continue_from(checkpoint.restore(model, env))
    elif settings.initial:
        begin_with(model, settings.initial)
    log = LearningLog(folder, sorted(set(env.kinds)), model.num_timesteps)
    model.set_logger(configure(str(folder / LOG_FOLDER), ["tensorboard"]))
    remaining = settings.steps - model.num_timesteps
    if remaining > 0:
        watch = _Watch(settings, env, checkpoint, log, clock, on_progress)
        # The log is written by the watch: the algorithms would write theirs every few episodes.
        learner: Any = model
        learner.learn(remaining, callback=watch, log_interval=None, reset_num_timesteps=False)
        model.logger.close()
        checkpoint.save(model, env, clock.record(), finished=True)
    return model


def _learn_habits(settings: TrainingSettings, model: Any, folder: Path, on_progress: OnProgress | None) -> None:
    from tab_marl.agents.hunted.habits import learn_for

    def learned(done: int, total: int) -> None:
        if on_progress is not None:
            on_progress(Progress("habits", done, total, 0.0, {}))

    learn_for(settings, model, folder, learned)


def _environment(settings: TrainingSettings, on_progress: OnProgress | None) -> Any:
    """The VecEnv that the settings ask for."""

    def built(done: int, total: int) -> None:
        if on_progress is not None and (done % 20 == 0 or done == total):
            on_progress(Progress("tasks", done, total, 0.0, {}))

    if settings.opponent != UNOPPOSED:
        from tab_marl.agents.hunted.env import hunted_env

        return hunted_env(settings, built)
    tasks = training_tasks(settings)
    bank = build_bank(tasks, settings.style, settings.seed, built)
    kinds = [task.mission_id for task in tasks]
    return BatchedVecEnv(bank, kinds, settings.robots, settings.seed, settings.ego_seen_metres)


def training_tasks(settings: TrainingSettings) -> list[Task]:
    """The tasks that a run with these settings trains on."""
    return draw_tasks(
        TRAINING, settings.seed, settings.tasks, settings.missions, settings.families, settings.map, settings.difficulty,
        settings.compositions,
    )  # fmt: skip


def build_model(settings: TrainingSettings, env: Any) -> BaseAlgorithm:
    """The untrained model of these settings. Raises TrainingError."""
    hyperparameters = settings.hyperparameters
    given = arguments(hyperparameters)
    policy = given.pop("policy", "MlpPolicy")
    if "n_steps" in given and "batch_size" in given and "buffer_size" not in given:
        given["batch_size"] = min(given["batch_size"], settings.robots * given["n_steps"])
    if "noise_type" in hyperparameters or "noise_std" in hyperparameters:
        given["action_noise"] = Exploration(settings.robots, float(hyperparameters["noise_std"]), settings.seed)
    try:
        model: BaseAlgorithm = ALGORITHMS[settings.algorithm].load()(
            policy, env, seed=settings.seed, device="cpu", **given
        )
    except (TypeError, ValueError, AssertionError) as error:
        raise TrainingError(
            f"{settings.name}: {ALGORITHMS[settings.algorithm].title} does not take these hyperparameters ({error})"
        ) from None
    return model


class _Clock:
    """Seconds that a run has taken, over all processes that worked on it."""

    def __init__(self) -> None:
        self._began, self._cpu_began = time.monotonic(), time.process_time()
        self._before = self._cpu_before = 0.0

    def continue_from(self, record: dict[str, float]) -> None:
        self._before, self._cpu_before = record["seconds"], record["cpu_seconds"]

    @property
    def seconds(self) -> float:
        return self._before + time.monotonic() - self._began

    @property
    def cpu_seconds(self) -> float:
        return self._cpu_before + time.process_time() - self._cpu_began

    def record(self) -> dict[str, float]:
        return {"seconds": self.seconds, "cpu_seconds": self.cpu_seconds}


class _Watch(BaseCallback):
    """Between updates: the phases of a run, checkpoints, the logs and the progress callback."""

    def __init__(
        self,
        settings: TrainingSettings,
        env: Any,
        checkpoint: Checkpoint,
        log: LearningLog,
        clock: _Clock,
        on_progress: OnProgress | None,
    ) -> None:
        super().__init__()
        self._settings, self._env, self._checkpoint = settings, env, checkpoint
        self._log, self._clock, self._on_progress = log, clock, on_progress
        self._began = self._saved = time.monotonic()
        self._first_step: int | None = None
        self._before = 0
        self._row_steps = max(settings.steps // ROWS, 1)
        self._weights = Sampler(settings, env.kinds)

    def _on_step(self) -> bool:
        return True

    def _on_rollout_start(self) -> None:
        if self._first_step is None:
            self._first_step = self.num_timesteps
        elif time.monotonic() - self._saved >= self._settings.checkpoint_seconds:
            self._checkpoint.save(self.model, self._env, self._clock.record())
            self._saved = time.monotonic()
        self._before = self.num_timesteps
        self._env.weights = self._weights(self.num_timesteps)
        if self.num_timesteps >= self._settings.final_step:
            _quieten(self.model, self._settings.final_std)

    def _on_rollout_end(self) -> None:
        if self._before // self._row_steps == self.num_timesteps // self._row_steps:
            return
        success = self._env.success()
        episodes = [episode["r"] for episode in self.model.ep_info_buffer or ()]
        seconds, cpu_seconds = self._clock.seconds, self._clock.cpu_seconds
        self._log.row(
            self.num_timesteps,
            self.model._n_updates,
            seconds,
            cpu_seconds,
            float(np.mean(episodes)) if episodes else math.nan,
            success,
        )
        for mission, share in success.items():
            if not math.isnan(share):
                self.logger.record(f"success/{mission}", share)
        self.logger.record("time/cpu_seconds", cpu_seconds)
        self.model.dump_logs()
        if self._on_progress is not None:
            assert self._first_step is not None
            rate = (self.num_timesteps - self._first_step) / max(time.monotonic() - self._began, 1e-9)
            self._on_progress(
                Progress("training", self.num_timesteps, self._settings.steps, rate, success, cpu_seconds)
            )


def _quieten(model: Any, std: float) -> None:
    """Little action noise, where the noise is not the algorithm's to choose (SAC and TQC weigh it against the reward)."""
    if hasattr(model.policy, "log_std"):
        model.policy.log_std.data.fill_(math.log(std))
    elif getattr(model, "action_noise", None) is not None:
        model.action_noise.std = min(model.action_noise.std, std)


class Sampler:
    """The probability of each task of the bank as the run goes on; a function of the control steps alone."""

    def __init__(self, settings: TrainingSettings, kinds: tuple[str, ...]) -> None:
        self._settings = settings
        self._exact = np.where(np.array(kinds) == EXACT_MISSION, 2.0, 1.0)
        self._hardness = np.zeros(len(kinds))
        if settings.difficulty is not None:
            self._hardness = np.array(difficulties(TRAINING, settings.seed, len(kinds), settings.difficulty))

    def __call__(self, steps: int) -> np.ndarray[Any, np.dtype[np.float64]]:
        """``[K]``, summing to 1."""
        settings = self._settings
        weights = self._exact if steps >= settings.final_step else np.ones(len(self._exact))
        rising = settings.curriculum_share * settings.steps
        if steps < rising and settings.difficulty is not None:
            low, high = settings.difficulty
            weights = np.where(self._hardness <= low + (high - low) * steps / rising, weights, 0.0)
            if not weights.any():
                weights = (self._hardness == self._hardness.min()).astype(float)
        return np.asarray(weights / weights.sum())
