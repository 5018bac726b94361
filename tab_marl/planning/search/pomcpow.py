"""POMCPOW: Monte-Carlo tree search with weighted beliefs for continuous observations (Sunberg and Kochenderfer, ICAPS 2018).

Where no observation is met twice, POMCP's nodes below the first step hold one state each, as if the agent then knew it: it plans
as in QMDP and never pays for information. POMCPOW lets the observations of an action grow only as ``widening * n ** power``, and
every simulation that comes to an observation adds its state there, weighted by how likely that observation was.
``Pomcpow(model, PomcpowOptions(...)).plan(belief, rng)`` returns the same `Plan` as `tab_marl.planning.search.pomcp.Pomcp`; the model is
a `ContinuousModel` or a Python class with ``likelihood``.
"""

from __future__ import annotations

import math
import time
from dataclasses import dataclass
from functools import partial
from typing import Any, Literal

import numba
import numpy as np
from numpy.typing import ArrayLike, NDArray

from tab_marl.planning.model import CompiledModel, ContinuousModel, belief_states, check_model, warn_of_plain_python
from tab_marl.planning.search import pomcpow_kernels as kernels
from tab_marl.planning.search.bounds import Depths, check_horizon, check_kinds, require
from tab_marl.planning.search.growing import (
    INVERSE_ROOT,
    ROOT_LOG,
    Chunks,
    grown,
    made_ready,
    merged,
    portion_of,
    run_all,
    shares,
    starts,
    taking_turns,
)
from tab_marl.planning.search.plan import Plan, Search, action_numbers, decided
from tab_marl.planning.search.pomcpow_interpreted import search_in_python
from tab_marl.planning.search.tree import Readings, SearchTree

_FIRST_NODES = 4096
_FIRST_ROWS = 32768
_POWERS = 65536


@dataclass(frozen=True)
class PomcpowOptions(Depths):
    """How to search. Raises ValueError naming the field, its value and its bounds."""

    simulations: int = 2000
    """N, the most simulations a plan."""
    exploration: float = 10.0
    """Weight of UCB1's bonus ``sqrt(log N / n)``, in units of return: about the spread between a good and a bad return."""
    widening: float = 5.0
    """k_o: an action tried n times has at most about ``widening * n ** widening_power`` observations below it."""
    widening_power: float = 1 / 15
    """alpha_o in [0, 1]; 1 with a large `widening` is POMCP."""
    discount: float = 0.95
    """In (0, 1]; 1 needs `max_depth`."""
    max_depth: int | None = None
    """Steps from the root at which a simulation ends, rollout included; None: where discount^depth falls below 0.01."""
    tree_depth: int | None = None
    """Steps from the root down to which nodes are added; beyond, the rollout decides. None: `max_depth`."""
    seconds: float | None = None
    """Stop after this long even if simulations remain. The plan then depends on the machine's speed. A sampler is asked for
    2,048 states at a time, in place of one for every simulation at once."""
    max_nodes: int = 1_000_000
    """Nodes at most; when reached, simulations go on through the nodes there are, and the plan says that it is `full`."""
    max_particles: int = 10_000_000
    """Places for particles in the nodes' beliefs, ``8 D + 16`` bytes each; when they are used up, beliefs stay as they are."""
    workers: int = 1
    """Threads that search at once, each with its share of simulations and memory; their trees are laid over each other."""
    choose: Literal["value", "visits"] = "value"
    """The action of greatest value, or the one most tried."""
    compiled: bool = True
    """False: a `ContinuousModel` runs interpreted, with the same random numbers and the same tree."""

    def __post_init__(self) -> None:
        check_kinds(self)
        require(self.simulations >= 1, "simulations", self.simulations, ">= 1")
        require(
            math.isfinite(self.exploration) and self.exploration >= 0, "exploration", self.exploration, "finite, >= 0"
        )
        require(math.isfinite(self.widening) and self.widening > 0, "widening", self.widening, "finite, > 0")
        require(0 <= self.widening_power <= 1, "widening_power", self.widening_power, "in [0, 1]")
        check_horizon(self.discount, self.max_depth, self.tree_depth)
        require(self.seconds is None or self.seconds > 0, "seconds", self.seconds, "> 0")
        require(1 <= self.max_nodes <= 2**30, "max_nodes", self.max_nodes, "in [1, 2^30]")
        require(1 <= self.max_particles <= 2**40, "max_particles", self.max_particles, "in [1, 2^40]")
        require(1 <= self.workers <= 1024, "workers", self.workers, "in [1, 1024]")
        require(self.choose in ("value", "visits"), "choose", self.choose, "'value' or 'visits'")


