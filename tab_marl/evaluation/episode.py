"""Playing one episode: a planner against a policy of the zoo on a task, to a row and, if wanted, a trace."""

from __future__ import annotations

import contextlib
import json
import os
import time
import traceback
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from tab_marl.agents.adversaries import AdversaryPolicy
from tab_marl.agents.planners import EgoAgent, PlannerOptions, make_planner
from tab_marl.envs.intercept_v0 import parallel_env
from tab_marl.evaluation.adversaries import opponent, population, precedents
from tab_marl.evaluation.engines.local import stop_requested
from tab_marl.evaluation.errors import Interrupted
from tab_marl.evaluation.report.replay import Trace, shrink
from tab_marl.evaluation.rows import EpisodeRow, Timing
from tab_marl.evaluation.units import Job, unit_seeds
from tab_marl.field.problem import FieldOptions
from tab_marl.mission.tasks import Task, ego_can_be_first, sample_task
from tab_marl.planning.models.drawn_ways import WaysOptions
from tab_marl.world.scenario import Scenario

ADVERSARY_STREAM = 1
"""Separates the adversary's own draws from the environment's, which have the same seed."""

WARM_STEPS = 11
"""Control steps: three decisions."""


@dataclass(frozen=True)
class Played:
    """One episode: its row, how long it took, and what is needed to show it."""

    row: EpisodeRow
    timing: Timing
    trace: Trace | None = None


def run_episode(
    task: Task,
    planner: EgoAgent,
    policy: AdversaryPolicy,
    seed: int,
    trace: bool = False,
    index: int = 0,
    planner_seed: int | None = None,
    should_stop: Callable[[], bool] = stop_requested,
    on_step: Callable[[Any], None] | None = None,
    render_mode: str | None = None,
    max_steps: int | None = None,
) -> Played:
    """Play one episode to interception or the horizon.

    `seed` decides the environment's draws (starts, the adversary's habits), `planner_seed` the planner's (default:
    `seed`), `index` is what the row is filed under. `on_step` is called with the environment after reset and every
    step, `max_steps` cuts the episode short. Raises Interrupted if `should_stop` says so.
    """
    env = parallel_env(
        task=task,
        adversary_style=policy.style,
        full_observation=planner.full_observation,
        render_mode=render_mode,
        max_cycles=max_steps,
    )
    began, clocks = time.perf_counter(), _Clocks()
    scenario = task.scenario
    every = scenario.control_hertz // scenario.decision_hertz
    recorder = _Recorder(task, every) if trace else None
    try:
        observations, _ = env.reset(seed=seed)
        policy.reset(task, np.random.default_rng(np.random.SeedSequence([seed, ADVERSARY_STREAM])))
        clocks.simulation += clocks.lap()
        planner.reset(task, np.random.default_rng(seed if planner_seed is None else planner_seed))
        clocks.preparation += clocks.lap()
        failed = False
        step = 0
        while True:
            if recorder is not None:
                recorder.record(env, planner if env.agents else None, step)
            if on_step is not None:
                on_step(env)
            if not env.agents:
                break
            if step % every == 0 and should_stop():
                raise Interrupted
            clocks.lap()
            ego = planner.act(observations["ego_0"])
            spent = clocks.lap()
            clocks.planner += spent
            if len(planner.decision_seconds) > clocks.decided:
                clocks.decided += 1
                clocks.decisions += spent
            adversary = policy.act(observations["adversary_0"])
            observations, _, _, _, infos = env.step({"ego_0": ego, "adversary_0": adversary})
            clocks.simulation += clocks.lap()
            failed |= infos["ego_0"]["mission_status"] == "failed"
            step += 1
        episode = env.episode
        horizon = round(scenario.horizon_seconds * scenario.physics_hertz)
        completed = episode.completed_seconds
        learned = planner.learned_state()
        row = EpisodeRow(
            mission=task.mission_id,
            family=task.family,
            planner=planner.name,
            seed=index,
            adversary=policy.name,
            slack=task.slack,
            intercepted=episode.intercepted,
            completed=completed is not None,
            failed=failed,
            physics_steps=episode.physics_steps if episode.intercepted else horizon,
            horizon_steps=horizon,
            completed_step=None if completed is None else round(completed * scenario.physics_hertz),
            ego_first=ego_can_be_first(task),
            fallbacks=planner.fallbacks,
            learned=None if learned is None else json.dumps(learned, sort_keys=True, separators=(",", ":")),
        )
    finally:
        env.close()
    taken = 1000 * np.asarray(planner.decision_seconds)
    mean, worst = (float(taken.mean()), float(taken.max())) if len(taken) else (float("nan"), float("nan"))
    timing = Timing(
        len(taken),
        mean,
        worst,
        time.perf_counter() - began,
        processor_seconds=clocks.total(),
        preparation_processor_seconds=clocks.preparation,
        decision_processor_seconds=clocks.decisions,
        planner_processor_seconds=clocks.preparation + clocks.planner,
        simulation_processor_seconds=clocks.simulation,
    )
    return Played(row, timing, None if recorder is None else recorder.trace)


