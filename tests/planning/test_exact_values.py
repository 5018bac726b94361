"""The planner's values against an exact solver: finite-horizon value iteration with alpha vectors.

Incremental pruning (Cassandra, Littman and Zhang, UAI 1997): one backup per step of the horizon; the cross sums over observations
are pruned by the linear programme of Lark and White after every sum. It shares nothing with the planner.
"""

from __future__ import annotations

import numba
import numpy as np
import pytest
import scipy.sparse
from scipy.optimize import linprog

from tab_marl.planning.model import Particles
from tab_marl.planning.search.pomcp import Pomcp, PomcpOptions
from tab_marl.planning.tables import table_model
from tab_marl.planning.textbook import tiger

heavy = pytest.mark.skipif(bool(numba.config.DISABLE_JIT), reason="takes hours interpreted")


def solve(transition, observation, reward, terminal, discount, horizon):
    """Vectors [n, S] whose maximum over a belief is the best return of `horizon` steps, and the first action [n] of each."""
    states = len(terminal)
    if reward.ndim == 3:
        reward = (transition * reward).sum(axis=2)
    goes_on = ~terminal
    vectors, actions = np.zeros((1, states)), np.zeros(1, dtype=int)
    for _ in range(horizon):
        made, by = [], []
        for a in range(len(transition)):
            total = (reward[a] * goes_on)[None]
            for o in range(observation.shape[2]):
                reach = goes_on[:, None] * transition[a] * (observation[a][:, o] * goes_on)
                sums = total[:, None] + (discount * vectors @ reach.T)[None]
                total = pruned(sums.reshape(-1, states))[0]
            made.append(total)
            by += [a] * len(total)
        vectors, kept = pruned(np.concatenate(made))
        actions = np.array(by)[kept]
    return vectors, actions


def pruned(vectors):
    """The vectors that are best at some belief, and their numbers."""
    left = np.unique(vectors.round(12), axis=0, return_index=True)[1].tolist()
    kept: list[int] = []
    while left:
        belief = witness(vectors[left[0]], vectors[kept])
        if belief is None:
            left.pop(0)
        else:
            best = max(left, key=lambda i: (vectors[i] @ belief, tuple(vectors[i])))
            left.remove(best)
            kept.append(best)
    return vectors[kept], kept


def witness(vector, others):
    """A belief at which `vector` beats all the others, or None."""
    size = len(vector)
    if len(others) == 0:
        return np.full(size, 1 / size)
    result = linprog(
        np.append(np.zeros(size), -1.0),  # the greatest lead
        A_ub=np.column_stack([others - vector, np.ones(len(others))]),
        b_ub=np.zeros(len(others)),
        A_eq=np.append(np.ones(size), 0.0)[None],
        b_eq=[1.0],
        bounds=[(0, 1)] * size + [(None, None)],
    )
    return result.x[:size] if result.status == 0 and -result.fun > 1e-10 else None


HEAR = np.array([[0.85, 0.15], [0.15, 0.85]])
ANEW = np.full((2, 2), 0.5)
TIGER = (
    np.array([np.eye(2), ANEW, ANEW]),
    np.array([HEAR, ANEW, ANEW]),
    np.array([[-1.0, -1.0], [-100.0, 10.0], [10.0, -100.0]]),
    np.zeros(2, dtype=bool),
)


def random_pomdp(seed, states=4, actions=3, observations=2):
    rng = np.random.default_rng(seed)
    return (
        rng.dirichlet(np.full(states, 0.5), size=(actions, states)),
        rng.dirichlet(np.full(observations, 0.4), size=(actions, states)),
        rng.normal(size=(actions, states, states)),
        np.arange(states) == states - 1,
    )


