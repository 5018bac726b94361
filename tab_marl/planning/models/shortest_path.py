"""FP-POMCP's adversary: it takes the shortest path to the mission's objectives at full speed.

The definition is deterministic; what is seen may contradict it. So the belief is a set of hypotheses that all follow
shortest paths and differ in the start, in a delay (up to the last moment that lets the mission succeed), in the pace, and in
which of several goals is meant. The textbook hypothesis (no delay, full speed, nearest goals) has nearly all the weight
until an observation speaks against it. Every sighting starts the paths anew from where the adversary was seen.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from tab_marl.mission.model import Constraint, Mission, Place
from tab_marl.planning.models import walk_kernels as kernels
from tab_marl.planning.models.interface import SampledPaths, TickObservation
from tab_marl.planning.models.mission_map import MissionMap
from tab_marl.planning.models.sight import noticed
from tab_marl.world.grid import GridMap
from tab_marl.world.regions import sample_in
from tab_marl.world.scenario import Scenario


@dataclass(frozen=True)
class ShortestPathOptions:
    """The hypotheses beside the textbook one, and how observations weigh."""

    doubt: float = 0.05
    """Prior weight of all hypotheses but the textbook one."""
    delays_seconds: tuple[float, ...] = (1.0, 2.0, 4.0, 8.0, 16.0, 32.0)
    """As far as the mission leaves so much time; the longest delay that it leaves is always added."""
    paces: tuple[float, ...] = (0.7,)
    """Shares of full speed other than 1."""
    starts: int = 4
    """Points of the start region, before the first sighting."""
    goal_variants: int = 8
    """At most so many other choices of goals."""
    sight_metres: float = 0.08
    """Standard deviation between a hypothesis and a sighting."""
    least_evidence: float = 0.01
    """The likelihood of an observation that a hypothesis excludes, relative to one that it explains."""
    spread_metres: float = 0.03
    """Sampled paths are shifted by so much, so that no interception hangs on a hair."""

    def __post_init__(self) -> None:
        if not 0 < self.doubt < 1:
            raise ValueError(f"ShortestPathOptions.doubt is {self.doubt}, must lie strictly between 0 and 1")
        if not 0 < self.least_evidence < 1:
            raise ValueError(f"ShortestPathOptions.least_evidence is {self.least_evidence}, must lie in (0, 1)")
        if not all(0 < pace < 1 for pace in self.paces):
            raise ValueError(f"ShortestPathOptions.paces is {self.paces}, each must lie strictly between 0 and 1")


def goal_choices(mission: Mission, limit: int) -> tuple[Mission, ...]:
    """The mission, then the missions in which a choice of places is narrowed: to one place, or to all but one.

    The shortest path of such a mission is the shortest one with that goal in mind.
    """
    found = [mission]
    for index, goal in enumerate(mission.constraints):
        if not goal.type.is_goal or len(goal.places) <= goal.different:
            continue
        for place in goal.places:
            narrowed = _narrow(goal, place)
            if narrowed is not None and len(found) <= limit:
                constraints = (*mission.constraints[:index], narrowed, *mission.constraints[index + 1 :])
                found.append(replace(mission, constraints=constraints))
    return tuple(found)


def _narrow(goal: Constraint, place: Place) -> Constraint | None:
    if goal.different == 1:
        return replace(goal, places=(place,), including=())
    if place in goal.including:
        return None
    return replace(goal, places=tuple(p for p in goal.places if p != place))


@lru_cache(maxsize=64)
def _maps(scenario: Scenario, mission: Mission, limit: int) -> tuple[MissionMap, ...]:
    """The maps of `goal_choices` whose goals can be reached at all; the first is the mission's own."""
    own = MissionMap.build(scenario, mission)
    maps = [own]
    for choice in goal_choices(mission, limit)[1:]:
        other = MissionMap.build(scenario, choice)
        start = other.grid.cells_of([scenario.adversary_start.centre])
        if np.isfinite(other.route.distance[other.automaton.initial, start]).all():
            maps.append(other)
    return tuple(maps)


