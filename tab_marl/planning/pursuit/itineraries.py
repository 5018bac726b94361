"""Itineraries worth considering: plain routes, and detours that leave in time for the place to be at.

"Drive to w and wait" undervalues looking around: a place that must be held only later can be left until then. Detours are
two legs, a route and the tick at which to change to another one.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from tab_marl.planning.models.interface import SampledPaths
from tab_marl.planning.pursuit import interception_kernels
from tab_marl.planning.pursuit.decide_kernels import TURN_TICKS
from tab_marl.planning.pursuit.interception import RouteValues
from tab_marl.planning.pursuit.routes import Itinerary, RouteMap, RouteTable
from tab_marl.planning.pursuit.tasks import driven_detours, value_itineraries, weighed

Pose = tuple[float, float, float]


@dataclass(frozen=True)
class PursuitOptions:
    """How to search; the same for every adversary model."""

    method: Literal["tree", "routes"] = "tree"
    """`routes`: take the best itinerary as it is, without a tree."""
    paths: int = 400
    """K sampled adversary paths a decision."""
    horizon_seconds: float = 40.0
    """How far ahead paths are sampled, at most (they end with the episode)."""
    screening_paths: int = 100
    """Of these, so many decide which plain routes are looked at more closely."""
    screened: int = 40
    """How many those are."""
    detours: int = 24
    """Waypoints tried as the first leg of a detour; 0: plain routes only."""
    detour_ends: int = 2
    """Routes tried as its second leg."""
    detour_seconds: tuple[float, ...] = (2.0, 4.0, 6.0, 9.0, 13.0, 18.0, 25.0)
    """Times tried for changing from the one to the other."""
    detour_paths: int = 80
    """Sampled paths against which detours are screened."""
    candidates: int = 12
    """The best itineraries, which the tree may choose among, now and later."""
    simulations: int = 300
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
    branch_on_sightings: bool = False
    """Whether the tree goes on below a sighting (else a rollout answers it)."""
    square_metres: float = 0.4
    """If it does, a sighting is told by the square of this size in which it is."""
    switches: int = 3
    """In a rollout the route is changed at most so often, when a camera sees the adversary; 0: never."""
    alike_metres: float = 0.4
    """Sampled paths this near to a sighting tell what the sighting means."""
    switch_bonus: float = 2.0
    """By how much another route must look better before a rollout leaves its own."""
    completion_weight: float = 3.0
    """How many times its price a completed mission costs while planning; above 1 the ego gambles less on early meetings."""
    keep_bonus: float = 0.5
    """By how much another route must be better before the present one is left."""
    radius_share: float = 1.0
    """Paths are met at this share of the interception distance: below 1 asks for a margin."""

    @classmethod
    def for_milliseconds(cls, milliseconds: float, **changes: Any) -> PursuitOptions:
        """The options whose decisions take about so long on one core (2026), the belief's update of about 1 ms included.

        Work is set, not time: the same seed gives the same decision on every machine, and missions differ (50 ms takes
        TAB-POMCP with its field alone 31 to 66, docs/studies/planner.md). `EFFORT` lists the steps; the dearest that fits is taken, the
        cheapest if none does.
        """
        fitting = [effort for effort in EFFORT if effort.milliseconds <= milliseconds] or [EFFORT[0]]
        chosen = {name: value for name, value in fitting[-1]._asdict().items() if name != "milliseconds"}
        return cls(**(chosen | changes))

    def __post_init__(self) -> None:
        if self.method not in ("tree", "routes"):
            raise ValueError(f"PursuitOptions.method is {self.method!r}, must be 'tree' or 'routes'")
        for name in (
            "paths",
            "candidates",
            "simulations",
            "root_count",
            "node_count",
            "detour_paths",
            "screened",
            "screening_paths",
        ):
            if getattr(self, name) < 1:
                raise ValueError(f"PursuitOptions.{name} is {getattr(self, name)}, must be >= 1")
        for name in ("horizon_seconds", "macro_seconds", "square_metres", "radius_share", "alike_metres"):
            if not getattr(self, name) > 0:
                raise ValueError(f"PursuitOptions.{name} is {getattr(self, name)}, must be > 0")
        for name in (
            "exploration",
            "keep_bonus",
            "completion_weight",
            "keep_count",
            "detours",
            "detour_ends",
            "tree_seconds",
            "switches",
            "switch_bonus",
        ):
            if not getattr(self, name) >= 0:
                raise ValueError(f"PursuitOptions.{name} is {getattr(self, name)}, must be >= 0")


class Effort(NamedTuple):
    """How much of everything a decision of so many milliseconds can afford."""

    milliseconds: float
    paths: int
    screening_paths: int
    screened: int
    detours: int
    detour_paths: int
    candidates: int
    simulations: int


EFFORT = (
    Effort(2, 20, 20, 12, 0, 1, 4, 10),
    Effort(5, 60, 30, 16, 6, 30, 6, 40),
    Effort(10, 200, 60, 30, 12, 60, 8, 150),
    Effort(20, 400, 100, 40, 24, 80, 12, 300),
    Effort(50, 800, 150, 60, 32, 150, 12, 1000),
    Effort(200, 2000, 300, 90, 48, 300, 16, 5000),
    Effort(1000, 4000, 500, 200, 64, 500, 16, 40000),
)
"""What `PursuitOptions.for_milliseconds` chooses from."""


class Geometry(NamedTuple):
    """Of the routes, as `motion_kernels.drive` takes it."""

    nearest: NDArray[np.int32]
    cell_metres: float
    centres: NDArray[np.float64]
    aims: NDArray[np.int32]
    goals: NDArray[np.int32]
    waypoints: NDArray[np.float64]


def geometry_of(routes: RouteMap) -> Geometry:
    return Geometry(
        routes.nearest, routes.grid.cell_metres, routes.grid.centres, routes.aims, routes.goals, routes.waypoints
    )  # fmt: skip


class Shortlist(NamedTuple):
    """Itineraries worth a closer look, the best on average first."""

    itineraries: tuple[Itinerary, ...]
    values: RouteValues
    """Of each, when followed without a change of mind."""
    bonus: NDArray[np.float64]
    """Added when they are compared: `PursuitOptions.keep_bonus` for the one being followed."""


def shortlist(
    routes: RouteMap, pose: Pose, sampled: SampledPaths, current: Itinerary | None, options: PursuitOptions
) -> Shortlist:
    """The best itineraries from (x, y, theta) against sampled paths; `current` (as seen from now) is always among them."""
    scenario, ticks = routes.scenario, sampled.positions.shape[1] - 1
    rewards = weighed(scenario.rewards, options.completion_weight)
    radius = scenario.interception_metres * options.radius_share

    def value(table: RouteTable, paths: SampledPaths) -> RouteValues:
        return value_itineraries(table, paths, scenario, rewards, radius)

    table = routes.table(pose, ticks)
    rows = np.arange(routes.stay + 1)
    if len(sampled.positions) > options.screening_paths and len(rows) > options.screened:
        rough = value(table, first_paths(sampled, options.screening_paths))
        rows = np.array(covering(rough.returns, rough.mean, options.screened))
    plain = value(RouteTable(table.positions[rows], table.effort[rows]), sampled)
    if scenario.ego_task == "interception":
        itineraries = best_detours(routes, table, rows, plain, sampled, options)
    else:
        few = first_paths(sampled, options.detour_paths)
        firsts, ends = options.detours, options.detour_ends if options.detours else 0
        switch = [n for n in (round(s / scenario.step_seconds) for s in options.detour_seconds) if 0 < n < ticks]
        itineraries = driven_detours(
            routes, pose, rows, plain, few, rewards, radius, switch, firsts, ends, options.candidates
        )
    if current is not None:
        itineraries.insert(0, current)
    found = plain
    if itineraries:
        found = value(routes.itinerary_table(pose, ticks, itineraries), sampled)
        found = RouteValues(np.concatenate([found.returns, plain.returns]), np.concatenate([found.met, plain.met]))
    bonus = np.zeros(len(found.returns))
    kept = []
    if current is not None:
        bonus[0], kept = options.keep_bonus, [0]
    itineraries += [Itinerary.plain(int(route)) for route in rows]
    chosen = covering(found.returns, found.mean + bonus, options.candidates, kept)
    values = RouteValues(found.returns[chosen], found.met[chosen])
    return Shortlist(tuple(itineraries[i] for i in chosen), values, bonus[chosen])


def first_paths(sampled: SampledPaths, count: int) -> SampledPaths:
    """The first `count` of the sampled paths (they are exchangeable)."""
    return SampledPaths(sampled.positions[:count], sampled.completed_tick[:count])


def covering(
    returns: NDArray[np.float32], mean: NDArray[np.float64], count: int, kept: Sequence[int] = ()
) -> list[int]:
    """`count` rows of `returns` ``[I, K]``: half of them best on average, half each best for paths that the others miss."""
    chosen = [int(i) for i in np.argsort(-mean, kind="stable")[: (count + 1) // 2]]
    chosen += [i for i in kept if i not in chosen]
    covered = returns[chosen].max(axis=0)
    while len(chosen) < min(count, len(returns)):
        gain = np.maximum(returns, covered).sum(axis=1, dtype=np.float64)
        gain[chosen] = -np.inf
        chosen.append(int(np.argmax(gain)))
        covered = np.maximum(covered, returns[chosen[-1]])
    return chosen


def best_detours(
    routes: RouteMap,
    table: RouteTable,
    rows: NDArray[np.int64],
    values: RouteValues,
    sampled: SampledPaths,
    options: PursuitOptions,
) -> list[Itinerary]:
    """The detours that promise most, at most `candidates`. `values` are those of the plain routes `rows`.

    Ends are the route that meets most paths and the best on average; first legs are those that together with an end
    could do best if it were known which of the two to take.
    """
    scenario, ticks = routes.scenario, table.positions.shape[1] - 1
    switch = np.array([round(s / scenario.step_seconds) for s in options.detour_seconds], dtype=np.int64)
    switch = switch[(switch > 0) & (switch < ticks)]
    moving = np.flatnonzero(rows != routes.stay)
    if options.detours == 0 or options.detour_ends == 0 or len(switch) == 0 or len(moving) == 0:
        return []
    few = first_paths(sampled, options.detour_paths)
    returns, met = values.returns[:, : options.detour_paths], values.met[:, : options.detour_paths]
    mean = values.mean
    surest = moving[np.argsort(-values.met_share[moving] - 1e-6 * mean[moving], kind="stable")]
    best = moving[np.argsort(-mean[moving], kind="stable")]
    ends = np.array(list(dict.fromkeys([*surest[:1], *best]))[: options.detour_ends], dtype=np.int64)
    hope = np.max([np.maximum(returns, returns[e]).mean(axis=1) for e in ends], axis=0)
    first = np.argsort(-hope, kind="stable")[: options.detours].astype(np.int64)
    found = np.empty((len(first), len(switch), len(ends)))
    rewards = weighed(scenario.rewards, options.completion_weight)
    interception_kernels.detour_returns(
        table.positions[rows[first]], returns[first], met[first], few.positions, few.completed_tick, switch, rows[ends],
        *geometry_of(routes), TURN_TICKS, scenario.ego.max_speed * scenario.step_seconds,
        scenario.interception_metres * options.radius_share, rewards.interception, rewards.per_step,
        rewards.mission_completed, found,
    )  # fmt: skip
    # The best time and end for each first leg, and only where that beats the plain routes.
    flat = found.reshape(len(first), -1)
    when, where = np.divmod(flat.argmax(axis=1), len(ends))
    gain = flat.max(axis=1) - returns.mean(axis=1).max()
    order = np.argsort(-gain, kind="stable")[: options.candidates]
    return [
        Itinerary(int(rows[first[i]]), int(switch[when[i]]), int(rows[ends[where[i]]]))
        for i in order
        if gain[i] > 0 and first[i] != ends[where[i]]
    ]
