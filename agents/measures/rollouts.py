"""Unopposed rollouts of adversary policies in the batched world."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tab_marl.agents.adversaries import AdversaryPolicy
from tab_marl.envs.adversary_observation import AdversaryTask
from tab_marl.envs.batched import Bank, BatchedWorld
from tab_marl.mission.tasks import Task

NOT_COMPLETED = -1
DRAWS = 8
"""Latents drawn per policy for `rollout_unopposed`; its rollouts share them in turn."""


@dataclass(frozen=True, eq=False)
class Rollouts:
    """N unopposed episodes, one row each; time in control steps."""

    task: NDArray[np.int64]
    """``[N]`` index into the bank."""
    positions: NDArray[np.float32]
    """``[N, T + 1, 2]`` metres; the last position is repeated after the end."""
    completed: NDArray[np.bool_]
    """``[N]``."""
    end: NDArray[np.int64]
    """``[N]`` step at which the mission was completed or failed."""
    touches: NDArray[np.int64]
    """``[N]`` steps in touch with a wall or an obstacle."""
    via_passed: NDArray[np.int64]
    """``[N]`` via points reached."""
    dropped: NDArray[np.bool_]
    """``[N]`` whether the style was dropped for lack of time."""
    places: tuple[tuple[str, ...], ...]
    """Per episode the places of the counted visits, in order."""


def run_bank(
    policy: AdversaryPolicy, bank: Bank, tasks: NDArray[np.int64], rng: np.random.Generator, with_places: bool = True
) -> Rollouts:
    """One episode of the policy on each of these tasks of the bank, side by side, until all have ended.

    Without `with_places` the places visited are not recorded, which is quicker.
    """
    n = len(tasks)
    scenarios = [task.scenario for task in bank.tasks]
    policy.reset(_as_task(bank.tasks[int(tasks[0])]), rng)
    steps = max(round(scenarios[k].horizon_seconds * scenarios[k].control_hertz) for k in tasks) + 2
    world = BatchedWorld(bank, n, rng)
    world.begin(np.arange(n), tasks)
    positions = np.empty((n, steps + 1, 2), dtype=np.float32)
    positions[:, 0] = world.state[:, :2]
    end = np.full(n, -1, dtype=np.int64)
    touches = np.zeros(n, dtype=np.int64)
    vias = np.zeros(n, dtype=np.int64)
    places: list[list[str]] = [[] for _ in range(n)]
    last = 0
    for step in range(1, steps + 1):
        before = world.location.copy()
        world.step(policy.act(world.observation))
        for i in np.flatnonzero(world.visited) if with_places else ():
            automaton = bank.tasks[int(tasks[i])].automaton
            branch = automaton.branch[before[i], int(automaton.masks(world.state[i, :2])[0])]
            places[i].append(automaton.branch_places[branch] if branch >= 0 else "")
        positions[:, step] = world.state[:, :2]
        touches += world.touched
        np.maximum(vias, world.memory[:, 0], out=vias)
        ended = world.finished
        end[ended & (end < 0)] = step
        last = step
        if ended.all():
            break
    end[end < 0] = last
    return Rollouts(
        task=tasks,
        positions=positions[:, : last + 1],
        completed=world.completed.copy(),
        end=end,
        touches=touches,
        via_passed=vias,
        dropped=world.memory[:, 1].astype(bool),
        places=tuple(tuple(visited) for visited in places),
    )


def _as_task(task: AdversaryTask) -> Task:
    return Task(task.scenario, task.mission, task.mission.name or "M1", "point", 1.0)


def rollout_unopposed(
    policy: AdversaryPolicy, task: Task, rng: np.random.Generator, count: int
) -> tuple[NDArray[np.float64], NDArray[np.int32]]:
    """Trajectories of a policy that nobody hunts, from starts drawn as an episode draws them.

    Returns positions ``[count, T + 1, 2]`` in metres at the ticks of `Scenario.step_seconds` (T: the horizon; it stays
    where its mission ended), and the tick at which each completed its mission ``[count]``, or -1.
    """
    if count < 1:
        raise ValueError(f"count is {count}, must be >= 1")
    built = AdversaryTask.draw(
        task.scenario, task.mission, policy.style, rng, min(count, DRAWS) if policy.style.varies else 1
    )
    bank = Bank.of(built)
    rollouts = run_bank(policy, bank, np.arange(count) % len(bank), rng, with_places=False)
    per_tick = round(task.scenario.step_seconds * task.scenario.control_hertz)
    steps = np.minimum(np.arange(task.scenario.horizon_ticks + 1) * per_tick, rollouts.positions.shape[1] - 1)
    completed = np.where(rollouts.completed, -(-rollouts.end // per_tick), NOT_COMPLETED)
    return rollouts.positions[:, steps].astype(np.float64), completed.astype(np.int32)


def zoo_rollouts(
    policies: Sequence[AdversaryPolicy], task: Task, rng: np.random.Generator, count: int
) -> tuple[NDArray[np.float64], NDArray[np.int32]]:
    """`rollout_unopposed` of every policy, `count` each, one after the other."""
    found = [rollout_unopposed(policy, task, rng, count) for policy in policies]
    return np.concatenate([f[0] for f in found]), np.concatenate([f[1] for f in found])
