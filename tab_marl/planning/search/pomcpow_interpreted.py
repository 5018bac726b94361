"""POMCPOW in plain Python: for models that are Python classes, and as the slow twin of `pomcpow_kernels`."""

from __future__ import annotations

import bisect
import copy
import math
import time
from collections.abc import Hashable
from typing import TYPE_CHECKING, Any

import numpy as np

from tab_marl.planning.model import ContinuousModel, belief_objects, belief_states
from tab_marl.planning.search.growing import merged, portion_of, shares, starts
from tab_marl.planning.search.interpreted import Stream, checked_step, gives, mixed
from tab_marl.planning.search.kernels import NO_CHILD, UNEXPANDED
from tab_marl.planning.search.plan import Search, Stopped
from tab_marl.planning.search.pomcpow_kernels import FIRST_ROOM
from tab_marl.planning.search.tree import EDGE, NODE, ROOT, SearchTree

if TYPE_CHECKING:
    from tab_marl.planning.search.pomcpow import PomcpowOptions

_MASK = 2**64 - 1
_GOLDEN = 0x9E3779B97F4A7C15


class _Uniform(Stream):
    def uniform(self) -> float:
        self.word = (self.word + _GOLDEN) & _MASK
        return (mixed(self.word) >> 11) * (1.0 / 9007199254740992.0)


class _CompiledSource:
    """A compiled model's functions, interpreted, with the random numbers that the kernel would give them."""

    def __init__(self, model: ContinuousModel, count: int, belief: Any, rng: np.random.Generator) -> None:
        self.model, self.belief, self.random = model, belief, rng
        self.believe(count)
        words = rng.integers(2**64, size=2, dtype=np.uint64)
        self.stream, self.word = _Uniform(int(words[0])), words[1:]
        self.has_rollout = model.rollout is not None

    def believe(self, count: int) -> None:
        self.states, self.weights = belief_states(self.model, self.belief, count, self.random)

    def step(self, state: Any, action: int) -> tuple[Any, Hashable, float, bool]:
        after, seen = state.copy(), np.empty(self.model.observation_size)
        reward, terminal = _plain(self.model.step)(after, action, self.model.data, self.word, seen)
        return after, tuple(seen.tolist()), float(reward), bool(terminal)

    def likelihood(self, before: Any, action: int, after: Any, seen: Any) -> float:
        return float(_plain(self.model.likelihood)(before, action, after, np.array(seen), self.model.data))

    def rollout(self, state: Any, action: int, seen: Any, depth: int, max_depth: int, discount: float) -> float:
        function = _plain(self.model.rollout)
        return float(
            function(state.copy(), action, np.array(seen), depth, max_depth, discount, self.model.data, self.word)
        )


class _PythonSource:
    """A model that is a Python class."""

    def __init__(self, model: Any, count: int, belief: Any, rng: np.random.Generator) -> None:
        self.model, self.belief, self.random = model, belief, rng
        self.believe(count)
        self.stream = _Uniform(int(rng.integers(2**64, dtype=np.uint64)))
        self.rng = np.random.default_rng(int(rng.integers(2**63)))
        self.has_rollout = gives(model, "rollout")

    def believe(self, count: int) -> None:
        self.states, self.weights = belief_objects(self.belief, count, self.random)

    def step(self, state: Any, action: int) -> tuple[Any, Hashable, float, bool]:
        return checked_step(self.model, copy.copy(state), action, self.rng)

    def likelihood(self, before: Any, action: int, after: Any, seen: Any) -> float:
        return float(self.model.likelihood(before, action, after, seen))

    def rollout(self, state: Any, action: int, seen: Any, depth: int, max_depth: int, discount: float) -> float:
        return float(self.model.rollout(copy.copy(state), action, seen, depth, max_depth, discount, self.rng))


def _plain(function: Any) -> Any:
    return getattr(function, "py_func", function)


class _Edge:
    def __init__(self, action: int) -> None:
        self.action, self.value, self.visits, self.generated = action, 0.0, 0, 0
        self.children: list[_Node] = []  # oldest first


