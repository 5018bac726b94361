"""What filters refuse, and what they make of tables at the edge: broken likelihoods, readings for numbers, states that have ended."""

from __future__ import annotations

import warnings

import numpy as np
import pytest
import scipy.sparse

from tab_marl.planning import table_kernels, textbook
from tab_marl.planning.beliefs import filter_kernels
from tab_marl.planning.beliefs.exact_filter import ExactFilter
from tab_marl.planning.beliefs.filter_report import BeliefWarning
from tab_marl.planning.beliefs.particle_filter import FilterOptions, ParticleFilter
from tab_marl.planning.cycle import play
from tab_marl.planning.model import CompiledModel, ContinuousModel
from tab_marl.planning.tables import table_model

FEW = FilterOptions(count=100)


def still(state, action, data, rng):
    return np.int64(0), 0.0, False


def measured(state, action, data, rng, observation):
    observation[0] = state[0]
    return 0.0, False


def value_of_data(before, action, state, observation, data):
    return data[0]


def log_density(before, action, state, observation, data):
    return -0.5 * (observation[0] - state[0]) ** 2


class Still:
    actions = 1

    def step(self, state, action, rng):
        return state, 0, 0.0, False


class Growing(Still):
    """Explains what is seen only from state 3 on, and badly there."""

    def likelihood(self, state, action, reached, seen):
        return 1.0 if reached < 3 else float("nan")


@pytest.mark.parametrize("value", [float("nan"), -1.0, -0.25, float("inf"), -float("inf")])
def test_a_broken_likelihood_is_not_taken_for_a_contradiction(value):
    said = rf"likelihood of observation 5 after action 0 is {value}, must be finite and >= 0.*not its logarithm"
    filters = [
        ParticleFilter(CompiledModel(still, 1, 1, (value,)), [0.0], FEW, 0, value_of_data),
        ParticleFilter(ContinuousModel(measured, value_of_data, 1, 1, data=(value,)), [0.0], FEW),
        ParticleFilter(Still(), ["here"], FEW, 0, lambda state, action, reached, seen: value),
    ]
    for belief, observation in zip(filters, [5, 5.0, 5], strict=True):
        before, weights = belief.states, belief.weights
        with pytest.raises(ValueError, match=said.replace("5", r"\[?5\.?0?\]?", 1)):
            belief.update(0, observation)
        assert belief.states is before
        assert belief.weights is weights
        assert belief.report().updates == 0


def test_a_log_likelihood_is_named_with_its_value():
    belief = ParticleFilter(ContinuousModel(measured, log_density, 1, 1), [3.0], FEW)
    with pytest.raises(ValueError, match=r"likelihood of observation \[5\.0\] after action 0 is -2\.0, must be"):
        belief.update(0, 5.0)
    with pytest.raises(ValueError, match=r"likelihood of observation 0 after action 0 is nan"):
        ParticleFilter(Growing(), [1, 2, 3], FEW).update(0, 0)
    ParticleFilter(Growing(), [1, 2], FEW).update(0, 0)


def test_a_likelihood_of_zero_everywhere_is_a_contradiction():
    belief = ParticleFilter(CompiledModel(still, 1, 1, (0.0,)), [0.0], FEW, 0, value_of_data)
    with pytest.warns(BeliefWarning, match="none of 100 particles explains it"):
        belief.update(0, 5)


# ---- readings for numbers


@pytest.mark.parametrize("observation", [0.7, 1.0, np.float64(1.0), "1", None, [1]])
def test_what_is_no_number_of_an_observation_is_refused(observation):
    refused = r"observation is .*, must be a whole number.*ContinuousModel"
    for belief in (ExactFilter(textbook.tiger()), ParticleFilter(textbook.tiger(), [0.0, 1.0], FEW)):
        with pytest.raises(TypeError, match=refused):
            belief.update(textbook.LISTEN, observation)
        belief.update(textbook.LISTEN, np.int32(1)).update(textbook.LISTEN, True)
        assert belief.report().updates == 2
        assert belief.report().events == ()


def reading(state, action, data, rng):
    return state[0], 0.0, False


def test_a_game_refuses_an_observation_that_is_a_reading():
    with pytest.raises(TypeError, match=r"returned .*0\.7.* as its observation"):
        play(CompiledModel(reading, 1, 1), [0.7], None, lambda belief, rng: 0, lambda belief, a, o: belief, 0, 1)
    game = play(CompiledModel(still, 1, 1), [0.7], None, lambda belief, rng: 0, lambda belief, a, o: belief, 0, 1)
    assert game.observations == (0,)
    assert type(game.observations[0]) is int


# ---- tables


