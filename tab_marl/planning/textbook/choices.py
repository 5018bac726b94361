"""Rollouts and priors of the textbook problems, by name."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TypeVar

from tab_marl.world.scenario import UnknownName

T = TypeVar("T")


def chosen(kind: str, name: str, known: Mapping[str, T]) -> T:
    """The entry of this name. Raises UnknownName with the nearest one."""
    if name not in known:
        raise UnknownName(kind, str(name), known)
    return known[name]
