"""On which side of obstacles and forbidden zones a way passes: fences that a way on the other side does not cross."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tab_marl.mission.automaton import FAILED, MissionAutomaton
from tab_marl.mission.route import RouteField
from tab_marl.mission.route_kernels import MOVE_CELLS, MOVE_X, MOVE_Y
from tab_marl.world.grid import GridMap
from tab_marl.world.regions import Region


def zones(automaton: MissionAutomaton) -> NDArray[np.bool_]:
    """``[U, P]``: whether being in region p alone fails the mission at location u."""
    alone = 1 << np.arange(len(automaton.regions))
    return np.asarray((automaton.next_location[:, alone] == FAILED) | (automaton.forbidden_until[:, alone] > 0))


def failing_regions(automaton: MissionAutomaton) -> tuple[Region, ...]:
    """Regions that fail the mission at some of its locations."""
    return tuple(region for region, fails in zip(automaton.regions, zones(automaton).T, strict=True) if fails.any())


def fences_of_first_leg(
    chosen: RouteField, home: int, start: ArrayLike, regions: Sequence[Region]
) -> NDArray[np.int64]:
    """``[S, 16]``: how many fences a move crosses that stand across the chosen way, from the start ``[2]`` at location `home`
    to where that location ends."""
    cells, locations = chosen.path(home, start)
    leg = cells[: int(np.argmax(locations != home)) + 1]
    return fences_crossed(chosen.grid, regions, chosen.grid.centres[leg])


def fences_crossed(grid: GridMap, regions: Sequence[Region], way: NDArray[np.float64]) -> NDArray[np.int64]:
    """``[S, 16]``: how many fences a move crosses.

    A fence stands from the middle of each region outwards, across the way ``[K, 2]`` where it passes nearest, to the wall
    or region beyond. A way that passes the region on its other side does not cross it.
    """
    crossed = np.zeros((grid.cells, 16), dtype=np.int64)
    if len(way) < 2:
        return crossed
    moves = grid.cell_metres * MOVE_CELLS * np.stack([MOVE_X, MOVE_Y])
    between = (way[1:] + way[:-1]) / 2
    for region in regions:
        nearest = between[int(np.argmin(region.distance(between)))]
        middle = np.asarray(region.centre)
        length = float(np.hypot(*(nearest - middle)))
        if length == 0.0:
            continue
        (x, y), offset = (nearest - middle) / length, grid.centres - middle
        end = length + _open_metres(grid, regions, nearest, np.array([x, y]))
        # Beside the fence (its two sides differ in sign) and along it, before the move and after it.
        aside, along = offset @ (-y, x), offset @ (x, y)
        aside_after, along_after = aside[:, None] + (-y, x) @ moves, along[:, None] + (x, y) @ moves
        changes = (aside[:, None] >= 0) != (aside_after >= 0)
        share = aside[:, None] / np.where(changes, aside[:, None] - aside_after, 1.0)
        at = along[:, None] + share * (along_after - along[:, None])
        crossed += changes & (at >= 0) & (at <= end)
    return crossed


def _open_metres(
    grid: GridMap, regions: Sequence[Region], point: NDArray[np.float64], direction: NDArray[np.float64]
) -> float:
    """How far it is from the point, in this direction, to what is not free or lies in one of these regions."""
    steps = grid.cell_metres / 2 * np.arange(1, 4 * max(grid.cell_at.shape))
    points = point + steps[:, None] * direction
    rows, columns = (np.floor(points[:, axis] / grid.cell_metres).astype(int) for axis in (1, 0))
    height, width = grid.cell_at.shape
    inside = (rows >= 0) & (rows < height) & (columns >= 0) & (columns < width)
    closed = ~inside
    closed[inside] = grid.cell_at[rows[inside], columns[inside]] < 0
    for region in regions:
        closed |= region.contains(points)
    return float(steps[int(np.argmax(closed))])
