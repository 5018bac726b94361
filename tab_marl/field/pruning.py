"""Leaving out automaton states that the motion cannot visit, or from which it cannot complete the mission in time."""

from __future__ import annotations

from dataclasses import fields, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from tab_marl.field.infeasible import InfeasibleField

if TYPE_CHECKING:
    from tab_marl.field.problem import FieldProblem
    from tab_marl.mission.unroll import TickAutomaton

Bools = NDArray[np.bool_]


def pruned(problem: FieldProblem) -> FieldProblem:
    """See `FieldProblem.pruned`. Raises InfeasibleField when nothing is left."""
    from tab_marl.field.support import support_of

    if problem.constraints or problem.tracking is not None:
        raise ValueError("pruned() needs a problem without soft constraints: prune first, then add them")
    automaton = problem.automaton
    possible = support_of(problem, True, problem.options.completion_probability < 1).possible
    started = np.flatnonzero(np.asarray(problem.start) > 0)
    if not possible[automaton.delta[automaton.initial, np.asarray(problem.labels)[started]], started].any():
        raise InfeasibleField("no feasible motion from any start cell completes the mission: there is nothing to keep")
    kept = possible.any(axis=1)
    kept[[automaton.initial, automaton.accepting, automaton.rejecting]] = True
    rough = None if problem.rough is None else pruned(problem.rough)
    return replace(
        problem, automaton=restricted(automaton, kept), rough=rough,
        **{name: np.asarray(getattr(problem, name))[kept] for name in ("reference_of", "stage", "status")},
    )  # fmt: skip


def restricted(automaton: TickAutomaton, kept: Bools) -> TickAutomaton:
    """The automaton without the other states ``[Q]``: what leads to them leads to rejection."""
    number = np.where(kept, np.cumsum(kept) - 1, 0)
    number[~kept] = number[automaton.rejecting]
    changes: dict[str, Any] = {
        one.name: value[kept]
        for one in fields(automaton)
        if isinstance(value := getattr(automaton, one.name), np.ndarray)
        and len(value) == len(kept)
        and one.name != "masks"
    }
    delta = number[automaton.delta][kept].astype(np.int32)
    changes["delta"] = delta
    changes["branch"] = np.where(delta == number[automaton.rejecting], -1, automaton.branch[kept]).astype(np.int32)
    for name in ("initial", "accepting", "rejecting"):
        changes[name] = int(number[getattr(automaton, name)])
    return replace(automaton, **changes)
