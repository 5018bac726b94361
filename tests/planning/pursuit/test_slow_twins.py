"""Kernels of routes, walkers and prospects against slow twins written from their definitions."""

import math

import numpy as np
import pytest

from tab_marl.mission.kernels import advance
from tab_marl.mission.model import Constraint, Mission
from tab_marl.planning.models import walk_kernels
from tab_marl.planning.models.interface import SampledPaths
from tab_marl.planning.models.mission_map import MissionMap
from tab_marl.planning.models.walker import MoveCounts
from tab_marl.planning.pursuit import decide_kernels
from tab_marl.planning.pursuit.decide import PursuitOptions, pursuit_model
from tab_marl.planning.pursuit.interception import value_routes
from tab_marl.planning.pursuit.motion_kernels import straightened_aims
from tab_marl.planning.pursuit.routes import Itinerary, RouteMap
from tab_marl.world.grid import GridMap
from tab_marl.world.kernels import MOVES, free_move
from tab_marl.world.scenario import Scenario

LAB = Scenario.preset("lab")
MAP = RouteMap.build(LAB)
POSE = (2.0, 2.7, -1.0)
RNG = np.random.default_rng


def free_line(grid: GridMap, a: int, b: int) -> bool:
    start, end = grid.index[a].astype(float), grid.index[b].astype(float)
    pieces = int(2 * np.abs(end - start).max())
    points = [start + i / pieces * (end - start) for i in range(1, pieces)]
    return all(grid.cell_at[math.floor(r + 0.5), math.floor(c + 0.5)] >= 0 for r, c in points)


