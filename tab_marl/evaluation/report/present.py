"""Prints the tables of stored rows and writes their report: the page, and what else is asked for."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from rich.console import Console

import tab_marl
from tab_marl.agents.policies.zoo import PolicyError
from tab_marl.evaluation import console as text
from tab_marl.evaluation import tables
from tab_marl.evaluation.errors import UserError, require_known
from tab_marl.evaluation.evaluate import REPORT_NAME
from tab_marl.evaluation.report import episode_film, exports, plots
from tab_marl.evaluation.report.page import write_report
from tab_marl.evaluation.report.replay import choose
from tab_marl.evaluation.report.results import ReportData, compute
from tab_marl.evaluation.rows import EpisodeRow
from tab_marl.evaluation.settings import FAMILIES, MISSIONS, PLANNERS
from tab_marl.evaluation.store import Store, StoredSettings
from tab_marl.world.scenario import UnknownName

DEFAULT_REPLAYS = 3
RUNS_SHOWN = 3
"""The latest runs on a store that the page describes."""


@dataclass(frozen=True)
class Wanted:
    """What is written beside the page."""

    tables: tuple[str, ...] = ()
    """Of "md", "tex"."""
    figures: tuple[str, ...] = ()
    """Of "svg", "pdf", "png"."""
    films: tuple[str, ...] = ()
    """Of "gif", "mp4": a film of every replay."""

    def __post_init__(self) -> None:
        for kind, known in (("tables", exports.KINDS), ("figures", plots.KINDS), ("films", episode_film.KINDS)):
            object.__setattr__(self, kind, require_known(f"kind of {kind}", getattr(self, kind), known))


def present(
    store: Store,
    stored: StoredSettings,
    folder: Path,
    replays: int | None,
    notes: Console,
    wanted: Wanted = Wanted(),
) -> Path:
    """Print the tables of what was asked for under these settings and write the page; returns its path.

    Beside it go the folders `tables`, `figures` and `films` with what is `wanted`. Raises UserError.
    """
    rows = requested_rows(store.rows(stored.key), stored.requested)
    out = Console(width=None if notes.is_terminal else text.WIDTH, highlight=False)
    keys = {r.key for r in rows}
    timings = {key: timing for key, timing in store.timings(stored.key).items() if key in keys}
    cards = describe_adversaries(stored.content["adversaries"])
    data = ReportData(
        rows, timings, stored.content, stored.key, (), None, cards, tab_marl.__version__, record_of(store, stored.key)
    )
    results = compute(data)
    text.print_tables(rows, out, results.lines)
    count = stored.requested.get("replays", DEFAULT_REPLAYS) if replays is None else replays
    if wanted.films and not count:
        raise UserError("films are made of the report's replays, and there are none: ask for --replays 1 or more")
    for kind in wanted.films:
        episode_film.check_kind(folder / "films", kind)
    choices = choose(rows, count)
    if choices:
        notes.print(f"playing {len(choices)} episodes again for the report", highlight=False)
    from tab_marl.evaluation.report.explanation import explanation
    from tab_marl.evaluation.report.replaying import replay_groups

    workers = stored.requested.get("workers") or os.cpu_count() or 1
    planners = tables.order([r.planner for r in rows], PLANNERS)
    groups = replay_groups(choices, planners, stored.content, store, stored.key, workers)
    data = replace(data, replays=groups, figures=explanation())
    path = folder / REPORT_NAME
    write_report(data, path, results)
    out.print(f"report: {path}")
    written = {
        "tables": exports.export_tables(results, folder / "tables", wanted.tables) if wanted.tables else [],
        "figures": plots.export_figures(results, folder / "figures", wanted.figures) if wanted.figures else [],
        "films": episode_film.export_films(groups, folder / "films", wanted.films) if wanted.films else [],
    }
    for name, files in written.items():
        if files:
            out.print(f"{name}: {folder / name} ({len(files)} files)")
    return path


def describe_adversaries(names: Sequence[str]) -> list[dict[str, str]]:
    """Name, what it is, style and split of each adversary that can still be found."""
    from tab_marl.evaluation.adversaries import opponent
    from tab_marl.evaluation.zoo_view import describe

    cards = []
    for name in names:
        with contextlib.suppress(UserError, PolicyError, UnknownName):  # gone since: the rows still hold
            policy = opponent(name)
            split = getattr(policy, "split", None) or ""
            cards.append(
                {"name": policy.name, "text": describe(policy), "style": policy.style.name, "split": str(split)}
            )
    return cards


def record_of(store: Store, key: str) -> dict[str, Any]:
    """The latest runs under these settings: versions, machine, engine, commit, checksums of the zoo."""
    from tab_marl.evaluation.provenance import describe_runs

    runs = describe_runs(store.runs(key))
    record: dict[str, Any] = {}
    if len(runs) > RUNS_SHOWN:
        record["runs"] = f"{len(runs)} on this store; the latest {RUNS_SHOWN} are described"
    return record | {f"run {run['run']}": {k: v for k, v in run.items() if k != "run"} for run in runs[-RUNS_SHOWN:]}


def requested_rows(rows: list[EpisodeRow], requested: Mapping[str, Any]) -> list[EpisodeRow]:
    """Those rows that the latest request of these settings asked for."""
    missions = requested.get("missions", MISSIONS)
    families = requested.get("families", FAMILIES)
    planners = requested.get("planners", PLANNERS)
    episodes = requested.get("episodes")
    return [
        r
        for r in rows
        if r.mission in missions
        and r.family in families
        and r.planner in planners
        and (episodes is None or r.seed < episodes)
    ]
