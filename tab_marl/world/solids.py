"""Shapes in space, the 3-D counterparts of `regions`: points have shape ``[N, 3]``, metres, z upwards.

Every solid answers ``contains`` (closed) and ``distance`` (0 inside), and ``grown`` by a margin.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tab_marl.world.regions import BOUNDARY_METRES

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]
Corner = tuple[float, float, float]


def _as_points(points: ArrayLike) -> Floats:
    array = np.asarray(points, dtype=np.float64)
    if array.ndim == 0 or array.shape[-1] != 3:
        raise ValueError(f"points must have shape [N, 3] in metres, got shape {array.shape}")
    return array


@dataclass(frozen=True)
class Ball:
    """A ball around (x, y, z)."""

    x: float
    y: float
    z: float
    radius: float
    """Metres, > 0."""

    __pydantic_config__: ClassVar = {"extra": "forbid"}

    def __post_init__(self) -> None:
        if not self.radius > 0:
            raise ValueError(f"Ball.radius is {self.radius}, must be > 0 metres")

    @property
    def centre(self) -> Corner:
        return (self.x, self.y, self.z)

    def distance(self, points: ArrayLike) -> Floats:
        away = np.linalg.norm(_as_points(points) - np.array(self.centre), axis=-1)
        return np.asarray(np.maximum(0.0, away - self.radius))

    def contains(self, points: ArrayLike) -> Bools:
        return np.asarray(self.distance(points) <= BOUNDARY_METRES)

    def bounds(self) -> tuple[Corner, Corner]:
        """(lower corner, upper corner)."""
        r = self.radius
        return (self.x - r, self.y - r, self.z - r), (self.x + r, self.y + r, self.z + r)

    def grown(self, metres: float) -> Ball:
        """With its surface moved outwards."""
        return Ball(self.x, self.y, self.z, self.radius + metres)


@dataclass(frozen=True)
class Cuboid:
    """An axis-aligned box in space."""

    x_min: float
    y_min: float
    z_min: float
    x_max: float
    y_max: float
    z_max: float

    __pydantic_config__: ClassVar = {"extra": "forbid"}

    def __post_init__(self) -> None:
        if not (self.x_max > self.x_min and self.y_max > self.y_min and self.z_max > self.z_min):
            raise ValueError(f"{self}: each max must exceed its min")

    @property
    def centre(self) -> Corner:
        return ((self.x_min + self.x_max) / 2, (self.y_min + self.y_max) / 2, (self.z_min + self.z_max) / 2)

    def distance(self, points: ArrayLike) -> Floats:
        lower, upper = (np.array(corner) for corner in self.bounds())
        p = _as_points(points)
        return np.asarray(np.linalg.norm(np.maximum(np.maximum(lower - p, p - upper), 0.0), axis=-1))

    def contains(self, points: ArrayLike) -> Bools:
        return np.asarray(self.distance(points) <= BOUNDARY_METRES)

    def bounds(self) -> tuple[Corner, Corner]:
        """(lower corner, upper corner)."""
        return (self.x_min, self.y_min, self.z_min), (self.x_max, self.y_max, self.z_max)

    def grown(self, metres: float) -> Cuboid:
        """With every face moved outwards (corners stay corners)."""
        (a, b, c), (d, e, f) = self.bounds()
        return Cuboid(a - metres, b - metres, c - metres, d + metres, e + metres, f + metres)


Solid = Ball | Cuboid
