"""Learning which habit to begin an episode with, against egos that hunt.

A policy that follows its route cannot choose between ways round an obstacle, or among goals, at random; what it was told to
do when the episode began decides. So that choice is learned: the probabilities of a style's habits, by multiplicative weights
on what each brought, with importance weights since one habit is tried at a time (Exp3: Auer, Cesa-Bianchi, Freund and
Schapire 2002). What is kept is the average over the second half of the rounds: against an opponent that always answers the
present mixture best, the average comes close to the mixture of the game's equilibrium (Freund and Schapire 1999), while the
mixture itself circles around it.
"""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import TypeAdapter

from tab_marl.agents.adversaries import AdversaryPolicy
from tab_marl.agents.hunted.egos import SEEDS, hunter_names, hunting_options
from tab_marl.agents.hunted.play import play_hunted
from tab_marl.agents.measures.rollouts import rollout_unopposed
from tab_marl.agents.training.env import TRAINING, draw_tasks
from tab_marl.agents.training.settings import TrainingError, TrainingSettings
from tab_marl.envs.adversary_observation import AdversaryTask, leaves_choice
from tab_marl.envs.styles import Habit, Style
from tab_marl.mission.tasks import Task

HABITS_FILE = "habits.json"
VERSION = 1
CONTEXTS = 2
"""Missions whose last goal is one place, and missions whose last goal is any of several."""
LEAST_WEIGHT = 0.01
"""Habits that are rarer are dropped."""
OWN_ROLLOUTS = 3
"""Trajectories per task and habit that population-POMCP knows."""
POOL = 60
"""Trajectories in its belief, drawn by the present mixture."""
TASKS = 30
"""Tasks on which a training run learns its habits: their fields are solved once and kept."""


