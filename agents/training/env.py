"""The batched world as a stable-baselines3 vector environment, and the banks of tasks it draws from."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
from gymnasium.spaces import Box
from numpy.typing import NDArray
from stable_baselines3.common.vec_env import VecEnv

from tab_marl.envs.adversary_observation import AdversaryTask, observation_bounds
from tab_marl.envs.batched import Bank, BatchedWorld
from tab_marl.envs.styles import Style
from tab_marl.mission.compositions import sample_composition
from tab_marl.mission.curriculum import Curriculum
from tab_marl.mission.tasks import Task, sample_task
from tab_marl.world.sampling import MapOptions

TRAINING, HELD_OUT = 1, 2
"""Streams of tasks that never share a random number."""
COMPOSED = "composed"
"""In place of a family: the mission is a composition's name."""
WINDOW = 400
"""Episodes over which success is averaged for the log."""


def draw_tasks(
    stream: int,
    seed: int,
    count: int,
    missions: Sequence[str],
    families: Sequence[str],
    options: MapOptions | None = None,
    difficulty: tuple[float, float] | None = None,
    compositions: Sequence[str] = (),
) -> list[Task]:
    """`count` tasks, missions and families in turn, then compositions; task i depends on (stream, seed, i) only.

    options: of the maps. compositions: names of `mission.compositions`, as many tasks each as of a mission and family.
    difficulty: the range in which the curriculum draws each task; see `difficulties`.
    """
    kinds = [(mission, family) for family in families for mission in missions]
    kinds += [(composition, COMPOSED) for composition in compositions]
    hardness = [0.0] * count if difficulty is None else difficulties(stream, seed, count, difficulty)
    curriculum = Curriculum()

    def draw(i: int) -> Task:
        rng, (mission, family) = np.random.default_rng((stream, seed, i)), kinds[i % len(kinds)]
        if family == COMPOSED:
            maps = options if difficulty is None else curriculum.map_options(hardness[i])
            return sample_composition(rng, mission, options=maps)
        if difficulty is None:
            return sample_task(rng, mission, family, options=options)
        return curriculum.sample_task(rng, hardness[i], mission, family)

    return [draw(i) for i in range(count)]


def difficulties(stream: int, seed: int, count: int, bounds: tuple[float, float]) -> list[float]:
    """The difficulty ``[count]`` of each task that `draw_tasks` draws, uniform within the bounds."""
    return [float(np.random.default_rng((stream, seed, i, 1)).uniform(*bounds)) for i in range(count)]


def build_bank(
    tasks: Sequence[Task], style: Style, seed: int, on_built: Callable[[int, int], None] | None = None
) -> Bank:
    """The bank of these tasks, latents drawn from (seed, index)."""
    built = []
    for i, task in enumerate(tasks):
        rng = np.random.default_rng((seed, i))
        built.append(AdversaryTask.build(task.scenario, task.mission, style, rng))
        if on_built is not None:
            on_built(i + 1, len(tasks))
    return Bank.of(built)


class TrainingEnv(VecEnv):
    """What the training worlds share as vector environments of the adversary: N robots on the tasks of a bank.

    `weights` ``[K]`` (summing to 1) is the probability of each task of the bank.
    """

    render_mode = None

    def __init__(self, robots: int, kinds: Sequence[str]) -> None:
        low, high = observation_bounds()
        super().__init__(robots, Box(low, high, dtype=np.float32), Box(-1.0, 1.0, (2,), np.float32))
        self.kinds = tuple(kinds)
        """Mission type of each task."""
        self.weights = np.full(len(kinds), 1.0 / len(kinds))
        self.recent: dict[str, list[float]] = {kind: [] for kind in sorted(set(kinds))}
        self._action = np.zeros((robots, 2), dtype=np.float32)

    def step_async(self, actions: NDArray[np.float32]) -> None:
        self._action = np.asarray(actions, dtype=np.float32)

    def record(self, task: int, completed: bool) -> None:
        """An episode on this task of the bank has ended."""
        recent = self.recent[self.kinds[task]]
        recent.append(float(completed))
        del recent[:-WINDOW]

    def success(self) -> dict[str, float]:
        """Share of completed missions per mission type over the last episodes (nan before the first)."""
        return {kind: float(np.mean(recent)) if recent else float("nan") for kind, recent in self.recent.items()}

    # What VecEnv asks for beside that; there is one world, so robots have no attributes of their own.
    def close(self) -> None:
        pass

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        return [getattr(self, attr_name)] * len(list(self._get_indices(indices)))

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
        setattr(self, attr_name, value)

    def env_method(self, method_name: str, *args: Any, indices: Any = None, **kwargs: Any) -> list[Any]:
        raise AttributeError(f"the training world has no method {method_name!r} per robot")

    def env_is_wrapped(self, wrapper_class: type, indices: Any = None) -> list[bool]:
        return [False] * len(list(self._get_indices(indices)))


class BatchedVecEnv(TrainingEnv):
    """N robots that begin a new task of the bank whenever theirs has ended."""

    KEPT = ("task", "state", "location", "clocks", "memory", "ghost", "potential", "observation")
    """Arrays of the world that the rest of a run depends on."""

    def __init__(self, bank: Bank, kinds: Sequence[str], robots: int, seed: int, seen_metres: float = 0.0) -> None:
        super().__init__(robots, kinds)
        self.world = BatchedWorld(bank, robots, np.random.default_rng((seed, 7)))
        self.world.seen_metres = seen_metres
        self.returns = np.zeros(robots)
        self.ticks = np.zeros(robots, dtype=np.int64)

    def _begin(self, which: NDArray[np.int64]) -> None:
        self.world.begin(which, self.world.rng.choice(len(self.weights), size=len(which), p=self.weights))

    def reset(self) -> NDArray[np.float32]:
        self._begin(np.arange(self.num_envs))
        self.returns[:] = 0
        self.ticks[:] = 0
        return self.world.observation.copy()

    def step_wait(self) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.bool_], list[dict[str, Any]]]:
        world = self.world
        world.step(self._action)
        reward = world.reward.astype(np.float32)
        self.returns += world.reward
        self.ticks += 1
        done = world.finished
        infos: list[dict[str, Any]] = [{} for _ in range(self.num_envs)]
        ended = np.flatnonzero(done)
        if len(ended):
            completed = world.completed
            for i in ended:
                infos[i] = {
                    "terminal_observation": world.observation[i].copy(),
                    "episode": {"r": float(self.returns[i]), "l": int(self.ticks[i]), "t": 0.0},
                }
                self.record(int(world.task[i]), bool(completed[i]))
            self.returns[ended] = 0
            self.ticks[ended] = 0
            self._begin(ended)
        return world.observation.copy(), reward, done, infos

    def snapshot(self) -> tuple[dict[str, NDArray[Any]], dict[str, Any]]:
        """Everything that the rest of a run depends on: arrays by name, and what goes into JSON."""
        arrays = {name: np.array(getattr(self.world, name)) for name in self.KEPT}
        arrays |= {"returns": self.returns.copy(), "ticks": self.ticks.copy()}
        return arrays, {"random": self.world.rng.bit_generator.state, "recent": self.recent}

    def restore(self, arrays: Mapping[str, NDArray[Any]], text: Mapping[str, Any]) -> None:
        """Go on from a snapshot."""
        for name in self.KEPT:
            getattr(self.world, name)[:] = arrays[name]
        self.returns[:], self.ticks[:] = arrays["returns"], arrays["ticks"]
        self.world.rng.bit_generator.state = text["random"]
        self.recent = {kind: list(shares) for kind, shares in text["recent"].items()}
