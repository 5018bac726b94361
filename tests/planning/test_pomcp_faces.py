"""What else the planner promises: going on with a tree, particle beliefs, priors, plain Python models, errors, the cache."""

from __future__ import annotations

import dataclasses
import itertools
import math
import subprocess
import sys

import numba
import numpy as np
import pytest

from tab_marl.planning import FilterOptions, ParticleFilter, textbook
from tab_marl.planning.beliefs.belief import BeliefDepleted, update_particles
from tab_marl.planning.model import CompiledModel, Particles
from tab_marl.planning.random_kernels import uniform
from tab_marl.planning.search.pomcp import START, Pomcp, PomcpOptions
from tab_marl.planning.search.tree import ROOT
from tab_marl.planning.tables import table_model

heavy = pytest.mark.skipif(bool(numba.config.DISABLE_JIT), reason="takes hours interpreted")


def noisy_step(state, action, data, rng):
    state[0] += uniform(rng)
    return np.int64(state[0]), state[0] * 0.1 - action * data[0], state[0] > 4.0


NOISY = CompiledModel(noisy_step, 4, 1, data=(0.02, 0.05))


# ---- going on with a tree


def rebuilt(tree, node):
    """The tree below a node as nested tuples, whatever its numbering."""
    return tuple(
        (
            int(tree.edge_actions[e]),
            float(tree.edges["value"][e]),
            int(tree.edges["visits"][e]),
            tuple((tree.observation(c), rebuilt(tree, c)) for c in tree.children(e)),
        )
        for e in tree.edges_of(node)
    )


def test_the_tree_after_a_step_is_the_part_below_it():
    plan = Pomcp(textbook.tag(), PomcpOptions(simulations=2000)).plan([[3, 9], [3, 20]], 1)
    action, seen = plan.tree.best_line()[0]
    node = plan.tree.child(ROOT, action, seen)
    after = plan.tree.after(action, seen)
    assert rebuilt(after, ROOT) == rebuilt(plan.tree, node)
    assert after.nodes["visits"][ROOT] == sum(after.edges["visits"][e] for e in after.edges_of(ROOT))
    assert (after.parent_edge[1:] >= 0).all()
    assert plan.tree.after(action, 12345) is None
    some = after.subtree(ROOT, np.array([1, 4]))
    assert [int(a) for a in some.edge_actions[:2]] == [1, 4]
    assert rebuilt(some, ROOT) == tuple(part for part in rebuilt(after, ROOT) if part[0] in (1, 4))


def test_a_search_goes_on_with_a_tree(same_tree):
    options = PomcpOptions(simulations=600)
    planner = Pomcp(textbook.tag(), options)
    before = planner.plan([[3, 9], [3, 20]], 1)
    action, seen = before.tree.best_line()[0]
    after = before.tree.after(action, seen)
    held = int(after.nodes["visits"][ROOT])
    assert held > 50
    belief = [[seen, 9], [seen, 21]]
    plan = planner.plan(belief, 2, start=after)
    assert plan.visits.sum() == 600 + held
    slow = Pomcp(textbook.tag(), dataclasses.replace(options, compiled=False)).plan(belief, 2, start=after)
    assert same_tree(plan.tree, slow.tree)
    assert len(after) == len(before.tree.after(action, seen))  # the tree handed over is not changed
    fewer = planner.plan(belief, 2, start=after, allowed=[0, 1])
    assert (fewer.visits > 0).tolist() == [True, True, False, False, False]
    with pytest.raises(ValueError, match="start goes without priors"):
        planner.plan(belief, 2, start=after, prior_values=1.0, prior_counts=1)


def test_a_plain_python_search_goes_on_with_a_tree():
    planner = Pomcp(PlainTiger(), PomcpOptions(simulations=300, exploration=100.0, max_depth=4))
    after = planner.plan(["left", "right"], 0).tree.after(0, "hear left")
    held = int(after.nodes["visits"][ROOT])
    assert planner.plan(["left"], 0, start=after).visits.sum() == 300 + held


# ---- particles


@heavy
def test_rejection_agrees_with_bayes():
    model, rng = textbook.tag(), np.random.default_rng(0)
    states = update_particles(
        model, np.column_stack([np.full(29, 4), np.arange(29)]), textbook.EAST, 5, rng, count=20000
    )
    exact = textbook.TagBelief(4).updated(model.data, textbook.EAST, 5)
    assert (states[:, 0] == 5).all()
    assert np.abs(np.bincount(states[:, 1].astype(int), minlength=29) / 20000 - exact.target).max() < 0.01


