"""The rules that Tag and LaserTag share, as look-up tables: how a robot moves on a map, and how the target flees from it.

These are the rules of the DESPOT package (AdaCompNUS/despot, ``base_tag.cpp``), which its authors published figures for (Ye et
al., JAIR 58, 2017). Implementations differ in two places. Here the target answers to where the robot was before the step and
moves on after a failed tag too; and each of its five chances (.2 each: two along x, two along y, one to stay) keeps its share
when the way is blocked: it is spent standing still. pomdp-py's Tag stands still on a failed tag and shares .8 out among the
free moves that lead away, so that its target is harder to corner; figures for one variant say little about the other.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

NORTH, EAST, SOUTH, WEST, TAG = range(5)
ACTION_NAMES = ("north", "east", "south", "west", "tag")
TARGET_SLOTS = 5
"""Equally likely moves of the target."""
ROLLOUT_SLOTS = 12
"""Equally likely moves of a rollout: 1, 2, 3 or 4 free moves share them evenly."""

Place: TypeAlias = tuple[int, int]
_STEPS = {NORTH: (0, 1), EAST: (1, 0), SOUTH: (0, -1), WEST: (-1, 0)}


def robot_moves(places: Sequence[Place]) -> NDArray[np.int16]:
    """``[C * 5]``: the robot's cell after (cell, action); it stays where the way is blocked, and when it tags."""
    cell = {place: number for number, place in enumerate(places)}
    after = [[_moved(cell, place, a) if a != TAG else cell[place] for a in range(5)] for place in places]
    return np.array(after, dtype=np.int16).ravel()


def target_moves(places: Sequence[Place]) -> NDArray[np.int16]:
    """``[C * C * 5]``: the target's cell after (robot, target, slot), 5 equally likely slots."""
    cell = {place: number for number, place in enumerate(places)}
    return np.array([_flights(cell, r, t) for r in places for t in places], dtype=np.int16).ravel()


def rollout_moves(places: Sequence[Place], stride: int) -> NDArray[np.int16]:
    """``[C * 5 * 12]``: ``action * stride + cell after`` of the moves worth trying after (cell, last action).

    Free moves that do not double back; if there are none, the free moves (Silver and Veness's Tag).
    """
    cell = {place: number for number, place in enumerate(places)}
    slots: list[int] = []
    for place in places:
        moves = [(d, _moved(cell, place, d)) for d in _STEPS]
        free = [move for move in moves if move[1] != cell[place]] or moves[:1]
        for last in range(5):
            worth_trying = [m for m in free if last == TAG or m[0] != (last + 2) % 4] or free
            for action, after in worth_trying:
                slots += [action * stride + after] * (ROLLOUT_SLOTS // len(worth_trying))
    return np.array(slots, dtype=np.int16)


def seen_values(places: Sequence[Place], discount: float = 0.95) -> NDArray[np.float64]:
    """``[C * C]``: the best return from (robot, target) if the target were always seen, by value iteration.

    What the target hides can only cost: no policy can expect more.
    """
    cells = len(places)
    robot = robot_moves(places).reshape(cells, 5).astype(int)
    target = target_moves(places).reshape(cells, cells, TARGET_SLOTS).astype(int)
    values = np.full((cells, cells), 10.0)
    for _ in range(400):
        after = np.stack([values[robot[:, a][:, None, None], target].mean(axis=2) for a in range(5)])
        returns = np.array([-1.0] * 4 + [-10.0])[:, None, None] + discount * after
        np.fill_diagonal(returns[TAG], 10.0)
        values = returns.max(axis=0)
    return np.ascontiguousarray(values.ravel())


def _moved(cell: dict[Place, int], place: Place, direction: int) -> int:
    dx, dy = _STEPS[direction]
    return cell.get((place[0] + dx, place[1] + dy), cell[place])


def _flights(cell: dict[Place, int], robot: Place, target: Place) -> list[int]:
    """The target's next cells, equally likely: away along each axis with .4 (split where level), else it stays."""
    (rx, ry), (tx, ty) = robot, target
    x = [EAST, WEST] if tx == rx else [EAST if tx > rx else WEST] * 2
    y = [NORTH, SOUTH] if ty == ry else [NORTH if ty > ry else SOUTH] * 2
    return [*(_moved(cell, target, d) for d in x + y), cell[target]]
