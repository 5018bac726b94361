"""What the adversary observes, and the task that this refers to.

The same compiled function serves the physics environment and the batched training world. Layout (version 1), float32:

=====  ==================  =====================================================================================
row    name                meaning
=====  ==================  =====================================================================================
0-1    route               unit vector (forward, left) along the route, body frame
2      near                straight metres to the point headed for / 1.2, at most 1
3      to visit            plain metres to the next counted visit along the route / 2, at most 2
4      to completion       plain metres to completion along the route / 4, at most 2
5-6    slack               seconds left for the next visit minus metres / top speed: / 10 in -0.5..2; tanh
7-8    total slack         the same for what comes after it, up to the end of the mission
9      timed               1 if there is a time at which to arrive (exact window, or a drawn arrival fraction)
10-11  excess              seconds until that time minus metres / top speed: / 10 in -0.5..2; tanh
12     exact               1 if that time is a window of the mission
13-14  v, w                own speed / top speed, own turn rate / top turn rate
15     speed limit         the mission's, / top speed, at most 1
16     via                 1 while a via point is ahead
17     styled              1 while the styled route is followed, 0 once it was dropped for lack of time
18-20  zone                unit vector (forward, left) to the centre of the nearest region that fails the mission,
                           metres to its boundary (1: none within a metre)
21-32  rays                free metres in 12 directions anticlockwise from the heading, at most 1
33-36  latents             side (-1..1), camera-shyness, cost noise, arrival fraction
37-39  ego                 1 while the ego is seen, its position (forward, left) in metres within -2..2
=====  ==================  =====================================================================================
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numba
import numpy as np
from numpy.typing import NDArray

from tab_marl.envs import adversary_kernels as kernels
from tab_marl.envs.adversary_tables import LATENT_MAX, Parts, Tables, later_windows, pack
from tab_marl.envs.reward import Gained
from tab_marl.envs.styles import SLACK_NEEDED, STRENGTHS, Latents, Style, clearance_cost, styled_cost
from tab_marl.mission.automaton import COMPLETED, FAILED, UNBOUNDED, MissionAutomaton
from tab_marl.mission.compile import compile_mission
from tab_marl.mission.fences import failing_regions, fences_of_first_leg
from tab_marl.mission.model import Mission
from tab_marl.mission.route import RouteField, solve_route
from tab_marl.world.grid import GridMap
from tab_marl.world.regions import Region
from tab_marl.world.scenario import Scenario

LAYOUT_VERSION = 1
OBSERVED = kernels.OBSERVED
"""Length of the observation."""

ROUTE_CELL_METRES = 0.1
TURN_SECONDS = 1.0
"""Allowed per visit for turning when judging whether a styled route fits."""
TIME_SHARE = 0.9
"""A styled route may need this share of the time that is allowed."""
VIA_CLEAR_METRES = 0.2
"""Between a via point and a zone that fails the mission."""
VIA_DETOUR_METRES = (0.4, 3.0)
"""How much longer a way over a via point is."""


def leaves_choice(mission: Mission) -> bool:
    """Whether the mission's last goal is any of several places."""
    return bool(mission.goals) and len(mission.goals[-1].places) > 1


@dataclass(frozen=True, eq=False)
class AdversaryTask:
    """One adversary's task: its mission's tables, its route fields and what was drawn of its style."""

    scenario: Scenario
    mission: Mission
    style: Style
    parts: Parts = field(repr=False)

    @cached_property
    def tables(self) -> Tables:
        """A bank that holds this task alone."""
        return pack([self.parts])

    @property
    def automaton(self) -> MissionAutomaton:
        return self.parts.automaton

    @property
    def latents(self) -> Latents:
        return self.parts.latents

    @property
    def strength(self) -> float:
        """1, 0.5 or 0.25 of the style's route latents are applied; 0: the mission left no time for them."""
        return self.parts.strength

    @classmethod
    def build(
        cls,
        scenario: Scenario,
        mission: Mission,
        style: Style,
        rng: np.random.Generator,
        cell_metres: float = ROUTE_CELL_METRES,
    ) -> AdversaryTask:
        """Draw the style's latents and solve the route fields (about 10 ms; M5 30 ms)."""
        return cls.draw(scenario, mission, style, rng, 1, cell_metres)[0]

    @classmethod
    def draw(
        cls,
        scenario: Scenario,
        mission: Mission,
        style: Style,
        rng: np.random.Generator,
        count: int,
        cell_metres: float = ROUTE_CELL_METRES,
    ) -> list[AdversaryTask]:
        """`count` tasks that differ in their latents; what they share is computed once."""
        automaton = compile_mission(mission, scenario, 1.0 / scenario.control_hertz)
        plain = _Plain.of(scenario, automaton, GridMap.from_scenario(scenario, cell_metres))
        parts = [_styled(plain, style.draw(rng, leaves_choice(mission))) for _ in range(count)]
        return [cls(scenario, mission, style, part) for part in parts]


