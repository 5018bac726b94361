"""The scenario search: its twin, its bounds, exact values, budgets and memory."""

from __future__ import annotations

import dataclasses
import math

import numba
import numpy as np
import pytest

from tab_marl.planning import CompiledModel, Despot, DespotOptions, Particles, textbook
from tab_marl.planning.model import PlainPythonWarning
from tab_marl.planning.search.tree import ROOT
from tab_marl.planning.tables import table_model

heavy = pytest.mark.skipif(bool(numba.config.DISABLE_JIT), reason="takes hours interpreted")
TIGER = {"reward_bounds": (-100.0, 10.0), "scenarios": 60, "trials": 25, "max_depth": 10}
TAG = {"scenarios": 20, "trials": 6}


def tag_belief(count=50):
    return textbook.TagBelief(4).sample(count, np.random.default_rng(0))


CASES = {
    "tiger": (textbook.tiger, TIGER, {}),
    "penalty": (textbook.tiger, TIGER | {"regularisation": 0.3, "trials": 60}, {}),
    "trivial bound": (textbook.tiger, TIGER | {"lower": "trivial"}, {}),
    "restricted": (textbook.tiger, TIGER, {"allowed": [0, 2]}),
    "shallow": (textbook.tiger, TIGER | {"tree_depth": 2}, {}),
    "no discount": (textbook.tiger, TIGER | {"discount": 1.0, "max_depth": 4}, {}),
    "full": (textbook.tiger, TIGER | {"max_nodes": 200}, {}),
    "upper bound of the model": (textbook.tag, TAG, {}),
}


@pytest.mark.parametrize("case", CASES)
def test_the_kernel_builds_the_same_tree_as_its_slow_twin(case, same_tree):
    make, changes, root = CASES[case]
    belief = [0.0, 1.0] if make is textbook.tiger else tag_belief()
    options = DespotOptions(**changes)
    fast = Despot(make(), options).plan(belief, 3, **root)
    slow = Despot(make(), dataclasses.replace(options, compiled=False)).plan(belief, 3, **root)
    assert same_tree(fast.tree, slow.tree)
    assert (fast.action, fast.depth, fast.steps, fast.simulations) == (
        slow.action,
        slow.depth,
        slow.steps,
        slow.simulations,
    )
    assert (fast.stopped, fast.full, fast.bounds) == (slow.stopped, slow.full, slow.bounds)
    assert fast.full == (case == "full")


# ---- exact values


@heavy
@pytest.mark.parametrize("seed", range(4))
def test_values_agree_with_expectimax(seed, random_pomdp, expectimax):
    pomdp = random_pomdp(seed)
    exact = expectimax(pomdp, np.array([0.5, 0.5, 0.0]), 3, 0.9)
    model = table_model(*pomdp, discount=0.9)
    options = DespotOptions(scenarios=20000, discount=0.9, max_depth=3, trials=500)
    plan = Despot(model, options).plan([0.0, 1.0], seed)
    assert plan.stopped == "closed"
    assert plan.bounds[1] - plan.bounds[0] <= options.gap
    assert plan.action == exact.argmax()
    assert plan.values.max() == pytest.approx(exact.max(), abs=0.04)  # 20,000 scenarios: a standard error of about 0.01


@heavy
def test_tiger_is_played_optimally(tiger_value):
    best, optimal = tiger_value()
    assert best == pytest.approx(19.37, abs=0.01)  # the published optimum
    options = DespotOptions(scenarios=2000, trials=60, max_depth=40, reward_bounds=(-100, 10))
    chosen = optimal.copy()
    for surplus in range(-3, 4):
        left = 1 / (1 + (0.15 / 0.85) ** surplus)
        plan = Despot(textbook.tiger(), options).plan(Particles(np.array([0.0, 1.0]), np.array([left, 1 - left])), 1)
        chosen[surplus + 12] = plan.action
    assert chosen[12] == textbook.LISTEN
    assert tiger_value(chosen)[0] == pytest.approx(best, abs=0.02)


# ---- what the bounds must satisfy


@heavy
def test_bounds_obey_bellman_and_only_tighten():
    def plan(trials):
        return Despot(textbook.tag(), DespotOptions(scenarios=50, trials=trials)).plan(tag_belief(), 5)

    few, many = plan(3), plan(30)
    assert few.bounds[0] <= many.bounds[0] <= many.bounds[1] <= few.bounds[1]
    tree = many.tree
    assert (tree.bounds[:, 0] <= tree.bounds[:, 1] + 1e-9).all()
    # At the root each action's value is its mean reward and the discounted lower bounds of what follows.
    for edge in tree.edges_of(ROOT):
        children = list(tree.children(edge))
        following = sum(tree.nodes["visits"][c] / 50 * tree.bounds[c, 0] for c in children)
        reward = -10.0 if tree.edge_actions[edge] == textbook.TAG else -1.0
        caught = 50 - sum(int(tree.nodes["visits"][c]) for c in children)
        assert caught == 0 or tree.edge_actions[edge] == textbook.TAG
        expected = reward * (50 - caught) / 50 + 10.0 * caught / 50 + 0.95 * following
        assert tree.edges["value"][edge] == pytest.approx(expected)
        assert tree.edges["visits"][edge] == 50


