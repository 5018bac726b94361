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
    after = [[_moved(places, c, a) if a != TAG else c for a in range(5)] for c in range(len(places))]
    return np.array(after, dtype=np.int16).ravel()


def target_moves(places: Sequence[Place]) -> NDArray[np.int16]:
    """``[C * C * 5]``: the target's cell after (robot, target, slot), 5 equally likely slots."""
    cells = range(len(places))
    return np.array([_flights(places, r, t) for r in cells for t in cells], dtype=np.int16).ravel()


def rollout_moves(places: Sequence[Place], stride: int) -> NDArray[np.int16]:
    """``[C * 5 * 12]``: ``action * stride + cell after`` of the moves worth trying after (cell, last action).

    Free moves that do not double back; if there are none, the free moves (Silver and Veness's Tag).
    """
    slots: list[int] = []
    for cell in range(len(places)):
        free = [(d, after) for d in _STEPS if (after := _moved(places, cell, d)) != cell] or [(NORTH, cell)]
        for last in range(5):
            moves = [m for m in free if last == TAG or m[0] != (last + 2) % 4] or free
            for action, after in moves:
                slots += [action * stride + after] * (ROLLOUT_SLOTS // len(moves))
    return np.array(slots, dtype=np.int16)


def _moved(places: Sequence[Place], cell: int, direction: int) -> int:
    (x, y), (dx, dy) = places[cell], _STEPS[direction]
    return places.index((x + dx, y + dy)) if (x + dx, y + dy) in places else cell


def _flights(places: Sequence[Place], robot: int, target: int) -> list[int]:
    """The target's next cells, equally likely: away along each axis with .4 (split where level), else it stays."""
    (rx, ry), (tx, ty) = places[robot], places[target]
    x = [EAST, WEST] if tx == rx else [EAST if tx > rx else WEST] * 2
    y = [NORTH, SOUTH] if ty == ry else [NORTH if ty > ry else SOUTH] * 2
    return [*(_moved(places, target, d) for d in x + y), target]
