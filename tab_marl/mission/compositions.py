"""Missions composed of what M1 to M5 are made of, in ways that are none of them: what a policy has not trained on.

=============  ======================================================================================================
composition    mission, with deadlines that fit a random map
=============  ======================================================================================================
chain          A, then B, then C, each within a gap of the last
return         A, then back to B within T, out of the central zone
detour         A, then B within T, out of a third checkpoint's disc
trap           not at B before A was visited; then B within T
two of four    two different ones of four checkpoints, then a target within T
errand exact   A within T, then B about S seconds after that, out of the central zone
slow           A, then B within T at a speed limit
all slow       A within T, a speed limit throughout
=============  ======================================================================================================

The last place may also be any of two.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import product

import numpy as np
from numpy.typing import NDArray

from tab_marl.mission.feasibility import check_feasible
from tab_marl.mission.impossible import InfeasibleMission
from tab_marl.mission.model import Constraint, ConstraintType, Mission, Place
from tab_marl.mission.tasks import (
    FAR_METRES,
    MAPS,
    PURSUIT_SECONDS,
    SLACK_RANGE,
    START_RADIUS_METRES,
    TURN_SECONDS,
    Task,
    Travel,
    draw_ego_start,
    half_seconds,
)
from tab_marl.world.grid import GridMap
from tab_marl.world.regions import Region
from tab_marl.world.sampling import PLANNING_CELL_METRES, MapOptions, sample_disc, sample_scenario
from tab_marl.world.scenario import Scenario, UnknownName

COMPOSITIONS = ("chain", "return", "detour", "trap", "two of four", "errand exact", "slow", "all slow")
SAMPLED = "sampled"
"""Mission id of these tasks."""
LIMIT_SHARE = (0.5, 0.8)
"""Of the adversary's top speed: range of speed limits."""
TWO_ENDS = 0.4
"""Probability that the last place is any of two."""

_EVENTUALLY, _DEADLINE, _EXACT = ConstraintType.EVENTUALLY, ConstraintType.DEADLINE, ConstraintType.EXACT


@dataclass(frozen=True)
class _Plan:
    """A composition before its times are known."""

    legs: tuple[tuple[Place, ...], ...]
    """Per stage in order of travel: the places of which one will do."""
    avoided: tuple[Region, ...] = ()
    start_clear_of: tuple[Region, ...] = ()
    limits: tuple[float, ...] = ()
    """Speed limit per leg, inf where there is none."""


def sample_composition(
    rng: np.random.Generator,
    composition: str | None = None,
    slack: float | None = None,
    options: MapOptions | None = None,
) -> Task:
    """Draw a task of a composition by name (None: any), slack from SLACK_RANGE unless given.

    Starts are fair as `sample_task`'s are. The task's family is "point", or "ambiguous" where the last place is any of
    two; its mission has the composition's name. Raises UnknownName; RuntimeError if no map allows it.
    """
    if composition is not None and composition not in COMPOSITIONS:
        raise UnknownName("composition", composition, COMPOSITIONS)
    if slack is not None and not slack > 1:
        raise ValueError(f"slack is {slack}, must be > 1 (allowed time / shortest time)")
    name = COMPOSITIONS[int(rng.integers(len(COMPOSITIONS)))] if composition is None else composition
    for _ in range(MAPS):
        drawn = float(rng.uniform(*SLACK_RANGE)) if slack is None else slack
        task = _attempt(rng, sample_scenario(rng, options, name=name.replace(" ", "-")), name, drawn)
        if task is not None:
            return task
    raise RuntimeError(f"no winnable {name} task with slack {slack} found on {MAPS} maps")


def _attempt(rng: np.random.Generator, scenario: Scenario, name: str, slack: float) -> Task | None:
    plan = _plan(rng, scenario, name)
    if plan is None:
        return None
    grid = GridMap.from_scenario(scenario, PLANNING_CELL_METRES)
    travel = Travel(scenario, grid, plan.avoided)
    first = [scenario.place(place) for place in plan.legs[0]]
    clear = scenario.adversary.radius_metres + START_RADIUS_METRES

    def far(points: NDArray[np.float64]) -> NDArray[np.bool_]:
        ok = np.min([region.distance(points) for region in first], axis=0) >= FAR_METRES
        for region in (*plan.avoided, *plan.start_clear_of):
            ok &= region.distance(points) >= clear
        return np.asarray(ok)

    start = sample_disc(rng, grid, START_RADIUS_METRES, far)
    if start is None:
        return None
    # Of several orders of the same visits only the farthest counts, so that every one can be done in time.
    orders = [order for order in product(*plan.legs) if len(set(order)) == len(order)]
    ways = [travel.walk(start.centre, order) for order in orders]
    if not ways or not all(math.isfinite(way.seconds) for way in ways):
        return None
    legs = np.array([way.leg_seconds for way in ways])
    top = scenario.adversary.max_speed
    slowed = np.array([max(1.0, top / limit) for limit in plan.limits]) if plan.limits else 1.0
    legs = TURN_SECONDS + (legs - TURN_SECONDS) * slowed
    mission, horizon = _mission(name, plan, legs, slack, scenario)
    meets = np.all([travel.ego_meets(way.path) for way in ways], axis=0)
    ego = draw_ego_start(rng, grid, meets, start, FAR_METRES)
    if ego is None:
        return None
    scenario = replace(scenario, ego_start=ego, adversary_start=start, horizon_seconds=horizon)
    try:
        check_feasible(mission, scenario)
    except InfeasibleMission:
        return None
    family = "ambiguous" if len(plan.legs[-1]) > 1 else "point"
    return Task(scenario, mission, SAMPLED, family, round(slack, 3))


