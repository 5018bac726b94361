"""The search against exact answers, and what it promises about seeds, bounds, priors and its own kernel."""

from __future__ import annotations

import dataclasses
import itertools
import math
import subprocess
import sys

import numpy as np
import pytest

from tab_marl.planning import pomcp as pomcp_module
from tab_marl.planning import textbook
from tab_marl.planning.belief import BeliefDepleted, update_particles
from tab_marl.planning.model import CompiledModel, Particles, table_model
from tab_marl.planning.pomcp import Pomcp, PomcpOptions
from tab_marl.planning.random_kernels import uniform
from tab_marl.planning.tree import NO_PARENT, ROOT


def same_tree(a, b) -> bool:
    return (
        np.array_equal(a.nodes, b.nodes)
        and np.array_equal(a.edges, b.edges)
        and np.array_equal(a.edge_actions, b.edge_actions)
    )


# ---- exact values


def random_pomdp(seed: int):
    rng = np.random.default_rng(seed)
    transition = rng.dirichlet(np.ones(3), size=(2, 3))
    observation = rng.dirichlet(np.full(2, 0.5), size=(2, 3))
    reward = rng.normal(size=(2, 3, 3))
    terminal = np.array([False, False, True])
    return transition, observation, reward, terminal


def expectimax(pomdp, belief, depth, discount):
    """Best values [A] of each action by enumerating all observations, from an unnormalised belief."""
    transition, observation, reward, terminal = pomdp
    values = np.zeros(len(transition))
    for a in range(len(transition)):
        joint = belief[:, None] * transition[a]
        values[a] = (joint * reward[a]).sum()
        after = np.where(terminal, 0.0, joint.sum(axis=0))
        if depth > 1:
            for o in range(observation.shape[2]):
                values[a] += discount * expectimax(pomdp, after * observation[a][:, o], depth - 1, discount).max()
    return values


@pytest.mark.parametrize("seed", range(6))
def test_values_agree_with_expectimax(seed):
    pomdp = random_pomdp(seed)
    exact = expectimax(pomdp, np.array([0.5, 0.5, 0.0]), 3, 0.9)
    planner = Pomcp(table_model(*pomdp), PomcpOptions(simulations=60000, exploration=2.0, discount=0.9, max_depth=3))
    plan = planner.plan(np.array([0.0, 1.0]), seed)
    assert plan.action == exact.argmax()
    assert plan.values.max() == pytest.approx(exact.max(), abs=0.03)
    assert plan.values[plan.action] <= exact.max() + 0.02  # trying worse actions below can only lower the mean


def test_the_error_falls_like_the_root_of_the_simulations():
    # With one action there is nothing to choose: what is left is the error of sampling.
    transition, observation, reward, terminal = random_pomdp(0)
    pomdp = (transition[:1], observation[:1], reward[:1], terminal)
    exact = expectimax(pomdp, np.array([0.5, 0.5, 0.0]), 3, 0.9)[0]
    budgets = [100, 1600, 25600]
    errors = [
        [
            Pomcp(table_model(*pomdp), PomcpOptions(simulations=budget, discount=0.9, max_depth=3))
            .plan(np.array([0.0, 1.0]), seed)
            .values[0]
            - exact
            for seed in range(60)
        ]
        for budget in budgets
    ]
    rms = np.sqrt((np.array(errors) ** 2).mean(axis=1))
    slope = np.polyfit(np.log(budgets), np.log(rms), 1)[0]
    assert -0.6 < slope < -0.4


def tiger_value(policy=None, discount=0.95, reach=12):
    """Exact Tiger: the belief is the surplus of growls heard on the left. Value at surplus 0, and the best action at each."""
    surplus = np.arange(-reach, reach + 1)
    left = 1 / (1 + (0.15 / 0.85) ** surplus)
    value = np.zeros(len(surplus))
    for _ in range(2000):
        hear_left = 0.85 * left + 0.15 * (1 - left)
        up, down = np.append(value[1:], value[-1]), np.insert(value[:-1], 0, value[0])
        q = np.array(
            [
                -1 + discount * (hear_left * up + (1 - hear_left) * down),
                -100 * left + 10 * (1 - left) + discount * value[reach],
                10 * left - 100 * (1 - left) + discount * value[reach],
            ]
        )
        value = q.max(axis=0) if policy is None else q[policy, np.arange(len(surplus))]
    return value[reach], q.argmax(axis=0)


@pytest.mark.parametrize("seed", range(3))
def test_tiger_is_played_optimally(seed):
    best, optimal = tiger_value()
    assert best == pytest.approx(19.37, abs=0.01)  # the published optimum
    planner = Pomcp(textbook.tiger(), PomcpOptions(simulations=20000, exploration=150.0, max_depth=25))
    chosen = optimal.copy()
    for surplus in range(-3, 4):
        left = 1 / (1 + (0.15 / 0.85) ** surplus)
        belief = Particles(np.array([0.0, 1.0]), weights=np.array([left, 1 - left]))
        chosen[surplus + 12] = planner.plan(belief, seed).action
    assert chosen[12] == textbook.LISTEN
    assert tiger_value(chosen)[0] == pytest.approx(best, abs=0.02)


