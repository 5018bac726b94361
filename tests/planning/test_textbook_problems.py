"""RockSample, LaserTag and light-dark against their rules told again, and their beliefs against counting simulations."""

from __future__ import annotations

import math

import numba
import numpy as np
import pytest

from tab_marl.planning.cycle import play
from tab_marl.planning.search.pomcp import Pomcp, PomcpOptions
from tab_marl.planning.textbook import laser_tag as laser_tag_function
from tab_marl.planning.textbook import light_dark, light_dark_binned, light_dark_start, rock_sample, tag, tiger
from tab_marl.planning.textbook import rock_sample_kernels as rocks
from tab_marl.planning.textbook.chase_maps import EAST, NORTH, SOUTH, TAG, WEST
from tab_marl.planning.textbook.laser_tag import LaserTagBelief, laser_tag_data, laser_tag_places
from tab_marl.planning.textbook.laser_tag_kernels import SEES_TARGET, likelihood
from tab_marl.planning.textbook.light_dark import DECLARE, light_dark_data
from tab_marl.planning.textbook.rock_sample import BAD, CHECK, GOOD, NOTHING, SAMPLE, RockBelief, rock_sample_data
from tab_marl.world.scenario import UnknownName

heavy = pytest.mark.skipif(bool(numba.config.DISABLE_JIT), reason="takes hours interpreted")


def word(seed=1):
    return np.array([seed], dtype=np.uint64)


# ---- RockSample


def rover(x, y, good=0, size=7, count=8):
    return np.array([y * size + x, good, *([0.0] * count)])


