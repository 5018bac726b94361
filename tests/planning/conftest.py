"""Exact solutions of small problems, and comparisons, shared by the planners' tests."""

from __future__ import annotations

import numpy as np
import pytest


def _random_pomdp(seed):
    rng = np.random.default_rng(seed)
    transition = rng.dirichlet(np.ones(3), size=(2, 3))
    observation = rng.dirichlet(np.full(2, 0.5), size=(2, 3))
    reward = rng.normal(size=(2, 3, 3))
    terminal = np.array([False, False, True])
    return transition, observation, reward, terminal


def _expectimax(pomdp, belief, depth, discount):
    """Best values [A] of each action by enumerating all observations, from an unnormalised belief."""
    transition, observation, reward, terminal = pomdp
    values = np.zeros(len(transition))
    for a in range(len(transition)):
        joint = belief[:, None] * transition[a]
        values[a] = (joint * reward[a]).sum()
        after = np.where(terminal, 0.0, joint.sum(axis=0))
        if depth > 1:
            for o in range(observation.shape[2]):
                values[a] += discount * _expectimax(pomdp, after * observation[a][:, o], depth - 1, discount).max()
    return values


def _tiger_value(policy=None, discount=0.95, reach=12):
    """Exact Tiger: the belief is the surplus of growls heard on the left. Value at surplus 0, and the best action at each."""
    surplus = np.arange(-reach, reach + 1)
    left = 1 / (1 + (0.15 / 0.85) ** surplus)
    value = np.zeros(len(surplus))
    for _ in range(2000):
        hear_left = 0.85 * left + 0.15 * (1 - left)
        up, down = np.append(value[1:], value[-1]), np.insert(value[:-1], 0, value[0])
        q = np.array(
            [
                -1 + discount * (hear_left * up + (1 - hear_left) * down),
                -100 * left + 10 * (1 - left) + discount * value[reach],
                10 * left - 100 * (1 - left) + discount * value[reach],
            ]
        )
        value = q.max(axis=0) if policy is None else q[policy, np.arange(len(surplus))]
    return value[reach], q.argmax(axis=0)


def _same_tree(a, b):
    return (
        all(np.array_equal(getattr(a, name), getattr(b, name)) for name in ("nodes", "edges", "edge_actions"))
        and np.array_equal(a.bounds if a.bounds is not None else 0, b.bounds if b.bounds is not None else 0)
        and all(a.observation(n) == b.observation(n) for n in range(1, len(a)))
    )


@pytest.fixture
def random_pomdp():
    """seed -> (transition, observation, reward, terminal) of 3 states, 2 actions, 2 observations."""
    return _random_pomdp


@pytest.fixture
def expectimax():
    """(pomdp, belief, depth, discount) -> exact values [A]."""
    return _expectimax


@pytest.fixture
def tiger_value():
    """(policy by surplus or None) -> (exact value from the uniform belief, best action by surplus -12..12)."""
    return _tiger_value


@pytest.fixture
def same_tree():
    """Whether two trees are the same to the last bit."""
    return _same_tree
