# mypy: ignore-errors
"""The compiled POMCP search: one function, compiled once per type of model data and cached on disk.

The model enters as first-class function types (numba passes a pointer with a known signature), never as a jitted function or
a closure, which would compile anew in every process. Nothing here raises; `tab_marl.planning.search.pomcp` validates, and
`tab_marl.planning.search.interpreted` is the slow twin that must build the identical tree.
"""

# mypy: allow-untyped-defs, allow-untyped-calls, allow-untyped-decorators, no-check-untyped-defs

from __future__ import annotations

import math

import numpy as np
from numba import njit

from tab_marl.planning.random_kernels import GOLDEN, below, mixed

NO_CHILD = -1
NO_SIBLING = -1
UNEXPANDED = -1

# What `used` counts.
NODES, EDGES, DEEPEST, TREE_STEPS, ROLLOUT_STEPS = 0, 1, 2, 3, 4


@njit(cache=True, nogil=True)
def select(nodes, edges, node, exploration, root_log, inverse_root, rng):
    """The edge to follow from an expanded node: an untried one at random, else the greatest upper bound (UCB1).

    `root_log` and `inverse_root` [M] hold sqrt(log n) and 1 / sqrt(n) for n < M: roots and logarithms of small counts would
    take a third of the search.
    """
    first = nodes[node]["first_edge"]
    count = nodes[node]["edge_count"]
    total = nodes[node]["visits"]
    known = len(inverse_root)
    factor = exploration * (root_log[total] if total < known else math.sqrt(math.log(total)))
    untried = 0
    for edge in range(first, first + count):
        untried += 1 if edges[edge]["visits"] == 0 else 0
    if untried == 0:
        best = first
        best_score = -math.inf
        for edge in range(first, first + count):
            visits = edges[edge]["visits"]
            score = edges[edge]["value"] + factor * (
                inverse_root[visits] if visits < known else 1.0 / math.sqrt(visits)
            )
            # No branch on the comparison: no processor could foresee it.
            better = score > best_score
            best = edge if better else best
            best_score = score if better else best_score
        return best
    chosen = below(rng, untried)
    for edge in range(first, first + count):
        if edges[edge]["visits"] == 0:
            if chosen == 0:
                return edge
            chosen -= 1
    return first


@njit(cache=True, nogil=True)
def expand(
    prior, data, state, action, observation, depth, actions, nodes, edges, edge_actions, used, node, values, counts
):
    """Gives the node its edges: all actions, or those the model's prior does not forbid, with its values and pseudo-counts."""
    first = used[EDGES]
    edge = first
    if prior is None:
        for a in range(actions):
            edges[edge]["value"] = 0.0
            edges[edge]["visits"] = 0
            edges[edge]["child"] = NO_CHILD
            edge_actions[edge] = a
            edge += 1
    else:
        values[:] = 0.0
        counts[:] = 0
        prior(state, action, observation, depth, data, values, counts)
        for a in range(actions):
            if counts[a] >= 0:
                edges[edge]["value"] = values[a]
                edges[edge]["visits"] = counts[a]
                edges[edge]["child"] = NO_CHILD
                edge_actions[edge] = a
                nodes[node]["visits"] += counts[a]
                edge += 1
    nodes[node]["first_edge"] = first
    nodes[node]["edge_count"] = edge - first
    used[EDGES] = edge


@njit(cache=True, nogil=True)
def slot_of(edge, observation, size):
    """Where the search for (edge, observation) starts in a table of `size` slots, a power of two."""
    key = np.uint64(observation) ^ (np.uint64(edge) * GOLDEN)
    return np.int64(np.uint64(mixed(key)) & np.uint64(size - 1))


@njit(cache=True, nogil=True)
def enter(nodes, parents, table, node):
    """Puts the node into the table by which `find_child` finds children of edges that have many."""
    size = len(table)
    slot = slot_of(parents[node], nodes[node]["observation"], size)
    while table[slot] >= 0:
        slot = (slot + 1) & (size - 1)
    table[slot] = node


