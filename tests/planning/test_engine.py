"""What every search promises: one seed one tree, on any machine part; budgets; cores; tables; memory over many decisions."""

from __future__ import annotations

import dataclasses
import hashlib
import subprocess
import sys
import time
import warnings

import numba
import numpy as np
import pytest
import scipy.sparse

from tab_marl.planning import (
    Despot,
    DespotOptions,
    Pomcp,
    PomcpOptions,
    Pomcpow,
    PomcpowOptions,
    textbook,
)
from tab_marl.planning.model import CompiledModel, PlainPythonWarning
from tab_marl.planning.random_kernels import below
from tab_marl.planning.search.tree import ROOT
from tab_marl.planning.tables import table_model

heavy = pytest.mark.skipif(bool(numba.config.DISABLE_JIT), reason="takes hours interpreted")


def tag_belief(count=300):
    return textbook.TagBelief(4).sample(count, np.random.default_rng(0))


# ---- one seed, one tree

_PROGRAM = """
import hashlib, numpy as np
from tab_marl.planning import *
from tab_marl.planning import textbook
belief = textbook.TagBelief(4).sample(300, np.random.default_rng(0))
for planner in (Pomcp(textbook.tag(), PomcpOptions(simulations=3000)),
                Pomcp(textbook.tag(), PomcpOptions(simulations=3000, workers=2)),
                Despot(textbook.tag(), DespotOptions(scenarios=30, trials=10)),
                Pomcpow(textbook.light_dark(), PomcpowOptions(simulations=2000, max_depth=20))):
    tree = planner.plan(textbook.light_dark_start if isinstance(planner, Pomcpow) else belief, 7).tree
    print(hashlib.sha256(tree.nodes.tobytes() + tree.edges.tobytes() + tree.edge_actions.tobytes()).hexdigest())
"""


@heavy
def test_one_seed_gives_the_same_bits_in_every_process():
    runs = [
        subprocess.run([sys.executable, "-c", _PROGRAM], capture_output=True, text=True, check=True).stdout.split()
        for _ in range(2)
    ]
    tree = Pomcp(textbook.tag(), PomcpOptions(simulations=3000)).plan(tag_belief(), 7).tree
    here = hashlib.sha256(tree.nodes.tobytes() + tree.edges.tobytes() + tree.edge_actions.tobytes()).hexdigest()
    assert runs[0] == runs[1]
    assert len(set(runs[0])) == 4
    assert runs[0][0] == here


# ---- budgets


@heavy
def test_simulations_done_before_the_time_is_up_leave_the_same_tree(same_tree):
    options = PomcpOptions(simulations=5000)
    plain = Pomcp(textbook.tag(), options).plan(tag_belief(), 7)
    timed = Pomcp(textbook.tag(), dataclasses.replace(options, seconds=60.0)).plan(tag_belief(), 7)
    assert same_tree(plain.tree, timed.tree)
    assert plain.stopped == timed.stopped == "simulations"


@heavy
def test_time_may_end_a_search_first():
    plan = Pomcp(textbook.tag(), PomcpOptions(simulations=10**9, seconds=0.03, max_nodes=500)).plan(tag_belief(), 7)
    assert (plan.stopped, plan.full, len(plan.tree)) == ("seconds", True, 500)
    assert plan.visits.sum() == plan.simulations < 10**9


def few_at_a_time(count, rng):
    """A sampler that could not draw a million states in an hour."""
    assert count <= 2048, "asked for more than the time allows"
    return np.column_stack([np.full(count, 4), rng.integers(29, size=count)])


@pytest.mark.parametrize("workers", [1, 2])
@pytest.mark.parametrize("compiled", [True, False])
def test_a_sampler_is_asked_within_the_time(workers, compiled):
    options = PomcpOptions(simulations=10**7, seconds=0.02, max_nodes=500, workers=workers, compiled=compiled)
    plan = Pomcp(textbook.tag(), options).plan(few_at_a_time, 0)
    assert plan.stopped == "seconds"
    assert 1 <= plan.simulations < 10**7
    wide = PomcpowOptions(simulations=10**7, seconds=0.02, max_nodes=500, workers=workers, compiled=compiled)
    dark = lambda count, rng: few_at_a_time(count, rng)[:, 1:]
    assert Pomcpow(textbook.light_dark(), wide).plan(dark, 0).stopped == "seconds"