@dataclass(frozen=True, eq=False)
class Pomcpow:
    """The planner: `model` is a `ContinuousModel`, or follows `PythonModel` and has ``likelihood``."""

    model: Any
    options: PomcpowOptions = PomcpowOptions()

    def __post_init__(self) -> None:
        check_model(self.model)
        if isinstance(self.model, CompiledModel) or not callable(getattr(self.model, "likelihood", None)):
            raise TypeError(
                f"the model, a {type(self.model).__name__}, must be a ContinuousModel or a Python class with likelihood(state, "
                "action, state reached, observation); for numbered observations use Pomcp"
            )
        if self.options.workers > 1 and not isinstance(self.model, ContinuousModel):
            raise ValueError(
                f"workers is {self.options.workers}, must be 1 for a model in plain Python: the interpreter runs one thread at "
                "a time; write the model as a ContinuousModel"
            )

    def plan(self, belief: Any, rng: np.random.Generator | int, *, allowed: ArrayLike | None = None) -> Plan:
        """Searches from `belief` (states, `Particles`, a filter or a sampler) and returns the plan; `allowed` restricts the root.

        The same seed, model and belief give the identical tree (unless `seconds` ends the search). The tree is not gone on with
        after a step: what is really observed is not in it. Raises ValueError when a likelihood is negative, not finite, or 0
        for an observation that the model's step has just given.
        """
        generator = np.random.default_rng(rng)
        numbers = action_numbers(self.model.actions, allowed)
        start = SearchTree.planted(numbers, np.zeros(len(numbers)), np.zeros(len(numbers), dtype=np.int64))
        started = time.perf_counter()
        compiled = isinstance(self.model, ContinuousModel)
        if not compiled:
            warn_of_plain_python(type(self.model))
        if compiled and self.options.compiled and not getattr(numba.config, "DISABLE_JIT", 0):
            search = _search_compiled(self.model, self.options, belief, generator, start)
        else:
            search = search_in_python(self.model, self.options, belief, generator, start)
        return decided(search, self.model, self.options.choose, time.perf_counter() - started)


