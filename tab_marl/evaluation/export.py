"""Stored rows as one file for other programs: CSV (also compressed), or Parquet with pyarrow; and their checksum."""

from __future__ import annotations

import hashlib
import importlib.util
import os
from pathlib import Path
from typing import Any, Literal

import pandas as pd

from tab_marl.evaluation.errors import UserError
from tab_marl.evaluation.rows import EpisodeRow, Timing, scored_completed, scored_steps
from tab_marl.evaluation.store import Store

FORMATS = ("csv", "parquet")
MEASURED = (
    "decisions", "mean_decision_milliseconds", "max_decision_milliseconds", "seconds", "processor_seconds",
    "preparation_processor_seconds", "decision_processor_seconds", "planner_processor_seconds",
    "simulation_processor_seconds",
)  # fmt: skip
TYPES = {"completed_step": "Int64", "error": "string"}
COMPRESSIONS: dict[str, Literal["gzip", "xz"]] = {".gz": "gzip", ".xz": "xz"}


def frame(rows: list[EpisodeRow], timings: dict[tuple[str, str, str, int], Timing], key: str) -> pd.DataFrame:
    """One row per episode, sorted by its key: what it was, how it ended, how it is scored, and how long it took."""
    table: list[dict[str, Any]] = []
    for row in sorted(rows, key=lambda r: r.key):
        timing = timings.get(row.key)
        table.append(
            {
                "settings": key,
                "mission": row.mission,
                "family": row.family,
                "planner": row.planner,
                "seed": row.seed,
                "adversary": row.adversary,
                "slack": row.slack,
                "intercepted": row.intercepted,
                "completed": row.completed,
                "failed": row.failed,
                "censored": row.censored,
                "physics_steps": row.physics_steps,
                "horizon_steps": row.horizon_steps,
                "completed_step": row.completed_step,
                "ego_first": row.ego_first,
                "fallbacks": row.fallbacks,
                "error": row.error,
                "scored_completed": scored_completed(row),
                "scored_steps": scored_steps(row),
                **{name: None if timing is None else getattr(timing, name) for name in MEASURED},
            }
        )
    return pd.DataFrame(table).astype({**TYPES, "decisions": "Int64"})


def checksum(table: pd.DataFrame) -> str:
    """SHA-256 of what settings and seeds decide: the same for the same rows, whatever machine played them and how long it took.

    `table`: of `frame`, or an exported file. The settings' key is not in it: code that changed and plays the same episodes has
    the same checksum. Numbers count to twelve digits, as parsers of CSV differ in the last.
    """
    decided = table.drop(columns=["settings", *MEASURED]).astype(TYPES)
    decided = decided.sort_values(["mission", "family", "planner", "seed"], kind="stable")
    return hashlib.sha256(decided.to_csv(index=False, lineterminator="\n", float_format="%.12g").encode()).hexdigest()


def export(store: Store, key: str, kind: str, path: Path) -> tuple[int, str]:
    """Write the rows under a settings key; returns how many, and their checksum.

    A CSV file whose name ends in .gz or .xz is compressed. Raises UserError: format, pyarrow missing, no rows, disk.
    """
    check_format(kind)
    rows = store.rows(key)
    if not rows:
        raise UserError(f"no episode is stored under settings {key}")
    table = frame(rows, store.timings(key), key)
    partial = path.with_name(path.name + ".tmp")  # a killed export leaves no half file under the name asked for
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        if kind == "csv":
            table.to_csv(partial, index=False, lineterminator="\n", compression=COMPRESSIONS.get(path.suffix))
        else:
            table.to_parquet(partial, index=False, engine="pyarrow")
        os.replace(partial, path)
    except OSError as error:
        raise UserError(f"{path}: cannot be written: {error.strerror or error}") from None
    return len(table), checksum(table)


def check_format(kind: str) -> None:
    """Raises UserError if this format is unknown or its library is missing."""
    if kind not in FORMATS:
        raise UserError(f"format is {kind!r}, must be one of {', '.join(FORMATS)}")
    if kind == "parquet" and importlib.util.find_spec("pyarrow") is None:
        raise UserError("Parquet needs pyarrow: pip install 'tab-marl[parquet]', or choose --format csv")
