"""How policies differ in what they do: figures of unopposed episodes, and whether a style's own figure moved.

All figures are of the same held-out tasks and the same starts, so that policies, the scripted follower and samples of the
TAB-Field stand side by side, and differences are paired over tasks. Distances between occupancies are support only: two
trainings of one policy already differ there.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from tab_marl.agents.adversaries import AdversaryPolicy
from tab_marl.agents.measures.homotopy import Sides
from tab_marl.agents.measures.rollouts import Rollouts, run_bank
from tab_marl.agents.measures.validation import HeldOut, allowed_seconds
from tab_marl.agents.policies.cards import StyleTest
from tab_marl.envs.adversary_kernels import VIA_METRES
from tab_marl.envs.adversary_observation import AdversaryTask
from tab_marl.envs.styles import Style
from tab_marl.mission.tasks import Task

Array = NDArray[np.float64]
DRAWS = 2
"""Episodes per task, each with latents of its own."""
WINDING_RADIANS = 0.3
"""A way that turns less than this about the arena's centre takes neither turning sense."""
SPREAD_POINTS = 21
OCCUPANCY_CELLS = 15
"""Per side of the arena."""
RESAMPLES = 2000
SOFT_ORDER_METRES = 4.0
"""Styles whose places may cost so much more or less choose among them."""

FIGURES = (
    "shortest side", "length / shortest", "time used / allowed", "seconds in cameras", "seconds in other cameras",
    "nearest place first", "places of the shortest way",
)  # fmt: skip
"""What is known of every path. "shortest side": 1 if it took the shortest path's side where two exist; "nearest place first":
1 if it began where the shortest way begins, where it could choose; "places of the shortest way": in its order, too."""
DRAWN = ("side as drawn", "via points reached")
"""What is known of a path against what was drawn for a style."""
SPREAD = "spread between episodes, metres"


@dataclass(frozen=True, eq=False)
class Yardstick:
    """A task and what paths on it are measured by."""

    task: Task
    plain: AdversaryTask
    """Without a style."""
    allowed_seconds: float
    sides: Sides

    @classmethod
    def of(cls, task: Task) -> Yardstick:
        plain = AdversaryTask.build(task.scenario, task.mission, Style(), np.random.default_rng(0))
        allowed = allowed_seconds(plain)
        return cls(task, plain, allowed, Sides(task, allowed))

    def shortest_places(self, start: Array) -> tuple[str, ...]:
        """The places that the shortest way from `start` ``[2]`` visits, in order."""
        route, automaton = self.plain.parts.plain, self.plain.automaton
        cells, locations = route.path(self.plain.parts.via_home, start)
        masks = automaton.masks(route.grid.centres[cells])
        return tuple(
            automaton.branch_places[automaton.branch[u, mask]]
            for u, mask in zip(locations[:-1], masks[1:], strict=True)
            if u >= 0 and automaton.progress[u, mask] and automaton.branch[u, mask] >= 0
        )

    def figures(self, path: Array, hertz: float, places: tuple[str, ...]) -> dict[str, float]:
        """Figures of a path ``[K + 1, 2]`` (to the mission's completion, `hertz` points a second) that visited `places`."""
        scenario, goals = self.task.scenario, self.task.mission.goals
        shortest = self.shortest_places(path[0])
        other = np.zeros(len(path), dtype=bool)
        for checkpoint in scenario.checkpoints:
            if checkpoint.name not in places:
                other |= checkpoint.camera.contains(path)
        metres = float(self.plain.parts.plain.metres(self.plain.parts.via_home, path[0])[0])
        first_open = len(goals[0].places) > 1
        any_open = any(len(goal.places) > 1 for goal in goals)
        return {
            "shortest side": self.sides.took_shortest(path, places[0]) if places else math.nan,
            "length / shortest": float(np.hypot(*np.diff(path, axis=0).T).sum()) / metres,
            "time used / allowed": (len(path) - 1) / hertz / self.allowed_seconds,
            "seconds in cameras": float(scenario.seen(path).sum()) / hertz,
            "seconds in other cameras": float(other.sum()) / hertz,
            "nearest place first": float(places[:1] == shortest[:1]) if first_open else math.nan,
            "places of the shortest way": float(places == shortest) if any_open else math.nan,
        }


