"""The driven bodies against the exact unicycle in free space, and against geometry at walls and obstacles."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from tab_marl.envs.physics import ADVERSARY, EGO, Arena
from tab_marl.world.grid import free_points
from tab_marl.world.regions import Disc
from tab_marl.world.scenario import Scenario

STILL = (0.0, 0.0)
DEEPEST_METRES = 0.0025
"""A robot at top speed moves 2.2 mm in the substep in which it meets a wall."""


def unicycle(pose: np.ndarray, v: float, w: float, seconds: float) -> np.ndarray:
    """Circular arc of constant v and w, by rotating about the centre of the turning circle."""
    x, y, theta = pose
    if w == 0.0:
        return np.array([x + v * seconds * math.cos(theta), y + v * seconds * math.sin(theta), theta])
    centre = np.array([x, y]) + v / w * np.array([-math.sin(theta), math.cos(theta)])
    turn = w * seconds
    rotation = np.array([[math.cos(turn), -math.sin(turn)], [math.sin(turn), math.cos(turn)]])
    return np.array([*(centre + rotation @ (np.array([x, y]) - centre)), theta + turn])


def test_free_motion_is_the_exact_arc() -> None:
    scenario = replace(Scenario.preset("open"), width_metres=40.0, height_metres=40.0)
    poses = [np.array([20.0, 20.0, 0.3]), np.array([10.0, 10.0, -2.0])]
    arena = Arena(scenario, (tuple(poses[0]), tuple(poses[1])))
    rng = np.random.default_rng(1)
    for step in range(400):
        commands = [(rng.uniform(0, 0.22), rng.choice([0.0, rng.uniform(-1.82, 1.82)])) for _ in range(2)]
        arena.command(*commands)
        arena.run(10)
        for robot, (v, w) in enumerate(commands):
            poses[robot] = unicycle(poses[robot], v, w, 0.1)
            motion = arena.motion(robot)
            assert motion[:3] == pytest.approx(poses[robot], abs=1e-9), f"step {step}, robot {robot}"
            assert (motion.v, motion.w) == (v, w)
    assert arena.touching == [False, False]


@pytest.mark.parametrize("heading", [0.0, 0.7, 1.6, 2.4, 3.1, -2.3, -1.5, -0.8])
@pytest.mark.parametrize("start", [(2.6, 2.6), (1.5, 1.0), (1.0, 1.8), (2.4, 1.9)])
def test_nothing_is_driven_through(mixed: Scenario, start: tuple[float, float], heading: float) -> None:
    arena = Arena(mixed, ((*start, heading), (0.4, 0.4, 0.0)))
    radius = mixed.ego.radius_metres
    rng = np.random.default_rng(7)
    touched = False
    for step in range(180):
        arena.command((0.22, 0.0 if step < 120 else rng.uniform(-1, 1)), STILL)
        for _ in range(10):
            arena.substep()
            x, y = arena.motion(EGO)[:2]
            assert free_points(mixed, [[x, y]], radius - DEEPEST_METRES)[0], (
                f"step {step}: inside something at {x}, {y}"
            )
        touched |= arena.touching[EGO]
    assert touched, "the robot met nothing: the test shows nothing"
    assert not arena.touching[ADVERSARY]


def test_leaning_on_a_wall_settles_at_its_surface(mixed: Scenario) -> None:
    arena = Arena(mixed, ((2.8, 2.7, 0.0), (0.4, 0.4, 0.0)))
    for _ in range(50):
        arena.command((0.22, 0.0), STILL)
        arena.run(10)
    motion = arena.motion(EGO)
    assert motion.x == pytest.approx(3.0 - 0.105, abs=2e-4)
    assert motion.y == pytest.approx(2.7, abs=1e-9)
    assert arena.touching[EGO]
    assert abs(motion.v) < 1e-3, "the speed reported is what the wall leaves of the command"


def test_slides_along_a_wall(mixed: Scenario) -> None:
    """Without friction the tangential part of the command remains."""
    heading = math.radians(60.0)
    arena = Arena(mixed, ((2.85, 1.8, heading), (0.4, 0.4, 0.0)))
    for _ in range(40):
        arena.command((0.22, 0.0), STILL)
        arena.run(10)
    assert arena.touching[EGO]
    assert arena.motion(EGO).y - 1.8 == pytest.approx(4.0 * 0.22 * math.sin(heading), rel=0.02)


def test_turns_on_the_spot_against_a_wall_and_leaves(mixed: Scenario) -> None:
    arena = Arena(mixed, ((2.8, 2.5, 0.0), (0.4, 0.4, 0.0)))
    for v, w, steps in ((0.22, 0.0, 10), (0.0, math.pi / 2.0, 20), (0.22, 0.0, 20)):
        for _ in range(steps):
            arena.command((v, w), STILL)
            arena.run(10)
    motion = arena.motion(EGO)
    assert motion.theta == pytest.approx(math.pi, abs=1e-9)
    assert motion.x == pytest.approx(3.0 - 0.105 - 2.0 * 0.22, abs=0.004)
    assert not arena.touching[EGO]


def test_robots_do_not_pass_through_each_other(mixed: Scenario) -> None:
    arena = Arena(mixed, ((1.2, 0.4, math.pi), (0.7, 0.4, 0.0)))
    for _ in range(40):
        arena.command((0.22, 0.0), (0.22, 0.0))
        for _ in range(10):
            arena.substep()
            assert math.sqrt(arena.squared_gap()) > 0.21 - 2 * DEEPEST_METRES
    assert arena.touching == [False, False], "touching is about walls and obstacles only"


def test_a_fast_robot_does_not_tunnel() -> None:
    """Ten times the speed, a thin obstacle."""
    base = Scenario.preset("open")
    fast = replace(base, ego=replace(base.ego, max_speed=2.2), obstacles=(Disc(1.5, 1.5, 0.02),))
    arena = Arena(fast, ((1.0, 1.5, 0.0), (0.4, 0.4, 0.0)))
    for _ in range(10):
        arena.command((2.2, 0.0), STILL)
        arena.run(10)
    assert arena.motion(EGO).x < 1.5