def test_a_sampler_that_takes_all_the_time_leaves_a_plan():
    def slow(count, rng):
        time.sleep(0.05)
        return few_at_a_time(count, rng)

    plan = Pomcp(textbook.tag(), PomcpOptions(simulations=10**6, seconds=0.03)).plan(slow, 0)
    assert plan.stopped == "seconds"
    assert 1 <= plan.simulations <= 2048


@pytest.mark.parametrize("scenarios", [False, True])
def test_the_twin_of_a_sampler_under_a_clock(scenarios, same_tree):
    options = PomcpOptions(simulations=4500, seconds=600.0, common_random_numbers=scenarios, max_depth=8, tree_depth=3)
    fast = Pomcp(textbook.tag(), options).plan(few_at_a_time, 1)
    slow = Pomcp(textbook.tag(), dataclasses.replace(options, compiled=False)).plan(few_at_a_time, 1)
    assert same_tree(fast.tree, slow.tree)
    assert fast.visits.sum() == 4500
    few = dataclasses.replace(options, simulations=2000)
    timeless = dataclasses.replace(few, seconds=None)
    timed, untimed = (Pomcp(textbook.tag(), o).plan(few_at_a_time, 1) for o in (few, timeless))
    assert same_tree(timed.tree, untimed.tree)


# ---- several cores


def laid_over(trees):
    """{history: (visits, {action: (visits, sum of returns)})} of trees added up, by walking them."""
    total = {}

    def walk(tree, node, history):
        visits, actions = total.setdefault(history, (0, {}))
        total[history] = (visits + int(tree.nodes["visits"][node]), actions)
        for edge in tree.edges_of(node):
            action, n = int(tree.edge_actions[edge]), int(tree.edges["visits"][edge])
            before = actions.get(action, (0, 0.0))
            actions[action] = (before[0] + n, before[1] + n * float(tree.edges["value"][edge]))
            for child in tree.children(edge):
                walk(tree, child, (*history, action, tree.observation(child)))

    for tree in trees:
        walk(tree, ROOT, ())
    return total


@heavy
def test_workers_trees_add_up():
    model, belief = textbook.tag(), tag_belief()
    seeds = np.random.default_rng(5).integers(2**63, size=3).tolist()
    alone = [
        Pomcp(model, PomcpOptions(simulations=share, max_nodes=10**6)).plan(belief, np.random.default_rng(seed))
        for seed, share in zip(seeds, (334, 333, 333), strict=True)
    ]
    expected = laid_over([plan.tree for plan in alone])
    together = Pomcp(model, PomcpOptions(simulations=1000, workers=3)).plan(belief, 5)
    got = laid_over([together.tree])
    assert got.keys() == expected.keys()
    for history, (visits, actions) in expected.items():
        assert got[history][0] == visits
        for action, (n, total) in actions.items():
            assert got[history][1][action][0] == n
            assert got[history][1][action][1] == pytest.approx(total, abs=1e-6)
    assert together.simulations == 1000 == together.visits.sum()
    assert (together.tree.parent_edge[1:] >= 0).all()


def test_the_twin_of_several_workers(same_tree):
    options = PomcpOptions(simulations=400, workers=3, max_depth=15)
    fast = Pomcp(textbook.tag("engine"), options).plan([[3, 9], [3, 20]], 2)
    slow = Pomcp(textbook.tag("engine"), dataclasses.replace(options, compiled=False)).plan([[3, 9], [3, 20]], 2)
    assert same_tree(fast.tree, slow.tree)


@heavy
def test_workers_go_on_with_a_tree_and_count_it_once(same_tree):
    planner = Pomcp(textbook.tag(), PomcpOptions(simulations=900, workers=3))
    before = planner.plan([[3, 9], [3, 20]], 1)
    action, seen = before.tree.best_line()[0]
    after = before.tree.after(action, seen)
    plan = planner.plan([[seen, 9], [seen, 21]], 2, start=after)
    assert plan.visits.sum() == 900 + after.nodes["visits"][ROOT]
    assert plan.tree.nodes["visits"][ROOT] == plan.visits.sum()
    again = planner.plan([[seen, 9], [seen, 21]], 2, start=after)
    assert same_tree(plan.tree, again.tree)


