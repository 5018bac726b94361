"""Fitting the weights of the constraints: iterative proportional scaling, with Newton's step and Anderson's memory.

Each round is one backward and one forward pass.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from tab_marl.field.constraints import Tilt

Floats = NDArray[np.float64]

MEMORY = 6
"""Changes remembered."""
NEWTON_ROUNDS = 3
"""Rounds in which the Newton matrix is sampled anew; later ones keep it, so that the memory stays consistent."""


class History:
    """What earlier rounds taught: how weights move the expected visits, and how the step changes with the weights."""

    def __init__(self, newton: Floats | None = None) -> None:
        self.newton = newton
        """``[n, n]`` from log-ratios of visits to changes of the branches' weights; None: the ratios themselves."""
        self.moved: list[Floats] = []
        self.changed: list[Floats] = []

    def step(self, residual: Floats) -> Floats:
        """Log-ratios -> a move of the weights: plain scaling, or Newton's step for the branches."""
        if self.newton is None:
            return residual
        count = len(self.newton)
        return np.concatenate([np.clip(self.newton @ residual[:count], -3.0, 3.0), residual[count:]])

    def propose(self, step: Floats) -> Floats:
        """The next move: the step, corrected by least squares over the known changes (Anderson 1965)."""
        if not self.moved:
            return step
        moved, changed = np.stack(self.moved, axis=1), np.stack(self.changed, axis=1)
        share = np.linalg.lstsq(changed, step, rcond=1e-10)[0]
        correction = (moved + changed) @ share
        if not np.isfinite(correction).all() or np.abs(correction).max() > 4 * max(1.0, float(np.abs(step).max())):
            return step
        return np.asarray(step - correction)

    def learn(self, moved: Floats, changed: Floats) -> None:
        self.moved.append(moved)
        self.changed.append(changed)
        del self.moved[:-MEMORY], self.changed[:-MEMORY]


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
        history: of the fit of a similar problem; its Newton matrix is kept.
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
    kept = history is not None and history.newton is not None and len(history.newton) == tilt.branches
    history = History(history.newton if history is not None and kept else None)
    best, best_error = tilt.get(), np.inf
    residual = tilt.residual(flux)
    for rounds in range(1, options.max_iterations + 1):
        error = float(np.abs(np.expm1(np.clip(residual, -50, 50))).max(initial=0.0))
        if error < best_error:
            best, best_error = tilt.get(), error
        if error <= options.marginal_tolerance or rounds == options.max_iterations:
            break
        if not kept and rounds <= NEWTON_ROUNDS and tilt.branches:
            history = History(newton_matrix(tilt, sample_visits()))
        here = tilt.get()
        step = history.step(residual)
        tilt.put(here + history.propose(step))
        flux = pass_both_ways(tilt)
        residual = tilt.residual(flux)
        history.learn(tilt.get() - here, history.step(residual) - step)
    if error > best_error:
        tilt.put(best)
        flux = pass_both_ways(tilt)
    return flux, best_error, rounds, history


def newton_matrix(tilt: Tilt, visits: Floats) -> Floats | None:
    """Inverse Jacobian of the log-visits of the constrained branches, from the visits ``[K, B]`` of sampled trajectories.

    d E[n_b] / d log w_c = Cov(n_b, n_c) in an exponential family. Where each trajectory visits exactly one of a single
    set of alternatives, plain scaling is that step already, and None is returned.
    """
    used = visits[:, np.concatenate(tilt.branch_groups)]
    if len(tilt.branch_groups) == 1 and (used.sum(axis=1) == 1).all():
        return None
    mean = used.mean(axis=0)
    if (mean <= 0).any():
        return None
    covariance = (used - mean).T @ (used - mean) / len(used)
    return np.asarray(np.linalg.pinv(covariance / mean[:, None], rcond=1e-3))
