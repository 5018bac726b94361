"""Which route the ego takes next: routes valued against sampled adversary paths, refined by POMCP over route changes.

One planner for all adversary models. `routes` values "drive to w and wait" for every waypoint; `tree` searches over
changing the route later, depending on what cameras will have seen, and starts from those values.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from tab_marl.planning import interception_kernels, pursuit_kernels
from tab_marl.planning.interception import RouteValues, value_routes
from tab_marl.planning.model import CompiledModel
from tab_marl.planning.models.interface import SampledPaths
from tab_marl.planning.pomcp import Plan, Pomcp, PomcpOptions
from tab_marl.planning.routes import RouteMap

Pose = tuple[float, float, float]


@dataclass(frozen=True)
class PursuitOptions:
    """How to search; the same for every adversary model."""

    method: Literal["tree", "routes"] = "tree"
    """`routes`: take the best route as it is, without a tree."""
    paths: int = 200
    """K sampled adversary paths a decision."""
    horizon_seconds: float = 40.0
    """How far ahead paths are sampled, at most (they end with the episode)."""
    candidates: int = 12
    """The best routes that the tree may choose among, now and later."""
    simulations: int = 600
    exploration: float = 5.0
    """UCB1's constant, in units of return."""
    macro_seconds: float = 1.0
    """How long a route is kept in the tree, unless cameras begin or cease to see the adversary."""
    tree_seconds: float = 6.0
    """Route changes later than this are not searched."""
    root_count: int = 10
    """Pseudo-count of a route's value at the root."""
    node_count: int = 5
    """Pseudo-count of a route's value below the root."""
    keep_count: int = 0
    """The same for keeping the route; 0: it is tried first, and its value is what its rollouts say."""
    square_metres: float = 0.4
    """A sighting in the tree is told by the square of this size in which it is."""
    switches: int = 3
    """In a rollout the route is changed at most so often, when a camera sees the adversary; 0: never."""
    alike_metres: float = 0.4
    """Sampled paths this near to a sighting tell what the sighting means."""
    switch_bonus: float = 2.0
    """By how much another route must look better before a rollout leaves its own."""
    keep_bonus: float = 0.5
    """By how much another route must be better before the present one is left."""
    radius_share: float = 1.0
    """Paths are met at this share of the interception distance: below 1 asks for a margin."""

    def __post_init__(self) -> None:
        if self.method not in ("tree", "routes"):
            raise ValueError(f"PursuitOptions.method is {self.method!r}, must be 'tree' or 'routes'")
        for name in ("paths", "candidates", "simulations", "root_count", "node_count"):
            if getattr(self, name) < 1:
                raise ValueError(f"PursuitOptions.{name} is {getattr(self, name)}, must be >= 1")
        for name in ("horizon_seconds", "macro_seconds", "square_metres", "radius_share", "alike_metres"):
            if not getattr(self, name) > 0:
                raise ValueError(f"PursuitOptions.{name} is {getattr(self, name)}, must be > 0")
        for name in ("exploration", "keep_bonus", "keep_count", "tree_seconds", "switches", "switch_bonus"):
            if not getattr(self, name) >= 0:
                raise ValueError(f"PursuitOptions.{name} is {getattr(self, name)}, must be >= 0")


class Geometry(NamedTuple):
    """Of the routes, as `motion_kernels.drive` takes it."""

    nearest: NDArray[np.int32]
    cell_metres: float
    centres: NDArray[np.float64]
    aims: NDArray[np.int32]
    goals: NDArray[np.int32]
    waypoints: NDArray[np.float64]


class Contacts(NamedTuple):
    """When sampled paths come by the candidates' waypoints."""

    distances: NDArray[np.float64]
    """``[W, S]`` metres from every cell to every waypoint."""
    first: NDArray[np.float64]
    """``[m, K]`` first tick within meeting distance, inf if never."""
    last: NDArray[np.float64]
    """``[m, K]`` last such tick, -1 if never."""


class PursuitData(NamedTuple):
    """What the generative model reads."""

    paths: NDArray[np.float64]
    """``[K, H + 1, 2]`` metres."""
    completed: NDArray[np.int32]
    """``[K]``."""
    cameras: NDArray[np.float64]
    """``[C, 3]``: x, y, radius in metres."""
    geometry: Geometry
    robot: tuple[float, float, float, float]
    """Top speed, top turn rate, seconds of a control step, control steps per tick."""
    prices: tuple[float, float, float, float]
    """Interception, per tick, per effort, mission completed."""
    candidates: NDArray[np.int64]
    """``[m]`` routes."""
    open_loop: NDArray[np.float32]
    """``[m, K]`` return of each candidate against each path."""
    baseline: NDArray[np.float64]
    """``[m]`` their means."""
    search: tuple[float, float, float, float, float, float, float, float, float]
    """Meeting radius, square, closing per tick, ticks of a macro-action, pseudo-counts of any route and of keeping on,
    distance of paths that look alike, switches in a rollout, what a switch must gain."""
    contacts: Contacts


