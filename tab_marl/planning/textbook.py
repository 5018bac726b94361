"""Textbook POMDPs with published values, to hold the planner against: Tiger and Tag."""

from __future__ import annotations

from dataclasses import replace
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from tab_marl.planning import textbook_kernels as kernels
from tab_marl.planning.model import CompiledModel, table_model

LISTEN, OPEN_LEFT, OPEN_RIGHT = 0, 1, 2
HEAR_LEFT, HEAR_RIGHT = 0, 1

NORTH, EAST, SOUTH, WEST, TAG = 0, 1, 2, 3, kernels.TAG
SEES_TARGET = kernels.SEES_TARGET


def tiger(accuracy: float = 0.85, rollout: Literal["patient", "engine"] = "patient") -> CompiledModel:
    """Tiger (Kaelbling, Littman and Cassandra, AIJ 1998): listen for -1, a good door is worth 10, the tiger's -100.

    State 0: the tiger is left; opening a door places it anew. With `accuracy` .85 and discount .95 the best value from the
    uniform belief is 19.37: listen until one side was heard twice more often than the other. `rollout` "patient" does just that
    from scratch; "engine" opens doors at random for -30 a step, under which a tree of a million simulations stays buried.
    """
    stay, anew = np.eye(2), np.full((2, 2), 0.5)
    hear = np.array([[accuracy, 1 - accuracy], [1 - accuracy, accuracy]])
    model = table_model(
        transition=[stay, anew, anew],
        observation=[hear, anew, anew],
        reward=[[-1, -1], [-100, 10], [10, -100]],
        action_names=("listen", "open left", "open right"),
    )
    return replace(model, rollout=kernels.patient_rollout) if rollout == "patient" else model


class TagData(NamedTuple):
    """Tag's moves as flat tables (all in the first-level cache)."""

    robot_moves: NDArray[np.int16]
    """``[29 * 5]`` robot cell after (cell, action)."""
    target_moves: NDArray[np.int16]
    """``[29 * 29 * 5]`` target cell after (robot, target, slot), 5 equally likely slots."""
    rollout_moves: NDArray[np.int16]
    """``[29 * 5 * 12]`` (action * 32 + cell after) of the moves worth trying after (cell, last action), 12 equally likely slots."""
    rollout_steps: NDArray[np.int64]
    """``[1]`` steps simulated inside rollouts, a counter for benchmarks."""


_MAP = [(x, y) for y in range(2) for x in range(10)] + [(x, y) for y in range(2, 5) for x in range(5, 8)]
"""The 29 cells: two rows of ten and a block of 3 x 3 above columns 5 to 7."""
_STEPS = {NORTH: (0, 1), EAST: (1, 0), SOUTH: (0, -1), WEST: (-1, 0)}
_CELL = {place: cell for cell, place in enumerate(_MAP)}


def _moved(cell: int, direction: int) -> int:
    (x, y), (dx, dy) = _MAP[cell], _STEPS[direction]
    return _CELL.get((x + dx, y + dy), cell)


def _flights(robot: int, target: int) -> list[int]:
    """The target's next cells, equally likely: away along each axis with .4 (split where level), else it stays."""
    (rx, ry), (tx, ty) = _MAP[robot], _MAP[target]
    x = [EAST, WEST] if tx == rx else [EAST if tx > rx else WEST] * 2
    y = [NORTH, SOUTH] if ty == ry else [NORTH if ty > ry else SOUTH] * 2
    return [_moved(target, d) for d in x + y] + [target]


def _worth_trying(cell: int, last: int) -> list[tuple[int, int]]:
    """(action, cell after) of the free moves that do not double back; if there are none, of the free moves."""
    free = [(d, _moved(cell, d)) for d in _STEPS if _moved(cell, d) != cell]
    return [m for m in free if last == TAG or m[0] != (last + 2) % 4] or free


