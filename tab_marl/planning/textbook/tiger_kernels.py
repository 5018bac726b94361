# mypy: ignore-errors
"""A rollout for Tiger."""

# mypy: allow-untyped-defs, allow-untyped-calls, allow-untyped-decorators, no-check-untyped-defs

from __future__ import annotations

import numpy as np

from tab_marl.planning.table_kernels import draw


def patient_rollout(state, action, observation, depth, max_depth, discount, data, rng):
    """Tiger: listen until one side was heard twice more often, open the other door, and again, to the end."""
    tiger = np.int64(state[0])
    total = 0.0
    weight = 1.0
    surplus = 0
    for _ in range(depth, max_depth):
        door = 0 if abs(surplus) < 2 else (2 if surplus > 0 else 1)
        after = draw(data.transition, door * 2 + tiger, rng)
        heard = draw(data.observation, door * 2 + after, rng)
        total += weight * data.reward[door * 2 + tiger, after]
        weight *= discount
        tiger = after
        surplus = surplus + 1 - 2 * heard if door == 0 else 0
    return total
