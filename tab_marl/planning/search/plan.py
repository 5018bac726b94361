"""What every planner returns: the action to take, and why."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, Protocol, TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tab_marl.planning.model import action_names
from tab_marl.planning.search.explanation import Explanation, brief, explain
from tab_marl.planning.search.tree import ROOT, SearchTree

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Stopped: TypeAlias = Literal["simulations", "seconds", "closed", "full"]
"""Why a search ended: its budget of simulations or of seconds; its bounds met (DESPOT); its memory (DESPOT)."""


@dataclass(frozen=True, eq=False)
class Plan:
    """The action to take, and why."""

    action: int
    values: NDArray[np.float64]
    """``[A]`` mean return of each action at the root (DESPOT: its lower bound); -inf where not allowed or not tried."""
    visits: NDArray[np.int64]
    """``[A]`` simulations (and pseudo-counts) of each action (DESPOT: scenarios)."""
    simulations: int
    """Simulations run (DESPOT: trials)."""
    depth: int
    """Steps of the longest simulation inside the tree."""
    steps: int
    """Calls of the model's step function (those inside a rollout of the model's own are not seen)."""
    seconds: float
    """Of wall time, not counting what was compiled."""
    tree: SearchTree
    names: tuple[str, ...]
    """``[A]`` of the actions."""
    stopped: Stopped = "simulations"
    """Why the search ended."""
    full: bool = False
    """Whether the cap on nodes was reached."""
    bounds: tuple[float, float] | None = None
    """Of the root's value over the scenarios (lower, upper), where the search keeps bounds."""

    def best_line(self) -> list[tuple[str, object]]:
        """What the plan expects: best action, commonest observation, best action after it, ..."""
        return [(self.names[action], observation) for action, observation in self.tree.best_line()]

    def table(self) -> str:
        """Actions with value, visits and share of simulations, best first, as text."""
        return self.explain().table()

    def explain(self, belief: Any = None, name_of: Callable[[Any], str] = brief) -> Explanation:
        """Why: values, visits, lead, most likely line, size of the search, and how uncertain `belief` is; print the result.

        `belief` is what the plan was made from (states, `Particles`, a filter or a sampler), `name_of` writes observations.
        """
        return explain(self, belief, name_of)

    def draw(self, path: str | Path | None = None, **options: Any) -> Figure:
        """The tree as a picture (.svg, .png, .pdf); options of `tab_marl.planning.search.drawing.draw_plan`."""
        from tab_marl.planning.search.drawing import draw_plan

        return draw_plan(self, path, **options)

    def __str__(self) -> str:
        return str(self.explain())


class Planner(Protocol):
    """What `Pomcp`, `Pomcpow` and `Despot` have in common."""

    def plan(
        self,
        belief: ArrayLike | Callable[[int, np.random.Generator], ArrayLike] | Any,
        rng: np.random.Generator | int,
        *,
        allowed: ArrayLike | None = None,
    ) -> Plan:
        """The plan from `belief`, the same for the same seed; `allowed` restricts the first action."""
        ...


@dataclass(frozen=True, eq=False)
class Search:
    """A tree and how it came about, before anything is read from it."""

    tree: SearchTree
    simulations: int
    depth: int
    steps: int
    stopped: Stopped = "simulations"
    full: bool = False
    bounds: tuple[float, float] | None = None
    compiling: float = 0.0
    """Seconds spent on compiling the search, or loading it, the first time that a model is planned for."""


def decided(search: Search, model: Any, choose: Literal["value", "visits"], seconds: float) -> Plan:
    """The plan that a search's root holds: greatest value (ties: visits, then the lower number), or the other way round.

    Raises ValueError when a value is not finite: the model's rewards or rollouts are not.
    """
    tree, actions = search.tree, model.actions
    values = np.full(actions, -np.inf)
    visits = np.zeros(actions, dtype=np.int64)
    count = int(tree.nodes["edge_count"][ROOT])
    numbers, returns = tree.edge_actions[:count].tolist(), tree.edges["value"][:count].tolist()
    best: tuple[tuple[float, float], int] | None = None
    for number, value, tried in zip(numbers, returns, tree.edges["visits"][:count].tolist(), strict=True):
        if tried > 0:
            if not math.isfinite(value):
                raise ValueError(
                    f"action {number} has value {value}: the model's rewards or rollouts are not all finite"
                )
            values[number], visits[number] = value, tried
        key = ((value if tried else -math.inf), tried) if choose == "value" else (tried, value if tried else -math.inf)
        if best is None or key > best[0]:
            best = key, number
    action = numbers[0] if best is None else best[1]
    return Plan(
        action, values, visits, search.simulations, search.depth, search.steps, seconds - search.compiling, tree, action_names(model),
        search.stopped, search.full, search.bounds,
    )  # fmt: skip


def action_numbers(actions: int, allowed: ArrayLike | None) -> NDArray[np.int64]:
    """Action numbers, ascending, from action numbers, a mask, or None for all; ValueError when none or out of bounds."""
    if allowed is None:
        return np.arange(actions)
    chosen = np.asarray(allowed)
    if chosen.dtype == np.bool_:
        if chosen.shape != (actions,):
            raise ValueError(f"allowed has shape {chosen.shape}, must be bool[{actions}] or action numbers")
        chosen = np.flatnonzero(chosen)
    chosen = np.unique(chosen.astype(np.int64))
    if len(chosen) == 0:
        raise ValueError("allowed names no action: at least one must be allowed")
    if chosen[0] < 0 or chosen[-1] >= actions:
        raise ValueError(f"allowed holds {chosen[0]}..{chosen[-1]}, must be in 0..{actions - 1}")
    return chosen
