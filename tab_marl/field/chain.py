"""The adversary as a Markov chain on (mission-automaton state, base state), tilted by a table h.

One form for every adversary model: the TAB-Field (h = the backward message, Doob's h-transform), a plain reference
process (h = 1), a reference kept inside what is feasible (h = 1{feasible}).
"""

from __future__ import annotations

from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tab_marl.field import kernels
from tab_marl.field.reference import Motion, Reference, from_matrices

Table = NDArray[np.float32] | NDArray[np.float64]


class Automaton(Protocol):
    """What a chain needs of a mission automaton; `tab_marl.mission.unroll.TickAutomaton` has it."""

    @property
    def delta(self) -> NDArray[np.int32]:
        """``[Q, L]`` next state when symbol l is read; absorbing states lead to themselves."""

    @property
    def initial(self) -> int:
        """State before the first symbol."""

    @property
    def accepting(self) -> int: ...

    @property
    def rejecting(self) -> int: ...


class ProductChain(NamedTuple):
    """Arrays only, so that kernels can take it whole. Build one with `product_chain`.

    A tick from (q, s): ``P(q', s') = Q(s'|s) w(q, l') h[q', s'] / norm``, ``q' = delta[q, l']``, l' the symbol of the
    cell of s'. From absorbing q, and wherever norm is 0, the plain reference goes on, scaled to sum to 1.
    """

    motion: Motion
    """The references."""
    reference_of: NDArray[np.int32]
    """``[Q]``."""
    labels: NDArray[np.int32]
    """``[C]`` symbol of each cell."""
    symbol_of: NDArray[np.int32]
    """``[S]`` the same for each base state."""
    delta: NDArray[np.int32]
    """``[Q, L]``."""
    factor: NDArray[np.float64]
    """``[Q, L]`` ``w(q, l) exp(log_scale[q'] - log_scale[q])``."""
    value: Table
    """``[Q, S]`` h / exp(log_scale[q]), up to one factor common to all rows."""
    norm: Table
    """``[Q, S]`` the kernel's normaliser on the same scale; the same array as `value` where h is harmonic."""
    log_scale: NDArray[np.float64]
    """``[Q]``."""
    initial: int
    accepting: int
    rejecting: int
    start: NDArray[np.float64]
    """``[C]`` distribution of the first cell."""
    mode_shares: NDArray[np.float64]
    """``[M]`` distribution of the mode of the plain reference."""
    first_mode_shares: NDArray[np.float64]
    """``[M]`` the same at tick 0, before it is tilted by h."""
    centres: NDArray[np.float64]
    """``[C, 2]`` metres, in space ``[C, 3]``."""
    cell_metres: float
    headings: NDArray[np.float64]
    """``[M]`` radians, nan for rest."""
    complete: NDArray[np.bool_]
    """``[Q]`` whether the mission is complete (in `accepting`, and where only other events are still watched)."""
    span: int
    """The largest difference between the numbers of two cells one tick apart."""

    @property
    def cells(self) -> int:
        return len(self.labels)

    @property
    def modes(self) -> int:
        return self.motion.mix.shape[1]

    @property
    def states(self) -> int:
        """S = cells * modes."""
        return self.value.shape[1]


