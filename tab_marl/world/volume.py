"""A box of space with named places in it: what `Scenario` is to missions and fields in the plane, in three dimensions.

Holds places, times and how fast and large the adversary is, no vehicle: what moves in it is a reference process or a
simulator.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import ClassVar

from tab_marl.world.scenario import UnknownName, require_positive
from tab_marl.world.solids import Ball, Solid

STRICT: dict[str, str] = {"extra": "forbid"}


@dataclass(frozen=True)
class Body:
    """How large and how fast something that moves in any direction is."""

    radius_metres: float = 0.25
    """Its centre keeps this far from walls and obstacles."""
    max_speed: float = 1.0
    """m/s."""

    __pydantic_config__: ClassVar = STRICT

    def __post_init__(self) -> None:
        require_positive(self, "radius_metres")
        require_positive(self, "max_speed")


@dataclass(frozen=True)
class BallCheckpoint:
    """A named ball with a sensor around it."""

    name: str
    x: float
    y: float
    z: float
    radius_metres: float = 0.5
    """A robot whose centre is within this radius is at the checkpoint."""
    sensor_metres: float = 1.0
    """The sensor notices the adversary while its centre is within this radius."""

    __pydantic_config__: ClassVar = STRICT

    def __post_init__(self) -> None:
        require_positive(self, "radius_metres")
        require_positive(self, "sensor_metres")

    @property
    def region(self) -> Ball:
        return Ball(self.x, self.y, self.z, self.radius_metres)

    @property
    def sensor(self) -> Ball:
        return Ball(self.x, self.y, self.z, self.sensor_metres)


@dataclass(frozen=True)
class Volume:
    """A box of space from the origin to (width, depth, height). Lengths in metres, times in seconds."""

    name: str
    checkpoints: tuple[BallCheckpoint, ...]
    """In order: the first is also "checkpoint 1" and "checkpoint A"."""
    adversary_start: Solid
    """The adversary starts uniformly in the free part of this solid."""
    width_metres: float = 10.0
    """Along x."""
    depth_metres: float = 10.0
    """Along y."""
    height_metres: float = 5.0
    """Along z."""
    obstacles: tuple[Solid, ...] = ()
    regions: tuple[tuple[str, Solid], ...] = ()
    """Named places beyond checkpoints; "central zone" (also "central ball") is always there."""
    aliases: tuple[tuple[str, str], ...] = ()
    """(other spelling, region name)."""
    adversary: Body = field(default_factory=Body)
    step_seconds: float = 0.5
    """One tick of the field and of missions on the grid."""
    horizon_seconds: float = 60.0
    leave_metres: float = 0.5
    """A recurring visit counts again only after the robot was this far outside the region."""
    exact_seconds: float = 0.5
    """`exact` means first entry within +- max(exact_seconds, exact_fraction * time)."""
    exact_fraction: float = 0.1
    central_zone_metres: float = 1.0
    """Radius of the central zone."""

    __pydantic_config__: ClassVar = STRICT

    def __post_init__(self) -> None:
        for name in (
            "width_metres", "depth_metres", "height_metres", "step_seconds", "horizon_seconds",
            "leave_metres", "central_zone_metres",
        ):  # fmt: skip
            require_positive(self, name)
        names = [name.casefold() for name, _ in self.named_regions()]
        repeated = sorted({name for name in names if names.count(name) > 1})
        if repeated:
            raise ValueError(f"Volume {self.name!r}: region names must be unique, repeated: {repeated}")
        for alias, name in self.aliases:
            if name.casefold() not in names:
                raise UnknownName("region", name, [n for n, _ in self.named_regions()])
            if alias.casefold() in names:
                raise ValueError(f"Volume {self.name!r}: alias {alias!r} is already the name of a region")
        for c in self.checkpoints:
            if not all(0 <= at <= size for at, size in zip(c.region.centre, self.size_metres, strict=True)):
                raise ValueError(
                    f"Volume {self.name!r}: {c.name} at ({c.x}, {c.y}, {c.z}) lies outside the "
                    f"{self.width_metres} x {self.depth_metres} x {self.height_metres} m box"
                )

    @property
    def size_metres(self) -> tuple[float, float, float]:
        """Along x, y, z."""
        return (self.width_metres, self.depth_metres, self.height_metres)

    @property
    def horizon_ticks(self) -> int:
        return round(self.horizon_seconds / self.step_seconds)

    def named_regions(self) -> tuple[tuple[str, Solid], ...]:
        """Every (name, solid): checkpoints first, then the volume's own, then the central zone."""
        own: list[tuple[str, Solid]] = [(c.name, c.region) for c in self.checkpoints]
        own += self.regions
        if "central zone" not in {name.casefold() for name, _ in own}:
            x, y, z = (size / 2 for size in self.size_metres)
            own.append(("central zone", Ball(x, y, z, self.central_zone_metres)))
        return tuple(own)

    def spellings(self) -> dict[str, str]:
        """Every accepted spelling (case-folded) -> the region's one name."""
        table = {name.casefold(): name for name, _ in self.named_regions()}
        for number, checkpoint in enumerate(self.checkpoints, start=1):
            for other in (f"checkpoint {number}", f"checkpoint {chr(ord('a') + number - 1)}"):
                table.setdefault(other, checkpoint.name)
        table.setdefault("central ball", table["central zone"])
        for alias, name in self.aliases:
            table[alias.casefold()] = table[name.casefold()]
        return table

    def region(self, name: str) -> Solid:
        """The solid of this name or alias, any case. Raises UnknownName."""
        spellings = self.spellings()
        canonical = spellings.get(name.casefold())
        if canonical is None:
            raise UnknownName("region", name, spellings.values())
        return dict(self.named_regions())[canonical]

    def place(self, place: str | tuple[float, float]) -> Solid:
        """The solid of a name. Raises ValueError for a bare point, which is planar."""
        if isinstance(place, str):
            return self.region(place)
        raise ValueError(
            f"target {list(place)} is a point of the plane: in a Volume name a region (Volume.regions) and go there"
        )
