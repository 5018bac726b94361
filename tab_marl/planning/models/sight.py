"""Where the ego would have noticed the adversary: under a camera, beside itself and, if it is to watch it, within sight."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from tab_marl.planning.models import sight_kernels
from tab_marl.world.grid import free_points
from tab_marl.world.scenario import Scenario

SQUARE_METRES = 0.03
"""Of the raster on which lines of sight are tested; obstacles are many times wider."""


TOUCH_METRES = 1e-9
"""A region's distance is 0 inside: a point this far off is outside."""


@dataclass(frozen=True, eq=False)
class Sight:
    """Lines of sight of a scenario's map."""

    open_squares: NDArray[np.bool_]
    """``[rows, columns]``: whose centre lies in no obstacle."""
    square_metres: float = SQUARE_METRES

    @classmethod
    def of(cls, scenario: Scenario) -> Sight:
        """Cached."""
        return _sight_of(scenario)

    def watched(self, ego: tuple[float, float], points: NDArray[np.float64], radius: float) -> NDArray[np.bool_]:
        """``[N]``: which points ``[N, 2]`` the ego has within `radius` metres and in sight."""
        found: NDArray[np.bool_] = sight_kernels.watched(
            self.open_squares, self.square_metres, float(radius), float(ego[0]), float(ego[1]), points
        )
        return found


@lru_cache(maxsize=32)
def _sight_of(scenario: Scenario) -> Sight:
    columns = max(1, round(scenario.width_metres / SQUARE_METRES))
    rows = max(1, round(scenario.height_metres / SQUARE_METRES))
    x, y = (np.arange(columns) + 0.5) * SQUARE_METRES, (np.arange(rows) + 0.5) * SQUARE_METRES
    return Sight(free_points(scenario, np.stack(np.meshgrid(x, y), axis=-1), TOUCH_METRES))


def noticed(scenario: Scenario, points: NDArray[np.float64], ego: tuple[float, float]) -> NDArray[np.bool_]:
    """``[N]``: at which points ``[N, 2]`` the adversary would have been seen, or met, with the ego where it is."""
    found = scenario.seen(points) | (np.hypot(*(points - ego).T) <= scenario.interception_metres)
    if scenario.ego_task == "surveillance":
        found |= Sight.of(scenario).watched(ego, np.ascontiguousarray(points), scenario.watch_metres)
    return np.asarray(found)
