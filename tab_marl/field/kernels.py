# mypy: ignore-errors
"""Compiled loops of the field: expectations one tick ahead, pushing mass forward, reweighing it.

Arrays and scalars only; nothing here validates or raises. Each has a slow twin in ``tests/field/test_kernels.py``.

Letters: C cells, M modes (headings and rest), S = C * M base states, cell-major (``s = cell * M + mode``), Q automaton
states, L label symbols, R references. One tick of reference r: the mode is redrawn by ``mix[r, m, m']``, then the state
moves by CSR row ``r * S + cell * M + m'``; rows may sum to less than 1 (the rest of the mass is killed).
`motion` is a `reference.Motion`: the moves, and `mix` once more as what lies near a mode plus a jump to any mode,
``mix[r, m] = near(m) + jump[r, m] * redraw[r]``; rows of constant `width` 4 take an unrolled path.
A table ``value[q, s]`` holds h / exp(log_scale[q]), up to one factor common to all rows (their peak).
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit


@njit(cache=True)
def expect_cells(motion, r, needed, ahead, out):
    """``out[s] = sum_s' P(s'|s) ahead[s']`` under reference r, for the states of the ``needed[C]`` cells."""
    modes = motion.mix.shape[1]
    states = out.shape[0]
    indices, data, width = motion.indices, motion.data, motion.width
    near = motion.near_share.shape[2]
    moved = np.empty(modes)
    for first in range(0, states, modes):
        if not needed[first // modes]:
            continue
        redrawn = 0.0
        row = r * states + first
        for m in range(modes):
            total = 0.0
            if width == 4:
                k = 4 * (row + m)
                total = (
                    data[k] * ahead[indices[k]]
                    + data[k + 1] * ahead[indices[k + 1]]
                    + data[k + 2] * ahead[indices[k + 2]]
                    + data[k + 3] * ahead[indices[k + 3]]
                )
            else:
                for k in range(motion.indptr[row + m], motion.indptr[row + m + 1]):
                    total += data[k] * ahead[indices[k]]
            moved[m] = total
            redrawn += motion.redraw[r, m] * total
        if modes == 1:
            out[first] = moved[0]
        elif near == 3:
            for m in range(modes):
                out[first + m] = (
                    motion.jump[r, m] * redrawn
                    + motion.near_share[r, m, 0] * moved[motion.near_mode[r, m, 0]]
                    + motion.near_share[r, m, 1] * moved[motion.near_mode[r, m, 1]]
                    + motion.near_share[r, m, 2] * moved[motion.near_mode[r, m, 2]]
                )
        else:
            for m in range(modes):
                total = motion.jump[r, m] * redrawn
                for j in range(near):
                    total += motion.near_share[r, m, j] * moved[motion.near_mode[r, m, j]]
                out[first + m] = total


@njit(cache=True)
def expect_row(motion, r, ahead, out):
    """`expect_cells` for all cells."""
    expect_cells(motion, r, np.ones(out.shape[0] // motion.mix.shape[1], dtype=np.uint8), ahead, out)


@njit(cache=True)
def look_ahead_scale(q, delta, weight, log_scale):
    """The largest scale among the states that may follow q; -inf if nothing lies ahead."""
    base = -math.inf
    for symbol in range(delta.shape[1]):
        if weight[q, symbol] > 0.0:
            base = max(base, log_scale[delta[q, symbol]] + math.log(weight[q, symbol]))
    return base


@njit(cache=True)
def look_ahead(q, labels, delta, weight, value, log_scale, modes, ahead):
    """Fill ``ahead[s'] = w(q, l') h[q', s'] / exp(base)``; return base (-inf if nothing lies ahead)."""
    base = look_ahead_scale(q, delta, weight, log_scale)
    if base == -math.inf:
        ahead[:] = 0.0
        return base
    for cell in range(labels.shape[0]):
        symbol = labels[cell]
        following = delta[q, symbol]
        factor = 0.0
        if weight[q, symbol] > 0.0:
            # In one exponent: a large weight times rows near the peak would overflow.
            factor = math.exp(log_scale[following] + math.log(weight[q, symbol]) - base)
        first = cell * modes
        if factor == 0.0:
            for s in range(first, first + modes):
                ahead[s] = 0.0
        else:
            for s in range(first, first + modes):
                ahead[s] = factor * value[following, s]
    return base


@njit(cache=True)
def normalisers(order, motion, reference_of, labels, delta, weight, value, log_scale, norm):
    """``norm[q, s] = sum_s' P(s'|s) w h[q', s'] / exp(log_scale[q])`` for any table, harmonic or not."""
    modes = motion.mix.shape[1]
    states = value.shape[1]
    ahead = np.empty(states)
    row = np.empty(states)
    for q in order:
        base = look_ahead(q, labels, delta, weight, value, log_scale, modes, ahead)
        factor = 0.0
        if base > -math.inf and log_scale[q] > -math.inf:
            factor = math.exp(base - log_scale[q])
        expect_row(motion, reference_of[q], ahead, row)
        for s in range(states):
            norm[q, s] = row[s] * factor


@njit(cache=True)
def scatter_cell(motion, r, states, first, before, drawn, out):
    """Add ``sum_m before[m] P(s'|first + m)`` to ``out[S]``: one cell's masses, redrawn and moved. `drawn`: scratch."""
    modes = before.shape[0]
    if modes == 1:
        drawn[0] = before[0]
    else:
        jumping = 0.0
        for m in range(modes):
            jumping += before[m] * motion.jump[r, m]
        for m in range(modes):
            drawn[m] = jumping * motion.redraw[r, m]
        for m in range(modes):
            amount = before[m]
            if amount > 0.0:
                for j in range(motion.near_share.shape[2]):
                    drawn[motion.near_mode[r, m, j]] += amount * motion.near_share[r, m, j]
    indices, data = motion.indices, motion.data
    for m in range(modes):
        amount = drawn[m]
        if amount > 0.0:
            row = r * states + first + m
            if motion.width == 4:
                k = 4 * row
                out[indices[k]] += amount * data[k]
                out[indices[k + 1]] += amount * data[k + 1]
                out[indices[k + 2]] += amount * data[k + 2]
                out[indices[k + 3]] += amount * data[k + 3]
            else:
                for k in range(motion.indptr[row], motion.indptr[row + 1]):
                    out[indices[k]] += amount * data[k]


@njit(cache=True)
def cells_with_mass(mass, modes):
    """The first and one past the last cell that holds mass; (0, 0) if none does."""
    first, last = 0, mass.shape[0]
    while first < last and mass[first] <= 0.0:
        first += 1
    while last > first and mass[last - 1] <= 0.0:
        last -= 1
    if first == last:
        return 0, 0
    return first // modes, (last - 1) // modes + 1


@njit(cache=True)
def push(mass, q, free, chain, slot, rows, flux):
    """Move the mass ``[S]`` of automaton state q one tick on, adding it to ``rows[slot[q']]``; ``flux[l]`` counts it.

    The kernel is ``P(s'|s) factor[q, l'] value[q', s'] / norm[q, s]``, factor = w exp(log_scale[q'] - log_scale[q]).
    A free q (absorbing), and any state from which nothing of weight lies ahead, follows the reference process, scaled
    to sum to 1 where it would be killed. Mass whose automaton state has no slot (< 0) is counted in the flux only.
    """
    motion = chain.motion
    modes = motion.mix.shape[1]
    states = mass.shape[0]
    r = chain.reference_of[q]
    first_cell, last_cell = cells_with_mass(mass, modes)
    if last_cell == 0:
        return
    # What can be reached in one tick; nothing outside is looked at.
    low, high = max(0, first_cell - chain.span), min(states // modes, last_cell + chain.span)
    # Sums of mass * P(s'|s), to be weighed by what lies ahead of s' (tilted) or not (plain).
    tilted, plain = np.empty(states), np.empty(states)
    tilted[low * modes : high * modes] = 0.0
    plain[low * modes : high * modes] = 0.0
    any_tilted, any_plain = False, False
    bridging = np.empty(modes)
    drifting = np.empty(modes)
    drawn = np.empty(modes)
    for first in range(first_cell * modes, last_cell * modes, modes):
        some_bridging, some_drifting = False, False
        for m in range(modes):
            bridging[m] = 0.0
            drifting[m] = 0.0
            here = mass[first + m]
            if here > 0.0:
                norm = 0.0
                if not free:
                    norm = chain.norm[q, first + m]
                if norm > 0.0:
                    bridging[m] = here / norm
                    some_bridging = True
                else:
                    survives = motion.row_sum[r * states + first + m]
                    if survives > 0.0:
                        drifting[m] = here / survives
                        some_drifting = True
                    else:
                        plain[first + m] += here
                        any_plain = True
        if some_bridging:
            any_tilted = True
            scatter_cell(motion, r, states, first, bridging, drawn, tilted)
        if some_drifting:
            any_plain = True
            scatter_cell(motion, r, states, first, drifting, drawn, plain)
    for cell in range(low, high):
        symbol = chain.labels[cell]
        following = chain.delta[q, symbol]
        row = slot[following]
        factor = chain.factor[q, symbol]
        first = cell * modes
        total = 0.0
        if any_tilted and factor > 0.0:
            for s in range(first, first + modes):
                if tilted[s] > 0.0:
                    amount = tilted[s] * factor * chain.value[following, s]
                    total += amount
                    if row >= 0:
                        rows[row, s] += amount
        if any_plain:
            for s in range(first, first + modes):
                total += plain[s]
                if row >= 0:
                    rows[row, s] += plain[s]
        flux[symbol] += total


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
def rows_at_once(order, delta, started, transient):
    """How many automaton states are begun and not yet done with, at most, when they are left in `order`."""
    live = started.copy()
    count = int(live.sum())
    most = count
    for q in order:
        if live[q]:
            for symbol in range(delta.shape[1]):
                following = delta[q, symbol]
                if transient[following] and not live[following]:
                    live[following] = True
                    count += 1
            most = max(most, count)
            count -= 1
    return most


@njit(cache=True)
def forward_flux(order, chain, begun, masses, flux):
    """``flux[q, l]``: how often each transition is taken, in expectation, by mass that starts as ``masses[n, S]``.

    `order` is of rising rank and leaves out absorbing states; ``begun[n]`` are the automaton states of the masses. A row
    of mass is kept only from the first visit to its automaton state until it has been left.
    """
    count = chain.delta.shape[0]
    started, transient = np.zeros(count, dtype=np.bool_), np.zeros(count, dtype=np.bool_)
    for q in order:
        transient[q] = True
    for q in begun:
        started[q] = transient[q]
    capacity = rows_at_once(order, chain.delta, started, transient)
    rows = np.zeros((capacity, masses.shape[1]))
    vacant = np.arange(capacity)[::-1].copy()
    vacancies = capacity
    slot = np.full(count, -1)
    for i in range(begun.shape[0]):
        if transient[begun[i]]:
            vacancies -= 1
            slot[begun[i]] = vacant[vacancies]
            rows[slot[begun[i]]] = masses[i]
    for q in order:
        here = slot[q]
        if here < 0:
            continue
        for symbol in range(chain.delta.shape[1]):
            following = chain.delta[q, symbol]
            if transient[following] and slot[following] < 0:
                vacancies -= 1
                slot[following] = vacant[vacancies]
        push(rows[here], q, False, chain, slot, rows, flux[q])
        first, last = cells_with_mass(rows[here], chain.motion.mix.shape[1])
        rows[here, first * chain.motion.mix.shape[1] : last * chain.motion.mix.shape[1]] = 0.0
        slot[q] = -1
        vacant[vacancies] = here
        vacancies += 1


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
