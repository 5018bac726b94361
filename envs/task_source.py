"""What an environment is asked to play: one fixed task, or a new one drawn at every reset."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from tab_marl.envs.paper_missions import paper_mission
from tab_marl.mission import Mission, parse_mission
from tab_marl.mission.feasibility import check_feasible
from tab_marl.mission.library import MISSIONS
from tab_marl.mission.tasks import FAMILIES, MISSION_IDS, Task, sample_task
from tab_marl.world.scenario import Scenario, UnknownName

TaskSource = Callable[[np.random.Generator], Task]
"""Draws the task of an episode."""

UNKNOWN_SLACK = 0.0
"""Slack of a task whose mission was given, not fitted."""

RANDOM = "random"
"""As a scenario: a random map, mission and starts at every reset."""


def task_source(
    task: Task | TaskSource | None, mission: str | Mission, scenario: str | Scenario, family: str = "point"
) -> TaskSource:
    """The source that these arguments of an environment mean.

    `task` (a Task, or a function of a Generator that draws one) goes before the others. A mission is a Mission, a text
    in English, or an id such as "M1": the paper's mission with its times fitted to the scenario. The scenario "random"
    draws tasks of that mission type and family.
    """
    if isinstance(task, Task):
        fixed = task
        return lambda rng: fixed
    if task is not None:
        if not callable(task):
            raise TypeError(f"task is {task!r}, must be a Task, a function of a numpy Generator, or None")
        return task
    if isinstance(scenario, str) and scenario == RANDOM:
        if not (isinstance(mission, str) and mission in MISSION_IDS):
            raise ValueError(f"mission is {mission!r}: with scenario 'random' it must be one of {list(MISSION_IDS)}")
        if family not in FAMILIES:
            raise UnknownName("scenario family", family, FAMILIES)
        mission_id = mission
        return lambda rng: sample_task(rng, mission_id, family)
    made = fixed_task(mission, scenario)
    return lambda rng: made


def fixed_task(mission: str | Mission, scenario: str | Scenario) -> Task:
    """A mission on a scenario, each by name or as it is. Raises InfeasibleMission if it cannot be completed there."""
    world = Scenario.preset(scenario) if isinstance(scenario, str) else scenario
    if not isinstance(world, Scenario):
        raise TypeError(f"scenario is {scenario!r}, must be a Scenario, a preset's name or 'random'")
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