def test_the_solver_solves_what_can_be_worked_out_by_hand():
    uniform = np.array([0.5, 0.5])
    best = [(solve(*TIGER, 0.95, horizon)[0] @ uniform).max() for horizon in (1, 2, 3)]
    # listen; listen twice; listen twice and open if the growls agree (probability .745, then right with .85^2 / .745)
    agree = 0.85**2 + 0.15**2
    third = agree * (10 * 0.85**2 - 100 * 0.15**2) / agree - (1 - agree)
    assert best == pytest.approx([-1.0, -1.95, -1.95 + 0.95**2 * third])
    first = solve(*random_pomdp(0), 0.9, 1)[0]
    mean = (random_pomdp(0)[0] * random_pomdp(0)[2]).sum(axis=2) * [1, 1, 1, 0]  # in the last state it is over
    for belief in np.random.default_rng(0).dirichlet(np.ones(4), size=20):
        assert (first @ belief).max() == pytest.approx((mean @ belief).max())


@heavy
@pytest.mark.parametrize(("horizon", "left"), [(2, 0.5), (2, 0.85), (2, 0.02), (3, 0.5), (3, 0.85)])
def test_tiger_within_a_horizon_is_worth_what_the_exact_solver_says(horizon, left):
    vectors, actions = solve(*TIGER, 0.95, horizon)
    belief = np.array([left, 1 - left])
    exact = (vectors @ belief).max()
    options = PomcpOptions(simulations=200_000, exploration=200.0, discount=0.95, max_depth=horizon)
    plan = Pomcp(tiger(rollout="engine"), options).plan(Particles(np.array([0.0, 1.0]), belief), 1)
    assert plan.action == actions[(vectors @ belief).argmax()]
    # What is tried below the best lowers the mean, and a wrong door costs 100.
    assert exact - 1.0 < plan.values[plan.action] < exact + 0.2


@heavy
@pytest.mark.parametrize("seed", range(4))
def test_random_pomdps_with_an_end_are_worth_what_the_exact_solver_says(seed):
    pomdp = random_pomdp(seed)
    vectors, actions = solve(*pomdp, 0.9, 4)
    options = PomcpOptions(simulations=100_000, exploration=3.0, discount=0.9, max_depth=4)
    planner = Pomcp(table_model(*pomdp), options)
    beliefs = np.random.default_rng(seed).dirichlet(np.ones(3), size=3)
    for ended, belief in zip((0.0, 0.0, 0.4), beliefs, strict=True):
        known = np.append(belief * (1 - ended), ended)  # the process may be over already: nothing is earned there
        worth = vectors @ known
        plan = planner.plan(Particles(np.arange(4.0), known), seed)
        assert worth.max() - 0.05 < plan.values[plan.action] < worth.max() + 0.02
        assert worth[actions == plan.action].max(initial=-np.inf) > worth.max() - 0.02  # the best action, or as good


@pytest.mark.parametrize("kind", ["dense", "sparse"])
def test_where_the_process_is_over_nothing_is_earned(kind):
    transition, observation, reward, terminal = random_pomdp(2)
    reward = reward + 50.0
    if kind == "sparse":
        transition, observation = ([scipy.sparse.csr_array(m) for m in t] for t in (transition, observation))
    model = table_model(transition, observation, reward, terminal)
    plan = Pomcp(model, PomcpOptions(simulations=200, max_depth=4)).plan([3.0], 0)
    assert plan.values.tolist() == [0.0, 0.0, 0.0]
    assert plan.depth == 1


@heavy
def test_the_value_approaches_the_exact_one_as_the_budget_grows():
    pomdp = random_pomdp(1)
    known = np.array([0.4, 0.3, 0.3, 0.0])
    exact = (solve(*pomdp, 0.9, 4)[0] @ known).max()
    model, belief = table_model(*pomdp), Particles(np.arange(4.0), known)
    errors = []
    for budget in (300, 3000, 30000, 300000):
        options = PomcpOptions(simulations=budget, exploration=3.0, discount=0.9, max_depth=4)
        values = [Pomcp(model, options).plan(belief, seed).values.max() for seed in range(6)]
        errors.append(abs(np.mean(values) - exact))
    assert errors == sorted(errors, reverse=True)
    assert errors[-1] < 0.02
    assert errors[0] > 0.1
