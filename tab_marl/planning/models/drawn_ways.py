"""Ways under costs that are drawn at random: how drivers with habits, whatever they are, would carry out a mission.

A field's reference process tumbles: it knows no driver who keeps to a way because of a preference that lasts. Here a driver is
a smooth random cost of the ground, a price of each place, the side on which obstacles are passed and a time to set out, none
of which favours a way before it is drawn; it takes the cheapest way that satisfies the mission, in the manner of
perturb-and-MAP (Papandreou and Yuille, "Perturb-and-MAP Random Fields", ICCV 2011). No policy is consulted; how strong habits
are is as in the styles of `tab_marl.envs.styles`.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from tab_marl.mission.automaton import BEFORE_START, COMPLETED
from tab_marl.mission.fences import failing_regions, fences_of_first_leg
from tab_marl.mission.model import Mission
from tab_marl.mission.route import solve_route
from tab_marl.mission.route_kernels import MOVE_CELLS
from tab_marl.planning.models import walk_kernels as kernels
from tab_marl.planning.models.mission_map import MissionMap, Ways
from tab_marl.world.grid import GridMap, free_points
from tab_marl.world.regions import sample_in
from tab_marl.world.scenario import Scenario

STRENGTHS = (1.0, 0.5, 0.25, 0.0)
"""Tried in turn until the mission leaves time for the way; at 0 a driver sets out at once on the shortest one."""


@dataclass(frozen=True)
class WaysOptions:
    """What drivers differ in. Lengths in widths of the arena's shorter side."""

    drivers: int = 150
    starts_each: int = 2
    """Starts drawn for each driver: so many ways have its preferences in common."""
    cost_deviation: float = 1.0
    """Standard deviation of the logarithm of what a metre costs."""
    smooth_widths: float = 1 / 6
    """Distance at which the correlation of that logarithm has fallen to exp(-1/2)."""
    place_widths: float = 2.0
    """The price of a place is uniform up to so much, so that far places are chosen as well, near ones more often."""
    fence_widths: float = 0.5
    """What half the drivers pay to pass an obstacle on the side on which the shortest way does."""
    late_share: float = 0.25
    """Of the ways that set out at a time drawn from all that the mission leaves; the others do at once."""

    def __post_init__(self) -> None:
        for name in ("drivers", "starts_each"):
            if getattr(self, name) < 1:
                raise ValueError(f"WaysOptions.{name} is {getattr(self, name)}, must be >= 1")
        for name in ("cost_deviation", "place_widths", "fence_widths"):
            if not (math.isfinite(getattr(self, name)) and getattr(self, name) >= 0):
                raise ValueError(f"WaysOptions.{name} is {getattr(self, name)}, must be finite and >= 0")
        if not (math.isfinite(self.smooth_widths) and self.smooth_widths > 0):
            raise ValueError(f"WaysOptions.smooth_widths is {self.smooth_widths}, must be finite and > 0")
        if not 0 <= self.late_share <= 1:
            raise ValueError(f"WaysOptions.late_share is {self.late_share}, must be a probability in 0..1")


def draw_ways(
    scenario: Scenario, mission: Mission, rng: np.random.Generator, options: WaysOptions | None = None
) -> tuple[NDArray[np.float64], NDArray[np.int32]]:
    """Ways of ``N = drivers * starts_each`` drivers whom nobody hunts.

    Returns positions ``[N, T + 1, 2]`` in metres at the ticks of `Scenario.step_seconds` (T: the horizon; it stays where its
    mission ended), and the tick at which each completed its mission ``[N]``, or -1 where even the shortest way takes too long.
    Labels are read on the squares of `MissionMap`, so a way may pass a place's edge by a centimetre on the wrong side.
    """
    given, mission_map = options or WaysOptions(), MissionMap.build(scenario, mission)
    smooth = given.smooth_widths * _width_metres(scenario)
    costs = np.exp(given.cost_deviation * smooth_noise(mission_map.grid, given.drivers, smooth, rng))
    count = given.drivers * given.starts_each
    positions = np.empty((count, scenario.horizon_ticks + 1, 2))
    completed = np.full(count, -1, dtype=np.int32)
    for driver, cost in enumerate(costs):
        rows = slice(driver * given.starts_each, (driver + 1) * given.starts_each)
        _drive(mission_map, cost, given, rng, positions[rows], completed[rows])
    return positions, completed


def _width_metres(scenario: Scenario) -> float:
    """What lengths in the options are widths of."""
    return min(scenario.width_metres, scenario.height_metres)


def smooth_noise(grid: GridMap, count: int, metres: float, rng: np.random.Generator) -> NDArray[np.float64]:
    """``[count, S]`` Gaussian fields of mean 0 and variance 1, whose correlation falls like ``exp(-(d / metres)^2 / 2)``.

    The map is taken for a torus, so that the variance is the same everywhere.
    """
    deviation = metres / math.sqrt(2.0) / grid.cell_metres
    white = rng.standard_normal((count, *grid.cell_at.shape))
    smooth = ndimage.gaussian_filter(white, (0, deviation, deviation), mode="wrap")
    variance = 1.0
    for length in grid.cell_at.shape:
        spread = ndimage.gaussian_filter1d(np.eye(1, length)[0], deviation, mode="wrap")
        variance *= float((spread**2).sum())
    return np.asarray(smooth[:, grid.row, grid.column] / math.sqrt(variance))


