"""Detours and shortlists: a slow twin, and cases where going somewhere and coming back in time is known to be right."""

import itertools
import math

import numpy as np
import pytest

from tab_marl.planning.models.interface import SampledPaths, Sighting, TickObservation
from tab_marl.planning.pursuit import interception_kernels
from tab_marl.planning.pursuit.interception import value_routes
from tab_marl.planning.pursuit.interception_kernels import first_meeting, meeting_fraction
from tab_marl.planning.pursuit.itineraries import EFFORT, PursuitOptions, covering, geometry_of, shortlist
from tab_marl.planning.pursuit.routes import Itinerary, RouteMap
from tab_marl.planning.pursuit.scenarios import ReuseOptions, ScenarioSet
from tab_marl.world.scenario import Scenario

RNG = np.random.default_rng
OPEN = Scenario.preset("open")
MAP = RouteMap.build(OPEN)
LAB = Scenario.preset("lab")
LAB_MAP = RouteMap.build(LAB)


def test_an_itinerary_as_time_goes_by() -> None:
    plan = Itinerary(4, 3, 9)
    assert plan.now == 4
    assert plan.later(2) == Itinerary(4, 1, 9)
    assert plan.later(3) == Itinerary.plain(9) and plan.later(3).now == 9
    assert Itinerary.plain(5).later(10) == Itinerary.plain(5)


def test_a_driven_itinerary_is_two_routes_one_after_the_other() -> None:
    pose, ticks = (2.0, 2.7, -1.0), 50
    table = LAB_MAP.itinerary_table(pose, ticks, [Itinerary(8, 12, 40)])
    assert (table.positions[0, :13] == LAB_MAP.table(pose, ticks).positions[8, :13]).all()
    assert math.dist(table.positions[0, -1], LAB_MAP.waypoints[40]) < 0.02
    steps = np.hypot(*np.diff(table.positions[0], axis=0).T)
    assert steps.max() <= 0.11 + 1e-6


def walkers(count: int, ticks: int, seed: int) -> SampledPaths:
    rng = RNG(seed)
    heading = rng.uniform(-np.pi, np.pi, (count, 1)) + np.cumsum(rng.normal(0, 0.2, (count, ticks)), axis=1)
    start = rng.uniform(0.3, 2.7, (count, 1, 2))
    moves = np.cumsum(0.11 * np.stack([np.cos(heading), np.sin(heading)], axis=-1), axis=1)
    positions = np.clip(np.concatenate([start, start + moves], axis=1), 0.1, 2.9)
    return SampledPaths(
        positions, np.where(rng.random(count) < 0.7, rng.integers(3, ticks, count), -1).astype(np.int32)
    )


def test_detours_match_a_slow_twin_and_the_driven_itinerary() -> None:
    pose, ticks = (1.0, 1.0, 0.4), 40
    sampled = walkers(30, ticks, seed=1)
    table = MAP.table(pose, ticks)
    rows, switch, ends = np.array([3, 30, 60]), np.array([4, 12]), np.array([10, 50])
    values = value_routes(table, sampled.positions, sampled.completed_tick, OPEN.rewards, 0.3)
    found = np.empty((3, 2, 2))
    interception_kernels.detour_returns(
        table.positions[rows], values.returns[rows], values.met[rows], sampled.positions, sampled.completed_tick,
        switch, ends, *geometry_of(MAP), 2.0, 0.11, 0.3, 50.0, -1.0, -50.0, found,
    )  # fmt: skip
    for i, row in enumerate(rows):
        for n, start in enumerate(switch):
            for j, end in enumerate(ends):
                # In the open, the way to a waypoint is a straight line.
                here, goal = table.positions[row, start], MAP.waypoints[end]
                gone = np.clip(np.arange(ticks + 1) - start - 2, 0, None) * 0.11 / math.dist(here, goal)
                leg = here + np.minimum(gone, 1.0)[:, None] * (goal - here)
                total = 0.0
                for k in range(30):
                    ended = 0 <= sampled.completed_tick[k] <= ticks
                    last = int(sampled.completed_tick[k]) if ended else ticks
                    if 0 <= values.met[row, k] <= start or last <= start:
                        total += values.returns[row, k]
                        continue
                    at = next(
                        (
                            t + s
                            for t in range(start, last)
                            if (
                                s := meeting_fraction(
                                    *(leg[t] - sampled.positions[k, t]),
                                    *(leg[t + 1] - sampled.positions[k, t + 1]),
                                    0.3,
                                )
                            )
                            >= 0
                        ),
                        None,
                    )
                    total += (50 - at) if at is not None else -last - (50 if ended else 0)
                assert found[i, n, j] == pytest.approx(total / 30, abs=1e-3)
                driven = MAP.itinerary_table(pose, ticks, [Itinerary(int(row), int(start), int(end))])
                exact = value_routes(driven, sampled.positions, sampled.completed_tick, OPEN.rewards, 0.3)
                # Turning circles and effort cost a little, and may just lose or win one of the 30 meetings.
                assert exact.mean[0] == pytest.approx(found[i, n, j], abs=12.0)


