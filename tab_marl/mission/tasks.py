"""Interception tasks: a random map, a mission with deadlines that fit it, and starts from which the chase is fair.

Families (what makes prediction matter, and what does not):

``point``      the paper's missions; every goal is one small disc that a waiting ego covers.
``perimeter``  the last goal is a disc wider than the interception radius: a control.
``ambiguous``  the goal is any of several: whoever waits at one of them may wait in vain.

Deadlines are `slack` times the shortest time to the farthest way of completing the mission. Every task can be won: an ego
that knew the adversary's shortest path (to each alternative goal) could meet it on the way.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import permutations
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from tab_marl.mission.model import Constraint, ConstraintType, Mission, Place
from tab_marl.world.grid import GridMap
from tab_marl.world.regions import Disc, Region
from tab_marl.world.sampling import PLANNING_CELL_METRES, MapOptions, sample_disc, sample_scenario
from tab_marl.world.scenario import STRICT, Scenario, UnknownName

MISSION_IDS = ("M1", "M2", "M3", "M4", "M5")
FAMILIES = ("point", "perimeter", "ambiguous")

SLACK_RANGE = (1.2, 2.5)
TURN_SECONDS = 1.0
"""Allowance for turning, once per leg: a Burger turns by 90 degrees in 0.9 s."""
START_RADIUS_METRES = 0.15
FAR_METRES = 1.0
"""The adversary starts at least this far from its first goal and from the ego."""
PURSUIT_SECONDS = 10.0
"""The episode goes on this long after the last moment at which the mission can be completed."""
TURN_BACK_SECONDS = 4.5
"""Leaving a disc, turning round and coming back, for recurring visits."""
PERIMETER_METRES = (0.45, 0.6)
MAPS = 200
"""Maps tried before a task is given up."""


@dataclass(frozen=True)
class Task:
    """What one episode is about."""

    scenario: Scenario
    mission: Mission
    mission_id: str
    family: str
    slack: float
    """Allowed time / shortest time."""

    __pydantic_config__: ClassVar = STRICT


def sample_task(
    rng: np.random.Generator,
    mission_id: str = "M1",
    family: str = "point",
    slack: float | None = None,
    options: MapOptions | None = None,
    *,
    scenario: Scenario | None = None,
    far_metres: float = FAR_METRES,
) -> Task:
    """Draw a task. `slack` None draws it uniformly from SLACK_RANGE. Raises UnknownName for a wrong id or family.

    `scenario`: the map, where it is not to be drawn; goals, starts and deadlines still are. `far_metres`: between the
    adversary's start and its first goal, and between the two starts, at least; on a given map as far as there is room.
    """
    if mission_id not in MISSION_IDS:
        raise UnknownName("mission type", mission_id, MISSION_IDS)
    if family not in FAMILIES:
        raise UnknownName("scenario family", family, FAMILIES)
    if slack is not None and not slack > 1:
        raise ValueError(f"slack is {slack}, must be > 1 (allowed time / shortest time)")
    for draw in range(MAPS):
        drawn = float(rng.uniform(*SLACK_RANGE)) if slack is None else slack
        map_drawn = sample_scenario(rng, options, name=f"{mission_id}-{family}") if scenario is None else scenario
        order, far = np.arange(len(map_drawn.checkpoints)), far_metres
        if scenario is not None:
            order, far = _goal_order(rng, scenario, mission_id, family), far_metres * (1.0 - 0.8 * draw / MAPS)
        task = _attempt(rng, map_drawn, order, mission_id, family, drawn, far)
        if task is not None:
            return task
    where = f"{MAPS} maps" if scenario is None else f"scenario {scenario.name!r} in {MAPS} draws"
    raise RuntimeError(f"no winnable {family} {mission_id} task with slack {slack} found on {where}")


def _goal_order(rng: np.random.Generator, scenario: Scenario, mission_id: str, family: str) -> NDArray[np.int_]:
    """Checkpoints of a given map in random order: the first are the goals. M4 keeps off those in the central zone.

    Raises ValueError if there are too few.
    """
    order = rng.permutation(len(scenario.checkpoints))
    if mission_id == "M4":
        zone = scenario.region("central zone")
        centres = np.array([scenario.checkpoints[i].region.centre for i in order]).reshape(-1, 2)
        reach = np.array([scenario.checkpoints[i].radius_metres for i in order])
        order = order[zone.distance(centres) >= reach]
    needed = 3 if mission_id == "M5" else 4 if family == "ambiguous" else 2 if mission_id == "M2" else 1
    if len(order) < needed:
        raise ValueError(
            f"scenario {scenario.name!r} has {len(order)} checkpoints that can be goals of {family} {mission_id}, needs "
            f"{needed}"
        )
    return order


def _attempt(
    rng: np.random.Generator,
    scenario: Scenario,
    order: NDArray[np.int_],
    mission_id: str,
    family: str,
    slack: float,
    far_metres: float,
) -> Task | None:
    if family == "perimeter":
        widened = _widen(rng, scenario, order, mission_id)
        if widened is None:
            return None
        scenario = widened
    legs = _legs(rng, scenario, order, mission_id, family)
    if legs is None:
        return None
    grid = GridMap.from_scenario(scenario, PLANNING_CELL_METRES)
    travel = Travel(scenario, grid, _avoided(scenario, mission_id))
    first = [scenario.place(place) for place in legs[0]]
    clear = scenario.adversary.radius_metres + START_RADIUS_METRES

    def far_from_goals(points: NDArray[np.float64]) -> NDArray[np.bool_]:
        ok = np.min([region.distance(points) for region in first], axis=0) >= far_metres
        for region in travel.avoided:
            ok &= region.distance(points) >= clear
        return np.asarray(ok)

    start = sample_disc(rng, grid, START_RADIUS_METRES, far_from_goals)
    if start is None:
        return None
    ways = travel.ways(start.centre, legs, mission_id)
    if not ways or not all(math.isfinite(way.seconds) for way in ways):
        return None
    mission, horizon = _mission(mission_id, legs, travel, ways, slack)
    meets = np.all([travel.ego_meets(way.path) for way in ways], axis=0)
    ego = draw_ego_start(rng, grid, meets, start, far_metres)
    if ego is None:
        return None
    scenario = replace(scenario, ego_start=ego, adversary_start=start, horizon_seconds=horizon)
    return Task(scenario, mission, mission_id, family, round(slack, 3))


def draw_ego_start(
    rng: np.random.Generator, grid: GridMap, meets: NDArray[np.bool_], start: Disc, far_metres: float
) -> Disc | None:
    """A start from which the ego can be first (`meets` ``[S]``) and that lies far from the adversary's; None if none does."""

    def fair(points: NDArray[np.float64]) -> NDArray[np.bool_]:
        apart = np.hypot(points[:, 0] - start.x, points[:, 1] - start.y) >= far_metres
        return np.asarray(meets & apart)

    return sample_disc(rng, grid, 0.05, fair)


