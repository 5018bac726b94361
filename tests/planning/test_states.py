"""What is no state is refused by every search and filter, before a compiled function looks it up past its tables."""

from __future__ import annotations

import numpy as np
import pytest

from tab_marl.planning import ParticleFilter, Particles, Pomcp, PomcpOptions, Pomcpow, PomcpowOptions, textbook
from tab_marl.planning.model import CompiledModel, ContinuousModel, StateRange, check_states


def counting_step(state, action, data, rng):
    state[0] += 1.0
    return np.int64(action), 0.0, False


@pytest.mark.parametrize(
    ("model", "belief", "words"),
    [
        (
            textbook.tiger(),
            [0.99, 0.01],
            r"state 0 of the belief is \[0.99\]: its number 0 must be whole and in \[0, 1\]",
        ),
        (
            textbook.tiger(),
            [0.0, 7.0],
            r"state 1 of the belief is \[7.0\].* not of probabilities: give those as weights",
        ),
        (textbook.tiger(), [-1.0], r"in \[0, 1\] for this model"),
        (textbook.tag(), [[3, 40]], r"its number 1 must be whole and in \[0, 28\]"),
        (textbook.tag(), [[99, 3]], r"its number 0 must be whole and in \[0, 28\]"),
        (textbook.tag(), [[3, np.nan]], "its number 1 must be whole"),
        (textbook.laser_tag(), [[3, 69]], r"in \[0, 68\]"),
        (textbook.rock_sample(4, 4), [[16, 0, 0, 0, 0, 0]], r"number 0 must be whole and in \[0, 15\]"),
        (textbook.rock_sample(4, 4), [[0, 16, 0, 0, 0, 0]], r"number 1 must be whole and in \[0, 15\]"),
        (textbook.rock_sample(4, 4), [[0, 0, 0.5, 0, np.nan, 0]], r"number 4 must be in \[-inf, inf\]"),
        (textbook.light_dark(), [61.0], r"whole and in \[-60, 60\]"),
        (textbook.light_dark_binned(), [0.5], r"whole and in \[-60, 60\]"),
    ],
)
def test_a_belief_in_what_is_no_state_is_refused_by_searches_and_filters(model, belief, words):
    search = (
        Pomcpow(model, PomcpowOptions(simulations=2))
        if isinstance(model, ContinuousModel)
        else Pomcp(model, PomcpOptions(simulations=2))
    )
    for given in (belief, Particles(np.array(belief)), lambda count, rng: np.array(belief)):
        with pytest.raises(ValueError, match=words):
            search.plan(given, 0)
        with pytest.raises(ValueError, match=words):
            ParticleFilter(model, given)


def test_the_range_of_states_is_one_of_every_number_in_a_state():
    with pytest.raises(ValueError, match="states gives the range of 2 numbers, must be of state_size = 1"):
        CompiledModel(counting_step, 3, 1, states=StateRange([0, 0], [1, 1]))
    half_open = CompiledModel(counting_step, 3, 2, states=StateRange([0, -np.inf], [np.inf, 5], [True, False]))
    check_states(half_open, np.array([[1e9, -0.5]]))
    with pytest.raises(ValueError, match="state 1 of the belief"):
        check_states(half_open, np.array([[1e9, -0.5], [0.0, 5.5]]))
    check_states(
        CompiledModel(counting_step, 3, 1), np.array([[np.nan]])
    )  # a model that does not say takes any numbers
