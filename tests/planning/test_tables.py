"""Tables as they are given: rounding, types, shapes, and what is kept of them."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.sparse

from tab_marl.planning.tables import table_model


def model_of(transition, observation=None, sparse=False):
    """A model of these transitions in which nothing is seen and nothing earned, unless said otherwise."""
    transition = np.asarray(transition)
    actions, states = transition.shape[:2]
    if observation is None:
        observation = np.ones((actions, states, 1))
    if sparse:
        transition, observation = ([scipy.sparse.csr_array(m) for m in t] for t in (transition, observation))
    return table_model(transition, observation, np.zeros((actions, states)))


def chances(model):
    """``[A * S, S]``: the transitions that the kernels draw by."""
    rows = model.data.transition
    if isinstance(rows, np.ndarray):
        return np.diff(rows, axis=1, prepend=0.0)
    table = np.zeros((len(rows.first) - 1, rows.columns))
    for row, (start, stop) in enumerate(zip(rows.first[:-1], rows.first[1:], strict=True)):
        table[row, rows.number[start:stop]] = np.diff(rows.cumulative[start:stop], prepend=0.0)
    return table


@pytest.mark.parametrize("sparse", [False, True])
@pytest.mark.parametrize(
    "row",
    [
        [1.0, 1e-10, 1e-10],
        [1e-10, 1.0, 1e-10],
        [1 / 3 + 3e-10, 1 / 3 + 3e-10, 1 / 3 + 3e-10],
        [0.5 - 4e-10, 0.0, 0.5],
        [0.1, 0.9, 0.0],
    ],
)
def test_rows_within_rounding_become_exact_distributions(row, sparse):
    model = model_of([[row] * 3] * 2, sparse=sparse)
    found = chances(model)
    assert (found >= 0).all()
    assert found.sum(axis=1) == pytest.approx(1.0, abs=1e-15)
    assert found == pytest.approx(np.tile(np.array(row) / sum(row), (6, 1)), abs=1e-15)
    assert (found[:, np.array(row) == 0] == 0).all()  # what was impossible stays so
    cumulative = model.data.transition.cumulative if sparse else model.data.transition
    assert cumulative.max() == 1.0


def test_many_sparse_rows_lose_no_digits_to_each_other():
    """Sums over the whole table would leave some 1e-12 of each entry after 20,000 rows."""
    size = 20_000
    small = 1e-13
    stay = scipy.sparse.diags_array([np.full(size, 1 - small), np.full(size - 1, small)], offsets=[0, 1], format="lil")
    stay[size - 1, size - 1] = 1.0
    model = table_model([stay], [scipy.sparse.csr_array(np.ones((size, 1)))], np.zeros((1, size)))
    rows = model.data.transition
    assert 1 - rows.cumulative[rows.first[:-2]] == pytest.approx(small, abs=2e-16)


@pytest.mark.parametrize("sparse", [False, True])
@pytest.mark.parametrize("states", [3, 7, 400])
def test_tables_in_single_precision_are_taken(states, sparse):
    rng = np.random.default_rng(states)
    exact = rng.dirichlet(np.ones(states), size=(2, states))
    seen = rng.dirichlet(np.ones(5), size=(2, states)).astype(np.float32)
    found = chances(model_of(exact.astype(np.float32), seen, sparse))
    assert found.sum(axis=1) == pytest.approx(1.0, abs=1e-14)
    assert found == pytest.approx(exact.reshape(2 * states, states), abs=1e-6)


@pytest.mark.parametrize("sparse", [False, True])
@pytest.mark.parametrize(
    ("change", "words"),
    [
        (np.float64(2e-7), r"least entry 0\.5, sum - 1 = 2e-07; .* within 1e-09: divide the row by its sum"),
        (np.float32(1e-4), r"sum - 1 = 0\.0001; .* within 6\.7e-07"),
        (np.float64(np.nan), "least entry nan, sum - 1 = nan"),
    ],
)
def test_what_is_no_rounding_is_refused_with_its_size(change, words, sparse):
    table = np.array([[[0.5, 0.5], [0.5, 0.5]]] * 2, dtype=change.dtype)
    table[1, 1, 1] += change
    name = r"transition\[1\]\[1\]" if sparse else r"transition\[1, 1\]"
    with pytest.raises(ValueError, match=rf"{name} = T\(\. \| state, action\) is not a distribution: .*{words}"):
        model_of(table, sparse=sparse)


@pytest.mark.parametrize("sparse", [False, True])
def test_a_negative_entry_is_refused(sparse):
    table = np.array([[[1.5, -0.5], [0.0, 1.0]]])
    with pytest.raises(ValueError, match=r"least entry -0\.5, sum - 1 = 0; entries must be >= 0"):
        model_of(table, sparse=sparse)


def test_a_row_without_entries_is_refused():
    with pytest.raises(ValueError, match=r"transition\[0\]\[1\] = .* least entry 0, sum - 1 = -1"):
        model_of([[[1.0, 0.0], [0.0, 0.0]]], sparse=True)


def test_the_number_of_observations_is_the_shapes():
    """That the last observation is never made does not make it unknown."""
    seen = np.array([[[0.5, 0.5, 0.0, 0.0]] * 2])
    dense, sparse = (model_of([np.eye(2)], seen, sparse) for sparse in (False, True))
    assert dense.data.observation.shape[1] == sparse.data.observation.columns == 4
    assert sparse.data.transition.columns == 2


def test_the_callers_matrices_stay_as_they_are():
    given = scipy.sparse.csr_array(
        (np.array([0.5, 0.5 + 1e-10, 0.0, 1.0]), np.array([1, 0, 0, 1]), np.array([0, 3, 4])), shape=(2, 2)
    )
    before = given.copy()
    table_model([given], [scipy.sparse.csr_array(np.ones((2, 1)))], np.zeros((1, 2)))
    for name in ("data", "indices", "indptr"):
        assert np.array_equal(getattr(given, name), getattr(before, name))