def _widen(rng: np.random.Generator, scenario: Scenario, order: NDArray[np.int_], mission_id: str) -> Scenario | None:
    """Make the last goal wider than the interception radius, if the map leaves room for it."""
    radius = round(float(rng.uniform(*PERIMETER_METRES)), 2)
    if mission_id == "M5":
        return replace(scenario, target_radius_metres=radius)
    index = int(order[1 if mission_id == "M2" else 0])
    goal = replace(scenario.checkpoints[index], radius_metres=radius, camera_metres=round(radius + 0.15, 2))
    others = [c for i, c in enumerate(scenario.checkpoints) if i != index]
    if any(math.hypot(goal.x - c.x, goal.y - c.y) < radius + c.radius_metres + 0.2 for c in others):
        return None
    if scenario.region("central zone").distance([[goal.x, goal.y]])[0] < radius + 0.1 and mission_id == "M4":
        return None
    checkpoints = list(scenario.checkpoints)
    checkpoints[index] = goal
    return replace(scenario, checkpoints=tuple(checkpoints))


def _legs(
    rng: np.random.Generator, scenario: Scenario, order: NDArray[np.int_], mission_id: str, family: str
) -> list[tuple[Place, ...]] | None:
    """The goals in order, each as the tuple of places of which one will do."""
    names: list[Place] = [scenario.checkpoints[i].name for i in order]
    several = family == "ambiguous"
    if mission_id == "M2":
        return [tuple(names[:2]), tuple(names[2:4])] if several else [(names[0],), (names[1],)]
    if mission_id == "M5":
        targets = _targets(rng, scenario, 3 if several else 1)
        return None if targets is None else [tuple(names), targets]
    return [tuple(names[:4])] if several else [(names[0],)]


