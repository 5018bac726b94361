"""Steps per second of the interception environment beside MPE2's simple_tag and a bare pymunk loop, in one run on one core.

simple_tag plays 1 against 1 with two obstacles, random actions, through its parallel API. The bare loop has the same walls and obstacles and two bodies that drive the same circles, their velocities assigned once
per environment step, and does nothing else but ten `Space.step`s: what pymunk leaves to any environment at this rate.

Both of the environment's agents act and observe at every step (0.1 s, ten physics substeps); the ego without lidar.

Run: OMP_NUM_THREADS=1 python benchmarks/env_speed.py      (pip install -e '.[benchmarks]' for MPE2)
"""

from __future__ import annotations

import math
import statistics
import time
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pymunk
from mpe2 import simple_tag_v3
from rich.console import Console
from rich.table import Table

from tab_marl.envs.intercept import InterceptEnv
from tab_marl.envs.single_agent import ego_env
from tab_marl.world.regions import Disc
from tab_marl.world.scenario import Scenario

STEPS = 500
"""Per repetition, and less than an episode."""
REPEATS = 9
STARTS = ((2.0, 2.6, 0.0), (1.5, 0.4, 0.0))
CIRCLE = (0.0, 1.0)
"""Half the top speed at the top turn rate: circles of 6 cm radius, in free space."""

Step = Callable[[int], object]


def rates(make: dict[str, Callable[[], Step]]) -> dict[str, float]:
    """Median steps per CPU second, the candidates taking turns."""
    found: dict[str, list[float]] = {name: [] for name in make}
    for _ in range(REPEATS):
        for name, begin in make.items():
            step = begin()
            began = time.process_time()
            for i in range(STEPS):
                step(i)
            found[name].append(STEPS / (time.process_time() - began))
    return {name: statistics.median(values) for name, values in found.items()}


def bare_pymunk(scenario: Scenario) -> Step:
    space = pymunk.Space()
    w, h = scenario.width_metres, scenario.height_metres
    boxes = [(-0.5, -0.5, 0.0, h), (w, 0.0, w + 0.5, h), (0.0, -0.5, w, 0.0), (0.0, h, w, h + 0.5)]
    outlines = [[(a, b), (c, b), (c, d), (a, d)] for a, b, c, d in boxes]
    outlines += [o.vertices().tolist() for o in scenario.obstacles if not isinstance(o, Disc)]
    space.add(*(pymunk.Poly(space.static_body, outline) for outline in outlines))
    bodies = []
    for x, y, _ in STARTS:
        body = pymunk.Body(1.0, pymunk.moment_for_circle(1.0, 0.0, 0.105))
        body.position = (x, y)
        space.add(body, pymunk.Circle(body, 0.105))
        bodies.append(body)

    def step(i: int) -> None:
        theta = 0.182 * i
        for body in bodies:
            body.velocity = (0.11 * math.cos(theta), 0.11 * math.sin(theta))
            body.angular_velocity = 1.82
        for _ in range(10):
            space.step(0.01)

    return step


def simple_tag() -> Step:
    env = simple_tag_v3.parallel_env(num_good=1, num_adversaries=1, num_obstacles=2, max_cycles=STEPS)
    env.reset(seed=0)
    rng = np.random.default_rng(0)
    actions = [{agent: int(rng.integers(5)) for agent in env.possible_agents} for _ in range(STEPS)]

    def step(i: int) -> None:
        env.step(actions[i])
        if not env.agents:
            env.reset()

    return step


UNDER_WAY = "Reach Checkpoint A within 59s"
"""A mission that is neither completed nor failed while the robots circle."""


def parallel(scenario: Scenario, actions: np.ndarray, mission: str = UNDER_WAY) -> Step:
    """Both agents act; `actions` ``[STEPS, 2, 2]``."""
    env = InterceptEnv(mission=mission, scenario=scenario)
    options = {"ego_start": STARTS[0], "adversary_start": STARTS[1]}
    env.reset(seed=0, options=options)
    given = [{"ego_0": ego, "adversary_0": adversary} for ego, adversary in actions.astype(np.float32)]

    def step(i: int) -> None:
        env.step(given[i])
        if not env.agents:
            env.reset(options=options)

    return step


def single_agent(scenario: Scenario) -> Step:
    env = ego_env(scenario=scenario, end_on_completion=False)
    env.reset(seed=0)
    action = np.array(CIRCLE, dtype=np.float32)

    def step(i: int) -> None:
        _, _, terminated, truncated, _ = env.step(action)
        if terminated or truncated:
            env.reset()

    return step


def main() -> None:
    lidar = Scenario.preset("lab")
    plain = replace(lidar, sensors=replace(lidar.sensors, lidar_rays=0))
    circles = np.tile(np.array(CIRCLE), (STEPS, 2, 1))
    random = np.random.default_rng(0).uniform(-1, 1, (STEPS, 2, 2))
    found = rates(
        {
            "bare pymunk loop": lambda: bare_pymunk(plain),
            "MPE2 simple_tag, 1 against 1": simple_tag,
            "parallel env": lambda: parallel(plain, circles),
            "parallel env, mission over": lambda: parallel(plain, circles, "M1"),
            "parallel env, mission M5": lambda: parallel(plain, circles, "M5"),
            "parallel env, random actions": lambda: parallel(plain, random),
            "parallel env, 12 lidar rays": lambda: parallel(lidar, circles),
            "Gymnasium view, scripted adversary": lambda: single_agent(plain),
        }
    )
    bare, peer = found["bare pymunk loop"], found["MPE2 simple_tag, 1 against 1"]
    table = Table("", "steps/s", "times simple_tag", "times the bare loop's cost")
    for name, steps in found.items():
        table.add_row(name, f"{steps:,.0f}", f"{steps / peer:.2f}", f"{bare / steps:.2f}")
    Console().print(table)


if __name__ == "__main__":
    main()
