"""The batched arenas: the interception environment N times over, in compiled loops, for training.

Both sides act; observations, rewards, ends and ego tasks are those of `InterceptEnv`, computed by the same functions or
held equal to them by tests. The motion is `motion_kernels.drive` instead of pymunk: exact in free space, and within 2.5 mm
a control step of pymunk's in contact with walls and obstacles. Robots that touch each other (possible in surveillance
only) yield to each other by halves, which is not what pymunk does.
"""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import lru_cache
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from tab_marl.envs import arena_kernels as k
from tab_marl.envs.adversary_observation import OBSERVED, AdversaryTask
from tab_marl.envs.adversary_tables import outline
from tab_marl.envs.batched import Bank
from tab_marl.envs.ego_observation import ego_rows
from tab_marl.envs.episode import CLOSING_MARGIN, draw_starts
from tab_marl.envs.reward import AdversaryRewards
from tab_marl.envs.styles import Style
from tab_marl.envs.task_source import TaskSource
from tab_marl.mission.automaton import FAILED
from tab_marl.mission.tasks import Task
from tab_marl.world.regions import Region
from tab_marl.world.scenario import EGO_TASKS, Scenario

EVENTS = (
    "intercepted", "completed", "failed", "ego_collided", "adversary_collided", "encountered", "arrived", "watched",
)  # fmt: skip
"""Columns of `BatchedArenas.events`."""


class Duels(NamedTuple):
    """What the ego and its task add to the bank's tables: a row per task (columns: `arena_kernels`)."""

    number: NDArray[np.int64]
    """``[K, NUMBERS]``."""
    real: NDArray[np.float64]
    """``[K, REALS]``."""
    camera: NDArray[np.float64]
    """``[K, C, 3]`` x, y, radius; the first `number[CAMERAS]` rows count."""
    goal_disc: NDArray[np.float64]
    goal_first: NDArray[np.int64]
    goal_halfplanes: NDArray[np.float64]
    """The ego's goal as `adversary_tables.outline` gives it."""


@dataclass(frozen=True, eq=False)
class Outcome:
    """What one step of all arenas gave; every array is fresh."""

    ego: NDArray[np.float32]
    """``[N, D]`` the ego's observations."""
    adversary: NDArray[np.float32]
    """``[N, 40]`` the adversary's."""
    rewards: NDArray[np.float64]
    """``[N, 2]`` of ego and adversary."""
    terminated: NDArray[np.bool_]
    truncated: NDArray[np.bool_]
    events: NDArray[np.bool_]
    """``[N, 8]`` what happened, in the order of EVENTS."""