@njit(cache=True, nogil=True)
def find_child(nodes, edges, parents, table, edge, observation):
    """The node reached by this edge and observation, or NO_CHILD: from the table if there is one, else along the siblings.

    Most problems have a few observations, whose nodes lie close together; some (LaserTag) have thousands, and a walk would be
    quadratic. A table in the one kernel would cost the others a third of their speed, so it is compiled in only where it is given.
    """
    if table is None:
        child = edges[edge]["child"]
        while child >= 0 and nodes[child]["observation"] != observation:
            child = nodes[child]["sibling"]
        return child
    else:
        size = len(table)
        slot = slot_of(edge, observation, size)
        while table[slot] >= 0:
            candidate = table[slot]
            if parents[candidate] == edge and nodes[candidate]["observation"] == observation:
                return candidate
            slot = (slot + 1) & (size - 1)
        return np.int32(NO_CHILD)


@njit(cache=True, nogil=True)
def most_children(nodes, edges):
    """The most children that an edge of the root has."""
    most = 0
    for edge in range(nodes[0]["first_edge"], nodes[0]["first_edge"] + nodes[0]["edge_count"]):
        count = 0
        child = edges[edge]["child"]
        while child >= 0:
            count += 1
            child = nodes[child]["sibling"]
        most = max(most, count)
    return most


@njit(cache=True, nogil=True)
def enter_all(nodes, edges, edge_count, node_count, parents, table):
    """Fills `parents` [nodes] (NO_CHILD at the root) and the table anew."""
    table[:] = NO_CHILD
    parents[0] = NO_CHILD
    for edge in range(edge_count):
        child = edges[edge]["child"]
        while child >= 0:
            parents[child] = edge
            child = nodes[child]["sibling"]
    for node in range(1, node_count):
        enter(nodes, parents, table, node)


@njit(cache=True, nogil=True)
def random_rollout(step, data, state, depth, max_depth, discount, actions, rng, model_rng, used):
    """The discounted return of uniformly random actions until the end, counted from now."""
    total = 0.0
    weight = 1.0
    for _ in range(depth, max_depth):
        _observation, reward, terminal = step(state, below(rng, actions), data, model_rng)
        used[ROLLOUT_STEPS] += 1
        total += weight * reward
        if terminal:
            break
        weight *= discount
    return total


