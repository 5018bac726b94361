"""Beliefs against brute-force Bayes, the rate at which particles approach it, and what happens when nothing explains what is seen."""

from __future__ import annotations

import itertools
import warnings

import numba
import numpy as np
import pytest
import scipy.sparse

from tab_marl.planning import table_kernels, textbook
from tab_marl.planning.beliefs.exact_filter import ExactFilter
from tab_marl.planning.beliefs.filter_report import BeliefWarning, ImpossibleObservation
from tab_marl.planning.beliefs.particle_filter import FilterOptions, ParticleFilter
from tab_marl.planning.model import CompiledModel, Particles
from tab_marl.planning.random_kernels import normal
from tab_marl.planning.tables import table_model

heavy = pytest.mark.skipif(bool(numba.config.DISABLE_JIT), reason="takes hours interpreted")


def tables(seed: int, states: int = 3, observations: int = 3):
    rng = np.random.default_rng(seed)
    transition = rng.dirichlet(np.full(states, 0.6), size=(2, states))
    observation = rng.dirichlet(np.full(observations, 0.6), size=(2, states))
    return transition, observation, np.zeros((2, states)), np.arange(states) == states - 1


def brute_force(pomdp, prior, history, floor=0.0):
    """The belief by summing over every path of states; `floor` replaces chances below it times the best."""
    transition, observation, _, terminal = pomdp
    after = np.zeros(len(prior))
    for path in itertools.product(range(len(prior)), repeat=len(history) + 1):
        weight = prior[path[0]]
        for (a, o), before, reached in zip(history, path, path[1:], strict=False):
            chance = max(observation[a][reached, o], floor)
            weight *= transition[a][before, reached] * chance * (not terminal[before] and not terminal[reached])
        after[path[-1]] += weight
    return after / after.sum()


HISTORY = [(0, 1), (1, 0), (1, 2), (0, 0)]


@pytest.mark.parametrize("seed", range(5))
def test_the_exact_filter_is_bayes_rule(seed):
    pomdp, prior = tables(seed), np.array([0.5, 0.3, 0.2])
    belief = ExactFilter(table_model(*pomdp), prior)
    for n, (action, observation) in enumerate(HISTORY, 1):
        belief.update(action, observation)
        assert belief.probabilities == pytest.approx(brute_force(pomdp, prior, HISTORY[:n]), abs=1e-12)
    assert belief.report().updates == 4
    assert belief.report().events == ()
    expected = -(belief.probabilities[:2] * np.log(belief.probabilities[:2])).sum()
    assert belief.entropy == pytest.approx(expected)


def test_the_predicted_observations_are_those_that_come():
    model, rng = textbook.tiger(), np.random.default_rng(0)
    belief = ExactFilter(model).update(textbook.LISTEN, textbook.HEAR_LEFT)
    assert belief.probabilities == pytest.approx([0.85, 0.15])
    assert belief.predicted(textbook.LISTEN) == pytest.approx([0.85**2 + 0.15**2, 2 * 0.85 * 0.15])
    assert belief.sample(4000, rng).mean() == pytest.approx(0.15, abs=0.02)


def sure_tiger():
    """A tiger that is always heard where it is, and does not move when listened to."""
    return textbook.tiger(accuracy=1.0)


def test_an_impossible_observation_says_what_and_when_and_the_history_is_replayed():
    belief = ExactFilter(sure_tiger(), doubt=0.01)
    belief.update(0, 0).update(0, 0)
    said = r"step 3: observation 1 after action listen \(probability 0; possible: 0 \(1\)\); belief made anew by replay"
    with pytest.warns(BeliefWarning, match=said):
        belief.update(0, 1)
    # left was heard twice and right once: against a doubt of .01 each
    assert belief.probabilities == pytest.approx(np.array([0.01, 0.0001]) / 0.0101)
    report = belief.report()
    assert (report.updates, report.replays, report.fallbacks) == (3, 1, 0)
    assert report.events[0].step == 3
    assert "3 updates, 1 replays, 0 fallbacks" in str(report)


