"""What a field problem takes, before it starts: states, bytes by arithmetic, processor seconds at a rate measured on the
problem.

The rate is that of the problem's own reference: a few rows of messages are solved and timed, so that cells, moves,
precision and machine are all in it. Where each automaton state can be is found first, and kept for the solver.
"""

from __future__ import annotations

import math
import time
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from tab_marl.field import kernels
from tab_marl.field.messages.tables import LAZY_BYTES
from tab_marl.field.options import FieldOptions
from tab_marl.mission.unroll import TickAutomaton

if TYPE_CHECKING:
    from tab_marl.field.constraints.tilt import Tilt
    from tab_marl.field.problem import FieldProblem

GIGABYTE = 1e9
FEW_ROWS = 4
"""Automaton states of the first of the automata that are timed; each further one has twice as many."""
TIMED_SECONDS = 0.05
"""A pass that takes this long says enough."""
REPETITIONS = 3
START_CELLS = 50
PAGE_BYTES = 4096
MOVE_BYTES, LEAST_MOVES = 12, 4
"""Of an entry of a reference's sparse rows (index and probability), and entries of a row at least."""
USUAL_ROUNDS = 4
"""Passes that weights beyond the mission usually take to fit (3 to 6 in the missions tried)."""


class FieldTooLarge(ValueError):
    """Solving would take more memory than `FieldOptions.memory_gigabytes`."""


@dataclass(frozen=True)
class Memory:
    """Bytes that solving holds at once."""

    messages: int
    """Backward messages ``[Q, S]``; of a large table only the pages that are written."""
    masses: int
    """Forward masses, where weights are fitted: of the automaton states that are under way at once."""
    reference: int
    support: int
    """Which cells each automaton state can be in ``[Q, C]``."""
    automaton: int
    scratch: int
    """A few rows ``[S]``, or what finding the support takes before there are messages."""

    @property
    def total(self) -> int:
        return self.messages + self.masses + self.reference + self.support + self.automaton + self.scratch


@dataclass(frozen=True)
class FieldSize:
    """How large a problem is and what it takes to solve. Numbers of bytes are exact but for what Python itself takes."""

    automaton_states: int
    """Q."""
    cells: int
    modes: int
    moves: int
    """Entries of the references' sparse rows: multiplications of one row of messages (of one reference)."""
    ticks: int
    """The most that a mission can last."""
    passes: int
    """Backward passes: 1, or about USUAL_ROUNDS where weights beyond the mission are fitted (each then with a forward
    pass); never more than `FieldOptions.max_iterations`."""
    memory: Memory
    seconds_per_pass: float
    """Of a backward pass, and of the forward pass that fitting adds. Compiled code is taken to be compiled."""

    @property
    def product_states(self) -> int:
        """Q * S: how many messages there are."""
        return self.automaton_states * self.cells * self.modes

    @property
    def gigabytes(self) -> float:
        return self.memory.total / GIGABYTE

    @property
    def seconds(self) -> float:
        return self.passes * self.seconds_per_pass

    def __str__(self) -> str:
        return (
            f"{self.automaton_states:,} automaton states x {self.cells:,} cells x {self.modes} modes = "
            f"{self.product_states:,} messages over {self.ticks} ticks; {self.moves:,} moves; "
            f"{self.gigabytes:.3g} GB; {self.passes} pass{'es' if self.passes > 1 else ''} of "
            f"{self.seconds_per_pass:.2g} s = {self.seconds:.2g} s"
        )


def size_of(problem: FieldProblem) -> FieldSize:
    """See `FieldProblem.size`."""
    motion, automaton = problem.reference, problem.automaton
    tilt = _tilt_of(problem)
    fitted = bool(problem.constraints) or tilt.needed
    return FieldSize(
        automaton_states=len(automaton.delta),
        cells=problem.cells,
        modes=motion.modes,
        moves=len(motion.data) // motion.count,
        ticks=int(automaton.rank.max()) - 1,
        passes=min(USUAL_ROUNDS, problem.options.max_iterations) if fitted else 1,
        memory=memory_of(problem),
        seconds_per_pass=_seconds_of_pass(problem, tilt, fitted),
    )


