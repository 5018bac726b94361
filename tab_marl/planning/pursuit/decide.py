"""What the ego does next: itineraries valued against sampled adversary paths, refined by POMCP over changes of mind.

One planner for all adversary models. `routes` takes the itinerary of best value; `tree` searches over changing it later,
depending on what cameras will have seen, and starts from those values.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from tab_marl.planning.model import CompiledModel
from tab_marl.planning.models.interface import SampledPaths
from tab_marl.planning.pursuit import decide_kernels, interception_kernels
from tab_marl.planning.pursuit.interception import RouteValues
from tab_marl.planning.pursuit.itineraries import Geometry, Pose, PursuitOptions, geometry_of, shortlist
from tab_marl.planning.pursuit.routes import Itinerary, RouteMap
from tab_marl.planning.pursuit.tasks import weighed
from tab_marl.planning.search.pomcp import Plan, Pomcp, PomcpOptions
from tab_marl.world.scenario import Scenario

TRIED_SHARE = 0.3
"""An itinerary is taken only if the search tried it at least this often, relative to the one it tried most."""

__all__ = ["Decision", "PursuitOptions", "decide", "pursuit_model"]


class Contacts(NamedTuple):
    """When sampled paths come by the candidates' waypoints."""

    distances: NDArray[np.float64]
    """``[W, S]`` metres from every cell to every waypoint."""
    first: NDArray[np.float64]
    """``[K, 2 m]`` first tick within meeting distance of the waypoints of first, then of second legs; inf if never."""
    last: NDArray[np.float64]
    """``[K, 2 m]`` last such tick, -1 if never."""


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
    itineraries: tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]]
    """``[m]`` each: first route, switch tick, second route."""
    open_loop: NDArray[np.float32]
    """``[m, K]`` return of each itinerary against each path."""
    baseline: NDArray[np.float64]
    """``[m]`` their means."""
    search: tuple[float, float, float, float, float, float, float, float, float, float]
    """Meeting radius, square, closing per tick, ticks of a macro-action, pseudo-counts of any route and of keeping on,
    distance of paths that look alike, switches in a rollout, what a switch must gain, 1 to branch on sightings."""
    contacts: Contacts
    driven: NDArray[np.float64]
    """``[m, T + 1, 5]`` of each itinerary from the present pose: x, y, theta, effort so far, 1 once it stands for good."""


@dataclass(frozen=True, eq=False)
class Decision:
    """The itinerary to follow, and why."""

    itinerary: Itinerary
    candidates: tuple[Itinerary, ...]
    """The best ones, which the tree chose among."""
    values: RouteValues
    """Of the candidates, followed without a change of mind."""
    plan: Plan | None
    """None without a tree; its action a is ``candidates[a]``."""
    valuation_seconds: float = 0.0
    """Processor time that valuing itineraries took."""
    search_seconds: float = 0.0
    """Processor time that the tree took."""

    @property
    def route(self) -> int:
        """The route to drive until the next decision: a waypoint's number, or `RouteMap.stay`."""
        return self.itinerary.now


def pursuit_model(
    routes: RouteMap,
    pose: Pose,
    sampled: SampledPaths,
    values: RouteValues,
    candidates: Sequence[Itinerary],
    options: PursuitOptions,
) -> CompiledModel:
    """The pursuit from a pose on, over these itineraries, worth `values` when followed without a change of mind."""
    scenario, step = routes.scenario, routes.scenario.step_seconds
    rewards = weighed(scenario.rewards, options.completion_weight)
    paths = np.ascontiguousarray(sampled.positions, dtype=np.float64)
    closing = interception_kernels.largest_step(paths) + scenario.ego.max_speed * step + 1e-6
    radius = scenario.interception_metres * options.radius_share
    completed = np.ascontiguousarray(sampled.completed_tick, dtype=np.int32)
    first, switch, second = np.array(candidates, dtype=np.int64).T.copy()
    points = np.concatenate([routes.waypoints, [pose[:2]]])[np.concatenate([first, second])]
    contacts = Contacts(routes.distances, *np.empty((2, len(paths), len(points))))
    decide_kernels.contacts(paths, completed, points, radius, contacts.first, contacts.last)
    robot = (
        scenario.ego.max_speed, scenario.ego.max_turn_rate, 1.0 / scenario.control_hertz,
        float(routes.control_steps_per_tick),
    )  # fmt: skip
    driven = np.empty((len(first), paths.shape[1], 5))
    decide_kernels.tracks(*pose, (first, switch, second), geometry_of(routes), robot, driven)
    data = PursuitData(
        paths,
        completed,
        np.array([(c.x, c.y, c.camera_metres) for c in scenario.checkpoints], dtype=np.float64).reshape(-1, 3),
        geometry_of(routes),
        robot,
        (
            rewards.interception, rewards.per_step, rewards.control, rewards.mission_completed,
        ),
        (first, switch, second),
        np.ascontiguousarray(values.returns),
        values.mean,
        (
            radius, options.square_metres, closing, float(max(1, round(options.macro_seconds / step))),
            float(options.node_count), float(options.keep_count), options.alike_metres, float(options.switches),
            options.switch_bonus, float(options.branch_on_sightings),
        ),
        contacts,
        driven,
    )  # fmt: skip
    return CompiledModel(
        decide_kernels.step, len(first), 6, data, rollout=decide_kernels.rollout, prior=decide_kernels.prior
    )


def decide(
    routes: RouteMap,
    pose: Pose,
    sampled: SampledPaths,
    current: Itinerary | None,
    options: PursuitOptions,
    rng: np.random.Generator,
) -> Decision:
    """Choose from (x, y, theta) against sampled adversary paths; `current` is what is being followed, seen from now.

    The tree is about interception: in the other ego tasks the itinerary of best value is taken, at every decision anew.
    """
    began = time.thread_time()
    found = shortlist(routes, pose, sampled, current, options)
    valued = time.thread_time()
    if options.method == "routes" or routes.scenario.ego_task != "interception":
        best = int(np.argmax(found.values.mean + found.bonus))
        return Decision(found.itineraries[best], found.itineraries, found.values, None, valued - began)
    model = pursuit_model(routes, pose, sampled, found.values, found.itineraries, options)
    plan = _search(model, pose, found.values, options, routes.scenario, rng)
    # A value met by few simulations is luck: the search tries what it holds good often.
    tried = plan.visits >= TRIED_SHARE * plan.visits.max()
    best = int(np.argmax(np.where(tried, plan.values + found.bonus, -np.inf)))
    searched = time.thread_time()
    return Decision(found.itineraries[best], found.itineraries, found.values, plan, valued - began, searched - valued)


def _search(
    model: CompiledModel,
    pose: Pose,
    values: RouteValues,
    options: PursuitOptions,
    scenario: Scenario,
    rng: np.random.Generator,
) -> Plan:
    """POMCP from the present pose, starting from the itineraries' values."""
    ticks, scenarios = model.data.paths.shape[1], len(model.data.paths)
    macro = max(1, round(options.macro_seconds / scenario.step_seconds))
    search = PomcpOptions(
        simulations=options.simulations,
        exploration=options.exploration,
        discount=1.0,
        max_depth=ticks + 1,
        tree_depth=min(int(options.tree_seconds / scenario.step_seconds / macro), ticks),
    )
    states = np.zeros((scenarios, 6))
    states[:, 0] = np.arange(scenarios)
    states[:, 2:5] = pose
    counts = np.full(model.actions, options.root_count)
    return Pomcp(model, search).plan(states, rng, prior_values=values.mean, prior_counts=counts)
