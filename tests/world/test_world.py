"""Regions, grids and motion against brute force, scipy and closed forms."""

from __future__ import annotations

import math

import numpy as np
import pytest
from pydantic import TypeAdapter
from scipy.integrate import solve_ivp
from scipy.sparse import lil_matrix
from scipy.sparse.csgraph import dijkstra

from tab_marl.world import kernels
from tab_marl.world.grid import BLOCKED, GridMap
from tab_marl.world.presets import PRESETS
from tab_marl.world.regions import Box, Disc, Polygon, sample_in
from tab_marl.world.scenario import Checkpoint, Robot, Scenario, UnknownName

SHAPES = [
    Disc(0.4, 0.6, 0.3),
    Box(0.1, 0.2, 0.7, 0.5),
    Polygon(((0.1, 0.1), (0.9, 0.2), (0.6, 0.8))),
]


@pytest.mark.parametrize("shape", SHAPES, ids=lambda s: type(s).__name__)
def test_distance_is_the_distance_to_the_nearest_contained_point(shape: Disc | Box | Polygon) -> None:
    fine = np.stack(np.meshgrid(np.linspace(-0.1, 1.1, 601), np.linspace(-0.1, 1.1, 601)), -1).reshape(-1, 2)
    members = fine[shape.contains(fine)]
    for point in np.random.default_rng(0).uniform(-0.5, 1.5, size=(50, 2)):
        nearest = np.hypot(*(members - point).T).min()
        assert shape.distance(point[None])[0] == pytest.approx(nearest, abs=0.004)
        assert shape.contains(point[None])[0] == (shape.distance(point[None])[0] == 0)


@pytest.mark.parametrize("shape", SHAPES, ids=lambda s: type(s).__name__)
def test_sample_in_is_uniform(shape: Disc | Box | Polygon) -> None:
    drawn = sample_in(shape, np.random.default_rng(1), 20_000)
    assert shape.contains(drawn).all()
    fine = np.random.default_rng(2).uniform(0, 1, size=(200_000, 2))
    assert drawn.mean(axis=0) == pytest.approx(fine[shape.contains(fine)].mean(axis=0), abs=0.01)


def test_polygon_refuses_clockwise_corners() -> None:
    with pytest.raises(ValueError, match="anticlockwise"):
        Polygon(((0, 0), (0, 1), (1, 0)))


