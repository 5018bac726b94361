"""DESPOT's bounds: what the known state is worth, short horizons and costs, other discounts, and rewards that were not promised."""

from __future__ import annotations

import dataclasses

import numba
import numpy as np
import pytest
import scipy.sparse

from tab_marl.planning import CompiledModel, Despot, DespotOptions, Particles, tables, textbook
from tab_marl.planning.search import despot_kernels, despot_rewards
from tab_marl.planning.search.despot import DESPOT_EDGE, DESPOT_NODE
from tab_marl.planning.search.kernels import NO_CHILD, UNEXPANDED
from tab_marl.planning.search.tree import ROOT
from tab_marl.planning.tables import table_model

heavy = pytest.mark.skipif(bool(numba.config.DISABLE_JIT), reason="takes hours interpreted")
SHIFTS = {"costs": -3.0, "both signs": 0.0, "earnings": 3.0}


def shifted(pomdp, by, ends=True):
    """The same problem with every reward made greater or smaller, and without an end if asked for."""
    transition, observation, reward, terminal = pomdp
    return transition, observation, reward + by, terminal & ends


def best_known(pomdp, discount, steps):
    """``[S]``: what `steps` steps are worth at best if the state is known, by the definition."""
    transition, _, reward, terminal = pomdp
    if steps == 0:
        return np.zeros(len(terminal))
    following = best_known(pomdp, discount, steps - 1)
    return np.where(terminal, 0.0, (transition * (reward + discount * following)).sum(axis=2).max(axis=0))


def bound(model, state, steps, discount):
    return model.upper(np.array([float(state)]), 2, 2 + steps, discount, model.data)


@pytest.mark.parametrize("most", [2**22, 12, 3, 1])
@pytest.mark.parametrize("shift", SHIFTS)
def test_the_known_state_bounds_every_horizon_even_where_memory_is_short(shift, most, random_pomdp, monkeypatch):
    monkeypatch.setattr(tables, "_MOST_VALUES", most)
    for seed in range(6):
        pomdp = shifted(random_pomdp(seed), SHIFTS[shift], ends=seed % 2 == 0)
        dense = table_model(*pomdp, discount=0.9)
        transition, observation, reward, terminal = pomdp
        sparse = table_model(
            [scipy.sparse.csr_array(t) for t in transition],
            [scipy.sparse.csr_array(o) for o in observation],
            reward,
            terminal,
            discount=0.9,
        )
        assert dense.upper_discount == sparse.upper_discount == 0.9
        for steps in (1, 2, 3, 5, 8, 40, 300):
            exact = best_known(pomdp, 0.9, steps)
            for model in (dense, sparse):
                bounds = np.array([bound(model, s, steps, 0.9) for s in range(3)])
                assert (bounds >= exact - 1e-9).all()
                if most == 2**22 or (steps == 300 and shift == "earnings"):
                    assert bounds == pytest.approx(exact, abs=1e-7)


# ---- short horizons


def test_where_steps_cost_a_short_horizon_is_not_bounded_by_a_long_one():
    """Action 0 leads where every step costs 1 for ever, action 1 where it costs 3: but on the way there 1 and 3 the other way."""
    transition = np.zeros((2, 3, 3))
    transition[0, 0, 1] = transition[1, 0, 2] = 1
    transition[:, 1, 1] = transition[:, 2, 2] = 1
    reward = np.array([[-1.0, -1.0, -3.0], [-1.0, -10.0, -3.0]])
    model = table_model(transition, np.ones((2, 3, 1)), reward, discount=0.95)
    plan = Despot(model, DespotOptions(discount=0.95, max_depth=4, scenarios=100)).plan([0.0], 0)
    worth = -(1 - 0.95**4) / 0.05
    assert plan.action == 0
    assert plan.bounds == pytest.approx((worth, worth))


def in_order(plan):
    return bool((plan.tree.bounds[:, 0] <= plan.tree.bounds[:, 1] + 1e-9).all())


@heavy
@pytest.mark.parametrize("shift", SHIFTS)
@pytest.mark.parametrize("depth", [1, 2, 5, 60])
def test_no_lower_bound_is_above_its_upper_one(shift, depth, random_pomdp):
    for seed in range(10):
        model = table_model(*shifted(random_pomdp(seed), SHIFTS[shift], ends=seed % 2 == 0), discount=0.9)
        options = DespotOptions(scenarios=30, trials=15, discount=0.9, max_depth=depth)
        plan = Despot(model, options).plan([0.0, 1.0], seed)
        assert in_order(plan)
        assert plan.bounds[0] <= plan.bounds[1] + 1e-9
        assert in_order(Despot(model, dataclasses.replace(options, regularisation=0.1)).plan([0.0, 1.0], seed))


