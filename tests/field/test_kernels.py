"""Every kernel against a slow twin on dense matrices."""

from __future__ import annotations

import numpy as np
import pytest

from tab_marl.field import from_matrices, kernels, product_chain, sampling_kernels
from tab_marl.field.belief import ProductBelief
from tab_marl.field.messages import backward_kernels
from tab_marl.field.messages.stencil import no_stencil


class Small:
    """Three transient states in a row, symbol 1 goes on, symbol 2 accepts from the last and fails elsewhere."""

    delta = np.array([[0, 1, 4], [1, 2, 4], [2, 2, 3], [3, 3, 3], [4, 4, 4]], dtype=np.int32)
    initial, accepting, rejecting = 0, 3, 4


def random_chain(rng, modes=3, cells=6, references=2, width=4, harmonic=False):
    states = cells * modes
    matrices = []
    for _ in range(references):
        dense = rng.random((states, states)) * (rng.random((states, states)).argsort(axis=1) < width)
        matrices.append(dense / dense.sum(axis=1, keepdims=True) * rng.uniform(0.6, 1.0, (states, 1)))
    mix = rng.random((references, modes, modes)) + np.eye(modes)
    mix /= mix.sum(axis=2, keepdims=True)
    motion = from_matrices(matrices, mix)
    value = rng.random((5, states)) * (rng.random((5, states)) < 0.8)
    chain = product_chain(
        motion, rng.integers(0, 3, cells), Small(), np.full(cells, 1 / cells), value,
        reference_of=[0, 1, 0, 1, 0][:5] if references == 2 else None, weight=rng.uniform(0.5, 2, (5, 3)),
        log_scale=rng.uniform(-3, 3, 5),
    )  # fmt: skip
    return motion, chain


def dense_kernel(motion, chain, q):
    """[S, S] transition law from automaton state q, and the rows' normalisers."""
    labels = np.repeat(chain.labels, chain.modes)
    plain = motion.matrix(int(chain.reference_of[q])).toarray()
    plain_law = plain / plain.sum(axis=1, keepdims=True)
    if q in (chain.accepting, chain.rejecting):
        return plain_law, plain.sum(axis=1)
    following = chain.delta[q, labels]
    ahead = chain.factor[q, labels] * chain.value[following, np.arange(chain.states)]
    norm = plain @ ahead
    return np.where(norm[:, None] > 0, plain * ahead / np.where(norm > 0, norm, 1)[:, None], plain_law), norm


@pytest.mark.parametrize(("modes", "width"), [(1, 4), (1, 6), (3, 4), (3, 7), (9, 3)])
def test_normalisers_push_and_steps(modes, width):
    rng = np.random.default_rng(modes * 10 + width)
    motion, chain = random_chain(rng, modes=modes, width=width)
    labels = np.repeat(chain.labels, modes)
    for q in range(5):
        law, norm = dense_kernel(motion, chain, q)
        if q < 3:
            np.testing.assert_allclose(chain.norm[q], norm, rtol=1e-12, atol=1e-15)
        mass = rng.random(chain.states) * (rng.random(chain.states) < 0.7)
        rows, flux = np.zeros((5, chain.states)), np.zeros(3)
        kernels.push(mass.copy(), q, q >= 3, chain, np.arange(5), rows, flux)
        moved = mass @ law
        expected = np.zeros((5, chain.states))
        expected[chain.delta[q, labels], np.arange(chain.states)] = moved
        np.testing.assert_allclose(rows, expected, rtol=1e-11, atol=1e-14)
        np.testing.assert_allclose(flux, np.bincount(labels, moved, minlength=3), rtol=1e-11)
        if q < 3:
            draws = 4000
            for s in rng.choice(np.flatnonzero(norm > 0), 3):
                found = np.array([sampling_kernels.bridge_step(chain, q, s, (i + 0.5) / draws) for i in range(draws)])
                share = np.bincount(found, minlength=chain.states) / draws
                np.testing.assert_allclose(share, law[s], atol=1.01 / draws * modes * width)


def test_push_without_a_slot_only_counts():
    rng = np.random.default_rng(5)
    _, chain = random_chain(rng)
    mass = rng.random(chain.states)
    slot = np.full(5, -1)
    slot[1] = 0
    rows, flux = np.zeros((1, chain.states)), np.zeros(3)
    kernels.push(mass, 0, False, chain, slot, rows, flux)
    assert flux.sum() == pytest.approx(mass.sum())
    assert rows.sum() == pytest.approx(flux[1])