def product_chain(
    transitions: object,
    labels: ArrayLike,
    automaton: Automaton,
    start: ArrayLike,
    value: ArrayLike | None = None,
    *,
    centres: ArrayLike | None = None,
    cell_metres: float = 1.0,
    reference_of: ArrayLike | None = None,
    weight: ArrayLike | None = None,
    log_scale: ArrayLike | None = None,
    harmonic: bool = False,
    complete: ArrayLike | None = None,
) -> ProductChain:
    """A chain from any reference and any table h >= 0.

    Args:
        transitions: a `Reference`, or ``[S, S]`` matrices (dense or sparse, one or a sequence of R), rows >= 0 with
            sum <= 1.
        labels: ``[C]`` symbol of each cell, 0..L-1.
        automaton: anything with delta ``[Q, L]``, initial, accepting and rejecting; cycles are allowed.
        start: ``[C]`` distribution of the first cell.
        value: ``[Q, S]`` h; default 1 everywhere. Rows of absorbing states matter as targets only.
        centres: ``[C, 2]`` metres, in space ``[C, 3]``; default: cells one apart on a line.
        reference_of: ``[Q]`` reference of each automaton state; default 0.
        weight: ``[Q, L]`` factor on each transition; default 1.
        log_scale: ``[Q]``, if `value` holds h / exp(log_scale).
        harmonic: `value` is known to satisfy ``h = sum Q w h'`` on transient states, so that it is its own normaliser.
        complete: ``[Q]`` where the mission counts as complete; default: in `accepting` alone.
    Raises:
        ValueError: a field has the wrong shape, a negative or not finite entry, or rows that sum to more than 1.
    """
    reference = transitions if isinstance(transitions, Reference) else from_matrices(transitions)
    symbols = np.ascontiguousarray(labels, dtype=np.int32)
    cells = len(symbols)
    states, modes = reference.states, reference.modes
    if symbols.ndim != 1 or cells * modes != states:
        raise ValueError(f"labels has shape {symbols.shape}: must be [{states // modes}], one symbol per cell")
    delta = np.ascontiguousarray(automaton.delta, dtype=np.int32)
    count, alphabet = delta.shape
    if delta.min() < 0 or delta.max() >= count:
        raise ValueError(f"automaton.delta has entries in {delta.min()}..{delta.max()}, must lie in 0..{count - 1}")
    if cells and (symbols.min() < 0 or symbols.max() >= alphabet):
        raise ValueError(f"labels lie in {symbols.min()}..{symbols.max()}, must lie in 0..{alphabet - 1}")
    for name in ("initial", "accepting", "rejecting"):
        q = int(getattr(automaton, name))
        if not 0 <= q < count:
            raise ValueError(f"automaton.{name} is {q}, must be one of its {count} states (0..{count - 1})")
    for name in ("accepting", "rejecting"):
        q = int(getattr(automaton, name))
        if (delta[q] != q).any():
            raise ValueError(f"automaton.{name} ({q}) must lead to itself under every symbol")
    which = np.zeros(count, dtype=np.int32) if reference_of is None else np.asarray(reference_of, dtype=np.int32)
    if which.shape != (count,) or (count and (which.min() < 0 or which.max() >= reference.count)):
        raise ValueError(f"reference_of must be [{count}] with entries in 0..{reference.count - 1}")
    table = np.ones((count, states), dtype=np.float32) if value is None else np.ascontiguousarray(value)
    if table.dtype not in (np.float32, np.float64):
        table = table.astype(np.float64)
    if not harmonic:  # else it was computed from checked input, and may be large
        check_nonnegative("value (h)", table, (count, states))
    tilt = np.ones((count, alphabet)) if weight is None else np.ascontiguousarray(weight, dtype=np.float64)
    check_nonnegative("weight", tilt, (count, alphabet))
    first = np.ascontiguousarray(start, dtype=np.float64)
    check_nonnegative("start", first, (cells,))
    if abs(first.sum() - 1) > 1e-9:
        raise ValueError(f"start sums to {first.sum():.12g}, must sum to 1")
    places = np.asarray(
        np.stack([np.arange(cells) + 0.5, np.full(cells, 0.5)], axis=1) if centres is None else centres,
        dtype=np.float64,
    )
    if places.shape not in ((cells, 2), (cells, 3)):
        raise ValueError(f"centres has shape {places.shape}, must be [{cells}, 2], in space [{cells}, 3]")
    scale = np.zeros(count) if log_scale is None else np.array(log_scale, dtype=np.float64)
    transient = np.setdiff1d(np.arange(count), [automaton.accepting, automaton.rejecting]).astype(np.int32)
    if harmonic:
        norm = table
    else:
        norm = np.zeros_like(table)
        kernels.normalisers(transient, reference.motion, which, symbols, delta, tilt, table, scale, norm)
    with np.errstate(invalid="ignore", over="ignore"):
        factor = tilt * np.exp(scale[delta] - scale[:, None])
    factor[~np.isfinite(factor)] = 0.0
    return ProductChain(
        reference.motion,
        which,
        symbols,
        np.repeat(symbols, modes),
        delta,
        factor,
        table,
        norm,
        scale,
        int(automaton.initial),
        int(automaton.accepting),
        int(automaton.rejecting),
        first,
        reference.mode_shares(),
        reference.first_mode_shares(),
        np.ascontiguousarray(places),
        float(cell_metres),
        reference.headings,
        np.arange(count) == automaton.accepting if complete is None else np.array(complete, dtype=np.bool_),
        reference.span,
    )


def check_nonnegative(name: str, array: NDArray[np.floating], shape: tuple[int, ...]) -> None:
    """Raise ValueError unless the array has this shape and every entry is finite and >= 0."""
    if array.shape != shape:
        raise ValueError(f"{name} has shape {array.shape}, must be {list(shape)}")
    smallest = array.min(initial=0.0)
    if not (np.isfinite(smallest) and smallest >= 0 and np.isfinite(array.max(initial=0.0))):
        bad = array[~(np.isfinite(array) & (array >= 0))]
        raise ValueError(f"{name} has the entry {bad.flat[0]}: all must be finite and >= 0")