@heavy
@pytest.mark.parametrize("shift", SHIFTS)
@pytest.mark.parametrize("bounds", ["known state", "rewards"])
def test_plans_of_short_horizons_are_as_good_as_the_best(shift, bounds, random_pomdp, expectimax):
    for seed in range(6):
        pomdp = shifted(random_pomdp(seed), SHIFTS[shift], ends=seed % 2 == 0)
        exact = expectimax(pomdp, np.array([0.5, 0.5, 0.0]), 3, 0.9)
        known = bounds == "known state"
        model = table_model(*pomdp, discount=0.9 if known else None)
        promised = None if known else (float(pomdp[2].min()), float(pomdp[2].max()))
        options = DespotOptions(
            scenarios=20_000, discount=0.9, max_depth=3, trials=500, reward_bounds=promised, lower="rollout" if known else "trivial"
        )  # fmt: skip
        plan = Despot(model, options).plan([0.0, 1.0], seed)
        assert plan.stopped == "closed"
        assert in_order(plan)
        assert exact[plan.action] > exact.max() - 0.04  # 20,000 scenarios: a standard error of about 0.02 at most
        assert plan.bounds == pytest.approx((exact.max(), exact.max()), abs=0.08)


@heavy
@pytest.mark.parametrize("depth", [1, 3, 10])
def test_a_chase_cut_short_is_bounded_too(depth):
    for model in (textbook.tag(), textbook.laser_tag()):
        plan = Despot(model, DespotOptions(scenarios=30, trials=20, max_depth=depth)).plan([[0.0, 9.0], [0.0, 12.0]], 0)
        away = -(1 - 0.95**depth) / 0.05  # nothing but moves
        assert plan.bounds[1] >= plan.bounds[0] >= away - 1e-9
        assert in_order(plan)
        free = model.upper(np.array([0.0, 9.0]), 0, depth, 0.95, model.data)
        assert free >= away


def test_an_upper_bound_is_raised_to_what_was_found():
    """A root with one action, below it one leaf whose default policy was luckier than the root's upper bound allows."""
    nodes, edges = np.zeros(2, dtype=DESPOT_NODE), np.zeros(1, dtype=DESPOT_EDGE)
    nodes["sibling"], nodes["first_edge"] = NO_CHILD, (0, UNEXPANDED)
    nodes["edge_count"] = 1, 0
    nodes[["lower", "upper", "raw", "default"]] = [(0.0, 1.0, 1.0, 0.0), (3.0, 4.0, 4.0, 3.0)]
    edges["child"] = 1
    despot_kernels.back_up(nodes, edges, 0.0, 0)
    assert (nodes["lower"][0], nodes["upper"][0], nodes["raw"][0]) == (3.0, 3.0, 3.0)
    nodes["upper"][0] = nodes["raw"][0] = 9.0
    despot_kernels.back_up(nodes, edges, 0.0, 0)
    assert (nodes["lower"][0], nodes["upper"][0], nodes["raw"][0]) == (3.0, 4.0, 4.0)


# ---- trivial bounds


def costly(ends):
    """One state where each step costs 1; action 1 goes on to an end, if there is one, or to more of the same, for 5."""
    transition = np.array([[[1.0, 0.0], [0.0, 1.0]], [[0.0, 1.0], [0.0, 1.0]]])
    reward = np.array([[-1.0, -1.0], [-5.0, -1.0]])
    return table_model(transition, np.ones((2, 2, 1)), reward, [False, ends])


def test_steps_that_all_cost_may_be_spared_by_an_end():
    options = DespotOptions(scenarios=5, max_depth=30, discount=0.95, trials=100, reward_bounds=(-5.0, -1.0))
    assert despot_rewards.trivial_rewards(costly(ends=True), options) == (-5.0, 0.0)
    assert despot_rewards.trivial_rewards(costly(ends=False), options) == (-5.0, -1.0)
    assert despot_rewards.trivial_rewards(textbook.tag(), options) == (-5.0, 0.0)
    for lower in ("rollout", "trivial"):
        plan = Despot(costly(ends=True), dataclasses.replace(options, lower=lower)).plan([0.0], 0)
        assert plan.action == 1
        assert plan.bounds == pytest.approx((-5.0, -5.0))
    assert Despot(costly(ends=False), options).plan([0.0], 0).action == 0


