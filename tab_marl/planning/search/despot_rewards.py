"""What a scenario search is promised about a model's rewards, and whether the model keeps to it."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

from tab_marl.planning.tables import SparseData, TableData, reward_range

if TYPE_CHECKING:
    from tab_marl.planning.search.despot import DespotOptions

_ROUNDING = 1e-9


def check_promises(model: Any, options: DespotOptions) -> None:
    """ValueError when the model's upper bound is for another discount, or its tables hold rewards out of bounds."""
    held = None if getattr(model, "upper", None) is None else getattr(model, "upper_discount", None)
    # A smaller discount is no safer: it shrinks the costs to come as it does the earnings.
    if held is not None and not math.isclose(held, options.discount, rel_tol=1e-12):
        raise ValueError(
            f"discount is {options.discount}, and the model's upper bound holds for a discount of {held} only: plan with "
            f"discount={held}, make the bound for {options.discount} (of tables: table_model(..., discount={options.discount})), "
            "or take a model without `upper` and give DespotOptions reward_bounds"
        )
    data = _tables(model)
    if data is not None:
        check_met(model, options, *reward_range(data))


def check_met(model: Any, options: DespotOptions, least: float, greatest: float) -> None:
    """ValueError when rewards from `least` to `greatest`, which the model gave, leave the bounds that were promised."""
    if options.reward_bounds is None:
        return
    low, high = trivial_rewards(model, options)
    slack = _ROUNDING * max(1.0, abs(low), abs(high))
    if least < low - slack or greatest > high + slack:
        promised = options.reward_bounds
        raise ValueError(
            f"reward_bounds is {promised}, and the model gives a reward of {least if least < low - slack else greatest:g}: no "
            f"bound holds then; give at least ({min(least, promised[0]):g}, {max(greatest, promised[1]):g})"
        )


def trivial_rewards(model: Any, options: DespotOptions) -> tuple[float, float]:
    """(least, greatest) of what a step can bring, by `reward_bounds`; (0, 0) without.

    A process that may end earns 0 from then on, so that of steps that all cost it can save some: only tables can say that
    theirs never ends.
    """
    if options.reward_bounds is None:
        return 0.0, 0.0
    least, greatest = options.reward_bounds
    data = _tables(model)
    if data is not None and not data.terminal.any():
        return float(least), float(greatest)
    return min(0.0, float(least)), max(0.0, float(greatest))


def _tables(model: Any) -> TableData | SparseData | None:
    data = getattr(model, "data", None)
    return data if isinstance(data, TableData | SparseData) else None
