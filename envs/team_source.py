"""What a team environment is asked to play: the same arguments as `task_source`'s, for several robots."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from tab_marl.envs.task_source import ANY, RANDOM, as_scenario, fixed_task
from tab_marl.mission import Mission
from tab_marl.mission.tasks import FAMILIES, MISSION_IDS, START_RADIUS_METRES, Task
from tab_marl.mission.teams import EGO_START_RADIUS_METRES, TeamTask, far_start, joined, sample_team_task
from tab_marl.world.regions import Region
from tab_marl.world.scenario import Scenario, UnknownName

TeamSource = Callable[[np.random.Generator], TeamTask]
"""Draws the task of an episode."""


@dataclass(frozen=True)
class FixedTeam:
    """The same task at every reset."""

    team: TeamTask

    def __call__(self, rng: np.random.Generator) -> TeamTask:
        return self.team


@dataclass(frozen=True)
class SampledTeam:
    """A new task at every reset."""

    mission_ids: tuple[str, ...]
    """One per adversary; "any" draws one of M1 to M5."""
    egos: int
    family: str
    scenario: Scenario | None
    """The map; None draws one."""
    adversary_sees_ego_metres: float | None

    def __call__(self, rng: np.random.Generator) -> TeamTask:
        ids = [MISSION_IDS[int(rng.integers(len(MISSION_IDS)))] if m == ANY else m for m in self.mission_ids]
        team = sample_team_task(rng, ids, self.egos, self.family, self.scenario)
        return aware(team, self.adversary_sees_ego_metres)


def team_source(
    task: TeamTask | TeamSource | None,
    mission: str | Mission | Sequence[str | Mission],
    scenario: str | Scenario,
    family: str,
    egos: int,
    adversaries: int,
    *,
    sampled: bool = False,
    adversary_sees_ego_metres: float | None = None,
) -> TeamSource:
    """The source that these arguments mean. `mission`: one for all adversaries, or a sequence with one for each."""
    if isinstance(task, TeamTask):
        return FixedTeam(aware(task, adversary_sees_ego_metres))
    if task is not None:
        if not callable(task):
            raise TypeError(f"task is {task!r}, must be a TeamTask, a function of a numpy Generator, or None")
        return task
    missions = (mission,) * adversaries if isinstance(mission, str | Mission) else tuple(mission)
    if len(missions) != adversaries:
        raise ValueError(f"mission has {len(missions)} entries, must be one for each of the {adversaries} adversaries")
    drawn_map = isinstance(scenario, str) and scenario == RANDOM
    if drawn_map or sampled:
        ids = [m for m in missions if isinstance(m, str) and m in (*MISSION_IDS, ANY)]
        if len(ids) != len(missions):
            raise ValueError(f"mission is {mission!r}: where it is sampled each must be one of {[*MISSION_IDS, ANY]}")
        if family not in FAMILIES:
            raise UnknownName("scenario family", family, FAMILIES)
        return SampledTeam(
            tuple(ids), egos, family, None if drawn_map else as_scenario(scenario), adversary_sees_ego_metres
        )
    return FixedTeam(aware(fixed_team(missions, as_scenario(scenario), egos), adversary_sees_ego_metres))


def fixed_team(missions: Sequence[str | Mission], scenario: Scenario, egos: int) -> TeamTask:
    """Missions on one scenario. The first robot of each side has the scenario's start, every further one the place farthest
    from all others; the times of the paper's missions fit each adversary's own start. Raises ValueError without room.
    """
    adversary_starts: list[Region] = [scenario.adversary_start]
    ego_starts: list[Region] = [scenario.ego_start]
    for _ in missions[1:]:
        adversary_starts.append(_further(scenario, ego_starts, adversary_starts, START_RADIUS_METRES))
    while len(ego_starts) < egos:
        ego_starts.append(_further(scenario, adversary_starts, ego_starts, EGO_START_RADIUS_METRES))
    tasks: list[Task] = []
    for mission, start in zip(missions, adversary_starts, strict=True):
        tasks.append(fixed_task(mission, replace(scenario, adversary_start=start)))
    return joined(tasks, ego_starts)


def aware(team: TeamTask, metres: float | None) -> TeamTask:
    """The team with adversaries that notice egos within this range; None leaves them as they are."""
    if metres is None:
        return team
    sensors = replace(team.scenario.sensors, adversary_sees_ego_metres=float(metres))
    tasks = tuple(replace(task, scenario=replace(task.scenario, sensors=sensors)) for task in team.tasks)
    return replace(team, tasks=tasks)


def _further(
    scenario: Scenario, far_from: Sequence[Region], apart_from: Sequence[Region], radius_metres: float
) -> Region:
    start = far_start(scenario, far_from, apart_from, radius_metres)
    if start is None:
        count = len(far_from) + len(apart_from)
        raise ValueError(f"scenario {scenario.name!r} has no room for a robot beside the {count} others: use fewer")
    return start
