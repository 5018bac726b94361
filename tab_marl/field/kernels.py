"""Compiled loops of the field: backward messages, pushing mass forward, sampling trajectories.

Arrays and scalars only; nothing here validates or raises. Each has a slow twin in ``tests/field/slow.py``.

Letters: C cells, M modes (headings and rest), S = C * M base states, cell-major (``s = cell * M + mode``), Q automaton
states, L label symbols, R references. One tick of reference r: the mode is redrawn by ``mix[r, m, m']``, then the state
moves by CSR row ``r * S + cell * M + m'``; rows may sum to less than 1 (the rest of the mass is killed).
A table ``value[q, s]`` holds h / exp(log_scale[q]).
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit


@njit(cache=True)
def expect_row(moves_from, indptr, indices, data, mix, ahead, out):
    """``out[s] = sum_s' P(s'|s) ahead[s']`` for one reference: CSR rows from `moves_from` on, `mix` ``[M, M]``."""
    modes = mix.shape[0]
    states = out.shape[0]
    if modes == 1:
        for s in range(states):
            total = 0.0
            for k in range(indptr[moves_from + s], indptr[moves_from + s + 1]):
                total += data[k] * ahead[indices[k]]
            out[s] = total
        return
    transposed = mix.T.copy()
    moved = np.empty(modes)
    drawn = np.empty(modes)
    for first in range(0, states, modes):
        alive = False
        for m in range(modes):
            total = 0.0
            for k in range(indptr[moves_from + first + m], indptr[moves_from + first + m + 1]):
                total += data[k] * ahead[indices[k]]
            moved[m] = total
            alive = alive or total > 0.0
        drawn[:] = 0.0
        if alive:
            for after in range(modes):
                if moved[after] > 0.0:
                    for m in range(modes):
                        drawn[m] += transposed[after, m] * moved[after]
        for m in range(modes):
            out[first + m] = drawn[m]


@njit(cache=True)
def look_ahead(q, labels, delta, weight, value, log_scale, modes, ahead):
    """Fill ``ahead[s'] = w(q, l') h[q', s'] / exp(base)``; return base (-inf if nothing lies ahead)."""
    symbols = delta.shape[1]
    base = -math.inf
    for symbol in range(symbols):
        if weight[q, symbol] > 0.0:
            base = max(base, log_scale[delta[q, symbol]])
    if base == -math.inf:
        ahead[:] = 0.0
        return base
    for cell in range(labels.shape[0]):
        symbol = labels[cell]
        following = delta[q, symbol]
        factor = weight[q, symbol] * math.exp(log_scale[following] - base)
        first = cell * modes
        if factor == 0.0:
            for s in range(first, first + modes):
                ahead[s] = 0.0
        else:
            for s in range(first, first + modes):
                ahead[s] = factor * value[following, s]
    return base


@njit(cache=True)
def backward(order, indptr, indices, data, mix, reference_of, labels, delta, weight, peak, value, log_scale):
    """Backward messages of the automaton states in `order` (falling rank), each row scaled to a maximum of `peak`.

    Rows of `value` and `log_scale` for absorbing states are inputs, the others outputs (design, section 4).
    """
    modes = mix.shape[1]
    states = value.shape[1]
    ahead = np.empty(states)
    row = np.empty(states)
    for q in order:
        base = look_ahead(q, labels, delta, weight, value, log_scale, modes, ahead)
        if base == -math.inf:
            value[q, :] = 0.0
            log_scale[q] = -math.inf
            continue
        r = reference_of[q]
        expect_row(r * states, indptr, indices, data, mix[r], ahead, row)
        largest = 0.0
        for s in range(states):
            largest = max(largest, row[s])
        if largest == 0.0:
            value[q, :] = 0.0
            log_scale[q] = -math.inf
            continue
        factor = peak / largest
        for s in range(states):
            value[q, s] = row[s] * factor
        log_scale[q] = base + math.log(largest) - math.log(peak)


@njit(cache=True)
def normalisers(order, indptr, indices, data, mix, reference_of, labels, delta, weight, value, log_scale, norm):
    """``norm[q, s] = sum_s' P(s'|s) w h[q', s'] / exp(log_scale[q])`` for any table, harmonic or not."""
    modes = mix.shape[1]
    states = value.shape[1]
    ahead = np.empty(states)
    row = np.empty(states)
    for q in order:
        base = look_ahead(q, labels, delta, weight, value, log_scale, modes, ahead)
        factor = 0.0
        if base > -math.inf and log_scale[q] > -math.inf:
            factor = math.exp(base - log_scale[q])
        r = reference_of[q]
        expect_row(r * states, indptr, indices, data, mix[r], ahead, row)
        for s in range(states):
            norm[q, s] = row[s] * factor


@njit(cache=True)
def push(mass, q, free, chain, slot, rows, flux):
    """Move the mass ``[S]`` of automaton state q one tick on, adding it to ``rows[slot[q']]``; ``flux[l]`` counts it.

    The kernel is ``P(s'|s) factor[q, l'] value[q', s'] / norm[q, s]``, factor = w exp(log_scale[q'] - log_scale[q]). A free q (absorbing), and any state from which nothing
    of weight lies ahead, follows the reference process, renormalised where it would be killed.
    Mass whose automaton state has no slot (< 0) is counted in the flux only.
    """
    modes = chain.mix.shape[1]
    states = mass.shape[0]
    r = chain.reference_of[q]
    mix = chain.mix[r]
    factor = chain.factor[q]
    tilted = np.empty(modes)
    plain = np.empty(modes)
    tilted_drawn = np.empty(modes)
    plain_drawn = np.empty(modes)
    for first in range(0, states, modes):
        any_tilted, any_plain = False, False
        for m in range(modes):
            tilted[m] = 0.0
            plain[m] = 0.0
            here = mass[first + m]
            if here <= 0.0:
                continue
            norm = 0.0
            if not free:
                norm = chain.norm[q, first + m]
            if norm > 0.0:
                tilted[m] = here / norm
                any_tilted = True
            else:
                survives = chain.row_sum[r * states + first + m]
                if survives > 0.0:
                    plain[m] = here / survives
                    any_plain = True
                else:
                    symbol = chain.labels[first // modes]
                    flux[symbol] += here
                    if slot[chain.delta[q, symbol]] >= 0:
                        rows[slot[chain.delta[q, symbol]], first + m] += here
        if not (any_tilted or any_plain):
            continue
        tilted_drawn[:] = 0.0
        plain_drawn[:] = 0.0
        for m in range(modes):
            if tilted[m] > 0.0:
                for after in range(modes):
                    tilted_drawn[after] += tilted[m] * mix[m, after]
            if plain[m] > 0.0:
                for after in range(modes):
                    plain_drawn[after] += plain[m] * mix[m, after]
        for after in range(modes):
            bridge, reference = tilted_drawn[after], plain_drawn[after]
            if bridge == 0.0 and reference == 0.0:
                continue
            start = r * states + first + after
            for k in range(chain.indptr[start], chain.indptr[start + 1]):
                target = chain.indices[k]
                symbol = chain.labels[target // modes]
                following = chain.delta[q, symbol]
                amount = reference
                if bridge > 0.0 and factor[symbol] > 0.0:
                    amount += bridge * factor[symbol] * chain.value[following, target]
                amount *= chain.data[k]
                if amount > 0.0:
                    flux[symbol] += amount
                    if slot[following] >= 0:
                        rows[slot[following], target] += amount


@njit(cache=True)
def push_all(active, masses, floor, chain, slot, rows):
    """One tick of a belief: `push` for each automaton state in `active`; entries at or below `floor` are dropped."""
    flux = np.zeros(chain.delta.shape[1])
    for i in range(active.shape[0]):
        mass = masses[i]
        if floor > 0.0:
            for s in range(mass.shape[0]):
                if mass[s] <= floor:
                    mass[s] = 0.0
        q = active[i]
        push(mass, q, q == chain.accepting or q == chain.rejecting, chain, slot, rows, flux)


@njit(cache=True)
def forward(order, chain, slot, mass, flux):
    """Push the start mass ``[Q, S]`` through all automaton states in `order` (rising rank).

    On return ``mass[q, s]`` is the probability of ever visiting (q, s), ``flux[q, l]`` of ever taking that transition.
    """
    for q in order:
        push(mass[q], q, False, chain, slot, mass, flux[q])


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
def sample_step(chain, q, s, uniform):
    """The next base state from (q, s), by inverting the kernel of `push` at `uniform` in [0, 1)."""
    modes = chain.mix.shape[1]
    states = chain.value.shape[1]
    r = chain.reference_of[q]
    mode = s % modes
    first = s - mode
    norm = 0.0
    if q != chain.accepting and q != chain.rejecting:
        norm = chain.norm[q, s]
    bridge = norm > 0.0
    target = uniform * (norm if bridge else chain.row_sum[r * states + s])
    reached = 0.0
    found = s
    for j in range(modes):
        after = chain.mix_order[r, mode, j]
        share = chain.mix[r, mode, after]
        if share <= 0.0:
            break
        start = r * states + first + after
        for k in range(chain.indptr[start], chain.indptr[start + 1]):
            following = chain.indices[k]
            amount = share * chain.data[k]
            if bridge:
                symbol = chain.labels[following // modes]
                amount *= chain.factor[q, symbol] * chain.value[chain.delta[q, symbol], following]
            if amount > 0.0:
                found = following
                reached += amount
                if reached > target:
                    return found
    return found


@njit(cache=True)
def sample_paths(chain, uniforms, automaton_states, base_states, completed_tick):
    """Fill ``[K, ticks + 1]`` automaton and base states from column 0 on; ``completed_tick[K]``, -1 if never."""
    modes = chain.mix.shape[1]
    count, ticks = uniforms.shape
    for i in range(count):
        q = automaton_states[i, 0]
        s = base_states[i, 0]
        completed_tick[i] = 0 if q == chain.accepting else -1
        for t in range(ticks):
            s = sample_step(chain, q, s, uniforms[i, t])
            q = chain.delta[q, chain.labels[s // modes]]
            automaton_states[i, t + 1] = q
            base_states[i, t + 1] = s
            if q == chain.accepting and completed_tick[i] < 0:
                completed_tick[i] = t + 1


@njit(cache=True)
def cell_marginal(masses, modes, out):
    """Add ``masses[n, S]`` up into cells ``out[C]``."""
    for i in range(masses.shape[0]):
        for cell in range(out.shape[0]):
            total = 0.0
            for s in range(cell * modes, (cell + 1) * modes):
                total += masses[i, s]
            out[cell] += total


@njit(cache=True)
def reweight(masses, cell_weight, mode_weight):
    """Multiply ``masses[n, S]`` by ``cell_weight[C] * mode_weight[M]`` in place; return each row's new total."""
    modes = mode_weight.shape[0]
    totals = np.zeros(masses.shape[0])
    for i in range(masses.shape[0]):
        total = 0.0
        for cell in range(cell_weight.shape[0]):
            w = cell_weight[cell]
            first = cell * modes
            if w == 0.0:
                for m in range(modes):
                    masses[i, first + m] = 0.0
            else:
                for m in range(modes):
                    changed = masses[i, first + m] * w * mode_weight[m]
                    masses[i, first + m] = changed
                    total += changed
        totals[i] = total
    return totals
