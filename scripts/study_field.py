"""Which TAB-Field predicts learned adversaries best? Plays the study of docs/studies/field.md and draws its figures."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import numpy as np
import typer
from rich.progress import track

from tab_marl.evaluation import field_figures, field_pursuit, field_study
from tab_marl.evaluation.adversaries import population, zoo_names
from tab_marl.evaluation.units import Unit, unit_seeds
from tab_marl.field import FieldProblem
from tab_marl.field.constraints.goals import branch_metres
from tab_marl.mission.propositions import region_of
from tab_marl.mission.tasks import sample_task

OUT = Path("runs/study-field")
POLICIES = zoo_names("development")
"""The study chooses among fields: the policies of the final table are none of its business."""
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
    done = field_study.play(cells, POLICIES, seed, out / "forecasts", workers)
    for _ in track(done, "tasks", total=len(cells)):
        pass


@app.command()
def pursue(
    missions: str = "M1,M4",
    family: str = "ambiguous",
    episodes: Annotated[int, typer.Option(min=1, help="Per mission.")] = 40,
    fields: Annotated[str, typer.Option(help="separated by ;")] = ";".join(field_pursuit.PLANNED),
    seed: int = 40_000,
    out: Path = OUT,
) -> None:
    """Let TAB-POMCP plan with each field; resumes where it stopped."""
    units = [Unit(mission, family, k) for k in range(episodes) for mission in missions.split(",")]
    done = field_pursuit.play(units, fields.split(";"), POLICIES, seed, out / "episodes.csv")
    for _ in track(done, "episodes", total=len(units)):
        pass


@app.command()
def goals(
    missions: str = "M1,M4",
    tasks: Annotated[int, typer.Option(min=1, help="Per mission.")] = 60,
    first: int = 1000,
    seed: int = 40_000,
) -> None:
    """How the policies share goals: nats lost (KL divergence, mean over tasks) by shares exp(-nearness (x - 1))."""
    nearness = (0.0, 0.5, 1.0, 1.5, 2.0, 3.0)
    lines = []
    for mission in missions.split(","):
        lost = []
        for k in track(range(first, first + tasks), mission):
            rng = np.random.default_rng(unit_seeds(seed, Unit(mission, "ambiguous", k))[0])
            task = sample_task(rng, mission, "ambiguous")
            problem = FieldProblem.from_mission(task.mission, task.scenario)
            centres = np.array([region_of(place, task.scenario).centre for place in problem.branch_places])
            positions, completed = population(POLICIES)(task, np.random.default_rng(k))
            ends = positions[np.flatnonzero(completed >= 0), completed[completed >= 0]]
            chosen = np.hypot(*(ends[:, None] - centres).transpose(2, 0, 1)).argmin(axis=1)
            share = np.bincount(chosen, minlength=len(centres)) + 1e-3 * len(ends)
            share = share / share.sum()
            metres = branch_metres(problem, np.arange(len(centres)))
            wanted = np.exp(-np.array(nearness)[:, None] * (metres / metres.min() - 1))
            lost.append((share * np.log(share / (wanted / wanted.sum(axis=1, keepdims=True)))).sum(axis=1))
        lines.append([mission, *(f"{nats:.3f}" for nats in np.mean(lost, axis=0))])
    print(field_figures.markdown(["mission", *(f"{n:g}" for n in nearness)], lines))


@app.command()
def draw(out: Path = OUT, docs: Path = Path("docs")) -> None:
    """Write the page's rows and figure, and print its tables as Markdown."""
    for table in field_figures.write(out, docs):
        print(table, end="\n\n")


if __name__ == "__main__":
    app()
