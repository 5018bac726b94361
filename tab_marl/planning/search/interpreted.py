"""The search in plain Python: for models that are Python classes, for debugging compiled ones, and as the kernel's slow twin.

Given a `CompiledModel` it draws the same random numbers as `tab_marl.planning.search.kernels.search` and must build the identical tree.
"""

from __future__ import annotations

import copy
import math
import time
from collections.abc import Hashable
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from tab_marl.planning.model import CompiledModel, belief_objects, belief_states, numbered
from tab_marl.planning.search.growing import merged, portion_of, shares, starts
from tab_marl.planning.search.kernels import NO_CHILD, UNEXPANDED
from tab_marl.planning.search.plan import Search
from tab_marl.planning.search.tree import EDGE, NODE, ROOT, SearchTree

if TYPE_CHECKING:
    from tab_marl.planning.search.pomcp import PomcpOptions

_MASK = 2**64 - 1
_GOLDEN = 0x9E3779B97F4A7C15


def mixed(word: int) -> int:
    """The output function of SplitMix64 on Python's integers."""
    word = ((word ^ (word >> 30)) * 0xBF58476D1CE4E5B9) & _MASK
    word = ((word ^ (word >> 27)) * 0x94D049BB133111EB) & _MASK
    return word ^ (word >> 31)


class Stream:
    def __init__(self, word: int) -> None:
        self.word = word

    def below(self, count: int) -> int:
        self.word = (self.word + _GOLDEN) & _MASK
        return ((mixed(self.word) >> 32) * count) >> 32


def asked_prior(
    model: CompiledModel, state: NDArray[np.float64], action: int, seen: int, depth: int
) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """What a compiled model's prior writes: (values [A], counts [A])."""
    assert model.prior is not None
    function = getattr(model.prior, "py_func", model.prior)
    values, counts = np.zeros(model.actions), np.zeros(model.actions, dtype=np.int64)
    function(state, action, seen, depth, model.data, values, counts)
    return values, counts


class _CompiledAsPython:
    """A compiled model's functions, interpreted, with the random numbers that the kernel would give them."""

    def __init__(self, model: CompiledModel, count: int, common: bool, belief: Any, rng: np.random.Generator) -> None:
        self.model, self.belief, self.common, self.random = model, belief, common, rng
        self._ask(count)
        words = rng.integers(2**64, size=2, dtype=np.uint64)
        self.stream, self.word = Stream(int(words[0])), words[1:]
        self._seed()
        self.has_rollout, self.has_prior = model.rollout is not None, model.prior is not None

    def believe(self, count: int) -> None:
        self._ask(count)
        self._seed()

    def _ask(self, count: int) -> None:
        self.states, self.weights = belief_states(self.model, self.belief, count, self.random)

    def _seed(self) -> None:
        shared = len(self.states) if self.common else 0
        self.seeds = self.random.integers(2**64, size=shared, dtype=np.uint64)

    def start(self, particle: int) -> NDArray[np.float64]:
        self.particle = particle
        return self.states[particle].copy()

    def at_depth(self, depth: int) -> None:
        if len(self.seeds):
            self.word[0] = mixed((int(self.seeds[self.particle]) + depth * _GOLDEN) & _MASK)

    def step(self, state: Any, action: int) -> tuple[Any, Hashable, float, bool]:
        function = getattr(self.model.step, "py_func", self.model.step)
        observation, reward, terminal = function(state, action, self.model.data, self.word)
        return state, numbered(observation, function), float(reward), bool(terminal)

    def rollout(self, state: Any, action: int, seen: Any, depth: int, max_depth: int, discount: float) -> float:
        assert self.model.rollout is not None
        function = getattr(self.model.rollout, "py_func", self.model.rollout)
        return float(function(state, action, seen, depth, max_depth, discount, self.model.data, self.word))

    def prior(self, state: Any, action: int, seen: Any, depth: int) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
        return asked_prior(self.model, state, action, seen, depth)


def gives(model: Any, name: str) -> bool:
    """Whether a model in plain Python has the optional function; None says no, as in a `CompiledModel`."""
    return getattr(model, name, None) is not None