@pytest.mark.parametrize("name", PRESETS)
@pytest.mark.parametrize("cell_metres", [0.15, 0.25])
def test_geodesics_equal_scipy_dijkstra(name: str, cell_metres: float) -> None:
    grid = GridMap.from_scenario(Scenario.preset(name), cell_metres)
    cost = np.random.default_rng(3).uniform(0.5, 3.0, size=grid.cells)
    graph = lil_matrix((grid.cells, grid.cells))
    for cell in range(grid.cells):
        for dr, dc in kernels.MOVES:
            if _squares_free(grid, cell, int(dr), int(dc)):
                other = grid.cell_at[grid.row[cell] + dr, grid.column[cell] + dc]
                graph[cell, other] = math.hypot(dr, dc) * cell_metres * (cost[cell] + cost[other]) / 2
    sources = [0, grid.cells // 2]
    expected = dijkstra(graph.tocsr(), indices=sources, min_only=True)
    np.testing.assert_allclose(grid.distances(sources, cost), expected, rtol=1e-12)


def _squares_free(grid: GridMap, cell: int, dr: int, dc: int) -> bool:
    """Slow twin of free_move: every square that the open segment between the centres passes through is free."""
    rows, columns = grid.cell_at.shape
    r0, c0 = int(grid.row[cell]), int(grid.column[cell])
    if not (0 <= r0 + dr < rows and 0 <= c0 + dc < columns):
        return False
    # A little aside on both sides, so that a diagonal through a corner counts both squares it squeezes between.
    for aside in (-0.02, 0.02):
        for f in np.linspace(0, 1, 41):
            r = math.floor(r0 + 0.5 + f * dr + aside * dc)
            c = math.floor(c0 + 0.5 + f * dc - aside * dr)
            if grid.cell_at[r, c] == BLOCKED:
                return False
    return True


def test_cells_of_finds_the_nearest_free_cell() -> None:
    grid = GridMap.from_scenario(Scenario.preset("lab"), 0.1)
    assert (grid.cells_of(grid.centres) == np.arange(grid.cells)).all()
    inside_a_box = np.array([[1.05, 2.05]])
    found = grid.cells_of(inside_a_box)[0]
    gaps = np.hypot(*(grid.centres - inside_a_box).T)
    assert gaps[found] == gaps.min()


@pytest.mark.parametrize(("v", "w"), [(0.2, 0.0), (0.22, 1.3), (0.1, -1.8), (0.0, 1.0)])
def test_unicycle_is_the_solution_of_its_equations(v: float, w: float) -> None:
    start = (0.3, -0.2, 0.7)
    exact = solve_ivp(lambda _, s: (v * np.cos(s[2]), v * np.sin(s[2]), w), (0, 0.5), start, rtol=1e-10, atol=1e-12)
    x, y, theta = kernels.unicycle_step(*start, v, w, 0.5)
    assert (x, y) == pytest.approx(tuple(exact.y[:2, -1]), abs=1e-8)
    assert theta == pytest.approx(kernels.wrap_angle(exact.y[2, -1]), abs=1e-8)


def test_steering_arrives_and_stops() -> None:
    robot = Robot()
    x, y, theta = 0.0, 0.0, math.pi  # facing away
    for _ in range(80):
        v, w = kernels.steer(x, y, theta, 0.5, 0.3, robot.max_speed, robot.max_turn_rate, 0.1)
        assert 0 <= v <= robot.max_speed and abs(w) <= robot.max_turn_rate
        x, y, theta = kernels.unicycle_step(x, y, theta, v, w, 0.1)
    assert math.hypot(x - 0.5, y - 0.3) < 0.01


@pytest.mark.parametrize("name", PRESETS)
def test_scenario_survives_json(name: str) -> None:
    adapter = TypeAdapter(Scenario)
    assert adapter.validate_json(adapter.dump_json(Scenario.preset(name))) == Scenario.preset(name)


def test_names_and_aliases() -> None:
    lab = Scenario.preset("lab")
    assert lab.region("checkpoint 2") == lab.region("Checkpoint B") == lab.checkpoints[1].region
    assert lab.region("Center of the environment") == lab.region("central zone")
    with pytest.raises(UnknownName, match="did you mean 'Checkpoint A'"):
        lab.region("Checkpiont A")
    with pytest.raises(UnknownName, match="did you mean 'lab'"):
        Scenario.preset("labb")


def test_bad_scenarios_are_refused_with_the_numbers() -> None:
    lab = Scenario.preset("lab")
    with pytest.raises(ValueError, match=r"max_speed is -1"):
        Robot(max_speed=-1)
    with pytest.raises(ValueError, match=r"physics_hertz \(100\) must be a multiple of control_hertz \(30\)"):
        Scenario("x", lab.checkpoints, lab.ego_start, lab.adversary_start, control_hertz=30)
    with pytest.raises(ValueError, match="lies outside the"):
        Scenario("x", (Checkpoint("Checkpoint A", 4, 1),), lab.ego_start, lab.adversary_start)
    with pytest.raises(ValueError, match="unique"):
        Scenario("x", (Checkpoint("P", 1, 1), Checkpoint("p", 2, 2)), lab.ego_start, lab.adversary_start)


def test_cameras_see_their_discs() -> None:
    lab = Scenario.preset("lab")
    a = lab.checkpoints[0]
    points = [(a.x, a.y), (a.x + a.camera_metres - 1e-6, a.y), (a.x + a.camera_metres + 1e-6, a.y)]
    assert lab.seen(points).tolist() == [True, True, False]