def _targets(rng: np.random.Generator, scenario: Scenario, count: int) -> tuple[Place, ...] | None:
    """Bare target points, clear of checkpoints, obstacles, walls and the central zone."""
    radius = scenario.target_radius_metres
    grid = GridMap.from_scenario(scenario, PLANNING_CELL_METRES)
    ok = scenario.region("central zone").distance(grid.centres) >= radius + 0.1
    for c in scenario.checkpoints:
        ok &= c.region.distance(grid.centres) >= radius + 0.15
    if radius < scenario.interception_metres:  # a wide target may reach under an obstacle, a small one may not
        for obstacle in scenario.obstacles:
            ok &= obstacle.distance(grid.centres) >= radius + 0.105
    chosen: list[Place] = []
    for _ in range(count):
        candidates = np.flatnonzero(ok)
        if len(candidates) == 0:
            return None
        x, y = grid.centres[rng.choice(candidates)]
        chosen.append((round(float(x), 2), round(float(y), 2)))
        ok &= np.hypot(grid.centres[:, 0] - x, grid.centres[:, 1] - y) >= 0.8
    return tuple(chosen)


def _avoided(scenario: Scenario, mission_id: str) -> tuple[Region, ...]:
    return (scenario.region("central zone"),) if mission_id in ("M4", "M5") else ()


@dataclass(frozen=True)
class Way:
    """One shortest way of completing the mission: the time it takes, leg by leg, and where it is at each tick."""

    seconds: float
    leg_seconds: tuple[float, ...]
    path: NDArray[np.float64]
    """``[ticks + 1, 2]`` metres."""


class Travel:
    """Shortest paths of one adversary on one map, out of the regions avoided."""

    def __init__(self, scenario: Scenario, grid: GridMap, avoided: Sequence[Region] = ()) -> None:
        self.scenario, self.grid, self.avoided = scenario, grid, tuple(avoided)
        # Walking through a region costs so much that a path avoids it wherever it can; a path that cannot is refused.
        zone = np.any([grid.inside(region) for region in avoided], axis=0) if avoided else None
        self._cost = None if zone is None else np.where(zone, 1e6, 1.0)
        self._from: dict[tuple[Place, ...], NDArray[np.float64]] = {}

    def to(self, places: tuple[Place, ...]) -> NDArray[np.float64]:
        """``[S]`` metres to the nearest cell of these places."""
        if places not in self._from:
            inside = np.any([self.grid.inside(self.scenario.place(p)) for p in places], axis=0)
            sources = np.flatnonzero(inside)
            self._from[places] = (
                self.grid.distances(sources, self._cost) if len(sources) else np.full(self.grid.cells, np.inf)
            )
        return self._from[places]

    def ways(self, start: tuple[float, float], legs: list[tuple[Place, ...]], mission_id: str) -> list[Way]:
        """The shortest way for each choice of last goal (M2: of both goals; M5: over the best three checkpoints)."""
        orders: list[tuple[Place, ...]]
        if mission_id == "M2":
            orders = [(a, b) for a in legs[0] for b in legs[1]]
        elif mission_id == "M5":
            orders = [self._best_three(start, legs[0], target) for target in legs[1]]
        else:
            orders = [(goal,) for goal in legs[0]]
        return [self.walk(start, order) for order in orders]

    def _best_three(self, start: tuple[float, float], names: tuple[Place, ...], target: Place) -> tuple[Place, ...]:
        cells = {place: int(self.grid.cells_of([self.scenario.place(place).centre])[0]) for place in (*names, target)}
        home = int(self.grid.cells_of([start])[0])

        def length(order: tuple[Place, ...]) -> float:
            cell, total = home, 0.0
            for place in order:
                total += float(self.to((place,))[cell])
                cell = cells[place]
            return total

        return min(((*three, target) for three in permutations(names, 3)), key=length)

    def walk(self, start: tuple[float, float], order: tuple[Place, ...]) -> Way:
        """Descend the distance to each goal in turn, one leg after the other, at full speed."""
        speed, step = self.scenario.adversary.max_speed, self.scenario.step_seconds
        cell = int(self.grid.cells_of([start])[0])
        points, times, legs = [self.grid.centres[cell]], [0.0], []
        for place in order:
            distance = self.to((place,))
            if not distance[cell] < 1e4:
                return Way(math.inf, (math.inf,), np.zeros((1, 2)))
            legs.append(TURN_SECONDS + float(distance[cell]) / speed)
            points.append(points[-1])
            times.append(times[-1] + TURN_SECONDS)
            while distance[cell] > 0:
                near = np.flatnonzero(
                    (abs(self.grid.row - self.grid.row[cell]) <= 2)
                    & (abs(self.grid.column - self.grid.column[cell]) <= 2)
                )
                gap = np.hypot(*(self.grid.centres[near] - self.grid.centres[cell]).T)
                rate = (distance[cell] - distance[near]) / np.maximum(gap, 1e-9)
                best = int(near[np.argmax(np.where(gap > 0, rate, -np.inf))])
                times.append(times[-1] + float(distance[cell] - distance[best]) / speed)
                cell = best
                points.append(self.grid.centres[cell])
        ticks = np.arange(0.0, times[-1] + step, step)
        track = np.asarray(points)
        path = np.stack([np.interp(ticks, times, track[:, 0]), np.interp(ticks, times, track[:, 1])], axis=1)
        return Way(times[-1], tuple(legs), path)

    def ego_meets(self, path: NDArray[np.float64]) -> NDArray[np.bool_]:
        """``[S]``: from which cells an ego that knew this path could be within reach of it in time."""
        ego, step = self.scenario.ego, self.scenario.step_seconds
        free = GridMap.from_scenario(self.scenario, PLANNING_CELL_METRES, ego.radius_metres)
        meets = np.zeros(self.grid.cells, dtype=bool)
        for tick in range(2, len(path), 2):
            distance = free.distances(free.cells_of([path[tick]]))[free.cells_of(self.grid.centres)]
            arrival = TURN_SECONDS + (distance - self.scenario.interception_metres) / ego.max_speed
            meets |= arrival <= tick * step
        return meets


