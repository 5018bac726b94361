"""Whether numbers are states of a model: one pass, since a search of a thousand simulations takes half a millisecond."""

# mypy: allow-untyped-defs, allow-untyped-calls, allow-untyped-decorators, no-check-untyped-defs

from __future__ import annotations

import math

import numpy as np
from numba import njit

ALL_STATES = -1


@njit(cache=True)
def first_outside(states, lowest, highest, whole):
    """``row * D + entry`` of the first number of `states` [P, D] out of its entry's bounds, or not whole where it must be; or ALL_STATES."""
    size = states.shape[1]
    for row in range(len(states)):
        for entry in range(size):
            number = states[row, entry]
            # In this form a NaN is outside.
            if not (lowest[entry] <= number <= highest[entry]) or (whole[entry] and number != math.floor(number)):
                return row * size + entry
    return np.int64(ALL_STATES)
