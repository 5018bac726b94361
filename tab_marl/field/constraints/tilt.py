"""Constraints beyond the mission: goal marginals, uniform completion tick, completion with probability c.

Each is a set of expectations under P. The minimiser of KL(P || Q) is then Q times a product of weights on transitions of
the automaton (exponential tilting); `fitting` finds them.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from tab_marl.field.constraints.goals import alternatives, goal_shares, reachable_places
from tab_marl.field.problem import COMPLETE, FieldProblem

Floats = NDArray[np.float64]
UNUSED = -1
UNREACHABLE, PATH_DEPENDENT = -2, -3


def ticks_of(problem: FieldProblem) -> NDArray[np.int64]:
    """``[Q]``: the tick at which an automaton state is entered (-1: before the first), PATH_DEPENDENT or UNREACHABLE."""
    automaton = problem.automaton
    count = len(automaton.delta)
    lowest = np.full(count, np.iinfo(np.int64).max)
    highest = np.full(count, UNREACHABLE, dtype=np.int64)
    occurring = np.unique(np.asarray(problem.labels))
    lowest[automaton.initial] = highest[automaton.initial] = -1
    absorbing = {automaton.accepting, automaton.rejecting}
    for q in np.argsort(automaton.rank, kind="stable"):
        if q in absorbing or highest[q] == UNREACHABLE:
            continue
        following = automaton.delta[q, occurring]
        np.minimum.at(lowest, following, lowest[q] + 1)
        np.maximum.at(highest, following, highest[q] + 1)
    return np.where(highest == UNREACHABLE, UNREACHABLE, np.where(lowest == highest, highest, PATH_DEPENDENT))


@dataclass(eq=False)
class Tilt:
    """Weights in force, as logarithms, and the features they belong to."""

    problem: FieldProblem
    branch_groups: list[NDArray[np.int64]]
    """Branches that can stand for one another."""
    completion_tick: NDArray[np.int64]
    """``[Q, L]``: tick of a transition into acceptance, UNUSED elsewhere or when the timing prior is off."""
    log_branch: Floats
    """``[B]``."""
    log_tick: Floats
    """``[ticks]``; -inf where completion is not feasible."""
    log_failure: float
    """Weight of failing, relative to completing; -inf when completion is certain."""
    ticks: NDArray[np.int64]
    """Feasible completion ticks."""
    tick_shares: Floats
    """Their wanted shares, sum 1."""
    free_visits: Floats | None = None
    """``[B]`` expected visits without the constraints; of the rough problem, where weights were fitted on one first."""
    wanted_shares: list[Floats] = field(default_factory=list)
    """Of the visits to each set of alternatives, what share each branch is to have."""
    fixed: Floats | None = None
    """``[Q, L]``: log of the factors, known from elsewhere (soft constraints, a file); then nothing is left to fit."""

    @classmethod
    def given(cls, problem: FieldProblem, log_weight: Floats, log_failure: float) -> Tilt:
        """Weights that need no fit."""
        branches = np.zeros(int(problem.automaton.branch.max(initial=-1)) + 1)
        unused = np.full(problem.automaton.delta.shape, UNUSED, dtype=np.int64)
        return cls(problem, [], unused, branches, np.zeros(0), log_failure, np.arange(0), np.empty(0), fixed=log_weight)

    @classmethod
    def of(cls, problem: FieldProblem) -> Tilt:
        automaton, options = problem.automaton, problem.options
        completion = np.full(automaton.delta.shape, UNUSED, dtype=np.int64)
        if options.timing_prior:
            entered = ticks_of(problem)
            completing = automaton.delta == automaton.accepting
            completing[automaton.accepting] = False
            if (entered[completing.any(axis=1)] == PATH_DEPENDENT).any():
                raise ValueError(
                    "FieldOptions.timing_prior needs a mission whose automaton tells the tick of completion; this "
                    "one's clocks are relative to earlier visits: set timing_prior=False"
                )
            known = np.where(entered >= -1, entered + 1, UNUSED)
            completion[completing] = np.broadcast_to(known[:, None], completing.shape)[completing]
        ticks = int(completion.max(initial=-1)) + 1
        return cls(
            problem,
            reachable_places(problem, alternatives(problem)) if options.goal_marginals else [],
            completion,
            np.zeros(int(automaton.branch.max(initial=-1)) + 1),
            np.zeros(ticks),
            -np.inf if options.completion_probability == 1 else 0.0,
            np.arange(0),
            np.empty(0),
        )

    @property
    def needed(self) -> bool:
        """Whether anything has to be fitted."""
        return self.fixed is None and self._constrained

    @property
    def _constrained(self) -> bool:
        return bool(self.branch_groups) or self.completion_tick.max(initial=-1) >= 0 or np.isfinite(self.log_failure)

    @property
    def branches(self) -> int:
        """How many branches are constrained."""
        return sum(len(group) for group in self.branch_groups)

    def log_weight(self) -> Floats:
        """``[Q, L]``: log of the factor on each transition."""
        if self.fixed is not None:
            return self.fixed
        branch = self.problem.automaton.branch
        total = np.zeros(branch.shape)
        if len(self.log_branch):
            total += np.where(branch >= 0, self.log_branch[np.maximum(branch, 0)], 0.0)
        if len(self.log_tick):
            used = self.completion_tick >= 0
            total[used] += self.log_tick[self.completion_tick[used]]
        return total

    def visits(self, flux: Floats) -> Floats:
        """``[B]`` expected visits by branch, from expected transitions ``[Q, L]``."""
        branch = self.problem.automaton.branch
        used = branch >= 0
        return np.asarray(np.bincount(branch[used], flux[used], minlength=len(self.log_branch)), dtype=np.float64)

    def completions(self, flux: Floats) -> Floats:
        """``[ticks]`` probability of completing at each tick (timing prior only)."""
        used = self.completion_tick >= 0
        ticks = np.bincount(self.completion_tick[used], flux[used], minlength=len(self.log_tick))
        return np.asarray(ticks, dtype=np.float64)

    def completed(self, flux: Floats) -> float:
        complete = np.asarray(self.problem.status) == COMPLETE
        into = complete[self.problem.automaton.delta] & ~complete[:, None]
        return float(flux[into].sum())

    def drop_infeasible(self, flux: Floats) -> None:
        """Leave out the branches and ticks that the mission-conditioned reference (almost) never takes."""
        least = self.problem.options.least_share
        visits = self.visits(flux)
        groups = []
        for group in self.branch_groups:
            usable = group[visits[group] > least * max(visits[group].sum(), 1e-300)]
            # A place visited on every path has no alternative.
            usable = usable[np.abs(visits[usable] - 1) > 1e-12] if len(usable) > 1 else usable
            if len(usable) > 1:
                groups.append(usable)
        self.branch_groups = groups
        if self.free_visits is None:
            self.free_visits = visits
        self.wanted_shares = [goal_shares(self.problem, group, self.free_visits[group]) for group in groups]
        if len(self.log_tick):
            share = self.completions(flux)
            target = self._uniform_ticks(share > least * max(share.sum(), 1e-300))
            self.ticks = np.flatnonzero(target > 0)
            self.tick_shares = target[self.ticks]
            self.log_tick[:] = np.where(target > 0, 0.0, -np.inf)

    def _uniform_ticks(self, possible: NDArray[np.bool_]) -> Floats:
        """``[ticks]``: uniform over each start cell's feasible ticks, averaged over the start."""
        at = np.arange(len(possible))
        start = np.asarray(self.problem.start)
        used = np.flatnonzero(start)
        earliest = np.broadcast_to(np.asarray(self.problem.earliest_tick), start.shape)[used]
        feasible = possible & (at >= earliest[:, None])
        feasible[~feasible.any(axis=1)] = possible
        return np.asarray(start[used] @ (feasible / feasible.sum(axis=1, keepdims=True)))

    def residual(self, flux: Floats) -> Floats:
        """Log-ratios target / present of every constrained expectation: the scaling step, zero when all are met."""
        parts = []
        visits = self.visits(flux)
        for group, wanted in zip(self.branch_groups, self.wanted_shares, strict=True):
            present = np.maximum(visits[group], 1e-300)
            parts.append(np.log(present.sum() * wanted) - np.log(present))
        if len(self.ticks):
            present = np.maximum(self.completions(flux)[self.ticks], 1e-300)
            parts.append(np.log(present.sum() * self.tick_shares) - np.log(present))
        if np.isfinite(self.log_failure):
            done = self.completed(flux)
            chance = self.problem.options.completion_probability
            odds = np.log(chance / (1 - chance)) - np.log(max(done, 1e-300) / max(1 - done, 1e-300))
            parts.append(np.array([-odds]))
        return np.concatenate(parts) if parts else np.empty(0)

    @property
    def scaling_is_exact(self) -> bool:
        """Whether every completing trajectory takes exactly one branch of one set, as its last step.

        One scaling step then meets the targets, but for what differs between start cells.
        """
        if len(self.branch_groups) != 1 or len(self.log_tick) or np.isfinite(self.log_failure):
            return False
        automaton = self.problem.automaton
        return bool((automaton.delta[np.isin(automaton.branch, self.branch_groups[0])] == automaton.accepting).all())

    def start_from(self, other: Tilt) -> None:
        """Take over the weights of the branches and of failure, fitted on another grid, and what was wanted there."""
        self.log_branch[:] = other.log_branch
        self.free_visits = other.free_visits
        if np.isfinite(self.log_failure):
            self.log_failure = other.log_failure

    def get(self) -> Floats:
        """The free logarithmic weights as one vector, in the order of `residual`."""
        parts = [self.log_branch[group] for group in self.branch_groups]
        if len(self.ticks):
            parts.append(self.log_tick[self.ticks])
        if np.isfinite(self.log_failure):
            parts.append(np.array([self.log_failure]))
        return np.concatenate(parts) if parts else np.empty(0)

    def put(self, vector: Floats) -> None:
        """Set the free logarithmic weights; the mean of each set of alternatives, which has no effect, is removed."""
        at = 0
        for group in self.branch_groups:
            part = vector[at : at + len(group)]
            self.log_branch[group] = part - part.mean()
            at += len(group)
        if len(self.ticks):
            part = vector[at : at + len(self.ticks)]
            self.log_tick[self.ticks] = part - part.mean() if not np.isfinite(self.log_failure) else part
            at += len(self.ticks)
        if np.isfinite(self.log_failure):
            self.log_failure = float(vector[at])
