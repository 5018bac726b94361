"""The page of the zoo: ``python scripts/study_population.py`` writes the tables and pictures of docs/adversaries/zoo.md."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import typer
from rich.progress import Progress

from tab_marl.agents.measures.diversity import Yardstick
from tab_marl.agents.measures.measuring import Sheet
from tab_marl.agents.measures.release import release_moves
from tab_marl.agents.policies.zoo import SHIPPED, load_zoo
from tab_marl.evaluation import population_figures as figures
from tab_marl.evaluation import population_study as tables

app = typer.Typer(add_completion=False)
MAPS = (("M1", "ambiguous"), ("M4", "point"))


@app.command()
def page(
    zoo: Annotated[Path, typer.Option(help="Folder of the policies.")] = SHIPPED,
    tasks: Annotated[int, typer.Option(min=15, help="Held-out tasks that everybody plays, twice.")] = 150,
    docs: Path = Path("docs"),
) -> None:
    """Let every policy, the scripted follower and the field do the same tasks; write tables and pictures."""
    policies = load_zoo(zoo)
    with Progress() as bar:
        done = bar.add_task("", total=len(policies) + 3)
        study = tables.conduct(policies, tasks, lambda what: bar.update(done, advance=1, description=what))
    found = {
        "population": tables.population_lines(study),
        "success": tables.success_table(policies),
        "styles": tables.style_table(policies),
        "behaviour": tables.behaviour_table(study),
    }
    path = docs / "adversaries" / "zoo.md"
    path.write_text(tables.put_tables(path.read_text(encoding="utf-8"), found), encoding="utf-8")
    images = docs / "images"
    figures.draw_figures(study, images / "zoo-figures.svg")
    for mission, family in MAPS:
        y = telling(study.sheet.yardsticks, mission, family)
        figures.draw_paths(study, y, images / f"zoo-paths-{mission}.png")
    print(found["population"])


def telling(yardsticks: Sequence[Yardstick], mission: str, family: str) -> Yardstick:
    """The task of this kind that leaves the most to choose: time to spare, a long way, two sides at most places."""

    def choice(y: Yardstick) -> float:
        start = y.task.scenario.adversary_start.centre
        metres = float(y.plain.parts.plain.metres(y.plain.parts.via_home, [start])[0])
        places = y.task.mission.goals[0].places
        return min(y.task.slack, 2.2) * metres * (1 + sum(bool(y.sides.two_sided(place)) for place in places))

    return max((y for y in yardsticks if (y.task.mission_id, y.task.family) == (mission, family)), key=choice)


@app.command()
def side(
    zoo: Annotated[Path, typer.Option(help="Folder of the policies.")] = SHIPPED,
    tasks: Annotated[int, typer.Option(min=15, help="Held-out tasks that every policy plays, twice.")] = 150,
    seed: Annotated[int, typer.Option(help="Of the tasks; the page's tables are of another.")] = 1234,
) -> None:
    """How often the shortest path's side is taken on other tasks than those the page shows."""
    sheet = Sheet.draw(tasks, 0, tasks, seed)
    share, low, high, n = tables.shortest_side([sheet.behaviour(policy) for policy in load_zoo(zoo)])
    print(f"{100 * share:.0f} % [{100 * low:.0f}, {100 * high:.0f}] of {n} episodes")


@app.command()
def moves(zoo: Annotated[Path, typer.Option(help="Folder of the policies.")] = SHIPPED) -> None:
    """Count anew what MLE-POMCP knows before an episode, from the policies for development."""
    print(release_moves(load_zoo(zoo, split="development"), zoo / "moves.json"))


if __name__ == "__main__":
    app()
