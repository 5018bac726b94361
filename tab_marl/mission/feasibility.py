"""Whether a mission can be done at all, and if not, why not, with the numbers.

Works with lower bounds: earliest arrivals through the mission's locations, every clock bounded by itself, paths measured
generously. What it calls impossible is impossible; a mission that passes may still be too tight for a real robot.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tab_marl.mission.automaton import (
    ALWAYS_FORBIDDEN,
    COMPLETED,
    MISSION_CLOCK,
    STAGE_CLOCK,
    UNBOUNDED,
    VISIT_CLOCK,
    MissionAutomaton,
)
from tab_marl.mission.compile import compile_mission
from tab_marl.mission.feasibility_kernels import arrivals
from tab_marl.mission.impossible import InfeasibleMission, Obstacle, words_for
from tab_marl.mission.model import Mission
from tab_marl.world.grid import GridMap
from tab_marl.world.regions import Box, Disc, Polygon, Region
from tab_marl.world.scenario import Scenario

# Paths along the 16 grid directions are longer than straight ones by at most 1 / cos(13.3 degrees) = 1.0275.
GRID_STRETCH = 1.0275
# A leg's ends are cell centres; the robot may begin nearer, and enters a region at its edge.
LEG_CELLS = 1.5
CLOCKS = (MISSION_CLOCK, STAGE_CLOCK, VISIT_CLOCK)
FEASIBILITY_CELL_METRES = 0.05

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]


def check_feasible(
    mission: Mission,
    scenario: Scenario,
    start: ArrayLike | Region | None = None,
    cell_metres: float = FEASIBILITY_CELL_METRES,
) -> float:
    """Seconds that the mission takes at least, from the best of the starts.

    `start`: a point ``[2]``, points ``[N, 2]`` in metres, or a region (default: the scenario's `adversary_start`).
    Raises InfeasibleMission if no start allows it.
    """
    automaton = compile_mission(mission, scenario)
    grid = GridMap.from_scenario(scenario, cell_metres)
    return _Search(mission, scenario, automaton, grid).earliest_completion(_start_cells(scenario, grid, start))


def _start_cells(scenario: Scenario, grid: GridMap, start: ArrayLike | Region | None) -> NDArray[np.int32]:
    where = scenario.adversary_start if start is None else start
    if isinstance(where, (Disc, Box, Polygon)):
        inside = np.flatnonzero(grid.inside(where)).astype(np.int32)
        return inside if len(inside) else grid.cells_of(where.centre)
    return np.unique(grid.cells_of(where))


@dataclass(frozen=True, eq=False)
class _Edge:
    """The way from one location to a later one."""

    source: int
    following: int
    targets: Bools
    """``[S]`` cells whose label leads there."""
    counted: bool
    """Whether it is a counted visit (else it is the leaving of a place)."""


class _Search:
    """Earliest arrivals, location by location (they are numbered forwards)."""

    def __init__(self, mission: Mission, scenario: Scenario, automaton: MissionAutomaton, grid: GridMap) -> None:
        self.mission, self.scenario, self.automaton, self.grid = mission, scenario, automaton, grid
        self.mask = automaton.masks(grid.centres)
        self.tick = automaton.tick_seconds
        seconds = np.asarray(
            np.where(automaton.latest < UNBOUNDED, automaton.latest * self.tick, np.inf), dtype=np.float64
        )
        seconds[:, MISSION_CLOCK] = np.minimum(seconds[:, MISSION_CLOCK], scenario.horizon_seconds)
        self.latest = seconds
        self.earliest: Floats = np.asarray(automaton.earliest * self.tick, dtype=np.float64)
        # [U, 3, S]: least value of each clock, in seconds, when a location is entered at a cell; inf: cannot be.
        self.entry = np.full((automaton.locations, 3, grid.cells), np.inf)
        self.completed = np.inf
        self.obstacles: list[Obstacle] = []
        self._cache: dict[tuple[bytes, bytes], Floats] = {}

    def earliest_completion(self, start: NDArray[np.int32]) -> float:
        """Seconds on the mission clock. Raises InfeasibleMission."""
        self._read_start(start)
        for u in range(self.automaton.locations):
            if np.isfinite(self.entry[u]).any():
                for edge in self._edges(u):
                    self._follow(edge)
        if not np.isfinite(self.completed):
            raise InfeasibleMission(words_for(self.mission, self.scenario, self.automaton, self.grid, self.obstacles))
        return float(self.completed)

    def _read_start(self, start: NDArray[np.int32]) -> None:
        """Tick 0: its label may fail, make progress, or neither."""
        automaton, u = self.automaton, self.automaton.initial
        for s in start:
            mask = self.mask[s]
            early = bool(automaton.progress[u, mask]) and bool((self.earliest[u] > 0).any())
            if automaton.forbidden_until[u, mask] > 0:
                self.obstacles.append(Obstacle(u, "start forbidden", cells=np.array([s])))
            elif early and not automaton.patient[u]:
                opens = float(self.earliest[u].max())
                self.obstacles.append(Obstacle(u, "start early", cells=np.array([s]), allows=opens))
            else:
                v = u if early else int(automaton.next_location[u, mask])
                if v == COMPLETED:
                    self.completed = 0.0
                else:
                    self.entry[v, :, s] = 0.0

    def _edges(self, u: int) -> list[_Edge]:
        following = self.automaton.next_location[u, self.mask]
        possible = self.automaton.forbidden_until[u, self.mask] < ALWAYS_FORBIDDEN
        row, progress = self.automaton.next_location[u], self.automaton.progress[u]
        later = [int(v) for v in np.unique(row) if v == COMPLETED or v > u]
        return [_Edge(u, v, (following == v) & possible, bool(progress[row == v].any())) for v in later]

    def _passable(self, u: int) -> Bools:
        """``[S]``: cells where one can be without leaving the location (some time, if forbidden for a while only)."""
        automaton = self.automaton
        stays = automaton.next_location[u, self.mask] == u
        if automaton.patient[u]:
            stays |= automaton.progress[u, self.mask]
        return np.asarray(stays & (automaton.forbidden_until[u, self.mask] < ALWAYS_FORBIDDEN))

    def _speed(self, u: int) -> float:
        return min(self.scenario.adversary.max_speed, float(self.automaton.speed_limit[u]))

    def _seconds(self, u: int, offset: Floats, passable: Bools) -> Floats:
        """``[S]`` earliest arrival in seconds, given head starts ``[S]`` in seconds."""
        if not np.isfinite(offset).any():
            return offset
        key = (offset.tobytes(), passable.tobytes() + np.float64(self._speed(u)).tobytes())
        if key not in self._cache:
            grid = self.grid
            per_cell = grid.cell_metres / GRID_STRETCH / self._speed(u)
            found = arrivals(grid.cell_at, grid.row, grid.column, offset / per_cell, passable) * per_cell
            allowance = LEG_CELLS * grid.cell_metres / self._speed(u)
            self._cache[key] = np.maximum(found - allowance, np.minimum(offset.min(), found))
        return self._cache[key]

    def _follow(self, edge: _Edge) -> None:
        u, automaton = edge.source, self.automaton
        latest, earliest, entry = self.latest[u], self.earliest[u], self.entry[u]
        if not edge.targets.any():
            # The next visit cannot fall on the tick of leaving the place before: no reason, just geometry.
            leaving = ((automaton.next_location[u] != u) & ~automaton.progress[u]).any()
            if not (leaving and edge.counted):
                self.obstacles.append(Obstacle(u, "no target", edge.following))
            return
        if (earliest > latest).any():
            clock = int(np.argmax(earliest > latest))
            self.obstacles.append(
                Obstacle(u, "contradictory", edge.following, clock, float(earliest[clock]), float(latest[clock]))
            )
            return
        passable = self._passable(u)
        to_go = self._seconds(u, np.where(edge.targets, 0.0, np.inf), passable)
        if not np.isfinite(entry[MISSION_CLOCK] + to_go).any():
            cells = np.flatnonzero(np.isfinite(entry[MISSION_CLOCK]))
            anyhow = self._seconds(u, np.where(edge.targets, 0.0, np.inf), np.ones_like(passable))
            kind = "forbidden way" if np.isfinite(anyhow[cells]).any() else "walled off"
            self.obstacles.append(Obstacle(u, kind, edge.following, cells=cells))
            return
        in_time = np.isfinite(to_go)
        for clock in CLOCKS:
            needs = np.where(in_time, entry[clock] + to_go, np.inf)
            in_time &= needs <= latest[clock] + 1e-9
            if not in_time.any():
                self.obstacles.append(
                    Obstacle(u, "too far", edge.following, clock, float(needs.min()), float(latest[clock]))
                )
                return
        self._arrive(edge, in_time, passable)

    def _arrive(self, edge: _Edge, in_time: Bools, passable: Bools) -> None:
        """Enter the following location from the source cells that are in time."""
        u, automaton = edge.source, self.automaton
        latest, earliest, entry = self.latest[u], self.earliest[u], self.entry[u]
        counted = automaton.progress[u, self.mask]
        reached = np.empty_like(entry)
        waits = 0.0
        for clock in CLOCKS:
            reached[clock] = self._seconds(u, np.where(in_time, entry[clock], np.inf), passable)
            reached[clock] = np.where(counted, np.maximum(reached[clock], earliest[clock]), reached[clock])
            if clock != MISSION_CLOCK:
                waits = max(waits, float(entry[MISSION_CLOCK][in_time].min()) + float(earliest[clock]))
        reached[MISSION_CLOCK] = np.where(counted, np.maximum(reached[MISSION_CLOCK], waits), reached[MISSION_CLOCK])
        opens = automaton.forbidden_until[u, self.mask] * self.tick
        reached[MISSION_CLOCK] = np.where(edge.targets, np.maximum(reached[MISSION_CLOCK], opens), np.inf)
        in_bounds = edge.targets & (reached <= latest[:, None] + 1e-9).all(axis=0)
        if not in_bounds.any():
            excess = reached - np.where(np.isfinite(latest), latest, 0.0)[:, None]
            excess[~np.isfinite(latest)] = -np.inf
            cell = int(np.argmin(np.where(edge.targets, excess.max(axis=0), np.inf)))
            clock = int(np.argmax(excess[:, cell]))
            kind = "opens late" if opens[cell] >= reached[clock, cell] - 1e-9 else "too far"
            self.obstacles.append(
                Obstacle(u, kind, edge.following, clock, float(reached[clock, cell]), float(latest[clock]))
            )
            return
        if edge.following == COMPLETED:
            self.completed = min(self.completed, float(reached[MISSION_CLOCK][in_bounds].min()))
            return
        resets = automaton.resets[u, self.mask].T
        entering = np.where(in_bounds, np.where(resets, 0.0, reached), np.inf)
        self.entry[edge.following] = np.minimum(self.entry[edge.following], entering)
