"""The regions a mission speaks of, one bit each."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import cast

import numpy as np
from numpy.typing import NDArray

from tab_marl.mission.model import Place, place_name
from tab_marl.mission.places import MissionWorld
from tab_marl.world.regions import Box, Disc, Polygon, Region
from tab_marl.world.scenario import Scenario
from tab_marl.world.solids import Ball, Cuboid

MOST_PROPOSITIONS = 12
"""Tables have 2**P columns."""


def region_of(place: Place, world: MissionWorld) -> Region:
    """The region a place stands for. Raises UnknownName, or ValueError for a point outside the arena."""
    region = world.place(place)
    if not isinstance(place, str) and isinstance(world, Scenario):
        x, y = place
        if not (0 <= x <= world.width_metres and 0 <= y <= world.height_metres):
            raise ValueError(
                f"target {place_name(place)} lies outside the {world.width_metres} x {world.height_metres} m arena"
            )
    # A solid answers the same questions about points in space. Typed by the plane, where most callers draw regions.
    return cast(Region, region)


def grown(region: Region, metres: float) -> Region:
    """The region with every side moved outwards (corners stay corners)."""
    if isinstance(region, Ball | Cuboid):
        return cast(Region, region.grown(metres))
    if isinstance(region, Disc):
        return Disc(region.x, region.y, region.radius + metres)
    if isinstance(region, Box):
        return Box(region.x_min - metres, region.y_min - metres, region.x_max + metres, region.y_max + metres)
    corners = region.vertices()
    edge = np.roll(corners, -1, axis=0) - corners
    normal = np.stack([edge[:, 1], -edge[:, 0]], axis=1) / np.hypot(edge[:, 0], edge[:, 1])[:, None]
    before = np.roll(normal, 1, axis=0)
    # The corner that lies `metres` beyond both adjacent sides.
    shift = metres * (before + normal) / (1.0 + (before * normal).sum(axis=1))[:, None]
    return Polygon(tuple((float(x), float(y)) for x, y in corners + shift))


@dataclass
class Propositions:
    """Collects distinct regions while a mission is compiled."""

    scenario: MissionWorld
    regions: list[Region] = field(default_factory=list)
    names: list[str] = field(default_factory=list)

    def add(self, place: Place) -> None:
        """Give the place a bit, unless its region has one."""
        self._add(region_of(place, self.scenario), place_name(place))

    def add_leaving(self, place: Place) -> None:
        """Give the place grown by `leave_metres` a bit."""
        region = grown(region_of(place, self.scenario), self.scenario.leave_metres)
        self._add(region, f"around {place_name(place)}")

    def _add(self, region: Region, name: str) -> None:
        if region not in self.regions:
            self.regions.append(region)
            self.names.append(name)
        if len(self.regions) > MOST_PROPOSITIONS:
            raise ValueError(
                f"the mission speaks of more than {MOST_PROPOSITIONS} distinct regions ({', '.join(self.names)}): "
                "its automaton would be too large; name fewer places"
            )

    @property
    def masks(self) -> NDArray[np.int32]:
        """``[2**P]``."""
        return np.arange(1 << len(self.regions), dtype=np.int32)

    def inside(self, place: Place) -> NDArray[np.bool_]:
        """``[2**P]``: which masks are inside the place."""
        return self._bit(region_of(place, self.scenario))

    def not_left(self, place: Place) -> NDArray[np.bool_]:
        """``[2**P]``: which masks are inside the place grown by `leave_metres`."""
        return self._bit(grown(region_of(place, self.scenario), self.scenario.leave_metres))

    def inside_any(self, places: tuple[Place, ...]) -> NDArray[np.bool_]:
        """``[2**P]``: which masks are inside some of the places."""
        found = np.zeros(len(self.masks), dtype=np.bool_)
        for place in places:
            found |= self.inside(place)
        return found

    def _bit(self, region: Region) -> NDArray[np.bool_]:
        return np.asarray((self.masks >> self.regions.index(region)) & 1 == 1)
