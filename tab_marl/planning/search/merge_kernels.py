# mypy: ignore-errors
"""Laying one search tree over another: counts add up, values are averaged by count."""

from __future__ import annotations

import numpy as np
from numba import njit

from tab_marl.planning.search.kernels import EDGES, NO_CHILD, NODES, UNEXPANDED, enter, find_child


@njit(cache=True, nogil=True)
def add_edge(edges, edge, value, visits):
    """Adds `visits` returns of mean `value` to the edge."""
    total = edges[edge]["visits"] + visits
    if total > 0:
        edges[edge]["value"] += (value - edges[edge]["value"]) * visits / total
    edges[edge]["visits"] = total


@njit(cache=True, nogil=True)
def overlay(
    nodes, edges, edge_actions, parents, table, used, other_nodes, other_edges, other_actions, start_nodes, start_edges, place,
):  # fmt: skip
    """Adds the other tree to this one (arrays with room for both). Both grew out of `start`, whose ids they kept: it counts once.

    `place` [other nodes] is scratch: where each went. A node's id is greater than its parent's, so one pass will do. An action
    that this tree's node lacks (a prior that forbids by hidden state) is left out, with what is below it.
    """
    place[:] = NO_CHILD
    place[0] = 0
    for other in range(len(other_nodes)):
        node = place[other]
        if node < 0:
            continue
        old = start_nodes[other]["visits"] if other < len(start_nodes) else 0
        nodes[node]["visits"] += other_nodes[other]["visits"] - old
        other_first = other_nodes[other]["first_edge"]
        if other_first == UNEXPANDED:
            continue
        count = other_nodes[other]["edge_count"]
        if nodes[node]["first_edge"] == UNEXPANDED:
            nodes[node]["first_edge"] = used[EDGES]
            nodes[node]["edge_count"] = count
            for k in range(count):
                edge = used[EDGES] + k
                edges[edge]["value"] = 0.0
                edges[edge]["visits"] = 0
                edges[edge]["child"] = NO_CHILD
                edge_actions[edge] = other_actions[other_first + k]
            used[EDGES] += count
        first = nodes[node]["first_edge"]
        mine = nodes[node]["edge_count"]
        for k in range(count):
            theirs = other_first + k
            edge = NO_CHILD
            if k < mine and edge_actions[first + k] == other_actions[theirs]:
                edge = first + k
            else:
                for candidate in range(first, first + mine):
                    if edge_actions[candidate] == other_actions[theirs]:
                        edge = candidate
            if edge == NO_CHILD:
                continue
            visits = other_edges[theirs]["visits"]
            value = other_edges[theirs]["value"]
            if theirs < len(start_edges) and start_edges[theirs]["visits"] > 0:
                before = start_edges[theirs]["visits"]
                if visits > before:
                    value = (value * visits - start_edges[theirs]["value"] * before) / (visits - before)
                visits -= before
            add_edge(edges, edge, value, visits)
            child = other_edges[theirs]["child"]
            while child >= 0:
                observation = other_nodes[child]["observation"]
                found = find_child(nodes, edges, parents, table, edge, observation)
                if found < 0:
                    found = np.int32(used[NODES])
                    used[NODES] += 1
                    nodes[found]["observation"] = observation
                    nodes[found]["sibling"] = edges[edge]["child"]
                    nodes[found]["visits"] = 0
                    nodes[found]["first_edge"] = UNEXPANDED
                    nodes[found]["edge_count"] = 0
                    edges[edge]["child"] = found
                    parents[found] = edge
                    enter(nodes, parents, table, found)
                place[child] = found
                child = other_nodes[child]["sibling"]