@dataclass(frozen=True, eq=False)
class _Plain:
    """What all styles share: the route without style, where it begins, and the time it leaves."""

    scenario: Scenario
    automaton: MissionAutomaton
    failing: tuple[Region, ...]
    """Regions that fail the mission."""
    zone_distance: NDArray[np.float64]
    """``[S]`` metres to the nearest of them, inf if there is none."""
    clearance: NDArray[np.float64]
    route: RouteField
    home: int
    """The mission's location after tick 0 at the middle of the start region."""
    windows: NDArray[np.int32]

    @classmethod
    def of(cls, scenario: Scenario, automaton: MissionAutomaton, grid: GridMap) -> _Plain:
        failing = failing_regions(automaton)
        zone_distance = np.full(grid.cells, np.inf)
        for region in failing:
            zone_distance = np.minimum(zone_distance, region.distance(grid.centres))
        clearance = clearance_cost(grid, zone_distance)
        windows = later_windows(automaton, round(scenario.horizon_seconds / automaton.tick_seconds))
        home = automaton.first(int(automaton.masks(scenario.adversary_start.centre)[0])).location
        return cls(
            scenario,
            automaton,
            failing,
            zone_distance,
            clearance,
            solve_route(automaton, grid, clearance),
            home,
            windows,
        )

    def parts(self, latents: Latents, strength: float) -> Parts:
        """The task on the plain route."""
        nowhere = np.zeros((0, 2))
        return Parts(
            self.scenario, self.automaton, self.route, self.route, nowhere, self.home, latents, strength, self.windows
        )  # fmt: skip


def _styled(plain: _Plain, latents: Latents) -> Parts:
    scenario, grid, home = plain.scenario, plain.route.grid, plain.home
    if home < 0 or not _fits(plain.route, home, plain, 1.0 / SLACK_NEEDED):
        # No time to spare: straight, and as early as possible.
        return plain.parts(Latents(seed=latents.seed), 0.0)
    if not latents.bends_route:
        return plain.parts(latents, 1.0)
    rng = np.random.default_rng(latents.seed + 1)
    dear = {name: float(rng.uniform(0, latents.order_metres)) for name in plain.automaton.branch_places}
    for strength in STRENGTHS:
        via = _via_points(rng, plain, latents.via_points, strength)
        places = {name: strength * metres for name, metres in dear.items()}
        crossed = _crossed(plain, places) if latents.contrary_metres else None
        route = solve_route(
            plain.automaton,
            grid,
            styled_cost(scenario, grid, plain.clearance, latents, strength, crossed),
            place_metres=places,
            via=via,
            via_location=home,
        )
        if _fits(route, route.via_locations[0] if via else home, plain, TIME_SHARE):
            points = np.asarray(via, dtype=np.float64).reshape(-1, 2)
            return Parts(
                scenario, plain.automaton, plain.route, route, points, home, latents, strength, plain.windows
            )  # fmt: skip
    return plain.parts(latents, 0.0)


def _crossed(plain: _Plain, place_metres: dict[str, float]) -> NDArray[np.int64]:
    """``[S, 16]``: fences across the first leg of the shortest way to the places chosen if they cost so much more."""
    chosen = solve_route(plain.automaton, plain.route.grid, plain.clearance, place_metres=place_metres)
    regions = [*plain.scenario.obstacles, *plain.failing]
    return fences_of_first_leg(chosen, plain.home, plain.scenario.adversary_start.centre, regions)


def _via_points(
    rng: np.random.Generator, plain: _Plain, count: int, strength: float
) -> tuple[tuple[float, float], ...]:
    """Free points off all places and zones, one after the other a detour of some length; fewer if none is found."""
    grid, to_go = plain.route.grid, plain.route.length[plain.home]
    free = (plain.automaton.masks(grid.centres) == 0) & (plain.zone_distance > VIA_CLEAR_METRES)
    chosen: list[tuple[float, float]] = []
    here = np.asarray(plain.scenario.adversary_start.centre, dtype=np.float64)
    low, high = VIA_DETOUR_METRES
    for _ in range(count):
        detour = np.hypot(*(grid.centres - here).T) + to_go - to_go[grid.cells_of(here)[0]]
        candidates = np.flatnonzero(free & (detour >= low) & (detour <= max(low + 0.2, high * strength)))
        if len(candidates) == 0:
            break
        here = grid.centres[rng.choice(candidates)]
        chosen.append((float(here[0]), float(here[1])))
    return tuple(chosen)