@dataclass(frozen=True, eq=False)
class Decision:
    """The route to take, and why."""

    route: int
    """A waypoint's number, or `RouteMap.stay`."""
    values: RouteValues
    """Of every route, driven and waited at."""
    candidates: NDArray[np.int64]
    """``[m]`` routes that the tree chose among."""
    plan: Plan | None
    """None without a tree; its action a is route ``candidates[a]``."""


def pursuit_model(
    routes: RouteMap,
    pose: Pose,
    sampled: SampledPaths,
    values: RouteValues,
    candidates: NDArray[np.int64],
    options: PursuitOptions,
) -> CompiledModel:
    """The pursuit from a pose on, over these candidate routes."""
    scenario, step = routes.scenario, routes.scenario.step_seconds
    paths = np.ascontiguousarray(sampled.positions, dtype=np.float64)
    closing = interception_kernels.largest_step(paths) + scenario.ego.max_speed * step + 1e-6
    open_loop = np.ascontiguousarray(values.returns[candidates])
    radius = scenario.interception_metres * options.radius_share
    completed = np.ascontiguousarray(sampled.completed_tick, dtype=np.int32)
    points = np.concatenate([routes.waypoints, [pose[:2]]])[candidates]
    first, last = np.empty((2, len(candidates), len(paths)))
    pursuit_kernels.contacts(paths, completed, points, radius, first, last)
    data = PursuitData(
        paths,
        completed,
        np.array([(c.x, c.y, c.camera_metres) for c in scenario.checkpoints], dtype=np.float64).reshape(-1, 3),
        Geometry(
            routes.nearest, routes.grid.cell_metres, routes.grid.centres, routes.aims, routes.goals, routes.waypoints
        ),
        (
            scenario.ego.max_speed, scenario.ego.max_turn_rate, 1.0 / scenario.control_hertz,
            float(routes.control_steps_per_tick),
        ),
        (
            scenario.rewards.interception, scenario.rewards.per_step, scenario.rewards.control,
            scenario.rewards.mission_completed,
        ),
        candidates,
        open_loop,
        open_loop.mean(axis=1, dtype=np.float64),
        (
            radius, options.square_metres, closing, float(max(1, round(options.macro_seconds / step))),
            float(options.node_count), float(options.keep_count), options.alike_metres, float(options.switches),
            options.switch_bonus,
        ),
        Contacts(routes.distances, first, last),
    )  # fmt: skip
    return CompiledModel(
        pursuit_kernels.step, len(candidates), 5, data, rollout=pursuit_kernels.rollout, prior=pursuit_kernels.prior
    )


def choose_candidates(
    returns: NDArray[np.float32], mean: NDArray[np.float64], count: int, current: int | None
) -> NDArray[np.int64]:
    """``[count]`` routes, the best first: half of them best on average, half each best for paths that the others miss."""
    chosen = list(np.argsort(-mean, kind="stable")[: (count + 1) // 2])
    if current is not None and current not in chosen:
        chosen.append(current)
    covered = returns[chosen].max(axis=0)
    while len(chosen) < count:
        gain = np.maximum(returns, covered).sum(axis=1, dtype=np.float64)
        gain[chosen] = -np.inf
        chosen.append(int(np.argmax(gain)))
        covered = np.maximum(covered, returns[chosen[-1]])
    return np.array(chosen[:count], dtype=np.int64)


def decide(
    routes: RouteMap,
    pose: Pose,
    sampled: SampledPaths,
    current: int | None,
    options: PursuitOptions,
    rng: np.random.Generator,
) -> Decision:
    """Choose a route from (x, y, theta) against sampled adversary paths; `current` is the one being driven."""
    scenario = routes.scenario
    table = routes.table(pose, sampled.positions.shape[1] - 1)
    radius = scenario.interception_metres * options.radius_share
    values = value_routes(table, sampled.positions, sampled.completed_tick, scenario.rewards, radius)
    mean = values.mean
    if current is not None:
        mean[current] += options.keep_bonus
    best = choose_candidates(values.returns, mean, min(options.candidates, len(mean)), current)
    count = len(best)
    if options.method == "routes" or count == 1:
        return Decision(int(best[0]), values, best, None)
    model = pursuit_model(routes, pose, sampled, values, best, options)
    macro = max(1, round(options.macro_seconds / scenario.step_seconds))
    search = PomcpOptions(
        simulations=options.simulations,
        exploration=options.exploration,
        discount=1.0,
        max_depth=sampled.positions.shape[1] + 1,
        tree_depth=min(int(options.tree_seconds / scenario.step_seconds / macro), sampled.positions.shape[1]),
    )
    states = np.zeros((len(sampled.positions), 5))
    states[:, 0] = np.arange(len(states))
    states[:, 2:] = pose
    plan = Pomcp(model, search).plan(
        states, rng, prior_values=values.mean[best], prior_counts=np.full(count, options.root_count)
    )
    bonus = np.where(best == current, options.keep_bonus, 0.0) if current is not None else np.zeros(count)
    return Decision(int(best[int(np.argmax(plan.values + bonus))]), values, best, plan)
