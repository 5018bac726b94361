"""Soft constraints: the multipliers of the paper's eq. 1 by ascent of its convex dual, with a report of how well they hold.

The minimiser of KL(P || Q) subject to E_P[f] = c is Q exp(lambda' f) / Z. The dual, sum over s0 of mu0(s0) log Z(s0) minus
lambda' c, is convex; its gradient E_P[f] - c costs one backward and one forward pass. BFGS from `scipy.optimize` finds
the neighbourhood of the optimum; where rounding of the dual's value stops it, secant steps on the gradient finish.
Each f is a sum over the transitions of the automaton that a trajectory takes (`tracking`).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from scipy import optimize, sparse
from scipy.special import logit

from tab_marl.field.chain import ProductChain
from tab_marl.field.constraints.contradiction import ContradictoryConstraints, explain
from tab_marl.field.constraints.events import Completes, SoftConstraint, TimingPrior
from tab_marl.field.constraints.goals import alternatives, goal_shares, reachable_places
from tab_marl.field.constraints.report import ConstraintFit, FitReport
from tab_marl.field.constraints.tilt import Tilt, ticks_of
from tab_marl.field.infeasible import InfeasibleField
from tab_marl.field.problem import COMPLETE, FieldProblem
from tab_marl.field.tab_field import expected_transitions, start_log_partition

Floats = NDArray[np.float64]
Message = Callable[[FieldProblem, Tilt], ProductChain]

LARGEST_MULTIPLIER = 150.0
"""Beyond e^150 a constraint is met only in the limit, if at all."""
SECANT_STEPS = 40
NEAR = 1e-3
"""Deviation from which secant steps take over."""
SUSPICIOUS = 40
"""Passes after which a contradiction is looked for; compatible targets rarely take 25."""
LEAST_SPREAD = 0.02
"""Keeps the first steps short."""


@dataclass(eq=False)
class Features:
    """F linear constraints E_P[f] = target, as sums of transitions."""

    matrix: sparse.csr_array
    """``[F, Q * L]``."""
    target: Floats
    """``[F]``."""
    allowed: Floats
    """``[F]`` deviation that counts as met."""
    start: Floats
    """``[F]`` a first guess of the multipliers."""
    spread: Floats
    """``[F]`` about the variance of f: scales the first step."""
    names: list[str]


@dataclass(eq=False)
class _Builder:
    """Collects features; `flux` are the expected transitions of the field without soft constraints."""

    problem: FieldProblem
    flux: Floats
    rows: list[Floats] = field(default_factory=list)
    target: list[float] = field(default_factory=list)
    allowed: list[float] = field(default_factory=list)
    start: list[float] = field(default_factory=list)
    spread: list[float] = field(default_factory=list)
    names: list[str] = field(default_factory=list)
    forbidden: NDArray[np.bool_] | None = None

    def probability(self, name: str, happens: NDArray[np.bool_], wanted: float, present: float | None = None) -> None:
        """``E[transitions in happens] = wanted``."""
        there = float(self.flux[happens].sum()) if present is None else present
        there = min(max(there, 1e-12), 1 - 1e-12)
        self._add(
            name, happens.astype(np.float64), wanted, self.problem.options.constraint_tolerance,
            float(logit(wanted) - logit(there)), wanted * (1 - wanted),
        )  # fmt: skip

    def shares(self, names: list[str], each: list[NDArray[np.bool_]], shares: Floats) -> None:
        """The transitions in ``each[i]`` are taken in proportion to ``shares[i]``: ``E[f_i - share_i f] = 0``."""
        total = np.sum([happens.astype(np.float64) for happens in each], axis=0)
        mass = float((self.flux * total).sum())
        for name, happens, share in zip(names, each, shares, strict=True):
            present = max(float(self.flux[happens].sum()), 1e-300) / mass
            close = self.problem.options.marginal_tolerance * share * mass
            self._add(name, happens - share * total, 0.0, close, float(np.log(share / present)), share * mass)

    def _add(self, name: str, row: Floats, target: float, allowed: float, start: float, spread: float) -> None:
        self.names.append(name)
        self.rows.append(row.ravel())
        self.target.append(target)
        self.allowed.append(allowed)
        self.start.append(float(np.clip(start, -30, 30)))
        self.spread.append(max(spread, LEAST_SPREAD))

    def forbid(self, transitions: NDArray[np.bool_]) -> None:
        self.forbidden = transitions if self.forbidden is None else self.forbidden | transitions

    def features(self) -> Features:
        shape = (len(self.rows), self.flux.size)
        matrix = sparse.csr_array(sparse.vstack([sparse.csr_array(row[None]) for row in self.rows]), shape=shape)
        return Features(
            matrix,
            np.array(self.target),
            np.array(self.allowed),
            np.array(self.start),
            np.array(self.spread),
            self.names,
        )


def completion_target(problem: FieldProblem) -> float:
    """c of the mission's own completion; 1 if it must be completed."""
    for constraint in problem.constraints:
        if isinstance(constraint, SoftConstraint) and _own(constraint):
            return constraint.probability
    return problem.options.completion_probability


