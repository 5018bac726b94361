"""What the ego observes: its own state and the clock exactly, the adversary only under a camera, and the lidar.

The layout is the table `ego_rows`; values are in metres, seconds, m/s and rad/s, one float32 per row:

==========================  ==========================================================================================
row                         meaning
==========================  ==========================================================================================
x, y                        own centre [m]
cos, sin                    own heading
v, w                        own speed [m/s] and turn rate [rad/s]
elapsed, left               seconds since the start and until the horizon
seen                        1 while a checkpoint camera sees the adversary (in surveillance also while the ego watches it;
                            always under `full_observation`), else 0
adversary x, y, cos, sin,   the adversary's state while seen, else 0
v, w
goal x, y                   centre of the region that the ego must reach [m]; ego task avoidance only
lidar 0 ..                  free distance [m], anticlockwise, the first ray along the heading
==========================  ==========================================================================================

With several adversaries (`team.TeamEnv`) the seven rows of the adversary come once for each, in order, and are followed by
one row "adversary k in play" each: 1 until it is intercepted or its mission ended it. With several egos the six rows of
every other ego follow, in order: egos always know of each other. The lidar stays last.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from gymnasium.spaces import Box
from numpy.typing import ArrayLike, NDArray

from tab_marl.envs.physics import Motion
from tab_marl.world.scenario import Robot, Scenario

ROWS_WITHOUT_LIDAR = 15
TIME_BOUND_SECONDS = 600.0
"""Bound of the two clocks, the same for shorter horizons, so that tasks of different length share one space."""
_SEEN = 8
_UNSEEN = (0.0,) * 7


class Row(NamedTuple):
    """One number of an observation."""

    name: str
    low: float
    high: float


def ego_rows(scenario: Scenario, egos: int = 1, adversaries: int = 1) -> tuple[Row, ...]:
    """The layout of an ego's observation, in order; with so many egos and adversaries in the arena."""
    w, h = scenario.width_metres, scenario.height_metres
    horizon = max(scenario.horizon_seconds, TIME_BOUND_SECONDS)
    names = [("seen", "adversary ")]
    if adversaries > 1:
        names = [(f"seen {j}", f"adversary {j} ") for j in range(adversaries)]
    return (
        *robot_rows("", scenario.ego, w, h),
        Row("elapsed", 0.0, horizon),
        Row("left", 0.0, horizon),
        *(row for name in names for row in (Row(name[0], 0.0, 1.0), *robot_rows(name[1], scenario.adversary, w, h))),
        *(Row(f"adversary {j} in play", 0.0, 1.0) for j in range(adversaries) if adversaries > 1),
        *(row for k in range(egos - 1) for row in robot_rows(f"other ego {k} ", scenario.ego, w, h)),
        *goal_rows(scenario),
        *(Row(f"lidar {i}", 0.0, scenario.sensors.lidar_metres) for i in range(scenario.sensors.lidar_rays)),
    )


def goal_rows(scenario: Scenario) -> tuple[Row, ...]:
    """Two rows of the ego's own goal; none where its task has none."""
    if scenario.ego_goal is None:
        return ()
    return (Row("goal x", 0.0, scenario.width_metres), Row("goal y", 0.0, scenario.height_metres))


def robot_rows(prefix: str, robot: Robot, width: float, height: float) -> tuple[Row, ...]:
    """Six rows of a robot's state: x, y, cos, sin, v, w."""
    # A wall can push a robot backwards, hence a speed below zero.
    return (
        Row(prefix + "x", 0.0, width),
        Row(prefix + "y", 0.0, height),
        Row(prefix + "cos", -1.0, 1.0),
        Row(prefix + "sin", -1.0, 1.0),
        Row(prefix + "v", -robot.max_speed, robot.max_speed),
        Row(prefix + "w", -robot.max_turn_rate, robot.max_turn_rate),
    )


def ego_space(scenario: Scenario, egos: int = 1, adversaries: int = 1) -> Box:
    """The Box of `ego_rows`, float32."""
    return box_of(ego_rows(scenario, egos, adversaries))


def box_of(rows: Sequence[Row]) -> Box:
    """The bounded float32 Box of a layout table."""
    low = np.array([row.low for row in rows], dtype=np.float32)
    high = np.array([row.high for row in rows], dtype=np.float32)
    return Box(low, high, dtype=np.float32)


