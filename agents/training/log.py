"""The learning curve of a run as a CSV file: one row per update, or per 500th of the run where updates are smaller."""

from __future__ import annotations

import csv
import math
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

LOG_FILE = "log.csv"
ROWS = 500
"""Of a log, about, where updates are smaller than a row."""
COLUMNS = ("steps", "updates", "seconds", "cpu_seconds", "reward")
SUCCESS = "success_"


class LearningLog:
    """Appends rows; a run that continues first drops the rows that came after its checkpoint."""

    def __init__(self, folder: Path, missions: Sequence[str], steps: int) -> None:
        """`steps`: of the checkpoint that the run continues from, 0 for a new run."""
        self._path = folder / LOG_FILE
        self._missions = tuple(missions)
        header = [*COLUMNS, *(SUCCESS + mission for mission in self._missions)]
        kept: list[list[str]] = []
        if steps and self._path.exists():
            with self._path.open(newline="", encoding="utf-8") as file:
                # A kill may have cut the last row.
                kept = [row for row in csv.reader(file) if len(row) == len(header) and row[0].isdigit()]
        temporary = self._path.with_name(LOG_FILE + ".tmp")
        with temporary.open("w", newline="", encoding="utf-8") as file:
            writer = csv.writer(file)
            writer.writerow(header)
            writer.writerows(row for row in kept if int(row[0]) <= steps)
        os.replace(temporary, self._path)

    def row(
        self, steps: int, updates: int, seconds: float, cpu_seconds: float, reward: float, success: Mapping[str, float]
    ) -> None:
        """Append a row; what is not known yet (nan) is left empty. Raises OSError."""
        shares = [reward, *(success.get(mission, math.nan) for mission in self._missions)]
        cells = [steps, updates, f"{seconds:.2f}", f"{cpu_seconds:.2f}"]
        with self._path.open("a", newline="", encoding="utf-8") as file:
            csv.writer(file).writerow([*cells, *("" if math.isnan(x) else f"{x:.4f}" for x in shares)])


@dataclass(frozen=True, eq=False)
class LearningCurve:
    """What a log holds; R rows."""

    steps: NDArray[np.float64]
    """``[R]``."""
    cpu_seconds: NDArray[np.float64]
    """``[R]``, since the run began, interruptions included as far as their work was lost."""
    reward: NDArray[np.float64]
    """``[R]`` mean reward of the last 100 episodes, nan where unknown."""
    success: dict[str, NDArray[np.float64]]
    """Mission type -> ``[R]`` share completed of the last episodes, action noise on; nan where unknown."""


def read_log(folder: Path | str) -> LearningCurve:
    """The learning curve of a run so far. Raises OSError if there is none, ValueError if it is damaged."""
    path = Path(folder) / LOG_FILE
    with path.open(newline="", encoding="utf-8") as file:
        rows = list(csv.reader(file))
    if not rows or tuple(rows[0][: len(COLUMNS)]) != COLUMNS:
        raise ValueError(f"{path} is no log of a training run: its first line must be {','.join(COLUMNS)},...")
    cells = [row for row in rows[1:] if len(row) == len(rows[0])]
    table = np.array([[float(cell) if cell else math.nan for cell in row] for row in cells]).reshape(-1, len(rows[0]))
    column = {name: table[:, i] for i, name in enumerate(rows[0])}
    success = {name.removeprefix(SUCCESS): values for name, values in column.items() if name.startswith(SUCCESS)}
    return LearningCurve(column["steps"], column["cpu_seconds"], column["reward"], success)
