"""Which field predicts adversaries best: forecasts of many fields, and of rivals, against rollouts of learned policies.

One unit of work is a task. Every model forecasts where the adversary will be 2, 5 and 10 s ahead, from the start and again
after 5 s of cameras, and is scored on trajectories of policies that it knows nothing about.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass, replace
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from tab_marl.agents.measures.rollouts import rollout_unopposed
from tab_marl.agents.planners import PlannerOptions
from tab_marl.agents.policies.zoo import find_policy
from tab_marl.agents.pretraining import untrained
from tab_marl.evaluation.prediction import Forecast, kernel_forecast, mixed
from tab_marl.evaluation.units import stable_hash
from tab_marl.field import FieldOptions, InfeasibleField, ProductBelief, sample_paths
from tab_marl.mission.tasks import Task, sample_task
from tab_marl.planning.models.field_model import FieldModel
from tab_marl.planning.models.interface import AdversaryModel, Sighting, TickObservation
from tab_marl.planning.models.mission_map import MissionMap
from tab_marl.planning.models.pool import TrajectoryPool
from tab_marl.planning.models.shortest_path import ShortestPath
from tab_marl.planning.models.walker import Walker
from tab_marl.world.grid import GridMap
from tab_marl.world.scenario import Scenario

AHEAD_SECONDS = (2.0, 5.0, 10.0)
WATCHED_SECONDS = 5.0
"""How long the cameras have watched before the filtered forecasts."""
LEVEL = 0.9
NOWHERE = (-100.0, -100.0)
"""Where the ego is: too far away to tell anything by not meeting the adversary."""
PER_POLICY = 4
"""Trajectories per policy that forecasts are scored on."""
KNOWN_PER_POLICY = 60
"""Trajectories per policy of the kernel estimate that knows the population."""
SAMPLES = 2000
"""Of models that can only sample."""
PACES = (0.55, 0.75, 1.0)

VARIED = FieldOptions(reference="drive_and_turn", mean_run_metres=1.0)
"""The field of which the filter, the kernel and the pace are varied."""


def _fields() -> Iterator[tuple[str, FieldOptions]]:
    yield "paper walk", FieldOptions(reference="paper_walk", goal_marginals=0.0)
    for name, motion in {
        "walk": FieldOptions(reference="walk"),
        "tumble": FieldOptions(reference="run_and_tumble", mean_run_metres=1.0),
        "drive": VARIED,
    }.items():
        yield name, replace(motion, goal_marginals=0.0)
        yield f"{name} + goals", motion
        yield f"{name} + timing", replace(motion, goal_marginals=0.0, timing_prior=True)
        yield f"{name} + goals + timing", replace(motion, timing_prior=True)
    yield "unicycle + goals", FieldOptions(reference="unicycle")
    yield "tumble 0.5 m + goals", FieldOptions(reference="run_and_tumble", mean_run_metres=0.5)
    yield "tumble + near goals", FieldOptions(goal_nearness=1.5)
    yield "turn, tumble + goals", FieldOptions(begins_at_rest=True)
    yield "turn, tumble + near goals", FieldOptions(goal_nearness=1.5, begins_at_rest=True)
    yield "drive 0.5 m + goals", replace(VARIED, mean_run_metres=0.5)
    yield "drive 2 m + goals", replace(VARIED, mean_run_metres=2.0)


FIELDS = dict(_fields())
"""Literal maximum entropy and each repair, alone and together."""
OTHERS = ("particles", "marginal kernel", "pace latent", "S", "FP", "MLE", "knows the population")
"""Of `drive + goals`: filtered by 2,000 particles, moved by its marginals as in the paper, a mixture over paces fixed per
trajectory. Then the rivals' models, and a kernel estimate from the policies' own rollouts."""


@dataclass(frozen=True)
class Cell:
    """A kind of task, and how many of it have been drawn."""

    mission: str
    family: str
    slack: float
    index: int

    @property
    def name(self) -> str:
        return f"{self.mission}-{self.family}-{self.slack}-{self.index}"

    def task(self, seed: int) -> Task:
        return sample_task(self.rng(seed, 0), self.mission, self.family, self.slack)

    def rng(self, seed: int, stream: int) -> np.random.Generator:
        name = stable_hash(f"{self.mission}/{self.family}/{self.slack}")
        return np.random.default_rng([seed, name, self.index, stream])


@dataclass(frozen=True, eq=False)
class Truth:
    """N trajectories per tick: positions ``[N, T + 1, 2]`` metres and completion ticks ``[N]`` (-1: never)."""

    positions: NDArray[np.float64]
    completed_tick: NDArray[np.int32]

    def completed(self, tick: int) -> NDArray[np.bool_]:
        return (self.completed_tick >= 0) & (self.completed_tick <= tick)

    @classmethod
    def of(cls, task: Task, policies: tuple[str, ...], count: int, rng: np.random.Generator) -> Truth:
        found = [rollout_unopposed(find_policy(name), task, rng, count) for name in policies]
        return cls(np.concatenate([f[0] for f in found]), np.concatenate([f[1] for f in found]))


def play(cells: Sequence[Cell], policies: tuple[str, ...], seed: int, folder: Path, workers: int = 1) -> Iterator[Cell]:
    """Write one CSV per task into `folder`; tasks already there are skipped. Yields each task when it is done."""
    folder.mkdir(parents=True, exist_ok=True)
    missing = [cell for cell in cells if not (folder / f"{cell.name}.csv").exists()]
    with ProcessPoolExecutor(workers, mp_context=get_context("spawn")) as pool:
        jobs = {pool.submit(_rows, cell, policies, seed): cell for cell in missing}
        for job in as_completed(jobs):
            partial = folder / f"{jobs[job].name}.partial"
            pd.DataFrame(job.result()).to_csv(partial, index=False)
            partial.rename(folder / f"{jobs[job].name}.csv")
            yield jobs[job]


def _rows(cell: Cell, policies: tuple[str, ...], seed: int) -> list[dict[str, Any]]:
    return list(rows_of(cell, policies, seed))


def rows_of(
    cell: Cell, policies: tuple[str, ...], seed: int, models: Sequence[str] = (*FIELDS, *OTHERS)
) -> Iterator[dict[str, Any]]:
    """Scores of the models on one task, averaged over the policies' trajectories."""
    task = cell.task(seed)
    truth = Truth.of(task, policies, PER_POLICY, cell.rng(seed, 1))
    known = Truth.of(task, policies, KNOWN_PER_POLICY, cell.rng(seed, 2))
    ticks = tuple(round(s / task.scenario.step_seconds) for s in AHEAD_SECONDS)
    head = {"mission": cell.mission, "family": cell.family, "slack": cell.slack, "index": cell.index}
    for name in models:
        try:
            blank = _Blank(name, task, known, cell.rng(seed, 3))
        except ValueError as error:  # no trajectory of this reference is fast enough, or the option does not apply
            yield {**head, "model": name, "watched": 0.0, "ahead": 0.0, "n": 0, "error": str(error)}
            continue
        for watched, ahead, log_score, covered in _scores(blank, task, truth, ticks, cell.rng(seed, 4)):
            yield {
                **head, "model": name, "watched": watched, "ahead": ahead, "n": len(log_score),
                "log_score": round(float(log_score.mean()), 4), "covered": round(float(covered.mean()), 4),
            }  # fmt: skip