def two_states(observation, sparse=False, **given):
    transition = np.eye(2)[None]
    if sparse:
        tables = ([scipy.sparse.csr_array(m) for m in t] for t in (transition, np.array(observation)))
        return table_model(*tables, np.zeros((1, 2)), **given)
    return table_model(transition, observation, np.zeros((1, 2)), **given)


@pytest.mark.parametrize("sparse", [False, True])
def test_an_observation_that_never_comes_is_a_contradiction_in_dense_and_sparse_tables(sparse):
    model = two_states([[[1.0, 0, 0], [1.0, 0, 0]]], sparse)
    exact, particles = ExactFilter(model, [0.9, 0.1]), ParticleFilter(model, [0.0, 1.0], FEW)
    for belief in (exact, particles):
        with pytest.warns(BeliefWarning, match="step 1: observation 2 .*belief made anew by fallback"):
            belief.update(0, 2)
    assert exact.probabilities == pytest.approx([0.9, 0.1])
    assert exact.predicted(0).tolist() == [1, 0, 0]
    with pytest.raises(ValueError, match=r"observation is 3, must be in 0\.\.2"):
        exact.update(0, 3)


@pytest.mark.parametrize("sparse", [False, True])
def test_rounding_makes_no_probability_negative(sparse):
    # The sum is 1 + 5e-10 and passes for 1; the cumulative sum is over 1 before the last entry.
    model = two_states([[[0.5, 0.5 + 3e-10, 2e-10], [0.25, 0.75, 0.0]]], sparse)
    exact = ExactFilter(model)
    assert all(exact.predicted(0) >= 0)
    likelihood = filter_kernels.sparse_table_likelihood if sparse else filter_kernels.table_likelihood
    assert all(likelihood(None, 0, np.array([s]), o, model.data) >= 0 for s in (0.0, 1.0) for o in range(3))
    with warnings.catch_warnings():
        warnings.simplefilter("error", BeliefWarning)
        assert exact.update(0, 2).probabilities.tolist() == [1, 0]


def test_no_negative_probability_even_of_tables_that_fall():
    data = two_states([[[0.5, 0.5, 0.0], [0.5, 0.25, 0.25]]]).data
    falling = data._replace(observation=np.array([[0.5, 1.0 + 1e-10, 1.0], [0.5, 0.75, 1.0]]))
    model = CompiledModel(table_kernels.step, 1, 1, falling)
    assert ExactFilter(model, [1, 0]).predicted(0).tolist() == pytest.approx([0.5, 0.5, 0.0], abs=1e-9)
    assert ExactFilter(model, [1, 0]).predicted(0).min() == 0
    assert filter_kernels.table_likelihood(None, 0, np.array([0.0]), 2, falling) == 0


@pytest.mark.parametrize("sparse", [False, True])
def test_without_a_prior_the_process_has_not_ended(sparse):
    model = two_states([[[0.5, 0.5], [0.5, 0.5]]], sparse, terminal=[False, True])
    assert ExactFilter(model).probabilities.tolist() == [1, 0]
    assert ExactFilter(textbook.tiger()).probabilities.tolist() == [0.5, 0.5]


def test_a_state_that_has_ended_takes_no_step():
    ends = table_model(
        [[[0.5, 0.5, 0], [0, 1, 0], [1, 0, 0]]], np.ones((1, 3, 1)), np.zeros((1, 3)), [False, False, True]
    )
    exact = ExactFilter(ends, [0, 0.5, 0.5]).update(0, 0)
    particles = ParticleFilter(ends, [1.0, 2.0], FEW).update(0, 0)
    assert exact.probabilities.tolist() == [0, 1, 0]  # where the process goes on, it had not ended
    assert (particles.states[particles.weights > 0] == 1.0).all()


# ---- states


def test_probabilities_are_no_states():
    with pytest.raises(ValueError, match=r"list of states.*ExactFilter"):
        ParticleFilter(textbook.tiger(), [0.99, 0.01])
    with pytest.raises(ValueError, match="must be"):
        ParticleFilter(textbook.tiger(), [2.0])


def test_reinvigorated_states_and_fallbacks_are_looked_at_too():
    nudged = ParticleFilter(textbook.tiger(), [0.0, 1.0], FEW, reinvigorate=lambda states, rng: states + 0.5)
    with pytest.raises(ValueError, match=r"is \[[01]\.5\]"):
        nudged.update(textbook.LISTEN, 0)
    given = ParticleFilter(textbook.tiger(1.0), [0.0], FEW, fallback=lambda a, o, n, rng: [7.0])
    with pytest.raises(ValueError, match=r"is \[7\.0\]"):
        given.update(textbook.LISTEN, 1)
