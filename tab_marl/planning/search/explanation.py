"""A plan that explains itself: what each action is worth and how surely, what is believed, and what is expected to happen.

``plan.explain(belief)`` gives an `Explanation`: print it for text, hand it to rich's ``print`` for a table. ``plan.draw("tree.svg")``
draws the tree.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from tab_marl.planning.model import Particles
from tab_marl.planning.search.tree import ROOT

if TYPE_CHECKING:
    from rich.console import Group

    from tab_marl.planning.search.plan import Plan

NameOf: TypeAlias = Callable[[Any], str]
"""How to write an observation for people."""
_DRAWN = 2000
"""States drawn from a belief that is only a sampler."""


def brief(observation: Any) -> str:
    """An observation as text, its numbers to three digits."""
    if isinstance(observation, float):
        return f"{observation:.3g}"
    if isinstance(observation, tuple | np.ndarray):
        return f"({', '.join(brief(part) for part in observation)})"
    return str(observation)


@dataclass(frozen=True)
class ActionValue:
    """What the search found out about one action at the root."""

    name: str
    value: float
    """Mean return."""
    visits: int
    share: float
    """Of the root's visits."""
    chosen: bool


@dataclass(frozen=True)
class ExpectedStep:
    """One step of the most likely line: the best action, and what is most often seen after it."""

    action: str
    value: float
    """Mean return from here on."""
    visits: int
    observation: object | None
    """None at the end of what was searched."""
    chance: float
    """Share of the simulations of this action that saw it."""


@dataclass(frozen=True)
class BeliefSummary:
    """How much is not known."""

    states: int
    """Distinct states with positive weight."""
    entropy: float
    """In nats, over the distinct states; of a sample of a continuous state it only says how many particles there are."""
    spread: tuple[float, ...]
    """Standard deviation of each number in the state (empty where states are not numbers)."""

    @property
    def perplexity(self) -> float:
        """As spread out as this many equally likely states."""
        return float(np.exp(self.entropy))


@dataclass(frozen=True)
class Explanation:
    """Why a plan is what it is."""

    action: str
    actions: tuple[ActionValue, ...]
    """Those tried, best first."""
    line: tuple[ExpectedStep, ...]
    """The most likely line: from each node the best action, then its commonest observation."""
    belief: BeliefSummary | None
    simulations: int
    depth: int
    """Steps of the longest simulation inside the tree."""
    nodes: int
    seconds: float
    name_of: NameOf = brief

    @property
    def lead(self) -> float:
        """By how much the chosen action's value exceeds the best of the others; infinite if there is none."""
        others = [a.value for a in self.actions if not a.chosen]
        chosen = next(a.value for a in self.actions if a.chosen)
        return chosen - max(others) if others else float("inf")

    def table(self) -> str:
        """Actions with value, visits and share of the simulations, best first."""
        width = max(6, *(len(a.name) for a in self.actions))
        rows = [f"  {'action':<{width}}  {'value':>10}  {'visits':>8}  share"]
        for a in self.actions:
            mark = "*" if a.chosen else " "
            rows.append(f"{mark} {a.name:<{width}}  {a.value:>10.3f}  {a.visits:>8d}  {a.share:>5.1%}")
        return "\n".join(rows)

    def __str__(self) -> str:
        return "\n".join([self.table(), *self._remarks()])

    def __rich__(self) -> Group:
        """The same for rich: a table and remarks."""
        from rich.console import Group
        from rich.table import Table
        from rich.text import Text

        table = Table("action", box=None, pad_edge=False)
        for heading in ("value", "visits", "share"):
            table.add_column(heading, justify="right")
        for a in self.actions:
            cells = (a.name, f"{a.value:.3f}", f"{a.visits:,}", f"{a.share:.1%}")
            table.add_row(*cells, style="bold green" if a.chosen else None)
        return Group(table, *(Text(line) for line in self._remarks()))

    def _remarks(self) -> list[str]:
        lines = []
        if self.lead < float("inf"):
            lines.append(f"{self.action} leads by {self.lead:.3f}")
        steps = [
            s.action if s.observation is None else f"{s.action} (sees {self.name_of(s.observation)}, {s.chance:.0%})"
            for s in self.line
        ]
        lines.append(f"most likely line: {' > '.join(steps)}")
        if self.belief is not None:
            b = self.belief
            lines.append(
                f"belief: {b.states} state{'s' * (b.states != 1)}, entropy {b.entropy:.2f} nats (as spread as "
                f"{b.perplexity:.1f} equally likely ones)"
            )
        lines.append(
            f"{self.simulations} simulations in {self.seconds * 1000:.1f} ms, {self.nodes} nodes, {self.depth} steps deep"
        )
        return lines


