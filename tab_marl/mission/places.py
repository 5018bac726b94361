"""What missions need of the world they are set in: named places, and the lengths and times that words stand for."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

from tab_marl.world.regions import Region
from tab_marl.world.solids import Solid


class Named(Protocol):
    @property
    def name(self) -> str: ...


class MissionWorld(Protocol):
    """`Scenario` in the plane and `Volume` in space are such worlds; any object with these members is."""

    @property
    def checkpoints(self) -> Sequence[Named]:
        """Those that "any three checkpoints" speaks of, in order."""

    @property
    def step_seconds(self) -> float: ...

    @property
    def horizon_seconds(self) -> float: ...

    @property
    def leave_metres(self) -> float:
        """A recurring visit counts again only after the robot was this far outside the region."""

    @property
    def exact_seconds(self) -> float:
        """`exact` means first entry within +- max(exact_seconds, exact_fraction * time)."""

    @property
    def exact_fraction(self) -> float: ...

    def named_regions(self) -> Sequence[tuple[str, Region | Solid]]: ...

    def spellings(self) -> dict[str, str]:
        """Every accepted spelling (case-folded) -> the region's one name."""

    def place(self, place: str | tuple[float, float]) -> Region | Solid:
        """The region of a name, or around a bare point. Raises UnknownName, or ValueError where there is none."""
