"""Measure the policies of a trained population and write those that ship: ``python scripts/train_zoo.py``.

First ``tab-marl train shipped``. Every member is measured on the same held-out tasks beside the population's controls,
direct policies with other seeds against which a style's own figure must move; the controls are written beside the zoo.
MLE-POMCP's counts are written anew from the policies for development.
"""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Annotated

import typer
from rich.progress import Progress

from tab_marl.agents.measures.measuring import Sheet
from tab_marl.agents.measures.release import release
from tab_marl.agents.policies.zoo import CONTROLS, POLICY_FOLDER, SHIPPED, load_policy, save_policy
from tab_marl.agents.population.members import Population


def main(
    population: Annotated[str, typer.Argument(help="A population's file, or shipped.")] = "shipped",
    runs: Annotated[Path | None, typer.Option(help="Folder of its runs; default: runs/train/POPULATION.")] = None,
    zoo: Annotated[Path, typer.Option(help="Folder that the policies are written to.")] = SHIPPED,
    controls: Annotated[Path, typer.Option(help="Folder that the controls are written to.")] = CONTROLS,
    tasks: Annotated[int, typer.Option(help="Held-out tasks of M1 to M5.")] = 300,
    sampled: Annotated[int, typer.Option(help="Held-out tasks of sampled compositions.")] = 96,
    fresh: Annotated[bool, typer.Option("--fresh", help="Remove policies that are not of this population.")] = False,
) -> None:
    """Measure and write."""
    loaded = Population.load(population)
    folder = runs if runs is not None else Path("runs/train") / loaded.name
    found = {member.name: load_policy(folder / member.name / POLICY_FOLDER) for member in loaded.members}
    members = [policy for name, policy in found.items() if name not in loaded.controls]
    if fresh:
        for path in zoo.iterdir() if zoo.is_dir() else ():
            if path.is_dir() and path.name not in {policy.name for policy in members}:
                shutil.rmtree(path)
    for name in loaded.controls:
        save_policy(found[name], controls / name)
    with Progress() as bar:
        sheet_task = bar.add_task("tasks", total=1)
        sheet = Sheet.draw(tasks, sampled, min(tasks, 150))
        bar.advance(sheet_task)
        every = bar.add_task("policies", total=len(members))
        lines = release(members, [found[name] for name in loaded.controls], zoo, sheet)
        for line in lines:
            bar.console.print(line, highlight=False)
            bar.advance(every)


if __name__ == "__main__":
    typer.run(main)
