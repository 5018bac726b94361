"""The report: rows (and replays re-played from them) in, one HTML file out that needs no network."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np
from jinja2 import Environment, StrictUndefined
from markupsafe import Markup

from tab_marl.evaluation import statistics, tables
from tab_marl.evaluation.errors import UserError
from tab_marl.evaluation.report import charts
from tab_marl.evaluation.report.findings import findings
from tab_marl.evaluation.report.paper import MISSION_TEXT, PAPER, TAB_TIME_RATIO
from tab_marl.evaluation.rows import EpisodeRow, Timing, scored_completed
from tab_marl.evaluation.settings import HEADLINE, PLANNERS
from tab_marl.evaluation.statistics import Interval, Paired
from tab_marl.evaluation.tables import ALL, Line, Share

MODELS = {
    "S-POMCP": "moves at random, as far as its motors allow",
    "FP-POMCP": "takes the shortest path to its mission’s goals",
    "MLE-POMCP": "moves with probabilities estimated from the mission and from what was seen of it so far",
    "TAB-POMCP": "anything that completes the mission, no way preferred without reason: the TAB-Field",
    "population-POMCP": "moves as the population of trained adversaries does: not available outside an experiment",
    "oracle": "is seen all the time: the bound on what can be reached",
    "random": "none; the ego drives at random",
}
"""What each planner believes of the adversary."""

FAMILY_TEXT = {
    "point": "The paper’s missions: the last goal is one small disc. Whoever gets there first can simply wait, "
    "so the goal-aware planners differ mostly in how soon they meet the adversary.",
    "perimeter": "The last goal is a disc wider than the interception radius: a control, "
    "in which guarding the near side is right against most adversaries and prediction matters little.",
    "ambiguous": "The goal is any of several. Waiting at one of them may be in vain: here prediction decides.",
}

CURVE_POINTS = 121


@dataclass(frozen=True)
class ReportData:
    """Everything the page is made of."""

    rows: Sequence[EpisodeRow]
    timings: Mapping[tuple[str, str, str, int], Timing]
    content: Mapping[str, Any]
    """The settings that decide the rows."""
    key: str
    replays: Sequence[Mapping[str, Any]] = ()
    """As `replaying.replay_groups` makes them."""
    figures: Mapping[str, str] | None = None
    """SVG by name, as `figures.explanation` makes them; None leaves the drawn explanation out."""
    cards: Sequence[Mapping[str, str]] = ()
    """Adversaries: name, text."""
    version: str = ""


def write_report(data: ReportData, path: Path) -> None:
    """Write the page. Raises UserError if the file cannot be written."""
    text = render(data)
    partial = path.with_suffix(".part")
    try:
        partial.write_text(text, encoding="utf-8")
        partial.replace(path)
    except OSError as error:
        partial.unlink(missing_ok=True)
        raise UserError(f"{path}: the report cannot be written: {error.strerror}; the episodes are safe") from None


def render(data: ReportData) -> str:
    """The page as text."""
    environment = Environment(autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True)
    environment.filters |= {
        "percent": _percent,
        "steps": _steps,
        "points": _points,
        "plain_steps": _step_difference,
        "p": statistics.stars,
    }
    found = tables.lines(data.rows)
    families = list(dict.fromkeys(line.family for line in found))
    planners = tables.order((r.planner for r in data.rows), PLANNERS)
    errors = [r for r in data.rows if r.error is not None]
    traces = {t for r in errors if (t := data.timings[r.key].traceback if r.key in data.timings else None)}
    return environment.from_string(_template("report.html.j2")).render(
        css=Markup(_template("report.css")),
        script=Markup(_template("report.js")),
        findings=findings(found),
        lines=found,
        families=[
            {"name": f, "text": FAMILY_TEXT.get(f, ""), "lines": [x for x in found if x.family == f]} for f in families
        ],
        panels={f: _panels([x for x in found if x.family == f], f) for f in families},
        curves={f: _curves([r for r in data.rows if r.family == f]) for f in families},
        adversaries=_grid(tables.by_adversary(data.rows)),
        slacks=_grid(tables.by_slack(data.rows)),
        first=_grid(tables.where_ego_is_first(data.rows)),
        paces=tables.paces(dict(data.timings)),
        paper=PAPER,
        paper_ratio=TAB_TIME_RATIO,
        mission_text=MISSION_TEXT,
        planners=[{"name": p, "model": MODELS.get(p, ""), "mark": Markup(charts.legend_mark(p))} for p in planners],
        headline=HEADLINE,
        replays=data.replays,
        replay_json=Markup(json_for_script(data.replays)),
        figures={name: Markup(svg) for name, svg in (data.figures or {}).items()},
        cards=data.cards,
        errors=errors,
        tracebacks=sorted(traces)[:5],
        content=json.dumps(dict(data.content), indent=2),
        key=data.key,
        version=data.version,
        episodes=len(data.rows),
        all=ALL,
        any_exact=any(x.atcr.exact for x in found),
    )


def json_for_script(value: object) -> str:
    """JSON that cannot end the script element it stands in."""
    text = json.dumps(value, separators=(",", ":"), allow_nan=False)
    return text.replace("<", "\\u003c").replace("\u2028", "\\u2028").replace("\u2029", "\\u2029")


def _template(name: str) -> str:
    return resources.files("tab_marl.evaluation.report").joinpath("templates", name).read_text(encoding="utf-8")


def _panels(found: Sequence[Line], family: str) -> list[dict[str, Any]]:
    """Per mission: the interval plots of ATCR and StI."""
    top = max((x.steps.high for x in found), default=1.0)
    if family == "point":
        top = max(
            [top] + [f.steps for (m, p), f in PAPER.items() if any(x.mission == m and x.planner == p for x in found)]
        )
    panels = []
    for mission in dict.fromkeys(x.mission for x in found):
        part = [x for x in found if x.mission == mission]
        figures = {x.planner: PAPER.get((mission, x.planner)) if family == "point" else None for x in part}
        name = "all missions" if mission == ALL else mission
        completion = [
            charts.Dot(x.planner, x.atcr, f.atcr_percent if (f := figures[x.planner]) else None) for x in part
        ]
        meeting = [charts.Dot(x.planner, x.steps, f.steps if (f := figures[x.planner]) else None) for x in part]
        panels.append(
            {
                "mission": name,
                "atcr": Markup(charts.interval_plot(completion, 100, "ATCR, % (lower is better)", f"ATCR, {name}, {family}", 100)),
                "sti": Markup(charts.interval_plot(meeting, top * 1.02, "StI, physics steps (lower is better)", f"StI, {name}, {family}")),
            }
        )  # fmt: skip
    return panels


def _curves(rows: Sequence[EpisodeRow]) -> dict[str, Markup]:
    grid = np.linspace(0, 1, CURVE_POINTS)
    met, done = {}, {}
    for planner in tables.order((r.planner for r in rows), PLANNERS):
        part = [r for r in rows if r.planner == planner]
        met[planner] = statistics.cumulative_share(
            [r.physics_steps / r.horizon_steps for r in part], [r.intercepted and r.error is None for r in part], grid
        )
        done[planner] = statistics.cumulative_share(
            [(r.completed_step if r.completed_step is not None else r.horizon_steps) / r.horizon_steps for r in part],
            [scored_completed(r) for r in part],
            grid,
        )
    return {
        "met": Markup(charts.curve_plot(met, "Share of episodes intercepted over time")),
        "done": Markup(charts.curve_plot(done, "Share of missions completed over time")),
    }


def _grid(shares: Sequence[Share]) -> list[dict[str, Any]]:
    """Per family: parts as rows, planners as columns."""
    grids = []
    for family in dict.fromkeys(s.family for s in shares):
        part = [s for s in shares if s.family == family]
        cells = {(s.part, s.planner): s.atcr for s in part}
        columns = tables.order((s.planner for s in part), PLANNERS)
        rows = [
            {
                "part": name,
                "count": max(cells[name, p].count for p in columns if (name, p) in cells),
                "cells": [cells.get((name, p)) for p in columns],
            }
            for name in dict.fromkeys(s.part for s in part)
        ]
        grids.append({"family": family, "planners": columns, "rows": rows})
    return grids


def _percent(interval: Interval) -> Markup:
    mark = "†" if interval.exact else ""
    return Markup('{:.1f} <span class="ci">[{:.0f}, {:.0f}]{}</span>').format(
        100 * interval.value, 100 * interval.low, 100 * interval.high, mark
    )


def _steps(interval: Interval) -> Markup:
    return Markup('{:.0f} <span class="ci">[{:.0f}, {:.0f}]</span>').format(interval.value, interval.low, interval.high)


def _points(paired: Paired | None) -> Markup:
    return _difference(paired, 100.0)


def _step_difference(paired: Paired | None) -> Markup:
    return _difference(paired, 1.0)


def _difference(paired: Paired | None, scale: float) -> Markup:
    if paired is None:
        return Markup("")
    d = paired.difference
    style = {1: "better", -1: "worse", 0: ""}[paired.verdict]
    return Markup('<span class="{}">{:+.0f}</span> <span class="ci">[{:+.0f}, {:+.0f}] p {}</span>').format(
        style, scale * d.value, scale * d.low, scale * d.high, statistics.stars(paired.p_value)
    )
