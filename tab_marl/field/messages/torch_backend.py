"""The backward pass in PyTorch, for a GPU: the same recursion as `backward_kernels`, all automaton states of a rank at once.

Imported only when asked for (`solve(problem, backend="torch")`). Messages are computed in double precision on the device
and come back to the host in the precision that the options ask for; everything else is as with the compiled kernels.
"""

from __future__ import annotations

import warnings
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from tab_marl.field.chain import Table
    from tab_marl.field.problem import FieldProblem

ROWS_AT_ONCE = 256
"""Automaton states per product: bounds the device's memory."""


def check(device: str) -> None:
    """Raise ValueError unless PyTorch is there and has this device."""
    try:
        import torch
    except ImportError:
        raise ValueError(
            'backend="torch" needs PyTorch, which is not installed: pip install torch, or use backend="numba"'
        ) from None
    try:
        torch.zeros(1, device=device)
    except (RuntimeError, AssertionError) as error:  # torch raises either for a device it was not built for
        reason = str(error).splitlines()[0]
        there = ["cpu", *(f"cuda:{i}" for i in range(torch.cuda.device_count()))]
        raise ValueError(f"device is {device!r}, which PyTorch cannot use here ({reason}); there is: {there}") from None


def backward(
    order: NDArray[np.int32],
    problem: FieldProblem,
    weight: NDArray[np.float64],
    peak: float,
    value: Table,
    log_scale: NDArray[np.float64],
    device: str,
) -> None:
    """As `backward_kernels.backward`, for `order` of falling rank: fills the rows of `value` and `log_scale` in place."""
    import torch

    automaton, reference = problem.automaton, problem.reference
    states, modes = reference.states, reference.modes
    symbol_of = torch.as_tensor(np.repeat(np.asarray(problem.labels), modes).astype(np.int64), device=device)
    moves, mixes = _moves(reference, device), torch.as_tensor(reference.mix, device=device)
    which, delta = np.asarray(problem.reference_of), automaton.delta
    with np.errstate(divide="ignore"):
        log_weight = np.log(weight)
    # Only rows that later states still read stay on the device.
    last_read = np.full(len(delta), -1, dtype=np.int64)
    groups = _groups(order, automaton.rank, which)
    for step, group in enumerate(groups):
        last_read[delta[group].ravel()] = step
    rows: dict[int, Any] = {}
    ahead_rows = [int(q) for q in np.unique(delta[order]) if q not in set(order.tolist())]
    for q in ahead_rows:
        rows[q] = torch.as_tensor(np.asarray(value[q], dtype=np.float64) / peak, device=device)
    for step, group in enumerate(groups):
        following = np.unique(delta[group])
        slot = np.zeros(len(delta), dtype=np.int64)
        slot[following] = np.arange(len(following))
        table = torch.stack([rows[int(q)] for q in following])
        log_factor = log_weight[group] + log_scale[delta[group]]
        base = log_factor.max(axis=1)
        with np.errstate(invalid="ignore"):
            factor = np.where(np.isfinite(log_factor), np.exp(log_factor - base[:, None]), 0.0)
        of_state = torch.as_tensor(slot[delta[group]], device=device)[:, symbol_of]
        ahead = torch.gather(table, 0, of_state) * torch.as_tensor(factor, device=device)[:, symbol_of]
        moved = torch.sparse.mm(moves[which[group[0]]], ahead.T)
        if modes > 1:
            moved = torch.matmul(mixes[which[group[0]]], moved.reshape(states // modes, modes, len(group)))
        out = moved.reshape(states, len(group)).T
        largest = out.max(dim=1).values
        out = torch.where(largest[:, None] > 0, out / largest[:, None], torch.zeros_like(out))
        found, top = out.cpu().numpy(), largest.cpu().numpy()
        with np.errstate(divide="ignore"):
            log_scale[group] = np.where(top > 0, base + np.log(top), -np.inf)
        value[group] = found * peak
        for i, q in enumerate(group):
            if last_read[q] > step:
                rows[int(q)] = out[i]
        for q in [q for q in rows if last_read[q] <= step]:
            del rows[q]


def _groups(order: NDArray[np.int32], rank: NDArray[np.int32], which: NDArray[np.int32]) -> list[NDArray[np.int32]]:
    """`order` cut where the rank or the reference changes, and into pieces of ROWS_AT_ONCE."""
    arranged = order[np.lexsort((which[order], -rank[order]))]
    changes = np.flatnonzero(np.diff(rank[arranged]) | np.diff(which[arranged])) + 1
    groups = np.split(arranged, changes)
    return [piece for group in groups for piece in np.split(group, range(ROWS_AT_ONCE, len(group), ROWS_AT_ONCE))]


def _moves(reference: Any, device: str) -> list[Any]:
    """``[S, S]`` sparse matrices of the moves, one per reference."""
    import torch

    states = reference.states
    found = []
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="Sparse CSR tensor support is in beta state")
        for r in range(reference.count):
            at = reference.indptr[r * states : (r + 1) * states + 1]
            part = slice(int(at[0]), int(at[-1]))
            found.append(
                torch.sparse_csr_tensor(
                    torch.as_tensor(at - at[0]), torch.as_tensor(reference.indices[part].astype(np.int64)),
                    torch.as_tensor(reference.data[part]), size=(states, states), dtype=torch.float64, device=device,
                    check_invariants=False,
                )
            )  # fmt: skip
    return found