@dataclass(frozen=True)
class HabitSettings:
    """How the mixture is learned."""

    egos: tuple[str, ...] = ("FP-POMCP", "TAB-POMCP")
    """One is drawn per episode. population-POMCP knows the adversary's present mixture, and so punishes being predictable."""
    episodes: int = 1000
    together: int = 16
    """Episodes between two updates."""
    step: float = 0.8
    """The learning rate of the logarithms of the weights, per update."""
    explore: float = 0.25
    """So much of the trials is spread evenly over the habits."""
    seen_metres: float = 0.8
    """Range in which the adversary sees the ego, with a free line of sight."""
    seed: int = 0

    def __post_init__(self) -> None:
        for name in ("episodes", "together"):
            if getattr(self, name) < 1:
                raise ValueError(f"HabitSettings.{name} is {getattr(self, name)}, must be >= 1")
        if not self.step > 0:
            raise ValueError(f"HabitSettings.step is {self.step}, must be > 0")
        if not 0 < self.explore <= 1:
            raise ValueError(f"HabitSettings.explore is {self.explore}, must lie in (0, 1]")
        object.__setattr__(self, "egos", tuple(self.egos))

    @property
    def updates(self) -> int:
        return -(-self.episodes // self.together)


class MixtureLearner:
    """Probabilities of K choices in C contexts, from what single trials brought."""

    def __init__(self, contexts: int, choices: int, step: float, explore: float) -> None:
        self.step, self.explore = step, explore
        self.logits = np.zeros((contexts, choices))
        self.sum = np.zeros((contexts, choices))
        """Of `mixture` over the rounds that count."""
        self.rounds = 0
        self.tries = np.zeros((contexts, choices))
        self.gains = np.zeros((contexts, choices))

    @property
    def mixture(self) -> NDArray[np.float64]:
        """``[C, K]`` probabilities of the present choice."""
        weight = np.exp(self.logits - self.logits.max(axis=1, keepdims=True))
        return np.asarray(weight / weight.sum(axis=1, keepdims=True))

    @property
    def trial(self) -> NDArray[np.float64]:
        """``[C, K]`` probabilities by which choices are tried."""
        return (1.0 - self.explore) * self.mixture + self.explore / self.logits.shape[1]

    def update(self, contexts: NDArray[np.int64], choices: NDArray[np.int64], rewards: NDArray[np.float64]) -> None:
        """One round: trials ``[M]`` and what each brought, at best 1."""
        trial = self.trial
        np.add.at(self.tries, (contexts, choices), 1.0)
        np.add.at(self.gains, (contexts, choices), rewards)
        for c in np.unique(contexts):
            mine = contexts == c
            # Any baseline leaves the expectation as it is, up to a shift that softmax does not see.
            baseline = self.gains[c].sum() / self.tries[c].sum()
            estimate = np.zeros(self.logits.shape[1])
            np.add.at(estimate, choices[mine], (rewards[mine] - baseline) / trial[c, choices[mine]])
            self.logits[c] += self.step * estimate / mine.sum()

    def end_round(self, counts: bool) -> None:
        """Add the present mixture to the average, if this round counts for it."""
        if counts:
            self.sum += self.mixture
            self.rounds += 1

    def average(self) -> NDArray[np.float64]:
        """``[C, K]`` the mixture to keep: the mean over the rounds that counted."""
        return self.sum / self.rounds if self.rounds else self.mixture

    def state(self) -> dict[str, Any]:
        """As JSON values."""
        arrays = {name: getattr(self, name).tolist() for name in ("logits", "sum", "tries", "gains")}
        return {**arrays, "rounds": self.rounds}

    def restore(self, state: dict[str, Any]) -> None:
        """The inverse of `state`."""
        for name in ("logits", "sum", "tries", "gains"):
            setattr(self, name, np.array(state[name]))
        self.rounds = state["rounds"]


def learn_habits(
    policy: AdversaryPolicy,
    style: Style,
    tasks: Sequence[Task],
    settings: HabitSettings,
    folder: Path | str,
    on_round: Callable[[int, int], None] | None = None,
) -> Style:
    """The style with the weights of its mixture learned by playing the policy against live egos on these tasks.

    The reward of an episode is 1 if the mission was completed before the adversary was caught, else 0. Every update is
    written to ``habits.json`` in `folder`, which a killed run continues from, to the same end. Raises ValueError for a style
    without a mixture, or a folder that holds the habits of other settings.
    """
    if not style.mixture:
        raise ValueError(f"the style {style.name!r} has no mixture: there is nothing to choose from")
    for ego in settings.egos:
        hunter_names(ego)
    path = Path(folder) / HABITS_FILE
    rng = np.random.default_rng((settings.seed, 23))
    learner = MixtureLearner(CONTEXTS, len(style.mixture), settings.step, settings.explore)
    asked = {"version": VERSION, "settings": _plain(settings), "habits": [h.style.name for h in style.mixture]}
    done = 0
    if path.exists():
        found = json.loads(path.read_text(encoding="utf-8"))
        if any(found.get(name) != value for name, value in asked.items()):
            raise ValueError(f"{path} holds habits that were learned with other settings: choose another folder")
        learner.restore(found["learner"])
        rng.bit_generator.state = found["random"]
        done = found["updates"]
    own = _OwnTrajectories(policy, style, settings.seed)
    options = replace(hunting_options(), rollouts=own)
    for update in range(done, settings.updates):
        own.mixture = learner.mixture
        chosen = rng.choice(len(tasks), settings.together)
        contexts = np.array([int(leaves_choice(tasks[i].mission)) for i in chosen])
        habits = np.array([rng.choice(len(style.mixture), p=learner.trial[c]) for c in contexts])
        built = [
            aware_task(tasks[i], style.mixture[h].style, rng, settings.seen_metres)
            for i, h in zip(chosen, habits, strict=True)
        ]
        egos = [settings.egos[int(i)] for i in rng.integers(len(settings.egos), size=len(chosen))]
        seeds = [int(seed) for seed in rng.integers(SEEDS, size=len(chosen))]
        played = play_hunted(policy, built, egos, seeds, options)
        learner.update(contexts, habits, played.completed.astype(np.float64))
        learner.end_round(counts=2 * (update + 1) > settings.updates)
        record = {
            **asked,
            "updates": update + 1,
            "learner": learner.state(),
            "random": rng.bit_generator.state,
            "mixture": learner.average().tolist(),
        }
        temporary = path.with_suffix(".tmp")
        temporary.write_text(json.dumps(record, indent=1), encoding="utf-8")
        os.replace(temporary, path)
        if on_round is not None:
            on_round(update + 1, settings.updates)
    return with_weights(style, learner.average())


def learn_for(
    settings: TrainingSettings, model: Any, folder: Path, on_round: Callable[[int, int], None] | None = None
) -> Style:
    """`learn_habits` of a training run, with the actor of its model, on tasks of its own.

    Where the settings have a family whose last goal is any of several places, its tasks alone: at a single goal a planner
    waits, whatever the adversary does, and there is nothing to learn. The weights for such missions then stay even.
    Raises TrainingError.
    """
    from tab_marl.agents.policies.zoo import policy_of

    families = tuple(family for family in settings.families if family == "ambiguous") or settings.families
    tasks = draw_tasks(
        TRAINING,
        settings.seed,
        min(settings.tasks, TASKS),
        settings.missions,
        families,
        settings.map,
        settings.difficulty,
    )
    try:
        asked = HabitSettings(
            egos=hunter_names(settings.habits_against),
            episodes=settings.habit_episodes,
            seen_metres=settings.ego_seen_metres,
            seed=settings.seed,
        )
        return learn_habits(policy_of(model, settings, settings.steps), settings.style, tasks, asked, folder, on_round)
    except ValueError as error:
        raise TrainingError(f"{settings.name}: {error}") from None


def aware_task(task: Task, style: Style, rng: np.random.Generator, seen_metres: float) -> AdversaryTask:
    """The task under a style, the adversary seeing an ego within this range."""
    sensors = replace(task.scenario.sensors, adversary_sees_ego_metres=seen_metres)
    return AdversaryTask.build(replace(task.scenario, sensors=sensors), task.mission, style, rng)


def with_weights(style: Style, mixture: NDArray[np.float64]) -> Style:
    """The style with these weights ``[2, K]``, rounded; habits below LEAST_WEIGHT in both contexts are dropped."""
    kept = np.flatnonzero((mixture >= LEAST_WEIGHT).any(axis=0))
    shares = np.round(mixture[:, kept] / mixture[:, kept].sum(axis=1, keepdims=True), 4)
    shares[:, 0] += np.round(1.0 - shares.sum(axis=1), 4)
    habits = [
        Habit(style.mixture[k].style, round(float(one), 4), round(float(several), 4))
        for k, (one, several) in zip(kept, shares.T, strict=True)
    ]
    return replace(style, mixture=tuple(habits))


def learned_style(style: Style, folder: Path | str) -> Style:
    """The style with what `learn_habits` left in this folder; as it is if there is nothing."""
    path = Path(folder) / HABITS_FILE
    if not path.exists():
        return style
    return with_weights(style, np.array(json.loads(path.read_text(encoding="utf-8"))["mixture"]))


def _plain(settings: HabitSettings) -> dict[str, Any]:
    return TypeAdapter(dict[str, Any]).dump_python(asdict(settings), mode="json")


class _OwnTrajectories:
    """What population-POMCP knows while habits are learned: how the adversary behaves, but not what it drew."""

    def __init__(self, policy: AdversaryPolicy, style: Style, seed: int) -> None:
        self.mixture = np.empty((0, 0))
        """``[C, H]`` the present one."""
        self._policy, self._style, self._seed = policy, style, seed
        self._known: dict[tuple[Task, int], tuple[NDArray[np.float64], NDArray[np.int32]]] = {}

    def __call__(self, task: Task, rng: np.random.Generator) -> tuple[NDArray[np.float64], NDArray[np.int32]]:
        """Trajectories drawn by the present mixture (`planners.Rollouts`)."""
        weights = self.mixture[int(leaves_choice(task.mission))]
        counts = rng.multinomial(POOL, weights)
        positions, completed = [], []
        for habit in np.flatnonzero(counts):
            paths, ticks = self._of(task, int(habit))
            picked = rng.integers(len(paths), size=counts[habit])
            positions.append(paths[picked])
            completed.append(ticks[picked])
        return np.concatenate(positions), np.concatenate(completed)

    def _of(self, task: Task, habit: int) -> tuple[NDArray[np.float64], NDArray[np.int32]]:
        if (task, habit) not in self._known:
            player = _InStyle(self._policy, self._style.mixture[habit].style)
            rng = np.random.default_rng((self._seed, habit, 29))
            self._known[task, habit] = rollout_unopposed(player, task, rng, OWN_ROLLOUTS)
        return self._known[task, habit]


@dataclass(frozen=True)
class _InStyle:
    """A policy under another style."""

    policy: AdversaryPolicy
    style: Style

    @property
    def name(self) -> str:
        return self.policy.name

    def reset(self, task: Task, rng: np.random.Generator) -> None:
        self.policy.reset(task, rng)

    def act(self, observation: NDArray[np.float32]) -> NDArray[np.float32]:
        return self.policy.act(observation)