def checked_step(model: Any, state: Any, action: int, rng: np.random.Generator) -> tuple[Any, Hashable, float, bool]:
    """One step of a model in plain Python. Raises TypeError naming what its `step` returned if that is no step."""
    result = model.step(state, action, rng)
    if not isinstance(result, tuple | list) or len(result) != 4:
        raise TypeError(
            f"{type(model).__name__}.step returned {result!r}, must return four things: (next state, observation, reward, terminal)"
        )
    after, seen, reward, terminal = result
    try:
        hash(seen)
    except TypeError:
        raise TypeError(
            f"{type(model).__name__}.step returned the observation {seen!r}, a {type(seen).__name__}, must be hashable to be told "
            "from others: return a number, a string or a tuple, such as tuple(observation.tolist()) for an array"
        ) from None
    return after, seen, reward, terminal


class _PythonModel:
    """A model that is a Python class; states are whatever it likes."""

    def __init__(self, model: Any, count: int, common: bool, belief: Any, rng: np.random.Generator) -> None:
        self.model, self.belief, self.common, self.random = model, belief, common, rng
        self.states, self.weights = belief_objects(belief, count, rng)
        self.stream = Stream(int(rng.integers(2**64, dtype=np.uint64)))
        self.rng = np.random.default_rng(int(rng.integers(2**63)))
        self._seed()
        self.has_rollout, self.has_prior = gives(model, "rollout"), gives(model, "prior")

    def believe(self, count: int) -> None:
        self.states, self.weights = belief_objects(self.belief, count, self.random)
        self._seed()

    def _seed(self) -> None:
        self.seeds = self.random.integers(2**63, size=len(self.states) if self.common else 0)

    def start(self, particle: int) -> Any:
        self.particle = particle
        return copy.copy(self.states[particle])

    def at_depth(self, depth: int) -> None:
        if len(self.seeds):
            self.rng = np.random.default_rng((int(self.seeds[self.particle]), depth))

    def step(self, state: Any, action: int) -> tuple[Any, Hashable, float, bool]:
        return checked_step(self.model, state, action, self.rng)

    def rollout(self, state: Any, action: int, seen: Any, depth: int, max_depth: int, discount: float) -> float:
        return float(self.model.rollout(state, action, seen, depth, max_depth, discount, self.rng))

    def prior(self, state: Any, action: int, seen: Any, depth: int) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
        values, counts = self.model.prior(state, action, seen, depth)
        return np.asarray(values, dtype=np.float64), np.asarray(counts, dtype=np.int64)


class _Growing:
    """The tree as lists, while it grows."""

    def __init__(self, start: SearchTree) -> None:
        nodes, edges = start.nodes, start.edges
        self.seen: list[Any] = [start.observation(n) if n else 0 for n in range(len(start))]
        self.sibling, self.node_visits = nodes["sibling"].tolist(), nodes["visits"].tolist()
        self.first_edge, self.edge_count = nodes["first_edge"].tolist(), nodes["edge_count"].tolist()
        self.actions, self.values = start.edge_actions.tolist(), edges["value"].tolist()
        self.edge_visits, self.child = edges["visits"].tolist(), edges["child"].tolist()

    def edges_of(self, node: int) -> range:
        return range(self.first_edge[node], self.first_edge[node] + self.edge_count[node])

    def select(self, node: int, exploration: float, stream: Stream) -> int:
        untried = [e for e in self.edges_of(node) if self.edge_visits[e] == 0]
        if untried:
            return untried[stream.below(len(untried))]
        factor = exploration * math.sqrt(math.log(self.node_visits[node]))
        return max(self.edges_of(node), key=lambda e: self.values[e] + factor * (1.0 / math.sqrt(self.edge_visits[e])))

    def find(self, edge: int, seen: Hashable) -> int:
        child = self.child[edge]
        while child != NO_CHILD and self.seen[child] != seen:
            child = self.sibling[child]
        return child

    def add_node(self, edge: int, seen: Hashable) -> None:
        self.seen.append(seen)
        self.sibling.append(self.child[edge])
        self.node_visits.append(1)
        self.first_edge.append(UNEXPANDED)
        self.edge_count.append(0)
        self.child[edge] = len(self.seen) - 1

    def expand(self, node: int, values: list[float], counts: list[int]) -> None:
        self.first_edge[node] = len(self.actions)
        for action, (value, count) in enumerate(zip(values, counts, strict=True)):
            if count >= 0:
                self.actions.append(action)
                self.values.append(value)
                self.edge_visits.append(count)
                self.child.append(NO_CHILD)
                self.node_visits[node] += count
        self.edge_count[node] = len(self.actions) - self.first_edge[node]

    def backup(self, path: list[tuple[int, float]], leaf: float, discount: float) -> None:
        for edge, reward in reversed(path):
            leaf = reward + discount * leaf
            self.edge_visits[edge] += 1
            self.values[edge] += (leaf - self.values[edge]) / self.edge_visits[edge]

    def finished(self, compiled: bool) -> SearchTree:
        nodes, edges = np.empty(len(self.seen), dtype=NODE), np.empty(len(self.actions), dtype=EDGE)
        nodes["observation"] = self.seen if compiled else range(len(self.seen))
        nodes["sibling"], nodes["visits"] = self.sibling, self.node_visits
        nodes["first_edge"], nodes["edge_count"] = self.first_edge, self.edge_count
        edges["value"], edges["visits"], edges["child"] = self.values, self.edge_visits, self.child
        return SearchTree(nodes, edges, np.array(self.actions, dtype=np.int32), None if compiled else tuple(self.seen))


