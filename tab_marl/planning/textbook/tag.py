"""Tag (Pineau, Gordon and Thrun, IJCAI 2003): a robot seeks a target that it sees only when on top of it."""

from __future__ import annotations

from functools import cache
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from tab_marl.planning.model import CompiledModel, StateRange
from tab_marl.planning.textbook import chase_maps
from tab_marl.planning.textbook import tag_kernels as kernels
from tab_marl.planning.textbook.chase_maps import TAG
from tab_marl.planning.textbook.choices import chosen

SEES_TARGET = kernels.SEES_TARGET
PLACES = [(x, y) for y in range(2) for x in range(10)] + [(x, y) for y in range(2, 5) for x in range(5, 8)]
"""The 29 cells as (x, y): two rows of ten and a block of 3 x 3 above columns 5 to 7."""


class TagData(NamedTuple):
    """Tag's moves as flat tables (all in the first-level cache)."""

    robot_moves: NDArray[np.int16]
    """``[29 * 5]`` robot cell after (cell, action)."""
    target_moves: NDArray[np.int16]
    """``[29 * 29 * 5]`` target cell after (robot, target, slot), 5 equally likely slots."""
    rollout_moves: NDArray[np.int16]
    """``[29 * 5 * 12]`` (action * 32 + cell after) of the moves worth trying after (cell, last action), 12 equally likely slots."""
    seen_values: NDArray[np.float64]
    """``[29 * 29]`` best return at discount .95 from (robot, target) if the target were always seen."""
    least_seen: float
    """The least of `seen_values`."""


def tag_data() -> TagData:
    """The tables of Tag."""
    return TagData(
        chase_maps.robot_moves(PLACES),
        chase_maps.target_moves(PLACES),
        chase_maps.rollout_moves(PLACES, stride=32),
        _seen_values(),
        float(_seen_values().min()),
    )


@cache
def _seen_values() -> NDArray[np.float64]:
    """By value iteration; what the target hides can only cost."""
    cells = kernels.CELLS
    robot = chase_maps.robot_moves(PLACES).reshape(cells, 5).astype(int)
    target = chase_maps.target_moves(PLACES).reshape(cells, cells, kernels.TARGET_SLOTS).astype(int)
    values = np.full((cells, cells), 10.0)
    for _ in range(400):
        after = np.stack([values[robot[:, a][:, None, None], target].mean(axis=2) for a in range(5)])
        returns = np.array([-1.0] * 4 + [-10.0])[:, None, None] + 0.95 * after
        np.fill_diagonal(returns[TAG], 10.0)
        values = returns.max(axis=0)
    return np.ascontiguousarray(values.ravel())


def tag(rollout: Literal["history", "uniform", "engine"] = "history", preferred: bool = False) -> CompiledModel:
    """Tag: 29 cells; a move costs 1, a failed tag 10, a tag on the target earns 10 and ends.

    The robot sees its own cell, and the target only when on it. The target knows where the robot was before this step; it flees
    with .4 along each axis and stays with .2; where the flight is blocked it stays; it moves after a failed tag too.
    Published at discount .95 (Ye et al., JAIR 58, 2017): SARSOP -6.03, POMCP -7.14, from the uniform belief.

    `rollout`: "history" tags when on the target and does not double back; "uniform" takes all actions alike, in one compiled
    call; "engine" leaves it to the engine's own random rollout. `preferred` starts such actions with 10 simulations.
    """
    rollouts = {"history": kernels.history_rollout, "uniform": kernels.uniform_rollout, "engine": None}
    return CompiledModel(
        kernels.step,
        5,
        2,
        tag_data(),
        rollout=chosen("rollout of Tag", rollout, rollouts),
        prior=kernels.preferred if preferred else None,
        action_names=chase_maps.ACTION_NAMES,
        upper=kernels.seen_value,
        upper_discount=0.95,
        states=StateRange([0, 0], [kernels.CELLS - 1] * 2),
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