class _Growth:
    """One worker's tree while it grows."""

    def __init__(
        self,
        model: ContinuousModel,
        options: PomcpowOptions,
        belief: Any,
        share: tuple[int, int, np.random.Generator],
        start: SearchTree,
    ) -> None:
        self.model, self.options, self.belief = model, options, belief
        self.simulations, self.node_cap, self.rng = share
        self.row_cap = max(kernels.FIRST_ROOM, options.max_particles // options.workers)
        self.portion = portion_of(belief, self.simulations, options.seconds)
        self.believe(self.portion)
        words = self.rng.integers(2**64, size=2, dtype=np.uint64)
        self.streams = words[:1], words[1:]
        self.powers = powers_of(options)
        self.done, self.timed_out = 0, False
        self.used = np.zeros(7, dtype=np.int64)
        self.used[kernels.NODES], self.used[kernels.EDGES] = 1, len(start.edges)
        nodes, actions, horizon = min(_FIRST_NODES, self.node_cap), model.actions, options.horizon
        self.nodes, self.edges = grown(start.nodes, nodes), grown(start.edges, nodes * actions)
        self.edge_actions = grown(start.edge_actions, nodes * actions)
        self.widths = np.zeros((nodes * actions, 2), dtype=np.int32)
        self.beliefs = np.zeros(nodes, dtype=BELIEF)
        self.seen = np.zeros((nodes, model.observation_size))
        rows = min(_FIRST_ROWS, self.row_cap)
        self.pool = np.empty((rows, model.state_size)), np.empty(rows), np.empty(rows)
        self.scratch = (
            np.empty(model.state_size), np.empty(model.state_size), np.empty(model.observation_size),
            np.empty(horizon, dtype=np.int64), np.empty(horizon),
        )  # fmt: skip

    def believe(self, count: int) -> None:
        """Draws states to start from."""
        self.states, self.weights = belief_states(self.model, self.belief, count, self.rng)

    def _search(self, particles: NDArray[np.int64]) -> int:
        options = self.options
        step, likelihood, rollout = self.model.functions
        run: int = kernels.search(
            step, likelihood, rollout, self.model.data, self.states, particles, self.model.actions, options.exploration,
            options.discount, options.horizon, options.deepest_node, options.widening, options.widening_power, self.powers,
            self.node_cap, self.row_cap, self.nodes, self.edges, self.edge_actions, self.widths, self.beliefs, self.seen,
            *self.pool, self.used, ROOT_LOG, INVERSE_ROOT, *self.streams, *self.scratch,
        )  # fmt: skip
        return run

    def warm(self) -> None:
        """Compiles the search for this type of model, or loads it, before the clock runs."""
        self._search(np.empty(0, dtype=np.int64))

    def _enlarge(self) -> None:
        if self.used[kernels.NODES] >= len(self.nodes) < self.node_cap:
            size, actions = min(self.node_cap, 2 * len(self.nodes)), self.model.actions
            self.nodes, self.beliefs, self.seen = (grown(a, size) for a in (self.nodes, self.beliefs, self.seen))
            self.edges, self.edge_actions, self.widths = (
                grown(a, size * actions) for a in (self.edges, self.edge_actions, self.widths)
            )
        else:
            states, rewards, weights = (grown(a, min(self.row_cap, 2 * len(a))) for a in self.pool)
            self.pool = states, rewards, weights

    def run(self, drawing: float) -> None:
        """All simulations, or as many as the time allows, of which `drawing` states has taken some already."""
        seconds = self.options.seconds
        chunks = Chunks(None if seconds is None else time.perf_counter() + seconds - drawing)
        for block in starts(self, self.simulations, self.portion, self.rng):
            if self.done > 0 and chunks.late():
                self.timed_out = True
                return
            at = 0
            while at < len(block):
                began = time.perf_counter()
                particles = block[at : at + chunks.within(len(block) - at)]
                run = self._search(particles)
                at, self.done = at + run, self.done + run
                if self.used[kernels.BROKEN]:
                    raise_likelihood()
                if run < len(particles):
                    self._enlarge()
                elif chunks.over(time.perf_counter() - began, run):
                    self.timed_out = self.done < self.simulations
                    return

    def finished(self, numbers: NDArray[np.int64]) -> Search:
        """The search, with `numbers` [nodes] for its observations."""
        count, edges = len(numbers), int(self.used[kernels.EDGES])
        nodes = self.nodes[:count].copy()
        nodes["observation"] = numbers
        return Search(
            SearchTree(nodes, self.edges[:edges], self.edge_actions[:edges], None),
            self.done,
            int(self.used[kernels.DEEPEST]),
            int(self.used[kernels.STEPS]),
            "seconds" if self.timed_out else "simulations",
            count >= self.node_cap,
        )


BELIEF = np.dtype([("first", np.int64), ("count", np.int32), ("room", np.int32), ("generated", np.int32)])
"""A node's particles in the pool, and how often its observation was generated."""


def powers_of(options: PomcpowOptions) -> NDArray[np.float64]:
    """``n ** widening_power`` for small n."""
    return np.arange(min(options.simulations, _POWERS) + 1, dtype=np.float64) ** options.widening_power


def raise_likelihood() -> None:
    raise ValueError(
        "the model's likelihood was negative, not finite, or 0 for an observation that its step had just given: "
        "likelihood and step must describe the same noise"
    )


def _numbered(seen: NDArray[np.float64], roots: NDArray[np.int64]) -> NDArray[np.int64]:
    """``[n]``: a number for each row of observations `seen` [n, O], the same for equal ones: the first such row's own.

    By it the workers' trees find each other's nodes. One worker's tree needs none: its nodes keep the numbers of their rows, and
    so do the `roots`, whose rows are no observations.
    """
    numbers = np.arange(len(seen))
    if len(roots) == 1:
        return numbers
    rows = np.delete(numbers, roots)
    order = rows[np.lexsort(seen[rows].T)]  # stable: of equal rows the first stays first
    fresh = np.ones(len(order), dtype=np.bool_)
    fresh[1:] = (seen[order[1:]] != seen[order[:-1]]).any(axis=1)
    numbers[order] = order[fresh][np.cumsum(fresh) - 1]
    return numbers


def _search_compiled(
    model: ContinuousModel, options: PomcpowOptions, belief: Any, rng: np.random.Generator, start: SearchTree
) -> Search:
    began = time.perf_counter()
    belief = taking_turns(belief)
    growths = [
        _Growth(model, options, belief, share, start)
        for share in shares(options.simulations, options.max_nodes, options.workers, rng)
    ]
    drawing = time.perf_counter() - began
    compiling = made_ready(model, growths[0])
    run_all([partial(growth.run, drawing) for growth in growths])
    counts = [int(growth.used[kernels.NODES]) for growth in growths]
    seen = np.concatenate([growth.seen[:count] for growth, count in zip(growths, counts, strict=True)])
    ends = np.cumsum(counts, dtype=np.int64)
    numbers = np.split(_numbered(seen, ends - counts), ends[:-1])
    search = merged(
        [growth.finished(own) for growth, own in zip(growths, numbers, strict=True)], start, options.max_nodes
    )
    tree = SearchTree(search.tree.nodes, search.tree.edges, search.tree.edge_actions, Readings(seen))
    return Search(
        tree, search.simulations, search.depth, search.steps, search.stopped, search.full, compiling=compiling
    )
