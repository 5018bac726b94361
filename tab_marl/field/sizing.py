"""What a field problem takes, before it starts: states, bytes by arithmetic, seconds at a rate measured on the problem.

The rate is that of the problem's own reference: a few rows of messages are solved and timed, so that cells, moves,
precision and machine are all in it.
"""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from tab_marl.field.options import FieldOptions
from tab_marl.mission.unroll import TickAutomaton

if TYPE_CHECKING:
    from tab_marl.field.problem import FieldProblem

GIGABYTE = 1e9
FEW_ROWS, MORE_ROWS = 2, 10
"""Automaton states solved for the rate: the difference is the cost of a state, the rest that of starting."""
TIMED_AT_MOST, TIMING_SECONDS = 5, 0.2
"""Repetitions, and the time after which none is begun; the fastest counts."""
USUAL_ROUNDS = 4
"""Passes that weights beyond the mission usually take to fit (3 to 6 in the missions tried)."""


class FieldTooLarge(ValueError):
    """Solving would take more memory than `FieldOptions.memory_gigabytes`."""


@dataclass(frozen=True)
class Memory:
    """Bytes that solving holds at once."""

    messages: int
    """Backward messages ``[Q, S]``."""
    masses: int
    """Forward masses ``[Q, S]``, where weights are fitted."""
    reference: int
    automaton: int
    scratch: int
    """A few rows ``[S]``."""

    @property
    def total(self) -> int:
        return self.messages + self.masses + self.reference + self.automaton + self.scratch


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
    fitted = _is_fitted(problem)
    passes = min(USUAL_ROUNDS, problem.options.max_iterations) if fitted else 1
    return FieldSize(
        automaton_states=len(automaton.delta),
        cells=problem.cells,
        modes=motion.modes,
        moves=len(motion.data) // motion.count,
        ticks=int(automaton.rank.max()) - 1,
        passes=passes,
        memory=memory_of(problem, fitted),
        seconds_per_pass=_seconds_of_pass(problem, fitted),
    )


def memory_of(problem: FieldProblem, fitted: bool | None = None) -> Memory:
    """Bytes that solving this problem holds at once."""
    motion, automaton = problem.reference, problem.automaton
    rows = len(automaton.delta)
    with_masses = _is_fitted(problem) if fitted is None else fitted
    table = rows * motion.states * _message_bytes(problem.options)
    return Memory(
        messages=table,
        masses=table if with_masses else 0,
        reference=motion.data.nbytes + motion.indices.nbytes + motion.indptr.nbytes + 8 * motion.count * motion.states,
        automaton=sum(array.nbytes for array in vars(automaton).values() if isinstance(array, np.ndarray))
        + 3 * 8 * automaton.delta.size,
        scratch=6 * 8 * motion.states,
    )


def _message_bytes(options: FieldOptions) -> int:
    return 4 if options.precision == "single" else 8


def _is_fitted(problem: FieldProblem) -> bool:
    from tab_marl.field.constraints import Tilt

    return bool(problem.constraints) or Tilt.of(problem).needed


def refuse_beyond_memory(problem: FieldProblem) -> None:
    """Raise FieldTooLarge if solving would take more than `options.memory_gigabytes`."""
    need = memory_of(problem)
    allowed = problem.options.memory_gigabytes
    if need.total <= allowed * GIGABYTE:
        return
    motion = problem.reference
    raise FieldTooLarge(
        f"solving needs {need.total / GIGABYTE:.3g} GB ({need.messages / GIGABYTE:.3g} messages = "
        f"{len(problem.automaton.delta):,} automaton states x {motion.states // motion.modes:,} cells x "
        f"{motion.modes} modes x {_message_bytes(problem.options)} bytes; {need.masses / GIGABYTE:.3g} forward masses; "
        f"{need.reference / GIGABYTE:.3g} reference), more than FieldOptions.memory_gigabytes = {allowed:g}: use "
        "larger cells, fewer headings, a shorter horizon, precision='single' or problem.pruned(), or raise the bound"
    )


def refuse_before_building(automaton: TickAutomaton, cells: int, modes: int, options: FieldOptions) -> None:
    """The same from the messages alone, before a reference is built. Raises FieldTooLarge."""
    need = len(automaton.delta) * cells * modes * _message_bytes(options)
    if need > options.memory_gigabytes * GIGABYTE:
        raise FieldTooLarge(
            f"the messages alone would take {need / GIGABYTE:.3g} GB ({len(automaton.delta):,} automaton states x "
            f"{cells:,} cells x {modes} modes x {_message_bytes(options)} bytes), more than "
            f"FieldOptions.memory_gigabytes = {options.memory_gigabytes:g}: use larger cells (cell_metres), fewer "
            "headings, a shorter horizon or precision='single', or raise the bound"
        )


def _seconds_of_pass(problem: FieldProblem, fitted: bool) -> float:
    """Chains of few and of more states on this problem's reference, solved and timed: a cost per state and one apart."""
    few, more = FEW_ROWS, MORE_ROWS
    _timed(problem, few, fitted)  # loads the compiled code
    began = time.perf_counter()
    samples = []
    while len(samples) < TIMED_AT_MOST and (not samples or time.perf_counter() - began < TIMING_SECONDS):
        samples.append((_timed(problem, few, fitted), _timed(problem, more, fitted)))
    at_few, at_more = np.min(samples, axis=0)  # the machine's other work only adds
    per_row = max(at_more - at_few, 0.0) / (more - few)
    # Neither the initial state nor the absorbing ones are solved for.
    return float(at_few + per_row * max(0, len(problem.automaton.delta) - 3 - few))


def _timed(problem: FieldProblem, rows: int, fitted: bool) -> float:
    from tab_marl.field.constraints import Tilt
    from tab_marl.field.solve import message
    from tab_marl.field.tab_field import expected_transitions

    small = _counting(problem, rows)
    tilt = Tilt.of(small)
    began = time.perf_counter()
    chain = message(small, tilt)
    if fitted:
        expected_transitions(chain, small.automaton.rank)
    return time.perf_counter() - began


def _counting(problem: FieldProblem, rows: int) -> FieldProblem:
    """The problem with an automaton that counts so many ticks and accepts."""
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
    options = replace(problem.options, goal_marginals=False, timing_prior=False, completion_probability=1.0)
    return replace(
        problem, automaton=automaton, options=options, reference_of=None, stage=None, stage_names=("mission",),
        status=None, mission=None, constraints=(), tracking=None, rough=None,
    )  # fmt: skip