def _fits(route: RouteField, first: int, plain: _Plain, share: float) -> bool:
    """Whether following the route from the start needs at most this share of each time allowed on the way.

    `first` is the route's location at the start (it differs from the mission's while a via point is ahead).
    """
    automaton, tick, robot = route.automaton, route.automaton.tick_seconds, plain.scenario.adversary
    cells, locations = route.path(first, plain.scenario.adversary_start.centre)
    if len(cells) < 2 or locations[-1] != COMPLETED:
        return False
    points = route.grid.centres[cells]
    at = np.where(locations[:-1] >= automaton.locations, plain.home, locations[:-1])
    seconds = np.hypot(*np.diff(points, axis=0).T) / np.minimum(robot.max_speed, automaton.speed_limit[at])
    counted = automaton.progress[at, automaton.masks(points[1:])] & (locations[1:] != locations[:-1])
    counted &= locations[:-1] < automaton.locations
    since_start = since_visit = 0.0
    for u, step, visit in zip(at, seconds, counted, strict=True):
        since_start += step
        since_visit += step
        if not visit:
            continue
        since_start += TURN_SECONDS
        since_visit += TURN_SECONDS
        latest = np.where(automaton.latest[u] >= UNBOUNDED, np.inf, automaton.latest[u] * tick)
        if since_start > share * min(latest[0], plain.windows[u, 1] * tick) or since_visit > share * min(latest[1:]):
            return False
        since_visit = 0.0
    return True


class AdversaryObserver:
    """The observations of one robot on one task; remembers which via points it has passed and whether it dropped its
    style for lack of time."""

    def __init__(self, task: AdversaryTask) -> None:
        self.task = task
        self._memory = np.zeros(2, dtype=np.int32)
        self._clocks = np.zeros(3, dtype=np.int32)
        self._out = np.zeros(OBSERVED, dtype=np.float32)
        self._last = (FAILED, 0.0, 0.0)
        self.gained = Gained()
        """Between the last two observations."""
        self._look_up()

    def __getstate__(self) -> dict[str, Any]:
        return {name: value for name, value in self.__dict__.items() if name != "_kernel"}

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Compiled code does not travel."""
        self.__dict__.update(state)
        self._look_up()

    def _look_up(self) -> None:
        """The compiled version for these tables: numba's dispatcher would find it anew at every call, from 33 arrays."""
        self._kernel: Any = kernels.observe
        arguments = (
            self.task.tables, 0, 0.0, 0.0, 0.0, 0.0, 0.0, -1, self._clocks, self._memory, False, 0.0, 0.0, self._out,
        )  # fmt: skip
        if hasattr(kernels.observe, "get_overload"):  # not where numba is switched off
            kernels.observe(*arguments)
            self._kernel = kernels.observe.get_overload(tuple(numba.typeof(argument) for argument in arguments))

    def reset(self) -> None:
        """Begin a new episode on the same task."""
        self._memory[:] = 0
        self._last, self.gained = (FAILED, 0.0, 0.0), Gained()

    @property
    def via_passed(self) -> int:
        return int(self._memory[0])

    @property
    def style_dropped(self) -> bool:
        return bool(self._memory[1])

    def observe(
        self,
        x: float,
        y: float,
        theta: float,
        v: float,
        w: float,
        location: int,
        clocks: tuple[int, int, int],
        ego: tuple[float, float] | None = None,
    ) -> NDArray[np.float32]:
        """The observation ``[OBSERVED]`` (a new array): pose in metres and rad, speeds in m/s and rad/s, the mission
        automaton's location and clocks (in control steps), and the ego's position if the adversary sees it.
        All zero once the mission has ended (location < 0).
        """
        via, dropped = self._memory.tolist()
        length = excess = 0.0
        if location < 0:
            self._out[:] = 0.0
        else:
            self._clocks[:] = clocks
            ego_x, ego_y = ego or (0.0, 0.0)
            length, excess = self._kernel(
                self.task.tables, 0, x, y, theta, v, w, location, self._clocks, self._memory, ego is not None, ego_x,
                ego_y, self._out,
            )  # fmt: skip
        before, owed_length, owed_excess = self._last
        self.gained = Gained(
            *kernels.gained(before, location, via, dropped, self._memory, owed_length, owed_excess, length, excess)
        )
        self._last = location, length, excess
        return self._out.copy()


def observation_bounds() -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Lowest and highest value of every row."""
    low = np.zeros(OBSERVED, dtype=np.float32)
    high = np.ones(OBSERVED, dtype=np.float32)
    signed = [kernels.O_ROUTE, kernels.O_ROUTE + 1, kernels.O_SPEED, kernels.O_SPEED + 1, kernels.O_ZONE]
    signed += [kernels.O_ZONE + 1, kernels.O_ZONE + 2, kernels.O_LATENTS]
    low[signed] = -1.0
    for row in (kernels.O_SLACK, kernels.O_TOTAL, kernels.O_TARGET + 1):
        low[row], high[row] = -0.5, 2.0
        low[row + 1] = -1.0
    high[[kernels.O_VISIT, kernels.O_LENGTH]] = 2.0
    high[[kernels.O_LATENTS + 1, kernels.O_LATENTS + 2]] = LATENT_MAX
    low[[kernels.O_EGO + 1, kernels.O_EGO + 2]] = -2.0
    high[[kernels.O_EGO + 1, kernels.O_EGO + 2]] = 2.0
    return low, high
