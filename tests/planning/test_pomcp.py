"""The search against exact answers, and what it promises about seeds, bounds, priors and its own kernel."""

from __future__ import annotations

import dataclasses

import numba
import numpy as np
import pytest

from tab_marl.planning import textbook
from tab_marl.planning.model import CompiledModel, Particles
from tab_marl.planning.random_kernels import uniform
from tab_marl.planning.search import growing
from tab_marl.planning.search.pomcp import Pomcp, PomcpOptions
from tab_marl.planning.search.tree import NO_PARENT, ROOT
from tab_marl.planning.tables import table_model

heavy = pytest.mark.skipif(bool(numba.config.DISABLE_JIT), reason="takes hours interpreted")


# ---- exact values


@heavy
@pytest.mark.parametrize("seed", range(6))
def test_values_agree_with_expectimax(seed, random_pomdp, expectimax):
    pomdp = random_pomdp(seed)
    exact = expectimax(pomdp, np.array([0.5, 0.5, 0.0]), 3, 0.9)
    planner = Pomcp(table_model(*pomdp), PomcpOptions(simulations=60000, exploration=2.0, discount=0.9, max_depth=3))
    plan = planner.plan(np.array([0.0, 1.0]), seed)
    assert plan.action == exact.argmax()
    assert plan.values.max() == pytest.approx(exact.max(), abs=0.03)
    assert plan.values[plan.action] <= exact.max() + 0.02  # trying worse actions below can only lower the mean


@heavy
def test_the_error_falls_like_the_root_of_the_simulations(random_pomdp, expectimax):
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


@heavy
@pytest.mark.parametrize("seed", range(3))
def test_tiger_is_played_optimally(seed, tiger_value):
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


@heavy
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
def test_the_kernel_builds_the_same_tree_as_its_slow_twin(case, same_tree):
    model, belief, changes, root = CASES[case]
    options = PomcpOptions(**({"simulations": 700, "exploration": 5.0} | changes))
    fast = Pomcp(model, options).plan(belief, 3, **root)
    slow = Pomcp(model, dataclasses.replace(options, compiled=False)).plan(belief, 3, **root)
    assert same_tree(fast.tree, slow.tree)
    assert (fast.action, fast.depth, fast.steps, fast.simulations) == (slow.action, slow.depth, slow.steps, 700)
    assert fast.steps >= 700 or case == "dead ends"


def test_a_seed_fixes_the_tree_and_another_changes_it(same_tree):
    model, belief = textbook.tag(), textbook.TagBelief(4).sample(300, np.random.default_rng(0))
    planner = Pomcp(model, PomcpOptions(simulations=500))
    first, again, other = (
        planner.plan(belief, 8),
        planner.plan(belief, np.random.default_rng(8)),
        planner.plan(belief, 9),
    )
    assert same_tree(first.tree, again.tree)
    assert not same_tree(first.tree, other.tree)


@heavy
def test_the_tree_does_not_depend_on_how_often_the_arrays_grew(monkeypatch, same_tree):
    model, belief = textbook.tag(), textbook.TagBelief(4).sample(300, np.random.default_rng(0))
    options = PomcpOptions(simulations=900)
    whole = Pomcp(model, options).plan(belief, 8)
    monkeypatch.setattr(growing, "_FIRST_NODES", 3)
    assert same_tree(Pomcp(model, options).plan(belief, 8).tree, whole.tree)


# ---- what a tree must satisfy


@heavy
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


@heavy
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
    assert 1 <= plan.simulations < 10**8