def test_the_patient_rollout_of_tiger_earns_the_optimum():
    # From the uniform belief that rollout is the optimal policy: one action (listen), then the rollout, is the optimum.
    only_listen = PomcpOptions(simulations=20000, tree_depth=0, max_depth=200)
    plan = Pomcp(textbook.tiger(), only_listen).plan([0.0, 1.0], 0, allowed=[0])
    # a listen that is then forgotten costs 1 and a step
    assert plan.values[0] == pytest.approx(-1 + 0.95 * 19.37, abs=0.6)


def test_rewards_after_a_terminal_state_do_not_count_and_discount_one_sums():
    # A corridor: action 0 walks on for -1, the last step earns 10 and ends; action 1 gives up at once for 0.
    corridor = table_model(
        transition=[np.eye(5)[[1, 2, 3, 4, 4]], np.eye(5)[[4] * 5]],
        observation=[np.eye(5)] * 2,
        reward=[[-1, -1, -1, 10, 1000], [0, 0, 0, 0, 1000]],
        terminal=[False] * 4 + [True],
    )
    options = PomcpOptions(simulations=3000, exploration=20.0, discount=1.0, max_depth=6)
    plan = Pomcp(corridor, options).plan([0.0], 0)
    assert plan.action == 0
    assert plan.values[1] == 0.0
    assert 6.0 < plan.values[0] <= 7.0
    assert plan.depth == 4
    assert [action for action, _ in plan.tree.best_line()] == [0, 0, 0, 0]


# ---- the twin


def noisy_step(state, action, data, rng):
    state[0] += uniform(rng)
    return np.int64(state[0]), state[0] * 0.1 - action * data[0], state[0] > 4.0


def all_forbidden_after_one(state, action, observation, depth, data, values, counts):
    counts[:] = -1
    if depth < 2:
        counts[action] = 3
        values[action] = 0.5
        counts[2] = 0


def constant_rollout(state, action, observation, depth, max_depth, discount, data, rng):
    return data[1] * (max_depth - depth) + action + uniform(rng)


NOISY = CompiledModel(noisy_step, 4, 1, data=(0.02, 0.05))
CASES = {
    "tables": (textbook.tiger(), [0.0, 1.0], {}, {}),
    "weights": (textbook.tiger(), Particles(np.array([0.0, 1.0]), np.array([0.2, 0.8])), {}, {}),
    "tag": (textbook.tag(), [[3, 9], [3, 20], [3, 28]], {}, {}),
    "engine rollout": (textbook.tag("engine"), [[3, 9], [3, 20], [3, 28]], {"max_depth": 15}, {}),
    "prior": (textbook.tag("uniform", preferred=True), [[3, 9], [3, 20]], {}, {"latest": (1, 3)}),
    "common numbers": (textbook.tag(), [[3, 9], [3, 20]], {"common_random_numbers": True}, {}),
    "sampler": (textbook.tag(), lambda n, rng: np.column_stack([np.full(n, 3), rng.integers(29, size=n)]), {}, {}),
    "few nodes": (textbook.tag(), [[3, 9], [3, 20]], {"max_nodes": 40}, {}),
    "shallow": (textbook.tag(), [[3, 9], [3, 20]], {"tree_depth": 1}, {}),
    "only the root": (textbook.tag(), [[3, 9], [3, 20]], {"tree_depth": 0}, {}),
    "restricted": (NOISY, [0.0], {"max_depth": 7}, {"allowed": [0, 3]}),
    "dead ends": (
        dataclasses.replace(NOISY, prior=all_forbidden_after_one, rollout=constant_rollout),
        [0.0, 0.5],
        {"max_depth": 7},
        {"prior_values": [1, 2, 3, 4], "prior_counts": [1, 0, 5, 2]},
    ),
    "no exploration": (NOISY, [0.0, 2.0], {"exploration": 0.0, "max_depth": 5}, {}),
}


@pytest.mark.parametrize("case", CASES)
def test_the_kernel_builds_the_same_tree_as_its_slow_twin(case):
    model, belief, changes, root = CASES[case]
    options = PomcpOptions(**({"simulations": 700, "exploration": 5.0} | changes))
    fast = Pomcp(model, options).plan(belief, 3, **root)
    slow = Pomcp(model, dataclasses.replace(options, compiled=False)).plan(belief, 3, **root)
    assert same_tree(fast.tree, slow.tree)
    assert (fast.action, fast.depth, fast.steps, fast.simulations) == (slow.action, slow.depth, slow.steps, 700)
    assert fast.steps >= 700 or case == "dead ends"


