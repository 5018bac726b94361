"""Ego tasks other than interception: values against slow twins, sight against exact geometry, and decisions known to be right."""

import math

import numpy as np
import pytest

from tab_marl.envs.lidar import Lidar
from tab_marl.planning.models.interface import SampledPaths, Sighting, TickObservation
from tab_marl.planning.models.sight import Sight, noticed
from tab_marl.planning.pursuit.decide import PursuitOptions, decide
from tab_marl.planning.pursuit.interception import NEVER
from tab_marl.planning.pursuit.routes import Itinerary, RouteMap, RouteTable
from tab_marl.planning.pursuit.scenarios import ScenarioSet
from tab_marl.planning.pursuit.tasks import arrivals, value_itineraries
from tab_marl.world.regions import Box, Disc
from tab_marl.world.scenario import Scenario

RNG = np.random.default_rng
LAB = Scenario.preset("lab")
OPEN = Scenario.preset("open")
WATCH = LAB.for_task("surveillance")


def walks(count: int, ticks: int, seed: int) -> np.ndarray:
    rng = RNG(seed)
    return np.clip(
        rng.uniform(0.3, 2.7, (count, 1, 2)) + np.cumsum(rng.normal(0, 0.07, (count, ticks, 2)), axis=1), 0.05, 2.95
    )


def table_of(count: int, ticks: int, seed: int) -> RouteTable:
    effort = np.concatenate(
        [np.zeros((count, 1)), np.cumsum(RNG(seed).uniform(0, 0.1, (count, ticks - 1)), axis=1)], axis=1
    )
    return RouteTable(walks(count, ticks, seed), effort)


def test_lines_of_sight_agree_with_the_lidars() -> None:
    sight, lidar, rng = Sight.of(LAB), Lidar.of(LAB), RNG(0)
    seen = 0
    for _ in range(300):
        x, y, to_x, to_y = rng.uniform(0.05, 2.95, 4)
        line = np.linspace((x, y), (to_x, to_y), 400)
        clearance = min(float(o.distance(line).min()) for o in LAB.obstacles)
        hidden = max(np.asarray(o.contains(line)).mean() for o in LAB.obstacles) * math.dist((x, y), (to_x, to_y))
        found = bool(sight.watched((x, y), np.array([[to_x, to_y]]), 9.0)[0])
        if clearance > 0.03:  # clear by more than a square
            assert found
        elif hidden > 0.25:
            assert not found
        seen += found
        if clearance > 0.03 or hidden > 0.25:
            assert found == lidar.sees(x, y, to_x, to_y)
    assert 50 < seen < 250


def test_what_would_have_been_noticed() -> None:
    points = RNG(1).uniform(0.05, 2.95, (500, 2))
    ego = (1.5, 0.6)
    gap = np.hypot(*(points - ego).T)
    hunted = noticed(LAB, points, ego)
    assert (hunted == (LAB.seen(points) | (gap <= LAB.interception_metres))).all()
    watched = noticed(WATCH, points, ego)
    assert (watched >= hunted).all()
    extra = watched & ~hunted
    assert extra.sum() > 10 and (gap[extra] <= WATCH.watch_metres).all()


def test_avoidance_matches_a_slow_twin() -> None:
    scenario = OPEN.for_task("avoidance", Disc(1.5, 1.5, 0.4))
    table, paths = table_of(6, 15, 2), walks(10, 15, 3)
    there = arrivals(table, scenario)
    assert (there >= 0).any() and (there < 0).any()
    values = value_itineraries(table, SampledPaths(paths, np.full(10, 4, dtype=np.int32)), scenario, OPEN.rewards, 0.3)
    s = np.linspace(0, 1, 2001)
    for w in range(6):
        inside = [t for t in range(15) if math.dist(table.positions[w, t], (1.5, 1.5)) <= 0.4]
        last = inside[0] if inside else 14
        for k in range(10):
            met = NEVER
            for t in range(last):
                a, b = table.positions[w, t] - paths[k, t], table.positions[w, t + 1] - paths[k, t + 1]
                close = np.hypot(*(a + s[:, None] * (b - a)).T) <= 0.3
                if close.any():
                    met = t + s[close.argmax()]
                    break
            end = last if met == NEVER else met
            spent = np.interp(end, np.arange(15), table.effort[w])
            expected = -end - 0.1 * spent + (-50 if met != NEVER else 50 if inside else 0)
            assert values.returns[w, k] == pytest.approx(expected, abs=5e-3)
            assert values.met[w, k] == pytest.approx(met, abs=5e-3)
    assert 0.05 < (values.met >= 0).mean() < 0.95


