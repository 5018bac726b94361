"""Figures from rows, each worked out by hand."""

import io
import math

import pytest
from rich.console import Console

from tab_marl.evaluation import console, tables
from tab_marl.evaluation.report.findings import findings
from tab_marl.evaluation.report.paper import PAPER
from tab_marl.evaluation.rows import Timing


@pytest.fixture
def rows(synthetic):
    """TAB: 1 of 4 completed; S: 3 of 4; one more S episode without partner, one that broke down."""
    row = synthetic.row
    return [
        row("TAB-POMCP", 0, steps=100),
        row("TAB-POMCP", 1, steps=300),
        row("TAB-POMCP", 2, steps=500),
        row("TAB-POMCP", 3, intercepted=False, completed=True),
        row("S-POMCP", 0, steps=400),
        row("S-POMCP", 1, steps=2000, completed=True),
        row("S-POMCP", 2, intercepted=False, completed=True),
        row("S-POMCP", 3, intercepted=False, error="ValueError: boom"),
        row("S-POMCP", 4, steps=100),
    ]


def test_lines(rows):
    tab, s = sorted(tables.lines(rows), key=lambda line: line.planner, reverse=True)
    assert (tab.planner, tab.episodes, tab.errors) == ("TAB-POMCP", 4, 0)
    assert tab.atcr.value == 0.25
    assert tab.steps.value == (100 + 300 + 500 + 6000) / 4
    assert tab.steps_if_intercepted == 300
    assert tab.atcr_against_headline is None
    assert (s.episodes, s.errors) == (5, 1)
    assert s.atcr.value == 3 / 5  # two completed, and the one that broke down
    assert s.steps_if_intercepted == (400 + 2000 + 100) / 3
    assert s.atcr_against_headline.pairs == 4  # seed 4 has no partner
    assert s.atcr_against_headline.difference.value == (3 - 1) / 4
    assert s.steps_against_headline.difference.value == (300 + 1700 + 5500 + 0) / 4


def test_all_missions_weigh_equally(synthetic):
    rows = [synthetic.row(seed=s) for s in range(9)]
    rows += [synthetic.row(seed=0, mission="M2", intercepted=False, completed=True)]
    whole = tables.lines(rows)[-1]
    assert (whole.mission, whole.episodes) == (tables.ALL, 10)
    assert whole.atcr.value == 0.5


def test_parts(synthetic):
    rows = [synthetic.row(seed=s, slack=x, ego_first=s == 0, adversary=a) for s, (x, a) in enumerate([(1.25, "x"), (1.3, "y"), (2.4, "x"), (math.nan, "")])]  # fmt: skip
    assert [(s.part, s.atcr.count) for s in tables.by_part(rows, "slack_bin")] == [
        ("1 to 1.3", 1),
        ("1.3 to 1.6", 1),
        ("2 or more", 1),
    ]
    assert [(s.part, s.atcr.count) for s in tables.by_part(rows, "adversary")] == [("x", 2), ("y", 1)]
    assert [s.atcr.count for s in tables.where_ego_is_first(rows)] == [1]


def test_paces_are_weighted_by_decisions():
    timings = {
        ("M1", "point", "S-POMCP", 0): Timing(10, 4.0, 9.0, 1.0),
        ("M1", "point", "TAB-POMCP", 0): Timing(10, 4.0, 9.0, 1.0),
        ("M1", "point", "TAB-POMCP", 1): Timing(30, 8.0, 20.0, 1.0),
        ("M1", "point", "TAB-POMCP", 2): Timing(0, math.nan, math.nan, 1.0),
    }
    s, tab = tables.paces(timings)
    assert (tab.decisions, tab.mean_milliseconds, tab.worst_milliseconds) == (40, 7.0, 20.0)
    assert tab.ratio == 1.75 and s.ratio == 1.0


def test_paper_table_is_the_papers():
    assert len(PAPER) == 20
    assert (PAPER["M5", "TAB-POMCP"].atcr_percent, PAPER["M5", "TAB-POMCP"].steps) == (30.9, 545)
    assert (PAPER["M3", "MLE-POMCP"].atcr_percent, PAPER["M3", "MLE-POMCP"].underwater_atcr_percent) == (45.3, 50.8)


def test_console_shows_ours_beside_the_papers(rows):
    text = io.StringIO()
    console.print_tables(rows, Console(file=text, width=console.WIDTH))
    shown = text.getvalue()
    (line,) = [line for line in shown.splitlines() if "TAB" in line and "25.0" in line]
    assert "13.3" in line and "316" in line  # the paper's, M1
    assert "(1 failed)" in shown and "ValueError: boom" in shown
    assert "…" not in shown and max(len(line) for line in shown.splitlines()) <= console.WIDTH
    narrow = io.StringIO()
    console.print_tables(rows, Console(file=narrow, width=80))
    assert "…" not in narrow.getvalue() and "paired differences" in narrow.getvalue()


def test_findings_follow_the_intervals(synthetic):
    def family(tab, s, mle):
        return [
            synthetic.row(p, seed, intercepted=seed >= lost, completed=seed < lost)
            for p, lost in (("TAB-POMCP", tab), ("S-POMCP", s), ("MLE-POMCP", mle))
            for seed in range(100)
        ]

    ((heading, (atcr, sti)),) = findings(tables.lines(family(10, 60, 12)))
    assert heading == "Point"
    assert "completed 10 % of its missions (S 60 %, MLE 12 %)" in atcr
    assert "lets fewer through than S by more than chance" in atcr and "no clear difference to MLE" in atcr
    assert "faster than S" in sti
    ((_, (worse, _)),) = findings(tables.lines(family(60, 10, 60)))
    assert "S did better by more than chance" in worse
    assert findings(tables.lines(family(10, 60, 12)[:5]))[-1][0] == "Few episodes"
