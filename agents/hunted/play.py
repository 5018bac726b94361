"""Whole episodes of a finished policy against live egos, side by side: what hunted habits are learned from and judged by."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tab_marl.agents.adversaries import AdversaryPolicy
from tab_marl.agents.hunted.egos import Hunters
from tab_marl.agents.hunted.env import COMPLETED, INTERCEPTED
from tab_marl.agents.planners import PlannerOptions
from tab_marl.envs.adversary_observation import AdversaryTask
from tab_marl.envs.batched_arenas import BatchedArenas
from tab_marl.envs.episode import draw_starts
from tab_marl.mission.tasks import Task

START_STREAM, EGO_STREAM = 1, 2


@dataclass(frozen=True, eq=False)
class Hunted:
    """N hunted episodes; time in control steps."""

    completed: NDArray[np.bool_]
    """``[N]`` the mission was completed before the adversary was caught."""
    caught: NDArray[np.bool_]
    """``[N]`` it was caught before that."""
    end: NDArray[np.int64]
    """``[N]`` when either happened, or the mission failed."""
    positions: NDArray[np.float32]
    """``[N, T + 1, 2]`` of the adversary, metres; the last one is repeated after the end."""


def play_hunted(
    policy: AdversaryPolicy,
    tasks: Sequence[AdversaryTask],
    egos: Sequence[str],
    seeds: Sequence[int],
    options: PlannerOptions | None = None,
) -> Hunted:
    """One episode per task against the ego named for it; the same seed gives the same starts and the same ego's draws.

    `options`: the planners' (default: those of training). Raises UnknownName for an ego that nobody knows.
    """
    n = len(tasks)
    names = tuple(dict.fromkeys(egos))
    hunters = Hunters(names, n, options)
    arenas = BatchedArenas(tasks, n, end_on_completion=True)
    starts = np.array(
        [draw_starts(t.scenario, np.random.default_rng((s, START_STREAM))) for t, s in zip(tasks, seeds, strict=True)]
    )
    plain = [Task(task.scenario, task.mission, "", "custom", 0.0) for task in tasks]
    for i, (task, seed) in enumerate(zip(plain, seeds, strict=True)):
        ego_seed = int(np.random.default_rng((seed, EGO_STREAM)).integers(2**62))
        hunters.begin(i, names.index(egos[i]), task, ego_seed)
    policy.reset(plain[0], np.random.default_rng(int(seeds[0])))
    ego, adversary = arenas.begin(np.arange(n), np.random.default_rng(0), np.arange(n), starts)
    completed, caught = np.zeros(n, dtype=bool), np.zeros(n, dtype=bool)
    end = np.zeros(n, dtype=np.int64)
    going = np.ones(n, dtype=bool)
    path = [arenas.robots[:, 1, :2].astype(np.float32)]
    while going.any():
        outcome = arenas.step(hunters.act(ego), policy.act(adversary))
        ego, adversary = outcome.ego, outcome.adversary
        ended = going & (outcome.terminated | outcome.truncated)
        completed[ended], caught[ended] = outcome.events[ended, COMPLETED], outcome.events[ended, INTERCEPTED]
        end[ended] = len(path)
        path.append(np.where(going[:, None], arenas.robots[:, 1, :2], path[-1]).astype(np.float32))
        going &= ~ended
        for arena in np.flatnonzero(ended).tolist():
            hunters.leave(arena)
    return Hunted(completed, caught, end, np.stack(path, axis=1))