@heavy
def test_a_failing_worker_is_heard():
    def broken(count, rng):
        raise RuntimeError("no belief today")

    with pytest.raises(RuntimeError, match="no belief today"):
        Pomcp(textbook.tag(), PomcpOptions(simulations=100, workers=2)).plan(broken, 0)


# ---- many observations


def lottery_step(state, action, data, rng):
    """A ticket number that is seldom drawn twice."""
    ticket = below(rng, 3000)
    state[0] += 1.0
    return np.int64(ticket), 1.0 if action == ticket % 3 else 0.0, state[0] > 2.0


@heavy
def test_thousands_of_observations_are_found_in_a_table_and_the_tree_is_the_same(same_tree):
    model = CompiledModel(lottery_step, 3, 1)
    options = PomcpOptions(simulations=9000, max_depth=3)
    fast = Pomcp(model, options).plan([0.0], 4)
    slow = Pomcp(model, dataclasses.replace(options, compiled=False)).plan([0.0], 4)
    assert same_tree(fast.tree, slow.tree)
    assert max(len(list(fast.tree.children(e))) for e in fast.tree.edges_of(ROOT)) > 1000


# ---- tables


def grid_tables(side=6):
    """A robot on a ring of side * side cells that slips, sees its column, and is paid in one corner."""
    cells = side * side
    transition = np.zeros((2, cells, cells))
    for a, move in enumerate((1, side)):
        for s in range(cells):
            transition[a, s, (s + move) % cells] += 0.7
            transition[a, s, s] += 0.3
    observation = np.zeros((2, cells, side))
    observation[:, np.arange(cells), np.arange(cells) % side] = 1.0
    reward = np.full((2, cells, cells), -1.0)
    reward[:, :, -1] = 20.0
    terminal = np.arange(cells) == cells - 1
    return transition, observation, reward, terminal


@pytest.mark.parametrize("rewards", ["by step", "by action", "sparse"])
def test_sparse_tables_are_the_dense_ones(rewards, same_tree):
    transition, observation, reward, terminal = grid_tables()
    if rewards == "by action":
        reward = reward[:, :, 0] + np.arange(36) * 0.1
    given = [scipy.sparse.csr_array(r) for r in reward] if rewards == "sparse" else reward
    dense = table_model(transition, observation, reward, terminal, discount=0.95)
    sparse = table_model(
        [scipy.sparse.coo_array(t) for t in transition],
        [scipy.sparse.csc_matrix(o) for o in observation],
        given,
        terminal,
        discount=0.95,
    )
    options = PomcpOptions(simulations=400, max_depth=20)
    belief = np.arange(36.0)
    assert same_tree(Pomcp(dense, options).plan(belief, 1).tree, Pomcp(sparse, options).plan(belief, 1).tree)
    assert sparse.data.best == pytest.approx(dense.data.best)
    assert len(sparse.data.reward) == 2 * 36 * 2


def test_known_state_values_solve_bellmans_equation():
    transition, observation, reward, terminal = grid_tables()
    best = table_model(transition, observation, reward, terminal, discount=0.9).data.best
    assert (best[:, terminal] == 0).all()
    for steps in range(len(best)):  # of one step, of two, ..., of any more
        after = best[steps - 1] if steps > 0 else np.zeros(36)
        backed_up = [(transition[a] * (reward[a] + 0.9 * after)).sum(axis=1) for a in range(2)]
        assert best[steps] == pytest.approx(np.where(terminal, 0.0, np.max(backed_up, axis=0)), abs=1e-8)
    backed_up = [(transition[a] * (reward[a] + 0.9 * best[-1])).sum(axis=1) for a in range(2)]
    assert best[-1] == pytest.approx(np.where(terminal, 0.0, np.max(backed_up, axis=0)), abs=1e-8)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"transition": [np.eye(2)] * 2}, "both sparse"),
        ({"transition": [scipy.sparse.eye_array(2), 0.5 * scipy.sparse.eye_array(2)]}, r"transition\[1\]\[0\] = T"),
        ({"observation": [scipy.sparse.eye_array(3)] * 2}, "observation has shapes"),
        ({"reward": [scipy.sparse.eye_array(3)] * 2}, "reward must be 2 sparse matrices"),
        ({"reward": np.full((2, 2), np.nan)}, "not finite"),
        ({"terminal": [True]}, "terminal has shape"),
        ({"discount": 1.5}, "discount is 1.5"),
    ],
)
def test_bad_sparse_tables_are_named(change, words):
    eye = [scipy.sparse.eye_array(2)] * 2
    given = {"transition": eye, "observation": eye, "reward": np.ones((2, 2))} | change
    with pytest.raises(ValueError, match=words):
        table_model(**given)


