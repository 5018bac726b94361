"""What an environment is asked to play: one fixed task, or a new one drawn at every reset.

A source is a function of a numpy Generator. Those made here are plain data, so that an environment that holds one can be
copied and pickled.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from tab_marl.envs.paper_missions import paper_mission
from tab_marl.mission import Mission, parse_mission
from tab_marl.mission.curriculum import Curriculum, check_difficulty
from tab_marl.mission.feasibility import check_feasible
from tab_marl.mission.library import MISSIONS
from tab_marl.mission.tasks import FAMILIES, MISSION_IDS, Task, sample_task
from tab_marl.world.scenario import EGO_TASKS, EgoTask, Scenario, UnknownName

TaskSource = Callable[[np.random.Generator], Task]
"""Draws the task of an episode."""

UNKNOWN_SLACK = 0.0
"""Slack of a task whose mission was given, not fitted."""

RANDOM = "random"
"""As a scenario: a random map, mission and starts at every reset."""
ANY = "any"
"""As a mission: one of M1 to M5, drawn at every reset."""


@dataclass(frozen=True)
class FixedTask:
    """The same task at every reset."""

    task: Task

    def __call__(self, rng: np.random.Generator) -> Task:
        return self.task


@dataclass(frozen=True)
class SampledTask:
    """A new task at every reset."""

    mission_ids: tuple[str, ...]
    """One of these."""
    family: str
    scenario: Scenario | None = None
    """The map; None draws one."""
    curriculum: Curriculum | None = None
    difficulty: float = 0.0
    """Where there is a curriculum."""

    def __call__(self, rng: np.random.Generator) -> Task:
        ids = self.mission_ids
        mission_id = ids[0] if len(ids) == 1 else ids[int(rng.integers(len(ids)))]
        if self.curriculum is not None:
            return self.curriculum.sample_task(rng, self.difficulty, mission_id, self.family, self.scenario)
        return sample_task(rng, mission_id, self.family, scenario=self.scenario)


@dataclass(frozen=True)
class Changed:
    """Tasks of another source with changes to their scenarios."""

    source: TaskSource
    ego_task: EgoTask | None
    adversary_sees_ego_metres: float | None

    def __call__(self, rng: np.random.Generator) -> Task:
        task = self.source(rng)
        scenario = task.scenario
        if self.adversary_sees_ego_metres is not None:
            sensors = replace(scenario.sensors, adversary_sees_ego_metres=float(self.adversary_sees_ego_metres))
            scenario = replace(scenario, sensors=sensors)
        if self.ego_task is not None and self.ego_task != scenario.ego_task:
            scenario = scenario.for_task(self.ego_task)
        return replace(task, scenario=scenario)


def task_source(
    task: Task | TaskSource | None,
    mission: str | Mission,
    scenario: str | Scenario,
    family: str = "point",
    *,
    sampled: bool = False,
    difficulty: float | None = None,
    curriculum: Curriculum | None = None,
    ego_task: EgoTask | None = None,
    adversary_sees_ego_metres: float | None = None,
) -> TaskSource:
    """The source that these arguments of an environment mean.

    `task` (a Task, or a function of a Generator that draws one) goes before `mission`, `scenario`, `family`, `sampled` and
    `difficulty`. A mission is a Mission, a text in English, or an id such as "M1": the paper's mission with its times
    fitted to the scenario. The scenario "random" draws map, goals, starts and deadlines of that mission type (or of "any"
    of the five) and family at every reset; `sampled` draws all but the map. `difficulty` in 0..1 draws them by
    `curriculum`. `ego_task` and `adversary_sees_ego_metres` replace the scenario's own.
    """
    source = _source(task, mission, scenario, family, sampled, difficulty, curriculum)
    if ego_task is not None and ego_task not in EGO_TASKS:
        raise UnknownName("ego task", str(ego_task), EGO_TASKS)
    if ego_task is None and adversary_sees_ego_metres is None:
        return source
    changed = Changed(source, ego_task, adversary_sees_ego_metres)
    return FixedTask(changed(np.random.default_rng(0))) if isinstance(source, FixedTask) else changed


def _source(
    task: Task | TaskSource | None,
    mission: str | Mission,
    scenario: str | Scenario,
    family: str,
    sampled: bool,
    difficulty: float | None,
    curriculum: Curriculum | None,
) -> TaskSource:
    if isinstance(task, Task):
        return FixedTask(task)
    if task is not None:
        if not callable(task):
            raise TypeError(f"task is {task!r}, must be a Task, a function of a numpy Generator, or None")
        return task
    drawn_map = isinstance(scenario, str) and scenario == RANDOM
    if not (drawn_map or sampled):
        if difficulty is not None:
            raise ValueError(f"difficulty is {difficulty}: it needs drawn tasks, scenario='random' or sampled=True")
        return FixedTask(fixed_task(mission, scenario))
    if not (isinstance(mission, str) and mission in (*MISSION_IDS, ANY)):
        raise ValueError(
            f"mission is {mission!r}: with scenario 'random' it must be one of {[*MISSION_IDS, ANY]}"
            if drawn_map
            else f"mission is {mission!r}: where it is sampled it must be one of {[*MISSION_IDS, ANY]}"
        )
    if family not in FAMILIES:
        raise UnknownName("scenario family", family, FAMILIES)
    ids = MISSION_IDS if mission == ANY else (mission,)
    world = None if drawn_map else as_scenario(scenario)
    if difficulty is None:
        return SampledTask(ids, family, world)
    return SampledTask(ids, family, world, curriculum or Curriculum(), check_difficulty(difficulty))


def at_difficulty(source: TaskSource, difficulty: object) -> TaskSource:
    """The same source at another difficulty. Raises ValueError if it has none."""
    if isinstance(source, SampledTask) and source.curriculum is not None:
        return replace(source, difficulty=check_difficulty(difficulty))
    if isinstance(source, Changed):
        return replace(source, source=at_difficulty(source.source, difficulty))
    raise ValueError(
        f"difficulty is {difficulty}: this environment has no curriculum; make it with scenario='random' and difficulty=0.0"
    )


def difficulty_of(source: TaskSource) -> float | None:
    """The difficulty at which a source draws; None if it has none."""
    if isinstance(source, Changed):
        return difficulty_of(source.source)
    return source.difficulty if isinstance(source, SampledTask) and source.curriculum is not None else None


def largest_task(source: TaskSource) -> Task:
    """A task whose scenario is as large as any of the source's, for the spaces: of a curriculum, one on its largest map."""
    inner = source.source if isinstance(source, Changed) else source
    if isinstance(inner, SampledTask) and inner.curriculum is not None:
        source = at_difficulty(source, inner.curriculum.hardest_map)
    return source(np.random.default_rng(0))


def as_scenario(scenario: str | Scenario) -> Scenario:
    """A scenario by a preset's name or as it is. Raises UnknownName, TypeError."""
    world = Scenario.preset(scenario) if isinstance(scenario, str) else scenario
    if not isinstance(world, Scenario):
        raise TypeError(f"scenario is {scenario!r}, must be a Scenario, a preset's name or 'random'")
    return world


def fixed_task(mission: str | Mission, scenario: str | Scenario) -> Task:
    """A mission on a scenario, each by name or as it is. Raises InfeasibleMission if it cannot be completed there."""
    world = as_scenario(scenario)
    if isinstance(mission, Mission):
        return _custom(world, mission)
    if not isinstance(mission, str):
        raise TypeError(f"mission is {mission!r}, must be a Mission, an English text, or one of {list(MISSIONS)}")
    if mission in MISSIONS:
        return paper_mission(mission, world)
    return _custom(world, parse_mission(mission, world))


def _custom(scenario: Scenario, mission: Mission) -> Task:
    check_feasible(mission, scenario)
    return Task(scenario, mission, mission.name, "custom", UNKNOWN_SLACK)
