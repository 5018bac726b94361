"""Reference processes against Monte Carlo of the motion they stand for, closed forms, symmetry and row sums."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest

from tab_marl.field import (
    Reference,
    paper_walk,
    reference_from_simulator,
    reference_from_trajectories,
    run_and_tumble,
    unicycle,
    walk,
)
from tab_marl.field.processes.isotropic import SHELLS, sphere
from tab_marl.field.processes.tumble import spatial_directions
from tab_marl.world.grid import GridMap
from tab_marl.world.kernels import unicycle_step
from tab_marl.world.regions import Box
from tab_marl.world.scenario import Robot, Scenario
from tab_marl.world.voxels import VoxelMap

OPEN_SPACE = VoxelMap.from_array(np.ones((9, 9, 9), dtype=bool), 0.5)
MIDDLE = int(OPEN_SPACE.cell_at[4, 4, 4])


def square(cells: int = 9, obstacles: tuple[Box, ...] = ()) -> GridMap:
    """Free cells of 0.5 m."""
    size = cells * 0.5
    scenario = Scenario(
        "square", (), Box(0, 0, 1, 1), Box(0, 0, 1, 1), size, size, obstacles=obstacles, adversary=Robot(0.01),
        central_zone_metres=0.3,
    )  # fmt: skip
    return GridMap.from_scenario(scenario, 0.5)


def row_of(reference: Reference, state: int, r: int = 0) -> np.ndarray:
    return reference.matrix(r)[[state]].toarray()[0]


def moments(grid: GridMap | VoxelMap, row: np.ndarray, cell: int) -> tuple[np.ndarray, np.ndarray]:
    """Mean displacement [D] and its covariance [D, D] of a row over cells."""
    away = grid.centres - grid.centres[cell]
    mean = row @ away
    return mean, (away * row[:, None]).T @ away - np.outer(mean, mean)


def test_walk_in_space_is_isotropic_and_as_fast_as_allowed() -> None:
    speed = 0.9
    row = row_of(walk(OPEN_SPACE, speed), MIDDLE)
    assert row.sum() == pytest.approx(1)
    mean, covariance = moments(OPEN_SPACE, row, MIDDLE)
    assert mean == pytest.approx([0, 0, 0], abs=1e-12)
    # Symmetry makes the covariance a multiple of the identity; rounding to cells adds, in each direction, the mean of
    # part * (1 - part) cells^2 (a Bernoulli variable), counted here move by move.
    unit, share = sphere(2)
    exact = sum(mass * speed**2 * radius**2 / 3 for radius, mass in SHELLS)
    part = np.stack([speed * radius * unit[:, 0] / 0.5 % 1 for radius, _ in SHELLS])
    rounding = sum(mass * (share @ (p * (1 - p))) for (_, mass), p in zip(SHELLS, part, strict=True)) * 0.25
    assert covariance == pytest.approx(np.eye(3) * (exact + rounding), abs=1e-9)
    reached = np.flatnonzero(row)
    furthest = np.abs(OPEN_SPACE.centres[reached] - OPEN_SPACE.centres[MIDDLE]).max()
    assert furthest == pytest.approx(1.0)  # full speed, rounded up to whole cells
    # Every symmetry of the cube leaves the row as it is.
    image = np.zeros(OPEN_SPACE.cell_at.shape)
    image[tuple(OPEN_SPACE.index.T)] = row
    for axes in ((1, 0, 2), (2, 1, 0), (0, 2, 1)):
        assert image.transpose(axes) == pytest.approx(image, abs=1e-14)
    assert image[::-1] == pytest.approx(image, abs=1e-14)


@pytest.mark.parametrize("steps", [2, 3, 5])
def test_sphere_integrates_polynomials(steps: int) -> None:
    unit, share = sphere(steps)
    assert np.linalg.norm(unit, axis=1) == pytest.approx(1)
    assert share.sum() == pytest.approx(1)
    assert (unit.T * share) @ unit == pytest.approx(np.eye(3) / 3, abs=1e-12)
    assert share @ unit[:, 0] ** 4 == pytest.approx(1 / 5, abs=0.03 / steps)  # the mean of x^4 over the sphere


def test_walks_never_enter_walls() -> None:
    free = np.random.default_rng(0).random((5, 6, 7)) < 0.6
    grid = VoxelMap.from_array(free, 1.0)
    for reference in (walk(grid, 1.3), paper_walk(grid, 1.3)):
        matrix = reference.matrix().toarray()
        assert matrix.sum(axis=1) == pytest.approx(1)
        for cell in range(grid.cells):
            away = np.abs(grid.centres[np.flatnonzero(matrix[cell])] - grid.centres[cell])
            assert away.max(initial=0) <= 2
    # The paper's: uniform over the free cells within reach, by hand.
    matrix = paper_walk(grid, 1.3).matrix().toarray()
    apart = np.linalg.norm(grid.centres[:, None] - grid.centres[None], axis=2)
    near = apart <= 1.3
    assert matrix == pytest.approx(near / near.sum(axis=1, keepdims=True))


@pytest.mark.parametrize(("asked", "count", "neighbours"), [(6, 6, {4}), (14, 14, {3, 4}), (16, 26, {3, 4})])
def test_run_and_tumble_in_space(asked: int, count: int, neighbours: set[int]) -> None:
    direction = spatial_directions(asked)
    assert len(direction) == count
    reference = run_and_tumble(OPEN_SPACE, 0.4, asked, 1.0)
    assert reference.modes == count + 1
    mix = reference.mix[0]
    assert mix.sum(axis=1) == pytest.approx(1)
    assert mix[:count, :count] == pytest.approx(mix[:count, :count].T)  # no heading is preferred
    shares = reference.mode_shares()
    assert shares[:count] == pytest.approx(shares[0])
    assert shares @ mix == pytest.approx(shares)
    redraw = 0.4 * 0.5
    off = mix[:count, :count] - redraw * 0.9 / count - np.diag(np.diag(mix[:count, :count] - redraw * 0.9 / count))
    assert set((off > 1e-12).sum(axis=1)) <= neighbours
    for mode in range(count):  # whichever mode is drawn, the move is its own direction at full speed
        at = MIDDLE * reference.modes + mode
        entries = slice(*reference.indptr[at : at + 2])
        cells = reference.indices[entries] // reference.modes
        assert (reference.indices[entries][reference.data[entries] > 0] % reference.modes == mode).all()
        moved = reference.data[entries] @ (OPEN_SPACE.centres[cells] - OPEN_SPACE.centres[MIDDLE])
        assert moved == pytest.approx(0.4 * direction[mode], abs=1e-12)
    for r, speed in enumerate((0.4, 0.1)):  # a speed limit shortens the moves and leaves the turning alone
        both = run_and_tumble(OPEN_SPACE, [0.4, 0.1], asked, 1.0)
        at = both.states * r + MIDDLE * both.modes
        entries = slice(*both.indptr[at : at + 2])
        moved = both.data[entries] @ (
            OPEN_SPACE.centres[both.indices[entries] // both.modes] - OPEN_SPACE.centres[MIDDLE]
        )
        assert moved == pytest.approx(speed * direction[0], abs=1e-12)


def test_unicycle_moves_as_unicycle_step_does() -> None:
    """Mean and covariance of (x, y) and mean turn from one heading, against Monte Carlo of the exact motion."""
    grid, headings, speed, turn = square(13), 16, 1.1, 0.91
    reference = unicycle(grid, speed, turn, headings)
    cell = int(grid.cell_at[6, 6])
    rng = np.random.default_rng(0)
    draws = 40_000
    for mode in (0, 3):
        heading = 2 * math.pi * mode / headings
        ends = np.array(
            [
                unicycle_step(0.0, 0.0, heading, v, w, 1.0)
                for v, w in zip(rng.uniform(0, speed, draws), rng.uniform(-turn, turn, draws), strict=True)
            ]
        )
        row = row_of(reference, cell * headings + mode).reshape(grid.cells, headings)
        assert row.sum() == pytest.approx(1)
        mean, covariance = moments(grid, row.sum(axis=1), cell)
        error = ends[:, :2].std(axis=0) / math.sqrt(draws)
        assert np.abs(mean - ends[:, :2].mean(axis=0)).max() < 5 * error.max()
        # Rounding adds at most a quarter of a cell squared to the variance, and none to the mean.
        excess = covariance - np.cov(ends[:, :2].T)
        assert (np.linalg.eigvalsh(excess) > -5 * error.max()).all()
        assert (np.linalg.eigvalsh(excess) < 0.25 * 0.5**2 + 5 * error.max()).all()
        # How the turn goes with the displacement: a left turn ends to the left.
        turned = (np.arange(headings) - mode + headings // 2) % headings - headings // 2
        turned = turned * 2 * math.pi / headings
        assert row.sum(axis=0) @ turned == pytest.approx(0, abs=1e-12)
        left = np.array([-math.sin(heading), math.cos(heading)])
        sideways = (grid.centres - grid.centres[cell]) @ left
        together = sideways @ row @ turned
        swung = (ends[:, 2] - heading + math.pi) % (2 * math.pi) - math.pi
        expected = (ends[:, :2] @ left * swung).mean()
        assert together == pytest.approx(expected, rel=0.03)
        assert np.abs(turned[row.sum(axis=0) > 0]).max() <= turn + 2 * math.pi / headings
    assert row_of(reference, cell * headings).reshape(grid.cells, headings)[:, 8].sum() == 0  # it cannot turn round


def test_unicycle_is_killed_at_walls_and_the_same_after_a_quarter_turn() -> None:
    grid = square(6, (Box(1.0, 1.0, 1.5, 2.0),))
    reference = unicycle(grid, [0.7, 0.3], 0.8, 8)
    matrix = reference.matrix().toarray()
    assert matrix.sum(axis=1).max() <= 1 + 1e-12
    assert matrix.sum(axis=1).min() >= 1 / 6 - 1e-12  # turning on the spot is always feasible
    corner = int(grid.cell_at[0, 0]) * 8
    assert matrix[corner + 5].sum() < 0.5 < matrix[corner + 1].sum()
    turned = unicycle(square(6, (Box(1.0, 1.0, 2.0, 1.5),)), 0.7, 0.8, 8)
    other = square(6, (Box(1.0, 1.0, 2.0, 1.5),))
    cell, mirrored = int(grid.cell_at[4, 1]), int(other.cell_at[1, 4])  # mirrored in the diagonal x = y
    row = matrix[cell * 8 + 1].reshape(grid.cells, 8)
    swapped = row_of(turned, mirrored * 8 + 1).reshape(other.cells, 8)
    image = np.zeros((6, 6, 8))
    image[grid.row, grid.column] = row
    image_swapped = np.zeros((6, 6, 8))
    image_swapped[other.row, other.column] = swapped
    across = (2 - np.arange(8)) % 8  # heading angle a becomes 90 degrees - a
    assert image.transpose(1, 0, 2)[:, :, across] == pytest.approx(image_swapped, abs=1e-12)


def test_estimated_shares_are_those_of_the_simulator() -> None:
    """A drift of 0.3 cells: from a start uniform in the cell, 0.3 of the mass crosses; walls take what they meet."""
    grid, samples = square(5), 4000

    def drift(states: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        return states + np.array([0.15, 0.0])

    matrix = reference_from_simulator(drift, grid, np.random.default_rng(0), samples).matrix().toarray()
    error = 5 * math.sqrt(0.3 * 0.7 / samples)
    for cell in range(grid.cells):
        row, column = int(grid.row[cell]), int(grid.column[cell])
        expected = np.zeros(grid.cells)
        expected[cell] = 0.7
        if column < 4:
            expected[grid.cell_at[row, column + 1]] = 0.3
        assert matrix[cell] == pytest.approx(expected, abs=error)


def test_estimated_from_a_unicycle_agrees_with_the_unicycle_reference() -> None:
    grid, headings, turn = square(7), 8, 0.9

    def drive(speed: float):  # type: ignore[no-untyped-def]
        def one_tick(states: np.ndarray, rng: np.random.Generator) -> np.ndarray:
            v, w = rng.uniform(0, speed, len(states)), rng.uniform(-turn, turn, len(states))
            return np.array(
                [
                    unicycle_step(*pose, *control, 1.0)
                    for pose, control in zip(states, zip(v, w, strict=True), strict=True)
                ]
            )

        return one_tick

    found = reference_from_simulator([drive(0.9), drive(0.4)], grid, np.random.default_rng(1), 300, headings=headings)
    known = unicycle(grid, [0.9, 0.4], turn, headings)
    cell = int(grid.cell_at[3, 3])
    for r in range(2):
        for mode in range(headings):
            a = row_of(found, cell * headings + mode, r).reshape(grid.cells, headings)
            b = row_of(known, cell * headings + mode, r).reshape(grid.cells, headings)
            mean, _ = moments(grid, a.sum(axis=1), cell)
            wanted, spread = moments(grid, b.sum(axis=1), cell)
            # The simulator starts anywhere in the heading's sector: its mean is shorter by sinc of half a sector.
            shrunk = wanted * np.sinc(1 / headings)
            assert np.abs(mean - shrunk).max() < 5 * math.sqrt(spread.max() / 300) + 0.03
            assert 0.5 * np.abs(a.sum(axis=0) - b.sum(axis=0)).sum() < 0.12
    assert np.isfinite(found.headings).all()


def test_a_simulator_in_space_and_motion_that_ends() -> None:
    grid = VoxelMap.from_array(np.ones((2, 2, 2), dtype=bool), 1.0)

    def up_or_lost(states: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        after = states + np.array([0.0, 0.0, 1.0])
        after[rng.random(len(states)) < 0.5] = np.nan
        return after

    matrix = reference_from_simulator(up_or_lost, grid, np.random.default_rng(0), 1000).matrix().toarray()
    assert matrix[:4, 4:] == pytest.approx(0.5 * np.eye(4), abs=0.08)
    assert matrix[:4].sum(axis=1) == pytest.approx(np.full(4, 0.5), abs=0.08)
    assert not matrix[4:].any()  # the upper layer leaves the map


def test_smoothing_is_a_dirichlet_posterior() -> None:
    grid = square(4)
    path = np.array([[0.25, 0.25], [0.75, 0.25], [0.75, 0.75], [0.75, 0.25], [1.25, 0.25]])
    prior = walk(grid, 0.5)
    k = 3.0
    found = reference_from_trajectories([path], grid, prior_samples=k, prior=prior).matrix().toarray()
    counts = np.zeros((grid.cells, grid.cells))
    cells = grid.cells_of(path)
    for before, after in itertools.pairwise(cells):
        counts[before, after] += 1
    expected = (counts + k * prior.matrix().toarray()) / (counts.sum(axis=1, keepdims=True) + k)
    assert found == pytest.approx(expected, abs=1e-14)
    # The pooled prior: displacements right (2), up (1), down (1); blocked ones leave their share to the others.
    pooled = reference_from_trajectories([path], grid, prior_samples=1e9).matrix().toarray()
    unseen = int(grid.cell_at[2, 1])
    share = {(2, 2): 2 / 4, (3, 1): 1 / 4, (1, 1): 1 / 4}
    for (row, column), wanted in share.items():
        assert pooled[unseen, grid.cell_at[row, column]] == pytest.approx(wanted, abs=1e-6)
    right_edge = int(grid.cell_at[2, 3])
    assert pooled[right_edge, grid.cell_at[3, 3]] == pytest.approx(1 / 2, abs=1e-6)


def test_recorded_headings() -> None:
    grid = square(5)
    turning = [(1.25, 1.25, 0.1), (1.75, 1.25, 1.5), (1.75, 1.75, 3.2), (1.25, 1.75, 4.6), (1.25, 1.25, 6.2)]
    reference = reference_from_trajectories([turning], grid, headings=4, prior_samples=1e-6)
    cell = int(grid.cell_at[2, 2])
    row = row_of(reference, cell * 4).reshape(grid.cells, 4)
    assert row[grid.cell_at[2, 3], 1] == pytest.approx(1, abs=1e-5)


@pytest.mark.parametrize(
    ("call", "says"),
    [
        (lambda grid: walk(grid, -1.0), "metres_per_tick is -1.0"),
        (lambda grid: run_and_tumble(grid, 0.1, 2), "headings is 2, must be >= 3"),
        (lambda grid: run_and_tumble(grid, 0.1, 8, 0.0), "mean_run_metres is 0.0"),
        (lambda grid: unicycle(grid, 0.1, -1.0), "radians_per_tick is -1.0"),
        (lambda grid: unicycle(OPEN_SPACE, 0.1, 1.0), "unicycle moves in the plane"),
        (lambda grid: reference_from_simulator(lambda s, r: s[:3], grid, np.random.default_rng(0)), "must be the same"),
        (lambda grid: reference_from_simulator(lambda s, r: s, grid, np.random.default_rng(0), 0), "samples_per_cell is 0"),
        (lambda grid: reference_from_trajectories([], grid), "hold no move"),
        (lambda grid: reference_from_trajectories([[[0.0, np.nan]]], grid), r"trajectories\[0\] has shape \(1, 2\)"),
        (lambda grid: reference_from_trajectories([[[0.3, 0.3]] * 3], grid, prior_samples=0.0), "never visited"),
        (lambda grid: reference_from_trajectories([[[0.3, 0.3]] * 3], grid, prior=walk(square(3), 0.5)), "prior is over 9"),
        (lambda grid: reference_from_trajectories([[[0.3, 0.3]] * 3], grid, headings=2), "headings is 2"),
    ],
)  # fmt: skip
def test_bad_input(call, says: str) -> None:  # type: ignore[no-untyped-def]
    with pytest.raises(ValueError, match=says):
        call(square(5))
