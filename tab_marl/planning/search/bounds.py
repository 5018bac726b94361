"""Checks and horizons that the options of every search share."""

from __future__ import annotations

import dataclasses
import math
from numbers import Integral, Real
from typing import Any

PRECISION = 0.01
"""Without `max_depth`: the weight of a reward beyond the horizon."""


def require(condition: bool, name: str, value: object, bound: str) -> None:
    """ValueError naming the field, its value and its bounds unless the condition holds."""
    if not condition:
        raise ValueError(f"{name} is {value!r}, must be {bound}")


def require_whole(name: str, value: object) -> None:
    """ValueError naming the field, its value and how to write it unless it is a whole number (Python's or numpy's)."""
    if isinstance(value, Integral):
        return
    remedy = f": write {float(value):.0f}" if isinstance(value, Real) and float(value).is_integer() else ""
    raise ValueError(f"{name} is {value!r}, must be a whole number{remedy}")


def check_kinds(options: Any) -> None:
    """ValueError naming the first option that is no number, or no whole one, where its annotation says ``float`` or ``int``.

    Asked before any bound is: a comparison with a text or None would fail without saying of what.
    """
    for option in dataclasses.fields(options):
        kind, value = str(option.type), getattr(options, option.name)
        if value is None and kind.endswith("| None"):
            continue
        if kind.startswith("int"):
            require_whole(option.name, value)
        elif kind.startswith("float"):
            require(isinstance(value, Real), option.name, value, "a number")


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
