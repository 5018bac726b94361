"""Single trajectories of a field: how uncertain they are together, and which one is the likeliest."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from tab_marl.field.answers import path_kernels
from tab_marl.field.belief import EXACT, ProductBelief
from tab_marl.field.chain import Table
from tab_marl.field.problem import COMPLETE, FAILED, UNDER_WAY

if TYPE_CHECKING:
    from tab_marl.field.tab_field import TabField

Floats = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class MostLikelyPath:
    """One trajectory from tick 0 to the tick at which the mission ends."""

    log_probability: float
    """Of exactly these base states (cell and mode), up to the mission's end."""
    cells: NDArray[np.int32]
    """``[n]``."""
    modes: NDArray[np.int32]
    """``[n]``."""
    automaton_states: NDArray[np.int32]
    """``[n]``."""
    positions: Floats
    """``[n, D]`` metres: the cells' centres."""
    completes: bool

    def __len__(self) -> int:
        return len(self.cells)


def path_entropy(field: TabField, visits: Table) -> float:
    """Entropy in nats of the trajectory (start, cells and modes) up to the tick at which the mission ends.

    `visits` ``[Q, S]``: probability of ever visiting (q, s). By the chain rule, the start's entropy and that of each step.
    """
    chain, problem = field.bridge, field.problem
    start = ProductBelief(chain, EXACT).masses
    total = -float((start[start > 0] * np.log(start[start > 0])).sum())
    rows = np.flatnonzero((np.asarray(problem.status) == UNDER_WAY) & (np.arange(len(visits)) != chain.initial))
    for r in np.unique(chain.reference_of[rows]):
        whole = _tick(field, int(r))
        these = rows[chain.reference_of[rows] == r]
        total += path_kernels.row_entropy(these, chain, whole.indptr, whole.indices, whole.data, visits)
    return total


def _tick(field: TabField, r: int) -> sparse.csr_array:
    whole = field.problem.reference.matrix(r)
    whole.sum_duplicates()
    whole.eliminate_zeros()
    return whole


def most_likely_path(field: TabField, completing: bool = True) -> MostLikelyPath:
    """The trajectory of largest probability up to the mission's end (max-product, Viterbi 1967).

    Args:
        completing: only among trajectories that complete the mission (else failing early may be the likeliest).
    """
    chain, problem = field.bridge, field.problem
    status = np.asarray(problem.status)
    log_weight = field.tilt.log_weight()
    matrices = {int(r): _tick(field, int(r)) for r in np.unique(chain.reference_of)}
    logs = {r: np.log(whole.data) for r, whole in matrices.items()}
    best = np.full(chain.value.shape, -np.inf)
    peak = float(chain.value[chain.accepting, 0])
    ended = (status == COMPLETE) if completing else (status != UNDER_WAY)
    with np.errstate(divide="ignore"):
        # Past the mission's end all that may follow counts together: its mass is h.
        best[ended] = np.log(chain.value[ended].astype(np.float64) / peak) + chain.log_scale[ended, None]
    best[~ended & (status == FAILED)] = -np.inf
    under_way = np.flatnonzero((status == UNDER_WAY) & (np.arange(len(status)) != chain.initial))
    for q in under_way[np.argsort(-problem.automaton.rank[under_way], kind="stable")]:
        r = int(chain.reference_of[q])
        whole = matrices[r]
        path_kernels.best_ahead(
            q, chain.symbol_of, chain.delta, log_weight, whole.indptr, whole.indices, logs[r], best, best[q]
        )
    start = ProductBelief(chain, EXACT)
    with np.errstate(divide="ignore", invalid="ignore"):
        # P(start state) is the filter's; what follows has weight best / h.
        h = (
            np.log(chain.value.astype(np.float64) / peak)[start.automaton_states]
            + chain.log_scale[start.automaton_states, None]
        )
        score = np.where(start.masses > 0, np.log(start.masses) + best[start.automaton_states] - h, -np.inf)
    row, s = np.unravel_index(int(np.argmax(score)), score.shape)
    q = int(start.automaton_states[row])
    states, automaton_states = [int(s)], [q]
    while status[q] == UNDER_WAY:
        r = int(chain.reference_of[q])
        whole = matrices[r]
        ends = slice(whole.indptr[states[-1]], whole.indptr[states[-1] + 1])
        following = whole.indices[ends]
        symbols = chain.symbol_of[following]
        ahead = logs[r][ends] + log_weight[q, symbols] + best[chain.delta[q, symbols], following]
        k = int(np.argmax(ahead))
        q = int(chain.delta[q, symbols[k]])
        states.append(int(following[k]))
        automaton_states.append(q)
    cells, modes = np.divmod(np.array(states, dtype=np.int32), np.int32(chain.modes))
    return MostLikelyPath(
        float(score[row, s]), cells, modes, np.array(automaton_states, dtype=np.int32), chain.centres[cells],
        bool(status[q] == COMPLETE),
    )  # fmt: skip
