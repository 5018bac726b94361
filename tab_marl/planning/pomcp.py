"""POMCP: Monte-Carlo tree search in a POMDP from a sampled belief (Silver and Veness, NeurIPS 2010), for any generative model.

``Pomcp(model, PomcpOptions(simulations=2000)).plan(belief, rng)`` returns a `Plan`. What a model and a belief are:
`tab_marl.planning.model`. Updating the belief after acting is the caller's: only the caller knows what was observed.
"""

from __future__ import annotations

import math
import time
from dataclasses import dataclass
from typing import Any, Literal

import numba
import numpy as np
from numpy.typing import ArrayLike, NDArray

from tab_marl.planning import kernels
from tab_marl.planning.interpreted import asked_prior, grow_tree_in_python
from tab_marl.planning.model import CompiledModel, action_names, belief_states, check_actions, draw_particles
from tab_marl.planning.tree import ROOT, SearchTree

_CHUNK = 256
"""Simulations between two looks at the clock."""
_FIRST_NODES = 16384
"""Nodes allocated at first; doubled when full."""
_ROOT_LOG = np.sqrt([0.0, *(math.log(n) for n in range(1, 4096))])
_INVERSE_ROOT = 1.0 / np.sqrt(np.maximum(np.arange(4096), 1))
"""sqrt(log n) and 1 / sqrt(n) of small counts, for UCB1."""
_PRECISION = 0.01
"""Without `max_depth`: the weight of a reward beyond the horizon."""


@dataclass(frozen=True)
class PomcpOptions:
    """How to search. Raises ValueError naming the field, its value and its bounds."""

    simulations: int = 2000
    """N, the most simulations a plan."""
    exploration: float = 10.0
    """Weight of UCB1's bonus ``sqrt(log N / n)``, in units of return: about the spread between a good and a bad return."""
    discount: float = 0.95
    """In (0, 1]; 1 needs `max_depth`."""
    max_depth: int | None = None
    """Steps from the root at which a simulation ends, rollout included; None: where discount^depth falls below 0.01."""
    tree_depth: int | None = None
    """Steps from the root down to which nodes are added; beyond, the rollout decides. None: `max_depth`."""
    seconds: float | None = None
    """Stop after this long even if simulations remain (checked every 256). A plan then depends on the machine's speed."""
    max_nodes: int = 1_000_000
    """Nodes at most; when reached, simulations go on without adding any. The whole tree takes up to
    ``max_nodes * (24 + 20 A)`` bytes; it is grown as needed."""
    common_random_numbers: bool = False
    """A particle fixes the randomness: at each depth its simulations draw the same numbers, whatever was done before
    (scenarios, as in DESPOT). Compares actions with less noise; give enough particles, or the plan learns their luck."""
    choose: Literal["value", "visits"] = "value"
    """The action of greatest value, or the one most tried."""
    compiled: bool = True
    """False: a `CompiledModel` runs interpreted, with the same random numbers and the same tree, for debugging its functions."""

    def __post_init__(self) -> None:
        _require(self.simulations >= 1, "simulations", self.simulations, ">= 1")
        _require(
            math.isfinite(self.exploration) and self.exploration >= 0, "exploration", self.exploration, "finite, >= 0"
        )
        _require(0 < self.discount <= 1, "discount", self.discount, "in (0, 1]")
        if self.discount == 1 and self.max_depth is None:
            raise ValueError("discount is 1 and max_depth is None: give max_depth, or rewards would be summed forever")
        _require(self.max_depth is None or self.max_depth >= 1, "max_depth", self.max_depth, ">= 1")
        _require(self.tree_depth is None or self.tree_depth >= 0, "tree_depth", self.tree_depth, ">= 0")
        _require(self.seconds is None or self.seconds > 0, "seconds", self.seconds, "> 0")
        _require(1 <= self.max_nodes <= 2**30, "max_nodes", self.max_nodes, "in [1, 2^30]")
        _require(self.choose in ("value", "visits"), "choose", self.choose, "'value' or 'visits'")

    @property
    def horizon(self) -> int:
        """`max_depth`, or the depth that the discount implies."""
        if self.max_depth is not None:
            return self.max_depth
        return max(1, math.ceil(math.log(_PRECISION) / math.log(self.discount)))


