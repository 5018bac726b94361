# mypy: ignore-errors
"""Compiled loops that draw states and trajectories from a product chain. Letters as in `kernels`.

Arrays and scalars only; nothing here validates or raises. Slow twins: ``tests/field/test_kernels.py``.
"""

from __future__ import annotations

import numpy as np
from numba import njit


@njit(cache=True)
def draw_states(masses, total, count, offset, slots, states):
    """Systematic sampling of `count` (row, s) from ``masses[n, S]``: points ``(i + offset) * total / count``."""
    spacing = total / count
    reached = 0.0
    drawn = 0
    last_row, last_state = 0, 0
    for i in range(masses.shape[0]):
        for s in range(masses.shape[1]):
            here = masses[i, s]
            if here > 0.0:
                reached += here
                last_row, last_state = i, s
                while drawn < count and (drawn + offset) * spacing < reached:
                    slots[drawn] = i
                    states[drawn] = s
                    drawn += 1
    while drawn < count:
        slots[drawn] = last_row
        states[drawn] = last_state
        drawn += 1


@njit(cache=True)
def next_uniform(streams, i):
    """A uniform of [0, 1) from stream i: SplitMix64 (Steele, Lea and Flood 2014)."""
    streams[i] += np.uint64(0x9E3779B97F4A7C15)
    z = streams[i]
    z = (z ^ (z >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    z = (z ^ (z >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    z = z ^ (z >> np.uint64(31))
    return np.float64(z >> np.uint64(11)) * (1.0 / 9007199254740992.0)


@njit(cache=True)
def bridge_step(chain, q, s, uniform):
    """The next base state from (q, s) with norm > 0, by inverting the kernel of `push` at `uniform` in [0, 1).

    New modes are tried by falling probability, so most draws end after a few terms.
    """
    motion = chain.motion
    modes = motion.mix.shape[1]
    states = chain.value.shape[1]
    r = chain.reference_of[q]
    mode = s % modes
    first = s - mode
    target = uniform * chain.norm[q, s]
    reached = 0.0
    found = -1
    for j in range(modes):
        after = motion.mix_order[r, mode, j]
        share = motion.mix[r, mode, after]
        if share <= 0.0:
            break
        row = r * states + first + after
        for k in range(motion.indptr[row], motion.indptr[row + 1]):
            following = motion.indices[k]
            symbol = chain.symbol_of[following]
            amount = share * motion.data[k] * chain.factor[q, symbol]
            if amount > 0.0:
                amount *= chain.value[chain.delta[q, symbol], following]
                if amount > 0.0:
                    found = following
                    reached += amount
                    if reached > target:
                        return found
    return found


@njit(cache=True)
def reference_step(motion, r, states, s, streams, i):
    """The next base state of the plain reference, given that it is not killed: redrawn until it survives."""
    modes = motion.mix.shape[1]
    mode = s % modes
    first = s - mode
    if motion.row_sum[r * states + s] <= 0.0:
        return s
    while True:
        after = 0
        if modes > 1:
            target = next_uniform(streams, i)
            reached = 0.0
            for j in range(modes):
                after = motion.mix_order[r, mode, j]
                reached += motion.mix[r, mode, after]
                if reached > target:
                    break
        target = next_uniform(streams, i)
        reached = 0.0
        row = r * states + first + after
        for k in range(motion.indptr[row], motion.indptr[row + 1]):
            reached += motion.data[k]
            if reached > target:
                return motion.indices[k]


@njit(cache=True)
def sample_paths(chain, streams, automaton_states, base_states, completed_tick):
    """Fill ``[K, ticks + 1]`` automaton and base states from column 0 on; ``completed_tick[K]``, -1 if never."""
    states = chain.value.shape[1]
    count, columns = base_states.shape
    for i in range(count):
        completed_tick[i] = 0 if chain.complete[automaton_states[i, 0]] else -1
    # Tick by tick: the paths of one tick read the same rows of the table.
    for t in range(1, columns):
        for i in range(count):
            q = automaton_states[i, t - 1]
            s = base_states[i, t - 1]
            following = -1
            if q != chain.accepting and q != chain.rejecting and chain.norm[q, s] > 0.0:
                following = bridge_step(chain, q, s, next_uniform(streams, i))
            if following < 0:
                following = reference_step(chain.motion, chain.reference_of[q], states, s, streams, i)
            q = chain.delta[q, chain.symbol_of[following]]
            automaton_states[i, t] = q
            base_states[i, t] = following
            if chain.complete[q] and completed_tick[i] < 0:
                completed_tick[i] = t
