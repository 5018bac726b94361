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

from tab_marl.planning.model import (
    CompiledModel,
    belief_objects,
    belief_states,
    check_model,
    check_numbered,
    warn_of_plain_python,
)
from tab_marl.planning.search.bounds import Depths, check_horizon, check_kinds, require
from tab_marl.planning.search.growing import grow_tree_compiled
from tab_marl.planning.search.interpreted import asked_prior, grow_tree_in_python
from tab_marl.planning.search.plan import Plan, action_numbers, decided
from tab_marl.planning.search.tree import ROOT, SearchTree

__all__ = ["START", "Plan", "Pomcp", "PomcpOptions"]


START = (-1, -1)
"""As `latest`: nothing was done or seen yet. A model's prior is then asked with action -1 and observation -1."""


@dataclass(frozen=True)
class PomcpOptions(Depths):
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
    """Stop after this long even if simulations remain (the clock is read every 256 or fewer). The plan then depends on the
    machine's speed; if the simulations are done first, it is the same as without, unless the belief is a sampler and they are
    more than 2,048: under a clock it is asked for so many states at a time."""
    max_nodes: int = 1_000_000
    """Nodes at most; when reached, simulations go on without adding any, and the plan says that it is `full`. The whole tree
    takes up to ``max_nodes * (44 + 20 A)`` bytes; it is grown as needed. A tree to go on with (`start`) is kept even if larger."""
    workers: int = 1
    """Threads that search at once, each with its share of simulations and nodes; their trees are laid over each other. The same
    seed and number of workers give the same tree. For compiled models, which then must not write to their `data`."""
    common_random_numbers: bool = False
    """A particle fixes the randomness: at each depth its simulations draw the same numbers, whatever was done before
    (scenarios, as in DESPOT). Compares actions with less noise; give enough particles, or the plan learns their luck."""
    choose: Literal["value", "visits"] = "value"
    """The action of greatest value, or the one most tried."""
    compiled: bool = True
    """False: a `CompiledModel` runs interpreted, with the same random numbers and the same tree, for debugging its functions."""

    def __post_init__(self) -> None:
        check_kinds(self)
        require(self.simulations >= 1, "simulations", self.simulations, ">= 1")
        require(
            math.isfinite(self.exploration) and self.exploration >= 0, "exploration", self.exploration, "finite, >= 0"
        )
        check_horizon(self.discount, self.max_depth, self.tree_depth)
        require(self.seconds is None or self.seconds > 0, "seconds", self.seconds, "> 0")
        require(1 <= self.workers <= 1024, "workers", self.workers, "in [1, 1024]")
        require(1 <= self.max_nodes <= 2**30, "max_nodes", self.max_nodes, "in [1, 2^30]")
        require(self.choose in ("value", "visits"), "choose", self.choose, "'value' or 'visits'")


@dataclass(frozen=True, eq=False)
class Pomcp:
    """The planner: `model` is a `CompiledModel` or follows `PythonModel`."""

    model: Any
    options: PomcpOptions = PomcpOptions()

    def __post_init__(self) -> None:
        check_model(self.model)
        check_numbered(self.model)
        if self.options.workers > 1 and not isinstance(self.model, CompiledModel):
            raise ValueError(
                f"workers is {self.options.workers}, must be 1 for a model in plain Python: the interpreter runs one thread at "
                "a time; write the model as a CompiledModel, which also makes it some hundred times faster"
            )

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
        """Searches from `belief` (states, `Particles`, a filter or a sampler) and returns the plan.

        `allowed` restricts the root: action numbers, or bool[A]. `prior_values` [A] with `prior_counts` [A] (or one count for
        all) start the root's actions as if tried that often with that mean return. Without them the model's own prior is asked
        if `latest` gives the (action, observation) that led here (with the belief's first state): ``START`` where none did, in
        the first plan of a game. Without `latest` the root has no prior, only the nodes below it.
        `start` is a tree to go on with instead, such as ``plan.tree.after(action, observation)`` of the plan before.
        The same seed, model and belief give the identical tree (unless `seconds` is set).
        """
        generator = np.random.default_rng(rng)
        actions = self.model.actions
        if start is not None and (prior_values is not None or prior_counts is not None or latest is not None):
            raise ValueError("start goes without priors and latest: the tree already holds values")
        if prior_values is None and prior_counts is None and latest is not None:
            prior_values, prior_counts, open_actions = _asked_prior(self.model, belief, latest, generator)
            allowed = (
                open_actions if allowed is None else np.intersect1d(open_actions, action_numbers(actions, allowed))
            )
        if start is None:
            start = _planted(actions, allowed, prior_values, prior_counts)
        elif allowed is not None:
            start = start.subtree(ROOT, action_numbers(actions, allowed))
        if not start.edges_of(ROOT) or start.edge_actions.max() >= actions:
            raise ValueError(f"start is no tree of this model: its root needs actions, all in 0..{actions - 1}")
        started = time.perf_counter()
        if not isinstance(self.model, CompiledModel):
            warn_of_plain_python(type(self.model))
            grow = grow_tree_in_python
        else:
            interpreted = not self.options.compiled or bool(getattr(numba.config, "DISABLE_JIT", 0))
            grow = grow_tree_in_python if interpreted else grow_tree_compiled
        search = grow(self.model, self.options, belief, generator, start)
        return decided(search, self.model, self.options.choose, time.perf_counter() - started)


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
        values, counts = model.prior(belief_objects(belief, 1, rng)[0][0], action, observation, 0)
    counts = np.asarray(counts, dtype=np.int64)
    return np.asarray(values, dtype=np.float64), np.maximum(counts, 0), np.flatnonzero(counts >= 0)


def _planted(actions: int, allowed: ArrayLike | None, values: ArrayLike | None, counts: ArrayLike | None) -> SearchTree:
    """A tree of a root only, with its allowed actions."""
    chosen = action_numbers(actions, allowed)
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