def test_a_strict_filter_raises_and_keeps_its_belief():
    belief = ExactFilter(sure_tiger(), strict=True).update(0, 0)
    with pytest.raises(ImpossibleObservation, match=r"step 2: observation 1 after action listen \(probability 0"):
        belief.update(0, 1)
    assert belief.probabilities.tolist() == [1.0, 0.0]
    assert belief.report().updates == 1


def test_what_no_state_explains_goes_to_the_fallback():
    observation = np.zeros((1, 2, 3))
    observation[:, :, 0] = 1.0  # observations 1 and 2 never happen
    model = table_model([np.eye(2)], observation, np.zeros((1, 2)))
    with pytest.warns(BeliefWarning, match="belief made anew by fallback"):
        belief = ExactFilter(model, [0.9, 0.1]).update(0, 2)
    assert belief.probabilities == pytest.approx([0.9, 0.1])
    assert belief.report().fallbacks == 1
    with pytest.warns(BeliefWarning):
        given = ExactFilter(model, [0.9, 0.1], fallback=lambda action, seen: [1, 3]).update(0, 2)
    assert given.probabilities == pytest.approx([0.25, 0.75])
    with pytest.raises(ValueError, match=r"observation is 3, must be in 0\.\.2"):
        belief.update(0, 3)
    with pytest.raises(TypeError, match="an exact filter needs tables"):
        ExactFilter(textbook.tag())


# ---- particles


@heavy
@pytest.mark.parametrize("weighed", [True, False])
def test_the_error_of_particles_falls_like_the_root_of_their_number(weighed):
    pomdp, prior = tables(3), np.array([0.5, 0.3, 0.2])
    exact = brute_force(pomdp, prior, HISTORY)
    model = table_model(*pomdp)
    if not weighed:  # the same process with data of another type: nothing but the simulated observation to go by
        model = CompiledModel(hidden_step, 2, 1, (model.data,))
    counts = [60, 480, 3840]
    errors = np.zeros((len(counts), 40))
    for i, count in enumerate(counts):
        for seed in range(40):
            belief = ParticleFilter(model, Particles(np.arange(3.0), prior), FilterOptions(count=count), seed)
            assert belief._dynamics.weighs is weighed
            for action, observation in HISTORY:
                belief.update(action, observation)
            errors[i, seed] = belief.weights[belief.states[:, 0] == 0].sum() - exact[0]
    slope = np.polyfit(np.log(counts), np.log(np.sqrt((errors**2).mean(axis=1))), 1)[0]
    assert -0.6 < slope < -0.4
    assert abs(errors[-1].mean()) < 4 * errors[-1].std() / np.sqrt(40)


table_step = numba.njit(table_kernels.step)


def hidden_step(state, action, data, rng):
    return table_step(state, action, data[0], rng)


@heavy
def test_particles_follow_tag_as_its_exact_belief_does():
    model = textbook.tag()
    exact, belief = textbook.TagBelief(4), ParticleFilter(model, textbook.TagBelief(4).sample, FilterOptions(20000), 1)
    for action, seen in [(textbook.EAST, 5), (textbook.NORTH, 15), (textbook.TAG, 15), (textbook.EAST, 16)]:
        exact = exact.updated(model.data, action, seen)
        belief.update(action, seen)
        assert (belief.states[:, 0] == exact.robot).all()
        counted = np.bincount(belief.states[:, 1].astype(int), weights=belief.weights, minlength=29)
        assert np.abs(counted - exact.target).max() < 0.015
    assert belief.report().events == ()


@heavy
def test_particles_that_explain_nothing_are_replayed_from_the_history():
    # Few particles, all of them in the west of the target's map by chance: then the target is met in the east.
    model = textbook.tag()
    belief = ParticleFilter(model, textbook.TagBelief(4).sample, FilterOptions(count=200, tries=1), 0)
    belief.states = np.tile([4.0, 0.0], (200, 1))  # wrong beyond repair by stepping
    with pytest.warns(
        BeliefWarning, match=r"step 1: observation 29 after action east \(none of 200 particles explains it\)"
    ):
        belief.update(textbook.EAST, textbook.SEES_TARGET)
    assert (belief.states == [5.0, 5.0]).all()
    assert (belief.report().replays, belief.report().fallbacks) == (1, 0)