def test_surveillance_matches_a_slow_twin() -> None:
    table, paths = table_of(5, 20, 4), walks(8, 20, 5)
    values = value_itineraries(table, SampledPaths(paths, np.full(8, -1, dtype=np.int32)), WATCH, WATCH.rewards, 0.3)
    blocked = 0
    for w in range(5):
        for k in range(8):
            seconds, first = 0.0, NEVER
            for t in range(1, 20):
                near = math.dist(table.positions[w, t], paths[k, t]) <= WATCH.watch_metres
                free = Sight.of(WATCH).watched(tuple(table.positions[w, t]), paths[k, t][None], 9.0)[0]
                blocked += near and not free
                if near and free:
                    first = t if first == NEVER else first
                    seconds += WATCH.step_seconds
            assert values.returns[w, k] == pytest.approx(-19 - 0.1 * table.effort[w, 19] + seconds, abs=1e-3)
            assert values.met[w, k] == first
    assert 0.05 < (values.met >= 0).mean() < 0.95 and blocked > 0


def test_an_ego_that_avoids_goes_round_or_waits_and_still_arrives() -> None:
    """The adversary walks the corridor towards the ego; straight on, they meet for sure."""
    scenario = OPEN.for_task("avoidance", Disc(2.6, 1.5, 0.2))
    routes = RouteMap.build(scenario, (scenario.ego_goal.centre,))  # type: ignore[union-attr]
    rng = RNG(0)
    x = 2.6 - 0.1 * np.arange(81)[None] + rng.normal(0, 0.1, (100, 1))
    y = np.full((100, 81), 1.5) + rng.normal(0, 0.05, (100, 1))
    sampled = SampledPaths(np.stack([np.clip(x, 0.1, 2.9), y], axis=-1), np.full(100, -1, dtype=np.int32))
    decision = decide(routes, (0.4, 1.5, 0.0), sampled, None, PursuitOptions(), rng)
    assert decision.plan is None
    goal = int(np.argmin(np.hypot(*(routes.waypoints - (2.6, 1.5)).T)))
    straight = routes.itinerary_table((0.4, 1.5, 0.0), 80, [Itinerary.plain(goal)])
    assert (value_itineraries(straight, sampled, scenario, scenario.rewards, 0.3).met >= 0).mean() > 0.95
    best = int(np.argmax(decision.values.mean))
    assert decision.values.met_share[best] < 0.05
    assert decision.values.mean[best] > 0  # it arrived: 50 less a step's price for each of fewer than 50 steps


def test_an_ego_that_watches_keeps_the_adversary_in_sight_whatever_its_mission() -> None:
    scenario = OPEN.for_task("surveillance")
    routes = RouteMap.build(scenario)
    still = np.tile(np.array([2.4, 2.4]), (50, 61, 1))
    done = np.full(50, 5, dtype=np.int32)  # completed early, which changes nothing
    decision = decide(routes, (0.4, 0.4, 0.0), SampledPaths(still, done), None, PursuitOptions(), RNG(0))
    end = routes.itinerary_table((0.4, 0.4, 0.0), 60, [decision.itinerary]).positions[0, -1]
    assert math.dist(end, (2.4, 2.4)) <= scenario.watch_metres


def test_kept_paths_are_dropped_where_the_watching_ego_would_have_seen_them() -> None:
    scenario = OPEN.for_task("surveillance")
    paths = ScenarioSet(scenario, 60)

    class Still:
        fallbacks = 0

        def sample(self, count, ticks, rng):
            at = np.where(np.arange(count)[:, None] % 2, (1.5, 0.4), (0.4, 1.5))
            return SampledPaths(np.repeat(at[:, None], ticks + 1, axis=1), np.full(count, -1, dtype=np.int32))

    paths.draw(Still(), 10, 40, RNG(0))  # type: ignore[arg-type]
    paths.advance(TickObservation(1, (1.5, 1.0)))
    kept = paths.draw(Still(), 10, 40, RNG(0)).positions[:, 0]  # type: ignore[arg-type]
    unseen = scenario.seen(np.array([[1.5, 0.4], [0.4, 1.5]]))
    assert not unseen.any()
    assert (np.hypot(*(kept - (1.5, 0.4)).T) < 0.1).mean() < 0.4  # only fresh ones
    paths.advance(TickObservation(2, (1.5, 1.0), Sighting(1.5, 0.4, 0.0, 0.0)))
    assert paths._positions.shape[0] == 0


def test_boxes_also_hide() -> None:
    scenario = Scenario(
        "wall", LAB.checkpoints, LAB.ego_start, LAB.adversary_start, obstacles=(Box(1.4, 0.0, 1.6, 2.0),)
    )
    sight = Sight.of(scenario)
    assert sight.watched((1.0, 1.0), np.array([[2.0, 1.0], [1.2, 1.0], [1.0, 2.9]]), 1.0).tolist() == [
        False,
        True,
        False,
    ]
    assert sight.watched((1.0, 2.5), np.array([[2.0, 2.5]]), 1.1).tolist() == [True]