def memory_of(problem: FieldProblem) -> Memory:
    """Bytes that solving this problem holds at once. Finds the support, which solving then need not do again."""
    from tab_marl.field.problem import UNDER_WAY
    from tab_marl.field.solve import layout

    tilt = _tilt_of(problem)
    motion, automaton = problem.reference, problem.automaton
    possible = layout(problem, bool(np.isfinite(tilt.log_failure)))[0].possible
    row = 8 * motion.states
    messages = _table_bytes(possible, motion.modes * _message_bytes(problem.options))
    if (np.asarray(problem.status) == UNDER_WAY).sum() < len(automaton.delta) - 2:  # watched beyond the mission's end
        messages *= 2
    return Memory(
        messages=messages,
        masses=_rows_at_once(problem) * row if problem.constraints or tilt.needed else 0,
        reference=_reference_bytes(problem),
        support=possible.nbytes + 8 * motion.count * problem.cells,
        automaton=sum(array.nbytes for array in vars(automaton).values() if isinstance(array, np.ndarray))
        + 3 * 8 * automaton.delta.size,
        scratch=6 * row,
    )


def _tilt_of(problem: FieldProblem) -> Tilt:
    from tab_marl.field.constraints.tilt import Tilt

    return Tilt.of(problem)


def _message_bytes(options: FieldOptions) -> int:
    return 4 if options.precision == "single" else 8


def _reference_bytes(problem: FieldProblem) -> int:
    motion = problem.reference
    return motion.data.nbytes + motion.indices.nbytes + motion.indptr.nbytes + 8 * motion.count * motion.states


