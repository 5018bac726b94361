"""Before a run: how wide its intervals will be, how many episodes narrower ones need, and how long it will take."""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.stats import norm

from tab_marl.evaluation.rows import EpisodeRow, Timing, scored_completed, scored_steps
from tab_marl.evaluation.settings import HEADLINE, MISSIONS
from tab_marl.evaluation.statistics.intervals import CONFIDENCE
from tab_marl.evaluation.units import Key

MOST_EPISODES = 10**9
PILOT_PAIRS = 10
"""Fewer stored pairs than these say too little about their spread."""

# Processor seconds per episode (mean of `point` and `ambiguous`) and milliseconds per decision of TAB-POMCP on M1, on the
# machine where they were measured: what an estimate rests on while nothing is stored. `speed_of` corrects for the machine.
COSTS: Mapping[str, tuple[float, ...]] = {
    "S-POMCP": (0.60, 1.00, 0.77, 0.60, 1.15),
    "FP-POMCP": (0.21, 0.59, 0.19, 0.22, 0.41),
    "MLE-POMCP": (0.37, 1.18, 0.26, 0.31, 0.59),
    "TAB-POMCP": (0.78, 1.25, 1.32, 0.79, 2.55),
    "TAB-POMCP+precedents": (0.50, 1.24, 0.90, 0.51, 1.47),
    "population-POMCP": (0.45, 1.09, 0.80, 0.46, 1.29),
    "oracle": (0.24, 0.67, 0.31, 0.22, 0.47),
    "random": (0.05, 0.10, 0.08, 0.05, 0.10),
}
REFERENCE_DECISION_MILLISECONDS = 18.0


def wilson_half_width(share: float, episodes: int, confidence: float = CONFIDENCE) -> float:
    """Half the width of Wilson's (1927) interval of a share, were it seen in so many episodes."""
    z = float(norm.ppf((1 + confidence) / 2))
    return z * math.sqrt(share * (1 - share) / episodes + z**2 / (4 * episodes**2)) / (1 + z**2 / episodes)


def episodes_for_share(half_width: float, share: float, confidence: float = CONFIDENCE) -> int:
    """The least number of episodes whose Wilson interval is no wider than +- `half_width` (0.05: five points).

    Raises ValueError unless half_width lies in (0, 0.5) and share in [0, 1].
    """
    if not 0 < half_width < 0.5:
        raise ValueError(f"half_width is {half_width}, must lie in (0, 0.5): 0.05 is five points of a percentage")
    if not 0 <= share <= 1:
        raise ValueError(f"share is {share}, must lie in [0, 1]")
    low, high = 0, 1
    while wilson_half_width(share, high, confidence) > half_width:
        low, high = high, 2 * high
    while high - low > 1:  # the width falls with the number of episodes
        middle = (low + high) // 2
        if wilson_half_width(share, middle, confidence) > half_width:
            low = middle
        else:
            high = middle
    return high


def episodes_for_mean(half_width: float, deviation: float, confidence: float = CONFIDENCE) -> int:
    """How many episodes (or pairs) bring a mean's normal interval down to +- `half_width`, in the deviation's unit.

    Raises ValueError unless half_width > 0 and deviation >= 0.
    """
    if half_width <= 0 or deviation < 0:
        raise ValueError(f"half_width is {half_width} and deviation {deviation}: must be > 0 and >= 0")
    z = float(norm.ppf((1 + confidence) / 2))
    return min(MOST_EPISODES, max(2, math.ceil((z * deviation / half_width) ** 2)))


@dataclass(frozen=True)
class Spread:
    """How much one planner's episodes differ from TAB-POMCP's, in stored pairs."""

    mission: str
    family: str
    planner: str
    pairs: int
    completed: float
    """Standard deviation of the paired difference of completed missions (0 or 1)."""
    steps: float
    """Of the steps to interception."""


def spreads(rows: Iterable[EpisodeRow], against: str = HEADLINE) -> list[Spread]:
    """The spread of every (mission, family, planner) with at least `PILOT_PAIRS` stored pairs."""
    by_planner: dict[tuple[str, str, str], dict[int, EpisodeRow]] = defaultdict(dict)
    for row in rows:
        by_planner[row.mission, row.family, row.planner][row.seed] = row
    found = []
    for (mission, family, planner), own in by_planner.items():
        other = by_planner.get((mission, family, against), {})
        seeds = sorted(own.keys() & other.keys())
        if planner == against or len(seeds) < PILOT_PAIRS:
            continue
        done = [float(scored_completed(own[s])) - float(scored_completed(other[s])) for s in seeds]
        steps = [float(scored_steps(own[s]) - scored_steps(other[s])) for s in seeds]
        found.append(
            Spread(mission, family, planner, len(seeds), float(np.std(done, ddof=1)), float(np.std(steps, ddof=1)))
        )
    return found


