"""The report: rows (and replays re-played from them) in, one HTML file out that needs no network."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from importlib import resources
from pathlib import Path
from typing import Any

from jinja2 import Environment, StrictUndefined
from markupsafe import Markup

from tab_marl.evaluation import statistics, tables
from tab_marl.evaluation.errors import UserError
from tab_marl.evaluation.report import charts, numbers, panels
from tab_marl.evaluation.report.findings import findings
from tab_marl.evaluation.report.numbers import Shown
from tab_marl.evaluation.report.paper import MISSION_TEXT, PAPER, TAB_TIME_RATIO
from tab_marl.evaluation.report.results import ReportData, Results, compute
from tab_marl.evaluation.settings import HEADLINE, MISSIONS, PAPER_PLANNERS, PLANNERS, short
from tab_marl.evaluation.tables import ALL, Line

__all__ = ["ReportData", "render", "write_report"]

MODELS = {
    "S-POMCP": "moves at random, as far as its motors allow",
    "FP-POMCP": "takes the shortest path to its mission’s goals",
    "MLE-POMCP": "moves as other learned adversaries were seen to, and as it was seen to so far, as far as its mission allows",
    "TAB-POMCP": "anything that completes the mission, no way preferred without reason (the TAB-Field), or drives as habits "
    "have it that are drawn at random: whichever foresees better",
    "TAB-POMCP+precedents": "as the TAB-Field has it, or drives as other learned adversaries did on such tasks: whichever "
    "foresees better",
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


PART_TEXT = {
    "adversary": "Which opponents are hard, and for whom. They take turns over the seeds, so each planner met each of them "
    "on the same episodes.",
    "style": "The habits that opponents were trained with.",
    "split": "Opponents that planners and settings were developed with, and those kept for the final measurement.",
    "slack_bin": "Slack is the time allowed over the shortest time in which the mission can be done. With little of it every "
    "way is nearly the shortest one; with much of it the adversary has a choice.",
}
PART_NAME = {"adversary": "Adversary", "style": "Style", "split": "Split", "slack_bin": "Slack"}


def write_report(data: ReportData, path: Path, results: Results | None = None) -> None:
    """Write the page. Raises UserError if the file cannot be written."""
    text = render(data, results)
    partial = path.with_suffix(".part")
    try:
        partial.write_text(text, encoding="utf-8")
        partial.replace(path)
    except OSError as error:
        partial.unlink(missing_ok=True)
        raise UserError(f"{path}: the report cannot be written: {error.strerror}; the episodes are safe") from None


def render(data: ReportData, results: Results | None = None) -> str:
    """The page as text; `results` where they are computed already."""
    found = compute(data) if results is None else results
    environment = Environment(autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True)
    environment.filters |= {
        "percent": lambda x: _shown(numbers.percent(x)),
        "steps": lambda x: _shown(numbers.steps(x)),
        "points": lambda x: _difference(numbers.difference(x, 100.0)),
        "plain_steps": lambda x: _difference(numbers.difference(x)),
        "p": statistics.stars,
        "short": short,
        "css_name": charts.css_name,
    }
    families = list(dict.fromkeys(line.family for line in found.lines))
    planners = tables.order(found.table["planner"], PLANNERS)
    broken = found.table[found.table["broken"]]
    errors = broken[["mission", "family", "planner", "seed", "error"]].to_dict("records")
    keys = [(r["mission"], r["family"], r["planner"], r["seed"]) for r in errors]
    paces = tables.paces(data.timings)
    traces = {t for key in keys if (t := data.timings[key].traceback if key in data.timings else None)}
    return environment.from_string(_template("report.html.j2")).render(
        css=Markup(_template("report.css")),
        script=Markup(_template("report.js")),
        findings=findings(found.lines),
        lines=found.lines,
        families=[_family(name, found) for name in families],
        beside=_beside(found.lines),
        parts=[
            {"name": PART_NAME[c], "text": PART_TEXT[c], "grids": panels.heat_map(shares)}
            for c, shares in found.by.items()
        ],
        first=panels.heat_map(found.first),
        paces=paces,
        processor=any(pace.processor_milliseconds is not None for pace in paces),
        mission_paces=_mission_paces(data),
        pace_plot=panels.pace_plot(data.timings),
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
        content=json.dumps(dict(data.content), indent=2, default=str),
        record=_record(data.record),
        key=data.key,
        version=data.version,
        episodes=len(found.table),
        all=ALL,
        any_exact=any(x.atcr.exact for x in found.lines),
    )


def json_for_script(value: object) -> str:
    """JSON that cannot end the script element it stands in."""
    text = json.dumps(value, separators=(",", ":"), allow_nan=False)
    return text.replace("<", "\\u003c").replace("\u2028", "\\u2028").replace("\u2029", "\\u2029")


def _template(name: str) -> str:
    return resources.files("tab_marl.evaluation.report").joinpath("templates", name).read_text(encoding="utf-8")


def _family(name: str, found: Results) -> dict[str, Any]:
    """Everything that is shown of one family of scenarios."""
    lines = [x for x in found.lines if x.family == name]
    middles = found.aggregates[found.aggregates["family"] == name]
    means = found.restricted[found.restricted["family"] == name]
    missions = tables.order(means["mission"], MISSIONS)
    seconds: dict[tuple[str, str], Any] = {(str(r.mission), str(r.planner)): r for r in means.itertuples()}
    until = {m: next(r.until_seconds for (k, _), r in seconds.items() if k == m) for m in missions}
    return {
        "name": name,
        "text": FAMILY_TEXT.get(name, ""),
        "lines": lines,
        "panels": panels.interval_panels(lines, name),
        "completed": panels.curve_panels(found.completed, name, "Missions completed before interception", until),
        "met": panels.curve_panels(found.met, name, "Adversaries met", until),
        "profile": panels.profile_plot(found.profiles, name),
        "middle": panels.middle_plot(found.aggregates, name),
        "middles": middles.to_dict("records"),
        "missions": missions,
        "until": until,
        "seconds": seconds,
        "planners": tables.order([x.planner for x in lines], PLANNERS),
        "comparisons": max((x.atcr_against_headline.comparisons for x in lines if x.atcr_against_headline and x.mission != ALL and x.planner in PAPER_PLANNERS), default=0),
    }  # fmt: skip


def _beside(lines: Sequence[Line]) -> list[dict[str, Any]]:
    """The paper's tables with ours under each figure: a row per mission of `point`, a column per planner of theirs."""
    ours = {(x.mission, x.planner): x for x in lines if x.family == "point"}
    missions = [m for m in MISSIONS if any((m, p) in ours for p in PAPER_PLANNERS)]
    return [
        {
            "mission": m,
            "cells": [{"planner": p, "paper": PAPER[m, p], "ours": ours.get((m, p))} for p in PAPER_PLANNERS],
        }
        for m in missions
    ]


