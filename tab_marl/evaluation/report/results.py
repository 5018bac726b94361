"""What a report shows, computed once from rows: the page, the tables and the figures all read it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import pandas as pd

from tab_marl.evaluation import statistics, tables
from tab_marl.evaluation.errors import UserError
from tab_marl.evaluation.rows import EpisodeRow, Timing
from tab_marl.evaluation.statistics import Curve, frame
from tab_marl.evaluation.statistics.frames import Key
from tab_marl.evaluation.tables import Line, Share


@dataclass(frozen=True)
class ReportData:
    """Everything the page is made of."""

    rows: Sequence[EpisodeRow] | pd.DataFrame
    timings: Mapping[tuple[str, str, str, int], Timing]
    content: Mapping[str, Any]
    """The settings that decide the rows."""
    key: str
    replays: Sequence[Mapping[str, Any]] = ()
    """As `replaying.replay_groups` makes them."""
    figures: Mapping[str, str] | None = None
    """SVG by name, as `explanation.explanation` makes them; None leaves the drawn explanation out."""
    cards: Sequence[Mapping[str, str]] = ()
    """Adversaries: name, text, and style and split where they are known."""
    version: str = ""
    record: Mapping[str, Any] = field(default_factory=dict)
    """Of the run: versions, machine, configuration, checksums; nested mappings become tables of their own."""


@dataclass(frozen=True)
class Results:
    """What the page, the tables and the figures show, computed once from the rows."""

    table: pd.DataFrame
    lines: list[Line]
    aggregates: pd.DataFrame
    profiles: pd.DataFrame
    completed: dict[Key, Curve]
    met: dict[Key, Curve]
    restricted: pd.DataFrame
    by: dict[str, list[Share]]
    """ATCR by "adversary", "slack_bin", "style", "split": those that the rows can tell apart."""
    first: list[Share]
    timings: Mapping[tuple[str, str, str, int], Timing]


def compute(data: ReportData) -> Results:
    """Every statistic of the rows. Raises UserError without rows."""
    styles = {card["name"]: card["style"] for card in data.cards if card.get("style")}
    table = frame(data.rows, styles)
    splits = {card["name"]: card["split"] for card in data.cards if card.get("split")}
    if "split" not in table and splits:
        table["split"] = table["adversary"].map(splits)
    if not len(table):
        raise UserError("there are no episodes to report on")
    by = {}
    for column in ("adversary", "style", "split", "slack_bin"):
        # A style per adversary says nothing that the table by adversary does not.
        if column in table and table[column].notna().any():
            parts = table.loc[table[column].astype(str) != "", column].dropna()
            if column in ("adversary", "slack_bin") or 1 < parts.nunique() < table["adversary"].nunique():
                by[column] = tables.by_part(table, column)
    met = statistics.survival_curves(table, "met")
    return Results(
        table,
        tables.lines(table),
        statistics.aggregates(table),
        statistics.performance_profiles(table),
        statistics.survival_curves(table, "completed"),
        met,
        statistics.restricted_means(table, met),
        by,
        tables.where_ego_is_first(table),
        data.timings,
    )