def _scores(
    blank: _Blank, task: Task, truth: Truth, ticks: tuple[int, ...], rng: np.random.Generator
) -> Iterator[tuple[float, float, NDArray[np.float64], NDArray[np.bool_]]]:
    """(seconds watched, seconds ahead, log-scores, covered) from the start and after watching."""
    step = task.scenario.step_seconds
    for tick, forecast in zip(ticks, blank.forecasts(None, 0, ticks), strict=True):
        points, done = truth.positions[:, min(tick, truth.positions.shape[1] - 1)], truth.completed(tick)
        yield 0.0, tick * step, forecast.log_score(points, done), forecast.covered(points, done, LEVEL, rng)
    watched = round(WATCHED_SECONDS / step)
    found: dict[int, list[tuple[NDArray[np.float64], NDArray[np.bool_]]]] = {tick: [] for tick in ticks}
    for i in np.flatnonzero(~truth.completed(watched))[::PER_POLICY]:
        forecasts = blank.forecasts(truth.positions[i], watched, ticks)
        for tick, forecast in zip(ticks, forecasts, strict=True):
            at = min(watched + tick, truth.positions.shape[1] - 1)
            point, done = truth.positions[i : i + 1, at], truth.completed(at)[i : i + 1]
            found[tick].append((forecast.log_score(point, done), forecast.covered(point, done, LEVEL, rng)))
    for tick, pairs in found.items():
        if pairs:
            scores, covered = (np.concatenate(part) for part in zip(*pairs, strict=True))
            yield WATCHED_SECONDS, tick * step, scores, covered


