"""Random episodes of every kind of environment: no body may leave the arena or pass into a wall, no observation its space.

Run: python benchmarks/random_episodes.py --episodes 10000      --workers 2      (about 15 CPU minutes)
"""

from __future__ import annotations

import multiprocessing
import time
from collections.abc import Callable
from typing import Annotated

import typer
from rich.console import Console
from rich.progress import track
from rich.table import Table

from tab_marl.envs.containment import DEEPEST_METRES, DRIVINGS, Findings, random_episode, together
from tab_marl.envs.intercept import InterceptEnv
from tab_marl.envs.styles import STYLES
from tab_marl.envs.team import TeamEnv

Env = InterceptEnv | TeamEnv
RANDOM = {"scenario": "random", "mission": "any"}
KINDS: dict[str, Callable[[str], Env]] = {
    "lab, M1": lambda style: InterceptEnv(adversary_style=style),
    "lab, sampled missions": lambda style: InterceptEnv(mission="any", sampled=True, adversary_style=style),
    "random maps": lambda style: InterceptEnv(**RANDOM, adversary_style=style),
    "random maps, ambiguous": lambda style: InterceptEnv(**RANDOM, family="ambiguous", adversary_style=style),
    "random maps, perimeter": lambda style: InterceptEnv(**RANDOM, family="perimeter", adversary_style=style),
    "hardest maps": lambda style: InterceptEnv(**RANDOM, difficulty=1.0, adversary_style=style),
    "avoidance": lambda style: InterceptEnv(**RANDOM, ego_task="avoidance", adversary_style=style),
    "surveillance": lambda style: InterceptEnv(**RANDOM, ego_task="surveillance", adversary_style=style),
    "team 2 against 2": lambda style: TeamEnv(2, 2, **RANDOM, adversary_style=style),
    "team 4 against 2": lambda style: TeamEnv(4, 2, **RANDOM, adversary_style=style),
}
CHUNK = 20
"""Episodes that one environment plays."""


def play(job: tuple[str, int, int]) -> tuple[str, Findings]:
    """Some episodes of a kind, from a seed on."""
    kind, seed, count = job
    style = list(STYLES)[seed // CHUNK % len(STYLES)]
    env = KINDS[kind](style)
    return kind, together([random_episode(env, seed + i, DRIVINGS[(seed + i) % len(DRIVINGS)]) for i in range(count)])


def main(
    episodes: Annotated[int, typer.Option(min=len(KINDS), help="In all.")] = 10_000,
    seed: Annotated[int, typer.Option(help="Of the first episode.")] = 0,
    workers: Annotated[int, typer.Option(min=1, help="Processes.")] = 1,
) -> None:
    """Play them, print a table, and end with an error if one was not sound."""
    each = episodes // len(KINDS)
    jobs = [(kind, seed + at, min(CHUNK, each - at)) for at in range(0, each, CHUNK) for kind in KINDS]
    found: dict[str, list[Findings]] = {kind: [] for kind in KINDS}
    began = time.perf_counter()
    with multiprocessing.get_context("spawn").Pool(workers) as pool:
        for kind, findings in track(pool.imap_unordered(play, jobs), total=len(jobs), console=Console(stderr=True)):
            found[kind].append(findings)
    table = Table("", "episodes", "robot steps", "at a wall, %", "deepest, mm", "longest step", "outside a space")
    rows = {kind: together(parts) for kind, parts in found.items()}
    rows["all"] = together(list(rows.values()))
    for name, f in rows.items():
        table.add_row(
            name, f"{f.episodes:,}", f"{f.steps:,}", f"{100 * f.touches / f.steps:.1f}", f"{1e3 * f.deepest_metres:.2f}",
            f"{f.longest_metres:.3f}", str(f.outside),
        )  # fmt: skip
    console = Console(width=120)
    console.print(table)
    console.print(
        f"{time.perf_counter() - began:,.0f} s on {workers} processes; sound means: never deeper than "
        f"{1e3 * DEEPEST_METRES:g} mm in a wall or an obstacle, no observation or state outside its space. longest step: way "
        "of a centre in a control step over what its top speed allows (robots push each other)."
    )
    if not rows["all"].sound:
        raise SystemExit("not sound")


if __name__ == "__main__":
    typer.run(main)
