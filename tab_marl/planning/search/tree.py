"""The search tree: flat arrays of nodes and edges with integer ids.

A *node* is a history that ends in an observation; its *edges* are the actions tried there, stored side by side. The children
of an edge (one per observation met) are a linked list through ``sibling``, newest first. Node 0 is the root.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from tab_marl.planning.search.kernels import NO_CHILD, NO_SIBLING, UNEXPANDED, copy_subtree

ROOT = 0
NO_PARENT = -1

NODE = np.dtype(
    [
        ("observation", np.int64),  # the observation that leads here
        ("sibling", np.int32),  # next child of the same edge, or NO_SIBLING
        ("visits", np.int32),  # simulations that came through, and the prior's pseudo-counts
        ("first_edge", np.int32),  # or UNEXPANDED: visited once, a leaf
        ("edge_count", np.int32),  # actions allowed here
    ]
)
"""24 bytes. 1,000 to 10,000 simulations should stay in a core's cache."""

EDGE = np.dtype(
    [
        ("value", np.float64),  # mean return from here, action included
        ("visits", np.int32),  # simulations, and the prior's pseudo-count
        ("child", np.int32),  # newest child, or NO_CHILD
    ]
)
"""16 bytes; the action's number is kept beside it in ``edge_actions``."""


@dataclass(frozen=True, eq=False)
class Readings:
    """Observations that are vectors, by number: a float where they have one component, else a tuple."""

    rows: NDArray[np.float64]
    """``[numbers, O]``."""

    def __len__(self) -> int:
        return len(self.rows)

    def __getitem__(self, number: int) -> float | tuple[float, ...]:
        row = self.rows[number].tolist()
        return float(row[0]) if len(row) == 1 else tuple(row)


@dataclass(frozen=True, eq=False)
class SearchTree:
    """What a search has learnt. Arrays may be shared with the search: treat them as read-only."""

    nodes: NDArray[np.void]
    """``[nodes]`` of dtype NODE."""
    edges: NDArray[np.void]
    """``[edges]`` of dtype EDGE."""
    edge_actions: NDArray[np.int32]
    """``[edges]``."""
    observations: tuple[object, ...] | Readings | None = None
    """What observation number i was, where they are objects or vectors (else observations are numbers already)."""
    bounds: NDArray[np.float64] | None = None
    """``[nodes, 2]`` lower and upper bound of the return from each node on, where the search keeps bounds (DESPOT). There an
    edge's value is its lower bound, and visits count scenarios."""

    @classmethod
    def planted(cls, actions: NDArray[np.int64], values: NDArray[np.float64], visits: NDArray[np.int64]) -> SearchTree:
        """A root with these actions, as if tried `visits` times with that mean return."""
        nodes, edges = np.empty(1, dtype=NODE), np.empty(len(actions), dtype=EDGE)
        nodes[ROOT] = (0, NO_SIBLING, visits.sum(), 0, len(actions))
        edges["value"], edges["visits"], edges["child"] = values, visits, NO_CHILD
        return cls(nodes, edges, actions.astype(np.int32))

    def __len__(self) -> int:
        return len(self.nodes)

    def edges_of(self, node: int) -> range:
        """Ids of the node's edges; empty where it is a leaf."""
        self._check(node)
        first = int(self.nodes["first_edge"][node])
        return range(0) if first == UNEXPANDED else range(first, first + int(self.nodes["edge_count"][node]))

    def children(self, edge: int) -> Iterator[int]:
        """Ids of the nodes that this edge led to, newest first."""
        child = int(self.edges["child"][edge])
        while child != NO_CHILD:
            yield child
            child = int(self.nodes["sibling"][child])

    def edge(self, node: int, action: int) -> int:
        """The id of the node's edge for this action; KeyError when it is not allowed there or the node is a leaf."""
        for edge in self.edges_of(node):
            if self.edge_actions[edge] == action:
                return edge
        raise KeyError(f"node {node} has no edge for action {action}")

    def child(self, node: int, action: int, observation: object) -> int:
        """The id of the node after action and observation, or NO_CHILD."""
        for child in self.children(self.edge(node, action)):
            if self.observation(child) == observation:
                return child
        return NO_CHILD

    def observation(self, node: int) -> object:
        """The observation that leads to this node, as the model gave it."""
        number = int(self.nodes["observation"][node])
        return number if self.observations is None else self.observations[number]

    @cached_property
    def parent_edge(self) -> NDArray[np.int32]:
        """``[nodes]``: the edge that leads to each node; NO_PARENT at the root."""
        parents = np.full(len(self.nodes), NO_PARENT, dtype=np.int32)
        # One link of every sibling list at a time: as many rounds as the longest list.
        edge = np.flatnonzero(self.edges["child"] != NO_CHILD)
        node = self.edges["child"][edge]
        while len(node):
            parents[node] = edge
            following = self.nodes["sibling"][node]
            more = following != NO_SIBLING
            edge, node = edge[more], following[more]
        return parents

    def after(self, action: int, observation: object) -> SearchTree | None:
        """The tree below the node that action and observation lead to, for the next plan; None where nothing was learnt."""
        try:
            node = self.child(ROOT, action, observation)
        except KeyError:
            return None
        return None if node == NO_CHILD or not self.edges_of(node) else self.subtree(node)

    def subtree(self, node: int, allowed: NDArray[np.int64] | None = None) -> SearchTree:
        """A copy of the tree below a node, which becomes the root; of the root's actions only those `allowed`."""
        self._check(node)
        keep = np.ones(int(self.edge_actions.max(initial=0)) + 1, dtype=np.bool_)
        if allowed is not None:
            keep[:] = False
            keep[allowed[allowed < len(keep)]] = True
        nodes, edges, actions = np.empty_like(self.nodes), np.empty_like(self.edges), np.empty_like(self.edge_actions)
        queue = np.empty(len(self.nodes), dtype=np.int64)
        n, e = copy_subtree(self.nodes, self.edges, self.edge_actions, node, keep, nodes, edges, actions, queue)
        nodes["observation"][ROOT] = 0  # as in a fresh tree: what led to the root is no part of it
        nodes["visits"][ROOT] = edges["visits"][: nodes["edge_count"][ROOT]].sum()
        return SearchTree(nodes[:n].copy(), edges[:e].copy(), actions[:e].copy(), self.observations)

    def best_edge(self, node: int) -> int | None:
        """The tried edge of greatest value (ties: more visits, then the lower action); None at a leaf."""
        tried = [e for e in self.edges_of(node) if self.edges["visits"][e] > 0]
        if not tried:
            return None
        return max(tried, key=lambda e: (self.edges["value"][e], self.edges["visits"][e], -int(self.edge_actions[e])))

    def best_line(self, node: int = ROOT) -> list[tuple[int, object]]:
        """Best action, its commonest observation, and so on: ``[(action, observation), ...]``; the last has observation None."""
        line: list[tuple[int, object]] = []
        while True:
            edge = self.best_edge(node)
            if edge is None:
                return line
            followers = list(self.children(edge))
            if not followers:
                line.append((int(self.edge_actions[edge]), None))
                return line
            node = max(followers, key=lambda n: int(self.nodes["visits"][n]))
            line.append((int(self.edge_actions[edge]), self.observation(node)))

    def _check(self, node: int) -> None:
        if not 0 <= node < len(self.nodes):
            raise IndexError(f"node {node} is not in the tree of {len(self.nodes)} nodes")
