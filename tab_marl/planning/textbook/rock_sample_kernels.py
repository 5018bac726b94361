# mypy: ignore-errors
"""RockSample (Smith and Simmons, UAI 2004) as compiled functions.

The state is ``[cell, rocks that are good as bits, log odds that rock 0 is good, rock 1, ...]``. The log odds follow from what
was done and seen alone (the readings of different rocks are independent), so a prior or a rollout may read them: they are the
rover's own knowledge, not a look at the rocks. ``data.collected`` stands for a rock that was sampled.
"""

# mypy: allow-untyped-defs, allow-untyped-calls, allow-untyped-decorators, no-check-untyped-defs

from __future__ import annotations

import math

import numpy as np
from numba import njit

from tab_marl.planning.random_kernels import below, uniform

NORTH, EAST, SOUTH, WEST, SAMPLE, CHECK = 0, 1, 2, 3, 4, 5
BAD, GOOD, NOTHING = 0, 1, 2
COLLECTED = -1000.0
"""Log odds of a rock that was sampled."""
FIRST = 2
"""Where the log odds begin in a state."""
LEAST_EVIDENCE = 1e-3
"""A sensor that says nothing at all takes a thousand readings to believe, and no policy waits for that."""


@njit(cache=True)
def act(state, action, data, rng):
    """One step on `state`; returns (observation, reward, terminal)."""
    cell = np.int64(state[0])
    if action < SAMPLE:
        after = np.int64(data.moves[cell * 4 + action])
        if after >= 0:
            state[0] = after
            return np.int64(NOTHING), 0.0, False
        if action == EAST:
            return np.int64(NOTHING), 10.0, True
        return np.int64(NOTHING), -100.0, False
    good = np.int64(state[1])
    if action == SAMPLE:
        rock = np.int64(data.rock_at[cell])
        if rock < 0:
            return np.int64(NOTHING), -100.0, False
        bit = np.int64(1) << rock
        reward = 10.0 if good & bit else -10.0
        state[1] = good & ~bit
        state[FIRST + rock] = COLLECTED
        return np.int64(NOTHING), reward, False
    rock = action - CHECK
    right = uniform(rng) < data.accuracy[cell * data.rocks + rock]
    is_good = (good >> rock) & 1
    seen = is_good if right else 1 - is_good
    if state[FIRST + rock] != COLLECTED:
        evidence = data.evidence[cell * data.rocks + rock]
        state[FIRST + rock] += evidence if seen == GOOD else -evidence
    return np.int64(seen), 0.0, False


def step(state, action, data, rng):
    """One step of RockSample."""
    return act(state, action, data, rng)


def likelihood(before, action, state, observation, data):
    """P(observation | action, state reached)."""
    if action < CHECK:
        return 1.0 if observation == NOTHING else 0.0
    if observation == NOTHING:
        return 0.0
    rock = action - CHECK
    right = data.accuracy[np.int64(state[0]) * data.rocks + rock]
    return right if (np.int64(state[1]) >> rock) & 1 == observation else 1.0 - right


@njit(cache=True)
def nearest_rock(state, cell, least_odds, taken, data):
    """(the nearest rock with log odds above `least_odds` and not in the bits `taken`, or -1; its distance in moves)."""
    nearest = -1
    way = data.size * data.size
    for rock in range(data.rocks):
        distance = data.distance[cell * data.rocks + rock]
        if state[FIRST + rock] > least_odds and distance < way and not (taken >> rock) & 1:
            way = distance
            nearest = rock
    return nearest, way


def survey_rollout(state, action, observation, depth, max_depth, discount, data, rng):
    """Go to the nearest rock that may be good, checking it on the way until sure; collect it; at last leave by the east.

    "May be good" and "sure" are bounds on the log odds (``data.hope``, ``data.trust``), which is all that it reads of the
    hidden state; what checks would show is drawn as in `act`.
    """
    cell = np.int64(state[0])
    good = np.int64(state[1])
    total = 0.0
    weight = 1.0
    left = max_depth - depth
    while True:
        nearest, way = nearest_rock(state, cell, data.hope, np.int64(0), data)
        if nearest < 0:
            break
        odds = state[FIRST + nearest]
        if odds < data.trust and way > 0:
            right = uniform(rng) < data.accuracy[cell * data.rocks + nearest]
            seen_good = ((good >> nearest) & 1) == right
            evidence = data.evidence[cell * data.rocks + nearest]
            state[FIRST + nearest] = odds + (evidence if seen_good else -evidence)
            weight *= discount
            left -= 1
            if left <= 0:
                return total
            continue
        left -= way + 1
        if left < 0:
            return total
        for _ in range(way):
            weight *= discount
        total += weight * (10.0 if (good >> nearest) & 1 else -10.0)
        weight *= discount
        state[FIRST + nearest] = COLLECTED
        cell = data.rock_cell[nearest]
    exit_way = data.size - cell % data.size
    if left < exit_way:
        return total
    for _ in range(exit_way - 1):
        weight *= discount
    return total + 10.0 * weight


