"""How near TAB-POMCP comes to its ceiling, and what a decision's budget buys: ``python scripts/study_planner.py``.

Rows (one per episode, CSV) are appended as episodes end, so an interrupted run continues; ``study_planner_report.py`` draws the
figure and prints the tables from rows alone. Base seed 40000: the published table's seeds are not touched.
"""

from __future__ import annotations

import csv
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer

from tab_marl.agents.planners import PlannerAgent, PlannerOptions
from tab_marl.evaluation.adversaries import opponent, zoo_names
from tab_marl.evaluation.episode import run_episode
from tab_marl.evaluation.units import Unit, unit_seeds
from tab_marl.field.problem import FieldOptions
from tab_marl.mission.tasks import Task, sample_task
from tab_marl.planning.pursuit.decide import PursuitOptions
from tab_marl.planning.pursuit.itineraries import EFFORT
from tab_marl.planning.pursuit.scenarios import ReuseOptions

BASE_SEED = 40_000
FIELDS = (
    "variant", "family", "mission", "seed", "adversary", "slack", "intercepted", "completed", "physics_steps",
    "horizon_steps", "decisions", "belief_ms", "sampling_ms", "valuation_ms", "search_ms", "worst_ms",
)  # fmt: skip


@dataclass(frozen=True)
class Variant:
    """A planner as it is studied."""

    planner: str
    options: PlannerOptions = field(default_factory=PlannerOptions)


def pursuing(planner: str, milliseconds: float = 20, **changes: Any) -> Variant:
    return Variant(planner, PlannerOptions(pursuit=PursuitOptions.for_milliseconds(milliseconds, **changes)))


OPEN_LOOP = {"method": "routes", "detours": 0, "paths": 200, "screened": 1000, "keep_bonus": 0.0}
"""`er`: every waypoint against 200 paths, meetings on the way counted, nothing else."""
VARIANTS: dict[str, Variant] = {
    "er": pursuing("TAB-POMCP", **OPEN_LOOP),
    "er, rewards as they are": pursuing("TAB-POMCP", **OPEN_LOOP, completion_weight=1.0),
    "routes": pursuing("TAB-POMCP", method="routes"),
    **{f"tree {effort.milliseconds:g} ms": pursuing("TAB-POMCP", effort.milliseconds) for effort in EFFORT},
    "population": pursuing("population-POMCP"),
    "oracle": pursuing("oracle"),
    "S-POMCP": pursuing("S-POMCP"),
    "tree, nothing kept": Variant("TAB-POMCP", PlannerOptions(reuse=ReuseOptions(renewed_share=1.0))),
    "tree, c = 1": pursuing("TAB-POMCP", exploration=1.0),
    "tree, c = 25": pursuing("TAB-POMCP", exploration=25.0),
    "tree, c = 100": pursuing("TAB-POMCP", exploration=100.0),
    "tree, branches on sightings": pursuing("TAB-POMCP", branch_on_sightings=True),
    "tree, no changes in rollouts": pursuing("TAB-POMCP", switches=0),
    "tree, no detours": pursuing("TAB-POMCP", detours=0),
    "tree, nearer goals likelier": Variant("TAB-POMCP", PlannerOptions(tab_field=FieldOptions(goal_marginals=False))),
    "tree, rewards as they are": pursuing("TAB-POMCP", completion_weight=1.0),
}


def play(name: str, variant: Variant, task: Task, unit: Unit, warm: bool = False) -> dict[str, object]:
    """One episode, as a row."""
    _, episode_seed, planner_seed = unit_seeds(BASE_SEED, unit)
    names = zoo_names("development")
    agent = PlannerAgent(variant.planner, variant.options)
    policy = opponent(names[unit.seed % len(names)])
    row = run_episode(
        task, agent, policy, episode_seed, False, unit.seed, planner_seed, max_steps=11 if warm else None
    ).row
    parts = 1e3 * np.array(agent.decision_parts)
    belief, sampling, valuation, search = parts.mean(axis=0).round(3)
    return {
        "variant": name, "family": row.family, "mission": row.mission, "seed": unit.seed, "adversary": row.adversary,
        "slack": row.slack, "intercepted": int(row.intercepted), "completed": int(row.completed),
        "physics_steps": row.physics_steps, "horizon_steps": row.horizon_steps, "decisions": len(parts),
        "belief_ms": belief, "sampling_ms": sampling, "valuation_ms": valuation, "search_ms": search,
        "worst_ms": parts.sum(axis=1).max().round(3),
    }  # fmt: skip


app = typer.Typer(add_completion=False)


@app.command()
def run(
    variants: Annotated[str, typer.Option(help="separated by ;")] = "er;routes;tree 20 ms;population;oracle",
    missions: str = "M1,M4",
    family: str = "ambiguous",
    first: int = 0,
    count: int = 150,
    out: Path = Path("runs/planner.csv"),
) -> None:
    """Play what is not yet in the file, seed by seed."""
    out.parent.mkdir(parents=True, exist_ok=True)
    done = set()
    if out.exists():
        with out.open(newline="") as file:
            done = {(r["variant"], r["family"], r["mission"], int(r["seed"])) for r in csv.DictReader(file)}
    warmed: set[str] = set()
    with out.open("a", newline="") as file:
        writer = csv.DictWriter(file, FIELDS)
        if not done and file.tell() == 0:
            writer.writeheader()
        for seed in range(first, first + count):
            for mission in missions.split(","):
                unit = Unit(mission, family, seed)
                wanted = [v for v in variants.split(";") if (v, family, mission, seed) not in done]
                if not wanted:
                    continue
                task = sample_task(np.random.default_rng(unit_seeds(BASE_SEED, unit)[0]), mission, family)
                for name in wanted:
                    if name not in warmed:
                        warmed.add(name)
                        play(name, VARIANTS[name], task, unit, warm=True)
                    writer.writerow(play(name, VARIANTS[name], task, unit))
                    file.flush()


if __name__ == "__main__":
    app()
