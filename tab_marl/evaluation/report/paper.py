"""The paper's Table 1 and its underwater table: printed beside what is measured here, never compared with a test.

Puthumanaillam, Song, Yesmagambet, Park, Ornik: TAB-Fields, L4DC 2025 (PMLR 283:1484-1497). Its arena is not published.
"""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class PaperFigure:
    atcr_percent: float
    steps: int
    underwater_atcr_percent: float


_COLUMNS = ("S-POMCP", "FP-POMCP", "MLE-POMCP", "TAB-POMCP")
_TABLE: dict[str, tuple[tuple[float, int, float], ...]] = {
    "M1": ((85.3, 1490, 90.1), (78.0, 1103, 83.5), (64.7, 852, 70.2), (13.3, 316, 19.1)),
    "M2": ((91.2, 1882, 94.8), (84.7, 1312, 88.3), (79.4, 1013, 82.7), (18.3, 380, 24.4)),
    "M3": ((88.1, 1631, 91.7), (80.6, 1274, 85.2), (45.3, 953, 50.8), (19.8, 412, 27.1)),
    "M4": ((82.0, 1445, 87.5), (74.6, 1102, 80.1), (59.8, 883, 65.3), (15.8, 297, 21.7)),
    "M5": ((95.6, 2312, 97.2), (88.9, 1871, 91.5), (80.2, 1533, 85.6), (30.9, 545, 43.4)),
}

PAPER: dict[tuple[str, str], PaperFigure] = {
    (mission, planner): PaperFigure(*figures)
    for mission, row in _TABLE.items()
    for planner, figures in zip(_COLUMNS, row, strict=True)
}
"""(mission, planner) -> the paper's figures."""

TAB_TIME_RATIO = 1.4
"""The paper's decision time of TAB-POMCP over that of standard POMCP."""

MISSION_TEXT = {
    "M1": "Reach Checkpoint A within 5s",
    "M2": "Reach Checkpoint A and then Checkpoint B in exactly 5s",
    "M3": "Reach Checkpoint A every 5s",
    "M4": "Reach Checkpoint A while avoiding the central zone",
    "M5": "Reach target [x,y] after visiting any three different checkpoints, taking no more than 10s between checkpoints, "
    "while avoiding the center of the environment",
}
