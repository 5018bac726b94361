"""Rows in one SQLite file: transactional, so a kill at any moment loses at most the episodes that were being played."""

from __future__ import annotations

import json
import sqlite3
from collections.abc import Iterable, Mapping
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self

from tab_marl.evaluation.errors import UserError
from tab_marl.evaluation.rows import EpisodeRow, Timing, finite

FILE_NAME = "episodes.sqlite"
SCHEMA_VERSION = 1
APPLICATION_ID = 0x7AB3A21

SCHEMA = """
CREATE TABLE settings (
    key TEXT PRIMARY KEY,
    content TEXT NOT NULL,          -- JSON: what a row depends on beside its own coordinates
    requested TEXT NOT NULL,        -- JSON: the latest request (missions, families, planners, episodes)
    last_used INTEGER NOT NULL      -- counts up; the highest is the latest
) STRICT;
CREATE TABLE episodes (
    settings_key TEXT NOT NULL REFERENCES settings (key),
    mission TEXT NOT NULL, family TEXT NOT NULL, planner TEXT NOT NULL, seed INTEGER NOT NULL,
    adversary TEXT NOT NULL, slack REAL,
    intercepted INTEGER NOT NULL, completed INTEGER NOT NULL, failed INTEGER NOT NULL, censored INTEGER NOT NULL,
    physics_steps INTEGER NOT NULL, horizon_steps INTEGER NOT NULL, completed_step INTEGER,
    ego_first INTEGER NOT NULL, fallbacks INTEGER NOT NULL, error TEXT, learned TEXT,
    PRIMARY KEY (settings_key, mission, family, planner, seed)
) STRICT, WITHOUT ROWID;
CREATE TABLE timings (
    settings_key TEXT NOT NULL, mission TEXT NOT NULL, family TEXT NOT NULL, planner TEXT NOT NULL, seed INTEGER NOT NULL,
    decisions INTEGER NOT NULL, mean_decision_milliseconds REAL, max_decision_milliseconds REAL,
    seconds REAL NOT NULL, traceback TEXT,
    PRIMARY KEY (settings_key, mission, family, planner, seed)
) STRICT, WITHOUT ROWID;
"""


@dataclass(frozen=True)
class StoredSettings:
    key: str
    content: dict[str, Any]
    requested: dict[str, Any]
    rows: int


