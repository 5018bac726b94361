"""Reference processes: what motion is like when nothing but physics is known."""

from tab_marl.field.processes.drive_and_turn import drive_and_turn
from tab_marl.field.processes.estimated import reference_from_simulator, reference_from_trajectories
from tab_marl.field.processes.isotropic import paper_walk, walk
from tab_marl.field.processes.tumble import TYPICAL_TURN, run_and_tumble
from tab_marl.field.processes.unicycle import unicycle

__all__ = [
    "TYPICAL_TURN",
    "drive_and_turn",
    "paper_walk",
    "reference_from_simulator",
    "reference_from_trajectories",
    "run_and_tumble",
    "unicycle",
    "walk",
]
