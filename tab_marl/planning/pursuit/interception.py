"""What a route of the ego is worth against sampled adversary paths: "walk there by the shortest path, then wait".

Interceptions on the way count, which is what a tree over single moves is too shallow to see.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from tab_marl.planning.pursuit import interception_kernels
from tab_marl.planning.pursuit.routes import RouteTable
from tab_marl.world.scenario import Rewards

NEVER = interception_kernels.NEVER


class RouteValues(NamedTuple):
    """One row per route, one column per sampled adversary path."""

    returns: NDArray[np.float32]
    """``[W, K]``: reward collected until the meeting, the mission's completion or the last tick."""
    met: NDArray[np.float32]
    """``[W, K]``: ticks until the meeting, or NEVER."""

    @property
    def mean(self) -> NDArray[np.float64]:
        """``[W]``: the expected return of each route."""
        return self.returns.mean(axis=1, dtype=np.float64)

    @property
    def met_share(self) -> NDArray[np.float64]:
        """``[W]``: the share of the paths that each route meets in time."""
        return (self.met >= 0).mean(axis=1, dtype=np.float64)


def value_routes(
    routes: RouteTable,
    positions: NDArray[np.floating],
    completed_tick: NDArray[np.int32],
    rewards: Rewards,
    interception_metres: float,
) -> RouteValues:
    """Value every route against adversary paths `positions` ``[K, H + 1, 2]`` that complete at `completed_tick` or -1.

    Between ticks both robots move straight; they meet as soon as their distance is `interception_metres`.
    Raises ValueError if the arrays do not fit together.
    """
    if positions.ndim != 3 or positions.shape[2] != 2 or completed_tick.shape != positions.shape[:1]:
        raise ValueError(
            f"positions must be [K, H + 1, 2] and completed_tick [K], got {positions.shape} and {completed_tick.shape}"
        )
    if min(positions.shape[1], routes.positions.shape[1]) < 2:
        raise ValueError("routes and positions must both reach at least one tick ahead")
    returns, met = interception_kernels.route_returns(
        routes.positions, routes.effort, np.ascontiguousarray(positions, dtype=np.float64),
        np.ascontiguousarray(completed_tick, dtype=np.int32), float(interception_metres),
        rewards.interception, rewards.per_step, rewards.control, rewards.mission_completed,
    )  # fmt: skip
    return RouteValues(returns, met)
