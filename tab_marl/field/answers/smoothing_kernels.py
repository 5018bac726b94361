# mypy: ignore-errors
"""The backward pass over evidence: how likely later observations are from each state. Letters as in `kernels`."""

from __future__ import annotations

import numpy as np
from numba import njit

from tab_marl.field import kernels


@njit(cache=True)
def pull(mass, q, free, chain, slot, ahead, out):
    """``out[s] = sum over s' of P*(s'|s, q) ahead[slot[q'], s']`` wherever ``mass[s] > 0``: the transpose of `push`.

    `ahead` ``[n, S]`` holds the rows of the next tick's automaton states; `slot` ``[Q]`` is -1 where there is none.
    """
    motion = chain.motion
    modes = motion.mix.shape[1]
    states = mass.shape[0]
    r = chain.reference_of[q]
    any_tilted, any_plain = False, False
    for s in range(states):
        if mass[s] > 0.0:
            if not free and chain.norm[q, s] > 0.0:
                any_tilted = True
            else:
                any_plain = True
    weighed = np.zeros(states)
    plain = np.zeros(states)
    for cell in range(chain.labels.shape[0]):
        symbol = chain.labels[cell]
        following = chain.delta[q, symbol]
        row = slot[following]
        if row >= 0:
            factor = chain.factor[q, symbol]
            for s in range(cell * modes, (cell + 1) * modes):
                plain[s] = ahead[row, s]
                if any_tilted and factor > 0.0 and ahead[row, s] > 0.0:
                    weighed[s] = ahead[row, s] * factor * chain.value[following, s]
    tilted_sum = np.zeros(states)
    plain_sum = np.zeros(states)
    if any_tilted:
        kernels.expect_row(motion, r, weighed, tilted_sum)
    if any_plain:
        kernels.expect_row(motion, r, plain, plain_sum)
    for s in range(states):
        out[s] = 0.0
        if mass[s] > 0.0:
            if not free and chain.norm[q, s] > 0.0:
                out[s] = tilted_sum[s] / chain.norm[q, s]
            else:
                survives = motion.row_sum[r * states + s]
                out[s] = plain_sum[s] / survives if survives > 0.0 else plain[s]