@njit(cache=True, nogil=True)
def search(
    step, rollout, prior, data, states, particles, seeds, actions, exploration, discount, max_depth, tree_depth,
    may_grow, nodes, edges, edge_actions, parents, table, used, root_log, inverse_root, rng, model_rng, state, path_edges, path_rewards, values, counts,
):  # fmt: skip
    """Simulations from `particles` [n] (rows of `states` [P, D]) until done or until the arrays are full and may grow.

    `seeds` uint64[P]: the model's randomness at each depth of a particle's simulation (empty: a fresh stream throughout).
    Returns how many simulations were run. The root (node 0) is expanded by the caller.
    """
    last_action = np.int64(-1)
    size = states.shape[1]
    for i in range(len(particles)):
        room = used[NODES] < len(nodes) and used[EDGES] + actions <= len(edges)
        if may_grow and not room:
            return i
        particle = particles[i]
        for d in range(size):
            state[d] = states[particle, d]
        node = np.int64(0)
        depth = 0
        leaf = 0.0
        last_action = np.int64(-1)
        observation = np.int64(0)
        while True:
            nodes[node]["visits"] += 1
            if nodes[node]["edge_count"] == 0:
                # Every action is forbidden here (or the root has none): the leaf estimate stands for what follows.
                leaf_needed = True
                break
            edge = select(nodes, edges, node, exploration, root_log, inverse_root, rng)
            # Where all actions are open, an edge's place says its action, and a cache line is saved.
            if nodes[node]["edge_count"] == actions:
                action = np.int64(edge - nodes[node]["first_edge"])
            else:
                action = np.int64(edge_actions[edge])
            if len(seeds) > 0:
                model_rng[0] = mixed(seeds[particle] + np.uint64(depth) * GOLDEN)
            observation, reward, terminal = step(state, action, data, model_rng)
            last_action = action
            path_edges[depth] = edge
            path_rewards[depth] = reward
            depth += 1
            leaf_needed = False
            if terminal or depth == max_depth:
                break
            child = find_child(nodes, edges, parents, table, edge, observation)
            leaf_needed = True
            if child < 0:
                if room and depth <= tree_depth:
                    child = used[NODES]
                    used[NODES] += 1
                    nodes[child]["observation"] = observation
                    nodes[child]["sibling"] = edges[edge]["child"]
                    nodes[child]["visits"] = 1
                    nodes[child]["first_edge"] = UNEXPANDED
                    nodes[child]["edge_count"] = 0
                    edges[edge]["child"] = child
                    if table is not None:
                        parents[child] = edge
                        enter(nodes, parents, table, child)
                break
            if nodes[child]["first_edge"] == UNEXPANDED:
                # Edges are made at the second visit: most nodes are visited once, and memory is what large trees wait for.
                if not room:
                    nodes[child]["visits"] += 1
                    break
                expand(prior, data, state, action, observation, depth, actions, nodes, edges, edge_actions, used,
                       child, values, counts)  # fmt: skip
            node = child
        used[TREE_STEPS] += depth
        used[DEEPEST] = max(used[DEEPEST], depth)
        if leaf_needed:
            if len(seeds) > 0:
                model_rng[0] = mixed(seeds[particle] + np.uint64(depth) * GOLDEN)
            if rollout is None:
                leaf = random_rollout(step, data, state, depth, max_depth, discount, actions, rng, model_rng, used)
            else:
                leaf = rollout(state, last_action, observation, depth, max_depth, discount, data, model_rng)
        for d in range(depth - 1, -1, -1):
            leaf = path_rewards[d] + discount * leaf
            edge = path_edges[d]
            edges[edge]["visits"] += 1
            edges[edge]["value"] += (leaf - edges[edge]["value"]) / edges[edge]["visits"]
    return len(particles)


@njit(cache=True, nogil=True)
def keep_matching(step, data, states, particles, action, observation, model_rng, state, kept, found):
    """Steps the particles in turn and appends to `kept` those that gave the observation and did not end; returns how many."""
    for i in range(len(particles)):
        if found == len(kept):
            break
        state[:] = states[particles[i]]
        seen, _reward, terminal = step(state, np.int64(action), data, model_rng)
        if seen == observation and not terminal:
            kept[found] = state
            found += 1
    return found


@njit(cache=True)
def copy_subtree(nodes, edges, edge_actions, root, keep, new_nodes, new_edges, new_actions, queue):
    """Copies the tree below node `root`, breadth first; of the root's edges only actions with `keep` [A].

    `queue` [nodes] is scratch. Returns (nodes, edges) copied.
    """
    queue[0] = root
    new_nodes[0] = nodes[root]
    new_nodes[0]["sibling"] = NO_SIBLING
    node_count = 1
    edge_count = 0
    done = 0
    while done < node_count:
        old = queue[done]
        if nodes[old]["first_edge"] != UNEXPANDED:
            new_nodes[done]["first_edge"] = edge_count
            for edge in range(nodes[old]["first_edge"], nodes[old]["first_edge"] + nodes[old]["edge_count"]):
                if done == 0 and not keep[edge_actions[edge]]:
                    continue
                new_edges[edge_count] = edges[edge]
                new_actions[edge_count] = edge_actions[edge]
                child = edges[edge]["child"]
                if child != NO_CHILD:
                    new_edges[edge_count]["child"] = node_count
                while child != NO_CHILD:
                    queue[node_count] = child
                    new_nodes[node_count] = nodes[child]
                    following = nodes[child]["sibling"]
                    new_nodes[node_count]["sibling"] = node_count + 1 if following != NO_SIBLING else NO_SIBLING
                    node_count += 1
                    child = following
                edge_count += 1
            new_nodes[done]["edge_count"] = edge_count - new_nodes[done]["first_edge"]
        done += 1
    return node_count, edge_count
