"""The scenario search in plain Python: for models that are Python classes, and as the slow twin of `despot_kernels`."""

from __future__ import annotations

import copy
import math
import time
from collections.abc import Hashable
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from tab_marl.planning.model import CompiledModel, belief_objects, belief_states, numbered
from tab_marl.planning.search import despot_kernels as kernels
from tab_marl.planning.search.despot_rewards import check_met, trivial_rewards
from tab_marl.planning.search.interpreted import Stream, mixed
from tab_marl.planning.search.kernels import NO_CHILD, UNEXPANDED
from tab_marl.planning.search.plan import Search, Stopped

if TYPE_CHECKING:
    from tab_marl.planning.search.despot import DespotOptions

_MASK = 2**64 - 1
_GOLDEN = 0x9E3779B97F4A7C15
_OTHER = 0x5851F42D4C957F2D


class _CompiledSource:
    """A compiled model's functions, interpreted, with the random numbers that the kernel would give them."""

    def __init__(self, model: CompiledModel, options: DespotOptions, belief: Any, rng: np.random.Generator) -> None:
        self.model, self.word = model, np.zeros(1, dtype=np.uint64)
        self.states, self.weights = belief_states(model, belief, options.scenarios, rng)

    def seed(self, seed: int, depth: int) -> None:
        self.word[0] = mixed((seed + depth * _GOLDEN) & _MASK)

    def step(self, state: Any, action: int) -> tuple[Any, Hashable, float, bool]:
        after = state.copy()
        function = _plain(self.model.step)
        observation, reward, terminal = function(after, action, self.model.data, self.word)
        return after, numbered(observation, function), float(reward), bool(terminal)

    def rollout(self, state: Any, action: int, seen: Any, depth: int, max_depth: int, discount: float) -> float:
        function = _plain(self.model.rollout)
        return float(function(state.copy(), action, seen, depth, max_depth, discount, self.model.data, self.word))

    def upper(self, state: Any, depth: int, max_depth: int, discount: float) -> float:
        return float(_plain(self.model.upper)(state.copy(), depth, max_depth, discount, self.model.data))


class _PythonSource:
    """A model that is a Python class."""

    def __init__(self, model: Any, options: DespotOptions, belief: Any, rng: np.random.Generator) -> None:
        self.model = model
        self.states, self.weights = belief_objects(belief, options.scenarios, rng)

    def seed(self, seed: int, depth: int) -> None:
        self.rng = np.random.default_rng((seed, depth))

    def step(self, state: Any, action: int) -> tuple[Any, Hashable, float, bool]:
        result: tuple[Any, Hashable, float, bool] = self.model.step(copy.copy(state), action, self.rng)
        return result

    def rollout(self, state: Any, action: int, seen: Any, depth: int, max_depth: int, discount: float) -> float:
        return float(self.model.rollout(copy.copy(state), action, seen, depth, max_depth, discount, self.rng))

    def upper(self, state: Any, depth: int, max_depth: int, discount: float) -> float:
        return float(self.model.upper(copy.copy(state), depth, max_depth, discount))


def _plain(function: Any) -> Any:
    return getattr(function, "py_func", function)


@dataclass
class _Edge:
    action: int
    reward: float = 0.0
    children: list[_Node] = field(default_factory=list)
    """Newest first."""
    lower: float = 0.0
    upper: float = 0.0


@dataclass
class _Node:
    number: int
    depth: int
    seen: Any
    held: list[tuple[Any, int]] = field(default_factory=list)
    """(state, scenario number)."""
    edges: list[_Edge] | None = None
    first_edge: int = UNEXPANDED
    lower: float = 0.0
    upper: float = 0.0
    raw: float = 0.0
    default: float = 0.0


