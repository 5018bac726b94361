"""Growing a tree with the compiled kernel: memory, budgets, and several cores.

Root-parallel search (Chaslot, Winands and Van den Herik 2008): every worker grows a tree of its own from its share of the
simulations, with its own random numbers, and the trees are laid over each other: counts add up, values are averaged by count.
The kernel holds no lock of the interpreter, so workers are threads. The result depends on the seed and the number of workers,
never on their timing (unless `seconds` ends the search).
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from functools import partial
from threading import Lock
from typing import TYPE_CHECKING, Any, Protocol
from weakref import WeakSet

import numpy as np
from numpy.typing import NDArray

from tab_marl.planning.model import CompiledModel, belief_states, draw_particles, is_sampler
from tab_marl.planning.search import kernels, merge_kernels
from tab_marl.planning.search.plan import Search
from tab_marl.planning.search.tree import SearchTree

if TYPE_CHECKING:
    from tab_marl.planning.search.pomcp import PomcpOptions

BLOCK = 2048
"""Simulations whose particles are drawn at a time: the same with a time budget and without, so that both grow one tree."""
_FIRST_CHUNK = 16
_MOST_CHUNK = 256
"""Simulations between two looks at the clock: few at first, in case a simulation takes milliseconds."""
_FIRST_NODES = 16384
"""Nodes allocated at first; doubled when full."""
_MANY_CHILDREN = 64
"""Observations after one action at the root from which on a table finds nodes (the kernel for that is compiled on first need)."""
ROOT_LOG = np.sqrt([0.0, *np.log(np.arange(1, 4096))])
INVERSE_ROOT = 1.0 / np.sqrt(np.maximum(np.arange(4096), 1))
"""sqrt(log n) and 1 / sqrt(n) of small counts, for UCB1."""


def particle_blocks(
    simulations: int, states: int, weights: NDArray[np.float64] | None, rng: np.random.Generator
) -> Iterator[NDArray[np.int64]]:
    """The particle that each simulation starts from, in blocks."""
    for done in range(0, simulations, BLOCK):
        yield draw_particles(min(BLOCK, simulations - done), states, weights, rng)


class Source(Protocol):
    """Where simulations start from."""

    states: Any
    weights: NDArray[np.float64] | None

    def believe(self, count: int) -> None:
        """Asks the belief for `count` states, in place of those that there are."""
        ...


def portion_of(belief: Any, simulations: int, seconds: float | None) -> int:
    """How many states a sampler is asked for at a time: one for every simulation, but under a clock only a block of them.

    The time may be up long before all could be drawn, or held in memory.
    """
    return min(simulations, BLOCK) if seconds is not None and is_sampler(belief) else simulations


def starts(source: Source, simulations: int, portion: int, rng: np.random.Generator) -> Iterator[NDArray[np.int64]]:
    """As `particle_blocks`, asking the belief anew after every `portion` of simulations; the first is there already."""
    for begun in range(0, simulations, portion):
        count = min(portion, simulations - begun)
        if begun > 0:
            source.believe(count)
        yield from particle_blocks(count, len(source.states), source.weights, rng)


@dataclass
class Chunks:
    """How many simulations to run before the next look at the clock: about a tenth of the time that is left."""

    deadline: float | None
    """Of time.perf_counter."""
    size: int = _FIRST_CHUNK

    def within(self, left: int) -> int:
        return left if self.deadline is None else min(self.size, left)

    def paused(self, since: float) -> float:
        """Seconds since then, which the deadline does not count."""
        seconds = time.perf_counter() - since
        if self.deadline is not None:
            self.deadline += seconds
        return seconds

    def late(self) -> bool:
        """Whether time is up."""
        return self.deadline is not None and time.perf_counter() >= self.deadline

    def over(self, seconds: float, simulations: int) -> bool:
        """Whether time is up, after a chunk that took this long."""
        if self.deadline is None:
            return False
        left = self.deadline - time.perf_counter()
        self.size = int(np.clip(0.1 * left * simulations / max(seconds, 1e-9), 1, _MOST_CHUNK))
        return left <= 0


@dataclass
class Growth:
    """One worker's tree while it grows: arrays with room to spare."""

    model: CompiledModel
    options: PomcpOptions
    belief: Any
    rng: np.random.Generator
    start: SearchTree
    simulations: int
    max_nodes: int
    done: int = 0
    timed_out: bool = False
    compiling: float = 0.0
    used: NDArray[np.int64] = field(init=False)

    def __post_init__(self) -> None:
        start, actions = self.start, self.model.actions
        self.parents: NDArray[np.int32] | None = None
        self.table: NDArray[np.int32] | None = None
        self.portion = portion_of(self.belief, self.simulations, self.options.seconds)
        self._ask(self.portion)
        words = self.rng.integers(2**64, size=2, dtype=np.uint64)
        self.tree_stream, self.model_stream = words[:1], words[1:]
        self._seed()
        # Every simulation adds at most one node and expands at most one.
        self.most = max(len(start), min(self.max_nodes, self.simulations + len(start)))
        self.spare = len(start.edges)
        self.used = np.array([len(start), self.spare, 0, 0, 0])
        self.nodes, self.edges, self.edge_actions = start.nodes, start.edges, start.edge_actions
        self._allocate(min(self.most, len(start) + _FIRST_NODES))
        horizon = self.options.horizon
        self.scratch = (
            np.empty(self.model.state_size), np.empty(horizon, dtype=np.int64), np.empty(horizon),
            np.empty(actions), np.empty(actions, dtype=np.int64),
        )  # fmt: skip

    def believe(self, count: int) -> None:
        self._ask(count)
        self._seed()

    def _ask(self, count: int) -> None:
        self.states, self.weights = belief_states(self.model, self.belief, count, self.rng)

    def _seed(self) -> None:
        """One seed for every state, where particles are scenarios."""
        shared = len(self.states) if self.options.common_random_numbers else 0
        self.seeds = self.rng.integers(2**64, size=shared, dtype=np.uint64)

    def _allocate(self, size: int) -> None:
        self.nodes = grown(self.nodes, size)
        self.edges = grown(self.edges, size * self.model.actions + self.spare)
        self.edge_actions = grown(self.edge_actions, len(self.edges))
        if self.table is not None:
            self._tabulate()

    def _tabulate(self) -> None:
        """Lists the children of every edge in a table, where there are too many to look through."""
        size = len(self.nodes)
        self.parents = np.empty(size, dtype=np.int32)
        self.table = np.empty(table_size(size), dtype=np.int32)
        kernels.enter_all(
            self.nodes, self.edges, self.used[kernels.EDGES], self.used[kernels.NODES], self.parents, self.table
        )

    def _search(self, particles: NDArray[np.int64]) -> int:
        options, (state, path_edges, path_rewards, values, counts) = self.options, self.scratch
        step, rollout, prior = self.model.functions
        run: int = kernels.search(
            step, rollout, prior, self.model.data, self.states, particles, self.seeds, self.model.actions,
            options.exploration, options.discount, options.horizon, options.deepest_node, len(self.nodes) < self.most,
            self.nodes, self.edges, self.edge_actions, self.parents, self.table, self.used, ROOT_LOG, INVERSE_ROOT,
            self.tree_stream, self.model_stream, state, path_edges, path_rewards, values, counts,
        )  # fmt: skip
        return run

    def warm(self) -> None:
        """Compiles the search for this type of model, or loads it, before the clock runs."""
        self._search(np.empty(0, dtype=np.int64))

    def run(self, drawing: float) -> None:
        """All simulations, or as many as the time allows, of which `drawing` states has taken some already."""
        seconds = self.options.seconds
        chunks = Chunks(None if seconds is None else time.perf_counter() + seconds - drawing)
        for block in starts(self, self.simulations, self.portion, self.rng):
            if self.done > 0 and chunks.late():
                self.timed_out = True
                return
            if self.table is None and kernels.most_children(self.nodes, self.edges) > _MANY_CHILDREN:
                began = time.perf_counter()
                self._tabulate()
                self.warm()  # another kernel: compiling it is none of the search's time
                self.compiling += chunks.paused(began)
            at = 0
            while at < len(block):
                started = time.perf_counter()
                particles = block[at : at + chunks.within(len(block) - at)]
                run = self._search(particles)
                at += run
                self.done += run
                if run < len(particles):
                    self._allocate(min(self.most, 2 * len(self.nodes)))
                elif chunks.over(time.perf_counter() - started, run):
                    self.timed_out = self.done < self.simulations
                    return

    def finished(self) -> Search:
        nodes, edges, deepest, tree_steps, rollout_steps = (int(n) for n in self.used)
        return Search(
            SearchTree(self.nodes[:nodes], self.edges[:edges], self.edge_actions[:edges], None),
            self.done,
            deepest,
            tree_steps + rollout_steps,
            "seconds" if self.timed_out else "simulations",
            nodes >= self.max_nodes,
            compiling=self.compiling,
        )


