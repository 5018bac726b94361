"""No window opens while testing, and small worlds that several tests use."""

from __future__ import annotations

import os

os.environ.setdefault("SDL_VIDEODRIVER", "dummy")

import pytest

from tab_marl.mission import Constraint, ConstraintType, Mission
from tab_marl.mission.tasks import Task
from tab_marl.world.regions import Box, Disc, Polygon
from tab_marl.world.scenario import Checkpoint, Scenario, Sensors


@pytest.fixture
def mixed() -> Scenario:
    """One obstacle of each shape, no lidar."""
    return Scenario(
        name="mixed",
        checkpoints=(Checkpoint("Checkpoint A", 0.5, 2.5), Checkpoint("Checkpoint B", 2.5, 0.5)),
        obstacles=(
            Box(1.9, 1.2, 2.3, 1.6),
            Disc(0.8, 1.4, 0.25),
            Polygon(((1.2, 2.1), (1.8, 2.2), (1.4, 2.6))),
        ),
        ego_start=Disc(2.6, 2.6, 0.2),
        adversary_start=Disc(0.4, 0.4, 0.2),
        sensors=Sensors(lidar_rays=0),
        horizon_seconds=30.0,
    )


@pytest.fixture
def reach_a(mixed: Scenario) -> Task:
    """Reach Checkpoint A within 20 s on `mixed`."""
    mission = Mission((Constraint(ConstraintType.DEADLINE, ("Checkpoint A",), seconds=20.0),), "reach A")
    return Task(mixed, mission, "", "custom", 1.5)
