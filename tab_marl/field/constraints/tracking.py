"""The product of a field's automaton with trackers of other events, so that their probabilities are flows between states.

Letters: K trackers; a state of the product is (mission state, state of each tracker). It is absorbing once the mission
has ended and every tracker has decided; until then the trajectory is followed, after the mission's end by the reference.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from tab_marl.field.constraints.events import Completes, Event, SoftConstraint, TimingPrior, Tracker
from tab_marl.field.problem import COMPLETE, UNDER_WAY, FieldProblem
from tab_marl.mission.unroll import TickAutomaton

if TYPE_CHECKING:
    from numpy.typing import ArrayLike

MOST_STATES = 5_000_000
"""Of a product automaton: beyond it the table h alone would need hundreds of gigabytes."""
UNDECIDED, HAPPENED, RULED_OUT = 0, 1, 2


@dataclass(frozen=True, eq=False)
class Tracking:
    """What each state and transition of a product means."""

    trackers: tuple[Tracker, ...]
    parent_state: NDArray[np.int32]
    """``[Q]`` state of the automaton before the latest trackers were added."""
    parent_symbol: NDArray[np.int32]
    """``[L]`` its symbol."""
    decided: NDArray[np.int8]
    """``[K, Q]`` UNDECIDED, HAPPENED or RULED_OUT; in the absorbing states UNDECIDED, since trajectories of all kinds meet."""
    happens: NDArray[np.bool_]
    """``[K, Q, L]``: the transition on which event k happens; taken at most once by a trajectory."""

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(tracker.name for tracker in self.trackers)


class TrackedAutomaton(TickAutomaton):
    """A product: its symbols stand for pairs of a mission's label and the trackers' labels."""

    def symbols(self, masks: ArrayLike) -> NDArray[np.int32]:
        raise ValueError(
            "a field with soft constraints or tracked events reads cells, not mission labels: use FieldProblem.labels"
        )


def with_constraints(problem: FieldProblem, constraints: Sequence[SoftConstraint | TimingPrior]) -> FieldProblem:
    """The problem whose automaton tracks the constraints' events (and the tick, where a timing prior needs it)."""
    from tab_marl.field.constraints.tilt import PATH_DEPENDENT, ticks_of

    for constraint in constraints:
        if not isinstance(constraint, SoftConstraint | TimingPrior):
            raise TypeError(f"a constraint is {constraint!r}, must be a SoftConstraint or a TimingPrior")
    every = (*problem.constraints, *constraints)
    _check_stages(problem, [c for c in every if isinstance(c, TimingPrior)])
    soft = [c for c in every if isinstance(c, SoftConstraint)]
    own = [c for c in soft if isinstance(c.event, Completes) and c.event.mission is None]
    if len(own) > 1 or (own and problem.options.completion_probability < 1):
        raise ValueError(
            "the mission's own completion is constrained twice: keep one SoftConstraint(Completes(), c) and "
            "FieldOptions.completion_probability at 1"
        )
    events = [c.event for c in constraints if isinstance(c, SoftConstraint) and c not in own]
    tracked = track(problem, events) if events else problem
    if any(isinstance(c, TimingPrior) for c in every) or problem.options.timing_prior:
        entered = ticks_of(tracked)
        if (entered[_completing(tracked).any(axis=1)] == PATH_DEPENDENT).any():
            tracked = track(tracked, [_clock(tracked)])
    return replace(tracked, constraints=every, rough=None)


def _check_stages(problem: FieldProblem, priors: list[TimingPrior]) -> None:
    count = len(problem.stage_names)
    taken = set()
    for prior in priors:
        if not -count <= prior.stage < count:
            known = ", ".join(f"{i} ({name})" for i, name in enumerate(problem.stage_names))
            raise ValueError(f"TimingPrior.stage is {prior.stage}, must be one of {known}")
        if prior.stage % count in taken or (prior.stage % count == count - 1 and problem.options.timing_prior):
            raise ValueError(f"the time of stage {prior.stage % count} is constrained twice: keep one timing prior")
        taken.add(prior.stage % count)


def _completing(problem: FieldProblem) -> NDArray[np.bool_]:
    """``[Q, L]``: transitions that complete a stage."""
    stage = np.asarray(problem.stage)
    return np.asarray(stage[problem.automaton.delta] > stage[:, None])