@heavy
def test_what_no_replay_explains_goes_to_the_fallback_and_is_counted():
    model, options = textbook.tag(), FilterOptions(count=100, tries=2)
    belief = ParticleFilter(model, textbook.TagBelief(4).sample, options, 0)
    belief.update(textbook.EAST, 5)
    with pytest.warns(
        BeliefWarning, match="step 2: .* nor does a replay of 2 steps; the prior does not explain it either"
    ):
        belief.update(textbook.EAST, 17)  # from cell 5 the robot cannot be in 17
    assert belief.report().fallbacks == 1
    belief.update(textbook.EAST, 5)  # the belief is the prior again, from which this is possible
    given = ParticleFilter(model, textbook.TagBelief(4).sample, options, 0, fallback=lambda a, o, n, rng: [[17, 3]])
    with pytest.warns(BeliefWarning, match="the given fallback is believed"):
        given.update(textbook.EAST, 17)
    assert (given.states == [17, 3]).all()
    none = ParticleFilter(model, textbook.TagBelief(4).sample, FilterOptions(count=100, tries=2, replay=0), 0)
    with pytest.warns(BeliefWarning, match="none of 200 particles explains it; the prior"):
        none.update(textbook.EAST, 17)


def test_a_replay_forgives_what_it_must():
    # Particles all on the left by an unlucky start, then two sure growls from the right: the prior knew both sides.
    belief = ParticleFilter(sure_tiger(), [0.0, 1.0], FilterOptions(count=64), 0)
    belief.states = np.zeros((64, 1))
    with pytest.warns(BeliefWarning, match="replay"):
        belief.update(0, 1)
    assert (belief.states == 1).all()
    with pytest.warns(BeliefWarning, match="step 2"):
        belief.update(0, 0)  # now left is heard: one of the two growls lied
    assert 0.2 < (belief.weights * belief.states[:, 0]).sum() < 0.8
    assert belief.report().replays == 2


def test_memory_is_bounded_and_a_replay_starts_from_what_is_kept():
    belief = ParticleFilter(textbook.tiger(), [0.0, 1.0], FilterOptions(count=50, memory=3), 0)
    for _ in range(20):
        belief.update(textbook.LISTEN, textbook.HEAR_LEFT)
        assert len(belief._history) < 6
    assert (belief.weights * (belief.states[:, 0] == 0)).sum() > 0.98
    belief.states = np.ones_like(belief.states)
    belief.model = belief._dynamics.model = sure_tiger()
    with pytest.warns(BeliefWarning, match="replay"):
        belief.update(textbook.LISTEN, textbook.HEAR_LEFT)
    assert (belief.states == 0).all()


def biased_step(state, action, data, rng):
    """A bias that never changes, read with noise in tenths."""
    return np.int64(np.round(10 * (state[0] + normal(rng)))), 0.0, False


def biased_likelihood(before, action, state, observation, data):
    return np.exp(-0.5 * (observation / 10 - state[0]) ** 2)


@heavy
def test_reinvigoration_keeps_a_belief_about_something_constant_from_thinning_out():
    model = CompiledModel(biased_step, 1, 1)
    readings = np.round(10 * np.random.default_rng(5).normal(1.3, 1.0, size=60)).astype(int)
    precision = 1 / 9 + 60  # conjugate prior N(0, 3)
    exact = readings.sum() / 10 / precision

    def after(reinvigorate):
        prior = np.random.default_rng(2).normal(0, 3, size=(500, 1))
        belief = ParticleFilter(model, prior, FilterOptions(500), 1, biased_likelihood, reinvigorate)
        for reading in readings:
            belief.update(0, int(reading))
        return len(np.unique(belief.states)), (belief.states[:, 0] * belief.weights).sum()

    thin, _ = after(None)
    rich, mean = after(lambda states, rng: states + rng.normal(0, 0.1, states.shape))
    assert thin < 60
    assert rich > 150
    assert mean == pytest.approx(exact, abs=0.08)


class Doors:
    """Tiger in plain Python, with tuples for states."""

    actions = 1
    action_names = ("listen",)

    def step(self, state, action, rng):
        lies = rng.random() < 0.15
        return state, ("left" if (state[0] == "left") != lies else "right"), -1.0, False