def test_actions_are_compared_on_the_same_scenarios():
    model = table_model(
        np.full((3, 4, 4), 0.25), np.full((3, 4, 2), 0.5), np.tile(np.arange(4.0), (3, 4, 1)), discount=0.95
    )
    plan = Despot(model, DespotOptions(scenarios=7, trials=1, max_depth=1)).plan([0.0], 0)
    assert plan.values[0] == plan.values[1] == plan.values[2]


@heavy
def test_a_penalty_makes_the_policy_smaller_until_only_the_default_is_left():
    sizes = []
    for penalty in (0.0, 0.05, 100.0):
        options = DespotOptions(scenarios=50, trials=40, regularisation=penalty)
        plan = Despot(textbook.tag(), options).plan(tag_belief(), 5)
        sizes.append(len(plan.tree))
    assert sizes[0] > sizes[1] > sizes[2]
    assert plan.depth == 1
    assert plan.stopped == "closed"


def test_where_there_is_nothing_to_gain_the_root_is_still_expanded():
    plan = Despot(textbook.tag(), DespotOptions(scenarios=20)).plan([[3, 3]], 0)
    assert plan.action == textbook.TAG
    assert plan.bounds == (10.0, 10.0)
    assert plan.stopped == "closed"
    assert np.isfinite(plan.values).all()


# ---- budgets and memory


@heavy
def test_time_and_memory_are_bounded():
    belief = tag_belief()
    quick = Despot(textbook.tag(), DespotOptions(scenarios=200, seconds=0.02)).plan(belief, 1)
    assert quick.stopped == "seconds"
    assert quick.seconds < 5.0
    assert (quick.visits == 200).all()
    small = Despot(textbook.tag(), DespotOptions(scenarios=20, max_nodes=600)).plan(belief, 1)
    assert (small.stopped, small.full) == ("full", True)
    assert len(small.tree) <= 600


@heavy
def test_the_tree_does_not_depend_on_how_often_the_arrays_grew(monkeypatch, same_tree):
    from tab_marl.planning.search import despot

    planner = Despot(textbook.tag(), DespotOptions(scenarios=30, trials=20))
    whole = planner.plan(tag_belief(), 8)
    monkeypatch.setattr(despot, "_FIRST_EXPANSIONS", 1)
    again = planner.plan(tag_belief(), 8)
    assert same_tree(again.tree, whole.tree)
    assert not same_tree(planner.plan(tag_belief(), 9).tree, whole.tree)


# ---- plain Python, errors


class PlainTiger:
    actions = 3

    def step(self, state, action, rng):
        if action == 0:
            heard = state if rng.random() < 0.85 else {"left": "right", "right": "left"}[state]
            return state, f"hear {heard}", -1.0, False
        reward = -100.0 if (action == 1) == (state == "left") else 10.0
        return str(rng.choice(["left", "right"])), "nothing", reward, False

    def upper(self, state, depth, max_depth, discount):
        return 10.0 * (max_depth - depth)


def test_a_plain_python_model_is_searched_and_said_to_be_slow():
    class Fresh(PlainTiger):
        pass

    planner = Despot(Fresh(), DespotOptions(scenarios=60, trials=5, max_depth=3))
    with pytest.warns(PlainPythonWarning, match="Fresh is a model in plain Python"):
        plan = planner.plan(["left", "right"], 0)
    assert plan.action == 0
    seen = {plan.tree.observation(c) for e in plan.tree.edges_of(ROOT) for c in plan.tree.children(e)}
    assert seen == {"hear left", "hear right", "nothing"}


def measuring_step(state, action, data, rng):
    return 0.5, 1.0, False


def test_a_measured_observation_is_refused_where_it_would_be_cut():
    model = CompiledModel(measuring_step, 2, 1)
    options = DespotOptions(scenarios=5, reward_bounds=(0, 1), compiled=False)
    with pytest.raises(TypeError, match=r"measuring_step returned 0\.5 as its observation, which would be cut"):
        Despot(model, options).plan([0.0], 0)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"scenarios": 0}, "scenarios is 0, must be >= 1"),
        ({"scenarios": 50.0}, "scenarios is 50.0, must be a whole number: write 50"),
        ({"regularisation": "none"}, "regularisation is 'none', must be a number"),
        ({"trials": 0}, "trials is 0"),
        ({"regularisation": -1.0}, "regularisation is -1.0"),
        ({"share": 1.0}, r"share is 1.0, must be in \[0, 1\)"),
        ({"gap": -1.0}, "gap is -1.0"),
        ({"lower": "none"}, "lower is 'none'"),
        ({"lower": "trivial"}, "give the .least, greatest. reward"),
        ({"reward_bounds": (1.0, 0.0)}, "reward_bounds is"),
        ({"reward_bounds": (0.0, math.inf)}, "reward_bounds is"),
        ({"discount": 1.0}, "give max_depth"),
        ({"max_nodes": 0}, "max_nodes is 0"),
        ({"seconds": 0}, "seconds is 0"),
    ],
)
def test_bad_options_are_named(change, words):
    with pytest.raises(ValueError, match=words):
        DespotOptions(**change)


def test_what_the_search_needs_is_asked_for():
    with pytest.raises(ValueError, match="no upper bound"):
        Despot(textbook.tiger(), DespotOptions())
    with pytest.raises(ValueError, match=r"max_nodes is 100, must be >= 1 \+ scenarios \* actions = 2501"):
        Despot(textbook.tag(), DespotOptions(max_nodes=100))
    with pytest.raises(ValueError, match="belief is empty"):
        Despot(textbook.tag(), DespotOptions(scenarios=5)).plan(np.empty((0, 2)), 0)
