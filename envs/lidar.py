"""The lidar, and lines of sight: rays against the walls and the obstacles of a scenario.

The lidar senses the static map only, not the other robot: whom one sees is the cameras' business (for the ego) and
`Sensors.adversary_sees_ego_metres`' (for the adversary).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from tab_marl.envs import lidar_kernels as kernels
from tab_marl.world.regions import Disc
from tab_marl.world.scenario import Scenario


@dataclass(frozen=True, eq=False)
class Lidar:
    """The solid outlines of a scenario as arrays for the ray caster."""

    discs: NDArray[np.float64]
    """``[D, 3]``: x, y, radius of round obstacles, metres."""
    edges: NDArray[np.float64]
    """``[E, 4]``: x0, y0, x1, y1 of walls and obstacle sides, metres."""
    rays: int
    longest: float
    """Range in metres: what a ray reads that meets nothing before."""

    @classmethod
    def of(cls, scenario: Scenario) -> Lidar:
        """The lidar of this scenario (cached)."""
        return _lidar_of(scenario)

    def scan(self, x: float, y: float, theta: float) -> NDArray[np.float64]:
        """``[rays]`` metres, anticlockwise, the first along the heading theta [rad]."""
        scanned: NDArray[np.float64] = kernels.scan(x, y, theta, self.rays, self.longest, self.discs, self.edges)
        return scanned

    def sees(self, x: float, y: float, other_x: float, other_y: float) -> bool:
        """Whether the straight line between two points is free of obstacles."""
        dx, dy = other_x - x, other_y - y
        distance = math.hypot(dx, dy)
        if distance == 0.0:
            return True
        free = kernels.free_distance(x, y, dx / distance, dy / distance, distance, self.discs, self.edges)
        return bool(free >= distance)


@lru_cache(maxsize=256)
def _lidar_of(scenario: Scenario) -> Lidar:
    w, h = scenario.width_metres, scenario.height_metres
    outlines = [np.array([(0.0, 0.0), (w, 0.0), (w, h), (0.0, h)])]
    outlines += [o.vertices() for o in scenario.obstacles if not isinstance(o, Disc)]
    edges = np.concatenate([np.hstack([v, np.roll(v, -1, axis=0)]) for v in outlines])
    discs = np.array([(o.x, o.y, o.radius) for o in scenario.obstacles if isinstance(o, Disc)]).reshape(-1, 3)
    return Lidar(discs, edges, scenario.sensors.lidar_rays, scenario.sensors.lidar_metres)