def test_straightened_aims_match_a_slow_twin() -> None:
    grid = GridMap.from_scenario(LAB, 0.1)
    for goal in (0, grid.cells // 2):
        distance = grid.distances([goal]) / grid.cell_metres
        found = np.empty(grid.cells, dtype=np.int32)
        straightened_aims(grid.cell_at, grid.row, grid.column, distance, goal, found)
        known = {goal: goal}

        def aim(cell: int, distance: np.ndarray = distance, known: dict[int, int] = known) -> int:
            if cell not in known:
                ways = []
                for dr, dc in MOVES.tolist():
                    if free_move(grid.cell_at, grid.row[cell], grid.column[cell], dr, dc):
                        other = int(grid.cell_at[grid.row[cell] + dr, grid.column[cell] + dc])
                        if distance[other] < distance[cell]:
                            ways.append((distance[other] + math.hypot(dr, dc), other))
                successor = min(ways, key=lambda way: way[0])[1] if ways else cell
                known[cell] = cell
                if successor != cell:
                    known[cell] = aim(successor) if free_line(grid, cell, aim(successor)) else successor
            return known[cell]

        assert [aim(cell) for cell in range(grid.cells)] == found.tolist()
        assert len(set(found.tolist())) > 3  # there are corners to turn at


def slow_step(m, x, y, location, clocks, moves, feasible, rng):
    """One move of a walker, told in plain Python from `MissionMap`."""
    cumulative, speeds, reach = moves.cumulative(), moves.speeds, m.reach_metres

    def read(location: int, clocks: np.ndarray, point: tuple[float, float]) -> int:
        return int(advance(*m.rules, location, clocks, m.mask_at(*point)))

    def open_at(px: float, py: float) -> bool:
        size = m.ground.square_metres
        return bool(m.ground.free[int(py / size), int(px / size)])

    def in_time(px: float, py: float, location: int, clocks: np.ndarray) -> bool:
        if location < 0:
            return location == -1
        cell, ways = int(m.ways.nearest[int(py / m.ways.cell_metres), int(px / m.ways.cell_metres)]), m.ways
        reserve = walk_kernels.RESERVE_CELLS * ways.cell_metres
        left = m.mission_latest - clocks[0]
        if ways.length[location, cell] + reserve > left * reach:
            return False
        bounds = [
            m.rules.latest[location, k] - clocks[k] for k in range(3) if m.rules.latest[location, k] < m.mission_latest
        ]
        return bool(ways.to_visit[location, cell] + reserve <= min([left, *bounds]) * reach)

    ahead, gap = 0.0, 0.0
    if location >= 0:
        cell = m.ways.nearest[int(y / m.ways.cell_metres), int(x / m.ways.cell_metres)]
        target = m.ways.target[location, cell]
        if target >= 0:
            offset = m.ways.centres[target] - (x, y)
            ahead, gap = math.atan2(offset[1], offset[0]), math.hypot(*offset)
    width, height = m.ground.free.shape[1] * m.ground.square_metres, m.ground.free.shape[0] * m.ground.square_metres
    for _ in range(walk_kernels.DRAWS):
        chosen = int(np.argmax(cumulative > rng.random() * cumulative[-1]))
        angle = ahead + (chosen // speeds + rng.random() - 0.5) * 2 * math.pi / moves.angles
        low, high = chosen % speeds / speeds, (chosen % speeds + 1) / speeds
        metres = reach * math.sqrt(low**2 + rng.random() * (high**2 - low**2))
        to = (x + metres * math.cos(angle), y + metres * math.sin(angle))
        if not (0 <= to[0] < width and 0 <= to[1] < height and open_at(*to)):
            continue
        if not open_at((x + to[0]) / 2, (y + to[1]) / 2):
            continue
        after = clocks.copy()
        following = read(location, after, to)
        if not feasible or location < 0 or in_time(*to, following, after):
            return *to, following, after
    if feasible and location >= 0:
        metres = min(reach, gap)
        to = (x + metres * math.cos(ahead), y + metres * math.sin(ahead))
        after = clocks.copy()
        following = read(location, after, to)
        if following != -2:
            return *to, following, after
    after = clocks.copy()
    return x, y, read(location, after, (x, y)), after


@pytest.mark.parametrize("feasible", [False, True])
def test_walkers_match_a_slow_twin_move_by_move(feasible: bool) -> None:
    mission = Mission((Constraint("deadline", (LAB.checkpoints[0].name,), seconds=25.0),), "M1")  # type: ignore[arg-type]
    m = MissionMap.build(LAB, mission)
    moves = MoveCounts(along_share=0.3)
    fast, slow, trial = RNG(3), RNG(3), np.empty(3, dtype=np.int32)
    starts = m.grid.centres[RNG(4).integers(m.grid.cells, size=12)]
    stood = refused = 0
    for x, y in starts:
        location, clocks = m.automaton.initial, np.full(3, -1, dtype=np.int32)
        location = int(walk_kernels.read_label(location, clocks, m.mask_at(x, y), m.rules))
        for _ in range(55):
            before = clocks.copy()
            expected = slow_step(m, x, y, location, before, moves, feasible, slow)
            got = walk_kernels.walk_once(
                x, y, location, clocks, moves.cumulative(), moves.speeds, feasible, m.mission_latest, m.reach_metres,
                m.rules, m.ways, m.ground, trial, fast,
            )  # fmt: skip
            assert got == pytest.approx(expected[:3], abs=1e-12)
            assert clocks.tolist() == expected[3].tolist()
            stood += got[:2] == (x, y)
            refused += location >= 0 > got[2]
            x, y, location = got
    assert fast.random() == slow.random()  # and as many numbers were drawn
    assert refused > 0  # missions ended, one way or the other


def pursuit(count: int, seed: int):
    """A model of four itineraries against paths in two bundles, so that many look alike."""
    rng = RNG(seed)
    heading = rng.choice([-2.0, 0.5], (count, 1)) + np.cumsum(rng.normal(0, 0.1, (count, 40)), axis=1)
    moves = 0.11 * np.stack([np.cos(heading), np.sin(heading)], axis=-1)
    positions = np.clip(1.5 + np.concatenate([np.zeros((count, 1, 2)), np.cumsum(moves, axis=1)], axis=1), 0.1, 2.9)
    completed = np.where(rng.random(count) < 0.7, rng.integers(8, 40, count), -1).astype(np.int32)
    sampled = SampledPaths(positions, completed)
    candidates = [Itinerary.plain(4), Itinerary(17, 9, 60), Itinerary(MAP.stay, 6, 3), Itinerary.plain(MAP.stay)]
    table = MAP.itinerary_table(POSE, 40, candidates)
    values = value_routes(table, positions, completed, LAB.rewards, 0.3)
    return candidates, sampled, table, values, pursuit_model(MAP, POSE, sampled, values, candidates, PursuitOptions())


def test_driven_itineraries_are_those_of_the_table() -> None:
    candidates, _sampled, table, _values, model = pursuit(20, 1)
    driven = model.data.driven
    assert driven[:, :, :2] == pytest.approx(table.positions, abs=1e-9)
    assert driven[:, :, 3] == pytest.approx(table.effort, abs=1e-9)
    for a, itinerary in enumerate(candidates):
        standing = np.flatnonzero(driven[a, :, 4])
        assert (np.ptp(driven[a, standing, :2], axis=0) == 0).all()
        assert (standing > itinerary.switch_tick).all()


def test_prospects_match_a_slow_twin() -> None:
    candidates, sampled, _table, values, model = pursuit(90, 2)
    positions, completed = sampled
    scenario, radius = LAB, LAB.interception_metres
    rng, found, asked = RNG(5), np.empty(4), 0
    for _ in range(60):
        k, t, kept, leave_out = (
            int(rng.integers(90)),
            int(rng.integers(1, 20)),
            int(rng.integers(4)),
            bool(rng.integers(2)),
        )
        x, y = MAP.grid.centres[rng.integers(MAP.grid.cells)]
        state = np.array([k, t, x, y, 0.3, -1.0])
        alike = decide_kernels.prospects(state, kept, 0.4, leave_out, model.data, found)
        rows = []
        for j in range(90):
            ends = 0 <= completed[j] <= 40
            last = int(completed[j]) if ends else 40
            if (leave_out and j == k) or last <= t or math.dist(positions[j, t], positions[k, t]) > 0.4:
                continue
            row = []
            for a, (first, switch, second) in enumerate(candidates):
                if a == kept:
                    row.append(values.returns[a, j] + t)
                    continue
                route = first if t < switch else second
                place = POSE[:2] if route == MAP.stay else MAP.waypoints[route]
                drive = 0.0 if route == MAP.stay else MAP.distances[route, MAP.grid.cells_of([(x, y)])[0]] / 0.11 + 2.0
                there = np.flatnonzero(np.hypot(*(positions[j, : last + 1] - place).T) <= radius)
                arrival = max(t + drive, there[0]) if len(there) else math.inf
                if len(there) and there[-1] >= arrival:
                    row.append(scenario.rewards.interception - (arrival - t))
                else:
                    row.append(-(last - t) + (3.0 * scenario.rewards.mission_completed if ends else 0.0))
            rows.append(row)
        assert alike == len(rows)
        if rows:
            asked += 1
            assert found == pytest.approx(np.mean(rows, axis=0), abs=1e-3)
    assert asked > 40
