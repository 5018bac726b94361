"""Light-dark on a line, a problem with continuous observations: first walk away from the goal, to where one can see.

``SimpleLightDark`` of Sunberg and Kochenderfer (ICAPS 2018, section 5.2; zsunberg/ContinuousPOMDPTreeSearchExperiments.jl): the
position is a whole number in -60..60, moves are exact, and each step costs 1 and gives a reading of the position with standard
deviation ``|position - 10| + 0.0001``. Declaring to be at the origin ends it: +100 if so, -100 if not. The start is uniform on
-30..30. Discount .95. Their figures (1 s a move, 1,000 episodes): POMCP on bins .05 wide 61.1 +- 0.4, PFT-DPW 57.2 +- 0.5,
POMCPOW 56.1 +- 0.6, DESPOT on bins 1 wide 54.2 +- 1.1, a heuristic 42.4, POMCP and QMDP (no progressive widening) -7.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from tab_marl.planning.model import CompiledModel, ContinuousModel, StateRange
from tab_marl.planning.textbook import light_dark_kernels as kernels
from tab_marl.planning.textbook.choices import chosen

DECLARE = 2
"""The number of the action that ends it."""
DISCOUNT = 0.95
ROLLOUTS = {"full view": kernels.full_view_value, "random": kernels.random_walk}


class LightDarkData(NamedTuple):
    """What the functions of light-dark read."""

    moves: NDArray[np.float64]
    """``[5]``: what each action adds to the position; 0 declares."""
    full_view_values: NDArray[np.float64]
    """``[2 * radius + 1]``: the best return from each position if it were known, at discount .95."""
    radius: float
    light: float
    """Where readings are sharpest."""
    least_noise: float
    hit: float
    """Reward of declaring at the origin."""
    miss: float
    """Reward of declaring elsewhere."""
    bin_width: float


def light_dark_data(
    radius: int = 60, light: float = 10.0, least_noise: float = 1e-4, leap: int = 10, bin_width: float = 0.05
) -> LightDarkData:
    """The constants of light-dark; raises ValueError naming what is out of bounds."""
    if radius < 1 or leap < 2:
        raise ValueError(f"radius is {radius} and leap is {leap}, must be >= 1 and >= 2")
    if not least_noise > 0 or not bin_width > 0:
        raise ValueError(f"least_noise is {least_noise} and bin_width is {bin_width}, both must be > 0")
    moves = np.array([-leap, -1, 0, 1, leap], dtype=np.float64)
    return LightDarkData(
        moves, _full_view_values(radius, moves), float(radius), light, least_noise, 100.0, -100.0, bin_width
    )


def _full_view_values(radius: int, moves: NDArray[np.float64]) -> NDArray[np.float64]:
    """Best returns with the position known, by value iteration."""
    positions = np.arange(-radius, radius + 1)
    after = np.clip(positions + moves[:, None].astype(int), -radius, radius) + radius
    values = np.where(positions == 0, 100.0, -100.0)
    for _ in range(2 * radius + 1):
        walking = -1.0 + DISCOUNT * values[after[moves != 0]].max(axis=0)
        values = np.maximum(np.where(positions == 0, 100.0, -100.0), walking)
    return values


def light_dark_start(count: int, rng: np.random.Generator, radius: int = 60) -> NDArray[np.float64]:
    """``[count, 1]`` states of the initial belief."""
    return rng.integers(-(radius // 2), radius // 2 + 1, size=(count, 1)).astype(np.float64)


def light_dark(
    rollout: Literal["full view", "random"] = "full view", data: LightDarkData | None = None
) -> ContinuousModel:
    """Light-dark with its continuous readings, for `Pomcpow` and particle filters.

    `rollout`: "full view" is the best return if the position were known from now on, "random" walks at random.
    """
    function = chosen("rollout of light-dark", rollout, ROLLOUTS)
    data = light_dark_data() if data is None else data
    names = action_names(data.moves)
    return ContinuousModel(
        kernels.step, kernels.likelihood, 5, 1, 1, data, function, names, StateRange([-data.radius], [data.radius])
    )


def light_dark_binned(
    bin_width: float = 0.05, rollout: Literal["full view", "random"] = "full view", data: LightDarkData | None = None
) -> CompiledModel:
    """Light-dark whose readings are rounded to bins: the discrete problem that POMCP and DESPOT can be given."""
    function = chosen("rollout of light-dark", rollout, ROLLOUTS)
    data = light_dark_data(bin_width=bin_width) if data is None else data
    return CompiledModel(
        kernels.binned_step,
        5,
        1,
        data,
        rollout=function,
        action_names=action_names(data.moves),
        states=StateRange([-data.radius], [data.radius]),
    )


def action_names(moves: Sequence[float] | NDArray[np.float64]) -> tuple[str, ...]:
    return tuple("declare" if move == 0 else f"{move:+.0f}" for move in moves)
