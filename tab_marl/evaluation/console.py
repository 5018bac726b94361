"""The tables as text for a terminal."""

from __future__ import annotations

from collections.abc import Sequence

from rich.console import Console
from rich.table import Table

from tab_marl.evaluation import tables
from tab_marl.evaluation.report.paper import PAPER
from tab_marl.evaluation.rows import EpisodeRow
from tab_marl.evaluation.settings import HEADLINE, short
from tab_marl.evaluation.statistics import Interval, Paired, stars
from tab_marl.evaluation.tables import Line

WIDTH = 132
"""Columns that the whole table needs, and that are used when the output is not a terminal."""


def _table(title: str, part: Sequence[Line], columns: Sequence[str]) -> Table:
    table = Table(title=title, title_justify="left", pad_edge=False, box=None, show_edge=False)
    for heading in columns:
        table.add_column(heading, justify="left" if heading in MEASURED[:2] else "right", no_wrap=True)
    mission = None
    for line in part:
        if mission is not None and line.mission != mission:
            table.add_section()
        cells = _cells(line)
        chosen = [cells[heading] if heading != "paper" else "" for heading in columns]
        for i, heading in enumerate(columns):
            if heading == "paper":
                chosen[i] = cells[f"paper {columns[i - 1]}"]
        if line.mission == mission:
            chosen[0] = ""
        table.add_row(*chosen, style="bold" if line.planner == HEADLINE else None)
        mission = line.mission
    return table


def _cells(line: Line) -> dict[str, str]:
    figure = PAPER.get((line.mission, line.planner)) if line.family == "point" else None
    return {
        "": line.mission,
        "planner": short(line.planner),
        "n": f"{line.episodes}" + (f" ({line.errors} failed)" if line.errors else ""),
        MEASURED[3]: percent(line.atcr),
        f"paper {MEASURED[3]}": f"{figure.atcr_percent:.1f}" if figure else "",
        MEASURED[5]: steps(line.steps),
        f"paper {MEASURED[5]}": f"{figure.steps}" if figure else "",
        PAIRED[0]: difference(line.atcr_against_headline, 100.0),
        PAIRED[1]: difference(line.steps_against_headline, 1.0),
    }


def percent(interval: Interval) -> str:
    mark = "†" if interval.exact else ""
    return f"{100 * interval.value:.1f} [{100 * interval.low:.0f}, {100 * interval.high:.0f}]{mark}"


def steps(interval: Interval) -> str:
    return f"{interval.value:.0f} [{interval.low:.0f}, {interval.high:.0f}]"


def difference(paired: Paired | None, scale: float) -> str:
    if paired is None:
        return ""
    d = paired.difference
    return f"{scale * d.value:+.0f} [{scale * d.low:+.0f}, {scale * d.high:+.0f}] p {stars(paired.p_value if paired.adjusted is None else paired.adjusted)}"


def notes_console() -> Console:
    """For progress and remarks, on stderr; sentences stay on one line where nobody watches."""
    console = Console(stderr=True, highlight=False)
    return console if console.is_terminal else Console(stderr=True, highlight=False, soft_wrap=True)


MEASURED = ("", "planner", "n", "ATCR % [95 %]", "paper", "StI [95 %]", "paper")
PAIRED = ("ATCR - TAB, points", "StI - TAB, steps")


def print_tables(rows: Sequence[EpisodeRow], console: Console, lines: Sequence[Line] | None = None) -> None:
    """Per family: ATCR and StI with intervals, the paper's figures, paired differences against TAB-POMCP.

    On a narrow terminal the differences follow in a table of their own. `lines` are those of the rows, if computed already.
    """
    found = tables.lines(rows) if lines is None else lines
    whole = console.width >= WIDTH
    for family in dict.fromkeys(line.family for line in found):
        part = [line for line in found if line.family == family]
        console.print(_table(f"family: {family}", part, MEASURED + (PAIRED if whole else ())))
        console.print()
        if not whole and any(line.atcr_against_headline for line in part):
            console.print(_table(f"family: {family}, paired differences", part, MEASURED[:2] + PAIRED))
            console.print()
    console.print(
        "ATCR: episodes in which the adversary completed its mission before interception (lower is better). "
        "StI: 100 Hz physics steps to interception, censored at the horizon.\n"
        "Differences are this planner minus TAB-POMCP over the same seeds (positive: TAB-POMCP is better); p by exact "
        "McNemar test and Wilcoxon signed-rank test after Holm's correction.\nPaper: L4DC 2025, its own arena. † all episodes alike: exact binomial bound.",
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