def tag_data() -> TagData:
    """The tables of Tag."""
    cells = range(kernels.CELLS)
    robot = [_moved(c, a) if a != TAG else c for c in cells for a in range(5)]
    target = [after for r in cells for t in cells for after in _flights(r, t)]
    rollout = []
    for c in cells:
        for last in range(5):
            moves = _worth_trying(c, last)
            each = kernels.ROLLOUT_SLOTS // len(moves)
            rollout += [a * 32 + after for a, after in moves for _ in range(each)]
    return TagData(
        np.array(robot, dtype=np.int16),
        np.array(target, dtype=np.int16),
        np.array(rollout, dtype=np.int16),
        np.zeros(1, dtype=np.int64),
    )


def tag(rollout: Literal["history", "uniform", "engine"] = "history", preferred: bool = False) -> CompiledModel:
    """Tag: 29 cells; a move costs 1, a failed tag 10, a tag on the target earns 10 and ends.

    The robot sees its own cell, and the target only when on it. The target knows where the robot was before this step; it flees
    with .4 along each axis and stays with .2; where the flight is blocked it stays; it moves after a failed tag too.
    Published at discount .95 (Ye et al., JAIR 58, 2017): SARSOP -6.03, POMCP -7.14, from the uniform belief.

    `rollout`: "history" tags when on the target and does not double back; "uniform" takes all actions alike, in one compiled
    call; "engine" leaves it to the engine's own random rollout. `preferred` starts such actions with 10 simulations.
    """
    function = {"history": kernels.history_rollout, "uniform": kernels.uniform_rollout, "engine": None}[rollout]
    return CompiledModel(
        kernels.step,
        5,
        2,
        tag_data(),
        rollout=function,
        prior=kernels.preferred if preferred else None,
        action_names=("north", "east", "south", "west", "tag"),
    )


class TagBelief:
    """The exact belief of Tag: the robot's cell is known, the target's is a distribution over 29 cells."""

    def __init__(self, robot: int, target: NDArray[np.float64] | None = None) -> None:
        self.robot = robot
        self.target = np.full(kernels.CELLS, 1 / kernels.CELLS) if target is None else target

    def sample(self, count: int, rng: np.random.Generator) -> NDArray[np.float64]:
        """``[count, 2]`` states."""
        targets = rng.choice(kernels.CELLS, size=count, p=self.target)
        return np.column_stack([np.full(count, self.robot), targets]).astype(np.float64)

    def updated(self, data: TagData, action: int, observation: int) -> TagBelief:
        """Bayes' rule after a step that did not end the game; ValueError when the observation was impossible."""
        before = self.target.copy()
        if action == TAG:
            before[self.robot] = 0.0
        moves = data.target_moves.reshape(kernels.CELLS, kernels.CELLS, kernels.TARGET_SLOTS)[self.robot]
        after = np.zeros(kernels.CELLS)
        np.add.at(after, moves.ravel(), np.repeat(before / kernels.TARGET_SLOTS, kernels.TARGET_SLOTS))
        robot = int(data.robot_moves[self.robot * 5 + action])
        here = after[robot]
        if observation == SEES_TARGET:
            after[:] = 0.0
        after[robot] = here if observation == SEES_TARGET else 0.0
        if not after.sum() > 0:
            raise ValueError(f"observation {observation} after action {action} is impossible from cell {self.robot}")
        return TagBelief(robot, after / after.sum())


def play_tag(
    plan: object, rng: np.random.Generator, data: TagData, discount: float = 0.95, max_steps: int = 90
) -> float:
    """The discounted return of one game in which ``plan(belief: TagBelief, rng) -> action`` chooses the moves."""
    if not callable(plan):
        raise TypeError("plan must be a function of (belief, rng) that returns an action")
    state = rng.integers(kernels.CELLS, size=2).astype(np.float64)
    belief = TagBelief(int(state[0]))
    word = rng.integers(2**64, size=1, dtype=np.uint64)
    total, weight = 0.0, 1.0
    for _ in range(max_steps):
        action = int(plan(belief, rng))
        observation, reward, terminal = kernels.step(state, action, data, word)
        total += weight * reward
        weight *= discount
        if terminal:
            break
        belief = belief.updated(data, action, int(observation))
    return total
