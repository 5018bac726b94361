"""The planners as agents: environment observations in, controls out.

Eight names, one planner: they differ in nothing but the adversary model (`tab_marl.planning.models`).

====================  ==================================================================================================
name                  adversary model
====================  ==================================================================================================
S-POMCP               uniform random moves within the speed limit
FP-POMCP              the shortest path to the mission's objectives at full speed
MLE-POMCP             moves counted from sightings of the development policies and of this episode, kept feasible
TAB-POMCP             the TAB-Field's bridge kernel, or drivers with habits drawn at random
                      (`tab_marl.planning.models.drawn_ways`): whichever foresees better
TAB-POMCP+precedents  the TAB-Field's bridge kernel, or as other policies (those for development) drove on this task
oracle                the TAB-Field's bridge kernel, and the adversary is always seen (environment option `full_observation`)
population-POMCP      trajectories of the very policies that may be played, weighted by what was seen: a ceiling
random                none: drives to random waypoints
====================  ==================================================================================================
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tab_marl.agents.planner_memory import PlannerMemory
from tab_marl.agents.policies.cards import Split
from tab_marl.agents.pretraining import pretrained
from tab_marl.envs.ego_observation import EgoView, parse_ego_observation
from tab_marl.field.problem import FieldOptions
from tab_marl.mission.propositions import region_of
from tab_marl.mission.tasks import Task
from tab_marl.planning.models.drawn_ways import WaysOptions, draw_ways
from tab_marl.planning.models.field_model import FieldModel
from tab_marl.planning.models.guarded import EvidentModel, Guarded
from tab_marl.planning.models.interface import AdversaryModel, Sighting, TickObservation
from tab_marl.planning.models.mission_map import MissionMap
from tab_marl.planning.models.mixture import Mixture
from tab_marl.planning.models.pool import PoolOptions, TrajectoryPool
from tab_marl.planning.models.shortest_path import ShortestPath, ShortestPathOptions
from tab_marl.planning.models.walker import MoveCounts, Walker
from tab_marl.planning.pursuit.decide import Decision, PursuitOptions, decide
from tab_marl.planning.pursuit.routes import RouteMap, RouteOptions
from tab_marl.planning.pursuit.scenarios import ReuseOptions, ScenarioSet
from tab_marl.world.scenario import UnknownName

PRECEDENTS = "TAB-POMCP+precedents"
PLANNERS = ("S-POMCP", "FP-POMCP", "MLE-POMCP", "TAB-POMCP", PRECEDENTS, "oracle", "population-POMCP", "random")

GUARDS = tuple((name, 0.05) for name in ("FP-POMCP", "MLE-POMCP", "population-POMCP"))

ROLLOUTS_PER_POLICY = 30

Rollouts = Callable[[Task, np.random.Generator], tuple[NDArray[np.float64], NDArray[np.int32]]]
"""Trajectories of a population that nobody hunts: positions ``[N, T + 1, 2]`` per tick, and completion ticks ``[N]``."""


@dataclass(frozen=True)
class PlannerOptions:
    """How to plan. Nothing in here is a planner's own but its adversary model's options."""

    pursuit: PursuitOptions = field(default_factory=PursuitOptions)
    reuse: ReuseOptions = field(default_factory=ReuseOptions)
    routes: RouteOptions = field(default_factory=RouteOptions)
    tab_field: FieldOptions = field(default_factory=FieldOptions)
    """Of TAB-POMCP, with and without precedents, and of the oracle."""
    ways: WaysOptions | None = field(default_factory=WaysOptions)
    """Of TAB-POMCP: drivers with habits of their own, an even match for the field. None: the field alone, as in the paper."""
    shortest_path: ShortestPathOptions = field(default_factory=ShortestPathOptions)
    pool: PoolOptions = field(default_factory=PoolOptions)
    guards: tuple[tuple[str, float], ...] = GUARDS
    """(planner, prior of "it may be anywhere": `tab_marl.planning.models.guarded`); planners not named have no guard."""
    particles: int = 3000
    """Of S-POMCP and MLE-POMCP."""
    rollouts: Rollouts | None = None
    """Of population-POMCP; None: every policy that ships with the package, those of the final table among them."""
    precedents: Rollouts | None = None
    """Of TAB-POMCP+precedents: how others with such missions have driven, an even match for the field until observations
    tell which foresees better. None: the development policies that ship with the package."""
    moves: MoveCounts | None = None
    """What MLE-POMCP has counted before; None: the development policies' moves (`tab_marl.agents.pretraining`)."""
    carries_moves: bool = False
    """Whether MLE-POMCP takes what it counts in one episode into the next. In a table that would be data from the
    policies that it is judged against."""
    memory: PlannerMemory | None = None
    """Keeps what depends on the task alone, where the same tasks come again and again."""

    def __post_init__(self) -> None:
        if self.particles < 1:
            raise ValueError(f"PlannerOptions.particles is {self.particles}, must be >= 1")