def _drive(
    mission_map: MissionMap,
    cost: NDArray[np.float64],
    options: WaysOptions,
    rng: np.random.Generator,
    positions: NDArray[np.float64],
    completed: NDArray[np.int32],
) -> None:
    """Fill the ways ``[n, T + 1, 2]`` of one driver, to whom cells cost ``[S]``, and when they complete the mission ``[n]``."""
    scenario, step, robot = mission_map.scenario, mission_map.scenario.step_seconds, mission_map.scenario.adversary
    width = _width_metres(scenario)
    prices = {place: rng.uniform(0.0, options.place_widths * width) for place in mission_map.automaton.branch_places}
    fence = options.fence_widths * width if rng.random() < 0.5 else 0.0
    starts, grid = sample_in(scenario.adversary_start, rng, len(positions)), mission_map.grid
    clear = free_points(scenario, starts, 0.0)
    starts = np.where(clear[:, None], starts, grid.centres[grid.cells_of(starts)])
    turning = rng.uniform(0.0, math.pi, len(positions)) / robot.max_turn_rate
    late, share = rng.random(len(positions)) < options.late_share, rng.random(len(positions))
    begun = [_begun(mission_map, start) for start in starts]
    missing = []
    for i, (start, location, _) in enumerate(begun):
        if location >= 0:
            missing.append(i)
        else:  # over at the start already
            positions[i] = start
            completed[i] = 0 if location == COMPLETED else -1
    if not missing:
        return
    for strength, ways in _weaker_and_weaker(mission_map, cost, prices, fence):
        for i in missing:
            delay = round(turning[i] / step) if strength else 0
            if late[i] and strength:
                delay = max(delay, int(share[i] * _spare_ticks(mission_map, ways, begun[i])))
            completed[i] = _follow(mission_map, ways, begun[i], delay, positions[i])
        missing = [i for i in missing if completed[i] < 0]
        if not missing:
            return


def _weaker_and_weaker(
    mission_map: MissionMap, cost: NDArray[np.float64], prices: dict[str, float], fence: float
) -> Iterator[tuple[float, Ways]]:
    """The cheapest ways to completion at each of STRENGTHS."""
    automaton, grid = mission_map.automaton, mission_map.grid
    crossed = _fences(mission_map, prices) if fence else np.zeros((grid.cells, 16), dtype=np.int64)
    for strength in STRENGTHS:
        edges = np.repeat((cost**strength)[:, None], 16, axis=1)
        edges += strength * fence * crossed / (grid.cell_metres * MOVE_CELLS)
        priced = {place: strength * metres for place, metres in prices.items()}
        route = solve_route(automaton, grid, edges, place_metres=priced)
        yield (
            strength,
            Ways(route.nearest, grid.cell_metres, grid.centres, route.next_cell, route.to_visit, route.length),
        )


def _fences(mission_map: MissionMap, prices: dict[str, float]) -> NDArray[np.int64]:
    """``[S, 16]``: fences across the first leg of the shortest way to the places chosen, from the middle of the start region."""
    automaton, scenario, grid = mission_map.automaton, mission_map.scenario, mission_map.grid
    start, home, _ = _begun(mission_map, np.asarray(scenario.adversary_start.centre))
    if home < 0:
        return np.zeros((grid.cells, 16), dtype=np.int64)
    chosen = solve_route(automaton, grid, place_metres=prices)
    return fences_of_first_leg(chosen, home, start, [*scenario.obstacles, *failing_regions(automaton)])


Begun = tuple[NDArray[np.float64], int, NDArray[np.int32]]
"""A start ``[2]``, and the mission's location and clocks ``[3]`` at tick 0 there."""


def _begun(mission_map: MissionMap, start: NDArray[np.float64]) -> Begun:
    automaton, clocks = mission_map.automaton, np.array(BEFORE_START, dtype=np.int32)
    mask = int(automaton.masks(start)[0])
    return start, int(kernels.read_label(automaton.initial, clocks, mask, mission_map.rules)), clocks


def _spare_ticks(mission_map: MissionMap, ways: Ways, begun: Begun) -> int:
    m, ((x, y), location, clocks) = mission_map, begun
    return int(kernels.spare_ticks(x, y, location, clocks, m.rules, ways, m.mission_latest, m.reach_metres))


def _follow(mission_map: MissionMap, ways: Ways, begun: Begun, delay: int, positions: NDArray[np.float64]) -> int:
    """Fill the way ``[T + 1, 2]`` of a driver who sets out after `delay` ticks; the tick of completion or -1."""
    m, ((x, y), location, clocks) = mission_map, begun
    locations = np.empty(len(positions), dtype=np.int32)
    states = np.empty((len(positions), 3), dtype=np.int32)
    done = kernels.follow_way(
        x, y, location, clocks, delay, 1.0, m.reach_metres, m.rules, ways, m.ground, positions, locations, states
    )
    return int(done)