def grow_tree_compiled(
    model: CompiledModel, options: PomcpOptions, belief: Any, rng: np.random.Generator, start: SearchTree
) -> Search:
    """The search by `options.workers` threads."""
    began = time.perf_counter()
    belief = taking_turns(belief)
    growths = [
        Growth(model, options, belief, stream, start, share, most)
        for share, most, stream in shares(options.simulations, options.max_nodes, options.workers, rng)
    ]
    drawing = time.perf_counter() - began
    growths[0].compiling = made_ready(model, growths[0])
    run_all([partial(growth.run, drawing) for growth in growths])
    return merged([growth.finished() for growth in growths], start, options.max_nodes)


def taking_turns(belief: Any) -> Any:
    """The belief, a sampler asked by one thread at a time: it is the caller's, and need not bear more."""
    if not is_sampler(belief):
        return belief
    sampler, lock = getattr(belief, "particles", belief), Lock()

    def sampled(count: int, rng: np.random.Generator) -> Any:
        with lock:
            return sampler(count, rng)

    return sampled


class Warmable(Protocol):
    """A worker whose search can be compiled ahead."""

    def warm(self) -> None: ...


_ready: WeakSet[Any] = WeakSet()
"""Models whose search is compiled in this process: asking again would cost a plan some microseconds."""


