# mypy: ignore-errors
"""The compiled scenario search (DESPOT). Nothing here raises; `tab_marl.planning.search.despot` validates, and
`tab_marl.planning.search.despot_interpreted` is the slow twin that must build the identical tree.

A node holds the scenarios that reach it, as rows (state, scenario number) stored side by side. All bounds are *totals*: sums
over the scenarios of discounted returns, divided by K, so that bounds of children add up (Ye et al. 2017, equations 9 to 14).
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from tab_marl.planning.random_kernels import GOLDEN, below, mixed
from tab_marl.planning.search.kernels import NO_CHILD, UNEXPANDED

# What `used` counts.
NODES, EDGES, ROWS, TRIALS, EXPANSIONS, AT, GREW, STEPS, DEEPEST = range(9)
# Why `search` returned.
BUDGET, CLOSED, NO_ROOM = 0, 1, 2
_OTHER = np.uint64(0x5851F42D4C957F2D)


@njit(cache=True, nogil=True)
def seed_rng(rng, seed, depth):
    """The scenario's stream at this depth: a function of both, whatever was done before."""
    rng[0] = mixed(seed + np.uint64(depth) * GOLDEN)


@njit(cache=True, nogil=True)
def meet(met, reward):
    """Keeps the least and the greatest reward of all steps, to be held against what was promised."""
    met[0] = min(met[0], reward)
    met[1] = max(met[1], reward)


@njit(cache=True, nogil=True)
def default_value(
    step, rollout, data, state, action, observation, depth, max_depth, discount, actions, seed, rng, model_rng, used, met,
):  # fmt: skip
    """The scenario's return under the default policy: the model's rollout, or uniformly random actions."""
    seed_rng(model_rng, seed, depth)
    if rollout is not None:
        return rollout(state, action, observation, depth, max_depth, discount, data, model_rng)
    else:
        seed_rng(rng, seed ^ _OTHER, depth)
        total = 0.0
        weight = 1.0
        for _ in range(depth, max_depth):
            _observation, reward, terminal = step(state, below(rng, actions), data, model_rng)
            used[STEPS] += 1
            meet(met, reward)
            total += weight * reward
            if terminal:
                break
            weight *= discount
        return total


@njit(cache=True, nogil=True)
def trivial_bound(reward, steps, discount, powers):
    """The return of this reward at so many steps."""
    if discount == 1.0:
        return reward * steps
    return reward * (1.0 - powers[steps]) / (1.0 - discount)


@njit(cache=True, nogil=True)
def bound_node(
    step, rollout, upper, trivial, least, greatest, data, seeds, node, action, actions, max_depth, discount, powers,
    penalty, nodes, row_states, row_scenarios, used, met, rng, model_rng, state,
):  # fmt: skip
    """First bounds of a node from its scenarios: the default policy's return, and what no policy can exceed."""
    depth = nodes[node]["depth"]
    observation = nodes[node]["observation"]
    low = 0.0
    high = 0.0
    for row in range(nodes[node]["first_row"], nodes[node]["first_row"] + nodes[node]["scenarios"]):
        if upper is None:
            high += trivial_bound(greatest, max_depth - depth, discount, powers)
        else:
            state[:] = row_states[row]
            high += upper(state, depth, max_depth, discount, data)
        if trivial:
            low += trivial_bound(least, max_depth - depth, discount, powers)
        else:
            state[:] = row_states[row]
            low += default_value(step, rollout, data, state, action, observation, depth, max_depth, discount, actions,
                                 seeds[row_scenarios[row]], rng, model_rng, used, met)  # fmt: skip
    scale = powers[depth] / len(seeds)
    nodes[node]["default"] = scale * low
    nodes[node]["lower"] = scale * low
    nodes[node]["raw"] = max(scale * low, scale * high)
    nodes[node]["upper"] = max(scale * low, scale * high - penalty)


@njit(cache=True, nogil=True)
def add_node(nodes, used, depth, edge, observation, sibling):
    """A leaf without scenarios yet; returns its number."""
    node = used[NODES]
    used[NODES] += 1
    nodes[node]["observation"] = observation
    nodes[node]["depth"] = depth
    nodes[node]["edge"] = edge
    nodes[node]["sibling"] = sibling
    nodes[node]["first_edge"] = UNEXPANDED
    nodes[node]["edge_count"] = 0
    nodes[node]["scenarios"] = 0
    nodes[node]["filled"] = 0
    return node


