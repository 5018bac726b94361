"""Route fields against a plain-Python Dijkstra, geometry, and hand-made missions."""

from __future__ import annotations

import heapq
from dataclasses import dataclass

import numpy as np
import pytest

from tab_marl.mission import route_kernels
from tab_marl.mission.route import nearest_cells, solve_route
from tab_marl.world.grid import GridMap
from tab_marl.world.regions import Box, Disc
from tab_marl.world.scenario import Scenario

COMPLETED, FAILED = -1, -2


@dataclass(frozen=True, eq=False)
class HandMade:
    """The tables of a mission automaton that a route reads, written by hand."""

    regions: tuple
    next_location: np.ndarray
    forbidden_until: np.ndarray
    progress: np.ndarray
    branch: np.ndarray
    branch_places: tuple
    initial: int = 0

    def masks(self, points):
        p = np.atleast_2d(points)
        return sum(
            (r.contains(p).astype(np.int32) << i for i, r in enumerate(self.regions)), np.zeros(len(p), np.int32)
        )


def in_order(goals, avoid=()):
    """Visit all goals in order while staying out of the regions to avoid."""
    regions = (*goals, *avoid)
    bits = 1 << len(regions)
    following = np.zeros((len(goals), bits), dtype=np.int32)
    progress = np.zeros(following.shape, dtype=bool)
    for u in range(len(goals)):
        for mask in range(bits):
            progress[u, mask] = mask >> u & 1
            following[u, mask] = (COMPLETED if u + 1 == len(goals) else u + 1) if mask >> u & 1 else u
            if mask >> len(goals):
                following[u, mask] = FAILED
    return HandMade(
        regions, following, np.zeros_like(following), progress, np.where(progress, 0, -1).astype(np.int32), ("goal",)
    )


def any_k_then(places, k, target):
    """Visit any k different places, then the target: one location per set of fewer than k places, and the last."""
    n = len(places)
    sets = [frozenset(i for i in range(n) if s >> i & 1) for s in range(1 << n)]
    few = [s for s in sets if len(s) < k]
    number = {s: i for i, s in enumerate(few)}
    last, bits = len(few), 1 << (n + 1)
    following = np.zeros((last + 1, bits), dtype=np.int32)
    progress = np.zeros(following.shape, dtype=bool)
    branch = np.full(following.shape, -1, dtype=np.int32)
    for mask in range(bits):
        for s in few:
            new = next((i for i in range(n) if mask >> i & 1 and i not in s), None)
            following[number[s], mask] = number[s]
            if new is not None:
                following[number[s], mask] = number.get(s | {new}, last)
                progress[number[s], mask], branch[number[s], mask] = True, new
        following[last, mask] = COMPLETED if mask >> n & 1 else last
        progress[last, mask] = bool(mask >> n & 1)
    names = tuple(f"place {i}" for i in range(n))
    return HandMade((*places, target), following, np.zeros_like(following), progress, branch, names)


