"""Fitting the weights of the constraints, in rounds of one backward and one forward pass.

A round ends with a step of the weights. Where trajectories visit one of several places and end, the step is iterative
proportional scaling. Where they visit several, visits are correlated and scaling crawls or overshoots; then the step
solves the same problem on the visits of sampled trajectories, reweighted, and is exact but for the sampling error.
Late rounds are accelerated after Anderson (1965).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from tab_marl.field.constraints.tilt import Tilt

Floats = NDArray[np.float64]

MEMORY = 6
"""Changes remembered."""
SAMPLED_ROUNDS = 5
"""Rounds in which trajectories are sampled anew; later ones keep them, so that the memory stays consistent."""
NEAR = 0.2
"""Relative error below which steps are accelerated."""
LONGEST_STEP = 3.0
"""Of one logarithmic weight in one round: beyond it the sampled trajectories say little."""


class History:
    """What earlier rounds taught: visits of trajectories, and how the step changes with the weights."""

    def __init__(self, visits: Floats | None = None, sizes: Sequence[int] = ()) -> None:
        self.sizes = tuple(sizes)
        """How many columns of `visits` belong to each set of alternatives."""
        self.visits = visits
        """``[K, n]`` visits of sampled trajectories at the constrained branches; None: plain scaling is exact."""
        self.moved: list[Floats] = []
        self.changed: list[Floats] = []

    def step(self, residual: Floats) -> Floats:
        """Log-ratios target / present -> a move of the logarithmic weights."""
        if self.visits is None:
            return residual
        count = self.visits.shape[1]
        return np.concatenate([reweighting_step(self.visits, residual[:count], self.sizes), residual[count:]])

    def propose(self, step: Floats) -> Floats:
        """The next move: the step, corrected by least squares over the known changes (Anderson 1965)."""
        if not self.moved:
            return step
        moved, changed = np.stack(self.moved, axis=1), np.stack(self.changed, axis=1)
        share = np.linalg.lstsq(changed, step, rcond=1e-10)[0]
        correction = (moved + changed) @ share
        if not np.isfinite(correction).all() or np.abs(correction).max() > 4 * float(np.abs(step).max()):
            return step
        return np.asarray(step - correction)

    def learn(self, moved: Floats, changed: Floats) -> None:
        self.moved.append(moved)
        self.changed.append(changed)
        del self.moved[:-MEMORY], self.changed[:-MEMORY]


def reweighting_step(visits: Floats, residual: Floats, sizes: Sequence[int]) -> Floats:
    """The change of log-weights that multiplies the mean of sampled visits ``[K, n]`` by ``exp(residual)``.

    The columns come in sets of `sizes`; the total of each set stays. Newton's method on the convex dual of the sampled
    problem, damped, and cut off at LONGEST_STEP.
    """
    present = visits.mean(axis=0)
    wanted = present * np.exp(residual)
    for part in np.split(np.arange(len(wanted)), np.cumsum(sizes)[:-1]):
        wanted[part] *= present[part].sum() / wanted[part].sum()
    move = np.zeros(len(residual))

    def dual(at: Floats) -> tuple[float, Floats]:
        exponent = visits @ at
        top = float(exponent.max())
        weight = np.exp(exponent - top)
        return top + float(np.log(weight.sum())) - float(at @ wanted), weight / weight.sum()

    value, law = dual(move)
    for _ in range(30):
        mean = law @ visits
        gradient = mean - wanted
        centred = visits - mean
        curvature = (centred * law[:, None]).T @ centred
        direction = -np.linalg.pinv(curvature, rcond=1e-6, hermitian=True) @ gradient
        longest = float(np.abs(direction).max())
        if longest < 1e-12:
            break
        scale = min(1.0, 1.0 / longest)
        while scale > 1e-4:
            following, candidate = dual(move + scale * direction)
            if following <= value:
                break
            scale /= 2
        else:
            break
        move, value, law = move + scale * direction, following, candidate
        if np.abs(move).max() > LONGEST_STEP:
            break
    return np.asarray(np.clip(move, -LONGEST_STEP, LONGEST_STEP))


def fit(
    tilt: Tilt,
    pass_both_ways: Callable[[Tilt], Floats],
    sample_visits: Callable[[], Floats],
    history: History | None = None,
) -> tuple[Floats, float, int, History]:
    """Fit the weights in place.

    Args:
        pass_both_ways: the expected transitions ``[Q, L]`` under a tilt's weights.
        sample_visits: visits ``[K, B]`` of trajectories drawn under the latest weights.
        history: of the fit of a similar problem; its sampled visits are used.
    Returns:
        The last expected transitions, the largest relative error of a constrained expectation, the rounds taken, and
        what was learnt.
    """
    options = tilt.problem.options
    flux = pass_both_ways(tilt)
    before = tilt.log_tick.copy()
    tilt.drop_infeasible(flux)
    if not np.array_equal(before, tilt.log_tick):
        flux = pass_both_ways(tilt)
    kept = history is not None and history.visits is not None and history.visits.shape[1] == tilt.branches
    sizes = [len(group) for group in tilt.branch_groups]
    history = History(history.visits if history is not None and kept else None, sizes)
    best, best_error = tilt.get(), np.inf
    residual = tilt.residual(flux)
    for rounds in range(1, options.max_iterations + 1):
        error = float(np.abs(np.expm1(np.clip(residual, -50, 50))).max(initial=0.0))
        if error < best_error:
            best, best_error = tilt.get(), error
        if error <= options.marginal_tolerance or rounds == options.max_iterations:
            break
        if tilt.branches and not (kept and rounds == 1) and rounds <= SAMPLED_ROUNDS:
            history = History(correlated_visits(tilt, sample_visits()), sizes)
        here = tilt.get()
        step = history.step(residual)
        tilt.put(here + (history.propose(step) if error < NEAR else step))
        flux = pass_both_ways(tilt)
        residual = tilt.residual(flux)
        history.learn(tilt.get() - here, history.step(residual) - step)
    if error > best_error:
        tilt.put(best)
        flux = pass_both_ways(tilt)
    return flux, best_error, rounds, history


def correlated_visits(tilt: Tilt, visits: Floats) -> Floats | None:
    """The columns of ``visits[K, B]`` that are constrained; None where each trajectory visits just one place."""
    used = visits[:, np.concatenate(tilt.branch_groups)]
    if len(tilt.branch_groups) == 1 and (used.sum(axis=1) == 1).all():
        return None
    return None if (used.sum(axis=0) == 0).any() else used