def observe_ego(
    own: Motion,
    elapsed: float,
    left: float,
    adversary: Motion | None,
    ranges: NDArray[np.float64] | None,
    limits: tuple[float, float],
    goal: tuple[float, float] | None = None,
) -> NDArray[np.float32]:
    """The observation ``[15 + rays]``, two more with a goal; `adversary` is None while unseen, `limits` the top speeds of
    ego and adversary, `goal` the centre of the region that the ego must reach, if there is one."""
    values = [*robot_values(own, limits[0]), elapsed, left]
    if adversary is None:
        values += _UNSEEN
    else:
        values.append(1.0)
        values += robot_values(adversary, limits[1])
    if goal is not None:
        values += goal
    if ranges is not None:
        values += ranges.tolist()
    return np.array(values, dtype=np.float32)


def robot_values(motion: Motion, top_speed: float) -> tuple[float, float, float, float, float, float]:
    """The values of `robot_rows`; a speed beyond the top speed (a robot that was pushed) is clipped."""
    x, y, theta, v, w = motion
    return (x, y, math.cos(theta), math.sin(theta), min(max(v, -top_speed), top_speed), w)


@dataclass(frozen=True, slots=True)
class AdversaryView:
    """The adversary's state as a camera reports it: metres, rad, m/s, rad/s."""

    x: float
    y: float
    theta: float
    v: float
    w: float


def parse_adversaries(observation: ArrayLike, adversaries: int) -> tuple[AdversaryView | None, ...]:
    """Every adversary in an ego observation of an arena with so many; None for those that no camera sees.

    Raises ValueError if the observation is too short for them.
    """
    array = np.asarray(observation, dtype=np.float32)
    end = _SEEN + 7 * adversaries
    if array.ndim != 1 or array.shape[0] < end:
        raise ValueError(
            f"an ego observation with {adversaries} adversaries has {end} rows or more, got {list(array.shape)}"
        )
    blocks = array[_SEEN:end].reshape(adversaries, 7).tolist()
    return tuple(
        AdversaryView(x, y, math.atan2(sin, cos), v, w) if seen > 0.5 else None for seen, x, y, cos, sin, v, w in blocks
    )


@dataclass(frozen=True, slots=True)
class EgoView:
    """An ego observation with names: metres, rad in [-pi, pi], m/s, rad/s, seconds."""

    x: float
    y: float
    theta: float
    v: float
    w: float
    seconds: float
    """Since the start of the episode."""
    seconds_left: float
    """Until the horizon."""
    adversary: AdversaryView | None
    """None while no camera sees it."""
    lidar: NDArray[np.float32]
    """``[rays]`` metres."""
    goal: tuple[float, float] | None = None
    """Centre of the region that the ego must reach (avoidance)."""


def parse_ego_observation(observation: ArrayLike, scenario: Scenario | None = None) -> EgoView:
    """Read an ego observation by name. Raises ValueError on a wrong shape.

    `scenario`: needed where the ego has a goal of its own (avoidance); without it all rows after the first 15 are read as
    lidar. With several adversaries use `parse_adversaries`.
    """
    array = np.asarray(observation, dtype=np.float32)
    if array.ndim != 1 or array.shape[0] < ROWS_WITHOUT_LIDAR:
        raise ValueError(
            f"an ego observation has shape [{ROWS_WITHOUT_LIDAR} + lidar rays], got {list(array.shape)}: "
            "pass the array that the environment returned for 'ego_0'"
        )
    o = array[:ROWS_WITHOUT_LIDAR].tolist()
    adversary = None
    if o[_SEEN] > 0.5:
        adversary = AdversaryView(o[9], o[10], math.atan2(o[12], o[11]), o[13], o[14])
    goal, lidar_at = None, ROWS_WITHOUT_LIDAR
    if scenario is not None:
        rows = len(ego_rows(scenario))
        if array.shape[0] != rows:
            raise ValueError(
                f"an ego observation of scenario {scenario.name!r} has shape [{rows}], got {list(array.shape)}"
            )
        if scenario.ego_goal is not None:
            goal, lidar_at = (float(array[lidar_at]), float(array[lidar_at + 1])), lidar_at + 2
    return EgoView(
        o[0], o[1], math.atan2(o[3], o[2]), o[4], o[5], o[6], o[7], adversary, array[lidar_at:], goal
    )  # fmt: skip