def explain(plan: Plan, belief: Any = None, name_of: NameOf = brief) -> Explanation:
    """Explains a plan; `belief` is what it was made from (states, `Particles`, a filter or a sampler), `name_of` writes observations."""
    total = max(1, int(plan.visits.sum()))
    tried = [a for a in range(len(plan.names)) if plan.visits[a] > 0]
    actions = tuple(
        ActionValue(plan.names[a], float(plan.values[a]), int(plan.visits[a]), plan.visits[a] / total, a == plan.action)
        for a in sorted(tried, key=lambda a: (-plan.values[a], a))
    )
    return Explanation(
        plan.names[plan.action],
        actions,
        most_likely_line(plan),
        None if belief is None else summarise(belief),
        plan.simulations,
        plan.depth,
        len(plan.tree),
        plan.seconds,
        name_of,
    )


def most_likely_line(plan: Plan, least_visits: int = 10) -> tuple[ExpectedStep, ...]:
    """The plan's action, its commonest observation, the best action after that, and so on while tried `least_visits` times."""
    tree = plan.tree
    node, steps = ROOT, list[ExpectedStep]()
    edge: int | None = tree.edge(ROOT, plan.action)
    while edge is not None:
        value, visits = float(tree.edges["value"][edge]), int(tree.edges["visits"][edge])
        name = plan.names[int(tree.edge_actions[edge])]
        children = list(tree.children(edge))
        if not children:
            steps.append(ExpectedStep(name, value, visits, None, 0.0))
            break
        counts = [int(tree.nodes["visits"][child]) for child in children]
        node = children[int(np.argmax(counts))]
        steps.append(ExpectedStep(name, value, visits, tree.observation(node), max(counts) / max(1, sum(counts))))
        edge = tree.best_edge(node)
        if edge is not None and tree.edges["visits"][edge] < least_visits:
            break
    return tuple(steps)


def summarise(belief: Any) -> BeliefSummary:
    """How much a belief leaves open; a sampler is asked for 2,000 states."""
    belief = getattr(belief, "particles", belief)
    if callable(belief):
        belief = belief(_DRAWN, np.random.default_rng(0))
    weights = None
    if isinstance(belief, Particles):
        belief, weights = belief.states, belief.weights
    w = np.ones(len(belief)) if weights is None else np.asarray(weights, dtype=np.float64)
    states = belief if isinstance(belief, np.ndarray) else _as_numbers(belief)
    if states is None or states.dtype == object:
        shares = np.array(list(_tally(belief, w).values()))
        return BeliefSummary(int((shares > 0).sum()), _entropy(shares), ())
    rows = states.reshape(len(states), -1)
    _, which = np.unique(rows, axis=0, return_inverse=True)
    shares = np.bincount(which.ravel(), weights=w).astype(np.float64)
    mean = np.average(rows, axis=0, weights=w)
    spread = np.sqrt(np.average((rows - mean) ** 2, axis=0, weights=w))
    return BeliefSummary(int((shares > 0).sum()), _entropy(shares), tuple(float(s) for s in spread))


def _as_numbers(states: Any) -> NDArray[np.float64] | None:
    """The states as an array if they are numbers or rows of numbers."""
    try:
        return np.asarray(states, dtype=np.float64)
    except (TypeError, ValueError):
        return None


def _tally(states: Any, weights: NDArray[np.float64]) -> dict[Any, float]:
    totals: dict[Any, float] = {}
    for state, weight in zip(states, weights, strict=True):
        key = _key(state)
        totals[key] = totals.get(key, 0.0) + float(weight)
    return totals


def _key(state: Any) -> Any:
    """The state itself where it can be hashed, else its content in a form that can be: states are any objects."""
    try:
        hash(state)
    except TypeError:
        return (type(state), _content(state))
    return state


def _content(state: Any) -> Any:
    """What a state that cannot be hashed consists of; what is of no known form goes by how it prints."""
    if isinstance(state, np.ndarray):
        return (
            state.shape,
            tuple(map(_key, state.flat)) if state.dtype.hasobject else (state.dtype.str, state.tobytes()),
        )
    if isinstance(state, dict):
        return frozenset((_key(name), _key(value)) for name, value in state.items())
    if isinstance(state, list | tuple):
        return tuple(map(_key, state))
    if isinstance(state, set):
        return frozenset(state)
    return _content(vars(state)) if hasattr(state, "__dict__") else repr(state)


def _entropy(shares: NDArray[np.float64]) -> float:
    p = shares[shares > 0] / shares.sum()
    return max(0.0, float(-(p * np.log(p)).sum()))  # of one state: 0, not -0
