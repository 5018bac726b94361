# mypy: ignore-errors
"""Compiled backward pass over the part of the product that matters.

Letters as in `kernels`. ``possible[Q, C]`` says which cells belong to an automaton state (`support`); everything else is
left alone. Arrays and scalars only; nothing here validates or raises. Slow twins: ``tests/field/test_support.py``.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from tab_marl.field.kernels import expect_cells, look_ahead_scale


@njit(cache=True)
def window(needed, low, high):
    """The first and one past the last cell within a tick of the `needed` cells; (0, 0) if there are none."""
    first, last = needed.shape[0], 0
    for cell in range(needed.shape[0]):
        if needed[cell]:
            first = min(first, low[cell])
            last = max(last, high[cell] + 1)
    if last <= first:
        return 0, 0
    return first, last


@njit(cache=True)
def shifted_sum(source, shift, share, first, last, out):
    """``out[x] = sum_k share[k] source[x + shift[k]]`` for first <= x < last."""
    target = out[first:last]
    width = shift.shape[0]
    if width == 4:
        a, b, c, d = share[0], share[1], share[2], share[3]
        at_a = source[first + shift[0] : last + shift[0]]
        at_b = source[first + shift[1] : last + shift[1]]
        at_c = source[first + shift[2] : last + shift[2]]
        at_d = source[first + shift[3] : last + shift[3]]
        for x in range(last - first):
            target[x] = a * at_a[x] + b * at_b[x] + c * at_c[x] + d * at_d[x]
        return
    target[:] = 0.0
    for k in range(width):
        a = share[k]
        if a > 0.0:
            at_a = source[first + shift[k] : last + shift[k]]
            for x in range(last - first):
                target[x] += a * at_a[x]


@njit(cache=True)
def look_ahead_planes(q, first, last, stencil, labels, delta, factor, possible, value, modes, planes):
    """Fill ``planes[m, x] = factor[l'] value[q', s']`` for the cells of a window; blocked points stay 0."""
    for cell in range(first, last):
        symbol = labels[cell]
        following = delta[q, symbol]
        w = factor[symbol]
        x = stencil.position[cell]
        if w > 0.0 and possible[following, cell]:
            at = cell * modes
            for m in range(modes):
                planes[m, x] = w * value[following, at + m]
        else:
            for m in range(modes):
                planes[m, x] = 0.0


@njit(cache=True)
def mixed_planes(motion, r, inside, first, last, moved, redrawn, planes):
    """The redrawing of the mode, times `inside`; returns the largest result.

    ``planes[m, x] = inside[x] sum_m' mix[r, m, m'] moved[m', x]`` for first <= x < last.
    """
    modes = planes.shape[0]
    near = motion.near_share.shape[2]
    length = last - first
    total = redrawn[first:last]
    total[:] = 0.0
    for m in range(modes):
        share = motion.redraw[r, m]
        part = moved[m, first:last]
        for x in range(length):
            total[x] += share * part[x]
    here = inside[first:last]
    largest = 0.0
    for m in range(modes):
        jump = motion.jump[r, m]
        target = planes[m, first:last]
        if near == 3:
            a, b, c = motion.near_share[r, m, 0], motion.near_share[r, m, 1], motion.near_share[r, m, 2]
            at_a = moved[motion.near_mode[r, m, 0], first:last]
            at_b = moved[motion.near_mode[r, m, 1], first:last]
            at_c = moved[motion.near_mode[r, m, 2], first:last]
            for x in range(length):
                target[x] = here[x] * (jump * total[x] + a * at_a[x] + b * at_b[x] + c * at_c[x])
        else:
            for x in range(length):
                target[x] = here[x] * jump * total[x]
            for j in range(near):
                a = motion.near_share[r, m, j]
                at_a = moved[motion.near_mode[r, m, j], first:last]
                for x in range(length):
                    target[x] += here[x] * a * at_a[x]
        for x in range(length):
            largest = max(largest, target[x])
    return largest


@njit(cache=True)
def expect_planes(motion, stencil, r, needed, planes, inside, moved, redrawn):
    """``planes[m, x]`` becomes its own expectation at the needed cells (0 elsewhere between them); returns the largest."""
    begin, end = needed.shape[0], 0
    for cell in range(needed.shape[0]):
        if needed[cell]:
            begin = min(begin, cell)
            end = cell + 1
    first, last = stencil.position[begin], stencil.position[end - 1] + 1
    inside[first:last] = 0.0
    for cell in range(begin, end):
        inside[stencil.position[cell]] = needed[cell] * stencil.scale[r, cell]
    for m in range(planes.shape[0]):
        shifted_sum(planes[m], stencil.shift[r, m], stencil.share[r, m], first, last, moved[m])
    return mixed_planes(motion, r, inside, first, last, moved, redrawn, planes)


@njit(cache=True)
def look_ahead_cells(q, first, last, labels, delta, factor, possible, value, modes, ahead):
    """Fill ``ahead[s'] = factor[l'] value[q', s']`` for the cells of a window."""
    for cell in range(first, last):
        symbol = labels[cell]
        following = delta[q, symbol]
        w = factor[symbol]
        at = cell * modes
        if w > 0.0 and possible[following, cell]:
            for s in range(at, at + modes):
                ahead[s] = w * value[following, s]
        else:
            for s in range(at, at + modes):
                ahead[s] = 0.0


@njit(cache=True)
def backward(order, motion, stencil, reference_of, labels, delta, weight, peak, possible, low, high, value, log_scale):
    """Backward messages of the automaton states in `order` (falling rank), each row scaled to a maximum of `peak`.

    Rows of `value` and `log_scale` for absorbing states are inputs, the others outputs (design, section 4). Entries of
    `value` outside `possible` must be 0 and stay so. ``low[R, C], high[R, C]``: the first and last cell within one tick.
    """
    cells, symbols = labels.shape[0], delta.shape[1]
    modes = motion.mix.shape[1]
    ahead, row = np.zeros(cells * modes), np.empty(cells * modes)
    planes, moved = np.zeros((modes, stencil.size)), np.empty((modes, stencil.size))
    redrawn, inside = np.empty(stencil.size), np.empty(stencil.size)
    factor = np.empty(symbols)
    for q in order:
        r = reference_of[q]
        needed = possible[q]
        first, last = window(needed, low[r], high[r])
        base = look_ahead_scale(q, delta, weight, log_scale)
        log_scale[q] = -math.inf
        if base == -math.inf or first == last:
            continue
        for symbol in range(symbols):
            factor[symbol] = 0.0
            if weight[q, symbol] > 0.0:
                # In one exponent: a large weight times rows near the peak would overflow.
                factor[symbol] = math.exp(log_scale[delta[q, symbol]] + math.log(weight[q, symbol]) - base)
        largest = 0.0
        if stencil.size > 0:
            look_ahead_planes(q, first, last, stencil, labels, delta, factor, possible, value, modes, planes)
            largest = expect_planes(motion, stencil, r, needed, planes, inside, moved, redrawn)
        else:
            look_ahead_cells(q, first, last, labels, delta, factor, possible, value, modes, ahead)
            expect_cells(motion, r, needed, ahead, row)
            for cell in range(cells):
                if needed[cell]:
                    for s in range(cell * modes, (cell + 1) * modes):
                        largest = max(largest, row[s])
        if largest == 0.0:
            continue
        log_scale[q] = base + math.log(largest / peak)
        scale = peak / largest
        for cell in range(cells):
            if not needed[cell]:
                continue
            at = cell * modes
            if stencil.size > 0:
                x = stencil.position[cell]
                for m in range(modes):
                    value[q, at + m] = planes[m, x] * scale
            else:
                for s in range(at, at + modes):
                    value[q, s] = row[s] * scale
