"""What somebody meets who brings a problem of their own: every face, any belief, the cycle, and what is refused.

The problem is the crying baby of Kochenderfer, *Decision Making Under Uncertainty* (2015), section 6.1.1, with singing as in
Kochenderfer, Wheeler and Wray, *Algorithms for Decision Making* (2022), appendix F.7.
"""

from __future__ import annotations

import time

import numba
import numpy as np
import pytest

from tab_marl.planning import (
    CompiledModel,
    ContinuousModel,
    Despot,
    DespotOptions,
    ExactFilter,
    FilterOptions,
    ParticleFilter,
    PlainPythonWarning,
    Pomcp,
    PomcpOptions,
    Pomcpow,
    PomcpowOptions,
    play,
    table_model,
)
from tab_marl.planning.random_kernels import normal, uniform

heavy = pytest.mark.skipif(bool(numba.config.DISABLE_JIT), reason="says how long compiling takes")
plain = pytest.mark.filterwarnings(f"ignore::{PlainPythonWarning.__module__}.PlainPythonWarning")

SATED, HUNGRY = 0, 1
NOTHING, FEED, SING = range(3)
TRANSITION = np.array([[[0.9, 0.1], [0, 1]], [[1, 0], [1, 0]], [[0.9, 0.1], [0, 1]]])
CRIES = np.array([[0.1, 0.8], [0.1, 0.8], [0.0, 0.9]])
REWARD = np.array([[0.0, -10.0], [-5.0, -15.0], [-0.5, -10.5]])
OPTIONS = PomcpOptions(simulations=2000, exploration=20.0, discount=0.9)


def baby_step(state, action, data, rng):
    reward = data[0][action, np.int64(state[0])]
    state[0] = 0 if action == 1 else max(state[0], np.float64(uniform(rng) < 0.1))
    return np.int64(uniform(rng) < data[1][action, np.int64(state[0])]), reward, False


class Baby:
    actions = 3
    action_names = ("nothing", "feed", "sing")

    def step(self, state, action, rng):
        reached = "sated" if action == FEED or (state == "sated" and rng.random() >= 0.1) else "hungry"
        cries = rng.random() < CRIES[action, int(reached == "hungry")]
        return reached, "crying" if cries else "quiet", float(REWARD[action, int(state == "hungry")]), False


def compiled_baby():
    return CompiledModel(baby_step, actions=3, state_size=1, data=(REWARD, CRIES), action_names=Baby.action_names)


def table_baby():
    return table_model(TRANSITION, np.stack([1 - CRIES, CRIES], axis=2), REWARD, discount=0.9)


def beacon_step(state, action, data, rng, observation):
    if action == 1:
        return 50.0 if abs(state[0]) < 0.5 else -50.0, True
    state[0] += action - 1.0
    observation[0] = state[0] + data * normal(rng)
    return -1.0, False


def beacon_likelihood(before, action, after, observation, data):
    return np.exp(-0.5 * ((observation[0] - after[0]) / data) ** 2)


def beacon():
    return ContinuousModel(beacon_step, beacon_likelihood, actions=3, state_size=1, data=0.5)


@plain
def test_every_face_feeds_a_baby_that_cries():
    """Half the time hungry, then heard crying: to feed is best in the exact solution, and in every face's plan."""
    belief = ExactFilter(table_baby()).update(SING, 1)
    assert belief.probabilities == pytest.approx([0.0, 1.0])
    names = [("sated", "hungry")[int(s)] for s in belief.sample(50, np.random.default_rng(0))[:, 0]]
    plans = [
        Pomcp(compiled_baby(), OPTIONS).plan(belief, 0),
        Pomcp(table_baby(), OPTIONS).plan(belief, 0),
        Pomcp(Baby(), PomcpOptions(simulations=400, exploration=20.0, discount=0.9)).plan(names, 0),
        Despot(table_baby(), DespotOptions(discount=0.9, scenarios=100, trials=5)).plan(belief, 0),
        Despot(Baby(), DespotOptions(discount=0.9, scenarios=20, trials=2, reward_bounds=(-15, 0))).plan(names, 0),
    ]
    assert [plan.action for plan in plans] == [FEED] * len(plans)