def test_plain_python_models_are_filtered_too():
    prior = [("left", 0), ("right", 0)]
    by_matching = ParticleFilter(Doors(), prior, FilterOptions(count=400), 0)
    by_weight = ParticleFilter(
        Doors(), prior, FilterOptions(count=400), 0, lambda s, a, t, seen: 0.85 if t[0] == seen else 0.15
    )
    for belief in (by_matching, by_weight):
        belief.update(0, "left").update(0, "left")
        left = sum(w for s, w in zip(belief.states, belief.weights, strict=True) if s == ("left", 0))
        assert left == pytest.approx(0.85**2 / (0.85**2 + 0.15**2), abs=0.05)
        assert belief.sample(10, np.random.default_rng(0)).shape == (10,)
    with pytest.warns(BeliefWarning, match="step 3: observation 'silence' after action listen"):
        by_matching.update(0, "silence")


def test_a_filter_without_trouble_is_silent_and_repeatable():
    with warnings.catch_warnings():
        warnings.simplefilter("error", BeliefWarning)
        beliefs = [ParticleFilter(textbook.tiger(), [0.0, 1.0], rng=7) for _ in range(2)]
        for belief in beliefs:
            belief.update(0, 0).update(0, 1).update(0, 0)
    assert np.array_equal(beliefs[0].states, beliefs[1].states)
    assert np.array_equal(beliefs[0].weights, beliefs[1].weights)


def test_bad_input_is_named():
    with pytest.raises(ValueError, match=r"count is 0, must be >= 1"):
        FilterOptions(count=0)
    with pytest.raises(ValueError, match=r"doubt is 2, must be in \[0, 1\]"):
        FilterOptions(doubt=2)
    with pytest.raises(ValueError, match=r"action is 3, must be in 0\.\.2"):
        ParticleFilter(textbook.tiger(), [0.0, 1.0]).update(3, 0)
    with pytest.raises(ValueError, match="prior must be 2 numbers"):
        ExactFilter(textbook.tiger(), [1.0])


@heavy
def test_sparse_tables_are_filtered_as_dense_ones():
    pomdp, prior = tables(4), np.array([0.5, 0.3, 0.2])
    sparse = table_model(*([scipy.sparse.csr_array(m) for m in part] for part in pomdp[:2]), pomdp[2], pomdp[3])
    dense_belief, sparse_belief = ExactFilter(table_model(*pomdp), prior), ExactFilter(sparse, prior)
    particles = [
        ParticleFilter(m, Particles(np.arange(3.0), prior), FilterOptions(300), 0)
        for m in (table_model(*pomdp), sparse)
    ]
    for action, observation in HISTORY:
        dense_belief.update(action, observation)
        sparse_belief.update(action, observation)
        assert sparse_belief.probabilities == pytest.approx(dense_belief.probabilities, abs=1e-12)
        for belief in particles:
            belief.update(action, observation)
    assert np.array_equal(particles[0].states, particles[1].states)
    assert particles[0].weights == pytest.approx(particles[1].weights, abs=1e-12)


@heavy
def test_particles_follow_continuous_readings_as_bayes_rule_on_the_whole_numbers_does():
    model, rng = textbook.light_dark(), np.random.default_rng(0)
    belief = ParticleFilter(model, textbook.light_dark_start, FilterOptions(40000), 1)
    positions = np.arange(-60, 61)
    exact = (abs(positions) <= 30) / 61
    truth = -12
    for action, move in [(3, 1), (4, 10), (3, 1), (0, -10)]:
        truth += move
        reading = rng.normal(truth, abs(truth - 10))
        exact = np.interp(positions - move, positions, exact)
        spread = abs(positions - 10) + 1e-4
        exact *= np.exp(-0.5 * ((reading - positions) / spread) ** 2) / spread
        exact /= exact.sum()
        belief.update(action, reading)
        counted = np.bincount(belief.states[:, 0].astype(int) + 60, weights=belief.weights, minlength=121)
        assert np.abs(counted - exact).max() < 0.01
    with pytest.raises(ValueError, match=r"observation has shape \(2,\), must be \[1\]"):
        belief.update(3, [1.0, 2.0])