class _Blank:
    """A model of one task before it has seen anything; `forecasts` starts afresh each time."""

    def __init__(self, name: str, task: Task, known: Truth, rng: np.random.Generator) -> None:
        self.name, self.task, self.known, self.rng = name, task, known, rng
        self.grid = GridMap.from_scenario(task.scenario, 0.05)
        self.models = self._models()

    def _models(self) -> list[AdversaryModel]:
        scenario, mission = self.task.scenario, self.task.mission
        if self.name in FIELDS:
            return [FieldModel(scenario, mission, FIELDS[self.name])]
        if self.name == "marginal kernel":
            return [FieldModel(scenario, mission, replace(VARIED, kernel="marginal"))]
        if self.name == "pace latent":
            return list(_at_paces(scenario, self.task))
        if self.name == "particles":
            field = FieldModel(scenario, mission, VARIED).field
            drawn = sample_paths(field.chain, field.belief(), self.rng, SAMPLES, scenario.horizon_ticks)
            return [TrajectoryPool(scenario, drawn.positions, drawn.completed_tick)]
        if self.name == "knows the population":
            return [TrajectoryPool(scenario, self.known.positions, self.known.completed_tick)]
        if self.name == "FP":
            return [ShortestPath(scenario, mission, PlannerOptions().shortest_path)]
        learns = self.name == "MLE"
        tables = MissionMap.build(scenario, mission)
        return [Walker(tables, untrained() if learns else None, feasible=learns, learns=learns, particles=SAMPLES)]

    def forecasts(self, track: NDArray[np.float64] | None, watched: int, ticks: tuple[int, ...]) -> list[Forecast]:
        """Of the position so many ticks after `watched` ticks of looking at `track` ``[T + 1, 2]``.

        Given that the mission is still under way then.
        """
        per_model = []
        for model in self.models:
            for tick in range(watched + 1 if track is not None else 1):
                observation = _look(self.task.scenario, track, tick)
                (model.start if tick == 0 else model.observe)(observation, self.rng)
            if isinstance(model, FieldModel):
                per_model.append(_exact(model.belief.copy(), model.grid, ticks))
            else:
                drawn = model.sample(SAMPLES, max(ticks), self.rng)
                done = drawn.completed_tick
                per_model.append(
                    [kernel_forecast(self.grid, drawn.positions[:, k], (done >= 0) & (done <= k)) for k in ticks]
                )
        evidence = np.array([getattr(model, "log_evidence", 0.0) for model in self.models])
        weights = np.exp(evidence - evidence.max()).tolist()
        return [mixed(at, weights) for at in zip(*per_model, strict=True)]


def _at_paces(scenario: Scenario, task: Task) -> Iterator[FieldModel]:
    """The default field at several top speeds, each as likely; those too slow for the mission are left out."""
    for pace in PACES:
        slower = replace(scenario.adversary, max_speed=pace * scenario.adversary.max_speed)
        try:
            yield FieldModel(replace(scenario, adversary=slower), task.mission, VARIED)
        except InfeasibleField:
            continue


def _look(scenario: Scenario, track: NDArray[np.float64] | None, tick: int) -> TickObservation:
    """What the cameras report at a tick; nothing without a track."""
    if track is None or not scenario.seen(track[tick : tick + 1])[0]:
        return TickObservation(tick, NOWHERE)
    dx, dy = track[tick] - track[max(tick - 1, 0)]
    theta, speed = (float(np.arctan2(dy, dx)), float(np.hypot(dx, dy))) if tick else (0.0, 0.0)
    sighting = Sighting(float(track[tick, 0]), float(track[tick, 1]), theta, speed / scenario.step_seconds)
    return TickObservation(tick, NOWHERE, sighting)


def _exact(belief: ProductBelief, grid: GridMap, ticks: tuple[int, ...]) -> list[Forecast]:
    """Read off the filter, without sampling."""
    under_way = belief.automaton_states != belief.chain.accepting
    if 0 < belief.completed < 1:
        belief.masses = belief.masses[under_way] / belief.masses[under_way].sum()
        belief.automaton_states = belief.automaton_states[under_way]
    out = []
    for tick in range(1, max(ticks) + 1):
        belief.predict()
        if tick in ticks:
            alive = belief.masses[belief.automaton_states != belief.chain.accepting]
            mass = alive.sum(axis=0).reshape(belief.chain.cells, belief.chain.modes).sum(axis=1)
            total = float(mass.sum()) + belief.completed
            out.append(Forecast(grid, mass / total, belief.completed / total))
    return out
