"""Tasks of several adversaries and egos on one map: each adversary has a mission and a start of its own."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from tab_marl.mission.tasks import FAR_METRES, START_RADIUS_METRES, Task, sample_task
from tab_marl.world.grid import GridMap
from tab_marl.world.regions import Disc, Region
from tab_marl.world.sampling import PLANNING_CELL_METRES
from tab_marl.world.scenario import STRICT, Scenario

EGO_START_RADIUS_METRES = 0.05
APART_METRES = 0.55
"""Between the centres of two start discs, at least, so that no two robots start in each other."""
TEAMS = 40
"""Draws of another adversary, and of a whole team, before it is given up."""


@dataclass(frozen=True)
class TeamTask:
    """What one episode of a team is about."""

    tasks: tuple[Task, ...]
    """One per adversary. Their scenarios differ in `adversary_start` only."""
    ego_starts: tuple[Region, ...]
    """One per ego: it starts uniformly in the free part."""

    __pydantic_config__: ClassVar = STRICT

    def __post_init__(self) -> None:
        if not self.tasks or not self.ego_starts:
            raise ValueError(
                f"TeamTask has {len(self.tasks)} adversaries and {len(self.ego_starts)} egos, must have one of each or more"
            )
        first = self.tasks[0].scenario
        for i, task in enumerate(self.tasks):
            if replace(task.scenario, adversary_start=first.adversary_start) != first:
                raise ValueError(
                    f"TeamTask.tasks[{i}] is on another scenario than tasks[0]: they may differ in adversary_start only"
                )
        if first.ego_task != "interception":
            raise ValueError(f"TeamTask: the scenario's ego_task is {first.ego_task!r}, teams play interception only")

    @property
    def scenario(self) -> Scenario:
        """The map, with the first adversary's start."""
        return self.tasks[0].scenario


def sample_team_task(
    rng: np.random.Generator,
    mission_ids: Sequence[str],
    egos: int = 2,
    family: str = "point",
    scenario: Scenario | None = None,
) -> TeamTask:
    """Draw a task of one adversary per mission id on a common map (drawn, unless `scenario` is given).

    The k-th ego starts where it can win against the k-th adversary; egos beyond the adversaries start anywhere far from
    them. The horizon is the longest of the adversaries'. Raises ValueError for the family "perimeter" (it changes the map),
    RuntimeError if the map has no room.
    """
    if family == "perimeter":
        raise ValueError(
            "family is 'perimeter', which widens a mission's goal: teams share one map, use 'point' or 'ambiguous'"
        )
    for _ in range(TEAMS):
        team = _attempt(rng, tuple(mission_ids), egos, family, scenario)
        if team is not None:
            return team
    raise RuntimeError(
        f"no room for {egos} egos and {len(mission_ids)} adversaries {APART_METRES} m apart found in {TEAMS} draws: use "
        "fewer robots or a larger map"
    )


def _attempt(
    rng: np.random.Generator, mission_ids: tuple[str, ...], egos: int, family: str, scenario: Scenario | None
) -> TeamTask | None:
    tasks: list[Task] = []
    ego_starts: list[Region] = []
    for i, mission_id in enumerate(mission_ids):
        for _ in range(TEAMS):
            task = sample_task(rng, mission_id, family, scenario=tasks[0].scenario if tasks else scenario)
            starts = [t.scenario.adversary_start for t in tasks]
            new = [task.scenario.adversary_start, *([task.scenario.ego_start] if i < egos else [])]
            if _apart(new, [*starts, *ego_starts]):
                break
        else:
            return None
        tasks.append(task)
        if i < egos:
            ego_starts.append(task.scenario.ego_start)
    while len(ego_starts) < egos:
        others = [t.scenario.adversary_start for t in tasks]
        found = far_start(tasks[0].scenario, others, ego_starts, EGO_START_RADIUS_METRES, rng)
        if found is None:
            return None
        ego_starts.append(found)
    return joined(tasks, ego_starts)


def joined(tasks: Sequence[Task], ego_starts: Sequence[Region]) -> TeamTask:
    """The team of these tasks on one map, with the longest of their horizons and the first ego's start."""
    horizon = max(task.scenario.horizon_seconds for task in tasks)
    same = [replace(t, scenario=replace(t.scenario, horizon_seconds=horizon, ego_start=ego_starts[0])) for t in tasks]
    return TeamTask(tuple(same), tuple(ego_starts))


def far_start(
    scenario: Scenario,
    far_from: Sequence[Region],
    apart_from: Sequence[Region],
    radius_metres: float = START_RADIUS_METRES,
    rng: np.random.Generator | None = None,
) -> Disc | None:
    """A start disc outside the central zone and off the checkpoints, FAR_METRES from some regions and APART_METRES from
    others where the map allows it; the farthest such place, or with `rng` a random one. None if there is no room at all.
    """
    grid = GridMap.from_scenario(scenario, PLANNING_CELL_METRES)
    others = [*far_from, *apart_from]
    near = np.min([_from(region, grid.centres) for region in others], axis=0)
    ok = (near >= APART_METRES) & (scenario.region("central zone").distance(grid.centres) >= radius_metres + 0.105)
    for checkpoint in scenario.checkpoints:
        ok &= checkpoint.region.distance(grid.centres) >= radius_metres
    far = ok & (np.min([_from(region, grid.centres) for region in far_from], axis=0) >= FAR_METRES)
    candidates = np.flatnonzero(far if far.any() else ok)
    if len(candidates) == 0:
        return None
    cell = candidates[int(np.argmax(near[candidates]))] if rng is None else rng.choice(candidates)
    x, y = grid.centres[cell]
    return Disc(round(float(x), 3), round(float(y), 3), radius_metres)


def _from(region: Region, points: NDArray[np.float64]) -> NDArray[np.float64]:
    x, y = region.centre
    return np.asarray(np.hypot(points[:, 0] - x, points[:, 1] - y))


def _apart(new: Sequence[Region], old: Sequence[Region]) -> bool:
    return all(np.hypot(*np.subtract(a.centre, b.centre)) >= APART_METRES for a in new for b in old)