@njit(cache=True, nogil=True)
def expand(
    step, rollout, upper, trivial, least, greatest, data, seeds, node, root_actions, actions, max_depth, discount, powers,
    penalty, nodes, edges, edge_actions, row_states, row_scenarios, used, met, slots, moved, moved_to, rng, model_rng, state,
):  # fmt: skip
    """Steps every scenario of the node by every action and gathers them by observation into new nodes with first bounds.

    `slots` int32[2 * 2^k >= 2 K], `moved` [K, D] and `moved_to` int32[K, 2] are scratch.
    """
    depth = nodes[node]["depth"]
    first_row = nodes[node]["first_row"]
    scenarios = nodes[node]["scenarios"]
    first = used[EDGES]
    count = len(root_actions) if node == 0 else actions
    nodes[node]["first_edge"] = first
    nodes[node]["edge_count"] = count
    used[EDGES] += count
    size = 1
    while size < 2 * scenarios:
        size *= 2
    for k in range(count):
        action = np.int64(root_actions[k]) if node == 0 else np.int64(k)
        edge = first + k
        edge_actions[edge] = action
        newest = np.int64(NO_CHILD)
        slots[:size] = NO_CHILD
        total = 0.0
        going = 0
        for row in range(first_row, first_row + scenarios):
            scenario = row_scenarios[row]
            state[:] = row_states[row]
            seed_rng(model_rng, seeds[scenario], depth)
            observation, reward, terminal = step(state, action, data, model_rng)
            meet(met, reward)
            total += reward
            if terminal or depth + 1 >= max_depth:
                continue
            slot = np.int64(np.uint64(mixed(np.uint64(observation))) & np.uint64(size - 1))
            while slots[slot] >= 0 and nodes[slots[slot]]["observation"] != observation:
                slot = (slot + 1) & (size - 1)
            if slots[slot] < 0:
                newest = add_node(nodes, used, depth + 1, edge, observation, newest)
                slots[slot] = newest
            nodes[slots[slot]]["scenarios"] += 1
            moved[going] = state
            moved_to[going, 0] = slots[slot]
            moved_to[going, 1] = scenario
            going += 1
        used[STEPS] += scenarios
        edges[edge]["reward"] = powers[depth] / len(seeds) * total - penalty
        edges[edge]["child"] = newest
        child = newest
        while child >= 0:
            nodes[child]["first_row"] = used[ROWS]
            used[ROWS] += nodes[child]["scenarios"]
            child = nodes[child]["sibling"]
        for i in range(going):
            child = moved_to[i, 0]
            row = nodes[child]["first_row"] + nodes[child]["filled"]
            nodes[child]["filled"] += 1
            row_states[row] = moved[i]
            row_scenarios[row] = moved_to[i, 1]
        child = newest
        while child >= 0:
            bound_node(step, rollout, upper, trivial, least, greatest, data, seeds, child, action, actions, max_depth,
                       discount, powers, penalty, nodes, row_states, row_scenarios, used, met, rng, model_rng, state)  # fmt: skip
            child = nodes[child]["sibling"]
    used[DEEPEST] = max(used[DEEPEST], depth + 1)


@njit(cache=True, nogil=True)
def back_up(nodes, edges, penalty, node):
    """Bellman's equation for the node's bounds. The lower bound only rises and the upper one falls, unless the lower one passes
    it: an upper bound holds on average, and what was earned on these scenarios may be luckier."""
    if nodes[node]["first_edge"] == UNEXPANDED:
        return
    low = nodes[node]["default"]
    high = nodes[node]["default"]
    raw = nodes[node]["default"]
    for edge in range(nodes[node]["first_edge"], nodes[node]["first_edge"] + nodes[node]["edge_count"]):
        edge_low = edges[edge]["reward"]
        edge_high = edges[edge]["reward"]
        edge_raw = edges[edge]["reward"] + penalty
        child = edges[edge]["child"]
        while child >= 0:
            edge_low += nodes[child]["lower"]
            edge_high += nodes[child]["upper"]
            edge_raw += nodes[child]["raw"]
            child = nodes[child]["sibling"]
        edges[edge]["lower"] = edge_low
        edges[edge]["upper"] = edge_high
        low = max(low, edge_low)
        high = max(high, edge_high)
        raw = max(raw, edge_raw)
    nodes[node]["lower"] = max(nodes[node]["lower"], low)
    nodes[node]["upper"] = max(nodes[node]["lower"], min(nodes[node]["upper"], high))
    nodes[node]["raw"] = max(nodes[node]["lower"], min(nodes[node]["raw"], raw))


