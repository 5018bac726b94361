# mypy: ignore-errors
"""The compiled POMCPOW search. Nothing here raises; `tab_marl.planning.search.pomcpow` validates, and
`tab_marl.planning.search.pomcpow_interpreted` is the slow twin that must build the identical tree.

Every node but the root keeps a belief: weighted particles (state, reward of the step that led there) side by side in a pool, with
cumulative weights; when its place is full, the belief moves to one twice as large at the pool's end.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from tab_marl.planning.random_kernels import below, uniform
from tab_marl.planning.search.kernels import NO_CHILD, UNEXPANDED, select

# What `used` counts; BROKEN is set where a likelihood was no number >= 0, or 0 for the very observation that step wrote.
NODES, EDGES, ROWS, DEEPEST, STEPS, LARGEST, BROKEN = range(7)
FIRST_ROOM = 4
"""Particles that a new node has room for."""


@njit(cache=True, nogil=True)
def plant_edges(nodes, edges, edge_actions, widths, actions, used, node):
    """Gives the node all actions, untried."""
    first = used[EDGES]
    for a in range(actions):
        edges[first + a]["value"] = 0.0
        edges[first + a]["visits"] = 0
        edges[first + a]["child"] = NO_CHILD
        edge_actions[first + a] = a
        widths[first + a, 0] = 0
        widths[first + a, 1] = 0
    nodes[node]["first_edge"] = first
    nodes[node]["edge_count"] = actions
    used[EDGES] = first + actions


@njit(cache=True, nogil=True)
def insert(beliefs, node, pool_states, pool_rewards, pool_weights, used, state, reward, weight):
    """Adds a particle to the node's belief if there is room for it."""
    count = beliefs[node]["count"]
    if count == beliefs[node]["room"]:
        room = max(FIRST_ROOM, 2 * count)
        first = used[ROWS]
        if first + room > len(pool_rewards):
            return
        old = beliefs[node]["first"]
        for i in range(count):
            pool_states[first + i] = pool_states[old + i]
            pool_rewards[first + i] = pool_rewards[old + i]
            pool_weights[first + i] = pool_weights[old + i]
        beliefs[node]["first"] = first
        beliefs[node]["room"] = room
        used[ROWS] = first + room
        used[LARGEST] = max(used[LARGEST], room)
    row = beliefs[node]["first"] + count
    for d in range(len(state)):
        pool_states[row, d] = state[d]
    pool_rewards[row] = reward
    pool_weights[row] = weight + (pool_weights[row - 1] if count > 0 else 0.0)
    beliefs[node]["count"] = count + 1


@njit(cache=True, nogil=True)
def draw_row(beliefs, node, pool_weights, rng):
    """The row of a particle of the node's belief, drawn by weight."""
    first = beliefs[node]["first"]
    low = first
    high = first + beliefs[node]["count"] - 1
    target = uniform(rng) * pool_weights[high]
    while low < high:
        middle = (low + high) // 2
        if pool_weights[middle] > target:
            high = middle
        else:
            low = middle + 1
    return low


@njit(cache=True, nogil=True)
def same_observation(nodes, edges, edge, seen, observation):
    """The child of the edge with this very observation, or NO_CHILD."""
    child = edges[edge]["child"]
    while child >= 0:
        same = True
        for d in range(len(observation)):
            if seen[child, d] != observation[d]:
                same = False
        if same:
            return child
        child = nodes[child]["sibling"]
    return child


@njit(cache=True, nogil=True)
def draw_child(nodes, edges, edge, beliefs, chosen):
    """The child that holds the `chosen`-th of the observations generated at the edge."""
    child = edges[edge]["child"]
    while child >= 0:
        chosen -= beliefs[child]["generated"]
        if chosen < 0:
            return child
        child = nodes[child]["sibling"]
    return child


@njit(cache=True, nogil=True)
def random_rollout(step, data, state, depth, max_depth, discount, actions, rng, model_rng, observation, used):
    """The discounted return of uniformly random actions until the end, counted from now."""
    total = 0.0
    weight = 1.0
    for _ in range(depth, max_depth):
        reward, terminal = step(state, below(rng, actions), data, model_rng, observation)
        used[STEPS] += 1
        total += weight * reward
        if terminal:
            break
        weight *= discount
    return total