@dataclass(frozen=True, eq=False)
class _Hypotheses:
    """H paths from a base tick on."""

    base_tick: int
    choice: NDArray[np.int32]
    """``[H]`` which goals."""
    positions: NDArray[np.float64]
    """``[H, T + 1, 2]``."""
    locations: NDArray[np.int32]
    """``[H, T + 1]``."""
    clocks: NDArray[np.int32]
    """``[H, T + 1, 3]``."""
    completed: NDArray[np.int32]
    """``[H]`` tick since the base, or -1."""


class ShortestPath:
    """The belief over hypotheses."""

    def __init__(self, scenario: Scenario, mission: Mission, options: ShortestPathOptions | None = None) -> None:
        self.options = options or ShortestPathOptions()
        self.scenario = scenario
        self.maps = _maps(scenario, mission, self.options.goal_variants)
        self.fallbacks = 0
        self.log_evidence = 0.0
        self._tick = 0
        self._log_weight = np.empty(0)
        self._paths: _Hypotheses

    def start(self, observation: TickObservation, rng: np.random.Generator) -> None:
        self.fallbacks, self._tick, self.log_evidence = 0, 0, 0.0
        seen = observation.sighting
        if seen is None:
            starts = sample_in(self.scenario.adversary_start, rng, self.options.starts)
        else:
            starts = np.array([[seen.x, seen.y]])
        count = len(self.maps)
        shares = np.full(count, self.options.doubt / max(1, count - 1))
        shares[0] = 1.0 if count == 1 else 1.0 - self.options.doubt
        before = [(m.automaton.initial, np.full(3, -1, dtype=np.int32)) for m in self.maps]
        self._grow(starts, before, np.log(shares), rng)
        if seen is None:
            self._condition(observation)

    def observe(self, observation: TickObservation, rng: np.random.Generator) -> None:
        self._tick = observation.tick
        self._condition(observation)
        seen = observation.sighting
        if seen is None:
            return
        self.log_evidence = 0.0
        # Which goals, and how far the mission is, by the hypotheses near the sighting; the path itself starts anew.
        paths, then = self._paths, self._index() - 1
        shares, before = np.empty(len(self.maps)), []
        for choice in range(len(self.maps)):
            members = np.flatnonzero(paths.choice == choice)
            best = members[np.argmax(self._log_weight[members])]
            shares[choice] = np.logaddexp.reduce(self._log_weight[members])
            before.append((int(paths.locations[best, then]), paths.clocks[best, then].copy()))
        shares -= np.logaddexp.reduce(shares)
        shares = np.maximum(shares, math.log(self.options.doubt / len(shares)))
        self._grow(self._point(observation)[None], before, shares, rng, observation.track)

    def _index(self) -> int:
        """Column of the hypotheses that is now."""
        return min(self._tick - self._paths.base_tick, self._paths.positions.shape[1] - 1)

    def _point(self, observation: TickObservation) -> NDArray[np.float64]:
        seen = observation.sighting
        assert seen is not None
        travelled = seen.speed * seen.age_seconds
        return np.array([seen.x + travelled * math.cos(seen.theta), seen.y + travelled * math.sin(seen.theta)])

    def _grow(
        self,
        starts: NDArray[np.float64],
        before: list[tuple[int, NDArray[np.int32]]],
        log_shares: NDArray[np.float64],
        rng: np.random.Generator,
        track: tuple[tuple[float, float], ...] = (),
    ) -> None:
        """Follow every hypothesis to the episode's end; `before`: location and clocks by choice, one tick ago.

        Nothing is known of what follows the mission's completion: random moves.
        """
        ticks = max(1, self.scenario.horizon_ticks - self._tick)
        grown: list[tuple[int, float, NDArray[np.float64], NDArray[np.int32], NDArray[np.int32], int]] = []
        for c, m in enumerate(self.maps):
            for x, y in starts:
                clocks = before[c][1].copy()
                mask = m.label(before[c][0], (x, y), track)
                location = int(kernels.read_label(before[c][0], clocks, mask, m.rules))
                kinds = self._kinds(m, (x, y), location, clocks)
                for share, delay, pace in kinds:
                    path = np.empty((ticks + 1, 2))
                    stages, states = np.empty(ticks + 1, dtype=np.int32), np.empty((ticks + 1, 3), dtype=np.int32)
                    done = kernels.follow_way(
                        x, y, location, clocks, delay, pace, m.reach_metres, m.rules, m.ways, m.ground, path, stages,
                        states,
                    )  # fmt: skip
                    if done >= 0 or location < 0:
                        kernels.wander(path, max(done, 0), m.reach_metres, m.ground, rng)
                    prior = float(log_shares[c]) + math.log(share / len(starts))
                    grown.append((c, prior, path, stages, states, 0 if location == -1 else done))
        choice, priors, positions, locations, clock_rows, completed = zip(*grown, strict=True)
        self._paths = _Hypotheses(
            self._tick, np.array(choice, dtype=np.int32), np.array(positions), np.array(locations),
            np.array(clock_rows),
            np.array(completed, dtype=np.int32),
        )  # fmt: skip
        self._log_weight = np.array(priors)

    def _kinds(
        self, m: MissionMap, start: tuple[float, float], location: int, clocks: NDArray[np.int32]
    ) -> list[tuple[float, int, float]]:
        """(prior share, delay in ticks, pace): the textbook hypothesis and those beside it."""
        options, step = self.options, self.scenario.step_seconds
        spare = kernels.spare_ticks(*start, location, clocks, m.rules, m.ways, m.mission_latest, m.reach_metres)
        delays = [d for d in (round(s / step) for s in options.delays_seconds) if 0 < d < spare]
        delays += [int(spare)] if spare > 0 else []
        slow = [(0, pace) for pace in options.paces] + [(delay, 1.0) for delay in delays]
        doubt = options.doubt if slow else 0.0
        return [(1.0 - doubt, 0, 1.0), *((doubt / len(slow), *kind) for kind in slow)]

    def _condition(self, observation: TickObservation) -> None:
        here, least = self._paths.positions[:, self._index()], math.log(self.options.least_evidence)
        if observation.sighting is not None:
            squared = ((here - self._point(observation)) ** 2).sum(axis=1)
            # No floor here: if all are far off, the nearest decide.
            evidence = -(squared - squared.min()) / (2 * self.options.sight_metres**2)
            surprise = squared.min() > (4 * self.options.sight_metres) ** 2
        else:
            contradicted = noticed(self.scenario, here, observation.ego)
            evidence = np.where(contradicted, least, 0.0)
            self.log_evidence += math.log(float(self._weights() @ np.exp(evidence)))
            surprise = contradicted.all()
        self.fallbacks += bool(surprise)
        self._log_weight = self._log_weight + evidence
        # Forget slowly: a hypothesis written off long ago may come back.
        floor = self._log_weight.max() + 6 * least
        self._log_weight = np.maximum(self._log_weight, floor)

    def _weights(self) -> NDArray[np.float64]:
        weight = np.exp(self._log_weight - self._log_weight.max())
        return np.asarray(weight / weight.sum())

    def sample(self, count: int, ticks: int, rng: np.random.Generator) -> SampledPaths:
        paths, now = self._paths, self._index()
        weight = self._weights()
        done = (paths.completed >= 0) & (paths.completed <= now)
        if self.scenario.ego_task == "interception" and not done.all():
            weight = np.where(done, 0.0, weight)
        chosen = rng.choice(len(weight), size=count, p=weight / weight.sum())
        columns = np.minimum(now + np.arange(ticks + 1), paths.positions.shape[1] - 1)
        positions = paths.positions[chosen][:, columns] + rng.normal(0.0, self.options.spread_metres, (count, 1, 2))
        completed = np.where(paths.completed[chosen] > now, paths.completed[chosen] - now, -1)
        return SampledPaths(positions, completed.astype(np.int32))

    def occupancy(self) -> tuple[GridMap, NDArray[np.float64]]:
        grid = self.maps[0].grid
        cells = grid.cells_of(self._paths.positions[:, self._index()])
        return grid, np.asarray(np.bincount(cells, weights=self._weights(), minlength=grid.cells), dtype=np.float64)
