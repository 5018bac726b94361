"""Building the field's problem from a mission and a world: cells, reference, unrolled automaton, start."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tab_marl.field import processes
from tab_marl.field.answers.stages import stages_of
from tab_marl.field.options import FieldOptions
from tab_marl.field.problem import FieldProblem
from tab_marl.field.reference import Reference
from tab_marl.field.sizing import refuse_before_building
from tab_marl.mission.automaton import MissionAutomaton
from tab_marl.mission.compile import compile_mission
from tab_marl.mission.joint import JointAutomaton, compile_joint
from tab_marl.mission.model import Mission
from tab_marl.mission.parse import parse_mission
from tab_marl.mission.unroll import TickAutomaton, unroll
from tab_marl.world.grid import GridMap
from tab_marl.world.scenario import Scenario
from tab_marl.world.volume import Volume
from tab_marl.world.voxels import VoxelMap

Process = Callable[[GridMap | VoxelMap, NDArray[np.float64]], Reference]
"""Builds the references on a map for speeds ``[R]`` in metres per tick, the fastest first."""

CELL_SIZES_METRES = (0.05, 0.1)
"""Tried in this order in a `Scenario` when `FieldOptions.cell_metres` is None."""
CELLS_PER_TICK = (2.0, 1.0)
"""The same in a `Volume`: how many cells full speed covers in a tick."""
HEADED = ("drive_and_turn", "run_and_tumble", "unicycle")
"""References that remember the heading."""
ROUGH_CELL_METRES = 0.15
ROUGH_FROM = 1_500_000
"""Automaton states x base states from which a first fit on rough cells saves time."""


def problem_of(
    mission: Mission | str | Sequence[Mission | str],
    world: Scenario | Volume,
    options: FieldOptions,
    horizon_ticks: int | None = None,
    process: Process | None = None,
) -> FieldProblem:
    """See `FieldProblem.from_mission`."""
    several = [mission] if isinstance(mission, str | Mission) else list(mission)
    missions = [parse_mission(one, world) if isinstance(one, str) else one for one in several]
    horizon = world.horizon_ticks if horizon_ticks is None else horizon_ticks
    compiled: MissionAutomaton | JointAutomaton
    if len(missions) == 1:
        compiled = compile_mission(missions[0], world, world.step_seconds)
    else:
        compiled = compile_joint(missions, world, world.step_seconds)
    headed = options.reference in HEADED and process is None
    for size in _cell_sizes(world, options):
        grid = map_of(world, size)
        automaton = unroll(compiled, horizon, compiled.masks(grid.centres))
        entries = len(automaton.delta) * grid.cells
        if entries * (options.headings + 1 if headed else 1) <= options.state_budget:
            break
    while options.cell_metres is None and headed and options.headings >= 16:
        if entries * (options.headings + 1) <= options.state_budget:
            break
        options = replace(options, headings=options.headings // 2)
    problem = _on_grid(compiled, grid, automaton, world, options, horizon, process)
    worth_it = entries * (options.headings + 1) > ROUGH_FROM and grid.cell_metres < ROUGH_CELL_METRES
    if (
        worth_it and headed and isinstance(world, Scenario)
        and options.goal_marginals and len(compiled.branch_places) > 1
    ):  # fmt: skip
        rough = map_of(world, ROUGH_CELL_METRES)
        automaton = unroll(compiled, horizon, compiled.masks(rough.centres))
        coarse = replace(options, headings=8)
        problem = replace(problem, rough=_on_grid(compiled, rough, automaton, world, coarse, horizon, process))
    return replace(problem, mission=missions[0]) if len(missions) == 1 else problem


def _cell_sizes(world: Scenario | Volume, options: FieldOptions) -> tuple[float, ...]:
    if options.cell_metres is not None:
        return (options.cell_metres,)
    if isinstance(world, Scenario):
        return CELL_SIZES_METRES
    return tuple(world.adversary.max_speed * world.step_seconds / cells for cells in CELLS_PER_TICK)


def _on_grid(
    compiled: MissionAutomaton | JointAutomaton,
    grid: GridMap | VoxelMap,
    automaton: TickAutomaton,
    world: Scenario | Volume,
    options: FieldOptions,
    horizon: int,
    process: Process | None,
) -> FieldProblem:
    headed = process is None and options.reference in HEADED
    refuse_before_building(automaton, grid.cells, options.headings if headed else 1, options)
    motion, which = _motion(grid, world, options, automaton.speed_limit, process)
    staged: dict[str, Any] = {}
    if isinstance(compiled, MissionAutomaton):
        stage, names = stages_of(compiled, automaton)
        staged = {"stage": stage, "stage_names": names}
    return FieldProblem(
        motion,
        automaton.symbols(compiled.masks(grid.centres)),
        automaton,
        start_cells(grid, world),
        horizon,
        options,
        which,
        grid,
        world,
        tuple(compiled.branch_places),
        earliest_tick(compiled, grid, world) if options.timing_prior else 0,
        **staged,
    )


def _motion(
    grid: GridMap | VoxelMap,
    world: Scenario | Volume,
    options: FieldOptions,
    speed_limit: NDArray[np.float64],
    process: Process | None,
) -> tuple[Reference, NDArray[np.int32]]:
    """One reference per speed limit in force somewhere, the fastest first, and which one holds in each state."""
    top = world.adversary.max_speed
    capped = np.minimum(speed_limit, top)
    speeds = np.append(top, np.unique(capped[capped < top])[::-1])
    which = np.searchsorted(-speeds, -capped).astype(np.int32)
    steps = speeds * world.step_seconds
    if process is not None:
        motion = process(grid, steps)
        if motion.states != grid.cells * motion.modes or motion.count != len(steps):
            raise ValueError(
                f"process returned {motion.count} references over {motion.states // motion.modes} cells, must be "
                f"{len(steps)} (one per speed in metres per tick: {steps}) over the map's {grid.cells} cells"
            )
        return motion, which
    # In space a body moves any way it likes: it turns within a tick.
    rate = processes.TYPICAL_TURN if isinstance(world, Volume) else world.adversary.max_turn_rate * world.step_seconds
    if options.reference == "run_and_tumble":
        first_turn = rate if options.begins_at_rest and isinstance(world, Scenario) else None
        return processes.run_and_tumble(grid, steps, options.headings, options.mean_run_metres, first_turn), which
    if options.reference == "drive_and_turn":
        rest = max(1.0, options.rest_seconds / world.step_seconds)
        return processes.drive_and_turn(grid, steps, rate, rest, options.headings, options.mean_run_metres), which
    if options.reference == "unicycle":
        if isinstance(world, Volume):
            raise ValueError(
                "FieldOptions.reference is 'unicycle', which moves in the plane: in a Volume use 'run_and_tumble' or 'walk'"
            )
        turn = world.adversary.max_turn_rate * world.step_seconds
        return processes.unicycle(grid, steps, turn, options.headings), which
    build = processes.walk if options.reference == "walk" else processes.paper_walk
    return build(grid, steps), which


def map_of(world: Scenario | Volume, cell_metres: float) -> GridMap | VoxelMap:
    """The world cut into cells."""
    if isinstance(world, Volume):
        return VoxelMap.from_volume(world, cell_metres)
    return GridMap.from_scenario(world, cell_metres)


def start_cells(grid: GridMap | VoxelMap, world: Scenario | Volume) -> NDArray[np.float64]:
    """``[C]``: uniform over the free cells whose centres lie in the adversary's start region."""
    region = world.adversary_start
    inside = np.asarray(region.contains(grid.centres))
    if not inside.any():
        inside[grid.cells_of([region.centre])] = True
    return np.asarray(inside / inside.sum())


def earliest_tick(
    compiled: MissionAutomaton | JointAutomaton, grid: GridMap | VoxelMap, world: Scenario | Volume
) -> NDArray[np.int64]:
    """``[C]``: the first tick at which the shortest path at full speed from each start cell completes the mission.

    Of several missions the last; 0 in space, where no route is searched.
    """
    from tab_marl.mission.route import solve_route

    earliest = np.zeros(grid.cells, dtype=np.int64)
    if isinstance(grid, VoxelMap):
        return earliest
    inside = np.flatnonzero(start_cells(grid, world))
    for part in compiled.parts if isinstance(compiled, JointAutomaton) else (compiled,):
        route = solve_route(part, grid)
        for cell, mask in zip(inside, part.masks(grid.centres[inside]), strict=True):
            location = part.first(int(mask)).location
            metres = float(route.length[location, cell]) if location >= 0 else 0.0
            if math.isfinite(metres):
                ticks = metres / (world.adversary.max_speed * world.step_seconds)
                earliest[cell] = max(earliest[cell], math.ceil(ticks - 1e-9))
    return earliest
