"""The report's charts, made from a table of rows: what is drawn, in which panel, against which axis."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd
from markupsafe import Markup

from tab_marl.evaluation.report import charts
from tab_marl.evaluation.report.paper import PAPER
from tab_marl.evaluation.rows import Timing
from tab_marl.evaluation.settings import COMPETING_PLANNERS, MISSIONS, PLANNERS
from tab_marl.evaluation.statistics import Curve, Interval, bootstrap_mean
from tab_marl.evaluation.statistics.frames import Key
from tab_marl.evaluation.tables import ALL, Line, Share, order

TOP_SHARES = (0.1, 0.2, 0.4, 0.6, 0.8, 1.0)
"""Where the axis of a plot of shares may end."""
CURVE_POINTS = 121
"""Times at which a curve over time is drawn."""


def mission_name(mission: str) -> str:
    """A mission as panels are headed."""
    return "all missions" if mission == ALL else mission


def interval_panels(found: Sequence[Line], family: str) -> list[dict[str, Any]]:
    """Per mission: the interval plots of ATCR and StI, the paper's figures beside those of `point`."""
    paper = {key: figure for key, figure in PAPER.items() if family == "point"}
    shown = [float(paper[x.mission, x.planner].steps) for x in found if (x.mission, x.planner) in paper]
    top = 1.02 * max([x.steps.high for x in found] + shown, default=1.0)
    panels = []
    for mission in dict.fromkeys(x.mission for x in found):
        part, name = [x for x in found if x.mission == mission], mission_name(mission)
        completion, meeting = [], []
        for x in part:
            figure = paper.get((mission, x.planner))
            completion.append(charts.Dot(x.planner, x.atcr, figure.atcr_percent if figure else None))
            meeting.append(charts.Dot(x.planner, x.steps, figure.steps if figure else None))
        atcr = charts.interval_plot(completion, 100, "ATCR, % (lower is better)", f"ATCR, {name}, {family}", 100)
        sti = charts.interval_plot(meeting, top, "StI, physics steps (lower is better)", f"StI, {name}, {family}")
        panels.append({"mission": name, "atcr": Markup(atcr), "sti": Markup(sti)})
    return panels


def curve_panels(
    curves: Mapping[Key, Curve], family: str, title: str, until: Mapping[str, float]
) -> list[dict[str, Any]]:
    """Per mission, ALL first: shares over time with the bands of the planners that compete.

    `until`: seconds shown of each mission; ALL has its time in percent of the episode's. Planners far above the others
    would flatten them: they are left out of the picture and named in its `note`.
    """
    panels = []
    missions = order([m for f, m, _ in curves if f == family], (ALL, *MISSIONS))
    for mission in missions:
        part = {p: c for (f, m, p), c in curves.items() if (f, m) == (family, mission)}
        end, unit = (100.0, "% of the episode’s time") if mission == ALL else (until[mission], "seconds")
        grid = np.linspace(0, end, CURVE_POINTS)
        tracks = []
        for planner, curve in part.items():
            value, low, high = curve.at(grid)
            band = (low, high) if planner in COMPETING_PLANNERS else (None, None)
            tracks.append(charts.Track(planner, grid, value, *band))
        highest = [float(np.max(t.value if t.high is None else t.high)) for t in tracks if t.planner != "random"]
        top = next(s for s in TOP_SHARES if s >= min(max(highest, default=1.0), 1.0))
        beyond = [t for t in tracks if np.max(t.value) > top]
        note = "; ".join(f"{t.planner}: {100 * t.value[-1]:.0f} % at the end, beyond the scale" for t in beyond)
        shown = [t for t in tracks if t not in beyond]
        name = f"{title}, {mission_name(mission)}, {family}"
        svg = charts.curve_plot(shown, name, unit, (0.0, end), top_share=top)
        panels.append({"mission": mission_name(mission), "svg": Markup(svg), "note": note})
    return panels


def profile_plot(profiles: pd.DataFrame, family: str) -> Markup:
    """The share of episodes above each score."""
    part = profiles[profiles["family"] == family]
    tracks = []
    for planner in order(part["planner"], PLANNERS):
        one = part[part["planner"] == planner]
        band = (one["low"].to_numpy(), one["high"].to_numpy()) if planner in COMPETING_PLANNERS else (None, None)
        tracks.append(charts.Track(planner, one["threshold"].to_numpy(), one["value"].to_numpy(), *band))
    ticks = (0.0, 0.25, 0.5, 0.75, 1.0)
    return Markup(
        charts.curve_plot(tracks, f"Performance profile, {family}", "score τ", (0.0, 1.0), ticks, named=False)
    )


def middle_plot(aggregates: pd.DataFrame, family: str) -> Markup:
    """Interquartile means with intervals."""
    part = aggregates[aggregates["family"] == family]
    rows: Any = part.itertuples()
    dots = [charts.Dot(r.planner, Interval(r.iqm, r.low, r.high, r.episodes)) for r in rows]
    title = f"Interquartile mean of the score, {family}"
    # The planners that compete lie close together: the axis shows them, and says of others where they are.
    close = [d.interval for d in dots if d.planner in COMPETING_PLANNERS] or [d.interval for d in dots]
    low = max(np.floor(20 * min(i.low for i in close) - 0.5) / 20, 0.0)
    high = min(np.ceil(20 * max(d.interval.high for d in dots) + 0.5) / 20, 1.0)
    unit = "IQM of the score (higher is better)"
    return Markup(charts.interval_plot(dots, high, unit, title, digits=3, minimum=low))


def pace_plot(timings: Mapping[tuple[str, str, str, int], Timing]) -> Markup:
    """Mean milliseconds per decision, with intervals over episodes."""
    groups: dict[str, list[float]] = {}
    for (_, _, planner, _), timing in timings.items():
        if timing.decisions and np.isfinite(timing.mean_decision_milliseconds):
            groups.setdefault(planner, []).append(timing.mean_decision_milliseconds)
    dots = [charts.Dot(p, bootstrap_mean(groups[p])) for p in order(list(groups), PLANNERS)]
    if not dots:
        return Markup("")
    top = 1.05 * max(d.interval.high for d in dots)
    return Markup(charts.interval_plot(dots, top, "milliseconds per decision", "Decision times"))


def heat_map(shares: Sequence[Share]) -> list[dict[str, Any]]:
    """Per family: parts as rows, planners as columns."""
    grids = []
    for family in dict.fromkeys(s.family for s in shares):
        part = [s for s in shares if s.family == family]
        cells = {(s.part, s.planner): s for s in part}
        columns = order([s.planner for s in part], PLANNERS)
        rows = [
            {
                "part": name,
                "count": max(cells[name, p].atcr.count for p in columns if (name, p) in cells),
                "cells": [cells.get((name, p)) for p in columns],
            }
            for name in dict.fromkeys(s.part for s in part)
        ]
        grids.append({"family": family, "planners": columns, "rows": rows})
    return grids