def _require(condition: bool, name: str, value: object, bound: str) -> None:
    if not condition:
        raise ValueError(f"{name} is {value!r}, must be {bound}")


@dataclass(frozen=True, eq=False)
class Plan:
    """The action to take, and why."""

    action: int
    values: NDArray[np.float64]
    """``[A]`` mean return of each action at the root; -inf where not allowed or not tried."""
    visits: NDArray[np.int64]
    """``[A]`` simulations (and pseudo-counts) of each action."""
    simulations: int
    """Simulations run."""
    depth: int
    """Steps of the longest simulation inside the tree."""
    steps: int
    """Calls of the model's step function (those inside a rollout of the model's own are not seen)."""
    seconds: float
    tree: SearchTree
    names: tuple[str, ...]
    """``[A]`` of the actions."""

    def best_line(self) -> list[tuple[str, object]]:
        """What the plan expects: best action, commonest observation, best action after it, ..."""
        return [(self.names[action], observation) for action, observation in self.tree.best_line()]

    def table(self) -> str:
        """Actions with value, standard of trial and share of simulations, best first, as text."""
        width = max(6, *(len(name) for name in self.names))
        total = max(1, int(self.visits.sum()))
        rows = [f"  {'action':<{width}}  {'value':>10}  {'visits':>8}  share"]
        for a in sorted(range(len(self.names)), key=lambda a: (-self.values[a], a)):
            if self.visits[a] > 0:
                mark = "*" if a == self.action else " "
                rows.append(
                    f"{mark} {self.names[a]:<{width}}  {self.values[a]:>10.3f}  {self.visits[a]:>8d}  "
                    f"{self.visits[a] / total:>5.1%}"
                )
        return "\n".join(rows)

    def explain(self) -> str:
        """The table, the best line and the size of the search, as text."""
        line = " > ".join(name if seen is None else f"{name} (sees {seen})" for name, seen in self.best_line())
        return (
            f"{self.table()}\nbest line: {line}\n"
            f"{self.simulations} simulations in {self.seconds * 1000:.1f} ms, {len(self.tree)} nodes, {self.depth} steps deep"
        )

    def __str__(self) -> str:
        return self.explain()


