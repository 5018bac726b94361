"""How near TAB-POMCP comes to its ceiling, and what a decision's budget buys: ``python scripts/study_planner.py``.

Rows (one per episode, CSV) are appended as episodes end, so an interrupted run continues; ``study_planner_report.py`` draws the
figure and prints the tables from rows alone. The published table's seeds are not touched; its policies are only with
``--split final``.
"""

from __future__ import annotations

import csv
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import typer

from tab_marl.agents.planners import GUARDS, PRECEDENTS, PlannerAgent, PlannerOptions
from tab_marl.agents.policies.cards import Split
from tab_marl.evaluation.adversaries import opponent, population, zoo_names
from tab_marl.evaluation.episode import run_episode
from tab_marl.evaluation.units import Unit, unit_seeds
from tab_marl.field.problem import FieldOptions
from tab_marl.mission.tasks import Task, sample_task
from tab_marl.planning.models.drawn_ways import WaysOptions
from tab_marl.planning.pursuit.decide import PursuitOptions
from tab_marl.planning.pursuit.itineraries import EFFORT
from tab_marl.planning.pursuit.scenarios import ReuseOptions

FIELDS = (
    "variant", "family", "mission", "seed", "adversary", "slack", "intercepted", "completed", "physics_steps",
    "horizon_steps", "decisions", "belief_ms", "sampling_ms", "valuation_ms", "search_ms", "worst_ms",
)  # fmt: skip


@dataclass(frozen=True)
class Variant:
    """A planner as it is studied."""

    planner: str
    options: PlannerOptions = field(default_factory=PlannerOptions)
    knows: Literal["those played", "the others", "the others unlike it"] = "those played"
    """Whose paths population-POMCP draws, and are precedents: of the split that is played, of the other one, or of those in
    the other one that have no style (of a mixture: no habit) in common with the adversary of the episode."""


def pursuing(planner: str, milliseconds: float = 20, **changes: Any) -> Variant:
    """TAB-POMCP's field alone, without drawn ways."""
    return Variant(planner, PlannerOptions(pursuit=PursuitOptions.for_milliseconds(milliseconds, **changes), ways=None))


def predicting(milliseconds: float = 20, **changes: Any) -> Variant:
    """TAB-POMCP with another field, alone."""
    pursuit = PursuitOptions.for_milliseconds(milliseconds)
    return Variant("TAB-POMCP", PlannerOptions(pursuit=pursuit, tab_field=FieldOptions(**changes), ways=None))


def drawing(milliseconds: float = 20, **changes: Any) -> Variant:
    """TAB-POMCP as it comes, its field and ways of drivers with habits drawn at random."""
    pursuit, ways = PursuitOptions.for_milliseconds(milliseconds), WaysOptions(**changes)
    return Variant("TAB-POMCP", PlannerOptions(pursuit=pursuit, ways=ways))


