"""Which field serves TAB-POMCP best: the same paired episodes planned with several fields."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from tab_marl.agents.planners import PlannerOptions, make_planner
from tab_marl.evaluation.adversaries import opponent
from tab_marl.evaluation.episode import WARM_STEPS, run_episode
from tab_marl.evaluation.field_study import FIELDS
from tab_marl.evaluation.units import Unit, unit_seeds
from tab_marl.field import FieldOptions
from tab_marl.mission.tasks import sample_task

PLANNED: Mapping[str, FieldOptions] = {
    "paper walk, marginal kernel": replace(FIELDS["paper walk"], kernel="marginal"),
    **{
        name: FIELDS[name]
        for name in ("walk", "tumble 0.5 m + goals", "tumble + goals", "drive 0.5 m + goals", "drive + goals")
    },
}
"""The paper's letter, the literal field, and the repairs."""


def play(
    units: Sequence[Unit], fields: Sequence[str], policies: Sequence[str], base_seed: int, out: Path
) -> Iterator[Unit]:
    """Append a row per episode to the CSV `out`, leaving out those it has. Yields each unit when it is done."""
    done: set[tuple[str, str, str, int]] = set()
    if out.exists():
        rows = pd.read_csv(out)
        done = set(zip(rows.field, rows.mission, rows.family, rows.seed, strict=True))
    out.parent.mkdir(parents=True, exist_ok=True)
    warm = False
    for unit in units:
        missing = [name for name in fields if (name, unit.mission, unit.family, unit.seed) not in done]
        found = []
        for name in missing:
            if not warm:
                _episode(name, unit, policies, base_seed, WARM_STEPS)
                warm = True
            found.append({"field": name, **_episode(name, unit, policies, base_seed, None)})
        if found:
            pd.DataFrame(found).to_csv(out, mode="a", index=False, header=not out.exists())
        yield unit


def _episode(name: str, unit: Unit, policies: Sequence[str], base_seed: int, max_steps: int | None) -> dict[str, Any]:
    sequence, episode_seed, planner_seed = unit_seeds(base_seed, unit)
    task = sample_task(np.random.default_rng(sequence), unit.mission, unit.family)
    policy = opponent(policies[unit.seed % len(policies)])
    head: dict[str, Any] = {"mission": unit.mission, "family": unit.family, "seed": unit.seed, "adversary": policy.name}
    try:
        planner = make_planner("TAB-POMCP", PlannerOptions(tab_field=PLANNED[name], ways=None))
        played = run_episode(task, planner, policy, episode_seed, False, unit.seed, planner_seed, max_steps=max_steps)
    except ValueError as error:  # this field does not apply to this mission, or its motion is too slow for it
        return {**head, "completed": "", "physics_steps": "", "milliseconds": "", "error": str(error)}
    row = played.row
    return {
        **head, "completed": int(row.completed), "physics_steps": row.physics_steps,
        "milliseconds": round(played.timing.mean_decision_milliseconds, 2), "error": "",
    }  # fmt: skip