@plain
@pytest.mark.parametrize("kind", ["compiled", "table", "plain Python", "continuous"])
def test_a_game_is_played_in_every_kind_of_model_and_the_filter_is_the_belief(kind):
    model = {"compiled": compiled_baby, "table": table_baby, "plain Python": Baby, "continuous": beacon}[kind]()
    start, prior = ("sated", ["sated", "hungry"]) if kind == "plain Python" else ([0.0], [0.0, 1.0])
    planner = (
        Pomcpow(model, PomcpowOptions(simulations=100, exploration=50.0, max_depth=10))
        if kind == "continuous"
        else Pomcp(model, PomcpOptions(simulations=50, exploration=20.0, discount=0.9))
    )
    belief = ParticleFilter(model, prior, FilterOptions(count=100), rng=1)
    game = play(
        model, start, belief, lambda b, rng: planner.plan(b, rng).action, lambda b, a, seen: b.update(a, seen), 3, 6
    )
    assert belief.report().updates == len(game.actions) - game.ended
    assert len(game.rewards) == len(game.observations) == len(game.actions) > 0
    kinds = {"plain Python": str, "continuous": np.ndarray}
    assert all(type(seen) is kinds.get(kind, int) for seen in game.observations)
    if game.ended:  # the beacon says nothing to a robot that docked
        assert np.isnan(game.observations[-1]).all()


@plain
def test_a_filter_is_a_belief_as_good_as_its_particles(same_tree):
    model = table_baby()
    belief = ExactFilter(model, [1, 3])
    assert same_tree(Pomcp(model, OPTIONS).plan(belief, 5).tree, Pomcp(model, OPTIONS).plan(belief.particles, 5).tree)
    options = PomcpOptions(simulations=30)
    followed = ParticleFilter(Baby(), ["hungry"], FilterOptions(count=20), rng=0)
    assert Pomcp(Baby(), options).plan(followed, 5).simulations == 30


def test_a_search_that_tells_observations_apart_refuses_vectors():
    with pytest.raises(
        TypeError, match="is a ContinuousModel, whose observations hardly ever repeat: plan with Pomcpow"
    ):
        Pomcp(beacon())
    with pytest.raises(TypeError, match="plan with Pomcpow"):
        Despot(beacon(), DespotOptions(reward_bounds=(-50, 50)))
    with pytest.raises(TypeError, match=r"the model is the class Baby: give an instance of it, Baby\(\.\.\.\)"):
        Pomcp(Baby)
    with pytest.raises(TypeError, match="exact filter needs tables, and this Baby was not made by table_model"):
        ExactFilter(Baby())


def cut_step(state, action, data, rng):
    if action == 0:
        return 1, -1, False
    return state[0] + 0.5, -1.0, False


@heavy
def test_an_observation_is_not_cut_to_a_whole_number_in_silence():
    for _ in range(2):  # nor from the cache
        with pytest.raises(TypeError, match=r"cut_step returns a float as its observation.* see ContinuousModel"):
            Pomcp(CompiledModel(cut_step, 2, 1)).plan([0.0], 0)


@heavy
@pytest.mark.parametrize("kind", ["pomcp", "despot", "pomcpow"])
def test_what_is_compiled_is_not_said_to_be_searched(kind):
    planner = {
        "pomcp": lambda: Pomcp(compiled_baby(), PomcpOptions(simulations=1)),
        "despot": lambda: Despot(compiled_baby(), DespotOptions(scenarios=1, trials=1, reward_bounds=(-15, 0))),
        "pomcpow": lambda: Pomcpow(beacon(), PomcpowOptions(simulations=1)),
    }[kind]()
    began = time.perf_counter()
    first = planner.plan([0.0, 1.0], 0)
    assert 0 < first.seconds <= time.perf_counter() - began
    again = [planner.plan([0.0, 1.0], 0).seconds for _ in range(20)]
    assert first.seconds < 0.02 + 10 * max(again)


def test_a_belief_of_one_state_is_told_without_a_minus():
    model = table_baby()
    told = str(Pomcp(model, OPTIONS).plan([1.0], 0).explain(ExactFilter(model, [0, 1])))
    assert "belief: 1 state, entropy 0.00 nats" in told
    assert str(ExactFilter(model, [0, 1]).entropy) == "0.0"