def _clock(problem: FieldProblem) -> Tracker:
    """Counts ticks while the mission is under way, and decides nothing."""
    count = problem.horizon + 2
    delta = np.minimum(np.arange(1, count + 2), count)[:, None]
    delta = np.append(delta, [[count + 1]], axis=0)
    return Tracker("clock", np.zeros(problem.cells, dtype=np.int32), delta, 0, count + 1, count)


def track(problem: FieldProblem, events: Sequence[Event]) -> FieldProblem:
    """The problem with an automaton that also watches these events; the law of its trajectories is the same.

    Raises ValueError for an event that cannot be watched, or when the product is too large.
    """
    trackers = tuple(event.tracker(problem) for event in events)
    product = _Product.of(problem, trackers)
    codes = product.reachable()
    states = product.decode(codes)
    ahead = product.follow(states)
    rank, delta = _numbered(product, codes, ahead)
    order = np.argsort(rank, kind="stable")
    count = len(codes)
    position = np.append(np.argsort(order), [count, count + 1])
    states, ahead, rank, delta = states[order], ahead[order], rank[order], position[delta[order]]
    return _tracked_problem(problem, trackers, product, states, ahead, rank, delta)


@dataclass(frozen=True, eq=False)
class _Product:
    """Component 0 is the problem's automaton, the others are the trackers."""

    automaton: TickAutomaton
    trackers: tuple[Tracker, ...]
    status: NDArray[np.int8]
    alphabet: NDArray[np.int64]
    """``[L, 1 + K]`` each component's symbol."""
    labels: NDArray[np.int64]
    """``[C]``."""

    @classmethod
    def of(cls, problem: FieldProblem, trackers: tuple[Tracker, ...]) -> _Product:
        columns = np.stack([np.asarray(problem.labels), *(t.labels for t in trackers)], axis=1)
        alphabet, labels = np.unique(columns, axis=0, return_inverse=True)
        return cls(problem.automaton, trackers, np.asarray(problem.status), alphabet, labels.ravel())

    @property
    def deltas(self) -> list[NDArray[np.integer[Any]]]:
        return [self.automaton.delta, *(t.delta for t in self.trackers)]

    @property
    def sizes(self) -> list[int]:
        return [len(delta) for delta in self.deltas]

    @property
    def first(self) -> NDArray[np.int64]:
        return np.array([[self.automaton.initial, *(t.initial for t in self.trackers)]], dtype=np.int64)

    def encode(self, states: NDArray[np.int64]) -> NDArray[np.int64]:
        """``[..., 1 + K]`` -> one number each."""
        code = states[..., -1].copy()
        for i in range(len(self.sizes) - 2, -1, -1):
            code = code * self.sizes[i] + states[..., i]
        return code

    def decode(self, codes: NDArray[np.int64]) -> NDArray[np.int64]:
        out = np.empty((len(codes), len(self.sizes)), dtype=np.int64)
        for i, size in enumerate(self.sizes):
            codes, out[:, i] = np.divmod(codes, size)
        return out

    def follow(self, states: NDArray[np.int64]) -> NDArray[np.int64]:
        """``[n, 1 + K]`` -> ``[n, L, 1 + K]``; trackers that go with the mission are closed where it ends."""
        ahead = np.stack(
            [d[states[:, i]][:, self.alphabet[:, i]].astype(np.int64) for i, d in enumerate(self.deltas)], axis=2
        )
        over = self.status[ahead[:, :, 0]] != UNDER_WAY
        for k, t in enumerate(self.trackers, 1):
            if t.with_mission:
                ahead[:, :, k] = np.where(over & (ahead[:, :, k] != t.happened), t.ruled_out, ahead[:, :, k])
        return ahead

    def absorbed(self, states: NDArray[np.int64]) -> NDArray[np.bool_]:
        done = np.isin(states[..., 0], [self.automaton.accepting, self.automaton.rejecting])
        for k, t in enumerate(self.trackers, 1):
            done &= np.isin(states[..., k], [t.happened, t.ruled_out])
        return np.asarray(done)

    def reachable(self) -> NDArray[np.int64]:
        """The codes of all reachable states that are not absorbing, rising."""
        if np.prod([float(size) for size in self.sizes]) > 2.0**62:
            raise ValueError(f"the trackers have {self.sizes[1:]} states: too many to combine; use fewer events")
        known, frontier = self.encode(self.first), self.first
        while len(frontier):
            ahead = self.follow(frontier).reshape(-1, len(self.sizes))
            ahead = ahead[~self.absorbed(ahead)]
            codes, where = np.unique(self.encode(ahead), return_index=True)
            new = ~np.isin(codes, known)
            known, frontier = np.union1d(known, codes[new]), ahead[where[new]]
            if len(known) > MOST_STATES:
                raise ValueError(
                    f"the mission's automaton ({self.sizes[0]} states) times the trackers ({self.sizes[1:]} states) has "
                    f"more than {MOST_STATES} states: use fewer events, shorter windows or a longer tick"
                )
        return known