def plain_dijkstra(automaton, grid, cost):
    """The slow twin: forward edges built one by one, then Dijkstra backwards from every completing edge."""
    masks = automaton.masks(grid.centres)
    edges: dict = {}
    for u in range(len(automaton.next_location)):

        def fails(s, u=u):
            return automaton.next_location[u, masks[s]] == FAILED or automaton.forbidden_until[u, masks[s]] > 0

        for s in range(grid.cells):
            r, c = int(grid.row[s]), int(grid.column[s])
            for dr, dc in [(0, 0), *map(tuple, route_kernels.MOVES)]:
                squares = {(r + dr, c + dc)}
                if abs(dr) + abs(dc) == 2 and dr and dc:
                    squares |= {(r, c + dc), (r + dr, c)}
                if abs(dr) == 2:
                    squares |= {(r + dr // 2, c), (r + dr // 2, c + dc)}
                if abs(dc) == 2:
                    squares |= {(r, c + dc // 2), (r + dr, c + dc // 2)}
                inside = all(0 <= a < grid.cell_at.shape[0] and 0 <= b < grid.cell_at.shape[1] for a, b in squares)
                if not inside or any(grid.cell_at[a, b] < 0 or fails(grid.cell_at[a, b]) for a, b in squares):
                    continue
                to = int(grid.cell_at[r + dr, c + dc])
                v = int(automaton.next_location[u, masks[to]])
                step = float(np.hypot(dr, dc)) * 0.5 * (cost[s] + cost[to]) * grid.cell_metres
                edges.setdefault((v, to) if v >= 0 else "done", []).append(((u, s), step))
    distance = np.full((len(automaton.next_location), grid.cells), np.inf)
    heap = [(step, node) for node, step in edges.get("done", [])]
    heapq.heapify(heap)
    while heap:
        key, node = heapq.heappop(heap)
        if key < distance[node]:
            distance[node] = key
            for earlier, step in edges.get(node, []):
                heapq.heappush(heap, (key + step, earlier))
    return distance


@pytest.fixture(scope="module")
def lab():
    return Scenario.preset("lab")


@pytest.mark.parametrize("costly", [False, True])
def test_equals_a_plain_dijkstra(lab, costly):
    grid = GridMap.from_scenario(lab, 0.2)
    places = [c.region for c in lab.checkpoints]
    automaton = in_order([places[0], places[2]], avoid=[Disc(1.5, 1.5, 0.4)])
    cost = np.random.default_rng(3).uniform(0.5, 3, grid.cells) if costly else np.ones(grid.cells)
    route = solve_route(automaton, grid, cost if costly else None)
    expected = plain_dijkstra(automaton, grid, cost)
    assert np.isfinite(expected).mean() > 0.9
    np.testing.assert_allclose(route.distance, expected, atol=1e-12)


def test_equals_a_plain_dijkstra_for_any_two_of_three(lab):
    grid = GridMap.from_scenario(lab, 0.25)
    automaton = any_k_then([c.region for c in lab.checkpoints[:3]], 2, Disc(1.5, 0.7, 0.2))
    np.testing.assert_allclose(
        solve_route(automaton, grid).distance, plain_dijkstra(automaton, grid, np.ones(grid.cells)), atol=1e-12
    )


def test_following_next_cell_costs_exactly_the_distance(lab):
    grid = GridMap.from_scenario(lab, 0.1)
    automaton = in_order([c.region for c in lab.checkpoints[:3]], avoid=[Disc(1.5, 1.5, 0.4)])
    cost = np.random.default_rng(0).uniform(1, 2, grid.cells)
    route = solve_route(automaton, grid, cost)
    for start in [(1.5, 0.4), (2.6, 1.6), (0.4, 1.5)]:
        cells, locations = route.path(0, start)
        assert locations[-1] == COMPLETED
        assert list(dict.fromkeys(locations.tolist())) == [0, 1, 2, COMPLETED]
        steps = np.hypot(*np.diff(grid.centres[cells], axis=0).T)
        mean_cost = (cost[cells[1:]] + cost[cells[:-1]]) / 2
        assert (steps * mean_cost).sum() == pytest.approx(route.distance[0, cells[0]])
        assert steps.sum() == pytest.approx(route.length[0, cells[0]])
        first = int(np.flatnonzero(locations != 0)[0])
        assert steps[:first].sum() == pytest.approx(route.to_visit[0, cells[0]])
        assert not Disc(1.5, 1.5, 0.4).contains(grid.centres[cells]).any()


def test_lengths_without_cost_are_the_distances(lab):
    grid = GridMap.from_scenario(lab, 0.1)
    route = solve_route(in_order([c.region for c in lab.checkpoints[:2]]), grid)
    np.testing.assert_allclose(route.length, route.distance, atol=1e-9)


def test_open_field_distance_is_straight_within_the_metric_error():
    scenario = Scenario.preset("open")
    grid = GridMap.from_scenario(scenario, 0.05)
    goal = Disc(2.5, 2.4, 0.18)
    route = solve_route(in_order([goal]), grid)
    straight = goal.distance(grid.centres)
    far = straight > 0.5
    # 16 neighbours overestimate a straight way by at most 2.8 %, and the goal is a cell centre inside the disc.
    assert (route.distance[0] >= straight - 1e-9)[far].all()
    assert (route.distance[0] <= 1.03 * straight + 0.06)[far].all()
    looked = route.metres(0, grid.centres[far], max_metres=10.0)
    assert (looked <= 1.005 * straight[far] + 0.06).all()


def test_direction_points_straight_at_a_visible_goal_and_around_an_obstacle():
    scenario = Scenario.preset("open")
    grid = GridMap.from_scenario(scenario, 0.05)
    goal = Disc(2.5, 2.4, 0.18)
    direction = solve_route(in_order([goal]), grid).direction(0, [(1.03, 0.51), (0.5, 2.37)])
    for point, d in zip([(1.03, 0.51), (0.5, 2.37)], direction, strict=True):
        towards = np.subtract(goal.centre, point)
        assert np.arccos(d @ towards / np.hypot(*towards)) < np.radians(12)
    wall = Scenario(
        name="wall",
        checkpoints=scenario.checkpoints,
        obstacles=(Box(1.4, 0.6, 1.6, 2.4),),
        ego_start=scenario.ego_start,
        adversary_start=scenario.adversary_start,
    )
    grid = GridMap.from_scenario(wall, 0.05)
    route = solve_route(in_order([Disc(2.5, 1.8, 0.18)]), grid)
    (d,) = route.direction(0, (1.2, 1.8))
    assert d[1] > 0.8, "the goal is behind the wall, nearer by its upper end"
    blocked = route.direction(0, np.random.default_rng(1).uniform(0.2, 2.8, (200, 2)))
    np.testing.assert_allclose(np.hypot(*blocked.T), 1.0)


def test_following_the_direction_reaches_the_goal_on_a_short_way(lab):
    """Small steps along `direction` walk the stages in a length between straight lines and the grid's own distance."""
    grid = GridMap.from_scenario(lab, 0.1)
    automaton = in_order([lab.region("Checkpoint A"), lab.region("Checkpoint C")], avoid=[lab.region("central zone")])
    route = solve_route(automaton, grid)
    rng = np.random.default_rng(5)
    for point in grid.centres[rng.choice(grid.cells, 20)]:
        if lab.region("central zone").contains(point):
            continue
        p, u, walked = point.copy(), int(automaton.next_location[0, automaton.masks(point)[0]]), 0.0
        expected = route.distance[u, grid.cells_of(point)[0]]
        while u >= 0 and walked < 20:
            p = p + 0.02 * route.direction(u, p)[0]
            walked += 0.02
            mask = automaton.masks(p)[0] & 3  # the avoided zone is checked on cells, a step may graze it
            u = int(automaton.next_location[u, mask])
        assert u == COMPLETED
        assert walked <= 1.02 * expected + 0.1


def test_the_look_ahead_is_the_farthest_cell_of_the_route_in_free_sight(lab):
    """Straight to it: only free squares, no zone, nothing visited before the end; and on the route's own cells."""
    grid = GridMap.from_scenario(lab, 0.1)
    zone = lab.region("central zone")
    automaton = in_order([lab.region("Checkpoint A"), lab.region("Checkpoint C")], avoid=[zone])
    route = solve_route(automaton, grid)
    rng = np.random.default_rng(2)
    reached_goal = farther = 0
    for point in grid.centres[rng.choice(grid.cells, 150)] + rng.uniform(-0.04, 0.04, (150, 2)):
        location = int(rng.integers(2))
        if automaton.masks(point)[0]:
            continue
        (target,), (after,) = route.targets(location, point)
        cells, locations = route.path(location, point)
        changed = int(np.flatnonzero(locations != location)[0])
        assert target in cells[1 : changed + 1]
        assert after == locations[list(cells).index(target)]
        line = point + np.linspace(0, 1, 400)[:, None] * (grid.centres[target] - point)
        squares = grid.cell_at[(line[:, 1] / 0.1).astype(int), (line[:, 0] / 0.1).astype(int)]
        if target != cells[1]:  # the first cell is headed for in any case
            farther += 1
            on_line = squares[np.linspace(0, 399, 1 + int(np.hypot(*(line[-1] - line[0])) / 0.05) + 1).astype(int)]
            assert (on_line >= 0).all()
            bits = automaton.masks(grid.centres[on_line])
            assert not (bits & 4).any()
            goal = bits >> location & 1
            assert (np.diff(goal) >= 0).all(), "a goal is entered once, at the end"
        reached_goal += after != location
    assert farther > 60 and reached_goal > 5


def test_costs_bend_the_route_but_lengths_stay_plain(lab):
    grid = GridMap.from_scenario(Scenario.preset("open"), 0.1)
    automaton = in_order([Disc(2.5, 1.5, 0.15)])
    camera = Disc(1.5, 1.45, 0.45)
    shy = solve_route(automaton, grid, np.where(camera.contains(grid.centres), 6.0, 1.0))
    straight = solve_route(automaton, grid)
    through, _ = straight.path(0, (0.5, 1.5))
    around, _ = shy.path(0, (0.5, 1.5))
    assert camera.contains(grid.centres[through]).sum() >= 6
    assert camera.contains(grid.centres[around]).sum() == 0
    start = grid.cells_of((0.5, 1.5))[0]
    assert straight.length[0, start] < shy.length[0, start] < 1.4 * straight.length[0, start]
    # The straight line through the costly disc is not taken as a short cut.
    (d,) = shy.direction(0, (0.85, 1.5))
    assert abs(d[1]) > 0.3


def test_directed_costs_choose_the_side():
    """Moves that turn clockwise about a block are dear: the way goes anticlockwise, and the other way when reversed."""
    base = Scenario.preset("open")
    scenario = Scenario(
        name="block",
        checkpoints=base.checkpoints,
        obstacles=(Box(1.2, 1.2, 1.8, 1.8),),
        ego_start=base.ego_start,
        adversary_start=base.adversary_start,
    )
    grid = GridMap.from_scenario(scenario, 0.1)
    moves = np.stack([route_kernels.MOVE_X, route_kernels.MOVE_Y], axis=1)
    arm = grid.centres - 1.5
    arm /= np.hypot(*arm.T)[:, None]
    turning = arm[:, :1] * moves[:, 1] - arm[:, 1:] * moves[:, 0]
    for sign in (1, -1):
        route = solve_route(in_order([Disc(2.6, 1.5, 0.15)]), grid, 1.0 + 2.0 * np.maximum(0.0, -sign * turning))
        cells, _ = route.path(0, (0.4, 1.5))
        x, y = grid.centres[cells].T - 1.5
        winding = np.diff(np.unwrap(np.arctan2(y, x))).sum()
        assert np.sign(winding) == sign


def test_extra_metres_change_which_places_are_chosen(lab):
    grid = GridMap.from_scenario(lab, 0.1)
    places = [c.region for c in lab.checkpoints]
    automaton = any_k_then(places, 2, Disc(1.5, 2.7, 0.18))

    def visited(route):
        cells, _ = route.path(0, (1.5, 0.4))
        u, seen = 0, []
        for cell in cells[1:]:
            mask = automaton.masks(grid.centres[cell])[0]
            if automaton.branch[u, mask] >= 0:
                seen.append(int(automaton.branch[u, mask]))
            u = automaton.next_location[u, mask]
        return seen

    usual = visited(solve_route(automaton, grid))
    assert len(usual) == 2
    changed = visited(solve_route(automaton, grid, place_metres={f"place {usual[0]}": 5.0}))
    assert len(changed) == 2 and usual[0] not in changed


def test_via_points_are_passed_first_and_goals_left_alone_until_then(lab):
    grid = GridMap.from_scenario(lab, 0.1)
    automaton = in_order([lab.region("Checkpoint C")])
    via = ((0.4, 1.6), (1.5, 2.7))
    route = solve_route(automaton, grid, via=via)
    assert route.via_locations == (1, 2)
    cells, locations = route.path(route.via_locations[0], (1.5, 0.4))
    assert list(dict.fromkeys(locations.tolist())) == [1, 2, 0, COMPLETED]
    for i, point in enumerate(via):
        passed = np.hypot(*(grid.centres[cells] - point).T) <= 0.15
        assert passed.any() and locations[np.flatnonzero(passed)[0]] != i + 1
    plain = solve_route(automaton, grid)
    np.testing.assert_allclose(route.distance[0], plain.distance[0])


def test_a_label_forbidden_for_a_while_is_walked_around(lab):
    grid = GridMap.from_scenario(lab, 0.1)
    free = in_order([Disc(1.5, 2.7, 0.2), Disc(1.5, 1.5, 0.4)])
    held = in_order([Disc(1.5, 2.7, 0.2), Disc(1.5, 1.5, 0.4)])
    held.forbidden_until[0, 2] = 40
    cells, locations = solve_route(held, grid).path(0, (1.5, 0.4))
    early = grid.centres[cells[:-1][locations[:-1] == 0]]
    assert not Disc(1.5, 1.5, 0.4).contains(early).any()
    assert solve_route(held, grid).distance[0, cells[0]] > solve_route(free, grid).distance[0, cells[0]]


def test_unreachable_goals_are_infinite_and_bad_costs_are_refused(lab):
    grid = GridMap.from_scenario(lab, 0.1)
    ring = (Box(1.8, 1.8, 3, 2.0), Box(1.8, 1.8, 2.0, 3))
    route = solve_route(in_order([Disc(2.6, 2.6, 0.2)], avoid=ring), grid)
    start = grid.cells_of((0.5, 0.5))[0]
    assert route.distance[0, start] == np.inf and route.next_cell[0, start] == -1
    np.testing.assert_array_equal(route.direction(0, (0.5, 0.5)), [[0.0, 0.0]])
    assert route.metres(0, (0.5, 0.5))[0] == np.inf
    with pytest.raises(ValueError, match="shape"):
        solve_route(in_order([Disc(2.6, 2.6, 0.2)]), grid, np.ones(3))
    with pytest.raises(ValueError, match="must be > 0"):
        solve_route(in_order([Disc(2.6, 2.6, 0.2)]), grid, np.zeros(grid.cells))
    with pytest.raises(ValueError, match="must be >= 0"):
        solve_route(in_order([Disc(2.6, 2.6, 0.2)]), grid, place_metres={"goal": -1.0})


def test_nearest_cells_cover_the_map(lab):
    grid = GridMap.from_scenario(lab, 0.1)
    nearest = nearest_cells(grid)
    assert nearest.min() >= 0
    rows, columns = np.indices(nearest.shape)
    squares = (np.stack([columns, rows], axis=-1).reshape(-1, 2) + 0.5) * 0.1
    gaps = np.hypot(*(grid.centres[nearest.reshape(-1)] - squares).T)
    best = np.hypot(*(grid.centres[None] - squares[:, None]).transpose(2, 0, 1)).min(axis=1)
    np.testing.assert_allclose(gaps, best, atol=1e-9)
