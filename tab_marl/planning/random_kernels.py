"""Random numbers for compiled models: one 64-bit word of state in an array, so that a search is a function of its seed.

SplitMix64 (Steele, Lea and Flood, OOPSLA 2014). A model draws with `uniform` and `below`; a rollout that draws millions of
numbers keeps the word in a local variable: ``word += GOLDEN; bits = mixed(word)`` and stores it back at the end.
"""

# mypy: allow-untyped-defs, allow-untyped-calls, allow-untyped-decorators, no-check-untyped-defs

from __future__ import annotations

import numpy as np
from numba import njit

GOLDEN = np.uint64(0x9E3779B97F4A7C15)
_FIRST = np.uint64(0xBF58476D1CE4E5B9)
_SECOND = np.uint64(0x94D049BB133111EB)
_SHIFT_30 = np.uint64(30)
_SHIFT_27 = np.uint64(27)
_SHIFT_31 = np.uint64(31)
_SHIFT_32 = np.uint64(32)
_SHIFT_11 = np.uint64(11)


@njit(cache=True)
def mixed(word):
    """64 random bits of a word: the output function of SplitMix64."""
    word = (word ^ (word >> _SHIFT_30)) * _FIRST
    word = (word ^ (word >> _SHIFT_27)) * _SECOND
    return word ^ (word >> _SHIFT_31)


@njit(cache=True)
def bits(rng):
    """64 random bits; `rng` is uint64[1] and is advanced."""
    rng[0] = rng[0] + GOLDEN
    return mixed(rng[0])


@njit(cache=True)
def to_uniform(random_bits):
    """A float64 in [0, 1) from 64 random bits."""
    return np.float64(random_bits >> _SHIFT_11) * (1.0 / 9007199254740992.0)


@njit(cache=True)
def to_below(random_bits, count):
    """An int64 in [0, count), count < 2**31, from 64 random bits (a bias below count / 2**32)."""
    return np.int64(((random_bits >> _SHIFT_32) * np.uint64(count)) >> _SHIFT_32)


@njit(cache=True)
def uniform(rng):
    """A float64 in [0, 1)."""
    return to_uniform(bits(rng))


@njit(cache=True)
def below(rng, count):
    """An int64 in [0, count), count < 2**31."""
    return to_below(bits(rng), count)


@njit(cache=True)
def normal(rng):
    """A standard normal number (Box and Muller 1958; two words a call)."""
    radius = np.sqrt(-2.0 * np.log(1.0 - uniform(rng)))
    return radius * np.cos(2.0 * np.pi * uniform(rng))