@dataclass(frozen=True, eq=False)
class Behaviour:
    """What somebody did on N tasks, D times each."""

    name: str
    figures: dict[str, Array]
    """Figure -> ``[D, N]``; nan where the episode was not completed or the figure means nothing."""
    completed: NDArray[np.bool_]
    """``[D, N]``."""
    paths: tuple[tuple[Array, ...], ...]
    """``[D][N]`` of ``[K + 1, 2]`` metres, to the mission's end."""
    drawn: tuple[tuple[AdversaryTask, ...], ...] = ()
    """``[D][N]`` what was drawn for its style."""

    def mean(self, figure: str) -> float:
        """Over tasks, each the mean of its episodes; nan if it is defined nowhere."""
        return _mean(_per_task(self.figures[figure]))

    def quantiles(self, figure: str, shares: Sequence[float] = (0.1, 0.5, 0.9)) -> list[float]:
        """Over all completed episodes."""
        values = self.figures[figure]
        values = values[~np.isnan(values)]
        return [math.nan] * len(shares) if len(values) == 0 else [float(v) for v in np.quantile(values, shares)]

    def figure(self, name: str, judged_by: Behaviour | None = None) -> Array:
        """``[N]`` a figure per task (nan where undefined). Those of DRAWN are judged by what was drawn for another."""
        if name == SPREAD:
            return np.array([_spread(paths) for paths in zip(*self.paths, strict=True)])
        if name in self.figures:
            return _per_task(self.figures[name])
        judge = _side_match if name == "side as drawn" else _via_reached
        drawn = (judged_by or self).drawn
        return _per_task(
            np.array(
                [
                    [judge(t, path) if done else math.nan for t, path, done in zip(*row, strict=True)]
                    for row in zip(drawn, self.paths, self.completed, strict=True)
                ]
            )
        )


def behaviour(policy: AdversaryPolicy, held_out: HeldOut, yardsticks: Sequence[Yardstick]) -> Behaviour:
    """What a policy does on held-out tasks in the batched world, nobody hunting it."""
    drawn, rollouts = [], []
    for draw in range(DRAWS):
        bank = held_out.bank(policy, draw)
        rng = np.random.default_rng((held_out.seed, draw))
        rollouts.append(run_bank(policy, bank, np.arange(len(bank)), rng))
        drawn.append(bank.tasks)
    return measured(policy.name, yardsticks, rollouts, tuple(drawn))


def measured(
    name: str,
    yardsticks: Sequence[Yardstick],
    rollouts: Sequence[Rollouts],
    drawn: tuple[tuple[AdversaryTask, ...], ...] = (),
    hertz: float | None = None,
) -> Behaviour:
    """The figures of rollouts (D of N tasks each); `hertz`: of their positions, default the control rate."""
    paths = tuple(
        tuple(r.positions[i, : r.end[i] + 1].astype(np.float64) for i in range(len(yardsticks))) for r in rollouts
    )
    completed = np.array([r.completed for r in rollouts])
    figures = {figure: np.full(completed.shape, math.nan) for figure in FIGURES}
    for d, i in zip(*np.nonzero(completed), strict=True):
        y = yardsticks[i]
        found = y.figures(paths[d][i], hertz or y.task.scenario.control_hertz, rollouts[d].places[i])
        for figure, value in found.items():
            figures[figure][d, i] = value
    return Behaviour(name, figures, completed, paths, drawn)