class _Node:
    def __init__(self, number: int, seen: Any) -> None:
        self.number, self.seen, self.visits, self.generated, self.room = number, seen, 1, 1, 0
        self.edges: list[_Edge] | None = None
        self.first_edge = UNEXPANDED
        self.held: list[tuple[Any, float]] = []  # (state, reward of the step that led here)
        self.cumulative: list[float] = []


class _Search:
    def __init__(self, model: Any, options: PomcpowOptions, source: Any, node_cap: int, row_cap: int) -> None:
        self.model, self.options, self.source = model, options, source
        self.node_cap, self.row_cap, self.rows = node_cap, row_cap, 0
        self.nodes: list[_Node] = []
        self.edges: list[_Edge] = []
        self.steps = self.deepest = 0

    def plant(self, node: _Node, actions: list[int]) -> None:
        node.edges, node.first_edge = [_Edge(a) for a in actions], len(self.edges)
        self.edges += node.edges

    def select(self, node: _Node) -> _Edge:
        assert node.edges is not None
        untried = [e for e in node.edges if e.visits == 0]
        if untried:
            return untried[self.source.stream.below(len(untried))]
        factor = self.options.exploration * math.sqrt(math.log(node.visits))
        return max(node.edges, key=lambda e: e.value + factor * (1.0 / math.sqrt(e.visits)))

    def insert(self, node: _Node, state: Any, reward: float, weight: float) -> None:
        if len(node.held) == node.room:
            room = max(FIRST_ROOM, 2 * node.room)
            if self.rows + room > self.row_cap:
                return
            node.room, self.rows = room, self.rows + room
        node.held.append((state, reward))
        node.cumulative.append(weight + (node.cumulative[-1] if node.cumulative else 0.0))

    def weight(self, before: Any, action: int, after: Any, seen: Any, own: bool) -> float:
        weight = self.source.likelihood(before, action, after, seen)
        if not (weight > 0.0 if own else weight >= 0.0) or not weight < math.inf:
            from tab_marl.planning.search.pomcpow import raise_likelihood

            raise_likelihood()
        return float(weight)

    def simulate(self, particle: int) -> None:
        options, source, horizon = self.options, self.source, self.options.horizon
        room = len(self.nodes) < self.node_cap
        state, node, path, leaf = copy.copy(source.states[particle]), self.nodes[ROOT], list[tuple[_Edge, float]](), 0.0
        while True:
            node.visits += 1
            edge = self.select(node)
            before = state
            state, seen, reward, terminal = source.step(before, edge.action)
            path.append((edge, reward))
            leaf_needed = not (terminal or len(path) == horizon)
            if not leaf_needed:
                break
            child = None
            if len(edge.children) <= options.widening * float(edge.visits) ** options.widening_power:
                child = next((c for c in edge.children if c.seen == seen), None)
                if child is not None:
                    child.generated += 1
                    edge.generated += 1
                    child = None  # counted, but not followed: see the kernel
                elif room and len(path) <= options.deepest_node and self.rows + FIRST_ROOM <= self.row_cap:
                    weight = self.weight(before, edge.action, state, seen, own=True)
                    self.nodes.append(_Node(len(self.nodes), seen))
                    edge.children.append(self.nodes[-1])
                    edge.generated += 1
                    self.insert(self.nodes[-1], state, reward, weight)
                    break
            if child is None:
                if edge.generated == 0:
                    break
                chosen = source.stream.below(edge.generated)
                for child in reversed(edge.children):
                    chosen -= child.generated
                    if chosen < 0:
                        break
                assert child is not None
                seen = child.seen
            self.insert(child, state, reward, self.weight(before, edge.action, state, seen, own=False))
            target = source.stream.uniform() * child.cumulative[-1]
            row = min(bisect.bisect_right(child.cumulative, target), len(child.cumulative) - 1)
            state, reward = child.held[row]
            path[-1] = (edge, reward)
            if child.edges is None:
                self.plant(child, list(range(self.model.actions)))
            node = child
        depth = len(path)
        self.steps, self.deepest = self.steps + depth, max(self.deepest, depth)
        if leaf_needed:
            if source.has_rollout:
                leaf = source.rollout(state, edge.action, seen, depth, horizon, options.discount)
            else:
                leaf = self.random_rollout(state, depth)
        for edge, reward in reversed(path):
            leaf = reward + options.discount * leaf
            edge.visits += 1
            edge.value += (leaf - edge.value) / edge.visits

    def random_rollout(self, state: Any, depth: int) -> float:
        total, weight = 0.0, 1.0
        for _ in range(depth, self.options.horizon):
            state, _seen, reward, terminal = self.source.step(state, self.source.stream.below(self.model.actions))
            self.steps += 1
            total += weight * reward
            if terminal:
                break
            weight *= self.options.discount
        return total

    def tree(self) -> SearchTree:
        nodes, edges = np.empty(len(self.nodes), dtype=NODE), np.empty(len(self.edges), dtype=EDGE)
        nodes["sibling"] = edges["child"] = NO_CHILD
        for i, node in enumerate(self.nodes):
            count = 0 if node.edges is None else len(node.edges)
            nodes[["observation", "visits", "first_edge", "edge_count"]][i] = (i, node.visits, node.first_edge, count)
        for i, edge in enumerate(self.edges):
            edges[["value", "visits"]][i] = edge.value, edge.visits
            numbers = [child.number for child in reversed(edge.children)]
            if numbers:
                edges["child"][i] = numbers[0]
                nodes["sibling"][numbers[:-1]] = numbers[1:]
        return SearchTree(nodes, edges, np.array([edge.action for edge in self.edges], dtype=np.int32), None)


