"""Scenarios by name."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

from tab_marl.world.regions import Box, Disc
from tab_marl.world.scenario import Checkpoint, Rewards, Scenario


def lab() -> Scenario:
    """The 3 x 3 m arena: five checkpoints (the fourth in the centre, as on the paper's project site), four obstacles."""
    return Scenario(
        name="lab",
        checkpoints=(
            Checkpoint("Checkpoint A", 0.5, 2.5),
            Checkpoint("Checkpoint B", 2.5, 2.45),
            Checkpoint("Checkpoint C", 2.5, 0.55),
            Checkpoint("Checkpoint D", 1.5, 1.5),
            Checkpoint("Checkpoint E", 0.9, 0.5),
        ),
        obstacles=(
            Box(0.95, 1.85, 1.15, 2.25),
            Box(1.95, 1.95, 2.25, 2.15),
            Box(1.8, 0.75, 2.0, 1.15),
            Box(0.65, 1.05, 0.95, 1.2),
        ),
        ego_start=Disc(2.0, 2.7, 0.1),
        adversary_start=Disc(1.5, 0.4, 0.15),
    )


def paper() -> Scenario:
    """`lab` with the paper's reward alone: a completed mission costs the ego nothing."""
    return replace(lab(), name="paper", rewards=Rewards(mission_completed=0.0))


def open_field() -> Scenario:
    """`lab` without obstacles: for first tries and closed forms."""
    return replace(lab(), name="open", obstacles=())


def reef() -> Scenario:
    """A larger planar arena with corals, for the underwater mission U5; the 3-D world comes later."""
    return Scenario(
        name="reef",
        width_metres=6.0,
        height_metres=6.0,
        checkpoints=(
            Checkpoint("Checkpoint A", 1.2, 1.0, 0.25, 0.7),
            Checkpoint("Checkpoint B", 4.8, 1.6, 0.25, 0.7),
            Checkpoint("Checkpoint C", 3.2, 4.4, 0.25, 0.7),
        ),
        regions=(("corals", Disc(1.0, 5.0, 0.3)),),
        obstacles=(Disc(2.9, 2.6, 0.35), Box(0.9, 2.9, 1.5, 3.3)),
        ego_start=Disc(5.2, 5.2, 0.15),
        adversary_start=Disc(0.6, 0.6, 0.2),
        horizon_seconds=180.0,
    )


def lab_avoidance() -> Scenario:
    """`lab` with an ego that must cross to the lower left corner without meeting the adversary."""
    return replace(lab(), name="lab-avoidance", ego_task="avoidance", ego_goal=Disc(0.35, 0.35, 0.2))


def lab_surveillance() -> Scenario:
    """`lab` with an ego that is paid for every second during which it watches the adversary."""
    return replace(lab(), name="lab-surveillance", ego_task="surveillance")


PRESETS: dict[str, Callable[[], Scenario]] = {
    "lab": lab,
    "paper": paper,
    "open": open_field,
    "reef": reef,
    "lab-avoidance": lab_avoidance,
    "lab-surveillance": lab_surveillance,
}