@dataclass(frozen=True, eq=False)
class Pomcp:
    """The planner: `model` is a `CompiledModel` or follows `PythonModel`."""

    model: Any
    options: PomcpOptions = PomcpOptions()

    def __post_init__(self) -> None:
        if not callable(getattr(self.model, "step", None)) or not hasattr(self.model, "actions"):
            raise TypeError(
                f"the model, a {type(self.model).__name__}, needs `actions` and `step`: see tab_marl.planning.model"
            )
        check_actions(self.model.actions, tuple(getattr(self.model, "action_names", ())))

    def plan(
        self,
        belief: Any,
        rng: np.random.Generator | int,
        *,
        allowed: ArrayLike | None = None,
        prior_values: ArrayLike | None = None,
        prior_counts: ArrayLike | None = None,
        latest: tuple[int, int] | None = None,
        start: SearchTree | None = None,
    ) -> Plan:
        """Searches from `belief` (states, `Particles` or a sampler) and returns the plan.

        `allowed` restricts the root: action numbers, or bool[A]. `prior_values` [A] with `prior_counts` [A] (or one count for
        all) start the root's actions as if tried that often with that mean return. Without them the model's own prior is asked
        if `latest` gives the (action, observation) that led here (for a compiled model, with the belief's first state).
        `start` is a tree to go on with instead, such as ``plan.tree.after(action, observation)`` of the plan before.
        The same seed, model and belief give the identical tree (unless `seconds` is set).
        """
        generator = np.random.default_rng(rng)
        actions = self.model.actions
        if start is not None and (prior_values is not None or prior_counts is not None or latest is not None):
            raise ValueError("start goes without priors and latest: the tree already holds values")
        if prior_values is None and prior_counts is None and latest is not None:
            prior_values, prior_counts, open_actions = _asked_prior(self.model, belief, latest, generator)
            allowed = open_actions if allowed is None else np.intersect1d(open_actions, _numbers(actions, allowed))
        if start is None:
            start = _planted(actions, allowed, prior_values, prior_counts)
        elif allowed is not None:
            start = start.subtree(ROOT, _numbers(actions, allowed))
        if not start.edges_of(ROOT) or start.edge_actions.max() >= actions:
            raise ValueError(f"start is no tree of this model: its root needs actions, all in 0..{actions - 1}")
        started = time.perf_counter()
        if (
            isinstance(self.model, CompiledModel)
            and self.options.compiled
            and not getattr(numba.config, "DISABLE_JIT", 0)
        ):
            tree, simulations, depth, steps = _grow_compiled(self.model, self.options, belief, generator, start)
        else:
            tree, simulations, depth, steps = grow_tree_in_python(self.model, self.options, belief, generator, start)
        seconds = time.perf_counter() - started
        values = np.full(actions, -np.inf)
        visits = np.zeros(actions, dtype=np.int64)
        at_root = tree.edges[: tree.nodes["edge_count"][ROOT]]
        chosen = tree.edge_actions[: len(at_root)]
        visits[chosen] = at_root["visits"]
        values[chosen] = np.where(at_root["visits"] > 0, at_root["value"], -np.inf)
        broken = (visits > 0) & ~np.isfinite(values)
        if broken.any():
            action = int(np.argmax(broken))
            raise ValueError(
                f"action {action} has value {values[action]}: the model's rewards or rollouts are not all finite"
            )
        keys = (values, visits) if self.options.choose == "value" else (visits, values)
        best = np.flatnonzero(keys[0] == keys[0].max())
        action = int(best[np.argmax(keys[1][best])])
        return Plan(action, values, visits, simulations, depth, steps, seconds, tree, action_names(self.model))


def _numbers(actions: int, allowed: ArrayLike) -> NDArray[np.int64]:
    """Action numbers, ascending, from action numbers or a mask."""
    chosen = np.asarray(allowed)
    if chosen.dtype == np.bool_:
        if chosen.shape != (actions,):
            raise ValueError(f"allowed has shape {chosen.shape}, must be bool[{actions}] or action numbers")
        chosen = np.flatnonzero(chosen)
    return np.unique(chosen.astype(np.int64))


def _asked_prior(
    model: Any, belief: Any, latest: tuple[int, int], rng: np.random.Generator
) -> tuple[NDArray[np.float64], NDArray[np.int64], NDArray[np.int64]]:
    """(values [A], counts [A], allowed action numbers) of the model's prior for the history that ends in `latest`."""
    if getattr(model, "prior", None) is None:
        raise ValueError("latest is given, but the model has no prior to ask")
    action, observation = latest
    if isinstance(model, CompiledModel):
        values, counts = asked_prior(model, belief_states(model, belief, 1, rng)[0][0].copy(), action, observation, 0)
    else:
        states = belief(1, rng) if callable(belief) else getattr(belief, "states", belief)
        values, counts = model.prior(states[0], action, observation, 0)
    counts = np.asarray(counts, dtype=np.int64)
    return np.asarray(values, dtype=np.float64), np.maximum(counts, 0), np.flatnonzero(counts >= 0)