def grow_tree_in_python(
    model: Any, options: PomcpOptions, belief: Any, rng: np.random.Generator, start: SearchTree
) -> Search:
    """The search, interpreted; workers take turns."""
    shared = shares(options.simulations, options.max_nodes, options.workers, rng)
    return merged([_grown(model, options, belief, *share, start) for share in shared], start, options.max_nodes)


def _grown(
    model: Any,
    options: PomcpOptions,
    belief: Any,
    simulations: int,
    max_nodes: int,
    rng: np.random.Generator,
    start: SearchTree,
) -> Search:
    compiled = isinstance(model, CompiledModel)
    deadline = None if options.seconds is None else time.perf_counter() + options.seconds
    portion = portion_of(belief, simulations, options.seconds)
    source = (_CompiledAsPython if compiled else _PythonModel)(
        model, portion, options.common_random_numbers, belief, rng
    )
    tree = _Growing(start)
    most = max(len(start), min(max_nodes, simulations + len(start)))
    done = deepest = steps = 0
    timed_out = False
    for block in starts(source, simulations, portion, rng):
        with np.errstate(over="ignore"):  # a model's random words wrap round
            for particle in block.tolist():
                depth, path_length = _simulate(tree, source, particle, options, most, model.actions)
                deepest, steps, done = max(deepest, depth), steps + path_length, done + 1
                timed_out = deadline is not None and done < simulations and time.perf_counter() >= deadline
                if timed_out:
                    break
        if timed_out:
            break
    grown = tree.finished(compiled)
    return Search(grown, done, deepest, steps, "seconds" if timed_out else "simulations", len(grown) >= max_nodes)


def _simulate(
    tree: _Growing,
    source: Any,
    particle: int,
    options: PomcpOptions,
    most: int,
    actions: int,
) -> tuple[int, int]:
    horizon, tree_depth = options.horizon, options.deepest_node
    room = len(tree.seen) < most
    state = source.start(particle)
    node, action, path, leaf, seen = ROOT, -1, list[tuple[int, float]](), 0.0, None
    while True:
        tree.node_visits[node] += 1
        if tree.edge_count[node] == 0:
            leaf_needed = True
            break
        edge = tree.select(node, options.exploration, source.stream)
        action = tree.actions[edge]
        source.at_depth(len(path))
        state, seen, reward, terminal = source.step(state, action)
        path.append((edge, reward))
        leaf_needed = not (terminal or len(path) == horizon)
        if not leaf_needed:
            break
        child = tree.find(edge, seen)
        if child == NO_CHILD:
            if room and len(path) <= tree_depth:
                tree.add_node(edge, seen)
            break
        if tree.first_edge[child] == UNEXPANDED:
            if not room:
                tree.node_visits[child] += 1
                break
            values, counts = (
                source.prior(state, action, seen, len(path))
                if source.has_prior
                else (np.zeros(actions), np.zeros(actions, int))
            )
            tree.expand(child, values.tolist(), counts.tolist())
        node = child
    depth = steps = len(path)
    if leaf_needed:
        source.at_depth(depth)
        if source.has_rollout:
            leaf = source.rollout(state, action, seen, depth, horizon, options.discount)
        else:
            leaf, rolled = _random_rollout(source, state, depth, horizon, options.discount, actions)
            steps += rolled
    tree.backup(path, leaf, options.discount)
    return depth, steps


def _random_rollout(
    source: Any, state: Any, depth: int, horizon: int, discount: float, actions: int
) -> tuple[float, int]:
    total, weight, steps = 0.0, 1.0, 0
    for _ in range(depth, horizon):
        state, _seen, reward, terminal = source.step(state, source.stream.below(actions))
        steps += 1
        total += weight * reward
        if terminal:
            break
        weight *= discount
    return total, steps
