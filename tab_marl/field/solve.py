"""Solving a FieldProblem: one backward pass, or a few where weights are to be fitted."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Literal
from weakref import WeakKeyDictionary

import numpy as np
from numpy.typing import NDArray

from tab_marl.field.belief import ProductBelief
from tab_marl.field.chain import ProductChain, product_chain
from tab_marl.field.constraints import tracking_kernels
from tab_marl.field.constraints.fitting import History, fit
from tab_marl.field.constraints.tilt import Tilt
from tab_marl.field.infeasible import InfeasibleField
from tab_marl.field.messages import backward_kernels
from tab_marl.field.messages.stencil import Stencil, no_stencil, stencil_of
from tab_marl.field.messages.support import Support, support_of
from tab_marl.field.messages.tables import zeros
from tab_marl.field.problem import COMPLETE, UNDER_WAY, FieldProblem
from tab_marl.field.sampling import Trajectories, sample_paths
from tab_marl.field.sizing import refuse_beyond_memory
from tab_marl.field.tab_field import TabField, expected_transitions, start_log_partition
from tab_marl.world.scenario import UnknownName

Floats = NDArray[np.float64]
Message = Callable[[FieldProblem, Tilt], ProductChain]

# Rows of messages are scaled to these maxima, to use the whole range of the number format: 68 and 600 decades below.
# Powers of 2, so that scaling rounds nothing.
PEAK = {"single": 2.0**100, "double": 2.0**930}


SAMPLED_PATHS = 2000
"""Trajectories that show how visits go together; their sampling error only slows the fit."""


def solve(problem: FieldProblem, backend: Literal["numba", "torch"] = "numba", device: str = "cpu") -> TabField:
    """The maximum-entropy distribution over trajectories that complete the mission (paper, eq. 1).

    Exact on the product of cells and mission automaton (design, section 4).

    Args:
        backend: of the backward passes; `torch` needs PyTorch and gives the same numbers.
        device: where `torch` computes, for instance "cuda"; it must know double precision.
    Raises:
        InfeasibleField: no trajectory completes the mission.
        FieldTooLarge: more memory than `FieldOptions.memory_gigabytes` is needed.
        ValueError: the backend or the device is not known or not there.
    """
    compute: Message = message
    if backend == "torch":
        from tab_marl.field.messages import torch_backend

        torch_backend.check(device)
        compute = partial(message, torch_device=device)
    elif backend != "numba":
        raise UnknownName("backend", str(backend), ("numba", "torch"))
    elif device != "cpu":
        raise ValueError(
            f'device is {device!r}: compiled code runs on "cpu" only; for another device use backend="torch"'
        )
    try:
        return _solve(problem, compute)
    except InfeasibleField:
        if problem.options.precision == "double":
            raise
        # A start more than 68 decades less likely to complete than the best state: single precision cannot hold it.
        return _solve(replace(problem, options=replace(problem.options, precision="double")), compute)


def _solve(problem: FieldProblem, compute: Message) -> TabField:
    refuse_beyond_memory(problem)
    if problem.constraints:
        from tab_marl.field.constraints.dual import fit_soft

        chain, tilt, flux, report = fit_soft(problem, compute)
        return TabField(problem, chain, tilt, flux, report.worst, report.passes, report)
    tilt = Tilt.of(problem)
    if not tilt.needed:
        return TabField(problem, compute(problem, tilt), tilt, None, 0.0, 1)
    history: History | None = None
    if problem.rough is not None and not problem.options.timing_prior and not tilt.scaling_is_exact:
        rough = Tilt.of(problem.rough)
        try:
            _, _, _, history, _ = _fitted(problem.rough, rough, None, compute)
            tilt.start_from(rough)
        except InfeasibleField:  # rough cells may close a gap
            history = None
    flux, error, rounds, _, chain = _fitted(problem, tilt, history, compute)
    return TabField(problem, chain, tilt, flux, error, rounds)


def _fitted(
    problem: FieldProblem, tilt: Tilt, history: History | None, compute: Message
) -> tuple[Floats, float, int, History, ProductChain]:
    latest: list[ProductChain] = []

    def pass_both_ways(current: Tilt) -> Floats:
        latest.clear()  # two tables at a time would take twice the memory
        latest.append(compute(problem, current))
        return expected_transitions(latest[0], problem.automaton.rank)

    def sample_visits() -> Floats:
        chain = latest[0]
        ticks = int(problem.automaton.rank.max())
        paths = sample_paths(chain, ProductBelief(chain), np.random.default_rng(0), SAMPLED_PATHS, ticks)
        return visits_of(paths, problem, len(tilt.log_branch))

    return *fit(tilt, pass_both_ways, sample_visits, history), latest[0]


def visits_of(paths: Trajectories, problem: FieldProblem, branches: int) -> Floats:
    """``[K, B]``: counted visits of sampled trajectories that begin at tick 0."""
    automaton = problem.automaton
    symbols = np.asarray(problem.labels)[paths.cells]
    before = np.column_stack([np.full(len(paths), automaton.initial), paths.automaton_states[:, :-1]])
    branch = automaton.branch[before, symbols]
    return np.stack([(branch == b).sum(axis=1) for b in range(branches)], axis=1).astype(np.float64)


_layouts: WeakKeyDictionary[FieldProblem, dict[bool, tuple[Support, Stencil]]] = WeakKeyDictionary()


def layout(problem: FieldProblem, failing: bool) -> tuple[Support, Stencil]:
    """What all passes over a problem share; kept as long as the problem is."""
    known = _layouts.setdefault(problem, {})
    if failing not in known:
        reachable = problem.options.only_reachable
        if reachable is None:
            entries = len(problem.automaton.delta) * problem.reference.states
            reachable = entries > problem.options.state_budget
        grid = problem.grid
        stencil = no_stencil() if grid is None else stencil_of(problem.reference, grid.centres, grid.cell_metres)
        known[failing] = support_of(problem, reachable, failing), stencil
    return known[failing]


def message(problem: FieldProblem, tilt: Tilt, torch_device: str | None = None) -> ProductChain:
    """The chain of the backward messages under these weights; computed by PyTorch where a device of its is named."""
    automaton, motion = problem.automaton, problem.reference
    count, states = len(automaton.delta), motion.states
    single = problem.options.precision == "single"
    value = zeros((count, states), np.float32 if single else np.float64)
    peak = PEAK[problem.options.precision]
    log_scale = np.zeros(count)
    value[automaton.accepting] = peak
    if np.isfinite(tilt.log_failure):
        value[automaton.rejecting] = peak
    log_scale[automaton.rejecting] = tilt.log_failure
    weight = np.exp(tilt.log_weight())
    transient = np.setdiff1d(np.arange(count), [automaton.accepting, automaton.rejecting, automaton.initial])
    order = transient[np.argsort(-automaton.rank[transient], kind="stable")].astype(np.int32)
    over = np.asarray(problem.status)[order] != UNDER_WAY
    norm = value
    if over.any():  # events are still watched after the mission's end: the reference goes on, scaled to sum to 1
        norm = value.copy()
        tracking_kernels.backward_free(
            order[over], motion.motion, problem.reference_of, problem.labels, automaton.delta, weight,
            peak, value, norm, log_scale,
        )  # fmt: skip
        order = order[~over]
    if torch_device is not None:
        from tab_marl.field.messages import torch_backend

        torch_backend.backward(order, problem, weight, peak, value, log_scale, torch_device)
    else:
        support, stencil = layout(problem, bool(np.isfinite(tilt.log_failure)))
        backward_kernels.backward(
            order, motion.motion, stencil, problem.reference_of, problem.labels, automaton.delta, weight,
            peak, *support, value, log_scale,
        )  # fmt: skip
    # The initial state only reads the first label and is never left by a move; its scale is that of what follows.
    first = automaton.delta[automaton.initial, np.unique(np.asarray(problem.labels)[np.asarray(problem.start) > 0])]
    log_scale[automaton.initial] = max(log_scale[first].max(), -1e300)
    grid = problem.grid
    chain = product_chain(
        motion, np.asarray(problem.labels), automaton, np.asarray(problem.start), value,
        centres=None if grid is None else grid.centres, cell_metres=1.0 if grid is None else grid.cell_metres,
        reference_of=problem.reference_of, weight=weight, log_scale=log_scale, harmonic=True,
        complete=np.asarray(problem.status) == COMPLETE,
    )  # fmt: skip
    if norm is not value:
        norm[order] = value[order]
        chain = chain._replace(norm=norm)
    feasible = np.isfinite(start_log_partition(chain))
    if not feasible.any():
        raise InfeasibleField(
            "no trajectory of the reference process completes the mission from any start cell: "
            "the bounds are too tight, the goal cannot be reached, or its probability is below 1e-600"
        )
    start = np.where(feasible, chain.start, 0.0)
    return chain._replace(start=start / start.sum())
