"""What MLE-POMCP knows before an episode: moves of the development policies, counted as an ego's cameras would see them.

The policies of the final table never lend it a move: what it learns there it learns within the episode, and forgets after it.
"""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Sequence
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tab_marl.agents.adversaries import AdversaryPolicy
from tab_marl.agents.measures.rollouts import rollout_unopposed
from tab_marl.agents.policies.zoo import SHIPPED, PolicyError, ZooPolicy
from tab_marl.mission.tasks import Task
from tab_marl.planning.models.interface import Sighting, TickObservation
from tab_marl.planning.models.mission_map import MissionMap
from tab_marl.planning.models.walker import MoveCounts, Walker

MOVES_FILE = SHIPPED / "moves.json"
"""The counts that ship, written by ``scripts/study_population.py moves``."""
PARTICLES = 300
NOWHERE = (-10.0, -10.0)
"""Where the ego is while it only watches: within reach of nobody."""


def untrained() -> MoveCounts:
    """What MLE-POMCP believes before any adversary was seen: half uniform moves, half along the mission's way."""
    return MoveCounts(along_share=0.5)


def count_moves(
    policies: Sequence[AdversaryPolicy],
    tasks: Sequence[Task],
    seed: int,
    per_task: int = 1,
    on_task: Callable[[int, int], None] | None = None,
) -> tuple[MoveCounts, int]:
    """Counts of the moves that cameras saw of these policies on these tasks, nobody hunting them, and of how many ticks.

    Every policy plays every task `per_task` times; what is counted depends on the arguments alone.
    """
    moves, ticks = untrained(), 0
    for i, task in enumerate(tasks):
        mission_map = MissionMap.build(task.scenario, task.mission)
        for j, policy in enumerate(policies):
            rng = np.random.default_rng((seed, i, j))
            positions, completed = rollout_unopposed(policy, task, rng, per_task)
            for path, end in zip(positions, completed, strict=True):
                watched = Walker(mission_map, moves, feasible=True, learns=True, particles=PARTICLES)
                ticks += _watch(watched, path[: end + 1] if end > 0 else path, rng)
        if on_task is not None:
            on_task(i + 1, len(tasks))
    return moves, ticks


def _watch(watcher: Walker, path: NDArray[np.float64], rng: np.random.Generator) -> int:
    """Show the walker what cameras see of a path ``[T + 1, 2]``; the number of ticks at which they see something."""
    seen = watcher.map.scenario.seen(path)
    for tick, (point, visible) in enumerate(zip(path, seen, strict=True)):
        sighting = Sighting(float(point[0]), float(point[1]), 0.0, 0.0) if visible else None
        observation = TickObservation(tick, NOWHERE, sighting)
        (watcher.start if tick == 0 else watcher.observe)(observation, rng)
    return int(seen.sum())


def write_moves(
    policies: Sequence[ZooPolicy], moves: MoveCounts, ticks: int, tasks: int, path: Path = MOVES_FILE
) -> None:
    """Write counts with what they were counted from. Raises ValueError for a policy that is not for development."""
    for policy in policies:
        if policy.split != "development":
            raise ValueError(
                f"policy {policy.name} is for the final table: MLE-POMCP's data come from development policies"
            )
    record = {
        "policies": {policy.name: policy.card.sha256 for policy in policies},
        "tasks": tasks,
        "ticks_seen": ticks,
        "moves": {**moves.to_json(), "counts": np.round(moves.counts, 3).tolist()},
    }
    temporary = path.with_suffix(".tmp")
    temporary.write_text(json.dumps(record, indent=1) + "\n", encoding="utf-8")
    os.replace(temporary, path)


@lru_cache(maxsize=8)
def read_moves(path: Path = MOVES_FILE) -> dict[str, Any]:
    """The record that `write_moves` wrote. Raises PolicyError."""
    try:
        record = json.loads(path.read_text(encoding="utf-8"))
        MoveCounts.from_json(record["moves"])
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise PolicyError(f"cannot read the counted moves {path}: {error}; write them anew") from None
    return dict(record)


def pretrained(path: Path = MOVES_FILE) -> MoveCounts:
    """A fresh copy of the counts that ship. Raises PolicyError."""
    return MoveCounts.from_json(read_moves(path)["moves"])
