"""The hunted world: batched arenas in which a live ego hunts the adversary that learns, as a vector environment for
stable-baselines3. Being caught ends the episode.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tab_marl.agents.hunted.egos import SEEDS, Hunters, hunter_names
from tab_marl.agents.planners import PlannerOptions
from tab_marl.agents.training.env import TRAINING, WINDOW, TrainingEnv, draw_tasks
from tab_marl.agents.training.settings import TrainingSettings
from tab_marl.envs.adversary_observation import OBSERVED, AdversaryTask
from tab_marl.envs.batched_arenas import EVENTS, BatchedArenas
from tab_marl.envs.episode import draw_starts
from tab_marl.envs.reward import SHAPED, AdversaryRewards
from tab_marl.envs.styles import Style
from tab_marl.mission.tasks import Task

REWARDS = replace(SHAPED, per_step=0.0)
"""Those of the batched training world, but waiting is free: a hunted adversary may need to."""
VISIT_REWARD = 1.0
DRAWS = 6
"""Draws of a style's latents per task of a training run."""
INTERCEPTED, COMPLETED = (EVENTS.index(name) for name in ("intercepted", "completed"))


def hunted_tasks(
    tasks: Sequence[Task],
    style: Style,
    seed: int,
    draws: int,
    seen_metres: float,
    on_built: Callable[[int, int], None] | None = None,
) -> list[AdversaryTask]:
    """`draws` draws of the style's habits for each task, one after the other; latents depend on (seed, index) only.

    `seen_metres`: the range in which the adversary sees the ego, with a free line of sight; 0: never.
    """
    found: list[AdversaryTask] = []
    for i, task in enumerate(tasks):
        aware = replace(
            task.scenario, sensors=replace(task.scenario.sensors, adversary_sees_ego_metres=float(seen_metres))
        )
        found += AdversaryTask.draw(aware, task.mission, style, np.random.default_rng((seed, i)), draws)
        if on_built is not None:
            on_built(i + 1, len(tasks))
    return found


