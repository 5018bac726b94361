"""Decision times of TAB-POMCP beside those of S-POMCP at equal simulations, per mission: the paper says 1.4 times."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tab_marl.evaluation.rows import Timing
from tab_marl.evaluation.statistics.intervals import CONFIDENCE, RESAMPLES, Interval
from tab_marl.evaluation.units import Key

PLAIN = "S-POMCP"
TASK_AWARE = "TAB-POMCP"
PAPER_RATIO = 1.4
LIMIT = 1.05
_SEED = 20250102


@dataclass(frozen=True)
class Comparison:
    """One mission's decision times, over the episodes that both planners played."""

    mission: str
    plain_milliseconds: float
    """S-POMCP's mean decision, processor time."""
    task_aware_milliseconds: float
    """TAB-POMCP's."""
    ratio: Interval
    """Of the two, with a bootstrap interval over paired episodes."""
    with_preparation: float
    """The same ratio with what precedes the first decision (the field's solution among it) spread over the decisions."""

    @property
    def verdict(self) -> str:
        """Whether the ratio keeps below the limit, as far as the interval tells."""
        if self.ratio.high <= LIMIT:
            return f"<= {LIMIT}"
        return f"> {LIMIT}" if self.ratio.low > LIMIT else f"not clear of {LIMIT}"


def compare(timings: Mapping[Key, Timing]) -> list[Comparison]:
    """Per mission, where both planners played at least two common episodes whose processor time was measured."""
    pairs: dict[str, list[tuple[Timing, Timing]]] = defaultdict(list)
    for (mission, family, planner, seed), timing in timings.items():
        other = timings.get((mission, family, TASK_AWARE, seed))
        if planner == PLAIN and other is not None and _measured(timing) and _measured(other):
            pairs[mission].append((timing, other))
    return [_compared(mission, found) for mission, found in sorted(pairs.items()) if len(found) >= 2]


def _measured(timing: Timing) -> bool:
    return timing.decisions > 0 and bool(np.isfinite(timing.decision_processor_seconds))


def _compared(mission: str, pairs: Sequence[tuple[Timing, Timing]]) -> Comparison:
    # [pairs, (S, TAB)]: all decisions weigh the same, so sums are divided, not episodes' means averaged.
    spent = np.array([[t.decision_processor_seconds for t in pair] for pair in pairs])
    decisions = np.array([[t.decisions for t in pair] for pair in pairs], dtype=np.float64)
    prepared = np.array([[t.preparation_processor_seconds for t in pair] for pair in pairs])
    draws = np.random.default_rng(_SEED).integers(len(pairs), size=(RESAMPLES, len(pairs)))
    low, high = np.quantile(
        _ratio(spent[draws].sum(axis=1), decisions[draws].sum(axis=1)), [(1 - CONFIDENCE) / 2, (1 + CONFIDENCE) / 2]
    )
    each = 1000 * spent.sum(axis=0) / decisions.sum(axis=0)
    value = float(each[1] / each[0])
    whole = float(_ratio((spent + prepared).sum(axis=0), decisions.sum(axis=0)))
    return Comparison(
        mission,
        float(each[0]),
        float(each[1]),
        Interval(value, min(float(low), value), max(float(high), value), len(pairs)),
        whole,
    )


def _ratio(spent: NDArray[np.float64], decisions: NDArray[np.float64]) -> NDArray[np.float64]:
    """``[..., (S, TAB)]`` seconds and decisions -> TAB's seconds per decision over S's."""
    each = spent / decisions
    return np.asarray(each[..., 1] / each[..., 0])


def summary(timings: Mapping[Key, Timing]) -> list[str]:
    """Lines for the end of a run; none if it has no pair of the two planners."""
    found = compare(timings)
    if not found:
        return []
    heading = (
        f"Decision time of {TASK_AWARE} over {PLAIN}'s at equal simulations (processor time, 95 % interval over paired "
        f"episodes; the paper: {PAPER_RATIO}; wanted: <= {LIMIT}):"
    )
    lines = [heading]
    for c in found:
        lines.append(
            f"  {c.mission}  {c.ratio.value:.2f} [{c.ratio.low:.2f}, {c.ratio.high:.2f}]  {c.verdict}   "
            f"({c.task_aware_milliseconds:.1f} ms and {c.plain_milliseconds:.1f} ms, {c.ratio.count} pairs; with the "
            f"preparation before the first decision spread over all: {c.with_preparation:.2f})"
        )
    return lines
