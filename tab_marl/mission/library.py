"""The missions of the paper and of its project site, by their ids."""

from __future__ import annotations

MISSIONS: dict[str, str] = {
    "M1": "Reach Checkpoint A within 5s",
    "M2": "Reach Checkpoint A and then Checkpoint B in exactly 5s",
    "M3": "Reach Checkpoint A every 5s",
    "M4": "Reach Checkpoint A while avoiding the central zone",
    "M5": (
        "Reach target [x,y] after visiting any three different checkpoints, taking no more than 10s between "
        "checkpoints, while avoiding the center of the environment"
    ),
    "U5": "Reach corals after visiting checkpoints 1, 2, 3 in order, taking no more than 30s between checkpoints",
    "a": "Visit Checkpoint 3, then Checkpoint 2, then Checkpoint 1, each within 7s, and end at the top right",
    "b": "Visit any checkpoint and end at the bottom right within 50s, while avoiding the center",
    "c": "Reach Checkpoint 1 in exactly 5s, then Checkpoint 2 within 10s",
    "d": "Visit a checkpoint every 10s while never entering the right half",
    "e": (
        "Visit any three different checkpoints including Checkpoint 4, exactly every 10s, and end at the bottom right"
    ),
    "f": "Visit the top right and another checkpoint in any order within 40s, then the center within 80s",
}
"""Id -> text. M1 to M5 and U5 are the paper's own words (M5 needs `target`); (a) to (f) tell the site's pictures.

Their times assume the paper's arena; on another map scale them (`tab_marl.mission.tasks` samples feasible ones).
"""