def _plan(rng: np.random.Generator, scenario: Scenario, name: str) -> _Plan | None:
    """Places of the composition on this map, None if they do not fit. Uses checkpoints clear of what is avoided."""
    centre = scenario.region("central zone")
    names = [scenario.checkpoints[i].name for i in rng.permutation(len(scenario.checkpoints))]
    two, share = rng.random() < TWO_ENDS, float(rng.uniform(*LIMIT_SHARE))
    limit = round(share * scenario.adversary.max_speed, 2)
    if len(names) < 5:
        return None
    a, b, c, d = names[:4]
    if name == "chain":
        return _Plan(((a,), (b,), (c, d) if two else (c,)))
    if name in ("return", "errand exact"):
        if any(_overlap(scenario, centre, place) for place in (a, b, c)):
            return None
        return _Plan(((a,), (b, c) if two else (b,)), (centre,))
    if name == "detour":
        return _Plan(((a,), (b, c) if two else (b,)), (scenario.region(d),))
    if name == "trap":
        return _Plan(((a,), (b,)), start_clear_of=(scenario.region(b),))
    if name == "two of four":
        return _Plan(((a, b, c, d), (a, b, c, d), (names[4],)))
    if name == "slow":
        return _Plan(((a,), (b, c) if two else (b,)), limits=(math.inf, limit))
    return _Plan(((a, b) if two else (a,),), limits=(limit,))


def _overlap(scenario: Scenario, region: Region, name: str) -> bool:
    checkpoint = next(c for c in scenario.checkpoints if c.name == name)
    return float(region.distance([[checkpoint.x, checkpoint.y]])[0]) < checkpoint.radius_metres


def _mission(
    name: str, plan: _Plan, legs: NDArray[np.float64], slack: float, scenario: Scenario
) -> tuple[Mission, float]:
    """The mission with its deadlines, and the episode's horizon. `legs` ``[ways, stages]`` seconds."""
    allowed = half_seconds(slack * float(legs.sum(axis=1).max()))
    places, beside = plan.legs, _avoid(plan, scenario)
    end = allowed
    goals: Sequence[Constraint]
    if name == "chain":
        gap = half_seconds(slack * float(legs.max()))
        goals, end = [Constraint(_EVENTUALLY, leg, max_gap_seconds=gap) for leg in places], len(places) * gap
    elif name == "two of four":
        gap = half_seconds(slack * float(legs.max()))
        goals = [
            Constraint(_EVENTUALLY, places[0], different=2, max_gap_seconds=gap),
            Constraint(_DEADLINE, places[-1], seconds=3 * gap),
        ]
        end = 3 * gap
    elif name == "errand exact":
        errand = half_seconds(slack * float(legs[:, 0].max()))
        about = half_seconds(slack * float(legs[:, 1].max()))
        goals = [
            Constraint(_DEADLINE, places[0], seconds=errand),
            Constraint(_EXACT, places[1], seconds=about, since="previous"),
        ]
        end = errand + about + max(scenario.exact_seconds, scenario.exact_fraction * about)
    elif name == "all slow":
        goals = [Constraint(_DEADLINE, places[0], seconds=allowed)]
        beside = [Constraint(ConstraintType.ALWAYS, speed_limit=plan.limits[0])]
    else:
        limit = plan.limits[1] if name == "slow" else None
        goals = [
            Constraint(_EVENTUALLY, places[0]),
            Constraint(_DEADLINE, places[1], seconds=allowed, speed_limit=limit),
        ]
        if name == "trap":
            beside = [Constraint(ConstraintType.UNTIL, places[1], avoid=True, until_goal=0)]
    return Mission((*goals, *beside), name), half_seconds(end + PURSUIT_SECONDS)


def _avoid(plan: _Plan, scenario: Scenario) -> list[Constraint]:
    found = []
    for region in plan.avoided:
        name = "central zone" if region == scenario.region("central zone") else _checkpoint_of(scenario, region)
        found.append(Constraint(ConstraintType.ALWAYS, (name,), avoid=True))
    return found


def _checkpoint_of(scenario: Scenario, region: Region) -> str:
    return next(c.name for c in scenario.checkpoints if scenario.region(c.name) == region)