def fit_soft(problem: FieldProblem, message: Message) -> tuple[ProductChain, Tilt, Floats, FitReport]:
    """The chain, its weights, its expected transitions and the report.

    Raises ContradictoryConstraints, InfeasibleField.
    """
    shape = problem.automaton.delta.shape
    wanted = completion_target(problem)
    soft = wanted < 1
    hard = message(problem, Tilt.given(problem, np.zeros(shape), -np.inf))
    built = _build(problem, hard, wanted)
    features = built.features()
    base = np.zeros(shape)
    if built.forbidden is not None:
        base[built.forbidden] = -np.inf

    def certify() -> str:
        return explain(problem, message, soft, wanted) or ""

    ascent = _Ascent(problem, message, features, base, 0.0 if soft else -np.inf, certify)
    try:
        ascent.run()
    except InfeasibleField as error:
        raise ContradictoryConstraints(f"the constraints leave no trajectory at all: {error}") from None
    if not ascent.met:
        raise ContradictoryConstraints(_why(ascent))
    return ascent.chain, ascent.tilt, ascent.flux, ascent.report()


def _why(ascent: _Ascent) -> str:
    """The certificate, or what the ascent can say itself."""
    if ascent.hopeless is None:
        ascent.hopeless = ascent.certify()
    if ascent.hopeless:
        return ascent.hopeless
    worst = np.argsort(-np.abs(ascent.gap) / ascent.features.allowed)[:3]
    missed = "; ".join(
        f"{ascent.features.names[i]}: {ascent.present[i]:.6g} instead of {ascent.features.target[i]:.6g}" for i in worst
    )
    return (
        f"the constraints are not met after {ascent.passes} passes ({missed}): each event could have its probability, but "
        "not beside the timing priors and goal marginals, or only in the limit; drop one, loosen constraint_tolerance, or "
        "raise max_iterations"
    )


def _build(problem: FieldProblem, hard: ProductChain, wanted: float) -> _Builder:
    flux = expected_transitions(hard, problem.automaton.rank)
    built = _Builder(problem, flux)
    complete = np.asarray(problem.status) == COMPLETE
    completing = complete[problem.automaton.delta] & ~complete[:, None]
    if wanted < 1:
        log_z = start_log_partition(hard)
        used = np.isfinite(log_z)
        chance = float(np.asarray(problem.start)[used] @ np.exp(np.minimum(log_z[used], 0.0)))
        built.probability("completes the mission", completing, wanted, chance)
    tracking = problem.tracking
    k = 0
    for constraint in problem.constraints:
        if isinstance(constraint, SoftConstraint) and not _own(constraint):
            assert tracking is not None
            while tracking.names[k] == "clock":
                k += 1
            built.probability(tracking.names[k], tracking.happens[k], constraint.probability)
            k += 1
    if problem.options.goal_marginals:
        _goal_marginals(built)
    priors = [c for c in problem.constraints if isinstance(c, TimingPrior)]
    if problem.options.timing_prior:
        priors.append(TimingPrior())
    for prior in priors:
        _timing(built, prior)
    return built