@dataclass(frozen=True)
class Cost:
    """What is left to play, and what it will cost."""

    episodes: int
    processor_seconds: float
    source: str
    """What the estimate rests on."""

    def seconds(self, workers: int) -> float:
        """On so many processors."""
        return self.processor_seconds / max(1, workers)


def estimate(missing: Sequence[Key], timings: Mapping[Key, Timing], speed: float | None = None) -> Cost:
    """The cost of these episodes, from stored ones of the same mission and planner where there are any.

    Args:
        missing: the episodes to be played.
        timings: of stored episodes.
        speed: how much slower than the reference this machine is (`speed_of`); None: as fast.
    """
    seen: dict[tuple[str, str], list[float]] = defaultdict(list)
    for (mission, _, planner, _), timing in timings.items():
        spent = timing.processor_seconds if math.isfinite(timing.processor_seconds) else timing.seconds
        seen[mission, planner].append(spent)
    # Where a pair was never seen, the reference tells, corrected by how the seen ones compare with it.
    ratios = [np.mean(v) / _reference(m, p) for (m, p), v in seen.items()]
    factor = float(np.median(ratios)) if ratios else (1.0 if speed is None else speed)
    total = 0.0
    for mission, _, planner, _ in missing:
        known = seen.get((mission, planner))
        total += float(np.mean(known)) if known else factor * _reference(mission, planner)
    if seen:
        source = f"from {sum(map(len, seen.values()))} stored episodes"
    else:
        source = "from a few decisions just played" if speed is not None else "from another machine's figures"
    return Cost(len(missing), total, source)


def _reference(mission: str, planner: str) -> float:
    return COSTS[planner][MISSIONS.index(mission)]


def speed_of(decision_milliseconds: float) -> float:
    """How much slower than the reference a machine is that takes so long for a decision of TAB-POMCP on M1."""
    return decision_milliseconds / REFERENCE_DECISION_MILLISECONDS


def forecast(episodes: int, half_width: float, rows: Sequence[EpisodeRow], cost: Cost, workers: int) -> list[str]:
    """What to print before a run: its size and time, the intervals it will have, what narrower ones need.

    Args:
        episodes: per mission, family and planner.
        half_width: the wanted half width of a share's interval, as a share (0.05: five points).
        rows: stored episodes, a pilot for the paired differences.
        cost: of what is missing.
        workers: processes, or processors of the cluster; 0 if not known yet.
    """
    each = cost.processor_seconds / max(1, cost.episodes)
    spent = f"{each:.2f} s of processor time each, {cost.source}"
    when = f"about {words(cost.seconds(workers))} with {workers} worker{'s' * (workers != 1)}" if workers else ""
    lines = [f"to play: {cost.episodes} episodes, {when + ' (' + spent + ')' if when else spent}"]
    points = 100 * half_width
    lines.append(
        f"intervals (95 %): with {episodes} episodes an ATCR of 10 % is known to +- {100 * wilson_half_width(0.1, episodes):.1f} "
        f"points, one of 50 % to +- {100 * wilson_half_width(0.5, episodes):.1f}; +- {points:g} points need "
        f"{episodes_for_share(half_width, 0.1)} episodes at 10 %, {episodes_for_share(half_width, 0.5)} at 50 %"
    )
    pilot = spreads(rows)
    if pilot:
        widest = max(pilot, key=lambda s: s.completed)
        z = float(norm.ppf((1 + CONFIDENCE) / 2))
        now = 100 * z * widest.completed / math.sqrt(episodes)
        lines.append(
            f"differences from {HEADLINE}, by the spread of {widest.pairs} stored pairs where it is widest ({widest.planner}, "
            f"{widest.mission} {widest.family}): ATCR to +- {now:.1f} points with {episodes} episodes; +- {points:g} need "
            f"{episodes_for_mean(half_width, widest.completed)}"
        )
        slowest = max(pilot, key=lambda s: s.steps)
        now = z * slowest.steps / math.sqrt(episodes)
        lines.append(
            f"  and StI ({slowest.planner}, {slowest.mission} {slowest.family}) to +- {now:.0f} steps; +- {max(1.0, now / 2):.0f} need "
            f"{episodes_for_mean(max(1.0, now / 2), slowest.steps)}"
        )
    return lines


def words(seconds: float) -> str:
    """A duration, roughly: "40 s", "12 min", "1 h 50 min"."""
    if seconds < 90:
        return f"{max(1, round(seconds))} s"
    minutes = round(seconds / 60)
    return f"{minutes} min" if minutes < 90 else f"{minutes // 60} h {minutes % 60:02d} min"
