"""Checks and horizons that the options of every search share."""

from __future__ import annotations

import math

PRECISION = 0.01
"""Without `max_depth`: the weight of a reward beyond the horizon."""


def require(condition: bool, name: str, value: object, bound: str) -> None:
    """ValueError naming the field, its value and its bounds unless the condition holds."""
    if not condition:
        raise ValueError(f"{name} is {value!r}, must be {bound}")


def check_horizon(discount: float, max_depth: int | None, tree_depth: int | None) -> None:
    """ValueError unless rewards are summed over finitely many steps."""
    require(0 < discount <= 1, "discount", discount, "in (0, 1]")
    if discount == 1 and max_depth is None:
        raise ValueError("discount is 1 and max_depth is None: give max_depth, or rewards would be summed forever")
    require(max_depth is None or max_depth >= 1, "max_depth", max_depth, ">= 1")
    require(tree_depth is None or tree_depth >= 0, "tree_depth", tree_depth, ">= 0")


class Depths:
    """How deep a search looks, from its options."""

    discount: float
    max_depth: int | None
    tree_depth: int | None

    @property
    def horizon(self) -> int:
        """`max_depth`, or the depth that the discount implies."""
        if self.max_depth is not None:
            return self.max_depth
        return max(1, math.ceil(math.log(PRECISION) / math.log(self.discount)))

    @property
    def deepest_node(self) -> int:
        """`tree_depth`, or the horizon."""
        return self.horizon if self.tree_depth is None else min(self.tree_depth, self.horizon)