def _own(constraint: SoftConstraint) -> bool:
    return isinstance(constraint.event, Completes) and constraint.event.mission is None


def _goal_marginals(built: _Builder) -> None:
    """Several places that can serve share their visits as `FieldOptions.goal_marginals` says."""
    problem, branch = built.problem, built.problem.automaton.branch
    names = problem.branch_places or tuple(str(b) for b in range(int(branch.max(initial=-1)) + 1))
    visits = np.bincount(branch[branch >= 0], built.flux[branch >= 0], minlength=len(names))
    for group in reachable_places(problem, alternatives(problem)):
        usable = group[visits[group] > problem.options.least_share * max(visits[group].sum(), 1e-300)]
        usable = usable[np.abs(visits[usable] - 1) > 1e-12] if len(usable) > 1 else usable
        if len(usable) > 1:
            each = [branch == b for b in usable]
            shares = goal_shares(problem, usable, visits[usable])
            built.shares([f"visits {names[b]}" for b in usable], each, shares)


def _timing(built: _Builder, prior: TimingPrior) -> None:
    problem = built.problem
    count = len(problem.stage_names)
    stage = prior.stage % count
    name = problem.stage_names[stage]
    before = np.asarray(problem.stage)[:, None]
    crossing = (before <= stage) & (np.asarray(problem.stage)[problem.automaton.delta] > stage)
    crossing &= before >= 0
    entered = ticks_of(problem)
    tick = np.where(crossing & (entered >= -1)[:, None], entered[:, None] + 1, -1)
    share = np.bincount(tick[tick >= 0], built.flux[tick >= 0], minlength=int(tick.max(initial=0)) + 1)
    possible = share > problem.options.least_share * max(share.sum(), 1e-300)
    step = problem.step_seconds
    if prior.shares is None:
        wanted = _uniform(problem, stage, possible)
    else:
        wanted = np.zeros(len(share))
        for seconds, part in prior.shares.items():
            at = round(seconds / step)
            if part > 0 and (at >= len(share) or not possible[at]):
                feasible = np.flatnonzero(possible) * step
                raise ContradictoryConstraints(
                    f"{name} at {seconds:g} s (share {part:g}) cannot be: the mission and the map allow it between "
                    f"{feasible.min():g} and {feasible.max():g} s; move that share"
                )
            if part > 0:
                wanted[at] += part
    built.forbid(crossing & ~(wanted > 0)[np.maximum(tick, 0)])
    used = np.flatnonzero(wanted > 0)
    if len(used) > 1:
        names = [f"{name} at {t * step:g} s" for t in used]
        built.shares(names, [tick == t for t in used], wanted[used])


def _uniform(problem: FieldProblem, stage: int, possible: NDArray[np.bool_]) -> Floats:
    """``[ticks]``: uniform over each start cell's feasible ticks, averaged over the start."""
    start = np.asarray(problem.start)
    used = np.flatnonzero(start)
    earliest = np.broadcast_to(problem.earliest_of_stage(stage), start.shape)[used]
    feasible = possible & (np.arange(len(possible)) >= earliest[:, None])
    feasible[~feasible.any(axis=1)] = possible
    return np.asarray(start[used] @ (feasible / feasible.sum(axis=1, keepdims=True)))


class _Enough(Exception):
    """The constraints hold, or never will."""