def _numbered(
    product: _Product, codes: NDArray[np.int64], ahead: NDArray[np.int64]
) -> tuple[NDArray[np.int32], NDArray[np.int64]]:
    """(``[Q - 2]`` rank: longest path from the initial state, ``[Q - 2, L]`` next state, Q - 2 and Q - 1 absorbing)."""
    count = len(codes)
    delta = np.searchsorted(codes, product.encode(ahead))
    failed = product.status[ahead[:, :, 0]] != COMPLETE
    delta = np.where(product.absorbed(ahead), count + failed, delta)
    initial = int(np.searchsorted(codes, product.encode(product.first))[0])
    rank = np.full(count + 2, -1, dtype=np.int32)
    rank[initial] = 0
    frontier = np.array([initial])
    # Longest paths by rounds: a state enters the next round whenever a longer path to it was found.
    for depth in range(1, count + 2):
        frontier = np.unique(delta[frontier])
        frontier = frontier[frontier < count]
        if not len(frontier):
            break
        rank[frontier] = depth
    else:
        raise ValueError("a tracker never decides on some path: unroll its clock, or set with_mission=True")
    return rank[:count], delta


def _tracked_problem(
    problem: FieldProblem,
    trackers: tuple[Tracker, ...],
    product: _Product,
    states: NDArray[np.int64],
    ahead: NDArray[np.int64],
    rank: NDArray[np.int32],
    delta: NDArray[np.int64],
) -> FieldProblem:
    """The arrays of the product: `states` ``[n, 1 + K]`` by rising rank, their successors `ahead` and `delta`."""
    automaton, count = problem.automaton, len(states)
    accepting, rejecting = count, count + 1
    of_state = np.append(states[:, 0], [automaton.accepting, automaton.rejecting]).astype(np.int32)
    of_symbol = product.alphabet[:, 0].astype(np.int32)
    absorbing = np.repeat([[accepting], [rejecting]], delta.shape[1], axis=1)
    decided = np.zeros((len(trackers), count + 2), dtype=np.int8)
    happens = np.zeros((len(trackers), count + 2, delta.shape[1]), dtype=np.bool_)
    for k, t in enumerate(trackers):
        now = states[:, k + 1]
        decided[k, :count] = np.select([now == t.happened, now == t.ruled_out], [HAPPENED, RULED_OUT], UNDECIDED)
        happens[k, :count] = (ahead[:, :, k + 1] == t.happened) & (now != t.happened)[:, None]
    before = problem.tracking
    if before is not None:
        trackers = before.trackers + trackers
        earlier = before.decided[:, of_state]
        earlier[:, count:] = UNDECIDED
        decided = np.concatenate([earlier, decided])
        happens = np.concatenate([before.happens[:, of_state][:, :, of_symbol], happens])
    last_rank = int(rank.max(initial=0)) + 1
    tracked = TrackedAutomaton(
        delta=np.concatenate([delta, absorbing]).astype(np.int32),
        masks=automaton.masks[of_symbol],
        initial=0,
        accepting=accepting,
        rejecting=rejecting,
        rank=np.append(rank, [last_rank, last_rank]).astype(np.int32),
        location=automaton.location[of_state],
        branch=automaton.branch[of_state][:, of_symbol],
        mission_ticks=automaton.mission_ticks[of_state],
        stage_ticks=automaton.stage_ticks[of_state],
        speed_limit=automaton.speed_limit[of_state],
        clocks=automaton.clocks[of_state],
    )
    return replace(
        problem,
        labels=product.labels.astype(np.int32),
        automaton=tracked,
        reference_of=np.asarray(problem.reference_of)[of_state],
        stage=np.asarray(problem.stage)[of_state],
        status=np.asarray(problem.status)[of_state],
        tracking=Tracking(trackers, of_state, of_symbol, decided, happens),
        rough=None,
    )