@njit(cache=True, nogil=True)
def search(
    step, likelihood, rollout, data, states, particles, actions, exploration, discount, max_depth, tree_depth, widening, power, powers,
    node_cap, row_cap, nodes, edges, edge_actions, widths, beliefs, seen, pool_states, pool_rewards, pool_weights, used,
    root_log, inverse_root, rng, model_rng, state, before, observation, path_edges, path_rewards,
):  # fmt: skip
    """Simulations from `particles` [n] (rows of `states`) until done or until an array is nearly full and may grow.

    An edge after n visits may get a further child while it has at most ``widening * n ** power`` (`powers` holds small n). `widths` int32[edges, 2]: children, and observations
    that were given to them. Returns how many simulations were run.
    """
    for i in range(len(particles)):
        room = used[NODES] < node_cap
        # No node's belief can more than double in one simulation, which meets at most one node at each depth.
        needed = (used[DEEPEST] + 2) * 2 * max(used[LARGEST], FIRST_ROOM)
        if used[NODES] >= len(nodes) and room:
            return i
        if used[ROWS] + needed > len(pool_rewards) and len(pool_rewards) < row_cap:
            return i
        for d in range(states.shape[1]):
            state[d] = states[particles[i], d]
        node = np.int64(0)
        depth = 0
        leaf = 0.0
        while True:
            nodes[node]["visits"] += 1
            edge = select(nodes, edges, node, exploration, root_log, inverse_root, rng)
            action = np.int64(edge_actions[edge])
            before[:] = state
            reward, terminal = step(state, action, data, model_rng, observation)
            path_edges[depth] = edge
            path_rewards[depth] = reward
            depth += 1
            leaf_needed = False
            if terminal or depth == max_depth:
                break
            leaf_needed = True
            child = np.int64(NO_CHILD)
            visits = edges[edge]["visits"]
            if widths[edge, 0] <= widening * (powers[visits] if visits < len(powers) else float(visits) ** power):
                child = same_observation(nodes, edges, edge, seen, observation)
                if child < 0:
                    if room and depth <= tree_depth and used[ROWS] + FIRST_ROOM <= len(pool_rewards):
                        weight = likelihood(before, action, state, observation, data)
                        if not (weight > 0.0 and weight < np.inf):
                            used[BROKEN] = 1
                            return i
                        child = used[NODES]
                        used[NODES] += 1
                        nodes[child]["observation"] = child
                        nodes[child]["sibling"] = edges[edge]["child"]
                        nodes[child]["visits"] = 1
                        nodes[child]["first_edge"] = UNEXPANDED
                        nodes[child]["edge_count"] = 0
                        edges[edge]["child"] = child
                        beliefs[child]["generated"] = 1
                        beliefs[child]["count"] = 0
                        beliefs[child]["room"] = 0
                        seen[child] = observation
                        widths[edge, 0] += 1
                        widths[edge, 1] += 1
                        insert(beliefs, child, pool_states, pool_rewards, pool_weights, used, state, reward, weight)
                        break
                else:
                    # Counted, but not followed: a state that chose its observation must not be weighed by it as well.
                    beliefs[child]["generated"] += 1
                    widths[edge, 1] += 1
                    child = np.int64(NO_CHILD)
            if child < 0:
                if widths[edge, 1] == 0:
                    break
                child = np.int64(draw_child(nodes, edges, edge, beliefs, below(rng, widths[edge, 1])))
                observation[:] = seen[child]
            weight = likelihood(before, action, state, observation, data)
            if not (weight >= 0.0 and weight < np.inf):
                used[BROKEN] = 1
                return i
            insert(beliefs, child, pool_states, pool_rewards, pool_weights, used, state, reward, weight)
            row = draw_row(beliefs, child, pool_weights, rng)
            for d in range(states.shape[1]):
                state[d] = pool_states[row, d]
            path_rewards[depth - 1] = pool_rewards[row]
            if nodes[child]["first_edge"] == UNEXPANDED:
                plant_edges(nodes, edges, edge_actions, widths, actions, used, child)
            node = child
        used[STEPS] += depth
        used[DEEPEST] = max(used[DEEPEST], depth)
        if leaf_needed:
            if rollout is None:
                leaf = random_rollout(step, data, state, depth, max_depth, discount, actions, rng, model_rng,
                                      observation, used)  # fmt: skip
            else:
                leaf = rollout(state, action, observation, depth, max_depth, discount, data, model_rng)
        for d in range(depth - 1, -1, -1):
            leaf = path_rewards[d] + discount * leaf
            edge = path_edges[d]
            edges[edge]["visits"] += 1
            edges[edge]["value"] += (leaf - edges[edge]["value"]) / edges[edge]["visits"]
    return len(particles)
