"""Ray casts against sphere tracing on the regions' own distances."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from tab_marl.envs.lidar import Lidar
from tab_marl.world.grid import free_points
from tab_marl.world.scenario import Scenario, Sensors


def traced(scenario: Scenario, x: float, y: float, angle: float, longest: float) -> float:
    """Slow twin: walk along the ray by the distance to the nearest solid until one is met."""
    travelled = 0.0
    for _ in range(10_000):
        px, py = x + travelled * math.cos(angle), y + travelled * math.sin(angle)
        gap = min(px, py, scenario.width_metres - px, scenario.height_metres - py)
        gap = min([gap, *(float(o.distance([[px, py]])[0]) for o in scenario.obstacles)])
        if gap < 1e-7:
            return travelled
        travelled += gap
        if travelled >= longest:
            return longest
    return travelled


@pytest.mark.parametrize("seed", range(4))
def test_scan_matches_sphere_tracing(mixed: Scenario, seed: int) -> None:
    rng = np.random.default_rng(seed)
    scenario = replace(mixed, sensors=Sensors(lidar_rays=7, lidar_metres=1.7))
    points = rng.uniform(0.05, 2.95, (40, 2))
    points = points[free_points(scenario, points, 0.03)]
    lidar = Lidar.of(scenario)
    for x, y in points[:12]:
        theta = rng.uniform(-math.pi, math.pi)
        ranges = lidar.scan(x, y, theta)
        angles = theta + 2 * math.pi * np.arange(7) / 7
        expected = [traced(scenario, x, y, angle, 1.7) for angle in angles]
        # Sphere tracing stops 1e-7 m off the surface, which along a grazing ray is a little more.
        assert ranges == pytest.approx(expected, abs=1e-4)


def test_interpreted_kernels_agree(mixed: Scenario) -> None:
    from tab_marl.envs import lidar_kernels as kernels

    lidar = Lidar.of(replace(mixed, sensors=Sensors(lidar_rays=3)))
    for angle in np.linspace(-3, 3, 9):
        arguments = (1.5, 1.0, math.cos(angle), math.sin(angle), 1.5, lidar.discs, lidar.edges)
        assert kernels.free_distance(*arguments) == pytest.approx(kernels.free_distance.py_func(*arguments), abs=1e-12)


def test_hand_made_ranges(mixed: Scenario) -> None:
    lidar = Lidar.of(replace(mixed, sensors=Sensors(lidar_rays=4, lidar_metres=1.5)))
    east, north, west, south = lidar.scan(1.5, 1.4, 0.0)
    assert east == pytest.approx(1.9 - 1.5), "the box's left side"
    assert west == pytest.approx(1.5 - (0.8 + 0.25)), "the disc's right end"
    assert south == pytest.approx(1.4), "the lower wall"
    assert north == pytest.approx(2.15 - 1.4), "the polygon's lower side at x = 1.5"


def test_line_of_sight(mixed: Scenario) -> None:
    lidar = Lidar.of(mixed)
    assert lidar.sees(0.4, 0.4, 2.6, 0.4)
    assert not lidar.sees(0.4, 1.4, 1.2, 1.4), "through the disc"
    assert not lidar.sees(1.7, 1.4, 2.6, 1.4), "through the box"
    assert lidar.sees(1.0, 1.0, 1.0, 1.0)