def made_ready(model: Any, growth: Warmable) -> float:
    """Compiles the search for this model, or loads it, unless that was done; returns the seconds it took."""
    if model in _ready:
        return 0.0
    began = time.perf_counter()
    growth.warm()
    _ready.add(model)
    return time.perf_counter() - began


def shares(
    simulations: int, max_nodes: int, workers: int, rng: np.random.Generator
) -> list[tuple[int, int, np.random.Generator]]:
    """(simulations, nodes, random stream) of each worker; one worker uses the stream itself."""
    workers = min(workers, simulations)
    if workers == 1:
        return [(simulations, max_nodes, rng)]
    seeds = rng.integers(2**63, size=workers)
    return [
        (
            simulations // workers + (i < simulations % workers),
            max(1, max_nodes // workers),
            np.random.default_rng(seed),
        )
        for i, seed in enumerate(seeds.tolist())
    ]


def run_all(tasks: list[Callable[[], None]]) -> None:
    """The first task in this thread, every other in one of its own; the first error is raised again."""
    if len(tasks) == 1:
        tasks[0]()
        return
    with ThreadPoolExecutor(len(tasks) - 1) as pool:
        others = [pool.submit(task) for task in tasks[1:]]
        tasks[0]()
        for other in others:
            other.result()


def merged(searches: list[Search], start: SearchTree, max_nodes: int) -> Search:
    """One search out of the workers'; what they all began with (`start`) counts once."""
    if len(searches) == 1:
        return searches[0]
    total = sum(len(search.tree) for search in searches)
    edge_total = sum(len(search.tree.edges) for search in searches)
    first = searches[0].tree
    nodes, edges = grown(first.nodes, total), grown(first.edges, edge_total)
    edge_actions = grown(first.edge_actions, edge_total)
    parents, table = np.empty(total, dtype=np.int32), np.empty(table_size(total), dtype=np.int32)
    used = np.array([len(first), len(first.edges)])
    kernels.enter_all(nodes, edges, used[1], used[0], parents, table)
    for search in searches[1:]:
        tree = search.tree
        merge_kernels.overlay(
            nodes, edges, edge_actions, parents, table, used, tree.nodes, tree.edges, tree.edge_actions,
            start.nodes, start.edges, np.empty(len(tree), dtype=np.int32),
        )  # fmt: skip
    return Search(
        SearchTree(nodes[: used[0]], edges[: used[1]], edge_actions[: used[1]], None),
        sum(search.simulations for search in searches),
        max(search.depth for search in searches),
        sum(search.steps for search in searches),
        "seconds" if any(search.stopped == "seconds" for search in searches) else "simulations",
        any(search.full for search in searches) or int(used[0]) >= max_nodes,
        compiling=max(search.compiling for search in searches),
    )


def table_size(nodes: int) -> int:
    """Slots for this many nodes: a power of two, half of them free at least."""
    return 1 << int(2 * nodes - 1).bit_length()


def grown(array: NDArray[Any], size: int) -> NDArray[Any]:
    """A copy with room for `size` rows."""
    larger = np.empty((size, *array.shape[1:]), dtype=array.dtype)
    larger[: len(array)] = array
    return larger