@njit(cache=True, nogil=True)
def back_up_path(nodes, edges, penalty, path, used):
    for i in range(used[AT], -1, -1):
        back_up(nodes, edges, penalty, path[i])


@njit(cache=True, nogil=True)
def close_node(nodes, node):
    """The search goes no deeper here: the default policy stands."""
    nodes[node]["upper"] = nodes[node]["lower"]
    nodes[node]["raw"] = nodes[node]["lower"]


@njit(cache=True, nogil=True)
def pruned(nodes, penalty, path, used):
    """Whether a node on the way blocks the last one: even a perfect subtree there could not pay for its size."""
    at = used[AT]
    for i in range(at):
        node = path[i]
        if nodes[node]["raw"] - nodes[node]["default"] <= penalty * (at - i):
            return True
    return False


@njit(cache=True, nogil=True)
def excess(nodes, node, total, target):
    """By how much the node's gap exceeds its share of the gap to which the search wants to bring the root."""
    return nodes[node]["upper"] - nodes[node]["lower"] - nodes[node]["scenarios"] / total * target


@njit(cache=True, nogil=True)
def search(
    step, rollout, upper, trivial, least, greatest, data, seeds, root_actions, actions, max_depth, tree_depth, discount,
    powers, penalty, share, gap, trials, expansions,
    nodes, edges, edge_actions, row_states, row_scenarios, used, met, path, slots, moved, moved_to, rng, model_rng, state,
):  # fmt: skip
    """Trials from the root until `trials` in all are done, `expansions` more nodes are expanded, the root's gap is closed, or
    the arrays might not hold the next expansion. Goes on in the middle of a trial when called again."""
    total = len(seeds)
    last = used[EXPANSIONS] + expansions
    while True:
        node = path[used[AT]]
        if used[AT] == 0:
            # The root is expanded in any case: the plan needs values of actions.
            known = nodes[0]["first_edge"] != UNEXPANDED
            if known and (nodes[0]["upper"] - nodes[0]["lower"] <= gap or used[GREW] == 0):
                return CLOSED
            if used[TRIALS] >= trials:
                return BUDGET
            used[GREW] = 0
        target = share * (nodes[0]["upper"] - nodes[0]["lower"])
        going = used[AT] == 0 or excess(nodes, node, total, target) > 0
        if (
            going
            and used[AT] > 0
            and (nodes[node]["depth"] >= tree_depth or (penalty > 0 and pruned(nodes, penalty, path, used)))
        ):
            if nodes[node]["upper"] > nodes[node]["lower"]:
                close_node(nodes, node)
                used[GREW] = 1
            going = False
        if going and nodes[node]["first_edge"] == UNEXPANDED:
            scenarios = nodes[node]["scenarios"]
            if (
                used[NODES] + scenarios * actions > len(nodes)
                or used[ROWS] + scenarios * actions > len(row_scenarios)
                or used[EDGES] + actions > len(edges)
            ):
                used[GREW] = 1
                return NO_ROOM
            if used[EXPANSIONS] >= last:
                used[GREW] = 1
                return BUDGET
            expand(step, rollout, upper, trivial, least, greatest, data, seeds, node, root_actions, actions, max_depth,
                   discount, powers, penalty, nodes, edges, edge_actions, row_states, row_scenarios, used, met, slots, moved,
                   moved_to, rng, model_rng, state)  # fmt: skip
            used[EXPANSIONS] += 1
            used[GREW] = 1
            back_up(nodes, edges, penalty, node)
        next_node = np.int64(NO_CHILD)
        if going:
            best = -1
            for edge in range(nodes[node]["first_edge"], nodes[node]["first_edge"] + nodes[node]["edge_count"]):
                if best < 0 or edges[edge]["upper"] > edges[best]["upper"]:
                    best = edge
            widest = -math.inf
            child = edges[best]["child"]
            while child >= 0:
                width = excess(nodes, child, total, target)
                if width > widest:
                    widest = width
                    next_node = np.int64(child)
                child = nodes[child]["sibling"]
        if next_node >= 0:
            used[AT] += 1
            path[used[AT]] = next_node
            continue
        back_up_path(nodes, edges, penalty, path, used)
        used[AT] = 0
        used[TRIALS] += 1
