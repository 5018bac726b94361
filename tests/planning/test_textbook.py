"""Tag's tables and belief against its rules, told again with coordinates; the random numbers against published ones."""

from __future__ import annotations

import numba
import numpy as np
import pytest

from tab_marl.planning import random_kernels, textbook
from tab_marl.planning.search.interpreted import mixed
from tab_marl.planning.search.pomcp import Pomcp, PomcpOptions
from tab_marl.planning.textbook import EAST, NORTH, SEES_TARGET, TAG, WEST, TagBelief, play_tag, tag, tag_data

MAP = """
     ...
     ...
     ...
..........
..........
"""


def places():
    """(x, y) of the free squares, rows from the bottom."""
    rows = [line.ljust(10) for line in MAP.split("\n")[1:-1]][::-1]
    return [(x, y) for y, row in enumerate(rows) for x in range(10) if row[x] == "."]


def test_the_map_has_29_cells():
    assert len(places()) == 29


def test_the_target_flees_as_the_rules_say():
    at = places()
    number = {place: i for i, place in enumerate(at)}
    moves = tag_data().target_moves.reshape(29, 29, 5)
    for robot, (rx, ry) in enumerate(at):
        for target, (tx, ty) in enumerate(at):
            expected = np.zeros(29)
            expected[target] += 0.2
            for dx, share in ((1, 0.4 * (tx > rx) + 0.2 * (tx == rx)), (-1, 0.4 * (tx < rx) + 0.2 * (tx == rx))):
                expected[number.get((tx + dx, ty), target)] += share
            for dy, share in ((1, 0.4 * (ty > ry) + 0.2 * (ty == ry)), (-1, 0.4 * (ty < ry) + 0.2 * (ty == ry))):
                expected[number.get((tx, ty + dy), target)] += share
            assert np.bincount(moves[robot, target], minlength=29) / 5 == pytest.approx(expected)


def test_one_step_of_tag():
    model, rng = tag(), np.array([7], dtype=np.uint64)
    state = np.array([0.0, 9.0])
    seen, reward, terminal = model.step(state, EAST, model.data, rng)
    assert (seen, reward, terminal, state[0]) == (1, -1.0, False, 1.0)
    seen, reward, terminal = model.step(state, TAG, model.data, rng)
    assert (seen, reward, terminal, state[0]) == (1, -10.0, False, 1.0)
    seen, reward, terminal = model.step(np.array([4.0, 4.0]), TAG, model.data, rng)
    assert (seen, reward, terminal) == (SEES_TARGET, 10.0, True)
    corner = np.array([0.0, 9.0])
    model.step(corner, WEST, model.data, rng)
    assert corner[0] == 0.0


def test_the_rollout_does_not_double_back():
    moves = tag_data().rollout_moves.reshape(29, 5, 12)
    assert set(moves[4, EAST] >> 5) == {EAST, NORTH}
    assert set(moves[4, TAG] >> 5) == {EAST, NORTH, WEST}
    assert set(moves[10, WEST] >> 5) == {textbook.SOUTH}  # a corner of the upper row: the only way on
    counts = np.bincount(moves[4, EAST] >> 5, minlength=4)
    assert counts[EAST] == counts[NORTH] == 6


def test_the_belief_agrees_with_counting_simulations():
    model, rng = tag(), np.array([3], dtype=np.uint64)
    after = np.zeros(29)
    for i in range(29 * 400):
        state = np.array([4.0, i % 29])
        seen, _, _ = model.step(state, EAST, model.data, rng)
        if seen == 5:
            after[int(state[1])] += 1
    belief = TagBelief(4).updated(model.data, EAST, 5)
    assert belief.robot == 5
    assert belief.target[5] == 0.0
    assert np.abs(belief.target - after / after.sum()).max() < 0.006
    assert TagBelief(4).updated(model.data, EAST, SEES_TARGET).target[5] == 1.0
    missed = TagBelief(4, np.eye(29)[4] * 0.5 + np.eye(29)[9] * 0.5).updated(model.data, TAG, 4)
    assert missed.target[[8, 9]].sum() > 0.3  # the tag failed, so the target was not here
    with pytest.raises(ValueError, match="is impossible from cell 0"):
        TagBelief(0, np.eye(29)[19]).updated(model.data, EAST, SEES_TARGET)


@pytest.mark.skipif(bool(numba.config.DISABLE_JIT), reason="takes hours interpreted")
def test_planning_plays_tag_better_than_its_own_rollout():
    model = tag()
    planner = Pomcp(model, PomcpOptions(simulations=500, exploration=10.0))

    def planned(belief, rng):
        return planner.plan(belief.sample(500, rng), rng).action

    def drifting(belief, rng):
        if belief.target[belief.robot] == 1.0:
            return TAG
        return int(rng.integers(4))

    def mean(policy):
        returns = [play_tag(policy, np.random.default_rng(seed), model.data) for seed in range(40)]
        return np.mean(returns)

    assert mean(planned) > -10.5  # about -8.4, standard error .9
    assert mean(drifting) < -12.0


def test_splitmix_gives_the_published_numbers():
    rng = np.array([1234567], dtype=np.uint64)
    drawn = [int(random_kernels.bits(rng)) for _ in range(3)]
    assert drawn == [6457827717110365317, 3203168211198807973, 9817491932198370423]
    assert mixed(1234567 + 0x9E3779B97F4A7C15) == drawn[0]


def test_draws_are_uniform():
    rng = np.array([5], dtype=np.uint64)
    uniforms = np.array([random_kernels.uniform(rng) for _ in range(20000)])
    assert 0 <= uniforms.min() < uniforms.max() < 1
    assert uniforms.mean() == pytest.approx(0.5, abs=0.01)
    assert uniforms.var() == pytest.approx(1 / 12, abs=0.003)
    counts = np.bincount([random_kernels.below(rng, 7) for _ in range(14000)], minlength=7)
    assert len(counts) == 7
    assert ((counts - 2000) ** 2 / 2000).sum() < 22.5  # chi-square, 6 degrees of freedom, p = .001
    normals = np.array([random_kernels.normal(rng) for _ in range(20000)])
    assert normals.mean() == pytest.approx(0.0, abs=0.03)
    assert normals.std() == pytest.approx(1.0, abs=0.03)
