"""The field against published optimisers: a conic solver on eq. 1's primal, and Sinkhorn for the bridge between marginals."""

from __future__ import annotations

from dataclasses import dataclass

import cvxpy as cp
import numpy as np
import ot
import pytest
from scipy import sparse

from tab_marl.field import FieldOptions, FieldProblem, ProductBelief, solve
from tab_marl.field.tab_field import expected_visits
from tab_marl.mission import Constraint, Mission
from tab_marl.mission.unroll import TickAutomaton


@dataclass
class Primal:
    """Eq. 1 as a convex program over the flow along every edge of the product of automaton and cells.

    min sum f log(f / (v Q)) over edges, v the visits of the edge's tail: the divergence of a Markov law from the
    reference. Inflow equals visits equals outflow; what is completed is `completed`.
    """

    flow: np.ndarray
    tail: np.ndarray  # [E] index of (q, s)
    head_state: np.ndarray  # [E] q'
    branch: np.ndarray  # [E]
    visits: np.ndarray  # [Q * S]
    optimum: float


def solve_primal(problem: FieldProblem, completed: float = 1.0, equal_branches: bool = False) -> Primal:
    automaton = problem.automaton
    labels, states = np.asarray(problem.labels), problem.reference.states
    assert problem.reference.modes == 1
    start = np.zeros(len(automaton.delta) * states)
    entered = automaton.delta[automaton.initial, labels]
    start[entered * states + np.arange(states)] = problem.start
    absorbing = {automaton.accepting, automaton.rejecting}
    edges = []
    todo = [int(i) for i in np.flatnonzero(start)]
    seen = set(todo)
    matrices = [problem.reference.matrix(r).tocsr() for r in range(problem.reference.count)]
    while todo:
        q, s = divmod(todo.pop(), states)
        if q in absorbing:
            continue
        row = matrices[problem.reference_of[q]][[s]].tocoo()
        for following, share in zip(row.col, row.data, strict=True):
            to = int(automaton.delta[q, labels[following]])
            node = to * states + int(following)
            edges.append((q * states + s, node, to, int(automaton.branch[q, labels[following]]), share))
            if node not in seen:
                seen.add(node)
                todo.append(node)
    tail, head, to, branch, share = (np.array(column) for column in zip(*edges, strict=True))
    nodes = len(start)
    if completed == 1:  # no flow where the goal can no longer be reached: the cone's boundary, which solvers dislike
        alive = np.arange(nodes) // states == automaton.accepting
        while not np.array_equal(alive, wider := alive | np.isin(np.arange(nodes), tail[alive[head]])):
            alive = wider
        kept = alive[head]
        tail, head, to, branch, share = tail[kept], head[kept], to[kept], branch[kept], share[kept]
    leaves = sparse.csr_array((np.ones(len(tail)), (tail, np.arange(len(tail)))), shape=(nodes, len(tail)))
    enters = sparse.csr_array((np.ones(len(tail)), (head, np.arange(len(tail)))), shape=(nodes, len(tail)))
    flow = cp.Variable(len(tail), nonneg=True)
    visits = enters @ flow + start
    under_way = np.setdiff1d(np.unique(tail), np.flatnonzero(np.isin(np.arange(nodes) // states, list(absorbing))))
    constraints = [
        (leaves @ flow)[under_way] == visits[under_way],
        cp.sum(flow[to == automaton.accepting]) == completed,
    ]
    if equal_branches:
        each = [cp.sum(flow[branch == b]) for b in range(branch.max() + 1)]
        constraints += [one == each[0] for one in each[1:]]
    program = cp.Problem(cp.Minimize(cp.sum(cp.rel_entr(flow, cp.multiply(share, visits[tail])))), constraints)
    program.solve(solver=cp.CLARABEL, tol_gap_abs=1e-10, tol_gap_rel=1e-10, tol_feas=1e-10)
    assert program.status == cp.OPTIMAL
    return Primal(flow.value, tail, to, branch, visits.value, float(program.value))


A, B, C = "Checkpoint A", "Checkpoint B", "Checkpoint C"
MISSIONS = {
    "sequence": (Constraint("deadline", (C,), seconds=3), Constraint("deadline", (B,), seconds=4)),
    "avoiding": (Constraint("always", ("central zone",), avoid=True), Constraint("deadline", (A,), seconds=4)),
    "exact": (Constraint("exact", (A,), seconds=4),),
    "any of three": (Constraint("deadline", (A, B, C), seconds=4),),
}


@pytest.mark.parametrize(
    ("name", "options"),
    [
        ("sequence", {}),
        ("avoiding", {}),
        ("exact", {}),
        ("sequence", {"completion_probability": 0.7}),
        ("any of three", {"goal_marginals": True}),
    ],
)
def test_the_primal_has_the_same_optimum_and_visits(name, options, tiny_scenario):
    settings = {"cell_metres": 1.0, "reference": "walk", "precision": "double", "marginal_tolerance": 1e-12}
    settings |= {"goal_marginals": False} | options
    problem = FieldProblem.from_mission(Mission(MISSIONS[name]), tiny_scenario(), FieldOptions(**settings))
    field = solve(problem)
    primal = solve_primal(problem, settings.get("completion_probability", 1.0), settings["goal_marginals"])
    assert primal.optimum == pytest.approx(field.kl_to_reference, abs=1e-6)
    visits, _ = expected_visits(field.bridge, problem.automaton.rank)
    used = np.unique(primal.tail)
    assert len(np.unique(used // problem.reference.states)) >= 4
    np.testing.assert_allclose(primal.visits[used], visits.ravel()[used], atol=2e-5)
    if settings["goal_marginals"]:
        by_branch = np.bincount(primal.branch[primal.branch >= 0], primal.flow[primal.branch >= 0])
        np.testing.assert_allclose(by_branch, list(field.branch_visits.values()), atol=2e-5)
        np.testing.assert_allclose(by_branch, 1 / 3, atol=2e-5)


def be_there_at(ticks: int, places: int) -> TickAutomaton:
    """Symbol l >= 1 at tick `ticks` accepts by branch l - 1, symbol 0 fails; symbols do not matter earlier."""
    count = ticks + 1
    accepting, rejecting = count, count + 1
    delta = np.repeat(np.arange(1, count + 2)[:, None], places + 1, axis=1)
    delta[count - 1] = [rejecting] + [accepting] * places
    delta = np.vstack([delta[:count], np.full((1, places + 1), accepting), np.full((1, places + 1), rejecting)])
    branch = np.full(delta.shape, -1)
    branch[count - 1, 1:] = np.arange(places)
    zeros = np.zeros(count + 2, dtype=np.int32)
    return TickAutomaton(
        delta.astype(np.int32), np.arange(places + 1, dtype=np.int32), 0, accepting, rejecting,
        np.arange(count + 2, dtype=np.int32), zeros, branch.astype(np.int32), zeros, zeros,
        np.full(count + 2, np.inf), np.zeros((count + 2, 3), dtype=np.int32),
    )  # fmt: skip


@pytest.mark.parametrize(("cells", "ticks", "seed"), [(6, 3, 0), (12, 7, 1), (20, 30, 2)])
def test_sinkhorn_finds_the_bridge_between_two_marginals(cells, ticks, seed):
    """The law of (first cell, last cell) is the entropic optimal transport plan with cost -log Q^T (Schroedinger 1931)."""
    rng = np.random.default_rng(seed)
    step = rng.random((cells, cells)) ** 3
    step /= step.sum(axis=1, keepdims=True)
    begins = rng.random(cells) * (rng.random(cells) < 0.7)
    begins[0] += 0.1
    begins /= begins.sum()
    goals = rng.permutation(cells)[: cells // 2]
    labels = np.zeros(cells, dtype=int)
    labels[goals] = 1 + np.arange(len(goals))
    problem = FieldProblem(
        step, labels, be_there_at(ticks, len(goals)), begins, ticks,
        FieldOptions(precision="double", goal_marginals=True, marginal_tolerance=1e-12),
    )  # fmt: skip
    field = solve(problem)
    far = np.linalg.matrix_power(step, ticks)
    used = np.flatnonzero(begins)
    cost = -np.log(far[np.ix_(used, goals)])
    plan = ot.sinkhorn(begins[used], np.full(len(goals), 1 / len(goals)), cost, reg=1.0, stopThr=1e-15, numItermax=5000)
    for row, cell in zip(plan, used, strict=True):
        alone = np.zeros(cells)
        alone[cell] = 1.0
        belief = ProductBelief(field.chain._replace(start=alone))
        for _ in range(ticks):
            belief.predict()
        np.testing.assert_allclose(belief.cell_marginal()[goals] * begins[cell], row, atol=1e-10)
    # Between the marginals the law is the plan's mixture of reference bridges.
    for tick in range(ticks + 1):
        onward, before = np.linalg.matrix_power(step, ticks - tick), np.linalg.matrix_power(step, tick)
        there = np.einsum("xy,xz,zy->z", plan / far[np.ix_(used, goals)], before[used], onward[:, goals])
        np.testing.assert_allclose(field.occupancy[tick], there, atol=1e-10)
    divergence = (plan * np.log(plan / (begins[used][:, None] * far[np.ix_(used, goals)]))).sum()
    assert field.kl_to_reference == pytest.approx(float(divergence), abs=1e-9)
