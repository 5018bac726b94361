"""Prints the tables of stored rows and writes their report."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from rich.console import Console

import tab_marl
from tab_marl.agents.zoo import PolicyError
from tab_marl.evaluation import console as text
from tab_marl.evaluation import tables
from tab_marl.evaluation.errors import UserError
from tab_marl.evaluation.evaluate import REPORT_NAME
from tab_marl.evaluation.report.page import ReportData, write_report
from tab_marl.evaluation.report.replay import choose
from tab_marl.evaluation.rows import EpisodeRow
from tab_marl.evaluation.settings import FAMILIES, MISSIONS, PLANNERS
from tab_marl.evaluation.store import Store, StoredSettings
from tab_marl.world.scenario import UnknownName

DEFAULT_REPLAYS = 3


def present(store: Store, stored: StoredSettings, folder: Path, replays: int | None, notes: Console) -> Path:
    """Print the tables of what was asked for under these settings and write the page; returns its path."""
    rows = requested_rows(store.rows(stored.key), stored.requested)
    out = Console(width=None if notes.is_terminal else text.WIDTH, highlight=False)
    text.print_tables(rows, out)
    count = stored.requested.get("replays", DEFAULT_REPLAYS) if replays is None else replays
    choices = choose(rows, count)
    planners = tables.order((r.planner for r in rows), PLANNERS)
    if choices:
        notes.print(f"playing {len(choices)} episodes again for the report", highlight=False)
    from tab_marl.evaluation.episode import opponent
    from tab_marl.evaluation.report.explanation import explanation
    from tab_marl.evaluation.report.replaying import replay_groups
    from tab_marl.evaluation.zoo_view import describe

    workers = stored.requested.get("workers") or os.cpu_count() or 1
    groups = replay_groups(choices, planners, stored.content, store, stored.key, workers)
    cards = []
    for name in stored.content["adversaries"]:
        with contextlib.suppress(UserError, PolicyError, UnknownName):  # gone since: the rows still hold
            policy = opponent(name)
            cards.append({"name": policy.name, "text": describe(policy)})
    path = folder / REPORT_NAME
    wanted = {r.key for r in rows}
    timings = {key: timing for key, timing in store.timings(stored.key).items() if key in wanted}
    write_report(
        ReportData(rows, timings, stored.content, stored.key, groups, explanation(), cards, tab_marl.__version__), path
    )
    out.print(f"report: {path}")
    return path


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
