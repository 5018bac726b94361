# mypy: ignore-errors
"""The backward message where the mission is over and events are still watched. Letters as in `kernels`."""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from tab_marl.field import kernels


@njit(cache=True)
def backward_free(order, motion, reference_of, labels, delta, weight, peak, value, norm, log_scale):
    """As `kernels.backward`, under the reference scaled to sum to 1; ``norm[q, s]`` is what scales the kernel of `push`.

    A state that no motion leaves stays where it is, as `push` has it (norm 0).
    """
    modes = motion.mix.shape[1]
    states = value.shape[1]
    ahead = np.empty(states)
    row = np.empty(states)
    for q in order:
        base = kernels.look_ahead(q, labels, delta, weight, value, log_scale, modes, ahead)
        if base == -math.inf:
            value[q, :] = 0.0
            norm[q, :] = 0.0
            log_scale[q] = -math.inf
            continue
        r = reference_of[q]
        kernels.expect_row(motion, r, ahead, row)
        largest = 0.0
        for s in range(states):
            survives = motion.row_sum[r * states + s]
            norm[q, s] = row[s]
            if survives > 0.0:
                row[s] /= survives
            else:
                row[s] = ahead[s]
            largest = max(largest, row[s])
        if largest == 0.0:
            value[q, :] = 0.0
            norm[q, :] = 0.0
            log_scale[q] = -math.inf
            continue
        factor = peak / largest
        for s in range(states):
            value[q, s] = row[s] * factor
            norm[q, s] *= factor
        log_scale[q] = base + math.log(largest / peak)