@pytest.mark.parametrize(
    ("x", "y", "action", "expected"),
    [
        (0, 3, NORTH, (0, 4, 0.0, False)),
        (0, 3, EAST, (1, 3, 0.0, False)),
        (0, 3, WEST, (0, 3, -100.0, False)),
        (2, 6, NORTH, (2, 6, -100.0, False)),
        (2, 0, SOUTH, (2, 0, -100.0, False)),
        (6, 2, EAST, (6, 2, 10.0, True)),
        (1, 1, SAMPLE, (1, 1, -100.0, False)),
    ],
)
def test_rover_moves(x, y, action, expected):
    model, state = rock_sample(7, 8), rover(x, y)
    seen, reward, terminal = model.step(state, action, model.data, word())
    assert (state[0] % 7, state[0] // 7, reward, terminal) == expected
    assert seen == NOTHING


def test_a_sample_takes_the_rock():
    model = rock_sample(7, 8)
    state = rover(3, 1, good=0b100)  # rock 2 lies at (3, 1)
    assert model.step(state, SAMPLE, model.data, word())[1] == 10.0
    assert state[1] == 0
    assert model.step(state, SAMPLE, model.data, word())[1] == -10.0
    assert model.step(state, CHECK + 2, model.data, word())[0] == BAD


@pytest.mark.parametrize("rock", [0, 3])
def test_a_check_is_right_as_often_as_the_distance_says(rock):
    model, rng = rock_sample(7, 8), word()
    x, y = [(2, 0), (0, 1), (3, 1), (6, 3)][rock]
    right = 0.5 * (1 + 2 ** (-math.hypot(x - 0, y - 3) / 20))
    seen = [model.step(rover(0, 3, good=1 << rock), CHECK + rock, model.data, rng)[0] for _ in range(4000)]
    assert np.mean(np.array(seen) == GOOD) == pytest.approx(right, abs=0.02)
    assert rocks.likelihood(None, CHECK + rock, rover(0, 3, good=1 << rock), GOOD, model.data) == pytest.approx(right)
    assert rocks.likelihood(None, CHECK + rock, rover(0, 3), GOOD, model.data) == pytest.approx(1 - right)


def test_the_rovers_belief_is_bayes_rule_and_travels_in_the_state():
    model, rng = rock_sample(7, 8), word(4)
    belief, state = RockBelief(model.data), rover(0, 3, good=0b1)
    chance = np.full(8, 0.5)
    for action in (CHECK, CHECK + 2, EAST, CHECK):
        seen, _, _ = model.step(state, action, model.data, rng)
        belief = belief.updated(action, int(seen))
        if action >= CHECK:
            x, y = [(2, 0), (0, 1), (3, 1)][action - CHECK]
            at = 0 if (action == CHECK and chance[0] == 0.5) or action == CHECK + 2 else 1
            right = 0.5 * (1 + 2 ** (-math.hypot(x - at, y - 3) / 20))
            says = right if seen == GOOD else 1 - right
            p = chance[action - CHECK]
            chance[action - CHECK] = p * says / (p * says + (1 - p) * (1 - says))
    assert belief.good == pytest.approx(chance)
    assert state[2:] == pytest.approx(belief.log_odds)
    assert belief.cell == state[0] == 22
    sampled = belief.sample(6000, np.random.default_rng(0))
    bits = (sampled[:, 1].astype(int)[:, None] >> np.arange(8)) & 1
    assert bits.mean(axis=0) == pytest.approx(chance, abs=0.03)
    with pytest.raises(ValueError, match="observation 1 after action 0 is impossible"):
        belief.updated(NORTH, GOOD)


def test_the_published_layouts_and_their_bounds():
    assert len(rock_sample_data(11, 11).rock_cell) == 11
    assert rock_sample(15, 15).actions == 20
    with pytest.raises(ValueError, match="must be 2 different"):
        rock_sample_data(4, 2, places=[(0, 0), (9, 9)])
    with pytest.raises(ValueError, match="5 rocks do not fit on 2 x 2 cells"):
        rock_sample_data(2, 5)


@heavy
def test_the_rollouts_of_rocksample_earn_what_their_steps_do():
    # The closed forms against the same policy acted out; "survey" alone earns what DESPOT was published with.
    model = rock_sample(7, 8, "survey")
    run = numba.njit(model.rollout)
    states = RockBelief(model.data).sample(4000, np.random.default_rng(0))
    earned = [run(s.copy(), 0, NOTHING, 0, 90, 0.95, model.data, word(i + 1)) for i, s in enumerate(states)]
    assert np.mean(earned) == pytest.approx(acted_survey(model.data), abs=0.45)
    assert np.mean(earned) > 20.0


def acted_survey(data, games=2500):
    """The survey policy step by step through the model's own step."""
    rng, total = np.random.default_rng(5), 0.0
    act = rocks.act
    for _ in range(games):
        state = RockBelief(data).sample(1, rng)[0]
        stream, weight = rng.integers(2**64, size=1, dtype=np.uint64), 1.0
        goal = -1
        while True:
            x, y = state[0] % 7, state[0] // 7
            if goal < 0:
                hopeful = [k for k in range(8) if state[2 + k] > data.hope]
                goal = min(hopeful, key=lambda k: (data.distance[int(state[0]) * 8 + k], k), default=-1)
                sure = goal < 0 or state[2 + goal] >= data.trust or data.distance[int(state[0]) * 8 + goal] == 0
                if not sure:
                    _, reward, _ = act(state, CHECK + goal, data, stream)
                    weight *= 0.95
                    goal = -1
                    continue
            gx, gy = (data.rock_cell[goal] % 7, data.rock_cell[goal] // 7) if goal >= 0 else (7, y)
            if (gx, gy) == (x, y):
                action, goal = SAMPLE, -1
            else:
                action = EAST if gx > x else WEST if gx < x else NORTH if gy > y else SOUTH
            _, reward, over = act(state, action, data, stream)
            total += weight * reward
            weight *= 0.95
            if over:
                break
    return total / games


def test_sensible_priors_forbid_what_cannot_pay():
    model = rock_sample(7, 8)
    values, counts = np.zeros(13), np.zeros(13, dtype=np.int64)
    state = rover(0, 6)
    state[2] = rocks.COLLECTED
    model.prior(state, 0, 0, 0, model.data, values, counts)
    assert [a for a in range(13) if counts[a] < 0] == [NORTH, WEST, SAMPLE, CHECK]


@pytest.mark.parametrize(
    ("x", "y", "odds", "follows"),
    [
        (0, 3, {}, [CHECK + 1]),  # rock 1 at (0, 1) is nearest, and unknown
        (0, 3, {1: 2.0}, [SOUTH]),
        (1, 1, {0: -2.0, 1: -2.0, 2: 2.0}, [EAST]),  # rocks 0 and 1 are given up, rock 2 lies at (3, 1)
        (1, 2, {1: 2.0}, [SOUTH, WEST]),
        (0, 1, {}, [SAMPLE]),  # no check on the rock itself
        (6, 0, dict.fromkeys(range(8), -2.0) | {6: 2.0}, [NORTH, WEST]),  # rock 6 at (5, 5); to leave is no way to it
        (4, 4, dict.fromkeys(range(8), -2.0), [EAST]),
    ],
)
def test_preferred_priors_hold_the_survey_policy_best(x, y, odds, follows):
    model = rock_sample(7, 8)
    values, counts = np.zeros(13), np.zeros(13, dtype=np.int64)
    state = rover(x, y)
    for rock, known in odds.items():
        state[2 + rock] = known
    model.prior(state, 0, 0, 0, model.data, values, counts)
    plain = np.zeros(13, dtype=np.int64)
    rock_sample(7, 8, prior="sensible").prior(state, 0, 0, 0, model.data, np.zeros(13), plain)
    assert (counts < 0).tolist() == (plain < 0).tolist()
    assert set(counts[counts >= 0]) == {model.data.pseudo_count}
    best = values.max()
    assert [a for a in range(13) if counts[a] > 0 and values[a] == best] == sorted(follows)
    others = [values[a] for a in range(13) if counts[a] > 0 and a not in follows]
    assert others == pytest.approx([0.95 * best] * len(others))


def test_the_guess_of_the_survey_policys_value():
    data, stream = rock_sample_data(7, 8), word(2)
    nothing_left = rover(2, 5)
    nothing_left[2:] = rocks.COLLECTED
    assert rocks.survey_value(nothing_left, 0.95, data) == pytest.approx(10 * 0.95**4)
    one_sure = nothing_left.copy()
    one_sure[1], one_sure[2 + 6] = 1 << 6, 50.0  # rock 6 lies at (5, 5): three moves, the sample, two moves out
    exact = 10 * 0.95**3 + 10 * 0.95**5
    assert rocks.survey_value(one_sure, 0.95, data) == pytest.approx(exact)
    assert rocks.survey_rollout(one_sure.copy(), 0, 0, 0, 90, 0.95, data, stream) == pytest.approx(exact)
    blind = rock_sample_data(7, 8, half_distance=1e-3)
    assert np.isfinite(rocks.survey_value(rover(0, 3), 0.95, blind))
    starts = RockBelief(data).sample(4000, np.random.default_rng(3))
    earned = np.mean([rocks.survey_rollout(state, 0, 0, 0, 90, 0.95, data, stream) for state in starts])
    assert (
        earned < rocks.survey_value(rover(0, 3), 0.95, data) < 1.25 * earned
    )  # it makes light of the way back from a bad rock


# ---- LaserTag


def test_beams_end_at_walls_and_at_the_target():
    # . . .
    # . # .   y upwards: (1, 1) is blocked
    # . . .
    places = [(x, y) for y in range(3) for x in range(3) if (x, y) != (1, 1)]
    data = laser_tag_data(places)
    beams = data.beams.reshape(8, 8, 8)
    from_corner = beams[places.index((0, 0)), places.index((2, 2))]
    # north, east: 3 cells to the border; south, west: 1; north-east: 1 to the obstacle, on the diagonal's rows
    assert from_corner.tolist() == [2, 2, 0, 0, 3, 3, 3, 3]
    assert beams[places.index((0, 0)), places.index((2, 0))][1] == 1  # the target two cells east stops the beam


def test_readings_fall_short_by_half_a_normal_error():
    data = laser_tag_data([(x, 0) for x in range(11)] + [(x, 1) for x in range(11)])
    chances = np.diff(data.readings, axis=1, prepend=0.0)
    assert chances.sum(axis=1) == pytest.approx(1)
    assert chances[0, 0] == 1.0  # a beam of length 1 always reads 0
    phi = lambda z: 0.5 * (1 + math.erf(z / math.sqrt(2)))
    assert chances[2][:3] == pytest.approx(
        [2 * phi(-2 / 2.5), 2 * (phi(-1 / 2.5) - phi(-2 / 2.5)), 2 * (0.5 - phi(-0.4))]
    )


@heavy
def test_the_belief_of_lasertag_agrees_with_weighing_simulations():
    model, rng = laser_tag_function(3), word(9)
    data = model.data
    exact, state = LaserTagBelief(data, 10), np.array([10.0, 40.0])
    for action in (EAST, NORTH, NORTH):
        seen, _, over = model.step(state, action, data, rng)
        assert not over
        exact = exact.updated(action, int(seen))
    assert exact.robot == state[0]
    assert exact.target.sum() == pytest.approx(1)
    assert exact.target[int(state[1])] > 3 / 69  # eight readings tell something
    reached = np.array([exact.robot, 0.0])
    each = [likelihood(None, 0, np.array([exact.robot, float(t)]), int(seen), data) for t in range(data.cells)]
    assert exact._chances(exact.robot, int(seen)) == pytest.approx(each)
    counts = np.zeros(1 << 4)
    for _ in range(3000):
        again = np.array([10.0, 40.0])
        observed, _, _ = model.step(again, TAG, data, rng)
        if (again[1], observed != SEES_TARGET) == (40.0, True):
            counts[(observed >> 4) & 15] += 1
    beam = data.beams.reshape(data.cells, data.cells, 8)[10, 40, 1]
    assert counts / counts.sum() == pytest.approx(np.diff(data.readings[beam], prepend=0.0), abs=0.06)
    assert reached[0] == exact.robot


def test_maps_differ_by_seed_and_have_eight_obstacles():
    assert len(laser_tag_places(0)) == 69
    assert laser_tag_places(0) != laser_tag_places(1)
    with pytest.raises(ValueError, match="sides must be 2"):
        laser_tag_places(0, width=20)


# ---- light-dark


def test_light_dark_follows_its_rules():
    model = light_dark_binned(bin_width=1.0)
    state = np.array([3.0])
    _, reward, over = model.step(state, 0, model.data, word())
    assert (state[0], reward, over) == (-7.0, -1.0, False)
    assert model.step(np.array([0.0]), DECLARE, model.data, word())[1:] == (100.0, True)
    assert model.step(np.array([1.0]), DECLARE, model.data, word())[1:] == (-100.0, True)
    at_border = np.array([-60.0])
    model.step(at_border, 0, model.data, word())
    assert at_border[0] == -60.0
    rng = word()
    readings = [model.step(np.array([21.0]), 1, model.data, rng)[0] + 0.5 for _ in range(3000)]
    assert np.mean(readings) == pytest.approx(20, abs=0.8)
    assert np.std(readings) == pytest.approx(10, abs=0.5)
    in_the_light = [model.step(np.array([11.0]), 1, model.data, rng)[0] for _ in range(50)]
    assert set(in_the_light) <= {9, 10}
    values = light_dark_data().full_view_values
    assert values[60] == 100.0
    assert values[60 + 11] == pytest.approx(-1 - 0.95 + 0.95**2 * 100)  # -10, -1, declare


# ---- returns


@heavy
def test_planning_plays_rocksample():
    model = rock_sample(7, 8)
    planner = Pomcp(model, PomcpOptions(simulations=200, exploration=10))
    games = []
    for seed in range(20):
        rng, prior = np.random.default_rng(seed), RockBelief(model.data)
        start = prior.sample(1, rng)[0]
        choose = lambda b, r: planner.plan(b.sample, r, latest=(EAST, NOTHING)).action
        games.append(play(model, start, prior, choose, follow, rng))
    assert all(game.ended for game in games)
    # About 19.5, standard error 1.5; without the prior's guesses 14, and leaving at once earns 7.4.
    assert np.mean([game.discounted(0.95) for game in games]) > 16


def follow(belief, action, observation):
    return belief.updated(action, int(observation))


def test_the_initial_belief_of_light_dark_is_uniform():
    start = light_dark_start(5000, np.random.default_rng(0))
    assert (start.min(), start.max()) == (-30, 30)
    assert start.shape == (5000, 1)


@pytest.mark.parametrize("problem", [tiger, tag, rock_sample, laser_tag_function, light_dark, light_dark_binned])
def test_an_unknown_rollout_names_the_nearest(problem):
    with pytest.raises(UnknownName, match=r"no rollout of .* named"):
        problem(rollout="uniformly")


def test_an_unknown_prior_names_the_nearest():
    with pytest.raises(UnknownName, match="no prior of RockSample named 'prefered': did you mean 'preferred'"):
        rock_sample(prior="prefered")