def _mission_paces(data: ReportData) -> list[dict[str, Any]]:
    """Per mission: milliseconds per decision of S-POMCP and TAB-POMCP, and their ratio."""
    found = []
    for mission, several in tables.paces_by_mission(data.timings).items():
        by_name = {pace.planner: pace for pace in several}
        if HEADLINE in by_name and PAPER_PLANNERS[0] in by_name:
            found.append({"mission": mission, "base": by_name[PAPER_PLANNERS[0]], "headline": by_name[HEADLINE]})
    return found


def _record(record: Mapping[str, Any]) -> list[tuple[str, list[tuple[str, str]]]]:
    """Tables (heading, [(name, value)]) of a nested mapping: its own values first, then a table per mapping in it."""
    plain, nested = [], []
    for name, value in record.items():
        title = str(name).replace("_", " ")
        if isinstance(value, Mapping):
            nested.append((title, [(str(k), _value_text(v)) for k, v in value.items()]))
        else:
            plain.append((title, _value_text(value)))
    return ([("", plain)] if plain else []) + nested


def _value_text(value: Any) -> str:
    return value if isinstance(value, str) else json.dumps(value, default=str)


def _shown(shown: Shown) -> Markup:
    return Markup('{} <span class="ci">{}</span>').format(shown.value, shown.interval)


def _difference(shown: Shown | None) -> Markup:
    if shown is None:
        return Markup("")
    style = {1: "better", -1: "worse", 0: ""}[shown.verdict]
    return Markup('<span class="{}">{}</span> <span class="ci">{} p {}</span>').format(
        style, shown.value, shown.interval, shown.p
    )
