"""The ego's routes: straight where the map allows, free of obstacles, driven as the environment's ego would drive."""

import heapq
import math

import numpy as np
import pytest

from tab_marl.planning.pursuit.motion_kernels import clear_line
from tab_marl.planning.pursuit.routes import RouteMap, RouteOptions
from tab_marl.world.grid import free_points
from tab_marl.world.kernels import steer, unicycle_step
from tab_marl.world.scenario import Scenario

LAB = Scenario.preset("lab")
MAP = RouteMap.build(LAB)


def test_waypoints_are_free_spread_out_and_include_the_checkpoints() -> None:
    assert 70 <= len(MAP.waypoints) <= 130
    assert free_points(LAB, MAP.waypoints, LAB.ego.radius_metres).all()
    for checkpoint in LAB.checkpoints:
        assert np.hypot(*(MAP.waypoints - (checkpoint.x, checkpoint.y)).T).min() < 0.05
    gaps = np.hypot(*(MAP.waypoints[:, None] - MAP.waypoints[None]).transpose(2, 0, 1))
    assert gaps[~np.eye(len(gaps), dtype=bool)].min() > 0.1


def test_named_places_become_waypoints() -> None:
    place = (1.03, 0.31)
    extended = RouteMap.build(LAB, (place,))
    assert np.hypot(*(extended.waypoints - place).T).min() < 0.05
    assert RouteMap.build(LAB, (place,)) is extended


def test_every_route_arrives_about_as_fast_as_its_shortest_path_allows() -> None:
    pose = (2.0, 2.7, -1.0)
    table = MAP.table(pose, 80)
    start = MAP.grid.cells_of([pose[:2]])[0]
    for w in range(MAP.stay):
        arrival = np.argmax(np.hypot(*(table.positions[w] - MAP.waypoints[w]).T) < 0.02)
        assert np.hypot(*(table.positions[w, -1] - MAP.waypoints[w])) < 0.02
        seconds = MAP.distances[w, start] / LAB.ego.max_speed
        # A turn on the spot takes up to 1.7 s; the first one is always there, sharp corners add a little.
        assert arrival * LAB.step_seconds <= seconds + 3.0


def test_routes_stay_clear_of_obstacles() -> None:
    rng = np.random.default_rng(0)
    for _ in range(5):
        x, y = MAP.grid.centres[rng.integers(MAP.grid.cells)]
        table = MAP.table((x, y, rng.uniform(-np.pi, np.pi)), 60)
        assert free_points(LAB, table.positions, LAB.ego.radius_metres - 0.01).all()


def test_no_step_is_faster_than_the_robot_and_the_last_row_stays() -> None:
    table = MAP.table((2.0, 2.7, -1.0), 40)
    steps = np.hypot(*np.moveaxis(np.diff(table.positions, axis=1), -1, 0))
    assert steps.max() <= LAB.ego.max_speed * LAB.step_seconds + 1e-6
    assert (table.positions[MAP.stay] == (2.0, 2.7)).all()
    assert (np.diff(table.effort, axis=1) >= 0).all()


def test_the_table_is_what_the_controller_drives() -> None:
    """Slow twin: the public controller and the world's unicycle, one control step at a time."""
    pose = (2.0, 2.7, -1.0)
    table = MAP.table(pose, 12)
    for w in (0, 7, 40, MAP.stay - 1):
        at, spent = pose, 0.0
        for t in range(1, 13):
            for _ in range(5):
                v, turn = MAP.control(at, w)
                at = unicycle_step(*at, v, turn, 0.1)
                spent += (v * v + turn * turn) / 5
            assert table.positions[w, t] == pytest.approx(at[:2], abs=1e-9)
            assert table.effort[w, t] == pytest.approx(spent, abs=1e-9)
    assert MAP.control(pose, MAP.stay) == (0.0, 0.0)


def test_in_the_open_a_route_is_a_straight_line() -> None:
    open_map = RouteMap.build(Scenario.preset("open"))
    rng = np.random.default_rng(4)
    for w in rng.integers(0, open_map.stay, 10):
        cell = rng.integers(open_map.grid.cells)
        assert open_map.aims[w, cell] == open_map.goals[w]
        x, y = open_map.grid.centres[cell]
        assert (
            open_map.control((x, y, 0.3), int(w))
            == pytest.approx(steer(x, y, 0.3, *open_map.waypoints[w], 0.22, 1.82, 0.1))
            or np.hypot(*(open_map.waypoints[w] - (x, y))) < 0.01
        )


def test_aims_follow_a_shortest_path() -> None:
    """Oracle: chains of aims are never longer than the grid's own shortest path, and every leg is free."""
    rng = np.random.default_rng(5)
    centres, grid = MAP.grid.centres, MAP.grid
    bent = 0
    for _ in range(200):
        w, cell = int(rng.integers(MAP.stay)), int(rng.integers(grid.cells))
        length, at, legs = 0.0, cell, 0
        while at != MAP.goals[w]:
            to = MAP.aims[w, at]
            assert clear_line(grid.cell_at, grid.row[at], grid.column[at], grid.row[to], grid.column[to])
            length += math.dist(centres[at], centres[to])
            at, legs = int(to), legs + 1
            assert legs < 200
        bent += legs > 1
        assert length <= MAP.distances[w, cell] + 1e-9
        assert length >= math.dist(centres[cell], centres[MAP.goals[w]]) - 1e-9
    assert bent > 10


def test_distances_against_a_plain_dijkstra() -> None:
    grid, w = MAP.grid, 3
    index = {(int(r), int(c)): i for i, (r, c) in enumerate(zip(grid.row, grid.column, strict=True))}
    best = {int(MAP.goals[w]): 0.0}
    queue = [(0.0, int(MAP.goals[w]))]
    while queue:
        d, cell = heapq.heappop(queue)
        if d > best[cell]:
            continue
        r, c = int(grid.row[cell]), int(grid.column[cell])
        for dr, dc in ((0, 1), (1, 0), (0, -1), (-1, 0)):
            other = index.get((r + dr, c + dc))
            if other is not None and d + 1 < best.get(other, np.inf):
                best[other] = d + 1
                heapq.heappush(queue, (d + 1, other))
    four = np.array([best[i] for i in range(grid.cells)]) * grid.cell_metres
    # More directions are never longer, and 16 of them at most sqrt(2) shorter.
    assert (MAP.distances[w] <= four + 1e-9).all()
    assert (MAP.distances[w] * math.sqrt(2) >= four - 0.2).all()


@pytest.mark.parametrize("bad", [{"spacing_metres": 0.0}, {"cell_metres": -1.0}, {"clearance_metres": -0.1}])
def test_bad_options_are_refused(bad: dict[str, float]) -> None:
    with pytest.raises(ValueError, match=f"RouteOptions.{next(iter(bad))} is"):
        RouteOptions(**bad)