def half_seconds(seconds: float) -> float:
    """Up to the next half second, so that the mission reads well."""
    return math.ceil(2 * seconds - 1e-9) / 2


def _mission(
    mission_id: str, legs: list[tuple[Place, ...]], travel: Travel, ways: list[Way], slack: float
) -> tuple[Mission, float]:
    """The mission with its deadlines, and the episode's horizon in seconds."""
    longest = max(way.seconds for way in ways)
    allowed = half_seconds(slack * longest)
    avoid_centre = Constraint(ConstraintType.ALWAYS, ("central zone",), avoid=True)
    reach = ConstraintType.DEADLINE
    if mission_id == "M1":
        goals: tuple[Constraint, ...] = (Constraint(reach, legs[0], seconds=allowed),)
        end = allowed
    elif mission_id == "M2":
        goals = (
            Constraint(ConstraintType.EVENTUALLY, legs[0]),
            Constraint(ConstraintType.EXACT, legs[1], seconds=allowed),
        )
        end = allowed + max(travel.scenario.exact_seconds, travel.scenario.exact_fraction * allowed)
    elif mission_id == "M3":
        period = half_seconds(slack * max(longest, TURN_BACK_SECONDS + TURN_SECONDS))
        goals = (Constraint(reach, legs[0], seconds=period, recurrences=3),)
        end = 3 * period
    elif mission_id == "M4":
        # Unbounded: it ends at the episode's horizon, which is therefore the allowed time.
        return Mission((Constraint(ConstraintType.EVENTUALLY, legs[0]), avoid_centre), "M4"), allowed
    else:
        gap = half_seconds(slack * max(max(way.leg_seconds) for way in ways))
        goals = (
            Constraint(ConstraintType.EVENTUALLY, legs[0], different=3, max_gap_seconds=gap),
            Constraint(ConstraintType.EVENTUALLY, legs[1], max_gap_seconds=gap),
            avoid_centre,
        )
        end = 4 * gap
    return Mission(goals, mission_id), half_seconds(end + PURSUIT_SECONDS)


@lru_cache(maxsize=1024)
def ego_can_be_first(task: Task) -> bool:
    """Whether the last goal is one small disc that the ego reaches, and covers, before the adversary possibly can."""
    goals = task.mission.goals
    if len(goals[-1].places) != 1 or task.family == "perimeter":
        return False
    scenario = task.scenario
    grid = GridMap.from_scenario(scenario, PLANNING_CELL_METRES)
    travel = Travel(scenario, grid, _avoided(scenario, task.mission_id))
    ways = travel.ways(scenario.adversary_start.centre, [g.places for g in goals], task.mission_id)
    shortest = min(way.seconds for way in ways) - 3 * TURN_SECONDS - START_RADIUS_METRES / scenario.adversary.max_speed
    place = scenario.place(goals[-1].places[0])
    free = GridMap.from_scenario(scenario, PLANNING_CELL_METRES, scenario.ego.radius_metres)
    distance = free.distances(free.cells_of([place.centre]))
    ego = float(distance[free.cells_of([scenario.ego_start.centre])[0]])
    return 2 * TURN_SECONDS + ego / scenario.ego.max_speed <= shortest