def hunted_env(settings: TrainingSettings, on_built: Callable[[int, int], None] | None = None) -> HuntedVecEnv:
    """The hunted world of these settings: `opponent` hunts on ``tasks / DRAWS`` tasks, each with DRAWS draws of the style,
    since what a planner computes for a task is kept. Raises UnknownName for an ego that nobody knows."""
    draws = DRAWS if settings.difficulty is None else 1  # the curriculum knows each task's difficulty by its number
    distinct = -(-settings.tasks // draws)
    tasks = draw_tasks(
        TRAINING, settings.seed, distinct, settings.missions, settings.families, settings.map, settings.difficulty
    )
    built = hunted_tasks(tasks, settings.style, settings.seed, draws, settings.ego_seen_metres, on_built)
    kinds = [task.mission_id for task in tasks for _ in range(draws)]
    return HuntedVecEnv(built, kinds, settings.robots, settings.seed, settings.opponent)


class HuntedVecEnv(TrainingEnv):
    """N arenas; an ego drawn from `opponent` ("pursue", "FP-POMCP+TAB-POMCP", an SB3 ego's .zip) hunts in each.

    An arena whose episode ends begins one on another task of the bank, drawn by `weights` ``[K]`` (summing to 1), from
    starts drawn as `InterceptEnv` draws them. The reward: `REWARDS` and `VISIT_REWARD` per counted visit; a mission that
    the episode's end leaves open has failed.
    """

    def __init__(
        self,
        tasks: Sequence[AdversaryTask],
        kinds: Sequence[str],
        arenas: int,
        seed: int,
        opponent: str = "pursue",
        options: PlannerOptions | None = None,
        rewards: AdversaryRewards = REWARDS,
    ) -> None:
        """`tasks`: see `hunted_tasks`; `kinds`: the mission type of each; `options`: the planners'. Raises UnknownName for
        an ego that nobody knows."""
        if len(kinds) != len(tasks):
            raise ValueError(f"there are {len(kinds)} kinds for {len(tasks)} tasks: give each task's mission type")
        super().__init__(arenas, kinds)
        self.rng = np.random.default_rng((seed, 11))
        self.recently_caught: list[float] = []
        self.observation = np.zeros((arenas, OBSERVED), dtype=np.float32)
        """``[N, 40]`` what the adversaries observe now."""
        self.hunters = Hunters(hunter_names(opponent), arenas, options)
        self.arenas = BatchedArenas(tasks, arenas, end_on_completion=True, adversary_rewards=rewards)
        self._failed_price = rewards.failed
        self._tasks = [Task(task.scenario, task.mission, "", "custom", 0.0) for task in tasks]
        longest = max(round(task.scenario.horizon_seconds * task.scenario.control_hertz) for task in tasks)
        self._ego = np.zeros((arenas, self.arenas.observed_by_ego), dtype=np.float32)
        self._returns = np.zeros(arenas)
        self._visits = np.zeros(arenas, dtype=np.int64)
        # What an episode under way began with and was told since: enough to play it again.
        self._hunter = np.zeros(arenas, dtype=np.int64)
        self._seed = np.zeros(arenas, dtype=np.int64)
        self._start = np.zeros((arenas, 2, 3))
        self._told = np.zeros((arenas, longest + 1, 2), dtype=np.float32)
        self._learned = [""] * arenas

    def _begin(self, which: NDArray[np.int64]) -> None:
        chosen = self.rng.choice(len(self.weights), size=len(which), p=self.weights)
        for i, k in zip(which.tolist(), chosen.tolist(), strict=True):
            self._start[i] = draw_starts(self._tasks[k].scenario, self.rng)
            self._hunter[i] = self.rng.integers(len(self.hunters.names))
            self._seed[i] = self.rng.integers(SEEDS)
            self._learned[i] = self.hunters.begin(i, int(self._hunter[i]), self._tasks[k], int(self._seed[i]))
        self._place(which, chosen)

    def _place(self, which: NDArray[np.int64], tasks: NDArray[np.int64]) -> None:
        self._ego, self.observation = self.arenas.begin(which, self.rng, tasks, self._start[which])
        self._visits[which] = self.arenas.visits[which]
        self._returns[which] = 0.0

    def reset(self) -> NDArray[np.float32]:
        self._begin(np.arange(self.num_envs))
        return self.observation.copy()

    def step_wait(self) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.bool_], list[dict[str, Any]]]:
        arenas = self.arenas
        rows = np.arange(self.num_envs)
        self._told[rows, arenas.steps] = self._action
        reward, done, events = self._play(self._action)
        infos: list[dict[str, Any]] = [{} for _ in rows]
        ended = np.flatnonzero(done)
        for i in ended:
            completed, caught = bool(events[i, COMPLETED]), bool(events[i, INTERCEPTED])
            infos[i] = {
                "terminal_observation": self.observation[i].copy(),
                "episode": {"r": float(self._returns[i]), "l": int(arenas.steps[i]), "t": 0.0},
                "task": int(arenas.task[i]),
                "hunter": self.hunters.names[self._hunter[i]],
                "completed": completed,
                "intercepted": caught,
            }
            self.record(int(arenas.task[i]), completed)
            self.recently_caught.append(float(caught))
            del self.recently_caught[:-WINDOW]
        if len(ended):
            self._begin(ended)
        return self.observation.copy(), reward.astype(np.float32), done, infos

    def _play(self, actions: NDArray[np.float32]) -> tuple[NDArray[np.float64], NDArray[np.bool_], NDArray[np.bool_]]:
        """One control step of all arenas: rewards, ends, events."""
        outcome = self.arenas.step(self.hunters.act(self._ego), actions)
        self._ego, self.observation = outcome.ego, outcome.adversary
        visits = self.arenas.visits
        reward = outcome.rewards[:, 1] + VISIT_REWARD * (visits - self._visits)
        reward += np.where(outcome.truncated & (self.arenas.location >= 0), self._failed_price, 0.0)
        self._visits = visits
        self._returns += reward
        return reward, outcome.terminated | outcome.truncated, outcome.events

    def snapshot(self) -> tuple[dict[str, NDArray[Any]], dict[str, Any]]:
        """Everything that what follows depends on: arrays, and JSON values. Call it between steps."""
        arrays: dict[str, NDArray[Any]] = {
            "task": self.arenas.task.copy(),
            "steps": self.arenas.steps,
            "hunter": self._hunter.copy(),
            "seed": self._seed.copy(),
            "start": self._start.copy(),
            "told": self._told[:, : int(self.arenas.steps.max()) + 1].copy(),
            "weights": self.weights.copy(),
        }
        text: dict[str, Any] = {
            "random": self.rng.bit_generator.state,
            "recent": self.recent,
            "caught": self.recently_caught,
            "learned": self._learned,
        }
        return arrays, text

    def restore(self, arrays: dict[str, NDArray[Any]], text: dict[str, Any]) -> None:
        """Back to a `snapshot`. A planner's mind is not kept: the episodes under way are played again, up to where they
        stood, from the same seeds and with the same actions."""
        steps, task = arrays["steps"], arrays["task"]
        self._hunter[:], self._seed[:], self._start[:] = arrays["hunter"], arrays["seed"], arrays["start"]
        self._told[:, : arrays["told"].shape[1]] = arrays["told"]
        self._learned = list(text["learned"])
        last = int(steps.max())
        for arena in range(self.num_envs):
            self.hunters.leave(arena)
        for now in range(last + 1):
            # Each arena begins so late that all stand where they stood after the last round.
            which = np.flatnonzero(last - steps == now)
            for i in which.tolist():
                self.hunters.begin(
                    i, int(self._hunter[i]), self._tasks[int(task[i])], int(self._seed[i]), self._learned[i]
                )  # fmt: skip
            if len(which):
                self._place(which, task[which])
            if now < last:
                begun = np.flatnonzero(last - steps <= now)
                actions = np.tile(np.array([-1.0, 0.0], dtype=np.float32), (self.num_envs, 1))
                actions[begun] = self._told[begun, now - (last - steps[begun])]
                self._play(actions)
        self.weights = arrays["weights"].copy()
        self.recent = {kind: list(shares) for kind, shares in text["recent"].items()}
        self.recently_caught = list(text["caught"])
        self.rng.bit_generator.state = text["random"]
