"""LaserTag (Somani, Ye, Hsu and Lee, NeurIPS 2013): Tag on a map of 7 x 11 with 8 obstacles, and a noisy laser in 8 directions.

The rules are those of the DESPOT package (AdaCompNUS/despot, ``laser_tag.cpp``): moves, flight and rewards as in Tag
(`tab_marl.planning.textbook.chase_maps`); obstacles at random; the robot's first cell is known and the target's is not. A beam ends
at the first obstacle, border or the target; its reading is never beyond that, falls short of it by a half-normal error of standard
deviation 2.5, and is rounded down to whole units: some 1.5 million observations, of which a tree sees hardly any twice.

Published at discount .95: POMCP -19.58 +- 0.06 (Ye et al., JAIR 58, 2017); DESPOT -8.9 +- 0.2, POMCPOW
-10.3 +- 0.2, QMDP -10.5 +- 0.2, POMCP with progressive widening -10.6 +- 0.2, PFT-DPW -11.1 +- 0.2, POMCP -14.1 +- 0.2 (Sunberg and
Kochenderfer, ICAPS 2018, whose laser differs a little).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from tab_marl.planning.model import CompiledModel, StateRange
from tab_marl.planning.textbook import chase_maps
from tab_marl.planning.textbook import laser_tag_kernels as kernels
from tab_marl.planning.textbook.chase_maps import TAG, Place
from tab_marl.planning.textbook.choices import chosen

_COMPASS = [(0, 1), (1, 0), (0, -1), (-1, 0), (1, 1), (1, -1), (-1, -1), (-1, 1)]
_NOISE = 2.5
_READINGS = 16


class LaserTagData(NamedTuple):
    """What the functions of LaserTag read."""

    robot_moves: NDArray[np.int16]
    """``[C * 5]``."""
    target_moves: NDArray[np.int16]
    """``[C * C * 5]``."""
    rollout_moves: NDArray[np.int16]
    """``[C * 5 * 12]``: action * 128 + cell."""
    beams: NDArray[np.int8]
    """``[C * C * 8]``: which row of `readings` a beam draws from, by (robot, target, direction)."""
    readings: NDArray[np.float64]
    """``[kinds of beam, 16]`` cumulative: straight beams of 1.. cells, then diagonal ones."""
    seen_values: NDArray[np.float64]
    """``[C * C]``: best return at discount .95 if the target were always seen."""
    least_seen: float
    """The least of `seen_values`."""
    cells: int


def laser_tag_places(seed: int, width: int = 11, height: int = 7, obstacles: int = 8) -> list[Place]:
    """Free cells as (x, y) of a map whose obstacles are drawn by `seed`."""
    if not 2 <= width <= 11 or not 2 <= height <= 11 or not 0 <= obstacles <= width * height - 2:
        raise ValueError(
            f"a map of {width} x {height} with {obstacles} obstacles: sides must be 2..11, free cells 2 or more"
        )
    blocked = set(np.random.default_rng(seed).choice(width * height, size=obstacles, replace=False).tolist())
    return [(c % width, c // width) for c in range(width * height) if c not in blocked]


def laser_tag_data(places: Sequence[Place]) -> LaserTagData:
    """The tables of LaserTag on a map."""
    free = set(places)
    width, height = (1 + max(axis) for axis in zip(*places, strict=True))
    longest = max(width, height)
    beams = np.zeros((len(places), len(places), 8), dtype=np.int8)
    for r, (x, y) in enumerate(places):
        for direction, (dx, dy) in enumerate(_COMPASS):
            d = 1
            while (x + d * dx, y + d * dy) in free:
                d += 1
            diagonal = longest * (dx != 0 and dy != 0) - 1
            beams[r, :, direction] = d + diagonal
            for nearer in range(1, d):  # the target stops a beam as a wall does
                beams[r, places.index((x + nearer * dx, y + nearer * dy)), direction] = nearer + diagonal
    straight = np.array([_reading_chances(float(d)) for d in range(1, longest + 1)])
    slanted = np.array([_reading_chances(d * math.sqrt(2)) for d in range(1, longest + 1)])
    seen = chase_maps.seen_values(places)
    return LaserTagData(
        chase_maps.robot_moves(places),
        chase_maps.target_moves(places),
        chase_maps.rollout_moves(places, stride=kernels.STRIDE),
        beams.ravel(),
        np.concatenate([straight, slanted]),
        seen,
        float(seen.min()),
        len(places),
    )


def _reading_chances(distance: float) -> NDArray[np.float64]:
    """``[16]`` cumulative probabilities of the readings of a beam of this length."""
    edges = np.minimum(np.arange(1, _READINGS + 1), distance)
    below = np.array([1 + math.erf((edge - distance) / (_NOISE * math.sqrt(2))) for edge in edges])
    below[edges >= distance] = 1.0
    return below


def laser_tag(
    seed: int = 0,
    rollout: Literal["history", "seen", "engine"] = "history",
    data: LaserTagData | None = None,
) -> CompiledModel:
    """LaserTag on the map drawn by `seed` (or on `data`'s) as a compiled model.

    `rollout`: "history" tags when on the target and does not double back; "seen" takes the best return if the target were seen from
    now on; "engine" is uniformly random.
    """
    data = laser_tag_data(laser_tag_places(seed)) if data is None else data
    rollouts = {"history": kernels.history_rollout, "seen": kernels.seen_leaf, "engine": None}
    return CompiledModel(
        kernels.step,
        5,
        2,
        data,
        rollout=chosen("rollout of LaserTag", rollout, rollouts),
        action_names=chase_maps.ACTION_NAMES,
        upper=kernels.seen_value,
        upper_discount=0.95,
        states=StateRange([0, 0], [data.cells - 1] * 2),
    )


class LaserTagBelief:
    """The exact belief of LaserTag: the robot's cell is known, the target's is a distribution over the free cells."""

    def __init__(self, data: LaserTagData, robot: int, target: NDArray[np.float64] | None = None) -> None:
        self.data, self.robot = data, robot
        self.target = np.full(data.cells, 1 / data.cells) if target is None else target

    def sample(self, count: int, rng: np.random.Generator) -> NDArray[np.float64]:
        """``[count, 2]`` states."""
        targets = rng.choice(self.data.cells, size=count, p=self.target)
        return np.column_stack([np.full(count, self.robot), targets]).astype(np.float64)

    def updated(self, action: int, observation: int) -> LaserTagBelief:
        """Bayes' rule after a step that did not end the game; ValueError when the observation was impossible."""
        data, cells = self.data, self.data.cells
        before = self.target.copy()
        if action == TAG:
            before[self.robot] = 0.0
        moves = data.target_moves.reshape(cells, cells, chase_maps.TARGET_SLOTS)[self.robot]
        after = np.bincount(moves.ravel(), np.repeat(before / chase_maps.TARGET_SLOTS, chase_maps.TARGET_SLOTS), cells)
        robot = int(data.robot_moves[self.robot * 5 + action])
        posterior = after * self._chances(robot, observation)
        if not posterior.sum() > 0:
            raise ValueError(f"observation {observation} after action {action} is impossible from cell {self.robot}")
        return LaserTagBelief(data, robot, posterior / posterior.sum())

    def _chances(self, robot: int, observation: int) -> NDArray[np.float64]:
        """``[C]``: P(observation | the robot's cell, each cell of the target)."""
        here = np.arange(self.data.cells) == robot
        if observation == kernels.SEES_TARGET:
            return here.astype(np.float64)
        beams = self.data.beams.reshape(self.data.cells, self.data.cells, 8)[robot]
        chances = np.diff(self.data.readings, axis=1, prepend=0.0)
        seen = (observation >> (kernels.READING_BITS * np.arange(8))) & 15
        return np.asarray(chances[beams, seen].prod(axis=1) * ~here)
