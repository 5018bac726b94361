"""A mission as one timed automaton: locations, three clocks counted in ticks, windows, forbidden labels.

The single semantics of missions. The environment's monitor steps it on positions, the field unrolls its clocks on cells.
At each tick, in this order: a forbidden label fails; a clock beyond its latest bound fails; a counted visit outside its
window fails (unless the location is patient, where an early one is ignored); else the location moves. At most one
visit is counted per tick.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tab_marl.mission import kernels
from tab_marl.world.regions import Region

COMPLETED: int = kernels.COMPLETED
"""Absorbing location: the mission is done."""
FAILED: int = kernels.FAILED
"""Absorbing location: the mission can no longer be done."""
ALWAYS_FORBIDDEN = 2**31 - 1
NO_BRANCH = -1
UNBOUNDED = 2**31 - 2
"""One less than the largest int32, so that `latest + 1` cannot overflow."""
MISSION_CLOCK, STAGE_CLOCK, VISIT_CLOCK = 0, 1, 2
BEFORE_START = (-1, -1, -1)
"""The clocks before tick 0 is read."""

Tables = tuple[
    NDArray[np.int32], NDArray[np.int32], NDArray[np.bool_], NDArray[np.bool_], NDArray[np.int32], NDArray[np.int32],
    NDArray[np.bool_],
]  # fmt: skip


class AutomatonState(NamedTuple):
    """Where a mission stands after reading a label."""

    location: int
    """>= 0, COMPLETED or FAILED."""
    clocks: tuple[int, int, int]
    """Ticks since the mission began, since the current goal became current, and since the last counted visit."""


@dataclass(frozen=True, eq=False)
class MissionAutomaton:
    """U locations over P propositions; a label is a bit mask of the regions that hold the robot's centre."""

    tick_seconds: float
    regions: tuple[Region, ...]
    """P regions; bit p of a mask: inside ``regions[p]``. Some are goals grown by `leave_metres` ("has it left yet")."""
    region_names: tuple[str, ...]
    """What people call each proposition."""
    next_location: NDArray[np.int32]
    """``[U, 2**P]``: >= 0, COMPLETED or FAILED."""
    forbidden_until: NDArray[np.int32]
    """``[U, 2**P]`` ticks: the label fails while the mission clock is below (0: allowed, or ALWAYS_FORBIDDEN)."""
    progress: NDArray[np.bool_]
    """``[U, 2**P]``: the transition counts as a visit, and the clocks must lie in the window."""
    patient: NDArray[np.bool_]
    """``[U]``: progress before the window is ignored instead of failing (presence, missions without goals)."""
    earliest: NDArray[np.int32]
    """``[U, 3]`` ticks of (mission, stage, visit) clock from which progress counts."""
    latest: NDArray[np.int32]
    """``[U, 3]`` ticks up to which progress counts; beyond it the mission has failed. UNBOUNDED if none."""
    resets: NDArray[np.bool_]
    """``[U, 2**P, 3]``: clocks that the transition sets to 0."""
    branch: NDArray[np.int32]
    """``[U, 2**P]``: the place visited by this progress, an index into `branch_places`, or NO_BRANCH."""
    branch_places: tuple[str, ...]
    speed_limit: NDArray[np.float64]
    """``[U]`` m/s, inf if none."""
    goal: NDArray[np.int32]
    """``[U]``: index into ``mission.constraints`` of the current goal; -1 in a mission without goals."""
    visits: NDArray[np.int32]
    """``[U]``: visits already counted for the current goal."""
    goals_done: NDArray[np.int32]
    """``[U]``: goals completed so far."""
    initial: int = 0
    """The location before tick 0 is read."""

    @property
    def locations(self) -> int:
        """U."""
        return len(self.next_location)

    @property
    def tables(self) -> Tables:
        """The first seven arguments of `kernels.advance`."""
        return (
            self.next_location, self.forbidden_until, self.progress, self.patient, self.earliest, self.latest,
            self.resets,
        )  # fmt: skip

    def masks(self, points: ArrayLike) -> NDArray[np.int32]:
        """``[N]`` labels of points ``[N, 2]`` in metres."""
        return masks_of(self.regions, points)

    def first(self, mask: int) -> AutomatonState:
        """The state at tick 0, whose label is `mask`."""
        return self.advance(AutomatonState(self.initial, BEFORE_START), mask)

    def advance(self, state: AutomatonState, mask: int) -> AutomatonState:
        """The state one tick later, whose label is `mask`. Plain Python twin of `kernels.advance`."""
        u = state.location
        if u < 0:
            return state
        clocks = tuple(c + 1 for c in state.clocks)
        counted = bool(self.progress[u, mask])
        early = any(c < e for c, e in zip(clocks, self.earliest[u], strict=True))
        late = any(c > e for c, e in zip(clocks, self.latest[u], strict=True))
        if clocks[MISSION_CLOCK] < self.forbidden_until[u, mask] or late:
            return AutomatonState(FAILED, _three(clocks))
        if counted and early:
            return AutomatonState(u if self.patient[u] else FAILED, _three(clocks))
        after = (0 if reset else c for c, reset in zip(clocks, self.resets[u, mask], strict=True))
        return AutomatonState(int(self.next_location[u, mask]), _three(tuple(after)))

    def run(self, masks: ArrayLike) -> AutomatonState:
        """The state after reading the labels of ticks 0, 1, ... in order."""
        state = AutomatonState(self.initial, BEFORE_START)
        for mask in np.asarray(masks):
            state = self.advance(state, int(mask))
        return state


def _three(clocks: tuple[int, ...]) -> tuple[int, int, int]:
    return (clocks[0], clocks[1], clocks[2])


def masks_of(regions: tuple[Region, ...], points: ArrayLike) -> NDArray[np.int32]:
    """``[N]``: bit p is set where a point ``[N, D]`` (metres) lies in ``regions[p]``."""
    p = np.atleast_2d(np.asarray(points, dtype=np.float64))
    found = np.zeros(len(p), dtype=np.int32)
    for bit, region in enumerate(regions):
        found |= region.contains(p).astype(np.int32) << bit
    return found