OPEN_LOOP = {"method": "routes", "detours": 0, "paths": 200, "screened": 1000, "keep_bonus": 0.0}
"""`er`: every waypoint against 200 paths, meetings on the way counted, nothing else."""
VARIANTS: dict[str, Variant] = {
    "er": pursuing("TAB-POMCP", **OPEN_LOOP),
    "er, rewards as they are": pursuing("TAB-POMCP", **OPEN_LOOP, completion_weight=1.0),
    "routes": pursuing("TAB-POMCP", method="routes"),
    **{f"tree {effort.milliseconds:g} ms": pursuing("TAB-POMCP", effort.milliseconds) for effort in EFFORT},
    "TAB-POMCP": drawing(),
    "TAB-POMCP 50 ms": drawing(50),
    "TAB-POMCP, habits half as strong": drawing(
        cost_deviation=0.5, smooth_widths=1 / 3, place_widths=1.0, fence_widths=0.25
    ),
    "TAB-POMCP, twice as strong": drawing(cost_deviation=2.0, smooth_widths=1 / 12, place_widths=4.0, fence_widths=1.0),
    "TAB-POMCP, no late ways": drawing(late_share=0.0),
    "TAB-POMCP, shortest sides": drawing(fence_widths=0.0),
    "TAB-POMCP, even ground": drawing(cost_deviation=0.0),
    "population": pursuing("population-POMCP"),
    "population 50 ms": pursuing("population-POMCP", 50),
    "population of others": replace(pursuing("population-POMCP"), knows="the others"),
    "population of others 50 ms": replace(pursuing("population-POMCP", 50), knows="the others"),
    "precedents of others": replace(pursuing(PRECEDENTS), knows="the others"),
    "precedents of others 50 ms": replace(pursuing(PRECEDENTS, 50), knows="the others"),
    "precedents unlike it 50 ms": replace(pursuing(PRECEDENTS, 50), knows="the others unlike it"),
    "oracle": pursuing("oracle"),
    "S-POMCP": pursuing("S-POMCP"),
    "FP-POMCP": pursuing("FP-POMCP"),
    "tree, nothing kept": Variant("TAB-POMCP", PlannerOptions(reuse=ReuseOptions(renewed_share=1.0), ways=None)),
    "tree, c = 1": pursuing("TAB-POMCP", exploration=1.0),
    "tree, c = 25": pursuing("TAB-POMCP", exploration=25.0),
    "tree, c = 100": pursuing("TAB-POMCP", exploration=100.0),
    "tree, branches on sightings": pursuing("TAB-POMCP", branch_on_sightings=True),
    "tree, no changes in rollouts": pursuing("TAB-POMCP", switches=0),
    "tree, no detours": pursuing("TAB-POMCP", detours=0),
    "tree, nearer goals likelier": predicting(goal_marginals=0.0),
    "tree, nearer goals half as much": predicting(goal_marginals=0.5),
    "tree, goals by distance": predicting(goal_nearness=1.5),
    "tree, turning first": predicting(begins_at_rest=True),
    "tree, both of these": predicting(goal_nearness=1.5, begins_at_rest=True),
    "tree, goals by distance, 50 ms": predicting(50, goal_nearness=1.5),
    "tree, both of these, 50 ms": predicting(50, goal_nearness=1.5, begins_at_rest=True),
    "tree, timing prior": predicting(timing_prior=True),
    "tree, drive and turn": predicting(reference="drive_and_turn"),
    "tree, runs of 0.5 m": predicting(mean_run_metres=0.5),
    "tree, runs of 2 m": predicting(mean_run_metres=2.0),
    "tree, guarded": Variant("TAB-POMCP", PlannerOptions(guards=(*GUARDS, ("TAB-POMCP", 0.2)), ways=None)),
    "tree, rewards as they are": pursuing("TAB-POMCP", completion_weight=1.0),
    "tree, completion at 10 times": pursuing("TAB-POMCP", completion_weight=10.0),
}


def styles(name: str) -> set[str]:
    """What a policy may drive in."""
    style = opponent(name).style
    return {habit.style.name for habit in style.mixture} or {style.name}


def play(
    name: str, variant: Variant, task: Task, unit: Unit, split: Split, base_seed: int, warm: bool = False
) -> dict[str, object]:
    """One episode, as a row."""
    _, episode_seed, planner_seed = unit_seeds(base_seed, unit)
    names = zoo_names(split)
    adversary = names[unit.seed % len(names)]
    other: Split = "final" if split == "development" else "development"
    known = names if variant.knows == "those played" else zoo_names(other)
    if variant.knows == "the others unlike it":
        known = tuple(name for name in known if not styles(name) & styles(adversary))
    agent = PlannerAgent(
        variant.planner, replace(variant.options, rollouts=population(known), precedents=population(known))
    )
    policy = opponent(adversary)
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
    split: Annotated[str, typer.Option(help="whose policies play: development or final")] = "development",
    base_seed: int = 40_000,
) -> None:
    """Play what is not yet in the file, seed by seed."""
    if split not in ("development", "final"):
        raise typer.BadParameter(f"split is {split!r}, must be 'development' or 'final'")
    played: Split = "final" if split == "final" else "development"
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
                task = sample_task(np.random.default_rng(unit_seeds(base_seed, unit)[0]), mission, family)
                for name in wanted:
                    if name not in warmed:
                        warmed.add(name)
                        play(name, VARIANTS[name], task, unit, played, base_seed, warm=True)
                    writer.writerow(play(name, VARIANTS[name], task, unit, played, base_seed))
                    file.flush()


if __name__ == "__main__":
    app()