OWN_FIGURE: dict[str, tuple[str, Literal[1, -1]]] = {
    "late": ("time used / allowed", 1),
    "contrary": ("shortest side", -1),
    "side": ("side as drawn", 1),
    "via": ("via points reached", 1),
    "camera-shy": ("seconds in other cameras", -1),
    "wander": (SPREAD, 1),
    "fickle": ("places of the shortest way", -1),
}
"""What the styles that have a name are there to move, and the direction."""


def own_figure(style: Style) -> tuple[str, Literal[1, -1]] | None:
    """The figure that a style is there to move, and the direction; None: it has none (the direct style).

    By the style's name, where it is one of those in OWN_FIGURE, else by what it holds.
    """
    if style.name in OWN_FIGURE:
        return OWN_FIGURE[style.name]
    held = (
        ("wander", bool(style.mixture)), ("late", style.arrival_fraction is not None), ("contrary", style.contrary_metres > 0),
        ("side", style.side > 0), ("via", style.via > 0), ("camera-shy", style.camera_shy > 0),
        ("wander", style.edge_noise > 0), ("fickle", style.order_metres >= SOFT_ORDER_METRES),
    )  # fmt: skip
    return next((OWN_FIGURE[name] for name, holds in held if holds), None)


def style_test(mine: Behaviour, controls: Sequence[Behaviour], style: Style, seed: int = 0) -> StyleTest | None:
    """Whether the style's own figure moved against every control by more than the controls differ; None: it has none.

    The interval is a percentile bootstrap over tasks (paired: the same tasks of everybody). A figure counts only at a
    success of CLAIM over the tasks. Raises ValueError for fewer than two controls.
    """
    if len(controls) < 2:
        raise ValueError(f"{len(controls)} controls: a style is judged against two or more re-seeded direct policies")
    found = own_figure(style)
    if found is None:
        return None
    name, direction = found
    own = mine.figure(name)
    theirs = np.array([control.figure(name, mine) for control in controls])
    known = ~np.isnan(own) & ~np.isnan(theirs).any(axis=0)
    if not known.any():
        return None
    own, theirs = own[known], theirs[:, known]
    gaps = direction * (own - theirs)
    draws = np.random.default_rng(seed).integers(len(own), size=(RESAMPLES, len(own)))
    moved = gaps[:, draws].mean(axis=2).min(axis=0)
    low, high = np.quantile(moved, (0.025, 0.975))
    levels = theirs.mean(axis=1)
    return StyleTest(
        figure=name,
        value=round(float(own.mean()), 4),
        controls=tuple(round(float(level), 4) for level in levels),
        moved=round(float(gaps.mean(axis=1).min()), 4),
        low=round(float(low), 4),
        high=round(float(high), 4),
        needed=round(float(np.ptp(levels)), 4),
        success=round(float(mine.completed.mean()), 4),
    )


def occupancy_distance(one: Behaviour, other: Behaviour, yardsticks: Sequence[Yardstick]) -> float:
    """Mean over tasks of the Jensen-Shannon distance (base 2, square root) of where the two spend their time."""
    distances = []
    for i, y in enumerate(yardsticks):
        p, q = (_occupancy([paths[i] for paths in b.paths], y.task) for b in (one, other))
        m = 0.5 * (p + q)
        distances.append(math.sqrt(max(0.0, 0.5 * _divergence(p, m) + 0.5 * _divergence(q, m))))
    return float(np.mean(distances))


