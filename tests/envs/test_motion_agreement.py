"""The batched worlds' motion against the pymunk world: in free space, pushed against walls, and over whole drives.

What is promised (docs/environments/batched.md quotes these figures): one control step from the same pose ends within
STEP_METRES of pymunk's in contact and within FREE_METRES in free space; a quarter of a minute of driving into walls from
the same start ends within DRIVE_METRES in nine of ten drives.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import pytest

from tab_marl.envs.adversary_observation import AdversaryTask
from tab_marl.envs.motion_kernels import drive
from tab_marl.envs.physics import EGO, Arena
from tab_marl.envs.styles import Style
from tab_marl.mission.tasks import Task
from tab_marl.world.grid import free_points

FREE_METRES = 1e-9
STEP_METRES = 0.0025
"""A robot at top speed sinks 2.2 mm into a wall in the substep in which it meets it; the batched one does not."""
DRIVE_METRES = 0.02
SPEED = 0.03
"""m/s, in 99 of 100 steps: a corner passed within the last substep changes what the wall leaves."""
STEPS, DRIVES = 150, 30
PARKED = (-5.0, -5.0, 0.0)
"""The other robot is out of the way, beyond the walls."""


@dataclass
class Found:
    gaps: np.ndarray
    """``[N]`` metres after one control step from the same pose."""
    speeds: np.ndarray
    """``[N]`` m/s."""
    touched: np.ndarray
    """``[N, 2]`` pymunk's, ours."""
    ends: np.ndarray
    """``[DRIVES]`` metres after a whole drive."""


def compare(task: Task, pushing: bool) -> Found:
    scenario, radius = task.scenario, task.scenario.ego.radius_metres
    tables = AdversaryTask.build(scenario, task.mission, Style(), np.random.default_rng(0)).tables
    rng = np.random.default_rng(3)
    starts = rng.uniform(0, 3, (400, 2))
    starts = starts[free_points(scenario, starts, radius)][:DRIVES]
    gaps, speeds, touched, ends = [], [], [], []
    for start in starts:
        heading = rng.uniform(-math.pi, math.pi)
        arena = Arena(scenario, ((*start, heading), PARKED))
        own = (*start, heading)
        for step in range(STEPS):
            if step % 10 == 0:
                v, w = rng.uniform(0, 0.22), rng.uniform(-1.82, 1.82)
                if pushing:
                    v, w = 0.22, 0.0 if rng.random() < 0.6 else 0.5 * w
            pose = arena.motion(EGO)[:3]
            arena.command((v, w), (0.0, 0.0))
            arena.run(10)
            there = arena.motion(EGO)
            x, y, _, speed, hit = drive(tables, 0, *pose, v, w, radius, 0.01, 10)
            gaps.append(math.hypot(there.x - x, there.y - y))
            speeds.append(abs(there.v - speed))
            touched.append((arena.touching[EGO], hit))
            own = drive(tables, 0, *own, v, w, radius, 0.01, 10)[:3]
        ends.append(math.hypot(there.x - own[0], there.y - own[1]))
    return Found(np.array(gaps), np.array(speeds), np.array(touched), np.array(ends))


@pytest.mark.parametrize("pushing", [False, True])
def test_the_batched_motion_is_pymunks(reach_a: Task, pushing: bool) -> None:
    found = compare(reach_a, pushing)
    contact = found.touched.any(axis=1)
    assert 0.1 < contact.mean() < 0.9, "both free space and contact are driven"
    # In the step after a contact pymunk's motors take up a new command a substep later.
    free = ~contact & ~np.roll(contact, 1)
    assert found.gaps[free].max() < FREE_METRES
    assert found.gaps.max() < STEP_METRES
    assert np.percentile(found.speeds, 99) < SPEED
    assert (found.touched[:, 0] == found.touched[:, 1]).mean() > 0.99
    assert np.percentile(found.ends, 90) < DRIVE_METRES
    assert np.median(found.ends) < DRIVE_METRES / 4