class DecisionParts(NamedTuple):
    """Where a decision's time went: processor seconds of the planner's thread, which other jobs do not disturb."""

    belief: float
    """Updating it, over all ticks since the last decision."""
    sampling: float
    """Drawing adversary paths from it."""
    valuation: float
    """Of itineraries against these."""
    search: float
    """The tree."""


class EgoAgent(Protocol):
    """Whatever can drive the ego."""

    name: str
    full_observation: bool
    """Whether the environment must be made with `full_observation`."""
    decision_seconds: list[float]
    """Wall-clock time of each decision of this episode, belief update included."""

    def reset(self, task: Task, rng: np.random.Generator) -> None:
        """Begin an episode."""

    def act(self, observation: ArrayLike) -> NDArray[np.float32]:
        """The action ``[2]`` in [-1, 1] for one control step."""

    def belief_image(self) -> NDArray[np.float64] | None:
        """``[rows, columns]``: where the adversary is believed to be, row 0 at the bottom; None if nothing is believed."""

    @property
    def fallbacks(self) -> int:
        """How often this episode's observations contradicted the whole belief."""

    def learned_state(self) -> dict[str, Any] | None:
        """What was learned across episodes, as JSON values; None if nothing ever is."""

    def restore(self, state: Mapping[str, Any] | None) -> None:
        """The inverse of `learned_state`."""