class BatchedArenas:
    """N arenas on the tasks of a bank. After `step`, call `begin` for the arenas whose episode has ended."""

    def __init__(
        self,
        tasks: Sequence[AdversaryTask],
        arenas: int,
        end_on_completion: bool = False,
        full_observation: bool = False,
        max_cycles: int | None = None,
        adversary_rewards: AdversaryRewards | str | None = None,
        workers: int = 1,
    ) -> None:
        """`tasks` are drawn from by `begin`; `workers` threads share the arenas, with the same outcome for any number of
        them; the other arguments are `InterceptEnv`'s.

        Raises ValueError if the tasks' egos observe different things.
        """
        if arenas < 1:
            raise ValueError(f"the number of arenas is {arenas}, must be >= 1")
        if workers < 1:
            raise ValueError(f"workers is {workers}, must be >= 1")
        self.bank = Bank.of(tasks)
        self.arenas = arenas
        rows = {tuple(row.name for row in ego_rows(task.scenario)) for task in tasks}
        kinds = {task.scenario.ego_task for task in tasks}
        if len(rows) > 1 or len(kinds) > 1:
            raise ValueError(
                f"the tasks' egos have observations of {sorted(len(r) for r in rows)} values and tasks {sorted(kinds)}: "
                "one batch needs one kind of ego"
            )
        self.observed_by_ego = len(next(iter(rows)))
        self._duels = _duels([task.scenario for task in tasks], AdversaryRewards.of(adversary_rewards), max_cycles)
        self._end_on_completion = end_on_completion
        self._full = full_observation
        self.task = np.zeros(arenas, dtype=np.int64)
        """``[N]`` which task each arena plays."""
        self.robots = np.zeros((arenas, 2, 5))
        """``[N, 2, 5]`` x, y, theta, v, w of ego and adversary."""
        self.location = np.full(arenas, FAILED, dtype=np.int64)
        self.clocks = np.full((arenas, 3), -1, dtype=np.int32)
        self.memory = np.zeros((arenas, 2), dtype=np.int32)
        """``[N, 2]`` via points that the adversary passed, whether it dropped its styled route."""
        self._potential = np.zeros((arenas, 2))
        self._counter = np.zeros((arenas, k.COUNTERS), dtype=np.int64)
        self._ego = np.zeros((arenas, self.observed_by_ego), dtype=np.float32)
        self._adversary = np.zeros((arenas, OBSERVED), dtype=np.float32)
        cuts = np.linspace(0, arenas, min(workers, arenas) + 1).round().astype(int).tolist()
        self._shares = [slice(a, b) for a, b in pairwise(cuts)]

    @property
    def steps(self) -> NDArray[np.int64]:
        """``[N]`` control steps since the episode began."""
        return self._counter[:, k.STEPS].copy()

    @property
    def visits(self) -> NDArray[np.int64]:
        """``[N]`` visits that counted for the adversary's mission since the episode began."""
        return self._counter[:, k.VISITS].copy()

    def begin(
        self,
        which: NDArray[np.int64],
        rng: np.random.Generator,
        tasks: NDArray[np.int64] | None = None,
        starts: NDArray[np.float64] | None = None,
    ) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Begin episodes in the arenas ``which[M]``; returns all observations of the egos and of the adversaries.

        Tasks ``[M]`` are drawn uniformly, starts ``[M, 2, 3]`` as `InterceptEnv` draws them, unless given.
        """
        chosen = rng.integers(len(self.bank), size=len(which)) if tasks is None else tasks
        if starts is None:
            starts = np.array([draw_starts(self.bank.tasks[i].scenario, rng) for i in chosen]).reshape(-1, 2, 3)
        self.task[which] = chosen
        k.begin_many(
            self.bank.tables, self._duels, which, self.task, starts, self._full, self.robots, self.location,
            self.clocks, self.memory, self._potential, self._counter, self._ego, self._adversary,
        )  # fmt: skip
        return self._ego.copy(), self._adversary.copy()

    def step(self, ego: NDArray[np.float32], adversary: NDArray[np.float32]) -> Outcome:
        """One control step under actions ``[N, 2]`` in [-1, 1] of each side.

        Raises ValueError for actions of another shape or that are not finite.
        """
        given = []
        for name, actions in (("ego", ego), ("adversary", adversary)):
            array = np.ascontiguousarray(actions, dtype=np.float32)
            if array.shape != (self.arenas, 2):
                raise ValueError(f"the actions of the {name} have shape {array.shape}, must be ({self.arenas}, 2)")
            if not np.isfinite(array).all():
                raise ValueError(f"some action of the {name} is not finite, must be numbers in [-1, 1]")
            given.append(array)
        n = self.arenas
        rewards, events = np.empty((n, 2)), np.empty((n, k.EVENTS))
        terminated, truncated = np.empty(n, dtype=bool), np.empty(n, dtype=bool)

        def share(rows: slice) -> None:
            k.step_many(
                self.bank.tables, self._duels, self.task[rows], given[0][rows], given[1][rows], self._end_on_completion,
                self._full, self.robots[rows], self.location[rows], self.clocks[rows], self.memory[rows],
                self._potential[rows], self._counter[rows], rewards[rows], terminated[rows], truncated[rows], events[rows], self._ego[rows],
                self._adversary[rows],
            )  # fmt: skip

        if len(self._shares) == 1:
            share(self._shares[0])
        else:
            list(_threads(len(self._shares)).map(share, self._shares))
        return Outcome(
            self._ego.copy(), self._adversary.copy(), rewards, terminated, truncated, events.astype(bool)
        )  # fmt: skip


@lru_cache(maxsize=8)
def _threads(count: int) -> ThreadPoolExecutor:
    """Kept, since a step is shorter than a thread's start."""
    return ThreadPoolExecutor(count, "arenas")