def test_a_belief_in_an_ended_state_is_worth_nothing():
    for rewards in (None, (-5.0, -1.0)):
        model = costly(ends=True) if rewards else table_model(*tables_of(costly(ends=True)), discount=0.95)
        options = DespotOptions(scenarios=8, max_depth=10, reward_bounds=rewards)
        plan = Despot(model, options).plan([1.0], 0)
        assert plan.bounds == (0.0, 0.0)
        assert plan.values.tolist() == [0.0, 0.0]
        half = Despot(model, options).plan(Particles(np.array([0.0, 1.0]), np.array([0.5, 0.5])), 0)
        assert half.bounds == pytest.approx((-2.5, -2.5))


def tables_of(model):
    """(transition, observation, reward, terminal) of a model made of dense tables."""
    data, size = model.data, len(model.data.terminal)
    transition = np.diff(data.transition, axis=1, prepend=0.0).reshape(-1, size, size)
    observation = np.diff(data.observation, axis=1, prepend=0.0).reshape(len(transition), size, -1)
    return transition, observation, data.reward.reshape(transition.shape), data.terminal


# ---- what was promised


@pytest.mark.parametrize("options", [{"discount": 0.95}, {"discount": 0.4}, {"discount": 1.0, "max_depth": 5}])
def test_an_upper_bound_for_another_discount_is_refused(options, random_pomdp):
    model = table_model(*random_pomdp(0), discount=0.5)
    with pytest.raises(
        ValueError, match=rf"discount is {options['discount']}, and the model's upper bound .* 0\.5 only"
    ):
        Despot(model, DespotOptions(**options))
    Despot(model, DespotOptions(discount=0.5))
    without = table_model(*random_pomdp(0))
    Despot(without, DespotOptions(reward_bounds=(-9.0, 9.0), **options))


def test_the_textbook_says_for_which_discount_its_bounds_hold():
    for model in (textbook.tag(), textbook.laser_tag()):
        with pytest.raises(ValueError, match=r"discount is 0\.9, and the model's upper bound holds .* of 0\.95 only"):
            Despot(model, DespotOptions(discount=0.9))
    Despot(textbook.rock_sample(), DespotOptions(discount=0.9))  # it reckons with the discount that it is given


@pytest.mark.parametrize(
    ("promised", "given", "enough"),
    [((-1, 1), "-100", "-100, 10"), ((-100, 5), "10", "-100, 10"), ((-50, 20), "-100", "-100, 20")],
)
def test_rewards_of_tables_are_held_against_what_was_promised(promised, given, enough):
    with pytest.raises(ValueError, match=rf"gives a reward of {given}: .* give at least \({enough}\)"):
        Despot(textbook.tiger(), DespotOptions(reward_bounds=promised))
    Despot(textbook.tiger(), DespotOptions(reward_bounds=(-100, 10)))


def test_rewards_that_no_step_can_bring_count_for_nothing():
    """Those of transitions of probability 0, and of states that have ended."""
    transition = np.array([[[0.0, 1.0], [0.0, 1.0]]])
    reward = np.array([[[99.0, 2.0], [99.0, 99.0]]])
    for given in (transition, [scipy.sparse.csr_array(transition[0])]):
        seen = np.ones((1, 2, 1)) if given is transition else [scipy.sparse.csr_array(np.ones((2, 1)))]
        model = table_model(given, seen, reward, [False, True])
        assert tables.reward_range(model.data) == (0.0, 2.0)
        plan = Despot(model, DespotOptions(reward_bounds=(0, 2), scenarios=3)).plan([0.0], 0)
        assert plan.bounds == (2.0, 2.0)


def jackpot(state, action, data, rng):
    """Pays 1 a step, and 7 at the third."""
    state[0] += 1.0
    return np.int64(0), 7.0 if state[0] == 3.0 else 1.0, False


def own_rollout(state, action, observation, depth, max_depth, discount, data, rng):
    return 0.0


@pytest.mark.parametrize("rollout", [None, own_rollout])
@pytest.mark.parametrize("compiled", [True, False])
def test_a_reward_that_was_not_promised_is_found_by_the_search(compiled, rollout):
    model = CompiledModel(jackpot, 2, 1, rollout=rollout)
    options = DespotOptions(scenarios=4, trials=50, max_depth=4, reward_bounds=(1, 2), compiled=compiled)
    with pytest.raises(ValueError, match=r"reward_bounds is \(1, 2\), and the model gives a reward of 7: .*\(1, 7\)"):
        Despot(model, options).plan([0.0], 0)
    enough = dataclasses.replace(options, reward_bounds=(1, 7))
    assert Despot(model, enough).plan([0.0], 0).tree.bounds[ROOT, 0] > 4.0