class PlannerAgent:
    """A planner with an adversary model."""

    def __init__(self, name: str, options: PlannerOptions) -> None:
        self.name = name
        self.options = options
        self.full_observation = name == "oracle"
        self.decision_seconds: list[float] = []
        self.decision_parts: list[DecisionParts] = []
        self.decision: Decision | None = None
        self.moves = self._first_moves() if name == "MLE-POMCP" else None
        self._model: AdversaryModel | None = None

    def reset(self, task: Task, rng: np.random.Generator) -> None:
        scenario = task.scenario
        self.task, self.rng = task, rng
        if self.moves is not None and not self.options.carries_moves:
            self.moves = self._first_moves()
        memory = self.options.memory
        self.routes = (RouteMap.build if memory is None else memory.routes)(
            scenario, goal_places(task), self.options.routes
        )
        model = self._make_model(task, rng)
        prior = dict(self.options.guards).get(self.name, 0.0)
        guarded = prior > 0
        self._model = Guarded(model, MissionMap.build(scenario, task.mission), prior) if guarded else model
        self._scenarios = ScenarioSet(scenario, self.options.pursuit.paths, self.options.reuse)
        self.decision, self.decision_seconds, self.decision_parts = None, [], []
        self._belief_seconds = 0.0
        self._steps_per_tick = round(scenario.step_seconds * scenario.control_hertz)
        self._steps_per_decision = scenario.control_hertz // scenario.decision_hertz
        self._step = 0
        self._latest: tuple[int, Sighting] | None = None
        self._track: list[tuple[float, float]] = []

    def act(self, observation: ArrayLike) -> NDArray[np.float32]:
        view = parse_ego_observation(observation)
        if view.adversary is not None:
            seen = view.adversary
            self._latest = (self._step, Sighting(seen.x, seen.y, seen.theta, abs(seen.v)))
            self._track.append((seen.x, seen.y))
        started = time.perf_counter()
        if self._step % self._steps_per_tick == 0:
            update_began = time.thread_time()
            self._update(view)
            self._belief_seconds += time.thread_time() - update_began
        if self._step % self._steps_per_decision == 0:
            self._decide(view)
            self.decision_seconds.append(time.perf_counter() - started)
        self._step += 1
        assert self.decision is not None, "call reset before act"
        return _action(self.routes, (view.x, view.y, view.theta), self.decision.route)

    def belief_image(self) -> NDArray[np.float64] | None:
        if self._model is None:
            return None
        grid, occupancy = self._model.occupancy()
        return grid.image(occupancy)

    @property
    def fallbacks(self) -> int:
        return 0 if self._model is None else self._model.fallbacks

    def learned_state(self) -> dict[str, Any] | None:
        carried = self.moves if self.options.carries_moves else None
        return None if carried is None else carried.to_json()

    def restore(self, state: Mapping[str, Any] | None) -> None:
        if self.moves is not None:
            self.moves = self._first_moves() if state is None else MoveCounts.from_json(state)

    def _first_moves(self) -> MoveCounts:
        given = self.options.moves
        return pretrained() if given is None else MoveCounts.from_json(given.to_json())

    def _make_model(self, task: Task, rng: np.random.Generator) -> EvidentModel:
        scenario, mission, options = task.scenario, task.mission, self.options
        if self.name == "FP-POMCP":
            return ShortestPath(scenario, mission, options.shortest_path)
        if self.name == "S-POMCP":
            return Walker(MissionMap.build(scenario, mission), particles=options.particles)
        if self.name == "MLE-POMCP":
            return Walker(
                MissionMap.build(scenario, mission), self.moves, feasible=True, learns=True, particles=options.particles
            )
        if self.name == "population-POMCP":
            return self._pool(options.rollouts or zoo_rollouts(), task, rng)
        memory = options.memory
        solved = None if memory is None else memory.field(scenario, mission, options.tab_field)
        model = FieldModel(scenario, mission, options.tab_field, solved)
        if self.name == PRECEDENTS:
            others = options.precedents or zoo_rollouts("development")
        elif self.name == "TAB-POMCP" and options.ways is not None:
            others = _drawn(options.ways)
        else:
            return model
        return Mixture([model, self._pool(others, task, rng)], [0.5, 0.5])

    def _pool(self, rollouts: Rollouts, task: Task, rng: np.random.Generator) -> TrajectoryPool:
        positions, completed = rollouts(task, rng)
        pool = TrajectoryPool(task.scenario, positions, completed, self.options.pool)
        pool.wander_after_completion(MissionMap.build(task.scenario, task.mission), rng)
        return pool

    def _update(self, view: EgoView) -> None:
        """Hand the model what happened since the last tick."""
        assert self._model is not None, "call reset before act"
        sighting = None
        if self._latest is not None:
            step, seen = self._latest
            age = (self._step - step) / self.task.scenario.control_hertz
            sighting = Sighting(seen.x, seen.y, seen.theta, seen.speed, age)
        tick = self._step // self._steps_per_tick
        observation = TickObservation(tick, (view.x, view.y), sighting, tuple(self._track))
        (self._model.start if tick == 0 else self._model.observe)(observation, self.rng)
        self._scenarios.advance(observation)
        self._latest, self._track = None, []

    def _decide(self, view: EgoView) -> None:
        assert self._model is not None
        scenario, pursuit = self.task.scenario, self.options.pursuit
        left = scenario.horizon_ticks - self._step // self._steps_per_tick
        ticks = max(2, min(round(pursuit.horizon_seconds / scenario.step_seconds), left))
        began = time.thread_time()
        sampled = self._scenarios.draw(self._model, ticks, left, self.rng)
        sampling = time.thread_time() - began
        per_decision = self._steps_per_decision // self._steps_per_tick
        current = None if self.decision is None else self.decision.itinerary.later(per_decision)
        chosen = decide(self.routes, (view.x, view.y, view.theta), sampled, current, pursuit, self.rng)
        self.decision_parts.append(
            DecisionParts(self._belief_seconds, sampling, chosen.valuation_seconds, chosen.search_seconds)
        )
        self.decision, self._belief_seconds = chosen, 0.0


