"""What being hunted does: the share of missions completed against live egos on held-out tasks, habit by habit, and so under any
mixture of them."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from tab_marl.agents.hunted.habits import aware_task
from tab_marl.agents.hunted.play import play_hunted
from tab_marl.agents.measures.rollouts import run_bank
from tab_marl.agents.planner_memory import PlannerMemory
from tab_marl.agents.planners import PlannerOptions
from tab_marl.agents.policies.zoo import ZooPolicy
from tab_marl.agents.training.env import HELD_OUT, build_bank, draw_tasks
from tab_marl.envs.styles import STYLES, Style
from tab_marl.mission.tasks import MISSION_IDS, Task

TURN_RADIANS = 0.3
"""A way that turns less than this about the arena's centre takes neither side."""
RESAMPLES = 4000
BLOCK = 20
"""Tasks played side by side, and whose fields are kept."""


@dataclass(frozen=True)
class HuntedRow:
    """One hunted episode."""

    policy: str
    style: str
    ego: str
    mission: str
    family: str
    task: int
    sees_ego: bool
    completed: bool
    caught: bool
    seconds: float
    """Until the mission was completed or failed, or the adversary was caught."""


def habits_of(policy: ZooPolicy) -> dict[str, tuple[ZooPolicy, Style]]:
    """The policy under each of the even mixture's habits, by the habit's name: what `study` plays."""
    return {habit.style.name: (policy, habit.style) for habit in STYLES["habits"].mixture}


def study(
    policies: Mapping[str, tuple[ZooPolicy, Style]],
    family: str,
    count: int,
    egos: Sequence[str],
    seed: int,
    seen_metres: float = 0.0,
    options: PlannerOptions | None = None,
    on_block: Callable[[list[HuntedRow]], None] | None = None,
    first: int = 0,
) -> list[HuntedRow]:
    """Every policy against every ego on the same `count` held-out tasks of a family, missions in turn, from the same starts.

    `policies`: by name, with the style to play in. `options`: the planners' (default: those of an evaluation, but TAB-POMCP
    expects the field alone, as in training). `on_block` is called with the rows of every BLOCK tasks. `first`: the task to
    begin with, where the ones before are known.
    """
    tasks = draw_tasks(HELD_OUT, seed, count, MISSION_IDS, (family,))
    rows: list[HuntedRow] = []
    for start in range(first, count, BLOCK):
        block = range(start, min(count, start + BLOCK))
        hunting = replace(options or PlannerOptions(ways=None), memory=PlannerMemory())
        before = len(rows)
        for ego in egos:
            for name, (policy, style) in policies.items():
                built = [aware_task(tasks[i], style, np.random.default_rng((seed, i)), seen_metres) for i in block]
                played = play_hunted(policy, built, [ego] * len(built), [seed * 10_000 + i for i in block], hunting)
                rows += [
                    HuntedRow(
                        name, style.name, ego, tasks[i].mission_id, family, i, seen_metres > 0, bool(played.completed[j]),
                        bool(played.caught[j]), float(played.end[j]) / tasks[i].scenario.control_hertz,
                    )
                    for j, i in enumerate(block)
                ]  # fmt: skip
        if on_block is not None:
            on_block(rows[before:])
    return rows


@dataclass(frozen=True)
class Value:
    """A mixture's chance of completing its mission against one ego."""

    share: float
    low: float
    high: float
    """95 % interval, bootstrapped over tasks."""
    gain: float
    """Over the even mixture, on the same episodes."""
    gain_low: float
    gain_high: float


def values(rows: Sequence[HuntedRow], mixtures: Mapping[str, Style], seed: int = 0) -> dict[tuple[str, str], Value]:
    """(mixture, ego) -> what the mixture completes, from episodes under each habit on the same tasks.

    `rows` are those of `habits_of`; a mixture's share on a task is the weighted mean over its habits' episodes there, which
    is less noisy than drawing the habits anew. Tasks that were not played under every habit are left out.
    """
    names = [habit.style.name for habit in STYLES["habits"].mixture]
    even = np.full(len(names), 1.0 / len(names))
    found: dict[tuple[str, str], Value] = {}
    for ego in sorted({row.ego for row in rows}):
        done = {(row.task, row.policy): float(row.completed) for row in rows if row.ego == ego}
        tasks = [t for t in sorted({task for task, _ in done}) if all((t, name) in done for name in names)]
        table = np.array([[done[t, name] for name in names] for t in tasks])
        resampled = np.random.default_rng(seed).integers(len(tasks), size=(RESAMPLES, len(tasks)))
        for mixture, style in mixtures.items():
            share = table @ _over(style, names)
            gain = share - table @ even
            low, high = np.quantile(share[resampled].mean(axis=1), (0.025, 0.975))
            least, most = np.quantile(gain[resampled].mean(axis=1), (0.025, 0.975))
            found[mixture, ego] = Value(*(float(x) for x in (share.mean(), low, high, gain.mean(), least, most)))
    return found


def _over(style: Style, names: Sequence[str]) -> NDArray[np.float64]:
    """A style's weights where the goal is open, in the order of these habits."""
    if not style.mixture:
        return np.array([float(name == style.name) for name in names])
    weights = {habit.style.name: habit.open_weight for habit in style.mixture}
    return np.array([weights.get(name, 0.0) for name in names])


def entropy_bits(style: Style, open_ended: bool = True) -> float:
    """Of the mixture's weights."""
    weights = style.weights(open_ended)
    weights = weights[weights > 0]
    return float(-(weights * np.log2(weights)).sum()) if len(weights) else 0.0


@dataclass(frozen=True)
class Unhunted:
    """What a policy does on the same tasks when nobody hunts it."""

    completed: float
    same_side: float
    """Share of completed episodes whose way turns about the arena's centre as the shortest one does, where that turns."""
    same_last_goal: float
    """Share of completed episodes that end at the same place as the shortest way."""
    stretch: float
    """Mean length over the shortest."""


def unhunted(policy: ZooPolicy, style: Style, family: str, count: int, seed: int, draws: int = 3) -> Unhunted:
    """`draws` unopposed episodes on each of the held-out tasks of `study`, beside the direct style's."""
    tasks = draw_tasks(HELD_OUT, seed, count, MISSION_IDS, (family,))
    shortest = build_bank(tasks, STYLES["direct"], seed)
    plain = run_bank(policy, shortest, np.arange(count), np.random.default_rng(seed))
    done, side, last, stretch = [], [], [], []
    for draw in range(draws):
        bank = build_bank(tasks, style, seed + draw)
        ways = run_bank(policy, bank, np.arange(count), np.random.default_rng((seed, draw)))
        done += ways.completed.tolist()
        for i in np.flatnonzero(ways.completed & plain.completed):
            path, other = (r.positions[i, : r.end[i] + 1].astype(np.float64) for r in (ways, plain))
            turned, usual = _winding(path, tasks[i]), _winding(other, tasks[i])
            if abs(usual) >= TURN_RADIANS:
                side.append(abs(turned) >= TURN_RADIANS and np.sign(turned) == np.sign(usual))
            last.append(ways.places[i][-1:] == plain.places[i][-1:])
            stretch.append(_length(path) / _length(other))
    return Unhunted(*(float(np.mean(values)) for values in (done, side, last, stretch)))


def _winding(path: NDArray[np.float64], task: Task) -> float:
    x, y = path.T - [[task.scenario.width_metres / 2], [task.scenario.height_metres / 2]]
    return float(np.diff(np.unwrap(np.arctan2(y, x))).sum())


def _length(path: NDArray[np.float64]) -> float:
    return float(np.hypot(*np.diff(path, axis=0).T).sum())
