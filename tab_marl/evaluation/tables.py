"""From rows to the figures that the console and the report show. Reads rows and nothing else."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import pandas as pd

from tab_marl.evaluation.rows import EpisodeRow, Timing
from tab_marl.evaluation.settings import FAMILIES, MISSIONS, PAPER_PLANNERS, PLANNERS
from tab_marl.evaluation.statistics import Interval, Paired, bootstrap_mean, frame, share
from tab_marl.evaluation.statistics.frames import ALL, cells, order, paired, slack_bin

__all__ = ["ALL", "Line", "Pace", "Share", "by_part", "lines", "order", "paces", "paces_by_mission", "slack_bin"]

Rows = Sequence[EpisodeRow] | pd.DataFrame


@dataclass(frozen=True)
class Line:
    """One planner on one mission of one family."""

    family: str
    mission: str
    planner: str
    episodes: int
    errors: int
    atcr: Interval
    """Share of episodes in which the mission was completed first."""
    steps: Interval
    """100 Hz steps to interception, censored at the horizon."""
    steps_if_intercepted: float | None
    intercepted: float
    mission_failed: float
    """Share in which the adversary broke its own mission, unintercepted until then."""
    fallbacks_per_episode: float
    atcr_against_headline: Paired | None = None
    """This planner minus TAB-POMCP over the episodes both played; None for TAB-POMCP itself."""
    steps_against_headline: Paired | None = None


@dataclass(frozen=True)
class Share:
    """ATCR and StI of one planner on a part of the episodes (an adversary, a bin of slack)."""

    family: str
    part: str
    planner: str
    atcr: Interval
    steps: Interval


@dataclass(frozen=True)
class Pace:
    """Decision times of one planner."""

    planner: str
    decisions: int
    mean_milliseconds: float
    p95_milliseconds: float
    """95th percentile over episodes of the slowest decision."""
    worst_milliseconds: float
    ratio: float | None
    """Mean over that of S-POMCP; of processor times where they were measured."""
    processor_milliseconds: float | None = None
    """Mean processor time of a decision, which other work on the machine does not lengthen."""


def scored(rows: Rows) -> pd.DataFrame:
    """The rows as `statistics.frame` makes them, unless they are that already."""
    return rows if isinstance(rows, pd.DataFrame) and "lost" in rows else frame(rows)


def lines(rows: Rows) -> list[Line]:
    """Every (family, mission, planner) with rows, then every (family, ALL, planner) where there are several missions."""
    table = scored(rows)
    against = paired(table)
    return [
        _line(family, mission, planner, part, against)
        for family, mission, parts in cells(table)
        for planner, part in parts.items()
    ]


def _line(
    family: str,
    mission: str,
    planner: str,
    part: pd.DataFrame,
    against: Mapping[tuple[str, str, str, str], Paired],
) -> Line:
    strata = part["mission"].tolist()
    caught = part.loc[part["met"] == 1, "sti"]
    return Line(
        family=family,
        mission=mission,
        planner=planner,
        episodes=len(part),
        errors=int(part["broken"].sum()),
        atcr=share(part["lost"], strata),
        steps=bootstrap_mean(part["sti"], strata),
        steps_if_intercepted=float(caught.mean()) if len(caught) else None,
        intercepted=float(part["intercepted"].mean()),
        mission_failed=float(part["failed"].mean()),
        fallbacks_per_episode=float(part["fallbacks"].mean()) if "fallbacks" in part else 0.0,
        atcr_against_headline=against.get((family, mission, planner, "ATCR")),
        steps_against_headline=against.get((family, mission, planner, "StI")),
    )


def by_part(rows: Rows, column: str) -> list[Share]:
    """ATCR and StI per family, part and planner, all missions together; rows whose part is missing are left out.

    `column`: "adversary", "slack_bin", "style", "split" or any other of the rows.
    """
    table = scored(rows)
    found = []
    for family in order(table["family"], FAMILIES):
        kept = table[(table["family"] == family) & table[column].notna() & (table[column].astype(str) != "")]
        groups = dict(list(kept.groupby([column, "planner"])))
        for part in order(kept[column].astype(str), MISSIONS):
            for planner in order(kept["planner"], PLANNERS):
                if (part, planner) in groups:
                    rows_of = groups[part, planner]
                    found.append(Share(family, part, planner, share(rows_of["lost"]), bootstrap_mean(rows_of["sti"])))
    return found


def where_ego_is_first(rows: Rows) -> list[Share]:
    """The sanity bar: episodes in which the ego could simply go to the only goal and wait."""
    table = scored(rows)
    return by_part(table[table["ego_first"]].assign(part="ego can be first"), "part")


def paces(timings: Mapping[tuple[str, str, str, int], Timing]) -> list[Pace]:
    """Decision times per planner, planners in the usual order."""
    groups: dict[str, list[Timing]] = defaultdict(list)
    for (_, _, planner, _), timing in timings.items():
        if timing.decisions and np.isfinite(timing.mean_decision_milliseconds):
            groups[planner].append(timing)
    clock, processor = {}, {}
    for planner, group in groups.items():
        decisions = sum(t.decisions for t in group)
        clock[planner] = sum(t.mean_decision_milliseconds * t.decisions for t in group) / decisions
        processor[planner] = 1000 * sum(t.decision_processor_seconds for t in group) / decisions
    base = PAPER_PLANNERS[0]
    # Processor time where both have it: other work on the machine does not lengthen it.
    found = []
    for planner in order(list(groups), PLANNERS):
        group = groups[planner]
        several = processor if np.isfinite([processor[planner], processor.get(base, np.nan)]).all() else clock
        found.append(
            Pace(
                planner,
                sum(t.decisions for t in group),
                clock[planner],
                float(np.quantile([t.max_decision_milliseconds for t in group], 0.95)),
                max(t.max_decision_milliseconds for t in group),
                several[planner] / several[base] if several.get(base) else None,
                processor[planner] if np.isfinite(processor[planner]) else None,
            )
        )
    return found


def paces_by_mission(timings: Mapping[tuple[str, str, str, int], Timing]) -> dict[str, list[Pace]]:
    """`paces` of each mission alone."""
    missions = order([key[0] for key in timings], MISSIONS)
    return {m: paces({key: t for key, t in timings.items() if key[0] == m}) for m in missions}