class _Ascent:
    """The state of the fit: the latest point of the dual."""

    def __init__(
        self,
        problem: FieldProblem,
        message: Message,
        features: Features,
        base: Floats,
        log_failure: float,
        certify: Callable[[], str],
    ) -> None:
        self.problem, self.message, self.features = problem, message, features
        self.base, self.log_failure = base, log_failure
        self.passes, self.iterations = 0, 0
        self.met = False
        self.certify = certify
        self.hopeless: str | None = None
        """The certificate of a contradiction; empty if it was looked for and there is none."""
        self.multipliers = features.start.copy()
        self.gap = np.full(len(features.target), np.inf)
        self.present = np.zeros(len(features.target))
        self.dual = np.nan
        self.chain: ProductChain
        self.flux: Floats
        self.tilt: Tilt

    def evaluate(self, multipliers: Floats) -> tuple[float, Floats]:
        """(dual to be minimised, its gradient E[f] - c). Raises _Enough once all constraints hold."""
        if self.passes == SUSPICIOUS and self.hopeless is None:
            self.hopeless = self.certify()
        if self.hopeless:
            raise _Enough
        limit = 4 * self.problem.options.max_iterations
        if self.passes >= limit or np.abs(multipliers).max(initial=0.0) > LARGEST_MULTIPLIER:
            raise _Enough
        self.passes += 1
        shape = self.base.shape
        weight = self.base + np.asarray(multipliers @ self.features.matrix).reshape(shape)
        self.tilt = Tilt.given(self.problem, weight, self.log_failure)
        with np.errstate(over="ignore"):  # far from the optimum
            self.chain = self.message(self.problem, self.tilt)
        self.flux = expected_transitions(self.chain, self.problem.automaton.rank)
        self.present = np.asarray(self.features.matrix @ self.flux.ravel())
        self.gap = self.present - self.features.target
        self.multipliers = multipliers.copy()
        log_z = start_log_partition(self.chain)
        used = self.chain.start > 0
        value = float(self.chain.start[used] @ log_z[used]) - float(multipliers @ self.features.target)
        self.dual = -value
        self.met = bool((np.abs(self.gap) <= self.features.allowed).all())
        if self.met:
            raise _Enough
        return value, self.gap.copy()

    def run(self) -> None:
        if not len(self.features.target):
            self._once()
            return
        try:
            found = optimize.minimize(  # type: ignore[call-overload]
                self.evaluate, self.features.start, jac=True, method="BFGS", callback=self._count,
                options={
                    "gtol": 0.0, "maxiter": self.problem.options.max_iterations,
                    "hess_inv0": np.diag(1 / self.features.spread),
                },
            )  # fmt: skip
            self._secant(np.asarray(found.x), np.asarray(found.hess_inv))
        except _Enough:
            return

    def _once(self) -> None:
        try:
            self.evaluate(np.zeros(0))
        except _Enough:
            return

    def _count(self, _: Floats) -> None:
        self.iterations += 1
        if np.abs(self.gap).max() < NEAR:
            raise StopIteration  # line searches would compare values of the dual that differ by rounding only

    def _secant(self, at: Floats, inverse: Floats) -> None:
        """Broyden's updates of the inverse Hessian; a step that makes the gradient larger is halved."""
        _, gap = self.evaluate(at)
        for _ in range(SECANT_STEPS):
            self.iterations += 1
            step = -inverse @ gap
            for _ in range(6):
                _, following = self.evaluate(at + step)
                if np.linalg.norm(following) <= 2 * np.linalg.norm(gap):
                    break
                step /= 4
            change = following - gap
            along = float(step @ inverse @ change)
            if along != 0:
                inverse = inverse + np.outer(step - inverse @ change, step @ inverse) / along
            at, gap = at + step, following

    def report(self) -> FitReport:
        """What stands now."""
        f = self.features
        rows = tuple(
            ConstraintFit(name, float(target), float(present), float(multiplier), float(allowed))
            for name, target, present, multiplier, allowed in zip(
                f.names, f.target, self.present, self.multipliers, f.allowed, strict=True
            )
        )
        return FitReport(rows, self.iterations, self.passes, float(self.dual))