def _table_bytes(possible: NDArray[np.uint8], cell_bytes: int) -> int:
    """Of a table ``[Q, C]`` of cells of so many bytes: all, or from LAZY_BYTES on the pages with something possible."""
    if possible.size * cell_bytes < LAZY_BYTES:
        return possible.size * cell_bytes
    at_once = max(1, PAGE_BYTES // cell_bytes)
    begin = np.arange(0, possible.shape[1], at_once)
    pages = np.maximum.reduceat(possible, begin, axis=1) > 0
    return int(pages.sum()) * max(PAGE_BYTES, cell_bytes)


def _rows_at_once(problem: FieldProblem) -> int:
    """Automaton states whose mass a forward pass holds at the same time."""
    automaton = problem.automaton
    order = np.argsort(automaton.rank, kind="stable").astype(np.int32)
    order = order[~np.isin(order, [automaton.initial, automaton.accepting, automaton.rejecting])]
    started, transient = np.zeros((2, len(automaton.delta)), dtype=np.bool_)
    transient[order] = True
    labels = np.asarray(problem.labels)[np.asarray(problem.start) > 0]
    first = np.unique(automaton.delta[automaton.initial, labels])
    started[first] = transient[first]
    return int(kernels.rows_at_once(order, automaton.delta, started, transient))


def refuse_beyond_memory(problem: FieldProblem) -> None:
    """Raise FieldTooLarge if solving would take more than `options.memory_gigabytes`."""
    motion, options = problem.reference, problem.options
    allowed = options.memory_gigabytes * GIGABYTE
    size = (
        f"{len(problem.automaton.delta):,} automaton states x {motion.states // motion.modes:,} cells x "
        f"{motion.modes} modes"
    )
    at_least = len(problem.automaton.delta) * problem.cells + _reference_bytes(problem)
    if at_least > allowed:
        raise FieldTooLarge(f"solving needs more than {at_least / GIGABYTE:.3g} GB ({size}), {_remedy(options)}")
    need = memory_of(problem)
    if need.total > allowed:
        raise FieldTooLarge(
            f"solving needs {need.total / GIGABYTE:.3g} GB ({size} x {_message_bytes(options)} bytes; "
            f"{need.messages / GIGABYTE:.3g} messages, {need.masses / GIGABYTE:.3g} forward masses, "
            f"{need.reference / GIGABYTE:.3g} reference, {need.support / GIGABYTE:.3g} support), {_remedy(options)}"
        )


def refuse_before_building(automaton: TickAutomaton, cells: int, modes: int, options: FieldOptions) -> None:
    """The same from what is the least, before a reference is built. Raises FieldTooLarge."""
    entries = len(automaton.delta) * cells * modes
    whole = options.only_reachable is False or (options.only_reachable is None and entries <= options.state_budget)
    least = entries * _message_bytes(options) if whole else len(automaton.delta) * cells
    least += cells * modes * LEAST_MOVES * MOVE_BYTES
    if least > options.memory_gigabytes * GIGABYTE:
        raise FieldTooLarge(
            f"solving needs more than {least / GIGABYTE:.3g} GB ({len(automaton.delta):,} automaton states x "
            f"{cells:,} cells x {modes} modes), {_remedy(options)}"
        )


def _remedy(options: FieldOptions) -> str:
    return (
        f"above FieldOptions.memory_gigabytes = {options.memory_gigabytes:g}: use larger cells, fewer headings, a shorter "
        "horizon, precision='single', only_reachable=True or problem.pruned(), or raise the bound"
    )


def _seconds_of_pass(problem: FieldProblem, tilt: Tilt, fitted: bool) -> float:
    """Counting automata of more and more states on this problem's reference, until one takes long enough to time.

    A few states would fit into the cache and into memory at hand, and say little about hundreds.
    """
    from tab_marl.field.solve import layout

    # Rows are solved for where they can matter: that many whole rows, without the initial and the absorbing ones.
    possible = layout(problem, bool(np.isfinite(tilt.log_failure)))[0].possible
    automaton = problem.automaton
    ended = [automaton.initial, automaton.accepting, automaton.rejecting]
    rows = float(np.delete(possible, ended, axis=0).sum(dtype=np.int64)) / problem.cells
    sampled = fitted and not problem.constraints and not tilt.scaling_is_exact
    few = more = FEW_ROWS
    at_few = at_more = _timed(problem, few, fitted, sampled)
    while at_more < TIMED_SECONDS and more < rows:
        few, at_few = more, at_more
        more = min(2 * more, math.ceil(rows))
        at_more = _timed(problem, more, fitted, sampled)
    per_row = (at_more - at_few) / (more - few) if more > few and at_more > at_few else at_more / more
    return float(max(at_more + per_row * (rows - more), at_more * rows / more))


def _timed(problem: FieldProblem, rows: int, fitted: bool, sampled: bool) -> float:
    """Seconds of one pass over a counting automaton of so many states."""
    from tab_marl.field.belief import ProductBelief
    from tab_marl.field.constraints.tilt import Tilt
    from tab_marl.field.sampling import sample_paths
    from tab_marl.field.solve import SAMPLED_PATHS, message
    from tab_marl.field.tab_field import expected_transitions

    small = _counting(problem, rows)
    taken = []
    for _ in range(REPETITIONS):  # the first one loads the compiled code, and prepares what all passes share
        began = time.thread_time()  # what other programs take does not count
        chain = message(small, Tilt.of(small))
        if fitted:
            expected_transitions(chain, small.automaton.rank)
        if sampled:
            # As many steps for a row as a mission of this many rows and ticks takes.
            paths = max(1, round(SAMPLED_PATHS * float(problem.automaton.rank.max()) / len(problem.automaton.delta)))
            sample_paths(chain, ProductBelief(chain), np.random.default_rng(0), paths, rows)
        taken.append(time.thread_time() - began)
    return min(taken)


def _counting(problem: FieldProblem, rows: int) -> FieldProblem:
    """The problem with an automaton that counts so many ticks and accepts, started in many places."""
    symbols = problem.automaton.delta.shape[1]
    count = rows + 1
    following = np.append(np.arange(1, count + 1), [count, count + 1]).astype(np.int32)
    ranks = np.append(np.arange(count), [count, count]).astype(np.int32)
    nothing = np.zeros(count + 2, dtype=np.int32)
    automaton = TickAutomaton(
        delta=np.repeat(following[:, None], symbols, axis=1),
        masks=problem.automaton.masks,
        initial=0,
        accepting=count,
        rejecting=count + 1,
        rank=ranks,
        location=nothing,
        branch=np.full((count + 2, symbols), -1, dtype=np.int32),
        mission_ticks=ranks - 1,
        stage_ticks=nothing,
        speed_limit=np.full(count + 2, np.inf),
        clocks=np.zeros((count + 2, 3), dtype=np.int32),
    )
    # Mass spreads over the map in a mission of many ticks, so a few ticks begin in many places.
    start = np.zeros(problem.cells)
    start[:: max(1, problem.cells // START_CELLS)] = 1.0
    start /= start.sum()
    options = replace(
        problem.options, goal_marginals=0.0, timing_prior=False, completion_probability=1.0, only_reachable=False
    )
    return replace(
        problem, automaton=automaton, start=start, options=options, reference_of=None, stage=None, stage_names=("mission",),
        status=None, mission=None, constraints=(), tracking=None, rough=None,
    )  # fmt: skip
