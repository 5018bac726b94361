"""POMDPs given as tables, dense or sparse, as compiled generative models."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
import scipy.sparse
from numpy.typing import ArrayLike, NDArray

from tab_marl.planning import table_kernels
from tab_marl.planning.model import CompiledModel, StateRange

_MOST_VALUES = 2**22
"""Of the known state that a model's upper bound may hold (32 MiB)."""


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
    """``[H, S]`` best return of h + 1 steps if the state were always known, the last row of any more; empty without discount."""


class SparseRows(NamedTuple):
    """Distributions in rows ``action * S + state``; row r has entries first[r] .. first[r + 1] - 1."""

    first: NDArray[np.int64]
    number: NDArray[np.int64]
    cumulative: NDArray[np.float64]
    columns: int
    """Numbers that a row is over (S states, O observations), whether or not any row holds the last of them."""


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
    ``[A, S]`` or ``[A, S, S]``: R(s, a) or R(s, a, s'). `terminal` ``[S]``: states that end the process when reached;
    a belief may hold one, from which every action earns nothing and ends at once, whatever the state's own rows say.
    Sparse: `transition` and `observation` are each a sequence of A scipy.sparse matrices (then so may `reward` be, for
    R(s, a, s'), of which entries that no transition reaches are not read). `discount` gives the model an upper bound for
    DESPOT at that discount: the best return of the steps left if the state were always known, by value iteration.
    Raises ValueError when shapes disagree or a row is not a distribution: a sum may be off by what the rounding of the table's
    own type explains (1e-9 in double precision), and is made 1.
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
        _best_returns(list(t), mean, ends, discount),
    )
    return _bounded(CompiledModel(table_kernels.step, actions, 1, data, action_names=action_names), discount)


def _bounded(model: CompiledModel, discount: float | None) -> CompiledModel:
    if discount is None:
        return model
    return replace(model, upper=table_kernels.known_state_bound, upper_discount=discount)


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


def _best_returns(
    transition: list[Any], mean_reward: NDArray[np.float64], ends: NDArray[np.bool_], discount: float | None
) -> NDArray[np.float64]:
    """``[H, S]``: row h is the best return of h + 1 steps with the state known; the last bounds those of all more steps too.

    Value iteration until another step changes nothing. Where steps cost, few are worth more than many, so that no horizon's
    values bound another's: each has its row as long as `_MOST_VALUES` hold them, and the last is the greatest of the rest.
    """
    if discount is None:
        return np.empty((0, len(ends)))
    most = max(1, _MOST_VALUES // len(ends))
    rows: list[NDArray[np.float64]] = []
    values = np.zeros(len(ends))
    for _ in range(100_000):
        before = values
        backed_up = [mean_reward[a] + discount * (t @ before) for a, t in enumerate(transition)]
        values = np.where(ends, 0.0, np.max(backed_up, axis=0))
        if len(rows) < most:
            rows.append(values)
        else:
            rows[-1] = np.maximum(rows[-1], values)
        gain = values - before
        if np.abs(gain).max() <= max(1e-9 * (1 - discount), 8 * np.spacing(np.abs(values).max())):
            break
    # What is still to be gained: the next step gains at most `discount` times as much as this one did, and so on.
    left = max(0.0, float(gain.max())) * discount / (1 - discount)
    rows[-1] = np.where(ends, 0.0, rows[-1] + left)
    return np.array(rows)


def _sparse_model(
    transition: Sequence[Any],
    observation: Sequence[Any],
    reward: Any,
    terminal: ArrayLike | None,
    action_names: tuple[str, ...],
    discount: float | None,
) -> CompiledModel:
    actions, states = len(transition), transition[0].shape[0]
    t, o = list(transition), list(observation)
    if any(m.shape != (states, states) for m in t):
        raise ValueError(f"transition has shapes {[m.shape for m in t]}, must be A times [{states}, {states}]")
    if len(o) != actions or any(m.shape != (states, o[0].shape[1]) for m in o):
        raise ValueError(f"observation has shapes {[m.shape for m in o]}, must be {actions} times [{states}, O]")
    t, rows = _sparse_distributions("transition", t, "T(. | state, action)")
    _, seen = _sparse_distributions("observation", o, "O(. | action, state reached)")
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
    data = SparseData(rows, seen, np.ascontiguousarray(entries), ends, _best_returns(t, mean, ends, discount))
    return _bounded(CompiledModel(table_kernels.sparse_step, actions, 1, data, action_names=action_names), discount)


def _sparse_distributions(name: str, matrices: list[Any], meaning: str) -> tuple[list[Any], SparseRows]:
    """(the matrices with rows that sum to 1, the same as cumulative rows); the caller's own stay as they are."""
    states, columns = matrices[0].shape
    allowed = max(_rounding(m.dtype, columns) for m in matrices)
    table = scipy.sparse.csr_array(scipy.sparse.vstack(matrices, format="csr"), dtype=np.float64, copy=True)
    table.sum_duplicates()
    table.eliminate_zeros()
    first, sizes = table.indptr.astype(np.int64), np.diff(table.indptr)
    least = np.asarray(table.min(axis=1).todense(), dtype=np.float64).ravel()
    sums = np.asarray(table.sum(axis=1), dtype=np.float64).ravel()
    _check_rows(least, sums, allowed, lambda row: f"{name}[{row // states}][{row % states}] = {meaning}")
    table.data /= np.repeat(sums, sizes)
    cumulative = table_kernels.cumulated(first, table.data)
    rows = SparseRows(first, table.indices.astype(np.int64), cumulative, int(columns))
    return [table[at : at + states] for at in range(0, table.shape[0], states)], rows


def _distributions(name: str, table: ArrayLike, meaning: str) -> NDArray[np.float64]:
    given = np.asarray(table)
    if given.ndim != 3:
        raise ValueError(f"{name} has {given.ndim} dimensions, must have 3")
    rows = given.astype(np.float64)
    sums, states = rows.sum(axis=2), rows.shape[1]
    allowed = _rounding(given.dtype, rows.shape[2])
    least = rows.min(axis=2, initial=np.inf)
    _check_rows(least.ravel(), sums.ravel(), allowed, lambda r: f"{name}[{r // states}, {r % states}] = {meaning}")
    return rows / sums[:, :, None]


def _rounding(kind: Any, columns: int) -> float:
    """By how much the sum of so many probabilities may be off 1 for no other reason than that their type is coarse."""
    precision = float(np.finfo(kind).eps) if np.issubdtype(kind, np.floating) else 0.0
    return max(1e-9, 4 * precision * math.sqrt(columns))


def _check_rows(
    least: NDArray[np.float64], sums: NDArray[np.float64], allowed: float, named: Callable[[int], str]
) -> None:
    """ValueError naming the first row that is not a distribution."""
    bad = np.flatnonzero(~((least >= 0) & (np.abs(sums - 1) <= allowed)))
    if len(bad) > 0:
        row = int(bad[0])
        raise ValueError(
            f"{named(row)} is not a distribution: least entry {least[row]:g}, sum - 1 = {sums[row] - 1:.3g}; entries must be "
            f">= 0 and sum to 1 within {allowed:.2g}: divide the row by its sum if that is rounding"
        )


def _cumulative(rows: NDArray[np.float64]) -> NDArray[np.float64]:
    """Cumulative sums that never fall and whose last *possible* entry is exactly 1: no draw can land on an impossible one."""
    total = np.cumsum(rows, axis=2)
    return np.ascontiguousarray(total / total[:, :, -1:])


def reward_range(data: TableData | SparseData) -> tuple[float, float]:
    """(least, greatest) reward of a step that can happen; an ended process, where there can be one, earns 0."""
    size = len(data.terminal)
    if isinstance(data, SparseData):
        before = np.repeat(np.arange(len(data.transition.first) - 1), np.diff(data.transition.first))
        met = data.reward[~data.terminal[before % size]]
    else:
        possible = np.diff(data.transition, axis=1, prepend=0.0) > 0
        goes_on = ~np.tile(data.terminal, len(possible) // size)
        met = data.reward[possible & goes_on[:, None]]
    if data.terminal.any():
        met = np.append(met, 0.0)
    return float(met.min()), float(met.max())
