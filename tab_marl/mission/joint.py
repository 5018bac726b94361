"""Several missions at once: all must be completed, and failing one fails them all. Products of automata."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tab_marl.mission import kernels
from tab_marl.mission.automaton import NO_BRANCH, MissionAutomaton, masks_of
from tab_marl.mission.compile import compile_mission
from tab_marl.mission.model import Mission
from tab_marl.mission.places import MissionWorld
from tab_marl.mission.unroll import MOST_STATES, UNTRACKED, AutomatonTooLarge, TickAutomaton, unroll
from tab_marl.world.regions import Region

MOST_REGIONS = 31
"""Of all missions together: a mask is one 32-bit number."""


@dataclass(frozen=True, eq=False)
class JointAutomaton:
    """The automata of missions that run side by side, over the regions of all of them."""

    parts: tuple[MissionAutomaton, ...]
    regions: tuple[Region, ...]
    """Bit p of a mask: inside ``regions[p]``."""
    branch_places: tuple[str, ...]
    """Those of the parts, one after another; of a place that several missions name, the later ones say which."""

    @property
    def tick_seconds(self) -> float:
        return self.parts[0].tick_seconds

    def masks(self, points: ArrayLike) -> NDArray[np.int32]:
        """``[N]`` labels of points ``[N, D]`` in metres."""
        return masks_of(self.regions, points)

    def masks_of_part(self, part: int, masks: ArrayLike) -> NDArray[np.int32]:
        """``[N]``: the joint masks as that mission sees them."""
        joint = np.asarray(masks, dtype=np.int32)
        seen = np.zeros(joint.shape, dtype=np.int32)
        for bit, region in enumerate(self.parts[part].regions):
            seen |= ((joint >> self.regions.index(region)) & 1) << bit
        return seen

    def unrolled(self, horizon_ticks: int | None, masks: ArrayLike | None = None) -> TickAutomaton:
        """See `unroll`. Without `masks` all 2**P labels are taken to occur."""
        symbols = np.unique(np.arange(1 << len(self.regions)) if masks is None else np.asarray(masks)).astype(np.int32)
        if len(symbols) == 0 or symbols[0] < 0 or int(symbols[-1]) >= 1 << len(self.regions):
            raise ValueError(f"masks must be a non-empty set of labels below 2**{len(self.regions)}, got {symbols}")
        automata = []
        for number, part in enumerate(self.parts):
            seen = self.masks_of_part(number, symbols)
            alone = unroll(part, horizon_ticks, seen)
            column = alone.symbols(seen)
            automata.append(replace(alone, masks=symbols, delta=alone.delta[:, column], branch=alone.branch[:, column]))
        return _product(automata, [len(part.branch_places) for part in self.parts])


def compile_joint(
    missions: Sequence[Mission], world: MissionWorld, tick_seconds: float | None = None
) -> JointAutomaton:
    """The automaton of missions that must all be completed. Raises as `compile_mission`, and for too many regions."""
    if not missions:
        raise ValueError("missions is empty: give at least one")
    parts = tuple(compile_mission(mission, world, tick_seconds) for mission in missions)
    regions = tuple(dict.fromkeys(region for part in parts for region in part.regions))
    if len(regions) > MOST_REGIONS:
        raise ValueError(
            f"the missions speak of {len(regions)} distinct regions, at most {MOST_REGIONS} can be told apart: "
            "name fewer places"
        )
    names: list[str] = []
    for number, part in enumerate(parts, start=1):
        names += [f"{name} (mission {number})" if name in names else name for name in part.branch_places]
    return JointAutomaton(parts, regions, tuple(names))


def conjunction(*automata: TickAutomaton) -> TickAutomaton:
    """Accepts where all of them have accepted, at the tick at which the last one does; rejects as soon as one rejects.

    All must read the same symbols (`masks`). Only pairs of states that some word reaches are made. Branches are numbered one automaton after another; where two visits fall on one tick, the first
    automaton's is the one counted. The slower of two speed limits holds.

    Raises:
        ValueError: the symbols differ.
        AutomatonTooLarge: more than `MOST_STATES` states.
    """
    if not automata:
        raise ValueError("conjunction needs at least one automaton")
    return _product(automata, [int(one.branch.max(initial=NO_BRANCH)) + 1 for one in automata])


def _product(automata: Sequence[TickAutomaton], branches: Sequence[int]) -> TickAutomaton:
    """`conjunction` of automata with so many branches each."""
    product, sides = automata[0], _sides(automata[0], branches[0])
    for number in range(1, len(automata)):
        product = _pair(product, automata[number], len(sides))
        next_side = max(sides, default=-1) + 1
        sides += tuple(next_side + side for side in _sides(automata[number], branches[number]))
    return replace(product, sides=sides)


def _sides(automaton: TickAutomaton, branches: int) -> tuple[int, ...]:
    return automaton.sides or (0,) * branches


def _pair(a: TickAutomaton, b: TickAutomaton, shift: int) -> TickAutomaton:
    """The product of two, the second one's branches numbered from `shift`."""
    if not np.array_equal(a.masks, b.masks):
        raise ValueError(
            f"conjunction: the automata read different symbols ({a.masks.tolist()[:20]} and {b.masks.tolist()[:20]}): "
            "unroll both with the same masks"
        )
    first, second = _reachable_pairs(a, b)
    count = len(first)
    accepting, rejecting = count, count + 1
    code = first * b.states + second
    order = np.argsort(code)
    after_a, after_b = a.delta[first].astype(np.int64), b.delta[second].astype(np.int64)
    following = after_a * b.states + after_b
    at = np.minimum(np.searchsorted(code[order], following), count - 1)
    known = code[order][at] == following
    delta = np.where(known, order[at], rejecting)
    delta[(after_a == a.accepting) & (after_b == b.accepting)] = accepting
    delta = np.concatenate([delta, np.repeat([[accepting], [rejecting]], len(a.masks), axis=1)]).astype(np.int32)
    counted = np.where(b.branch[second] >= 0, b.branch[second] + shift, NO_BRANCH)
    counted = np.where(a.branch[first] >= 0, a.branch[first], counted)
    branch = np.full(delta.shape, NO_BRANCH, dtype=np.int32)
    branch[:count] = np.where(delta[:count] == rejecting, NO_BRANCH, counted)
    # Sums of ranks rise along transitions: at least one part moves on, and none falls back.
    topological = np.argsort(a.rank[first].astype(np.int64) + b.rank[second], kind="stable").astype(np.int32)
    inner = np.where(delta[:count] >= count, -1, delta[:count]).astype(np.int32)
    rank = kernels.longest_depth(inner, topological)
    last = int(rank.max(initial=0)) + 1
    locations_of_b = int(b.location.max()) + 2
    location = (a.location[first].astype(np.int64) + 1) * locations_of_b + b.location[second] + 1
    _, location = np.unique(location, return_inverse=True)
    both = [(x.mission_ticks[p], x.stage_ticks[p]) for x, p in ((a, first), (b, second))]
    return TickAutomaton(
        delta=delta,
        masks=a.masks,
        initial=0,
        accepting=accepting,
        rejecting=rejecting,
        rank=np.append(rank, [last, last]).astype(np.int32),
        location=np.append(location.ravel(), [-1, -2]).astype(np.int32),
        branch=branch,
        mission_ticks=np.append(np.maximum(both[0][0], both[1][0]), [UNTRACKED] * 2).astype(np.int32),
        stage_ticks=np.append(np.minimum(both[0][1], both[1][1]), [0, 0]).astype(np.int32),
        speed_limit=np.append(np.minimum(a.speed_limit[first], b.speed_limit[second]), [np.inf, np.inf]),
        clocks=np.concatenate([np.maximum(a.clocks[first], b.clocks[second]), np.zeros((2, 3))]).astype(np.int32),
    )


def _reachable_pairs(a: TickAutomaton, b: TickAutomaton) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """States of a and of b that occur together before both have accepted, none rejected; the initial pair first."""
    width = b.states
    frontier = np.array([a.initial * width + b.initial], dtype=np.int64)
    seen = frontier
    found = [frontier]
    while len(frontier):
        after_a, after_b = a.delta[frontier // width], b.delta[frontier % width]
        open_pairs = (after_a != a.rejecting) & (after_b != b.rejecting)
        open_pairs &= (after_a != a.accepting) | (after_b != b.accepting)
        following = np.unique(after_a[open_pairs].astype(np.int64) * width + after_b[open_pairs])
        frontier = np.setdiff1d(following, seen, assume_unique=True)
        seen = np.union1d(seen, frontier)
        found.append(frontier)
        if len(seen) > MOST_STATES:
            raise AutomatonTooLarge(
                f"the product of automata of {a.states:,} and {b.states:,} states has more than {MOST_STATES:,} states "
                f"(up to {a.states * b.states:,}): use shorter bounds, a shorter horizon or longer ticks"
            )
    pairs = np.concatenate(found)
    return pairs // width, pairs % width