def late_arrival(share_here: float) -> SampledPaths:
    """All reach the goal (2.5, 2.5) at tick 60; this share of them passes (0.5, 2.5) at tick 14 before."""
    goal, other, start = np.array((2.5, 2.5)), np.array((0.5, 2.5)), np.array((0.5, 0.9))
    t = np.arange(61)[:, None]
    up = np.where(t <= 14, start + t / 14 * (other - start), other + (t - 14) / 46 * (goal - other))
    around = np.where(
        t <= 30, start + t / 30 * (np.array((2.7, 0.3)) - start),
        np.array((2.7, 0.3)) + (t - 30) / 30 * (goal - np.array((2.7, 0.3))),
    )  # fmt: skip
    count = round(200 * share_here)
    positions = np.concatenate([np.repeat(up[None], count, axis=0), np.repeat(around[None], 200 - count, axis=0)])
    order = RNG(0).permutation(200)
    return SampledPaths(positions[order], np.full(200, 60, dtype=np.int32))


def test_a_place_needed_late_is_left_until_then() -> None:
    """Waiting at the goal wins for sure at tick 57 or so; first going where some pass early, and back, is better."""
    pose, sampled = (1.5, 2.5, 0.0), late_arrival(0.3)
    options = PursuitOptions(detour_seconds=(9.0, 13.0))
    found = shortlist(MAP, pose, sampled, None, options)
    best = found.itineraries[0]
    assert best.first != best.second
    assert math.dist(MAP.waypoints[best.second], (2.5, 2.5)) < 0.6
    assert found.values.met_share[0] == 1.0
    plain = shortlist(MAP, pose, sampled, None, PursuitOptions(detours=0))
    assert all(i.first == i.second for i in plain.itineraries)
    assert found.values.mean[0] > plain.values.mean[0] + 8


def test_the_shortlist_keeps_what_is_being_followed_and_covers_what_the_best_misses() -> None:
    sampled = walkers(150, 40, seed=2)
    current = Itinerary(MAP.stay, 5, 2)
    found = shortlist(MAP, (1.0, 1.0, 0.0), sampled, current, PursuitOptions())
    assert current in found.itineraries
    assert found.bonus[found.itineraries.index(current)] == PursuitOptions().keep_bonus
    assert len(found.itineraries) == PursuitOptions().candidates
    returns = np.array([[9.0, 0.0, 0.0], [8.0, 0.0, 0.0], [0.0, 0.0, 5.0], [0.0, 4.0, 0.0]], dtype=np.float32)
    assert covering(returns, returns.mean(axis=1), 3)[0] == 0
    assert sorted(covering(returns, returns.mean(axis=1), 4)) == [0, 1, 2, 3]
    assert set(covering(returns, returns.mean(axis=1), 3)) == {0, 1, 2}  # 2 helps most where 0 and 1 fail