def nameless_step(state, action, data, rng):
    return np.int64(0), "a reward", False


@heavy
def test_a_function_that_does_not_compile_is_named():
    with pytest.raises(TypeError, match=r"nameless_step does not compile as .*compiled=False"):
        Pomcp(CompiledModel(nameless_step, 2, 1)).plan([0.0], 0)


# ---- plain Python says that it is slow


def test_a_plain_python_model_warns_once_per_class():
    class Still:
        actions = 2

        def step(self, state, action, rng):
            return state, 0, float(action), False

    options = PomcpOptions(simulations=20, max_depth=3)
    with pytest.warns(PlainPythonWarning, match="Still is a model in plain Python.*CompiledModel"):
        Pomcp(Still(), options).plan([0], 0)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        Pomcp(Still(), options).plan([0], 0)
    with pytest.raises(ValueError, match="workers is 2, must be 1 for a model in plain Python"):
        Pomcp(Still(), dataclasses.replace(options, workers=2))


# ---- many decisions


@heavy
def test_reused_trees_stay_within_the_cap_over_a_game():
    model, rng = textbook.tag(), np.random.default_rng(3)
    planner = Pomcp(model, PomcpOptions(simulations=800, max_nodes=1000))
    state, belief, tree = np.array([4.0, 28.0]), textbook.TagBelief(4), None
    word = rng.integers(2**64, size=1, dtype=np.uint64)
    reused = 0
    for _ in range(25):
        plan = planner.plan(belief.sample(400, rng), rng, start=tree)
        assert len(plan.tree) <= 1000
        reused += tree is not None
        seen, _reward, terminal = textbook.tag_kernels.step(state, plan.action, model.data, word)
        if terminal:
            break
        belief = belief.updated(model.data, plan.action, int(seen))
        tree = plan.tree.after(plan.action, int(seen))
    assert reused > 5


@heavy
def test_every_search_answers_in_the_same_form():
    belief = tag_belief()
    for planner in (
        Pomcp(textbook.tag(), PomcpOptions(simulations=200)),
        Despot(textbook.tag(), DespotOptions(scenarios=30, trials=5)),
    ):
        plan = planner.plan(belief, np.random.default_rng(1), allowed=[0, 1])
        assert plan.action in (0, 1)
        assert np.isneginf(plan.values[2:]).all()
        assert plan.values.shape == plan.visits.shape == (5,)
        assert plan.simulations > 0
        assert plan.seconds > 0
        assert plan.depth >= 1
        assert plan.best_line()
        assert plan.tree.nodes["visits"][ROOT] >= plan.visits.max()


# ---- workers share a model and write to none of it


@heavy
@pytest.mark.parametrize("model", [textbook.tag("history"), textbook.tag("uniform"), textbook.laser_tag()])
def test_two_workers_leave_the_models_data_alone(model, same_tree):
    before = [np.copy(part) for part in model.data]
    planner = Pomcp(model, PomcpOptions(simulations=4000, workers=2))
    first, second = planner.plan([[3, 9], [3, 20]], 0), planner.plan([[3, 9], [3, 20]], 0)
    assert all(np.array_equal(a, b) for a, b in zip(before, model.data, strict=True))
    assert same_tree(first.tree, second.tree)
    assert first.steps == second.steps
