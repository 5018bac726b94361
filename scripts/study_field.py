"""Which TAB-Field predicts learned adversaries best? Plays the study of docs/studies/field.md and draws its figures."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer
from rich.progress import track

from tab_marl.evaluation import field_study

OUT = Path("runs/study-field")
HELD_OUT = ("camera-shy", "fickle", "via", "wander")
app = typer.Typer(add_completion=False)


@app.command()
def predict(
    tasks: Annotated[int, typer.Option(min=1, help="Per mission, family and slack.")] = 4,
    slack: Annotated[list[float], typer.Option(help="Allowed time over shortest time.")] = [1.1, 1.4, 1.8, 2.5],  # noqa: B006
    seed: int = 40_000,
    workers: Annotated[int, typer.Option(min=1)] = 1,
    out: Path = OUT,
) -> None:
    """Score forecasts; resumes where it stopped."""
    cells = [
        field_study.Cell(mission, family, s, index)
        for index in range(tasks)
        for mission in ("M1", "M2", "M3", "M4", "M5")
        for family in ("point", "perimeter", "ambiguous")
        for s in slack
    ]
    done = field_study.play(cells, HELD_OUT, seed, out / "forecasts", workers)
    for _ in track(done, "tasks", total=len(cells)):
        pass


if __name__ == "__main__":
    app()