def _planted(actions: int, allowed: ArrayLike | None, values: ArrayLike | None, counts: ArrayLike | None) -> SearchTree:
    """A tree of a root only, with its allowed actions."""
    chosen = np.arange(actions) if allowed is None else _numbers(actions, allowed)
    if len(chosen) == 0:
        raise ValueError("allowed names no action: at least one must be allowed")
    if chosen[0] < 0 or chosen[-1] >= actions:
        raise ValueError(f"allowed holds {chosen[0]}..{chosen[-1]}, must be in 0..{actions - 1}")
    if (values is None) != (counts is None):
        raise ValueError("prior_values and prior_counts go together: give both or neither")
    if values is None or counts is None:
        return SearchTree.planted(chosen, np.zeros(len(chosen)), np.zeros(len(chosen), dtype=np.int64))
    v = np.broadcast_to(np.asarray(values, dtype=np.float64), (actions,))[chosen]
    n = np.broadcast_to(np.asarray(counts), (actions,)).astype(np.int64)[chosen]
    if (n < 0).any() or n.sum() > 2**30:
        raise ValueError(f"prior_counts holds {n.min()}..{n.max()}, must be >= 0 and sum to at most 2^30")
    if not np.isfinite(v[n > 0]).all():
        raise ValueError("prior_values must be finite where prior_counts > 0")
    return SearchTree.planted(chosen, np.where(n > 0, v, 0.0), n)


def _grow_compiled(
    model: CompiledModel, options: PomcpOptions, belief: Any, rng: np.random.Generator, start: SearchTree
) -> tuple[SearchTree, int, int, int]:
    states, weights = belief_states(model, belief, options.simulations, rng)
    step, rollout, prior = model.functions
    actions, horizon = model.actions, options.horizon
    shared = len(states) if options.common_random_numbers else 0
    words = rng.integers(2**64, size=2 + shared, dtype=np.uint64)
    tree_stream, model_stream, seeds = words[:1], words[1:2], words[2:]

    # Every simulation adds at most one node and expands at most one.
    most = max(len(start), min(options.max_nodes, options.simulations + len(start)))
    size = min(most, len(start) + _FIRST_NODES)
    spare = len(start.edges)
    nodes, edges = _grown(start.nodes, size), _grown(start.edges, size * actions + spare)
    edge_actions = _grown(start.edge_actions, len(edges))
    used = np.array([len(start), spare, 0, 0, 0])
    state = np.empty(model.state_size)
    path_edges = np.empty(horizon, dtype=np.int64)
    path_rewards = np.empty(horizon)
    values, counts = np.empty(actions), np.empty(actions, dtype=np.int64)

    done = 0
    deadline = None if options.seconds is None else time.perf_counter() + options.seconds
    while done < options.simulations:
        chunk = options.simulations - done if deadline is None else min(_CHUNK, options.simulations - done)
        particles = draw_particles(chunk, len(states), weights, rng)
        run = 0
        while run < chunk:
            run += kernels.search(
                step, rollout, prior, model.data, states, particles[run:], seeds, actions,
                options.exploration, options.discount, horizon, _tree_depth(options), len(nodes) < most,
                nodes, edges, edge_actions, used, _ROOT_LOG, _INVERSE_ROOT, tree_stream, model_stream, state, path_edges, path_rewards, values, counts,
            )  # fmt: skip
            if run < chunk:
                size = min(most, 2 * len(nodes))
                nodes = _grown(nodes, size)
                edges = _grown(edges, size * actions + spare)
                edge_actions = _grown(edge_actions, len(edges))
        done += chunk
        if deadline is not None and time.perf_counter() >= deadline:
            break
    tree = SearchTree(nodes[: used[kernels.NODES]], edges[: used[kernels.EDGES]], edge_actions[: used[kernels.EDGES]])
    return tree, done, int(used[kernels.DEEPEST]), int(used[kernels.TREE_STEPS] + used[kernels.ROLLOUT_STEPS])


def _tree_depth(options: PomcpOptions) -> int:
    return options.horizon if options.tree_depth is None else min(options.tree_depth, options.horizon)


def _grown(array: NDArray[Any], size: int) -> NDArray[Any]:
    larger = np.empty(size, dtype=array.dtype)
    larger[: len(array)] = array
    return larger