def test_backward_is_the_dense_recursion():
    rng = np.random.default_rng(3)
    motion, chain = random_chain(rng, cells=9)
    assert set(chain.labels) == {0, 1, 2}
    weight = rng.uniform(0.5, 2, (5, 3))
    for peak, dtype in ((1.0, np.float64), (1e30, np.float32)):
        value = np.zeros((5, chain.states), dtype=dtype)
        value[3] = 1.0
        log_scale = np.zeros(5)
        # Acyclic here: state 0 waits for nothing (its stay on symbol 0 leads to rejection instead).
        delta = np.array([[4, 1, 4], [4, 2, 3], [4, 4, 3], [3, 3, 3], [4, 4, 4]], dtype=np.int32)
        low, high = np.zeros((2, 9), dtype=np.int32), np.full((2, 9), 8, dtype=np.int32)
        everywhere = np.ones((5, 9), dtype=np.uint8)
        backward_kernels.backward(
            np.array([2, 1, 0], dtype=np.int32), motion.motion, no_stencil(), chain.reference_of, chain.labels, delta,
            weight, peak, everywhere, low, high, value, log_scale,
        )  # fmt: skip
        labels = np.repeat(chain.labels, chain.modes)
        h = np.zeros((5, chain.states))
        h[3] = 1.0
        for q in (2, 1, 0):
            h[q] = motion.matrix(int(chain.reference_of[q])) @ (
                weight[q, labels] * h[delta[q, labels], np.arange(len(labels))]
            )
        np.testing.assert_allclose(value * np.exp(log_scale)[:, None], h, rtol=1e-6 if peak > 1 else 1e-12)
        assert value[2].max() == pytest.approx(peak)


def test_plain_steps_follow_the_renormalised_reference():
    rng = np.random.default_rng(8)
    motion, chain = random_chain(rng)
    law, _ = dense_kernel(motion, chain, chain.accepting)
    streams = np.array([12345], dtype=np.uint64)
    draws = 20_000
    found = [sampling_kernels.reference_step(motion.motion, 1, chain.states, 4, streams, 0) for _ in range(draws)]
    np.testing.assert_allclose(
        np.bincount(found, minlength=chain.states) / draws, law[4], atol=5 * np.sqrt(0.25 / draws)
    )


def test_uniform_stream_is_splitmix64():
    """First outputs for seed 0 as published with the generator."""
    streams = np.zeros(1, dtype=np.uint64)
    known = [0xE220A8397B1DCDAF, 0x6E789E6AA1B965F4, 0x06C45D188009454F]
    for word in known:
        assert sampling_kernels.next_uniform(streams, 0) == (word >> 11) / 2**53


def test_draw_states_takes_evenly_spaced_points_of_the_mass():
    rng = np.random.default_rng(4)
    masses = rng.random((3, 7)) * (rng.random((3, 7)) < 0.5)
    slots, states = np.empty(100, dtype=np.int64), np.empty(100, dtype=np.int64)
    sampling_kernels.draw_states(masses, masses.sum(), 100, 0.3, slots, states)
    points = (np.arange(100) + 0.3) / 100 * masses.sum()
    flat = np.searchsorted(np.cumsum(masses), points, side="right")
    np.testing.assert_array_equal(slots * 7 + states, flat)


def test_reweigh_and_marginal():
    rng = np.random.default_rng(6)
    masses = rng.random((2, 12))
    cell_weight, mode_weight = np.array([0.0, 1.0, 0.5, 2.0]), np.array([1.0, 0.0, 3.0])
    expected = masses * np.outer(cell_weight, mode_weight).ravel()
    marginal = np.zeros(4)
    totals = kernels.reweight(masses, cell_weight, mode_weight)
    kernels.cell_marginal(masses, 3, marginal)
    np.testing.assert_allclose(masses, expected)
    np.testing.assert_allclose(totals, expected.sum(axis=1))
    np.testing.assert_allclose(marginal, expected.reshape(2, 4, 3).sum(axis=(0, 2)))


def test_a_table_that_is_not_harmonic_is_renormalised():
    """h = 1{feasible}: the chain stays where h is 1 and its rows sum to 1."""
    line = np.diag(np.full(4, 0.5), 1) + np.diag(np.full(4, 0.5), -1)
    value = np.ones((3, 5))
    value[:, 4] = 0.0

    class Endless:
        delta = np.array([[0], [1], [2]], dtype=np.int32)
        initial, accepting, rejecting = 0, 1, 2

    chain = product_chain(line, np.zeros(5, int), Endless(), [0, 0, 0, 1, 0], value)
    belief = ProductBelief(chain)
    belief.predict()
    np.testing.assert_allclose(belief.cell_marginal(), [0, 0, 1, 0, 0])
    belief.predict()
    np.testing.assert_allclose(belief.cell_marginal(), [0, 0.5, 0, 0.5, 0])
