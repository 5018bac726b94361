"""Solids, volumes and voxel maps against brute force and scipy."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.sparse import lil_matrix
from scipy.sparse.csgraph import dijkstra

from tab_marl.world.grid import BLOCKED, GridMap
from tab_marl.world.scenario import Scenario, UnknownName
from tab_marl.world.solids import Ball, Cuboid, Solid
from tab_marl.world.volume import BallCheckpoint, Body, Volume
from tab_marl.world.voxels import VoxelMap

SOLIDS = [Ball(0.4, 0.6, 0.5, 0.3), Cuboid(0.1, 0.2, 0.3, 0.7, 0.5, 0.9)]


def tank(**changes: object) -> Volume:
    settings: dict[str, object] = {
        "name": "tank",
        "checkpoints": (BallCheckpoint("Ball 1", 1, 3, 1, 0.6), BallCheckpoint("Ball 2", 3, 3, 1, 0.6)),
        "adversary_start": Cuboid(0, 0, 0, 1, 1, 2),
        "width_metres": 4.0,
        "depth_metres": 4.0,
        "height_metres": 2.0,
        "obstacles": (Cuboid(1.5, 0, 0, 2.5, 2.5, 1.2), Ball(3, 1, 1.5, 0.4)),
        "adversary": Body(0.2, 1.0),
    }
    return Volume(**(settings | changes))  # type: ignore[arg-type]


@pytest.mark.parametrize("solid", SOLIDS, ids=lambda s: type(s).__name__)
def test_distance_is_the_distance_to_the_nearest_contained_point(solid: Solid) -> None:
    axis = np.linspace(-0.1, 1.1, 121)
    fine = np.stack(np.meshgrid(axis, axis, axis), -1).reshape(-1, 3)
    members = fine[solid.contains(fine)]
    lower, upper = solid.bounds()
    assert members.min(axis=0) == pytest.approx(lower, abs=0.011)
    assert members.max(axis=0) == pytest.approx(upper, abs=0.011)
    points = np.random.default_rng(0).uniform(-0.5, 1.5, size=(30, 3))
    nearest = np.array([np.linalg.norm(members - point, axis=1).min() for point in points])
    assert solid.distance(points) == pytest.approx(nearest, abs=0.012)
    assert np.array_equal(solid.contains(points), solid.distance(points) == 0)
    beyond = solid.grown(0.2)
    inside = solid.distance(points) <= 0.2
    assert (beyond.contains(points) >= inside).all()  # corners stay corners: a grown box holds a little more
    if isinstance(solid, Ball):
        assert np.array_equal(beyond.contains(points), inside)


def test_solids_refuse_bad_numbers() -> None:
    with pytest.raises(ValueError, match=r"Ball.radius is 0.0, must be > 0"):
        Ball(0, 0, 0, 0.0)
    with pytest.raises(ValueError, match="each max must exceed"):
        Cuboid(0, 0, 0, 1, 1, 0)
    with pytest.raises(ValueError, match=r"shape \[N, 3\]"):
        Ball(0, 0, 0, 1).contains([[0.0, 0.0]])


def test_free_cells_are_where_the_body_fits() -> None:
    volume = tank()
    grid = VoxelMap.from_volume(volume, 0.25)
    assert VoxelMap.from_volume(volume, 0.25) is grid
    assert grid.cell_at.shape == (8, 16, 16)
    expected = 0
    for layer, row, column in np.ndindex(grid.cell_at.shape):
        point = (np.array([column, row, layer]) + 0.5) * 0.25
        fits = all(0.2 <= at <= size - 0.2 for at, size in zip(point, volume.size_metres, strict=True))
        fits = fits and all(obstacle.distance(point) >= 0.2 for obstacle in volume.obstacles)
        cell = grid.cell_at[layer, row, column]
        assert (cell != BLOCKED) == fits
        if fits:
            assert cell == expected
            assert grid.centres[cell] == pytest.approx(point)
            expected += 1
    assert grid.cells == expected
    points = np.random.default_rng(1).uniform(0, 2, size=(200, 3))
    nearest = np.linalg.norm(grid.centres[None] - points[:, None], axis=2)
    found = grid.cells_of(points)
    own = grid.cell_at[tuple((points[:, ::-1] / 0.25).astype(int).T)]
    assert np.array_equal(found[own != BLOCKED], own[own != BLOCKED])
    lost = own == BLOCKED
    assert nearest[lost, found[lost]] == pytest.approx(nearest[lost].min(axis=1))
    values = np.arange(grid.cells, dtype=float)
    assert grid.image(values)[tuple(grid.index.T)] == pytest.approx(values)


def test_distances_equal_scipy_dijkstra() -> None:
    grid = VoxelMap.from_volume(tank(), 0.5)
    graph = lil_matrix((grid.cells, grid.cells))
    for cell in range(grid.cells):
        for move in np.ndindex(3, 3, 3):
            other_at = grid.index[cell] + np.array(move) - 1
            if (other_at < 0).any() or (other_at >= grid.cell_at.shape).any():
                continue
            other = grid.cell_at[tuple(other_at)]
            if other not in (BLOCKED, cell):
                graph[cell, other] = 0.5 * np.linalg.norm(np.array(move) - 1)
    every = dijkstra(graph.tocsr())
    sources = [3, 40]
    np.testing.assert_allclose(grid.distances(sources), every[sources].min(axis=0))
    assert np.isinf(grid.distances([])).all()


def test_volume_names_its_places() -> None:
    volume = tank(aliases=(("buoy", "Ball 2"),), central_zone_metres=0.3)
    assert volume.region("BUOY") == volume.region("checkpoint 2") == volume.region("checkpoint b") == Ball(3, 3, 1, 0.6)
    assert volume.region("central ball") == Ball(2, 2, 1, 0.3)
    assert volume.checkpoints[0].sensor == Ball(1, 3, 1, 1.0)
    with pytest.raises(UnknownName, match="did you mean 'Ball 1'"):
        volume.region("Bal 1")
    with pytest.raises(ValueError, match="name a region"):
        volume.place((1.0, 2.0))


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"height_metres": 0.0}, "Volume.height_metres is 0.0, must be > 0"),
        ({"height_metres": 0.9}, r"Ball 1 at \(1, 3, 1\) lies outside the 4.0 x 4.0 x 0.9 m box"),
        ({"regions": (("ball 1", Ball(1, 1, 1, 1)),)}, "repeated: .*ball 1"),
        ({"aliases": (("x", "nowhere"),)}, "no region named 'nowhere'"),
        ({"aliases": (("Ball 2", "Ball 1"),)}, "already the name"),
    ],
)
def test_volume_refuses(changes: dict[str, object], says: str) -> None:
    with pytest.raises((ValueError, UnknownName), match=says):
        tank(**changes)


def test_maps_refuse_what_cannot_be_laid_out() -> None:
    with pytest.raises(ValueError, match="cell_metres is 0, must be > 0"):
        VoxelMap.from_volume(tank(), 0)
    with pytest.raises(ValueError, match=r"4000 x 4000 x 2000 = 32,000,000,000 cells, more than 20,000,000"):
        VoxelMap.from_volume(tank(), 0.001)
    with pytest.raises(ValueError, match=r"30000 x 30000 = 900,000,000 cells"):
        GridMap.from_scenario(Scenario.preset("lab"), 0.0001)
    with pytest.raises(ValueError, match="no free cell"):
        VoxelMap.from_volume(tank(obstacles=(Cuboid(0, 0, 0, 4, 4, 2),)), 0.5)
    with pytest.raises(ValueError, match="must be 3-D"):
        VoxelMap.from_array(np.ones((3, 3), dtype=bool))
