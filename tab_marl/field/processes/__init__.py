"""Reference processes: what motion is like when nothing but physics is known."""

from tab_marl.field.processes.isotropic import paper_walk, walk
from tab_marl.field.processes.tumble import run_and_tumble
from tab_marl.field.processes.unicycle import unicycle

__all__ = ["paper_walk", "run_and_tumble", "unicycle", "walk"]