def search_in_python(
    model: Any, options: PomcpowOptions, belief: Any, rng: np.random.Generator, start: SearchTree
) -> Search:
    """The search, interpreted; workers take turns."""
    searches, seen, first = list[Search](), list[Any](), dict[Any, int]()
    for simulations, node_cap, stream in shares(options.simulations, options.max_nodes, options.workers, rng):
        kind = _CompiledSource if isinstance(model, ContinuousModel) else _PythonSource
        began, portion = time.perf_counter(), portion_of(belief, simulations, options.seconds)
        source = kind(model, portion, belief, stream)
        row_cap = max(FIRST_ROOM, options.max_particles // options.workers)
        search = _Search(model, options, source, node_cap, row_cap)
        search.nodes.append(_Node(0, None))
        search.nodes[0].visits = 0
        search.plant(search.nodes[0], start.edge_actions.tolist())
        done, timed_out = _run(search, simulations, portion, stream, began)
        tree = search.tree()
        # Equal observations of several workers have the number of the first; a root's is no observation.
        own = len(seen) + np.arange(len(tree))
        if options.workers > 1:
            own[1:] = [first.setdefault(node.seen, len(seen) + node.number) for node in search.nodes[1:]]
        tree.nodes["observation"] = own
        seen += [node.seen for node in search.nodes]
        stopped: Stopped = "seconds" if timed_out else "simulations"
        searches.append(Search(tree, done, search.deepest, search.steps, stopped, len(tree) >= node_cap))
    whole = merged(searches, start, options.max_nodes)
    flat = [s[0] if isinstance(s, tuple) and len(s) == 1 else s for s in seen]
    tree = SearchTree(whole.tree.nodes, whole.tree.edges, whole.tree.edge_actions, tuple(flat))
    return Search(tree, whole.simulations, whole.depth, whole.steps, whole.stopped, whole.full)


def _run(search: _Search, simulations: int, portion: int, rng: np.random.Generator, began: float) -> tuple[int, bool]:
    """(simulations run, whether time was up before the last); the clock runs since `began`, when the belief was asked."""
    seconds, done = search.options.seconds, 0
    deadline = None if seconds is None else began + seconds
    with np.errstate(over="ignore"):  # a model's random words wrap round
        for block in starts(search.source, simulations, portion, rng):
            for particle in block.tolist():
                search.simulate(particle)
                done += 1
                if deadline is not None and done < simulations and time.perf_counter() >= deadline:
                    return done, True
    return done, False
