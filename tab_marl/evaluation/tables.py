"""From rows to the figures that the console and the report show. Reads rows and nothing else."""

from __future__ import annotations

import itertools
from collections import defaultdict
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from tab_marl.evaluation import statistics
from tab_marl.evaluation.rows import EpisodeRow, Timing, scored_completed, scored_steps
from tab_marl.evaluation.settings import FAMILIES, HEADLINE, MISSIONS, PAPER_PLANNERS, PLANNERS
from tab_marl.evaluation.statistics import Interval, Paired

ALL = "all"
"""In place of a mission: the mean over the missions, each with equal weight."""

SLACK_EDGES = (1.3, 1.6, 2.0)
"""Bounds between the bins of the table by slack."""


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
    """ATCR of one planner on a part of the episodes (an adversary, a bin of slack)."""

    family: str
    part: str
    planner: str
    atcr: Interval


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
    """Mean over that of S-POMCP."""


def order(names: Iterable[str], known: Sequence[str]) -> list[str]:
    """Each once, in the order of `known`, strangers last by name."""
    return sorted(set(names), key=lambda n: (known.index(n) if n in known else len(known), n))


def lines(rows: Sequence[EpisodeRow]) -> list[Line]:
    """Every (family, mission, planner) with rows, then every (family, ALL, planner) where there are several missions."""
    cells: dict[tuple[str, str, str], list[EpisodeRow]] = defaultdict(list)
    for row in rows:
        cells[row.family, row.mission, row.planner].append(row)
    found = []
    for family in order((r.family for r in rows), FAMILIES):
        missions = order((r.mission for r in rows if r.family == family), MISSIONS)
        for mission in missions + ([ALL] if len(missions) > 1 else []):
            members = missions if mission == ALL else [mission]
            part = {
                planner: [row for m in members for row in cells.get((family, m, planner), ())]
                for planner in order((r.planner for r in rows), PLANNERS)
            }
            found += [_line(family, mission, p, part[p], part.get(HEADLINE, [])) for p in part if part[p]]
    return found


def _line(family: str, mission: str, planner: str, rows: list[EpisodeRow], headline: list[EpisodeRow]) -> Line:
    strata = [r.mission for r in rows]
    caught = [r.physics_steps for r in rows if r.intercepted and r.error is None]
    atcr_pair = steps_pair = None
    if planner != HEADLINE:
        other = {(r.mission, r.seed): r for r in headline}
        both = [(r, other[r.mission, r.seed]) for r in rows if (r.mission, r.seed) in other]
        if both:
            mine, theirs = zip(*both, strict=True)
            where = [r.mission for r in mine]
            atcr_pair = statistics.paired_shares(
                [scored_completed(r) for r in mine], [scored_completed(r) for r in theirs], where
            )
            steps_pair = statistics.paired_steps(
                [scored_steps(r) for r in mine], [scored_steps(r) for r in theirs], where
            )
    return Line(
        family=family,
        mission=mission,
        planner=planner,
        episodes=len(rows),
        errors=sum(r.error is not None for r in rows),
        atcr=statistics.share([scored_completed(r) for r in rows], strata),
        steps=statistics.bootstrap_mean([scored_steps(r) for r in rows], strata),
        steps_if_intercepted=float(np.mean(caught)) if caught else None,
        intercepted=float(np.mean([r.intercepted for r in rows])),
        mission_failed=float(np.mean([r.failed for r in rows])),
        fallbacks_per_episode=float(np.mean([r.fallbacks for r in rows])),
        atcr_against_headline=atcr_pair,
        steps_against_headline=steps_pair,
    )


def by_part(rows: Sequence[EpisodeRow], part: Callable[[EpisodeRow], str | None]) -> list[Share]:
    """ATCR per family, part and planner, all missions together; rows whose part is None are left out."""
    cells: dict[tuple[str, str, str], list[EpisodeRow]] = defaultdict(list)
    for row in rows:
        name = part(row)
        if name is not None:
            cells[row.family, name, row.planner].append(row)
    parts = sorted({p for _, p, _ in cells})
    return [
        Share(f, p, planner, statistics.share([scored_completed(r) for r in cells[f, p, planner]]))
        for f in order((r.family for r in rows), FAMILIES)
        for p in parts
        for planner in order((r.planner for r in rows), PLANNERS)
        if (f, p, planner) in cells
    ]


def by_adversary(rows: Sequence[EpisodeRow]) -> list[Share]:
    return by_part(rows, lambda r: r.adversary or None)


def by_slack(rows: Sequence[EpisodeRow]) -> list[Share]:
    return by_part(rows, lambda r: slack_bin(r.slack))


def where_ego_is_first(rows: Sequence[EpisodeRow]) -> list[Share]:
    """The sanity bar: episodes in which the ego could simply go to the only goal and wait."""
    return by_part(rows, lambda r: "ego can be first" if r.ego_first else None)


def slack_bin(slack: float) -> str | None:
    """Text of the bin a slack falls in; None without a slack."""
    if not np.isfinite(slack):
        return None
    edges = (1.0, *SLACK_EDGES)
    for low, high in itertools.pairwise(edges):
        if slack < high:
            return f"{low:g} to {high:g}"
    return f"{edges[-1]:g} or more"


def paces(timings: dict[tuple[str, str, str, int], Timing]) -> list[Pace]:
    """Decision times per planner, planners in the usual order."""
    groups: dict[str, list[Timing]] = defaultdict(list)
    for (_, _, planner, _), timing in timings.items():
        if timing.decisions and np.isfinite(timing.mean_decision_milliseconds):
            groups[planner].append(timing)
    means = {
        planner: float(np.average([t.mean_decision_milliseconds for t in group], weights=[t.decisions for t in group]))
        for planner, group in groups.items()
    }
    base = means.get(PAPER_PLANNERS[0])
    return [
        Pace(
            planner,
            sum(t.decisions for t in groups[planner]),
            means[planner],
            float(np.quantile([t.max_decision_milliseconds for t in groups[planner]], 0.95)),
            max(t.max_decision_milliseconds for t in groups[planner]),
            means[planner] / base if base else None,
        )
        for planner in order(groups, PLANNERS)
    ]
