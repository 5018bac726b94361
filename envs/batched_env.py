"""The batched arenas as a Gymnasium vector environment: one side learns in N arenas at once, the other one is played.

``gymnasium.make_vec("tab_marl/BatchedEgo-v0", num_envs=256)`` and ``"tab_marl/BatchedAdversary-v0"``. Observations,
actions and rewards are those of ``tab_marl/Ego-v0`` and ``tab_marl/Adversary-v0``; what differs is the motion
(`batched_arenas`). An arena whose episode ends begins the next one in the same step; the last observation is then in
``infos["final_obs"]`` (Gymnasium's `AutoresetMode.SAME_STEP`).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, ClassVar, Protocol

import numpy as np
from gymnasium.spaces import Box
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray

from tab_marl.envs.adversary_side import adversary_space, as_style
from tab_marl.envs.batched_arenas import EVENTS, BatchedArenas, draw_bank
from tab_marl.envs.ego_observation import ego_space
from tab_marl.envs.opponents import HOLD_SECONDS, OPPONENTS, Opponent, Player, follow_route, make_opponent
from tab_marl.envs.reward import AdversaryRewards
from tab_marl.envs.styles import Style
from tab_marl.envs.task_source import TaskSource, task_source
from tab_marl.mission import Mission
from tab_marl.mission.tasks import Task
from tab_marl.world.scenario import Scenario

Array = NDArray[np.float32]
TASKS = 64
"""Tasks in the bank where they are drawn (scenario "random", styles with latents)."""


class Crowd(Protocol):
    """What plays one side of all arenas."""

    def begin(self, which: NDArray[np.int64], tasks: Sequence[Task], rng: np.random.Generator) -> None:
        """Episodes on these tasks begin in these arenas."""
        ...

    def act(self, observations: Array) -> Array:
        """Actions ``[N, 2]`` for observations ``[N, D]``."""
        ...


class BatchedEnv(VectorEnv[Array, Array, NDArray[Any]]):
    """One side of N batched arenas as a Gymnasium vector environment."""

    metadata: ClassVar[dict[str, Any]] = {"render_modes": [], "autoreset_mode": AutoresetMode.SAME_STEP}  # type: ignore[misc]

    def __init__(
        self,
        num_envs: int,
        side: str,
        opponent: Opponent | Any,
        adversary_style: Style | str | None = None,
        end_on_completion: bool = True,
        full_observation: bool = False,
        max_cycles: int | None = None,
        adversary_rewards: AdversaryRewards | str | None = None,
        tasks: int | None = None,
        render_mode: None = None,
        task: Task | TaskSource | None = None,
        mission: str | Mission = "M1",
        scenario: str | Scenario = "lab",
        workers: int = 1,
        **drawn: Any,
    ) -> None:
        """`side`: "ego" or "adversary", who learns. `opponent`: a scripted player's name (see `opponents`), or an object
        with ``act`` or a function that takes observations ``[N, D]`` and gives actions ``[N, 2]``, such as a zoo policy or
        a frozen copy of the learner. `tasks`: how many tasks are drawn once, at the first reset, and played over and over
        (default: 64 where there is something to draw). `workers`: threads that share the arenas; the episodes are the
        same. `task`, `mission`, `scenario` and what else says what is played (`family`, `sampled`, `difficulty`,
        `curriculum`, `ego_task`, `adversary_sees_ego_metres`): see `task_source`. The rest is
        `InterceptEnv`'s.
        """
        if side not in ("ego", "adversary"):
            raise ValueError(f"side is {side!r}, must be 'ego' or 'adversary'")
        if tasks is not None and tasks < 1:
            raise ValueError(f"tasks is {tasks}, must be >= 1 or None")
        self.num_envs = num_envs
        self.render_mode = render_mode
        other = "adversary" if side == "ego" else "ego"
        self._own_is_ego = side == "ego"
        self._crowd = _crowd(opponent, other, num_envs)
        own_style = getattr(self._crowd, "style", None) if side == "ego" else None
        self._style = as_style(own_style if adversary_style is None else adversary_style)
        self._source = task_source(task, mission, scenario, **drawn)
        some, another = (self._source(np.random.default_rng(seed)) for seed in (0, 1))
        self._tasks = tasks if tasks is not None else TASKS if some != another or self._style.varies else 1
        self._shape_of = some.scenario
        self._options: dict[str, Any] = {
            "end_on_completion": end_on_completion,
            "full_observation": full_observation,
            "max_cycles": max_cycles,
            "adversary_rewards": adversary_rewards,
            "workers": workers,
        }
        self.single_observation_space = ego_space(self._shape_of) if side == "ego" else adversary_space()
        self.single_action_space = Box(-1.0, 1.0, (2,), dtype=np.float32)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self._rng = np.random.default_rng()
        self._arenas: BatchedArenas | None = None
        self._seen_by_other: Array = np.zeros((num_envs, 0), dtype=np.float32)

    @property
    def arenas(self) -> BatchedArenas:
        """The arenas. Raises RuntimeError before the first reset."""
        if self._arenas is None:
            raise RuntimeError("there is no episode yet: call reset first")
        return self._arenas

    def reset(
        self, *, seed: int | list[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Array, dict[str, Any]]:
        """Begin an episode in every arena. The same seed and actions give the same episodes; a seed also draws the tasks
        anew. A list of seeds, as a vector of separate environments takes, is one seed here.
        """
        if seed is not None or self._arenas is None:
            self._rng = np.random.default_rng(_one_seed(seed))
            built = draw_bank(self._source, self._tasks, self._style, self._rng)
            self._arenas = BatchedArenas(built, self.num_envs, **self._options)
        return self._begin(np.arange(self.num_envs)), {}

    def step(self, actions: Array) -> tuple[Array, NDArray[Any], NDArray[Any], NDArray[Any], dict[str, Any]]:
        """One control step in every arena; `infos` holds the events by name as arrays ``[N]``."""
        arenas = self.arenas
        other = self._crowd.act(self._seen_by_other)
        outcome = arenas.step(actions, other) if self._own_is_ego else arenas.step(other, actions)
        own, self._seen_by_other = (
            (outcome.ego, outcome.adversary) if self._own_is_ego else (outcome.adversary, outcome.ego)
        )
        infos: dict[str, Any] = {name: outcome.events[:, i] for i, name in enumerate(EVENTS)}
        ended = np.flatnonzero(outcome.terminated | outcome.truncated)
        if len(ended):
            last = np.empty(self.num_envs, dtype=object)
            for i in ended:
                last[i] = own[i].copy()
            infos["final_obs"] = last
            infos["_final_obs"] = outcome.terminated | outcome.truncated
            own = self._begin(ended)
        rewards = outcome.rewards[:, 0 if self._own_is_ego else 1]
        return own, rewards, outcome.terminated, outcome.truncated, infos

    def close_extras(self, **kwargs: Any) -> None:
        """Nothing is held open."""

    def _begin(self, which: NDArray[np.int64]) -> Array:
        arenas = self.arenas
        ego, adversary = arenas.begin(which, self._rng)
        own, self._seen_by_other = (ego, adversary) if self._own_is_ego else (adversary, ego)
        tasks = [arenas.bank.tasks[k] for k in arenas.task[which]]
        self._crowd.begin(which, [Task(t.scenario, t.mission, "", "custom", 0.0) for t in tasks], self._rng)
        return own


def _one_seed(seed: int | list[int | None] | None) -> int | None:
    return seed[0] if isinstance(seed, list) else seed


class _Follow:
    """The scripted follower of routes, all at once."""

    def __init__(self, arenas: int) -> None:
        self._turn_per_step = np.ones(arenas)

    def begin(self, which: NDArray[np.int64], tasks: Sequence[Task], rng: np.random.Generator) -> None:
        for i, task in zip(which, tasks, strict=True):
            self._turn_per_step[i] = task.scenario.adversary.max_turn_rate / task.scenario.control_hertz

    def act(self, observations: Array) -> Array:
        return follow_route(observations, self._turn_per_step)


class _Random:
    """Random actions, each held for HOLD_SECONDS."""

    def __init__(self, arenas: int) -> None:
        self._action = np.zeros((arenas, 2), dtype=np.float32)
        self._hold = np.ones(arenas, dtype=np.int64)
        self._step = np.zeros(arenas, dtype=np.int64)
        self._rng = np.random.default_rng(0)

    def begin(self, which: NDArray[np.int64], tasks: Sequence[Task], rng: np.random.Generator) -> None:
        self._rng = rng
        self._step[which] = 0
        for i, task in zip(which, tasks, strict=True):
            self._hold[i] = round(HOLD_SECONDS * task.scenario.control_hertz)

    def act(self, observations: Array) -> Array:
        due = self._step % self._hold == 0
        self._action[due] = self._rng.uniform(-1.0, 1.0, (int(due.sum()), 2)).astype(np.float32)
        self._step += 1
        return self._action


class _Static:
    def begin(self, which: NDArray[np.int64], tasks: Sequence[Task], rng: np.random.Generator) -> None: ...

    def act(self, observations: Array) -> Array:
        return np.tile(np.array([-1.0, 0.0], dtype=np.float32), (len(observations), 1))


class _OnePerArena:
    """A player that knows one arena at a time, once per arena: convenient, and slow."""

    def __init__(self, name: str, side: str, arenas: int) -> None:
        self._players: list[Any] = [make_opponent(name, side) for _ in range(arenas)]

    def begin(self, which: NDArray[np.int64], tasks: Sequence[Task], rng: np.random.Generator) -> None:
        for i, task in zip(which, tasks, strict=True):
            begin = getattr(self._players[i], "reset", None)
            if begin is not None:
                begin(task, rng.spawn(1)[0])

    def act(self, observations: Array) -> Array:
        return np.stack([player.act(row) for player, row in zip(self._players, observations, strict=True)])


class _Batch:
    """A policy or function that takes all observations at once."""

    def __init__(self, player: Player, arenas: int) -> None:
        self._player, self._arenas = player, arenas
        self.style = getattr(player, "style", None)

    def begin(self, which: NDArray[np.int64], tasks: Sequence[Task], rng: np.random.Generator) -> None:
        begin = getattr(self._player, "begin", None)  # of recurrent policies, which forget these episodes
        if begin is not None:
            begin(which)

    def act(self, observations: Array) -> Array:
        actions = np.asarray(self._player.act(observations), dtype=np.float32)
        if actions.shape != (self._arenas, 2):
            raise ValueError(
                f"the opponent answered observations {observations.shape} with actions {actions.shape}, must be "
                f"({self._arenas}, 2): in a batched environment it plays all arenas at once"
            )
        return actions


def _crowd(opponent: Opponent | Any, side: str, arenas: int) -> Crowd:
    quick: dict[str, Callable[[int], Crowd]] = {"follow": _Follow, "random": _Random, "static": lambda n: _Static()}
    if isinstance(opponent, str):
        if opponent in OPPONENTS[side] and opponent in quick:
            return quick[opponent](arenas)
        if opponent in OPPONENTS[side] or side == "ego":
            return _OnePerArena(opponent, side, arenas)
    # Policies, models and functions take all observations at once.
    return _Batch(make_opponent(opponent, side), arenas)


def batched_ego_env(num_envs: int = 1, opponent: Any = "follow", **arguments: Any) -> BatchedEnv:
    """The ego learns; the adversary follows its route unless told otherwise."""
    return BatchedEnv(num_envs, "ego", opponent, **arguments)


def batched_adversary_env(num_envs: int = 1, opponent: Any = "static", **arguments: Any) -> BatchedEnv:
    """The adversary learns; the ego stands still unless told otherwise ("pursue" works, arena by arena)."""
    return BatchedEnv(num_envs, "adversary", opponent, **arguments)