def test_a_belief_that_runs_dry_says_so():
    model, rng = textbook.tag(), np.random.default_rng(0)
    with pytest.raises(BeliefDepleted, match="none of 500 simulated steps of action 1 gave observation 28"):
        update_particles(model, [[4, 9]], textbook.EAST, 28, rng, tries=500)
    few = update_particles(model, [[4, 9]], textbook.EAST, 5, rng, count=100, tries=10)
    assert few.shape == (100, 2)
    assert len(np.unique(few, axis=0)) <= 10


# ---- priors, restrictions, scenarios


def test_the_root_keeps_to_what_is_allowed():
    plan = Pomcp(NOISY, PomcpOptions(simulations=200, max_depth=4)).plan([0.0], 0, allowed=[False, True, False, True])
    assert (plan.visits > 0).tolist() == [False, True, False, True]
    assert np.isneginf(plan.values[[0, 2]]).all()
    assert plan.action in (1, 3)


def test_a_prior_starts_the_root_as_if_tried():
    options = PomcpOptions(simulations=1, max_depth=4)
    plan = Pomcp(NOISY, options).plan([0.0], 0, prior_values=[7, 8, 9, 6], prior_counts=50)
    assert plan.visits.sum() == 201
    assert plan.action == 2  # the only simulation went where the prior was best, and could not change that
    assert plan.visits[2] == 51
    assert plan.values[[0, 1, 3]].tolist() == [7, 8, 6]


def test_preferred_actions_are_asked_at_the_root_and_at_new_nodes():
    model = textbook.tag("uniform", preferred=True)
    plan = Pomcp(model, PomcpOptions(simulations=400)).plan([[3, 20]], 0, latest=(textbook.EAST, 3))
    # from cell 3 of the lower row, having come from the west: east and north are free and do not double back
    assert plan.visits.sum() == 400 + 20
    assert (plan.visits[[textbook.NORTH, textbook.EAST]] >= 10).all()
    tree = plan.tree
    child = tree.child(ROOT, textbook.EAST, 4)
    preferred = {int(tree.edge_actions[e]) for e in tree.edges_of(child) if tree.edges["visits"][e] >= 10}
    assert preferred >= {textbook.NORTH, textbook.EAST}


def test_before_the_first_action_a_prior_is_asked_all_the_same():
    robot = 4  # in the middle of the lower row: three ways lead off, none of them back
    model = textbook.tag("uniform", preferred=True)
    plan = Pomcp(model, PomcpOptions(simulations=1)).plan([[robot, 20]], 0, latest=START)
    assert (plan.visits >= 10).tolist() == [True, True, False, True, False]
    rocks = textbook.rock_sample(4, 4)
    belief = textbook.RockBelief(rocks.data).sample
    plain, asked = (Pomcp(rocks, PomcpOptions(simulations=300)).plan(belief, 0, latest=h) for h in (None, START))
    off_the_grid_or_bare = [textbook.WEST, 4]  # 4: sample
    assert (plain.visits[off_the_grid_or_bare] > 0).all()
    assert (asked.visits[off_the_grid_or_bare] == 0).all()
    assert asked.values[asked.visits > 0].min() > 0


@pytest.mark.filterwarnings("ignore:Guided is a model in plain Python")
def test_a_plain_prior_is_asked_before_the_first_action_too():
    class Guided(PlainTiger):
        def prior(self, state, action, observation, depth):
            assert state in ("left", "right")
            assert (action, observation) == START or action in range(3)
            return np.zeros(3), np.array([0, -1, 0])

    options = PomcpOptions(simulations=30, max_depth=3)
    filtered = ParticleFilter(Guided(), ["left", "right"], FilterOptions(count=20))
    for belief in (["left", "right"], filtered, filtered.sample):
        assert Pomcp(Guided(), options).plan(belief, 0, latest=START).visits[1] == 0


def test_common_random_numbers_make_a_particle_a_scenario():
    options = PomcpOptions(simulations=80, max_depth=1, exploration=50.0)
    shared = Pomcp(NOISY, dataclasses.replace(options, common_random_numbers=True)).plan([0.0], 0)
    # one scenario: every trial of an action saw the same noise, so that actions differ by their cost alone
    assert np.diff(shared.values) == pytest.approx([-0.02] * 3, abs=1e-12)
    fresh = Pomcp(NOISY, options).plan([0.0], 0)
    assert np.abs(np.diff(fresh.values) + 0.02).max() > 1e-4


@heavy
def test_weights_decide_how_often_a_particle_is_used():
    belief = Particles(np.array([[0.0], [1.0], [2.0]]), weights=np.array([1.0, 0.0, 3.0]))
    plan = Pomcp(NOISY, PomcpOptions(simulations=400, max_depth=2)).plan(belief, 0, allowed=[0])
    seen = {plan.tree.observation(c): int(plan.tree.nodes["visits"][c]) for c in plan.tree.children(0)}
    assert seen == {0: 100, 2: 300}  # to within one by systematic resampling, here exactly