def draw_bank(source: TaskSource, count: int, style: Style, rng: np.random.Generator) -> list[AdversaryTask]:
    """`count` tasks of a source with the latents of the style drawn for each; what they share is computed once."""
    drawn = [source(rng) for _ in range(count)]
    found: list[AdversaryTask] = []
    for task, times in _runs(drawn):
        found += AdversaryTask.draw(task.scenario, task.mission, style, rng, times)
    return found


def _runs(tasks: Sequence[Task]) -> list[tuple[Task, int]]:
    """Each task once, and how often it comes in succession."""
    runs: list[tuple[Task, int]] = []
    for task in tasks:
        if runs and runs[-1][0] is task:
            runs[-1] = (task, runs[-1][1] + 1)
        else:
            runs.append((task, 1))
    return runs


def _duels(scenarios: Sequence[Scenario], prices: AdversaryRewards, max_cycles: int | None) -> Duels:
    number = np.zeros((len(scenarios), k.NUMBERS), dtype=np.int64)
    real = np.zeros((len(scenarios), k.REALS))
    camera = np.zeros((len(scenarios), max(1, *(len(s.checkpoints) for s in scenarios)), 3))
    goals = []
    for i, scenario in enumerate(scenarios):
        last = round(scenario.horizon_seconds * scenario.control_hertz)
        number[i] = (
            EGO_TASKS.index(scenario.ego_task), last if max_cycles is None else min(last, max_cycles),
            round(scenario.step_seconds * scenario.control_hertz), len(scenario.checkpoints),
            scenario.sensors.lidar_rays, scenario.ego_goal is not None,
        )  # fmt: skip
        fastest = scenario.ego.max_speed + scenario.adversary.max_speed
        pay = scenario.rewards
        real[i] = (
            scenario.ego.radius_metres, scenario.ego.max_speed, scenario.ego.max_turn_rate, scenario.interception_metres,
            scenario.interception_metres + CLOSING_MARGIN * fastest / scenario.control_hertz, scenario.watch_metres,
            scenario.sensors.lidar_metres, scenario.sensors.adversary_sees_ego_metres,
            1.0 / (scenario.control_hertz * scenario.step_seconds),
            pay.interception, pay.collision, pay.per_step, pay.control, pay.mission_completed, pay.encounter,
            pay.arrival, pay.watched,
            prices.completed, prices.failed, prices.intercepted, prices.collision, prices.per_step,
            prices.progress, prices.excess,
            *((0.0, 0.0) if scenario.ego_goal is None else scenario.ego_goal.centre),
        )  # fmt: skip
        for c, checkpoint in enumerate(scenario.checkpoints):
            camera[i, c] = checkpoint.x, checkpoint.y, checkpoint.camera_metres
        goals.append(scenario.ego_goal)
    return Duels(number, real, camera, *_goal_tables(goals))


def _goal_tables(
    goals: Sequence[Region | None],
) -> tuple[NDArray[np.float64], NDArray[np.int64], NDArray[np.float64]]:
    discs, planes, first = np.zeros((len(goals), 4)), [np.zeros((0, 3))], [0]
    for i, goal in enumerate(goals):
        if goal is not None:
            discs[i], sides, _ = outline(goal)
            planes.append(sides)
        first.append(sum(len(p) for p in planes))
    return discs, np.array(first, dtype=np.int64), np.concatenate([*planes, np.zeros((1, 3))])
