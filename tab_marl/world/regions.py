"""Planar shapes for goals, zones, cameras and obstacles.

Every shape answers two vectorised questions about points of shape ``[N, 2]`` in metres:
``contains`` (closed: the boundary belongs to the shape) and ``distance`` (0 inside, metres to the boundary outside).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]

# Boundaries are closed up to this rounding error, so that a point computed to lie on one counts as inside.
BOUNDARY_METRES = 1e-9


def _as_points(points: ArrayLike) -> Floats:
    array = np.asarray(points, dtype=np.float64)
    if array.ndim == 0 or array.shape[-1] != 2:
        raise ValueError(f"points must have shape [N, 2] in metres, got shape {array.shape}")
    return array


@dataclass(frozen=True)
class Disc:
    """A disc around (x, y)."""

    x: float
    """Centre, metres."""
    y: float
    """Centre, metres."""
    radius: float
    """Metres, > 0."""

    __pydantic_config__: ClassVar = {"extra": "forbid"}

    def __post_init__(self) -> None:
        if not self.radius > 0:
            raise ValueError(f"Disc.radius is {self.radius}, must be > 0 metres")

    @property
    def centre(self) -> tuple[float, float]:
        return (self.x, self.y)

    def distance(self, points: ArrayLike) -> Floats:
        p = _as_points(points)
        return np.maximum(0.0, np.hypot(p[..., 0] - self.x, p[..., 1] - self.y) - self.radius)

    def contains(self, points: ArrayLike) -> Bools:
        return self.distance(points) <= BOUNDARY_METRES

    def bounds(self) -> tuple[float, float, float, float]:
        """(x_min, y_min, x_max, y_max)."""
        return (self.x - self.radius, self.y - self.radius, self.x + self.radius, self.y + self.radius)


@dataclass(frozen=True)
class Box:
    """An axis-aligned rectangle."""

    x_min: float
    y_min: float
    x_max: float
    y_max: float

    __pydantic_config__: ClassVar = {"extra": "forbid"}

    def __post_init__(self) -> None:
        if not (self.x_max > self.x_min and self.y_max > self.y_min):
            raise ValueError(f"{self}: x_max must exceed x_min and y_max must exceed y_min")

    @property
    def centre(self) -> tuple[float, float]:
        return ((self.x_min + self.x_max) / 2, (self.y_min + self.y_max) / 2)

    def vertices(self) -> Floats:
        """Corners anticlockwise, ``[4, 2]`` metres."""
        return np.array(
            [(self.x_min, self.y_min), (self.x_max, self.y_min), (self.x_max, self.y_max), (self.x_min, self.y_max)]
        )

    def distance(self, points: ArrayLike) -> Floats:
        p = _as_points(points)
        dx = np.maximum(np.maximum(self.x_min - p[..., 0], p[..., 0] - self.x_max), 0.0)
        dy = np.maximum(np.maximum(self.y_min - p[..., 1], p[..., 1] - self.y_max), 0.0)
        return np.hypot(dx, dy)

    def contains(self, points: ArrayLike) -> Bools:
        return self.distance(points) <= BOUNDARY_METRES

    def bounds(self) -> tuple[float, float, float, float]:
        return (self.x_min, self.y_min, self.x_max, self.y_max)


@dataclass(frozen=True)
class Polygon:
    """A convex polygon, corners anticlockwise."""

    corners: tuple[tuple[float, float], ...]
    """At least three (x, y) corners in metres, anticlockwise and convex."""

    __pydantic_config__: ClassVar = {"extra": "forbid"}

    def __post_init__(self) -> None:
        v = np.asarray(self.corners, dtype=np.float64)
        if v.ndim != 2 or v.shape[0] < 3 or v.shape[1] != 2:
            raise ValueError(f"Polygon.corners needs at least 3 (x, y) pairs, got {self.corners}")
        edge = np.roll(v, -1, axis=0) - v
        following = np.roll(edge, -1, axis=0)
        turns = edge[:, 0] * following[:, 1] - edge[:, 1] * following[:, 0]
        if not np.all(turns > 0):
            raise ValueError(f"Polygon.corners must be convex and anticlockwise, got {self.corners}")

    @property
    def centre(self) -> tuple[float, float]:
        x, y = np.mean(self.vertices(), axis=0)
        return (float(x), float(y))

    def vertices(self) -> Floats:
        """Corners anticlockwise, ``[V, 2]`` metres."""
        return np.asarray(self.corners, dtype=np.float64)

    def distance(self, points: ArrayLike) -> Floats:
        p = _as_points(points)
        a = self.vertices()
        edge = np.roll(a, -1, axis=0) - a
        to_point = p[..., None, :] - a
        along = np.clip((to_point * edge).sum(-1) / (edge**2).sum(-1), 0.0, 1.0)
        gap = to_point - along[..., None] * edge
        outside = np.any(edge[:, 0] * to_point[..., 1] - edge[:, 1] * to_point[..., 0] < 0, axis=-1)
        return np.where(outside, np.hypot(gap[..., 0], gap[..., 1]).min(axis=-1), 0.0)

    def contains(self, points: ArrayLike) -> Bools:
        return self.distance(points) <= BOUNDARY_METRES

    def bounds(self) -> tuple[float, float, float, float]:
        (x_min, y_min), (x_max, y_max) = self.vertices().min(axis=0), self.vertices().max(axis=0)
        return (float(x_min), float(y_min), float(x_max), float(y_max))


Region = Disc | Box | Polygon


def sample_in(region: Region, rng: np.random.Generator, count: int) -> Floats:
    """``[count, 2]`` points uniform in the region, by rejection from its bounding box."""
    x_min, y_min, x_max, y_max = region.bounds()
    kept = np.empty((0, 2))
    while len(kept) < count:
        drawn = rng.uniform((x_min, y_min), (x_max, y_max), size=(2 * count + 8, 2))
        kept = np.concatenate([kept, drawn[region.contains(drawn)]])
    return kept[:count]