# ---- plain Python


class PlainTiger:
    actions = 3

    def step(self, state, action, rng):
        if action == 0:
            heard = state if rng.random() < 0.85 else {"left": "right", "right": "left"}[state]
            return state, f"hear {heard}", -1.0, False
        reward = -100.0 if (action == 1) == (state == "left") else 10.0
        return str(rng.choice(["left", "right"])), "nothing", reward, False


@heavy
def test_a_plain_python_model_agrees_with_the_compiled_one():
    options = PomcpOptions(simulations=8000, exploration=500.0, max_depth=2)
    plain = Pomcp(PlainTiger(), options).plan(["left", "right"], 0)
    compiled = Pomcp(textbook.tiger(), options).plan([0.0, 1.0], 0)
    assert plain.action == compiled.action == 0
    assert plain.values[0] == pytest.approx(compiled.values[0], abs=1.0)
    # tried some 400 times, for returns between -200 and 20
    assert plain.values == pytest.approx(compiled.values, abs=18.0)
    assert {plain.tree.observation(c) for c in plain.tree.children(0)} == {"hear left", "hear right"}
    assert "sees hear" in str(plain.explain())


# ---- faces


def test_a_plan_explains_itself():
    plan = Pomcp(textbook.tiger(), PomcpOptions(simulations=2000, exploration=60.0)).plan([0.0, 1.0], 0)
    text = str(plan)
    assert text.splitlines()[1].startswith("* listen")
    assert "most likely line: listen (sees " in text
    assert "2000 simulations in " in text


@heavy
def test_a_second_process_finds_the_compiled_search_on_disk():
    program = (
        "from tab_marl.planning import textbook; from tab_marl.planning.search import kernels;"
        "from tab_marl.planning.search.pomcp import Pomcp, PomcpOptions;"
        "Pomcp(textbook.tag(), PomcpOptions(simulations=10)).plan([[0, 1]], 0);"
        "print(sum(kernels.search.stats.cache_hits.values()), sum(kernels.search.stats.cache_misses.values()))"
    )
    for _ in range(2):
        result = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert result.stdout.split() == ["1", "0"]


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"simulations": 0}, "simulations is 0, must be >= 1"),
        ({"exploration": -1.0}, "exploration is -1.0, must be finite, >= 0"),
        ({"exploration": math.inf}, "exploration is inf"),
        ({"discount": 1.2}, r"discount is 1.2, must be in \(0, 1\]"),
        ({"discount": 1.0}, "give max_depth"),
        ({"max_depth": 0}, "max_depth is 0, must be >= 1"),
        ({"tree_depth": -1}, "tree_depth is -1"),
        ({"seconds": 0.0}, "seconds is 0.0, must be > 0"),
        ({"max_nodes": 0}, "max_nodes is 0"),
        ({"choose": "best"}, "choose is 'best'"),
        ({"simulations": 1e3}, "simulations is 1000.0, must be a whole number: write 1000"),
        ({"simulations": "10"}, "simulations is '10', must be a whole number"),
        ({"simulations": None}, "simulations is None, must be a whole number"),
        ({"max_depth": 5.0}, "max_depth is 5.0, must be a whole number: write 5"),
        ({"exploration": "ten"}, "exploration is 'ten', must be a number"),
        ({"seconds": "1"}, "seconds is '1', must be a number"),
    ],
)
def test_bad_options_are_named(change, words):
    with pytest.raises(ValueError, match=words):
        PomcpOptions(**change)


@pytest.mark.parametrize(
    ("belief", "root", "words"),
    [
        ([[0.0, 1.0]], {}, r"shape \(1, 2\), must be \[P, 1\]"),
        (np.empty((0, 1)), {}, "belief is empty"),
        (Particles(np.zeros(2), np.zeros(2)), {}, "weights must be finite, >= 0 and not all zero"),
        (Particles(np.zeros(2), np.ones(3)), {}, r"weights of shape \(3,\) for 2 states"),
        ([0.0], {"allowed": []}, "names no action"),
        ([0.0], {"allowed": [4]}, r"allowed holds 4..4, must be in 0..3"),
        ([0.0], {"allowed": [True, False]}, r"must be bool\[4\]"),
        ([0.0], {"prior_values": 1.0}, "go together"),
        ([0.0], {"prior_values": 1.0, "prior_counts": -1}, "must be >= 0"),
        ([0.0], {"prior_values": math.nan, "prior_counts": 1}, "must be finite"),
        ([0.0], {"latest": (0, 0)}, "has no prior"),
    ],
)
def test_bad_beliefs_and_roots_are_named(belief, root, words):
    with pytest.raises(ValueError, match=words):
        Pomcp(NOISY, PomcpOptions(simulations=10)).plan(belief, 0, **root)


