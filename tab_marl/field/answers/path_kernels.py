# mypy: ignore-errors
"""Compiled loops over single trajectories: the entropy of the field's kernel, and the most likely continuation.

Letters as in `kernels`. ``indptr, indices, data`` is one whole tick of one reference as a CSR matrix ``[S, S]``, each
pair of states once (`Reference.matrix`). Slow twins: ``tests/field/test_answers.py`` enumerates trajectories.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit


@njit(cache=True)
def row_entropy(rows, chain, indptr, indices, data, mass):
    """Sum over the automaton states in `rows` of ``mass[q, s]`` times the entropy of the kernel from (q, s), in nats."""
    total = 0.0
    for q in rows:
        for s in range(mass.shape[1]):
            here = mass[q, s]
            if here > 0.0 and chain.norm[q, s] > 0.0:
                norm = np.float64(chain.norm[q, s])
                entropy = 0.0
                for k in range(indptr[s], indptr[s + 1]):
                    following = indices[k]
                    symbol = chain.symbol_of[following]
                    ahead = chain.factor[q, symbol] * chain.value[chain.delta[q, symbol], following]
                    p = data[k] * ahead / norm
                    if p > 0.0:
                        entropy -= p * math.log(p)
                total += here * entropy
    return total


@njit(cache=True)
def best_ahead(q, symbol_of, delta, log_weight, indptr, indices, log_data, best, out):
    """``out[s] = max over s' of log P(s'|s) + log w(q, l') + best[q', s']``."""
    for s in range(out.shape[0]):
        top = -math.inf
        for k in range(indptr[s], indptr[s + 1]):
            following = indices[k]
            symbol = symbol_of[following]
            here = log_data[k] + log_weight[q, symbol] + best[delta[q, symbol], following]
            top = max(top, here)
        out[s] = top