def harvest_rollout(state, action, observation, depth, max_depth, discount, data, rng):
    """Collect the nearest rock more likely good than not, and so on; then leave. No random number, no step by step."""
    cell = np.int64(state[0])
    good = np.int64(state[1])
    taken = np.int64(0)
    total = 0.0
    weight = 1.0
    left = max_depth - depth
    while True:
        nearest, way = nearest_rock(state, cell, 0.0, taken, data)
        if nearest < 0:
            break
        left -= way + 1
        if left < 0:
            return total
        for _ in range(way):
            weight *= discount
        total += weight * (10.0 if (good >> nearest) & 1 else -10.0)
        weight *= discount
        taken |= np.int64(1) << nearest
        cell = data.rock_cell[nearest]
    exit_way = data.size - cell % data.size
    if left < exit_way:
        return total
    for _ in range(exit_way - 1):
        weight *= discount
    return total + 10.0 * weight


def legal_rollout(state, action, observation, depth, max_depth, discount, data, rng):
    """Uniform among the actions that make sense anywhere, to the end: POMCP's rollout without further knowledge."""
    total = 0.0
    weight = 1.0
    for _ in range(depth, max_depth):
        cell = np.int64(state[0])
        while True:
            chosen = below(rng, CHECK + data.rocks)
            if chosen < SAMPLE:
                if chosen == EAST or data.moves[cell * 4 + chosen] >= 0:
                    break
            elif chosen == SAMPLE:
                rock = np.int64(data.rock_at[cell])
                if rock >= 0 and state[FIRST + rock] != COLLECTED:
                    break
            elif state[FIRST + chosen - CHECK] != COLLECTED:
                break
        _seen, reward, terminal = act(state, chosen, data, rng)
        total += weight * reward
        if terminal:
            break
        weight *= discount
    return total


@njit(cache=True)
def sensible(state, action, observation, depth, data, values, counts):
    """Forbids walking into the border, sampling where nothing is left, and checking rocks already known or collected."""
    cell = np.int64(state[0])
    for a in range(SAMPLE):
        if a != EAST and data.moves[cell * 4 + a] < 0:
            counts[a] = -1
    here = np.int64(data.rock_at[cell])
    if here < 0 or state[FIRST + here] == COLLECTED:
        counts[SAMPLE] = -1
    for rock in range(data.rocks):
        if abs(state[FIRST + rock]) > data.sure:
            counts[CHECK + rock] = -1


@njit(cache=True)
def survey_value(state, discount, data):
    """About what `survey_rollout` earns from here, on average over what is known: rocks in its order, each fetched with
    the probability that it is good, after as many checks as right readings would make sure."""
    cell = np.int64(state[0])
    taken = np.int64(0)
    total = 0.0
    weight = 1.0
    while True:
        nearest, way = nearest_rock(state, cell, data.hope, taken, data)
        if nearest < 0:
            break
        odds = state[FIRST + nearest]
        good = 1.0 / (1.0 + math.exp(-odds))
        checks = 0
        if odds < data.trust and way > 0:
            evidence = max(data.evidence[cell * data.rocks + nearest], LEAST_EVIDENCE)
            checks = math.ceil((data.trust - odds) / evidence)
        weight *= discount**checks
        total += weight * good * 10.0 * discount**way
        # With the chance that it is bad, nobody goes there.
        weight *= good * discount ** (way + 1) + 1.0 - good
        taken |= np.int64(1) << nearest
        if good >= 0.5:
            cell = data.rock_cell[nearest]
    return total + weight * 10.0 * discount ** (data.size - 1 - cell % data.size)


def preferred(state, action, observation, depth, data, values, counts):
    """What `sensible` forbids, and for the rest a first guess: what the survey policy does next is worth its value, anything
    else the same a step later. A few hundred simulations cannot tell thirteen actions apart; so none leaves the policy
    for less than it can show.
    """
    sensible(state, action, observation, depth, data, values, counts)
    cell = np.int64(state[0])
    nearest, way = nearest_rock(state, cell, data.hope, np.int64(0), data)
    worth = survey_value(state, data.discount, data)
    for a in range(CHECK + data.rocks):
        if counts[a] < 0:
            continue
        if nearest < 0:
            follows = a == EAST
        elif way == 0:
            follows = a == SAMPLE
        elif state[FIRST + nearest] < data.trust:
            follows = a == CHECK + nearest
        else:
            after = np.int64(data.moves[cell * 4 + a]) if a < SAMPLE else np.int64(-1)
            follows = after >= 0 and data.distance[after * data.rocks + nearest] < way
        counts[a] = data.pseudo_count
        values[a] = worth if follows else data.discount * worth


def upper(state, depth, max_depth, discount, data):
    """Every good rock fetched as if it were the only one, and the way out: no policy can expect more."""
    cell = np.int64(state[0])
    good = np.int64(state[1])
    total = 10.0 * discount ** (data.size - 1 - cell % data.size)
    for rock in range(data.rocks):
        if (good >> rock) & 1:
            total += 10.0 * discount ** data.distance[cell * data.rocks + rock]
    return total
