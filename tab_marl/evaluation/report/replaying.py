"""Plays chosen episodes again, exactly as they were, and turns them into what the page animates."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from tab_marl.envs.mission_scene import mission_scene
from tab_marl.evaluation.engines.local import pool
from tab_marl.evaluation.episode import Played, play_unit
from tab_marl.evaluation.report.replay import Choice, encode_image, encode_map, encode_trace, shrink
from tab_marl.evaluation.rows import EpisodeRow
from tab_marl.evaluation.settings import LEARNS_ACROSS_EPISODES
from tab_marl.evaluation.store import Store
from tab_marl.evaluation.units import Job, unit_seeds
from tab_marl.field import FieldOptions, FieldProblem, solve
from tab_marl.mission import to_english
from tab_marl.mission.tasks import Task, sample_task


def replay_groups(
    choices: Sequence[Choice],
    planners: Sequence[str],
    content: Mapping[str, Any],
    store: Store,
    key: str,
    workers: int,
) -> list[dict[str, Any]]:
    """One group per choice: every planner's episode of that unit, re-simulated. `content` as the store keeps it."""
    rows = {row.key: row for row in store.rows(key)}
    jobs = []
    for choice in choices:
        unit = choice.unit
        base = Job(
            unit, (), content["seed"], content["slack"], tuple(content["adversaries"]), content["planner_preset"]
        )
        present = [p for p in planners if (unit.mission, unit.family, p, unit.seed) in rows]
        for planner in present:
            learned = None
            if planner in LEARNS_ACROSS_EPISODES and unit.seed:
                learned = store.learned(key, unit.mission, unit.family, planner, unit.seed - 1)
            jobs.append(replace(base, planners=(planner,), learned=learned))
    if not jobs:
        return []
    with pool(min(workers, len(jobs))) as (executor, _):
        played = list(executor.map(_play_traced, jobs))
    groups = []
    for choice in choices:
        part = [(job, result) for job, result in zip(jobs, played, strict=True) if job.unit == choice.unit]
        if part:
            groups.append(_group(choice, part, rows))
    return groups


def _play_traced(job: Job) -> Played:
    return play_unit(job, trace=True)[0]


def _group(choice: Choice, part: Sequence[tuple[Job, Played]], rows: Mapping[Any, EpisodeRow]) -> dict[str, Any]:
    job, unit = part[0][0], choice.unit
    task = sample_task(np.random.default_rng(unit_seeds(job.base_seed, unit)[0]), unit.mission, unit.family, job.slack)
    text = to_english(task.mission, task.scenario)
    scene = mission_scene(task.mission, task.scenario, text)
    goals = list(dict.fromkeys(region for stage in scene.stages for region in stage.regions))
    episodes: list[dict[str, Any]] = []
    for _, played in part:
        if played.trace is None:
            continue
        stored = rows[played.row.key]
        # Another processor may round differently; the page must not pass a different episode off as the stored one.
        same = replace(played.row, learned=None) == replace(stored, learned=None)
        episodes.append(
            {
                "planner": played.row.planner,
                "outcome": outcome(played.row),
                "note": "" if same else "unlike the stored episode, which another machine or version played",
                "trace": encode_trace(played.trace),
            }
        )
    return {
        "title": f"{unit.mission}, {unit.family}, episode {unit.seed}",
        "about": f"“{text}” Adversary: {job.adversary}. Episode {unit.seed}, slack {task.slack:.2f}.",
        "why": f"Chosen as {choice.why}.",
        "map": encode_map(task.scenario, goals, scene.avoided),
        "field": encode_field(task, job.planner_preset, max(len(e["trace"]["poses"][0]) for e in episodes)),
        "episodes": episodes,
    }


def encode_field(task: Task, preset: str, control_steps: int) -> dict[str, Any]:
    """The TAB-Field of the mission over the steps that are shown: where the adversary may be if nothing is seen of it.

    `rows`, `columns` of a picture, and `frames`: (control step, encoded picture) at each tick.
    """
    problem = FieldProblem.from_mission(task.mission, task.scenario, FieldOptions.preset(preset))
    field, scenario = solve(problem), task.scenario
    assert problem.grid is not None  # a mission on a map has one
    per_tick = scenario.step_seconds * scenario.control_hertz
    frames = []
    shape = (0, 0)
    for tick, occupancy in enumerate(field.occupancy):
        if tick * per_tick > control_steps:
            break
        image = shrink(problem.grid.image(occupancy, 0.0), scenario.width_metres, scenario.height_metres)
        shape = image.shape
        frames.append([round(tick * per_tick), encode_image(image)])
    return {"rows": shape[0], "columns": shape[1], "frames": frames}


def outcome(row: EpisodeRow) -> str:
    """One sentence on how the episode ended."""
    if row.error is not None:
        return f"broke down: {row.error}"
    met = f"met the adversary after {row.physics_steps / 100:.1f} s"
    if row.completed and row.completed_step is not None:
        done = f"the adversary completed its mission after {row.completed_step / 100:.1f} s"
        return f"{done}; the ego {met}" if row.intercepted else f"{done} and was never met"
    if row.intercepted:
        return f"{met}, before its mission was completed" + (" (which it had failed by then)" if row.failed else "")
    return "the adversary was never met" + (
        ", but failed its mission" if row.failed else ", nor did it complete its mission"
    )