def test_rewards_that_are_not_numbers_are_reported():
    with pytest.raises(ValueError, match="action 0 has value nan"):
        Pomcp(NOISY, PomcpOptions(simulations=10)).plan([math.nan], 0)


def rounded_step(state, action, data, rng):
    """Its observation is a float where it ought to be a number of its own."""
    state[0] += uniform(rng)
    return state[0], 0.0, False


def test_a_float_observation_is_refused_interpreted_too():
    for compiled in (True, False):
        with pytest.raises(
            TypeError, match=r"rounded_step return(s a float|ed np.float64).* cut to a whole number.*np.int64"
        ):
            Pomcp(CompiledModel(rounded_step, 2, 1), PomcpOptions(simulations=10, compiled=compiled)).plan([0.0], 0)


class Still:
    actions = 2
    rollout = prior = action_names = None  # as a base class for others may have it

    def __init__(self, result):
        self.result = result

    def step(self, state, action, rng):
        return self.result


@pytest.mark.filterwarnings("ignore:Still is a model in plain Python")
def test_what_a_plain_step_may_not_return_is_named():
    options = PomcpOptions(simulations=20, max_depth=3)
    assert Pomcp(Still((0, "seen", 1.0, False)), options).plan([0], 0).values == pytest.approx([2.8525] * 2)
    with pytest.raises(
        TypeError, match=r"Still.step returned \(0, 1.0, False\), must return four things: \(next state"
    ):
        Pomcp(Still((0, 1.0, False)), options).plan([0], 0)
    with pytest.raises(TypeError, match=r"Still.step returned None, must return four things"):
        Pomcp(Still(None), options).plan([0], 0)
    with pytest.raises(TypeError, match=r"observation array\(\[1, 2\]\), a ndarray, must be hashable .*tuple"):
        Pomcp(Still((0, np.array([1, 2]), 1.0, False)), options).plan([0], 0)


@pytest.mark.parametrize(
    ("actions", "words"),
    [
        (["a", "b"], r"actions is \['a', 'b'\], must be the number of actions.*write actions = 2.*action_names"),
        (2.0, "actions is 2.0, must be the number of actions, a whole one"),
        ("ab", "actions is 'ab', must be the number of actions"),
        (0, "actions is 0, must be >= 1"),
    ],
)
def test_actions_that_are_no_number_are_named(actions, words):
    model = Still(None)
    model.actions = actions
    with pytest.raises(ValueError, match=words):
        Pomcp(model)
    with pytest.raises(ValueError, match=words):
        CompiledModel(rounded_step, actions, 1)
    with pytest.raises(ValueError, match=r"state_size is 1.0, must be a whole number: write 1"):
        CompiledModel(rounded_step, 2, 1.0)


def test_a_model_without_step_is_refused():
    with pytest.raises(TypeError, match="needs `actions` and `step`"):
        Pomcp(object())


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"transition": np.ones((2, 2, 2))}, r"transition\[0, 0\] = T\(. \| state, action\) is not a distribution"),
        ({"transition": np.full((2, 3, 2), 0.5)}, r"must be \[A, S, S\]"),
        ({"observation": np.full((2, 3, 2), 0.5)}, r"must be \[2, 2, O\]"),
        ({"reward": np.ones(2)}, r"reward has shape \(2,\)"),
        ({"reward": np.full((2, 2), np.inf)}, "not finite"),
        ({"terminal": [True]}, r"terminal has shape \(1,\)"),
        ({"action_names": ("one",)}, "1 names for 2 actions"),
    ],
)
def test_bad_tables_are_named(changes, words):
    tables = {"transition": np.full((2, 2, 2), 0.5), "observation": np.full((2, 2, 2), 0.5), "reward": np.ones((2, 2))}
    with pytest.raises(ValueError, match=words):
        table_model(**(tables | changes))


def test_a_draw_never_lands_on_an_impossible_state():
    rows = np.array([[0.1] * 10 + [0.0]])  # ten times 0.1 does not sum to 1 in floating point
    transition = np.repeat(rows, 11, axis=0)[None]
    model = table_model(
        transition, np.ones((1, 11, 1)), np.where(np.arange(11) == 10, np.nan_to_num(np.inf), 0.0)[None]
    )
    top = model.data.transition[:, 9]
    assert (top == 1.0).all()
    assert all(a <= b for a, b in itertools.pairwise(model.data.transition[0]))