def field_samples(
    yardsticks: Sequence[Yardstick], seed: int, on_task: Callable[[int], None] | None = None
) -> Behaviour:
    """Trajectories of the TAB-Field (its default) on the same tasks, D each, as if they were somebody's."""
    from tab_marl.field.problem import FieldProblem
    from tab_marl.field.solve import solve
    from tab_marl.mission.compile import compile_mission

    rows = []
    for i, y in enumerate(yardsticks):
        scenario, mission = y.task.scenario, y.task.mission
        paths = solve(FieldProblem.from_mission(mission, scenario)).sample(np.random.default_rng((seed, i)), DRAWS)
        automaton = compile_mission(mission, scenario, scenario.step_seconds)
        for path, end in zip(paths.positions, paths.completed_tick, strict=True):
            places, state = [], automaton.first(int(automaton.masks(path[0])[0]))
            for mask in automaton.masks(path[1 : end + 1]):
                if state.location >= 0 and automaton.branch[state.location, mask] >= 0:
                    after = automaton.advance(state, int(mask))
                    if automaton.progress[state.location, mask]:
                        places.append(automaton.branch_places[automaton.branch[state.location, mask]])
                    state = after
                else:
                    state = automaton.advance(state, int(mask))
            rows.append((path[: end + 1], end >= 0, tuple(places)))
        if on_task is not None:
            on_task(i + 1)
    ticks = max(len(path) for path, _, _ in rows)
    rollouts = []
    for draw in range(DRAWS):
        mine = rows[draw::DRAWS]
        n = len(mine)
        positions = np.stack([np.pad(p, ((0, ticks - len(p)), (0, 0)), mode="edge") for p, _, _ in mine])
        nothing = np.zeros(n, dtype=np.int64)
        rollouts.append(
            Rollouts(
                np.arange(n), positions.astype(np.float32), np.array([done for _, done, _ in mine]),
                np.array([len(p) - 1 for p, _, _ in mine]), nothing, nothing, nothing.astype(bool),
                tuple(places for _, _, places in mine),
            )
        )  # fmt: skip
    return measured("TAB-Field", yardsticks, rollouts, hertz=1.0 / yardsticks[0].task.scenario.step_seconds)


def _per_task(values: Array) -> Array:
    """``[N]`` mean over the episodes that have the figure."""
    known = ~np.isnan(values)
    total, count = np.where(known, values, 0.0).sum(axis=0), known.sum(axis=0)
    return np.asarray(np.where(count > 0, total / np.maximum(count, 1), math.nan))


def _mean(values: Array) -> float:
    known = values[~np.isnan(values)]
    return float(known.mean()) if len(known) else math.nan


def _side_match(task: AdversaryTask, path: Array) -> float:
    if task.latents.side == 0 or task.strength == 0:
        return math.nan
    x, y = path.T - [[task.scenario.width_metres / 2], [task.scenario.height_metres / 2]]
    winding = float(np.diff(np.unwrap(np.arctan2(y, x))).sum())
    return math.nan if abs(winding) < WINDING_RADIANS else float(np.sign(winding) == task.latents.side)


def _via_reached(task: AdversaryTask, path: Array) -> float:
    if len(task.parts.via) == 0:
        return math.nan
    return float(all((np.hypot(*(path - point).T) <= VIA_METRES).any() for point in task.parts.via))


def _spread(paths: Sequence[Array]) -> float:
    """Mean distance in metres between the first two paths at equal shares of their lengths."""
    shares, points = np.linspace(0, 1, SPREAD_POINTS), []
    for path in paths[:2]:
        along = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(path, axis=0).T))])
        points.append(np.stack([np.interp(shares * along[-1], along, path[:, k]) for k in (0, 1)], axis=1))
    return float(np.hypot(*(points[0] - points[1]).T).mean())


def _occupancy(paths: Sequence[Array], task: Task) -> Array:
    edges = [
        np.linspace(0, side, OCCUPANCY_CELLS + 1) for side in (task.scenario.width_metres, task.scenario.height_metres)
    ]
    total = np.zeros((OCCUPANCY_CELLS, OCCUPANCY_CELLS))
    for path in paths:
        count, _, _ = np.histogram2d(path[:, 0], path[:, 1], bins=edges)
        total += count / count.sum()
    return total.ravel() / total.sum()


def _divergence(p: Array, q: Array) -> float:
    some = p > 0
    return float((p[some] * np.log2(p[some] / q[some])).sum())
