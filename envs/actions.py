"""Actions of the robots: what they mean, which are legal, and what is said about those that are not.

``continuous``  ``Box(-1, 1, (2,))``: ``a[0]`` is the speed, from -1 (stand still) to 1 (top speed), ``a[1]`` the turn rate, from
                -1 (clockwise at the top rate) to 1.
``discrete``    ``Discrete(15)``: number ``5 i + j`` drives at ``SPEEDS[i]`` of the top speed and turns at ``TURNS[j]`` of the
                top rate.
"""

from __future__ import annotations

from typing import Any, Literal, get_args

import numpy as np
from gymnasium.spaces import Box, Discrete
from numpy.typing import ArrayLike, NDArray

from tab_marl.world.scenario import Robot, UnknownName

ActionKind = Literal["continuous", "discrete"]
ACTION_KINDS: tuple[ActionKind, ...] = get_args(ActionKind)

SPEEDS = (0.0, 0.5, 1.0)
"""Share of the top speed."""
TURNS = (-1.0, -0.25, 0.0, 0.25, 1.0)
"""Share of the top turn rate; clockwise is negative."""
TABLE = tuple((speed, turn) for speed in SPEEDS for turn in TURNS)
"""Of the discrete actions: (speed, turn), both as shares."""

ROUNDING = 1e-6
"""An action may lie beyond its bound by so much, as float32 arithmetic leaves it, and is set to the bound."""
_BOUND = 1.0 + ROUNDING


def check_kind(kind: str) -> ActionKind:
    """The kind of action of this name. Raises UnknownName."""
    for known in ACTION_KINDS:
        if kind == known:
            return known
    raise UnknownName("kind of action", str(kind), ACTION_KINDS)


def action_space(kind: ActionKind) -> Box | Discrete:
    """The space of a robot's actions."""
    return Discrete(len(TABLE)) if kind == "discrete" else Box(-1.0, 1.0, (2,), dtype=np.float32)


def continuous_command(action: ArrayLike, agent: str, robot: Robot) -> tuple[float, float]:
    """(v [m/s], w [rad/s]) of a continuous action. Raises ValueError with agent, value and bound."""
    array = np.asarray(action)
    if array.shape != (2,) or array.dtype.kind not in "fiu":
        raise ValueError(_malformed(array, agent))
    speed, turn = array.tolist()
    if not (-_BOUND <= speed <= _BOUND and -_BOUND <= turn <= _BOUND):  # NaN fails as well
        raise ValueError(_beyond(speed, turn, agent))
    speed, turn = min(max(speed, -1.0), 1.0), min(max(turn, -1.0), 1.0)
    return (0.5 * (speed + 1.0) * robot.max_speed, turn * robot.max_turn_rate)


def discrete_command(action: Any, agent: str, robot: Robot) -> tuple[float, float]:
    """(v [m/s], w [rad/s]) of a discrete action. Raises ValueError with agent, value and bound."""
    array = np.asarray(action)
    if array.size != 1 or array.dtype.kind not in "iu":
        raise ValueError(
            f"the action of {agent!r} is {action!r}, must be one whole number in 0..{len(TABLE) - 1}: the environment was "
            "made with actions='discrete'"
        )
    number = int(array.item())
    if not 0 <= number < len(TABLE):
        raise ValueError(f"the action of {agent!r} is {number}, must lie in 0..{len(TABLE) - 1}")
    speed, turn = TABLE[number]
    return (speed * robot.max_speed, turn * robot.max_turn_rate)


COMMANDS = {"continuous": continuous_command, "discrete": discrete_command}


def nearest_discrete(action: NDArray[np.float32]) -> int:
    """The discrete action closest to a continuous one: speeds and turn rates are compared as shares."""
    speed, turn = 0.5 * (float(action[0]) + 1.0), float(action[1])
    i = min(range(len(SPEEDS)), key=lambda k: abs(SPEEDS[k] - speed))
    j = min(range(len(TURNS)), key=lambda k: abs(TURNS[k] - turn))
    return i * len(TURNS) + j


def _malformed(array: NDArray[Any], agent: str) -> str:
    if array.shape != (2,):
        return f"the action of {agent!r} has shape {list(array.shape)}, must be [2] (speed, turn rate)"
    return f"the action of {agent!r} has dtype {array.dtype}, must be two real numbers in [-1, 1]"


def _beyond(speed: float, turn: float, agent: str) -> str:
    name, value = ("speed", speed) if not -_BOUND <= speed <= _BOUND else ("turn rate", turn)
    if not np.isfinite(value):
        return f"the action of {agent!r} is {[speed, turn]}: its {name} must be a finite number in [-1, 1]"
    return (
        f"the action of {agent!r} is {[speed, turn]}: its {name} {value:g} lies outside [-1, 1]; clip actions "
        "(numpy.clip, gymnasium.wrappers.ClipAction) or scale the policy's output"
    )
