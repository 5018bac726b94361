"""The stages of a mission: the counted visits of its goals, one after another."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from tab_marl.mission.automaton import MissionAutomaton
    from tab_marl.mission.model import Mission
    from tab_marl.mission.unroll import TickAutomaton
    from tab_marl.world.grid import GridMap
    from tab_marl.world.scenario import Scenario
    from tab_marl.world.volume import Volume
    from tab_marl.world.voxels import VoxelMap


def stages_of(compiled: MissionAutomaton, automaton: TickAutomaton) -> tuple[NDArray[np.int32], tuple[str, ...]]:
    """(``[Q]`` stages completed, their names): a stage is one counted visit of one goal; -1 in the rejecting state."""
    counted = np.stack([compiled.goals_done, compiled.visits], axis=1)
    known = np.unique(counted, axis=0)
    at = np.array([int(np.flatnonzero((known == row).all(axis=1))[0]) for row in counted], dtype=np.int32)
    stage = np.where(automaton.location >= 0, at[np.maximum(automaton.location, 0)], len(known)).astype(np.int32)
    stage[automaton.rejecting] = -1
    several = {int(goal) for goal, visit in known if visit}
    names = [f"goal {goal + 1}" + (f", visit {visit + 1}" if goal in several else "") for goal, visit in known]
    return stage, tuple(names) if len(names) > 1 else ("mission",)


def earliest_of_stage(
    mission: Mission, scenario: Scenario | Volume, grid: GridMap | VoxelMap, stage: int
) -> NDArray[np.int64]:
    """Of the mission cut off after the last goal that this stage completes."""
    from tab_marl.field.from_mission import earliest_tick
    from tab_marl.mission.compile import compile_mission

    compiled = compile_mission(mission, scenario, scenario.step_seconds)
    known = np.unique(np.stack([compiled.goals_done, compiled.visits], axis=1), axis=0)
    goal = int(known[stage, 0])
    ends_goal = stage + 1 == len(known) or known[stage + 1, 0] != goal
    goals = [c for c in mission.constraints if c.type.is_goal][: goal + int(ends_goal)]
    beside = [c for c in mission.constraints if not c.type.is_goal and c.until_goal is None]
    if not goals:
        return np.zeros(grid.cells, dtype=np.int64)
    cut = replace(mission, constraints=(*beside, *goals))
    return earliest_tick(compile_mission(cut, scenario, scenario.step_seconds), grid, scenario)