def test_a_seed_fixes_the_tree_and_another_changes_it():
    model, belief = textbook.tag(), textbook.TagBelief(4).sample(300, np.random.default_rng(0))
    planner = Pomcp(model, PomcpOptions(simulations=500))
    first, again, other = (
        planner.plan(belief, 8),
        planner.plan(belief, np.random.default_rng(8)),
        planner.plan(belief, 9),
    )
    assert same_tree(first.tree, again.tree)
    assert not same_tree(first.tree, other.tree)


def test_the_tree_does_not_depend_on_how_often_the_arrays_grew(monkeypatch):
    model, belief = textbook.tag(), textbook.TagBelief(4).sample(300, np.random.default_rng(0))
    options = PomcpOptions(simulations=900)
    whole = Pomcp(model, options).plan(belief, 8)
    monkeypatch.setattr(pomcp_module, "_FIRST_NODES", 3)
    assert same_tree(Pomcp(model, options).plan(belief, 8).tree, whole.tree)


# ---- what a tree must satisfy


def test_counts_add_up_and_every_node_hangs_from_one_edge():
    belief = textbook.TagBelief(4).sample(300, np.random.default_rng(0))
    plan = Pomcp(textbook.tag(), PomcpOptions(simulations=2000)).plan(belief, 8)
    tree = plan.tree
    assert plan.visits.sum() == 2000 == tree.nodes["visits"][ROOT]
    assert tree.parent_edge[ROOT] == NO_PARENT
    assert (tree.parent_edge[1:] >= 0).all()
    for node in range(len(tree)):
        edges = tree.edges_of(node)
        if edges:
            # the first visit made the node, the others chose among its edges
            assert sum(tree.edges["visits"][e] for e in edges) == tree.nodes["visits"][node] - (node != ROOT)
        for edge in edges:
            observations = [tree.observation(child) for child in tree.children(edge)]
            assert len(set(observations)) == len(observations)
            assert all(tree.parent_edge[child] == edge for child in tree.children(edge))
            ended = tree.edges["visits"][edge] - sum(tree.nodes["visits"][child] for child in tree.children(edge))
            assert ended >= 0
            assert ended == 0 or tree.edge_actions[edge] == textbook.TAG
    assert plan.values[plan.action] == plan.values.max()


def test_memory_is_bounded():
    belief = textbook.TagBelief(4).sample(300, np.random.default_rng(0))
    plan = Pomcp(textbook.tag(), PomcpOptions(simulations=3000, max_nodes=100)).plan(belief, 8)
    assert len(plan.tree) == 100
    assert plan.simulations == plan.visits.sum() == 3000


def test_time_is_bounded():
    belief = textbook.TagBelief(4).sample(300, np.random.default_rng(0))
    planner = Pomcp(textbook.tag(), PomcpOptions(simulations=10**8, seconds=0.05, max_nodes=2000))
    plan = planner.plan(belief, 8)
    assert 0.05 <= plan.seconds < 2.0
    assert 256 <= plan.simulations < 10**8


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


def test_a_search_goes_on_with_a_tree():
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


def test_common_random_numbers_make_a_particle_a_scenario():
    options = PomcpOptions(simulations=80, max_depth=1, exploration=50.0)
    shared = Pomcp(NOISY, dataclasses.replace(options, common_random_numbers=True)).plan([0.0], 0)
    # one scenario: every trial of an action saw the same noise, so that actions differ by their cost alone
    assert np.diff(shared.values) == pytest.approx([-0.02] * 3, abs=1e-12)
    fresh = Pomcp(NOISY, options).plan([0.0], 0)
    assert np.abs(np.diff(fresh.values) + 0.02).max() > 1e-4


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


def test_a_plain_python_model_agrees_with_the_compiled_one():
    options = PomcpOptions(simulations=8000, exploration=500.0, max_depth=2)
    plain = Pomcp(PlainTiger(), options).plan(["left", "right"], 0)
    compiled = Pomcp(textbook.tiger(), options).plan([0.0, 1.0], 0)
    assert plain.action == compiled.action == 0
    assert plain.values == pytest.approx(compiled.values, abs=12.0)
    assert {plain.tree.observation(c) for c in plain.tree.children(0)} == {"hear left", "hear right"}
    assert "sees hear" in plain.explain()


# ---- faces


def test_a_plan_explains_itself():
    plan = Pomcp(textbook.tiger(), PomcpOptions(simulations=2000, exploration=60.0)).plan([0.0, 1.0], 0)
    text = str(plan)
    assert text.splitlines()[1].startswith("* listen")
    assert "best line: listen (sees " in text
    assert "2000 simulations in " in text


def test_a_second_process_finds_the_compiled_search_on_disk():
    program = (
        "from tab_marl.planning import kernels, textbook; from tab_marl.planning.pomcp import Pomcp, PomcpOptions;"
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
