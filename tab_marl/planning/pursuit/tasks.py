"""What itineraries are worth for the ego's task, by the scenario's rewards alone: intercepting the adversary, getting
somewhere without meeting it, or watching it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from tab_marl.planning.models.interface import SampledPaths
from tab_marl.planning.models.sight import Sight
from tab_marl.planning.pursuit import task_kernels
from tab_marl.planning.pursuit.interception import RouteValues, value_routes
from tab_marl.planning.pursuit.routes import Itinerary, RouteMap, RouteTable
from tab_marl.world.scenario import Rewards, Scenario

NEAR_METRES, FAR_METRES = 0.2, 1.8
"""How far off the first leg of a detour may lead, in avoidance and surveillance."""


def weighed(rewards: Rewards, completion_weight: float) -> Rewards:
    """The rewards that are planned with."""
    return replace(rewards, mission_completed=completion_weight * rewards.mission_completed)


def value_itineraries(
    table: RouteTable, sampled: SampledPaths, scenario: Scenario, rewards: Rewards, meeting_metres: float
) -> RouteValues:
    """The return of each itinerary of the table against each sampled path, in the scenario's ego task.

    `met` is when the robots meet or, in surveillance, when the adversary is first watched.
    """
    if scenario.ego_task == "interception":
        return value_routes(table, sampled.positions, sampled.completed_tick, rewards, meeting_metres)
    paths = np.ascontiguousarray(sampled.positions, dtype=np.float64)
    returns, met = np.empty((2, len(table.positions), len(paths)), dtype=np.float32)
    if scenario.ego_task == "avoidance":
        task_kernels.avoidance_returns(
            table.positions, table.effort, arrivals(table, scenario), paths, meeting_metres,
            rewards.encounter, rewards.per_step, rewards.control, rewards.arrival, returns, met,
        )  # fmt: skip
    else:
        sight = Sight.of(scenario)
        task_kernels.watch_returns(
            table.positions, table.effort, paths, sight.open_squares, sight.square_metres, scenario.watch_metres,
            rewards.per_step, rewards.control, rewards.watched * scenario.step_seconds, returns, met,
        )  # fmt: skip
    return RouteValues(returns, met)


def arrivals(table: RouteTable, scenario: Scenario) -> NDArray[np.int64]:
    """``[I]``: the tick at which each itinerary is in the ego's goal, or -1."""
    goal = scenario.ego_goal
    if goal is None:
        return np.full(len(table.positions), -1, dtype=np.int64)
    inside = np.asarray(goal.contains(table.positions))
    return np.where(inside.any(axis=1), inside.argmax(axis=1), -1)


def driven_detours(
    routes: RouteMap,
    pose: tuple[float, float, float],
    rows: NDArray[np.int64],
    values: RouteValues,
    few: SampledPaths,
    rewards: Rewards,
    meeting_metres: float,
    switch: Sequence[int],
    firsts: int,
    ends: int,
    most: int,
) -> list[Itinerary]:
    """Detours that promise more than the plain routes `rows`, at most so many: some way off or a while here, then one of the
    best routes. Each is driven and valued against a few of the sampled paths.
    """
    ticks = few.positions.shape[1] - 1
    count = len(few.positions)
    mean = values.returns[:, :count].mean(axis=1, dtype=np.float64)
    last = rows[np.argsort(-mean, kind="stable")[:ends]]
    far = routes.distances[:, routes.grid.cells_of([pose[:2]])[0]]
    near = np.flatnonzero((far >= NEAR_METRES) & (far <= FAR_METRES))
    near = near[np.argsort(far[near], kind="stable")]
    spread = near[np.unique(np.linspace(0, len(near) - 1, max(0, firsts - 1)).astype(int))] if len(near) else near
    tried = [Itinerary(int(f), int(n), int(e)) for f in (routes.stay, *spread) for n in switch for e in last if f != e]
    if not tried:
        return []
    table = routes.itinerary_table(pose, ticks, tried)
    found = value_itineraries(table, few, routes.scenario, rewards, meeting_metres).mean
    order = np.argsort(-found, kind="stable")[:most]
    return [tried[i] for i in order if found[i] > mean.max()]