class RandomAgent:
    """Drives to uniformly random waypoints, one after another."""

    name = "random"
    full_observation = False
    fallbacks = 0

    def __init__(self, options: PlannerOptions) -> None:
        self.options = options
        self.decision_seconds: list[float] = []

    def reset(self, task: Task, rng: np.random.Generator) -> None:
        self.rng = rng
        self.routes = RouteMap.build(task.scenario, goal_places(task), self.options.routes)
        self.decision_seconds = []
        self._route: int | None = None

    def act(self, observation: ArrayLike) -> NDArray[np.float32]:
        view = parse_ego_observation(observation)
        pose = (view.x, view.y, view.theta)
        if self._route is None or self.routes.control(pose, self._route) == (0.0, 0.0):
            started = time.perf_counter()
            self._route = int(self.rng.integers(self.routes.stay))
            self.decision_seconds.append(time.perf_counter() - started)
        return _action(self.routes, pose, self._route)

    def belief_image(self) -> NDArray[np.float64] | None:
        return None

    def learned_state(self) -> dict[str, Any] | None:
        return None

    def restore(self, state: Mapping[str, Any] | None) -> None:
        """Nothing is ever learned."""


def _action(routes: RouteMap, pose: tuple[float, float, float], route: int) -> NDArray[np.float32]:
    """The environment's action for the next control step along a route."""
    v, w = routes.control(pose, route)
    robot = routes.scenario.ego
    return np.array([2.0 * v / robot.max_speed - 1.0, w / robot.max_turn_rate], dtype=np.float32)


def goal_places(task: Task) -> tuple[tuple[float, float], ...]:
    """Centres of all places where the mission's goals may be, and of the ego's own goal: it may want to stand at each."""
    regions = (region_of(place, task.scenario) for goal in task.mission.goals for place in goal.places)
    own = () if task.scenario.ego_goal is None else (task.scenario.ego_goal.centre,)
    return tuple(dict.fromkeys([*(region.centre for region in regions), *own]))


def _drawn(options: WaysOptions) -> Rollouts:
    """Of drivers with habits drawn at random."""
    return lambda task, rng: draw_ways(task.scenario, task.mission, rng, options)


def zoo_rollouts(split: Split | None = None) -> Rollouts:
    """Of the shipped policies of a split (None: of both)."""

    def rollouts(task: Task, rng: np.random.Generator) -> tuple[NDArray[np.float64], NDArray[np.int32]]:
        from tab_marl.agents.measures.rollouts import zoo_rollouts
        from tab_marl.agents.policies.zoo import load_zoo

        return zoo_rollouts(load_zoo(split=split), task, rng, ROLLOUTS_PER_POLICY)

    return rollouts


def make_planner(name: str, options: PlannerOptions | None = None) -> EgoAgent:
    """The agent of this name (`PLANNERS`). Raises UnknownName with the nearest one."""
    if name not in PLANNERS:
        raise UnknownName("planner", name, PLANNERS)
    chosen = options or PlannerOptions()
    return RandomAgent(chosen) if name == "random" else PlannerAgent(name, chosen)
