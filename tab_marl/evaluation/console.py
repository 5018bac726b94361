"""The tables as text for a terminal."""

from __future__ import annotations

from collections.abc import Sequence

from rich.console import Console
from rich.table import Table

from tab_marl.evaluation import tables
from tab_marl.evaluation.paper import PAPER
from tab_marl.evaluation.rows import EpisodeRow
from tab_marl.evaluation.settings import HEADLINE
from tab_marl.evaluation.statistics import Interval, Paired, stars

WIDTH = 118
"""Columns when the output is not a terminal."""


def percent(interval: Interval) -> str:
    mark = "†" if interval.exact else ""
    return f"{100 * interval.value:.1f} [{100 * interval.low:.0f}, {100 * interval.high:.0f}]{mark}"


def steps(interval: Interval) -> str:
    return f"{interval.value:.0f} [{interval.low:.0f}, {interval.high:.0f}]"


def difference(paired: Paired | None, scale: float) -> str:
    if paired is None:
        return ""
    d = paired.difference
    return f"{scale * d.value:+.0f} [{scale * d.low:+.0f}, {scale * d.high:+.0f}] p {stars(paired.p_value)}"


def print_tables(rows: Sequence[EpisodeRow], console: Console) -> None:
    """One table per family: ATCR and StI with intervals, the paper's figures, paired differences against TAB-POMCP."""
    found = tables.lines(rows)
    for family in dict.fromkeys(line.family for line in found):
        table = Table(title=f"family: {family}", title_justify="left", pad_edge=False, box=None, show_edge=False)
        for heading in (
            "",
            "planner",
            "n",
            "ATCR % [95 %]",
            "paper",
            "StI [95 %]",
            "paper",
            "ATCR - TAB, points",
            "StI - TAB, steps",
        ):
            table.add_column(heading, justify="left" if heading in ("", "planner") else "right", no_wrap=True)
        mission = None
        for line in (line for line in found if line.family == family):
            if mission is not None and line.mission != mission:
                table.add_section()
            figure = PAPER.get((line.mission, line.planner)) if family == "point" else None
            table.add_row(
                line.mission if line.mission != mission else "",
                line.planner,
                f"{line.episodes}" + (f" ({line.errors} failed)" if line.errors else ""),
                percent(line.atcr),
                f"{figure.atcr_percent:.1f}" if figure else "",
                steps(line.steps),
                f"{figure.steps}" if figure else "",
                difference(line.atcr_against_headline, 100.0),
                difference(line.steps_against_headline, 1.0),
                style="bold" if line.planner == HEADLINE else None,
            )
            mission = line.mission
        console.print(table)
        console.print()
    console.print(
        "ATCR: episodes in which the adversary completed its mission before interception (lower is better). "
        "StI: 100 Hz physics steps to interception, censored at the horizon.\n"
        "Differences are this planner minus TAB-POMCP over the same seeds (positive: TAB-POMCP is better); p by exact "
        "McNemar test and Wilcoxon signed-rank test.\nPaper: L4DC 2025, its own arena. † all episodes alike: exact binomial bound.",
        style="dim",
        highlight=False,
    )
    errors = [row for row in rows if row.error is not None]
    if errors:
        first = errors[0]
        console.print(
            f"{len(errors)} episodes broke down and count as completed missions; the first: {first.mission} {first.family} "
            f"{first.planner} seed {first.seed}: {first.error}",
            style="red",
            highlight=False,
        )