class _Clocks:
    """Where an episode's processor time goes: that of this thread, which other jobs do not lengthen."""

    def __init__(self) -> None:
        self._began = self._last = time.thread_time()
        self.preparation = self.planner = self.decisions = self.simulation = 0.0
        self.decided = 0

    def lap(self) -> float:
        """Seconds since the last call."""
        now = time.thread_time()
        spent, self._last = now - self._last, now
        return spent

    def total(self) -> float:
        return time.thread_time() - self._began


class _Recorder:
    """Fills a Trace."""

    def __init__(self, task: Task, every: int) -> None:
        self._task, self._every = task, every
        self.trace = Trace(task.scenario.control_hertz)
        self._status = "active"

    def record(self, env: Any, planner: EgoAgent | None, step: int) -> None:
        episode, scenario = env.episode, self._task.scenario
        ego, adversary = episode.motion
        self.trace.poses.append(
            (ego.x, ego.y, ego.theta, adversary.x, adversary.y, adversary.theta, bool(episode.seen_by))
        )
        if (
            planner is not None and step % self._every == 1
        ):  # just after a decision, when the belief is that of its tick
            image = planner.belief_image()
            if image is not None:
                self.trace.beliefs.append((step - 1, shrink(image, scenario.width_metres, scenario.height_metres)))
        status = episode.monitor.status
        if status != self._status and not episode.intercepted:
            self._status = status
            self.trace.events.append((episode.seconds, f"mission {status}"))
        if episode.intercepted:
            self.trace.events.append((episode.seconds, "intercepted"))


def play_job(job: Job) -> list[tuple[EpisodeRow, Timing]]:
    """Every episode of a job. One that breaks down becomes a row with its error; nothing is dropped."""
    return [(played.row, played.timing) for played in play_unit(job)]


def play_unit(job: Job, trace: bool = False) -> list[Played]:
    """As `play_job`, with traces if wanted."""
    task_sequence, episode_seed, planner_seed = unit_seeds(job.base_seed, job.unit)
    task: Task | None = None
    played = []
    for name in job.planners:
        began = time.perf_counter()
        try:
            if task is None:
                task = sample_task(np.random.default_rng(task_sequence), job.unit.mission, job.unit.family, job.slack)
                if job.planner_preset == "paper":
                    # The paper's reward knows no price of a completed mission.
                    free = replace(task.scenario, rewards=replace(task.scenario.rewards, mission_completed=0.0))
                    task = replace(task, scenario=free)
            options = PlannerOptions(
                tab_field=FieldOptions.preset(job.planner_preset),
                ways=None if job.planner_preset == "paper" else WaysOptions(),
                rollouts=population(job.adversaries),
                precedents=precedents(job.adversary),
            )
            planner = make_planner(name, options)
            if job.learned is not None:
                planner.restore(json.loads(job.learned))
            policy = opponent(job.adversary)
            _warm(name, task, options, policy, episode_seed, planner_seed)
            played.append(run_episode(task, planner, policy, episode_seed, trace, job.unit.seed, planner_seed))
        except (Interrupted, MemoryError):
            raise
        except Exception as error:  # noqa: BLE001, whatever broke becomes part of the record
            played.append(_broken(job, name, task, error, time.perf_counter() - began))
    return played


_warmed: set[str] = set()


def _warm(
    planner: str, task: Task, options: PlannerOptions, policy: AdversaryPolicy, seed: int, planner_seed: int
) -> None:
    """Play the first moments of the episode, once per process: loading compiled kernels is no decision time.

    Those of another episode could break down where this one does not, and which episode is a worker's first is chance.
    """
    if planner not in _warmed:
        _warmed.add(planner)
        agent = make_planner(planner, options)
        run_episode(task, agent, policy, seed, planner_seed=planner_seed, max_steps=WARM_STEPS)


def _broken(job: Job, planner: str, task: Task | None, error: Exception, seconds: float) -> Played:
    scenario = Scenario.preset("lab") if task is None else task.scenario  # its horizon: the longest waiting there is
    horizon = round(scenario.horizon_seconds * scenario.physics_hertz)
    row = EpisodeRow(
        mission=job.unit.mission,
        family=job.unit.family,
        planner=planner,
        seed=job.unit.seed,
        adversary=_name_in_row(job.adversary),
        slack=float("nan") if task is None else task.slack,
        intercepted=False,
        completed=False,
        failed=False,
        physics_steps=horizon,
        horizon_steps=horizon,
        error=" ".join(f"{type(error).__name__}: {error}".split()),
        learned=job.learned,
    )
    return Played(row, Timing(0, float("nan"), float("nan"), seconds, traceback.format_exc()))


def lost_job(job: Job, reason: str) -> list[tuple[EpisodeRow, Timing]]:
    """The rows of episodes that no worker survived: with the error, scored as their planner's worst case."""
    sequence, _, _ = unit_seeds(job.base_seed, job.unit)
    task: Task | None = None
    with contextlib.suppress(Exception):
        task = sample_task(np.random.default_rng(sequence), job.unit.mission, job.unit.family, job.slack)
    lost = [_broken(job, planner, task, WorkerLost(reason), 0.0) for planner in job.planners]
    return [(played.row, replace(played.timing, traceback=None)) for played in lost]


class WorkerLost(Exception):
    """The process that played an episode died."""


def _name_in_row(adversary: str) -> str:
    return adversary if os.sep not in adversary else Path(adversary).name
