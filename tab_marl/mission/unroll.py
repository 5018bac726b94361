"""The automaton with its clocks unrolled in ticks: a finite automaton for the field's products."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tab_marl.mission import kernels
from tab_marl.mission.automaton import ALWAYS_FORBIDDEN, COMPLETED, MISSION_CLOCK, UNBOUNDED, MissionAutomaton

if TYPE_CHECKING:
    from tab_marl.mission.joint import JointAutomaton

MOST_STATES = 4_000_000
"""An automaton that unrolls to more states is refused: its tables alone would take gigabytes."""
UNTRACKED = -1
"""`mission_ticks` of a state whose mission clock does not matter from there on."""


class AutomatonTooLarge(ValueError):
    """Unrolled in ticks the automaton would have no bound, or too many states; says how many."""


@dataclass(frozen=True, eq=False)
class TickAutomaton:
    """Q states over L label symbols; acyclic but for the two absorbing states."""

    delta: NDArray[np.int32]
    """``[Q, L]`` next state."""
    masks: NDArray[np.int32]
    """``[L]`` symbol -> mask of the automaton's regions, rising."""
    initial: int
    """The state before tick 0; the state at tick 0 is ``delta[initial, symbol of the first cell]``."""
    accepting: int
    rejecting: int
    rank: NDArray[np.int32]
    """``[Q]``: strictly increases along transitions between transient states (longest path from `initial`)."""
    location: NDArray[np.int32]
    """``[Q]`` location of the automaton; COMPLETED and FAILED in the absorbing states."""
    branch: NDArray[np.int32]
    """``[Q, L]`` place visited by this transition, index into the automaton's `branch_places`, or NO_BRANCH."""
    mission_ticks: NDArray[np.int32]
    """``[Q]`` mission clock, UNTRACKED where it no longer matters."""
    stage_ticks: NDArray[np.int32]
    """``[Q]`` ticks since the current goal (or the last visit, where that is the clock that matters); 0 if neither."""
    speed_limit: NDArray[np.float64]
    """``[Q]`` m/s, inf if none."""
    clocks: NDArray[np.int32]
    """``[Q, 3]`` the clocks as kept: no further than they matter from this state on."""
    sides: tuple[int, ...] = ()
    """``[B]`` which of several missions a branch belongs to (places of different ones cannot stand for one another);
    empty: all to one."""

    @property
    def states(self) -> int:
        """Q."""
        return len(self.delta)

    def symbols(self, masks: ArrayLike) -> NDArray[np.int32]:
        """``[N]`` symbol of each mask. Raises ValueError for a mask that was not among those given to `unroll`."""
        asked = np.asarray(masks, dtype=np.int32)
        found = np.minimum(np.searchsorted(self.masks, asked), len(self.masks) - 1)
        if not np.array_equal(self.masks[found], asked):
            unknown = np.unique(asked[self.masks[found] != asked])
            raise ValueError(f"labels {unknown.tolist()} were not among those unrolled ({self.masks.tolist()})")
        return found.astype(np.int32)


def unroll(
    automaton: MissionAutomaton | JointAutomaton, horizon_ticks: int | None, masks: ArrayLike | None = None
) -> TickAutomaton:
    """Unroll the clocks that matter. The mission fails at the first tick beyond the horizon.

    Args:
        automaton: of one mission, or of several that are all to be completed.
        horizon_ticks: None where the mission bounds itself.
        masks: the labels that occur (any shape, repeats allowed; default all 2**P). Only states that some word of
            these labels reaches are made.
    Raises:
        AutomatonTooLarge: no bound, or more than `MOST_STATES` states; with the size it would need.
    """
    if horizon_ticks is not None and horizon_ticks < 0:
        raise ValueError(f"horizon_ticks is {horizon_ticks}, must be >= 0")
    if not isinstance(automaton, MissionAutomaton):
        return automaton.unrolled(horizon_ticks, masks)
    labels = automaton.next_location.shape[1]
    symbols = np.unique(np.arange(labels) if masks is None else np.asarray(masks)).astype(np.int32)
    if len(symbols) == 0 or symbols[0] < 0 or symbols[-1] >= labels:
        raise ValueError(f"masks must be a non-empty set of labels in 0..{labels - 1}, got {symbols.tolist()}")
    latest = automaton.latest
    # Every location ends by itself, within the horizon on every path? Then the horizon needs no clock of its own.
    bounded_itself = (latest < UNBOUNDED).any(axis=1)
    if bounded_itself.all():
        found = _unrolled(automaton, latest, symbols)
        # A state of depth d is reached at tick d - 1 at the latest, and left for good one tick later.
        if horizon_ticks is None or int(found.rank[: found.accepting].max()) <= horizon_ticks:
            return found
    if horizon_ticks is None:
        waiting = int(np.flatnonzero(~bounded_itself)[0])
        sizes = [unroll(automaton, ticks, symbols).states for ticks in (100, 200)]
        raise AutomatonTooLarge(
            f"the mission has no bound (location {waiting} may wait for ever), so unrolled it has no end: {sizes[0]:,} "
            f"states for a horizon of 100 ticks, {sizes[1]:,} for 200; give horizon_ticks, or the mission a deadline"
        )
    bounded = latest.copy()
    bounded[:, MISSION_CLOCK] = np.minimum(bounded[:, MISSION_CLOCK], horizon_ticks)
    return _unrolled(automaton, bounded, symbols)