class _Search:
    def __init__(
        self, model: Any, options: DespotOptions, source: Any, root_actions: list[int], seeds: list[int]
    ) -> None:
        self.model, self.options, self.source, self.seeds = model, options, source, seeds
        self.root_actions, self.horizon = root_actions, options.horizon
        self.powers = np.cumprod([1.0, *[options.discount] * self.horizon]).tolist()
        self.nodes: list[_Node] = []
        self.edges: list[_Edge] = []
        self.rows = options.scenarios
        self.expansions = self.steps = self.deepest = self.trials = 0
        self.has_rollout = getattr(model, "rollout", None) is not None
        self.has_upper = getattr(model, "upper", None) is not None
        self.bounds, self.met = trivial_rewards(model, options), [math.inf, -math.inf]

    def add(self, depth: int, seen: Any) -> _Node:
        self.nodes.append(_Node(len(self.nodes), depth, seen))
        return self.nodes[-1]

    def meet(self, reward: float) -> None:
        self.met = [min(self.met[0], reward), max(self.met[1], reward)]

    def trivial(self, reward: float, depth: int) -> float:
        discount = self.options.discount
        if discount == 1.0:
            return reward * (self.horizon - depth)
        return float(reward * (1.0 - self.powers[self.horizon - depth]) / (1.0 - discount))

    def default_value(self, state: Any, action: int, seen: Any, depth: int, seed: int) -> float:
        self.source.seed(seed, depth)
        discount = self.options.discount
        if self.has_rollout:
            return float(self.source.rollout(state, action, seen, depth, self.horizon, discount))
        stream = Stream(mixed(((seed ^ _OTHER) + depth * _GOLDEN) & _MASK))
        total, weight = 0.0, 1.0
        for _ in range(depth, self.horizon):
            state, _seen, reward, terminal = self.source.step(state, stream.below(self.model.actions))
            self.steps += 1
            self.meet(reward)
            total += weight * reward
            if terminal:
                break
            weight *= discount
        return total

    def bound(self, node: _Node, action: int) -> None:
        least, greatest = self.bounds
        low = high = 0.0
        for state, scenario in node.held:
            high += (
                self.source.upper(state, node.depth, self.horizon, self.options.discount)
                if self.has_upper
                else self.trivial(greatest, node.depth)
            )
            low += (
                self.trivial(least, node.depth)
                if self.options.lower == "trivial"
                else self.default_value(state, action, node.seen, node.depth, self.seeds[scenario])
            )
        scale = self.powers[node.depth] / self.options.scenarios
        node.default = node.lower = scale * low
        node.raw = max(scale * low, scale * high)
        node.upper = max(scale * low, scale * high - self.options.regularisation)

    def expand(self, node: _Node) -> None:
        actions = self.root_actions if node.number == 0 else range(self.model.actions)
        node.edges, node.first_edge = [_Edge(action) for action in actions], len(self.edges)
        self.edges += node.edges
        for edge in node.edges:
            met: dict[Any, _Node] = {}
            total = 0.0
            for state, scenario in node.held:
                self.source.seed(self.seeds[scenario], node.depth)
                after, seen, reward, terminal = self.source.step(state, edge.action)
                self.meet(reward)
                total += reward
                if terminal or node.depth + 1 >= self.horizon:
                    continue
                if seen not in met:
                    met[seen] = self.add(node.depth + 1, seen)
                met[seen].held.append((after, scenario))
                self.rows += 1
            self.steps += len(node.held)
            edge.reward = self.powers[node.depth] / self.options.scenarios * total - self.options.regularisation
            edge.children = list(met.values())[::-1]
            for child in edge.children:
                self.bound(child, edge.action)
        self.deepest = max(self.deepest, node.depth + 1)
        self.expansions += 1

    def back_up(self, node: _Node) -> None:
        if node.edges is None:
            return
        low = high = raw = node.default
        for edge in node.edges:
            edge.lower = edge.upper = edge.reward
            edge_raw = edge.reward + self.options.regularisation
            for child in edge.children:
                edge.lower += child.lower
                edge.upper += child.upper
                edge_raw += child.raw
            low, high, raw = max(low, edge.lower), max(high, edge.upper), max(raw, edge_raw)
        node.lower = max(node.lower, low)
        node.upper = max(node.lower, min(node.upper, high))
        node.raw = max(node.lower, min(node.raw, raw))

    def pruned(self, path: list[_Node]) -> bool:
        at, penalty = len(path) - 1, self.options.regularisation
        return penalty > 0 and any(x.raw - x.default <= penalty * (at - i) for i, x in enumerate(path[:-1]))

    def run(self, deadline: float | None) -> Stopped:
        """Trials until something ends the search."""
        options, root = self.options, self.nodes[0]
        grew = True
        while True:
            # The root is expanded in any case: the plan needs values of actions.
            if root.edges is not None and (root.upper - root.lower <= options.gap or not grew):
                return "closed"
            if self.trials >= options.trials:
                return "simulations"
            grew, path, end = False, [root], None
            while end is None:
                node = path[-1]
                target = options.share * (root.upper - root.lower)
                going = len(path) == 1 or self.excess(node, target) > 0
                if going and len(path) > 1 and (node.depth >= options.deepest_node or self.pruned(path)):
                    if node.upper > node.lower:
                        node.upper = node.raw = node.lower
                        grew = True
                    going = False
                if going and node.edges is None:
                    needed = len(node.held) * self.model.actions
                    if len(self.nodes) + needed > options.max_nodes or self.rows + needed > options.max_rows:
                        end = "full"
                        break
                    if deadline is not None and self.expansions and time.perf_counter() >= deadline:
                        end = "seconds"
                        break
                    self.expand(node)
                    grew = True
                    self.back_up(node)
                following = None
                if going and node.edges:
                    best = max(node.edges, key=lambda edge: edge.upper)
                    if best.children:
                        following = max(best.children, key=lambda child: self.excess(child, target))
                if following is None:
                    break
                path.append(following)
            for node in reversed(path):
                self.back_up(node)
            if end is not None:
                stopped: Stopped = "full" if end == "full" else "seconds"
                return stopped
            self.trials += 1

    def excess(self, node: _Node, target: float) -> float:
        return node.upper - node.lower - len(node.held) / self.options.scenarios * target