def test_a_completed_mission_may_weigh_more() -> None:
    sampled = walkers(80, 40, seed=3)
    usual = shortlist(MAP, (1.0, 1.0, 0.0), sampled, None, PursuitOptions(detours=0))
    careful = shortlist(MAP, (1.0, 1.0, 0.0), sampled, None, PursuitOptions(detours=0, completion_weight=5.0))
    assert careful.values.met_share[0] >= usual.values.met_share[0]
    assert careful.values.mean[0] < usual.values.mean[0]


class Uniform:
    """A model whose adversary drifts from anywhere on the map, uniformly."""

    fallbacks = 0

    def sample(self, count: int, ticks: int, rng: np.random.Generator) -> SampledPaths:
        start = rng.uniform(0.1, 2.9, (count, 1, 2))
        return SampledPaths(
            start + np.arange(ticks + 1)[None, :, None] * rng.normal(0, 0.02, (count, 1, 2)),
            rng.integers(5, 60, count).astype(np.int32),
        )


def test_kept_paths_are_those_that_agree_with_what_was_observed() -> None:
    scenarios, rng = ScenarioSet(LAB, 2000, ReuseOptions(renewed_share=0.1)), RNG(4)
    first = scenarios.draw(Uniform(), 30, 200, rng)
    ego = (1.5, 1.0)
    scenarios.advance(TickObservation(1, ego))
    kept = np.array([p for p, c in zip(first.positions[:, 1], first.completed_tick, strict=True) if agrees(p, c, ego)])
    assert 200 < len(kept) < 1800
    second = scenarios.draw(Uniform(), 30, 199, rng)
    old = {tuple(p) for p in kept}
    again = sum(tuple(p) in old for p in second.positions[:, 0])
    assert again == min(len(kept), 1800)
    assert second.positions.shape == (2000, 31, 2)
    assert ((second.completed_tick == -1) | (second.completed_tick <= 30)).all()
    scenarios.advance(TickObservation(2, ego, Sighting(1.0, 1.0, 0.0, 0.2)))
    third = scenarios.draw(Uniform(), 30, 198, rng)
    assert not {tuple(p) for p in second.positions[:, 1]} & {tuple(p) for p in third.positions[:, 0]}


def agrees(point: np.ndarray, completed: int, ego: tuple[float, float]) -> bool:
    return not LAB.seen(point) and math.dist(point, ego) > 0.3 and (completed < 0 or completed > 1)


def test_kept_paths_last_and_are_then_renewed() -> None:
    scenarios, rng = ScenarioSet(OPEN, 50), RNG(5)
    for tick in range(60):
        sampled = scenarios.draw(Uniform(), 20, 60 - tick + 20, rng)
        assert sampled.positions.shape == (50, 21, 2)
        scenarios.advance(TickObservation(tick + 1, (9.0, 9.0)))


def test_first_meeting_from_a_slice_is_what_detours_need() -> None:
    route = np.tile(np.array([1.0, 1.0]), (10, 1))
    path = np.stack([np.linspace(2.0, 1.0, 10), np.ones(10)], axis=1)
    whole = first_meeting(route, path, 9, 0.3, 0.2)
    assert first_meeting(route[3:], path[3:], 6, 0.3, 0.2) == pytest.approx(whole - 3)


def test_bad_reuse_is_refused() -> None:
    with pytest.raises(ValueError, match=r"ReuseOptions.renewed_share is 0"):
        ReuseOptions(renewed_share=0.0)


def test_effort_in_milliseconds_is_the_dearest_that_fits() -> None:
    for effort in EFFORT:
        options = PursuitOptions.for_milliseconds(effort.milliseconds)
        assert (options.paths, options.simulations) == (effort.paths, effort.simulations)
    assert PursuitOptions.for_milliseconds(49.0) == PursuitOptions.for_milliseconds(20.0) == PursuitOptions()
    assert PursuitOptions.for_milliseconds(0.1) == PursuitOptions.for_milliseconds(EFFORT[0].milliseconds)
    assert PursuitOptions.for_milliseconds(50, method="routes", paths=7).paths == 7
    for cheap, dear in itertools.pairwise(EFFORT):
        assert all(a <= b for a, b in zip(cheap, dear, strict=True))