def _caps(automaton: MissionAutomaton, latest: NDArray[np.int32], symbols: NDArray[np.int32]) -> NDArray[np.int32]:
    """``[U, 3]``: beyond which value each clock makes no difference from this location on (0: it never does)."""
    forbidden = automaton.forbidden_until[:, symbols]
    caps = np.maximum(automaton.earliest, np.where(latest < UNBOUNDED, latest + 1, 0)).astype(np.int32)
    timed = np.where(forbidden < ALWAYS_FORBIDDEN, forbidden, 0).max(axis=1)
    caps[:, MISSION_CLOCK] = np.maximum(caps[:, MISSION_CLOCK], timed)
    for u in range(automaton.locations - 1, -1, -1):  # transitions lead to later locations
        for symbol in symbols:
            following = int(automaton.next_location[u, symbol])
            if following > u:
                kept = np.where(automaton.resets[u, symbol], 0, caps[following])
                caps[u] = np.maximum(caps[u], kept)
    return caps


def states_at_most(caps: NDArray[np.int32]) -> int:
    """How many (location, clocks) there can be, clocks kept up to ``caps[U, 3]``.

    The visit clock never runs ahead of the stage clock, nor that of the mission clock: each is reset with those after it.
    """
    total = 0
    for mission, stage, visit in caps.tolist():
        s = np.arange(stage + 1)
        # Mission clocks that a stage clock allows, the kept stage clock being exact below its cap.
        per_stage = np.maximum(1, mission - np.minimum(s, mission) + 1)
        from_stage = np.cumsum(per_stage[::-1])[::-1]
        total += int(from_stage[np.minimum(np.arange(visit + 1), stage)].sum())
    return total + 1


def _unrolled(automaton: MissionAutomaton, latest: NDArray[np.int32], symbols: NDArray[np.int32]) -> TickAutomaton:
    caps = _caps(automaton, latest, symbols)
    tables = (
        automaton.next_location, automaton.forbidden_until, automaton.progress, automaton.patient, automaton.earliest,
        latest.astype(np.int32), automaton.resets,
    )  # fmt: skip
    capacity = 1024
    while True:
        count, location, clocks, delta = kernels.unroll(*tables, automaton.initial, caps, symbols, capacity)
        if count >= 0:
            break
        if capacity == MOST_STATES:
            raise AutomatonTooLarge(
                f"unrolled in ticks of {automaton.tick_seconds:g} s the mission's automaton has more than "
                f"{MOST_STATES:,} states, and up to {states_at_most(caps):,}: its clocks run to "
                f"{', '.join(f'{c:,}' for c in caps.max(axis=0))} ticks (mission, stage, visit); use shorter bounds, "
                "a shorter horizon or longer ticks"
            )
        capacity = min(4 * capacity, MOST_STATES)
    # Locations are numbered forwards, and within one location some kept clock grows with every tick.
    order = np.lexsort((clocks.sum(axis=1), location)).astype(np.int32)
    rank = kernels.longest_depth(delta, order)
    return _with_absorbing_states(automaton, symbols, caps, location, clocks, delta, rank)


def _with_absorbing_states(
    automaton: MissionAutomaton,
    symbols: NDArray[np.int32],
    caps: NDArray[np.int32],
    location: NDArray[np.int32],
    clocks: NDArray[np.int32],
    delta: NDArray[np.int32],
    rank: NDArray[np.int32],
) -> TickAutomaton:
    count = len(location)
    accepting, rejecting = count, count + 1
    transient = np.where(delta == COMPLETED, accepting, np.where(delta < 0, rejecting, delta))
    absorbing = np.repeat([[accepting], [rejecting]], len(symbols), axis=1)
    branch = np.where(transient == rejecting, -1, automaton.branch[location][:, symbols])
    # An early visit to a patient location is no visit: it stays where it is.
    stays = location[np.minimum(transient, count - 1)] == location[:, None]
    moved = (transient >= count) | ~stays
    branch = np.where(moved, branch, -1)
    tracked = caps[location] > 0
    kept = np.where(tracked, clocks, 0)
    last_rank = int(rank.max(initial=0)) + 1
    return TickAutomaton(
        delta=np.concatenate([transient, absorbing]).astype(np.int32),
        masks=symbols,
        initial=0,
        accepting=accepting,
        rejecting=rejecting,
        rank=np.concatenate([rank, [last_rank, last_rank]]).astype(np.int32),
        location=np.concatenate([location, [-1, -2]]).astype(np.int32),
        branch=np.concatenate([branch, np.full((2, len(symbols)), -1)]).astype(np.int32),
        mission_ticks=np.concatenate([np.where(tracked[:, 0], clocks[:, 0], UNTRACKED), [UNTRACKED] * 2]).astype(
            np.int32
        ),
        stage_ticks=np.concatenate([np.maximum(kept[:, 1], kept[:, 2]), [0, 0]]).astype(np.int32),
        speed_limit=np.concatenate([automaton.speed_limit[location], [np.inf, np.inf]]),
        clocks=np.concatenate([clocks, np.zeros((2, 3))]).astype(np.int32),
    )
