"""POMDPs given as tables, dense or sparse, as compiled generative models."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
import scipy.sparse
from numpy.typing import ArrayLike, NDArray

from tab_marl.planning import table_kernels
from tab_marl.planning.model import CompiledModel, StateRange


class TableData(NamedTuple):
    """Tables as the kernel reads them; rows are ``action * S + state``."""

    transition: NDArray[np.float64]
    """``[A*S, S]`` cumulative."""
    observation: NDArray[np.float64]
    """``[A*S, O]`` cumulative, by the state reached."""
    reward: NDArray[np.float64]
    """``[A*S, S]`` by state left and state reached."""
    terminal: NDArray[np.bool_]
    """``[S]``."""
    best: NDArray[np.float64]
    """``[S]`` best return if the state were always known; empty where no discount was given."""


class SparseRows(NamedTuple):
    """Distributions in rows ``action * S + state``; row r has entries first[r] .. first[r + 1] - 1."""

    first: NDArray[np.int64]
    number: NDArray[np.int64]
    cumulative: NDArray[np.float64]


class SparseData(NamedTuple):
    """Sparse tables as the kernel reads them: memory goes with the entries that are not zero."""

    transition: SparseRows
    observation: SparseRows
    reward: NDArray[np.float64]
    """By entry of `transition`."""
    terminal: NDArray[np.bool_]
    best: NDArray[np.float64]


def table_model(
    transition: Any,
    observation: Any,
    reward: Any,
    terminal: ArrayLike | None = None,
    action_names: tuple[str, ...] = (),
    discount: float | None = None,
) -> CompiledModel:
    """A POMDP with S states, A actions and O observations as a compiled model whose state is ``[state number]``.

    `transition` ``[A, S, S]``: T(s' | s, a). `observation` ``[A, S, O]``: O(o | a, s'), s' the state reached. `reward`
    ``[A, S]`` or ``[A, S, S]``: R(s, a) or R(s, a, s'). `terminal` ``[S]``: states that end the process when reached.
    Sparse: `transition` and `observation` are each a sequence of A scipy.sparse matrices (then so may `reward` be, for
    R(s, a, s'), of which entries that no transition reaches are not read). `discount` gives the model an upper bound for
    DESPOT: the best return if the state were always known, by value iteration.
    Raises ValueError when shapes disagree or a row is not a distribution.
    """
    sparse = [_is_sparse(transition), _is_sparse(observation)]
    if any(sparse) and not all(sparse):
        raise ValueError(
            "transition and observation must be both sparse (sequences of A scipy.sparse matrices) or neither"
        )
    if _is_sparse(reward) and not all(sparse):
        raise ValueError("reward is sparse: then transition and observation must be sparse too")
    if discount is not None and not 0 < discount < 1:
        raise ValueError(f"discount is {discount}, must be in (0, 1)")
    make = _sparse_model if all(sparse) else _dense_model
    model = make(transition, observation, reward, terminal, action_names, discount)
    return replace(model, states=StateRange([0], [len(model.data.terminal) - 1]))


def _is_sparse(tables: Any) -> bool:
    return isinstance(tables, Sequence) and len(tables) > 0 and all(scipy.sparse.issparse(t) for t in tables)


def _dense_model(
    transition: ArrayLike,
    observation: ArrayLike,
    reward: ArrayLike,
    terminal: ArrayLike | None,
    action_names: tuple[str, ...],
    discount: float | None,
) -> CompiledModel:
    t = _distributions("transition", transition, "T(. | state, action)")
    actions, states = t.shape[:2]
    if t.shape[2] != states:
        raise ValueError(f"transition has shape {t.shape}, must be [A, S, S]")
    o = _distributions("observation", observation, "O(. | action, state reached)")
    if o.shape[:2] != (actions, states):
        raise ValueError(f"observation has shape {o.shape}, must be [{actions}, {states}, O] to go with transition")
    r = _rewards(reward, actions, states)
    ends = _terminal(terminal, states)
    mean = (t * (r if r.ndim == 3 else r[:, :, None])).sum(axis=2)
    if r.ndim == 2:
        r = np.repeat(r[:, :, None], states, axis=2)
    data = TableData(
        _cumulative(t).reshape(actions * states, states),
        _cumulative(o).reshape(actions * states, o.shape[2]),
        np.ascontiguousarray(r).reshape(actions * states, states),
        ends,
        _known_state_values(list(t), mean, ends, discount),
    )
    return _bounded(CompiledModel(table_kernels.step, actions, 1, data, action_names=action_names), discount)


def _bounded(model: CompiledModel, discount: float | None) -> CompiledModel:
    return model if discount is None else replace(model, upper=table_kernels.known_state_bound)


def _rewards(reward: ArrayLike, actions: int, states: int) -> NDArray[np.float64]:
    r = np.asarray(reward, dtype=np.float64)
    if r.shape not in ((actions, states), (actions, states, states)):
        raise ValueError(
            f"reward has shape {r.shape}, must be [{actions}, {states}] or [{actions}, {states}, {states}]"
        )
    if not np.isfinite(r).all():
        raise ValueError("reward has entries that are not finite")
    return r


def _terminal(terminal: ArrayLike | None, states: int) -> NDArray[np.bool_]:
    ends = np.zeros(states, dtype=np.bool_) if terminal is None else np.array(terminal, dtype=np.bool_)
    if ends.shape != (states,):
        raise ValueError(f"terminal has shape {ends.shape}, must be [{states}]")
    return ends


def _known_state_values(
    transition: list[Any], mean_reward: NDArray[np.float64], ends: NDArray[np.bool_], discount: float | None
) -> NDArray[np.float64]:
    """``[S]`` best returns with the state known: value iteration to 1e-9 from above, which leaves an upper bound."""
    if discount is None:
        return np.empty(0)
    values = np.full(len(ends), max(0.0, float(mean_reward.max())) / (1 - discount))
    for _ in range(100_000):
        going = np.where(ends, 0.0, values)
        before, values = (
            values,
            np.max([mean_reward[a] + discount * (t @ going) for a, t in enumerate(transition)], axis=0),
        )
        if np.abs(before - values).max() < 1e-9:
            break
    return values


def _sparse_model(
    transition: Sequence[Any],
    observation: Sequence[Any],
    reward: Any,
    terminal: ArrayLike | None,
    action_names: tuple[str, ...],
    discount: float | None,
) -> CompiledModel:
    actions, states = len(transition), transition[0].shape[0]
    t = [scipy.sparse.csr_array(m, dtype=np.float64) for m in transition]
    o = [scipy.sparse.csr_array(m, dtype=np.float64) for m in observation]
    if any(m.shape != (states, states) for m in t):
        raise ValueError(f"transition has shapes {[m.shape for m in t]}, must be A times [{states}, {states}]")
    if len(o) != actions or any(m.shape != (states, o[0].shape[1]) for m in o):
        raise ValueError(f"observation has shapes {[m.shape for m in o]}, must be {actions} times [{states}, O]")
    rows = _sparse_rows("transition", t, "T(. | state, action)")
    seen = _sparse_rows("observation", o, "O(. | action, state reached)")
    before = np.repeat(np.arange(actions * states), np.diff(rows.first))
    if _is_sparse(reward):
        if len(reward) != actions or any(m.shape != (states, states) for m in reward):
            raise ValueError(f"reward must be {actions} sparse matrices of shape ({states}, {states})")
        stacked = scipy.sparse.csr_array(scipy.sparse.vstack([scipy.sparse.csr_array(m) for m in reward]))
        entries = np.asarray(stacked[before, rows.number], dtype=np.float64).ravel()
        if not np.isfinite(entries).all():
            raise ValueError("reward has entries that are not finite")
    else:
        r = _rewards(reward, actions, states)
        flat = r.reshape(actions * states, -1)
        entries = flat[before, 0] if r.ndim == 2 else flat[before, rows.number]
    ends = _terminal(terminal, states)
    probabilities = scipy.sparse.csr_array(scipy.sparse.vstack(t))
    totals = np.bincount(before, probabilities.data * entries, minlength=actions * states).astype(np.float64)
    mean = totals.reshape(actions, states)
    data = SparseData(rows, seen, np.ascontiguousarray(entries), ends, _known_state_values(t, mean, ends, discount))
    return _bounded(CompiledModel(table_kernels.sparse_step, actions, 1, data, action_names=action_names), discount)


def _sparse_rows(name: str, matrices: list[Any], meaning: str) -> SparseRows:
    for matrix in matrices:
        matrix.sum_duplicates()
        matrix.eliminate_zeros()
    rows = scipy.sparse.csr_array(scipy.sparse.vstack(matrices))
    states = matrices[0].shape[0]
    first = rows.indptr.astype(np.int64)
    sums = np.asarray(rows.sum(axis=1)).ravel()
    negative = np.zeros(len(sums), dtype=np.bool_)
    negative[np.repeat(np.arange(len(sums)), np.diff(first))[rows.data < 0]] = True
    bad = negative | ~np.isclose(sums, 1.0, rtol=0.0, atol=1e-9)
    if bad.any():
        action, state = divmod(int(np.argmax(bad)), states)
        raise ValueError(
            f"{name}[{action}][{state}] = {meaning} is not a distribution: sum {sums[np.argmax(bad)]:g}"
            f"{', with a negative entry' if negative[np.argmax(bad)] else ''}, must be >= 0 and sum to 1"
        )
    total = np.cumsum(rows.data)
    cumulative = total - np.repeat(np.concatenate([[0.0], total])[first[:-1]], np.diff(first))
    cumulative[first[1:] - 1] = 1.0
    return SparseRows(first, rows.indices.astype(np.int64), np.minimum(cumulative, 1.0))


def _distributions(name: str, table: ArrayLike, meaning: str) -> NDArray[np.float64]:
    rows = np.asarray(table, dtype=np.float64)
    if rows.ndim != 3:
        raise ValueError(f"{name} has {rows.ndim} dimensions, must have 3")
    bad = (rows < 0).any(axis=2) | ~np.isclose(rows.sum(axis=2), 1.0, rtol=0.0, atol=1e-9)
    if bad.any():
        action, state = (int(i) for i in np.argwhere(bad)[0])
        raise ValueError(
            f"{name}[{action}, {state}] = {meaning} is not a distribution: "
            f"least entry {rows[action, state].min():g}, sum {rows[action, state].sum():g}, must be >= 0 and sum to 1"
        )
    return rows


def _cumulative(rows: NDArray[np.float64]) -> NDArray[np.float64]:
    """Cumulative sums whose last *possible* entry is exactly 1, so that no draw can land on an impossible one."""
    total = np.cumsum(rows, axis=2)
    total[total >= total[:, :, -1:]] = 1.0
    return np.ascontiguousarray(total)