class Store:
    """The episodes of one folder. Rows of different settings lie side by side under their keys and never mix."""

    def __init__(self, path: Path, connection: sqlite3.Connection) -> None:
        self.path, self._connection = path, connection

    @classmethod
    def create(cls, folder: Path) -> Store:
        """Open the folder's store, made if missing. Raises UserError if that cannot be."""
        try:
            folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise UserError(f"{folder}: cannot be written: {error.strerror}") from None
        path = folder / FILE_NAME
        connection = _connect(path)
        with _clear_errors(path), connection:
            connection.execute("BEGIN IMMEDIATE")
            if not connection.execute("SELECT count(*) FROM sqlite_master").fetchone()[0]:
                for statement in SCHEMA.split(";\n"):
                    connection.execute(statement)
                connection.execute(f"PRAGMA application_id = {APPLICATION_ID}")
                connection.execute(f"PRAGMA user_version = {SCHEMA_VERSION}")
        return cls(path, _verified(path, connection))

    @classmethod
    def open(cls, folder: Path) -> Store:
        """Open an existing store (its folder or the file). Raises UserError if there is none."""
        path = folder / FILE_NAME if folder.is_dir() else folder
        if not path.is_file():
            raise UserError(f"{folder}: no evaluation is stored here (no {FILE_NAME}); run tab-marl evaluate first")
        return cls(path, _verified(path, _connect(path)))

    def close(self) -> None:
        self._connection.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def use(self, key: str, content: Mapping[str, Any], requested: Mapping[str, Any]) -> None:
        """Note that rows of these settings are about to be added, or were asked for again."""
        values = (key, json.dumps(content, sort_keys=True), json.dumps(requested, sort_keys=True))
        with _clear_errors(self.path), self._connection:
            self._connection.execute(
                "INSERT INTO settings VALUES (?, ?, ?, (SELECT coalesce(max(last_used), 0) + 1 FROM settings)) "
                "ON CONFLICT (key) DO UPDATE SET requested = excluded.requested, last_used = excluded.last_used",
                values,
            )

    def add(self, key: str, results: Iterable[tuple[EpisodeRow, Timing]]) -> None:
        """Write these episodes, all or none. An episode already there stays as it is."""
        with _clear_errors(self.path), self._connection:
            for row, timing in results:
                self._connection.execute(
                    f"INSERT OR IGNORE INTO episodes VALUES ({','.join('?' * 18)})",
                    (key, row.mission, row.family, row.planner, row.seed, row.adversary, finite(row.slack),
                     row.intercepted, row.completed, row.failed, row.censored, row.physics_steps, row.horizon_steps,
                     row.completed_step, row.ego_first, row.fallbacks, row.error, row.learned),
                )  # fmt: skip
                self._connection.execute(
                    "INSERT OR IGNORE INTO timings VALUES (?,?,?,?,?,?,?,?,?,?)",
                    (key, row.mission, row.family, row.planner, row.seed, timing.decisions,
                     finite(timing.mean_decision_milliseconds), finite(timing.max_decision_milliseconds),
                     timing.seconds, timing.traceback),
                )  # fmt: skip

    def settings(self) -> list[StoredSettings]:
        """Every setting with rows or a request, the latest first."""
        found = self._connection.execute(
            "SELECT key, content, requested, (SELECT count(*) FROM episodes WHERE settings_key = key) "
            "FROM settings ORDER BY last_used DESC"
        ).fetchall()
        return [StoredSettings(k, json.loads(c), json.loads(r), n) for k, c, r, n in found]

    def keys(self, key: str) -> set[tuple[str, str, str, int]]:
        """(mission, family, planner, seed) of every stored episode."""
        return set(
            self._connection.execute(
                "SELECT mission, family, planner, seed FROM episodes WHERE settings_key = ?", (key,)
            )
        )

    def rows(self, key: str) -> list[EpisodeRow]:
        """Every episode, sorted by mission, family, planner and seed; `learned` is left out, being large."""
        found = self._connection.execute(
            "SELECT mission, family, planner, seed, adversary, slack, intercepted, completed, failed, physics_steps, "
            "horizon_steps, completed_step, ego_first, fallbacks, error FROM episodes WHERE settings_key = ? "
            "ORDER BY mission, family, planner, seed",
            (key,),
        )
        return [
            EpisodeRow(m, f, p, s, a, float("nan") if slack is None else slack, bool(i), bool(c), bool(x), n, h, d, bool(e), b, err)
            for m, f, p, s, a, slack, i, c, x, n, h, d, e, b, err in found
        ]  # fmt: skip

    def timings(self, key: str) -> dict[tuple[str, str, str, int], Timing]:
        """How long each episode took, by (mission, family, planner, seed)."""
        found = self._connection.execute(
            "SELECT mission, family, planner, seed, decisions, mean_decision_milliseconds, max_decision_milliseconds, "
            "seconds, traceback FROM timings WHERE settings_key = ?",
            (key,),
        )
        nan = float("nan")
        return {
            (m, f, p, s): Timing(d, nan if mean is None else mean, nan if top is None else top, seconds, trace)
            for m, f, p, s, d, mean, top, seconds, trace in found
        }

    def learned(self, key: str, mission: str, family: str, planner: str, seed: int) -> str | None:
        """What the planner carried out of this episode; None if nothing, or if the episode is not stored."""
        found = self._connection.execute(
            "SELECT learned FROM episodes WHERE settings_key = ? AND mission = ? AND family = ? AND planner = ? AND seed = ?",
            (key, mission, family, planner, seed),
        ).fetchone()
        return None if found is None else found[0]


def _connect(path: Path) -> sqlite3.Connection:
    with _clear_errors(path):
        return sqlite3.connect(path, timeout=30.0)


def _verified(path: Path, connection: sqlite3.Connection) -> sqlite3.Connection:
    with _clear_errors(path):
        application = connection.execute("PRAGMA application_id").fetchone()[0]
        version = connection.execute("PRAGMA user_version").fetchone()[0]
    if application != APPLICATION_ID:
        with closing(connection):
            raise UserError(f"{path}: not a store of tab-marl episodes; choose another folder with --out")
    if version != SCHEMA_VERSION:
        with closing(connection):
            raise UserError(
                f"{path}: written by another version (store version {version}, this one reads {SCHEMA_VERSION}); "
                "choose another folder with --out"
            )
    return connection


class _clear_errors:
    """Turns SQLite's errors about the file (full disk, no permission, not a database) into one line for the user."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __enter__(self) -> None:
        return None

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: object) -> None:
        if isinstance(error, sqlite3.OperationalError) and "full" in str(error):
            raise UserError(
                f"{self.path}: the disk is full; episodes stored so far are safe, "
                "the same command continues once there is room"
            ) from error
        if isinstance(error, (sqlite3.OperationalError, sqlite3.DatabaseError)) and not isinstance(
            error, (sqlite3.IntegrityError, sqlite3.ProgrammingError)
        ):
            raise UserError(f"{self.path}: cannot be used as a store: {error}") from error
