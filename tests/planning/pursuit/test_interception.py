"""Meetings of moving points and the returns of routes, against dense sampling and a slow twin."""

import math

import numpy as np
import pytest

from tab_marl.planning.pursuit.interception import NEVER, value_routes
from tab_marl.planning.pursuit.interception_kernels import first_meeting, meeting_fraction
from tab_marl.planning.pursuit.routes import RouteTable
from tab_marl.world.scenario import Rewards

REWARDS = Rewards()


def test_meeting_fraction_agrees_with_dense_sampling() -> None:
    rng = np.random.default_rng(1)
    s = np.linspace(0, 1, 20001)
    found = {True: 0, False: 0}
    for _ in range(400):
        a, b = rng.uniform(-0.7, 0.7, (2, 2))
        inside = np.hypot(*(a + s[:, None] * (b - a)).T) <= 0.3
        got = meeting_fraction(*a, *b, 0.3)
        closest = np.hypot(*(a + s[:, None] * (b - a)).T).min()
        if abs(closest - 0.3) < 1e-4:
            continue
        assert (got != NEVER) == inside.any()
        if inside.any():
            assert got == pytest.approx(s[inside.argmax()], abs=1e-4)
        found[bool(inside.any())] += 1
    assert min(found.values()) > 50


def test_passing_each_other_within_a_tick_counts() -> None:
    # Outside the radius at both ends, face to face in between.
    assert meeting_fraction(-1.0, 0.0, 1.0, 0.0, 0.3) == pytest.approx(0.35)
    assert meeting_fraction(-1.0, 0.4, 1.0, 0.4, 0.3) == NEVER


def slow_return(route, effort, path, completed, radius, rewards):
    """One route against one path, in dense small steps."""
    ticks = min(len(route), len(path)) - 1
    ends = 0 <= completed <= ticks
    last = completed if ends else ticks
    for t in range(last):
        for s in np.linspace(0, 1, 4001):
            r = route[t] + s * (route[t + 1] - route[t])
            p = path[t] + s * (path[t + 1] - path[t])
            if math.hypot(*(r - p)) <= radius:
                spent = effort[t] + s * (effort[t + 1] - effort[t])
                return rewards.interception + rewards.per_step * (t + s) + rewards.control * spent, t + s
    value = rewards.per_step * last + rewards.control * effort[last]
    return value + (rewards.mission_completed if ends else 0.0), NEVER


def test_returns_match_the_slow_twin() -> None:
    rng = np.random.default_rng(2)
    routes = np.clip(rng.uniform(0, 2, (6, 1, 2)) + np.cumsum(rng.normal(0, 0.08, (6, 15, 2)), axis=1), 0, 2)
    effort = np.concatenate([np.zeros((6, 1)), np.cumsum(rng.uniform(0, 0.1, (6, 14)), axis=1)], axis=1)
    paths = np.clip(rng.uniform(0, 2, (10, 1, 2)) + np.cumsum(rng.normal(0, 0.08, (10, 15, 2)), axis=1), 0, 2)
    completed = np.array([3, 7, 14, -1, 9, -1, 0, 12, 5, 10], dtype=np.int32)
    values = value_routes(RouteTable(routes, effort), paths, completed, REWARDS, 0.3)
    for w in range(6):
        for k in range(10):
            value, met = slow_return(routes[w], effort[w], paths[k], completed[k], 0.3, REWARDS)
            assert values.returns[w, k] == pytest.approx(value, abs=2e-3)
            assert values.met[w, k] == pytest.approx(met, abs=2e-3)
    assert 0.05 < (values.met >= 0).mean() < 0.95
    assert values.mean == pytest.approx(values.returns.astype(float).mean(axis=1), abs=1e-5)


def test_skipping_ahead_never_misses_a_meeting() -> None:
    """The far-apart shortcut must give what stepping tick by tick gives."""
    rng = np.random.default_rng(3)
    for _ in range(200):
        route = np.cumsum(rng.normal(0, 0.07, (60, 2)), axis=0) + rng.uniform(0, 3, 2)
        path = np.cumsum(rng.normal(0, 0.07, (60, 2)), axis=0) + rng.uniform(0, 3, 2)
        closing = np.hypot(*np.diff(route, axis=0).T).max() + np.hypot(*np.diff(path, axis=0).T).max()
        plain = NEVER
        for t in range(59):
            s = meeting_fraction(*(route[t] - path[t]), *(route[t + 1] - path[t + 1]), 0.3)
            if s != NEVER:
                plain = t + s
                break
        assert first_meeting(route, path, 59, 0.3, closing) == plain


def test_a_meeting_after_completion_is_worth_nothing() -> None:
    route = np.tile(np.array([1.0, 1.0]), (1, 5, 1))
    path = np.array([[[2.0, 1.0], [1.8, 1.0], [1.6, 1.0], [1.4, 1.0], [1.2, 1.0]]])
    table = RouteTable(route, np.zeros((1, 5)))
    late = value_routes(table, path, np.array([3], dtype=np.int32), REWARDS, 0.3)
    assert late.returns[0, 0] == pytest.approx(-3 - 50)
    in_time = value_routes(table, path, np.array([-1], dtype=np.int32), REWARDS, 0.3)
    assert in_time.met[0, 0] == pytest.approx(3.5)
    assert in_time.returns[0, 0] == pytest.approx(50 - 3.5)


def test_arrays_that_do_not_fit_are_refused() -> None:
    table = RouteTable(np.zeros((1, 3, 2)), np.zeros((1, 3)))
    with pytest.raises(ValueError, match=r"positions must be \[K, H \+ 1, 2\]"):
        value_routes(table, np.zeros((2, 3)), np.zeros(2, dtype=np.int32), REWARDS, 0.3)