def search_in_python(
    model: Any, options: DespotOptions, belief: Any, rng: np.random.Generator, root_actions: NDArray[np.int64]
) -> Search:
    """The search, interpreted."""
    from tab_marl.planning.search.despot import DESPOT_EDGE, DESPOT_NODE, drawn_scenarios, finished, powers_of

    whole = isinstance(model, CompiledModel)
    source = (_CompiledSource if whole else _PythonSource)(model, options, belief, rng)
    start, seeds = drawn_scenarios(options.scenarios, len(source.states), source.weights, rng)
    search = _Search(model, options, source, root_actions.tolist(), seeds.tolist())
    root = search.add(0, 0)
    root.held = [(source.states[i], k) for k, i in enumerate(start.tolist())]
    with np.errstate(over="ignore"):  # a model's random words wrap round
        search.bound(root, -1)
        stopped = search.run(None if options.seconds is None else time.perf_counter() + options.seconds)
    check_met(model, options, *search.met)
    nodes, edges = np.zeros(len(search.nodes), dtype=DESPOT_NODE), np.zeros(len(search.edges), dtype=DESPOT_EDGE)
    nodes["sibling"] = edges["child"] = NO_CHILD
    for i, node in enumerate(search.nodes):
        seen = node.seen if whole else i
        count = 0 if node.edges is None else len(node.edges)
        nodes[["observation", "lower", "upper", "scenarios", "depth", "first_edge", "edge_count"]][i] = (
            seen, node.lower, node.upper, len(node.held), node.depth, node.first_edge, count,
        )  # fmt: skip
    for i, edge in enumerate(search.edges):
        edges[["reward", "lower", "upper"]][i] = (edge.reward, edge.lower, edge.upper)
        numbers = [child.number for child in edge.children]
        if numbers:
            edges["child"][i] = numbers[0]
            nodes["sibling"][numbers[:-1]] = numbers[1:]
    used = np.zeros(9, dtype=np.int64)
    used[kernels.TRIALS], used[kernels.DEEPEST], used[kernels.STEPS] = search.trials, search.deepest, search.steps
    observations = None if whole else tuple(node.seen for node in search.nodes)
    edge_actions = np.array([edge.action for edge in search.edges], dtype=np.int32)
    return finished(nodes, edges, edge_actions, options, powers_of(options), used, stopped, observations)
