"""Rows in one SQLite file: transactional, so a kill at any moment loses at most the episodes that were being played.

Write-ahead logging lets any number of processes read while one writes, and lets runs on one store take turns writing.
"""

from __future__ import annotations

import json
import os
import sqlite3
import time
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self
from urllib.parse import quote

from tab_marl.evaluation import claims
from tab_marl.evaluation.claims import Claimed, StoredRun
from tab_marl.evaluation.errors import UserError
from tab_marl.evaluation.rows import EpisodeRow, Timing, finite
from tab_marl.evaluation.store_schema import SCHEMA_VERSION, is_ours, lay_out, version

FILE_NAME = "episodes.sqlite"
BUSY_SECONDS = 60.0
"""How long to wait for another process's write; each takes milliseconds."""

Key = tuple[str, str, str, int]
"""(mission, family, planner, seed)."""

MEASURED = (
    "decisions", "mean_decision_milliseconds", "max_decision_milliseconds", "seconds", "traceback", "processor_seconds",
    "preparation_processor_seconds", "decision_processor_seconds", "planner_processor_seconds",
    "simulation_processor_seconds",
)  # fmt: skip
"""Columns of `timings`, named as the fields of Timing."""


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
        with _clear_errors(path):
            with connection:
                lay_out(connection)
            _log_ahead(connection)
        return cls(path, _verified(path, connection))

    @classmethod
    def open(cls, folder: Path) -> Store:
        """Open an existing store (its folder or the file), also on a medium that cannot be written.

        Raises UserError if there is none.
        """
        path = folder / FILE_NAME if folder.is_dir() else folder
        if not path.is_file():
            raise UserError(f"{folder}: no evaluation is stored here (no {FILE_NAME}); run tab-marl evaluate first")
        if not (os.access(path.parent, os.W_OK) and os.access(path, os.W_OK)):
            return cls(path, _verified(path, _connect(path, read_only=True)))
        connection = _connect(path)
        with _clear_errors(path):
            if is_ours(connection) and version(connection) < SCHEMA_VERSION:
                with connection:
                    lay_out(connection)
        return cls(path, _verified(path, connection))

    def close(self) -> None:
        self._connection.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def use(self, key: str, content: Mapping[str, Any], requested: Mapping[str, Any]) -> None:
        """Note that rows of these settings are about to be added, or were asked for again."""
        values = (key, json.dumps(content, sort_keys=True), json.dumps(requested, sort_keys=True))
        with self._writing():
            self._connection.execute(
                "INSERT INTO settings VALUES (?, ?, ?, (SELECT coalesce(max(last_used), 0) + 1 FROM settings)) "
                "ON CONFLICT (key) DO UPDATE SET requested = excluded.requested, last_used = excluded.last_used",
                values,
            )

    def add(self, key: str, results: Iterable[tuple[EpisodeRow, Timing]], run: int | None = None) -> int:
        """Write these episodes, all or none, and give up the run's claims to them; returns how many were new.

        An episode already there stays as it is.
        """
        added = 0
        with self._writing():
            for row, timing in results:
                added += self._connection.execute(
                    f"INSERT OR IGNORE INTO episodes VALUES ({','.join('?' * 18)})",
                    (key, row.mission, row.family, row.planner, row.seed, row.adversary, finite(row.slack),
                     row.intercepted, row.completed, row.failed, row.censored, row.physics_steps, row.horizon_steps,
                     row.completed_step, row.ego_first, row.fallbacks, row.error, row.learned),
                ).rowcount  # fmt: skip
                measured = [getattr(timing, name) for name in MEASURED]
                self._connection.execute(
                    "INSERT OR IGNORE INTO timings (settings_key, mission, family, planner, seed, run, "
                    f"{', '.join(MEASURED)}) VALUES ({','.join('?' * (6 + len(MEASURED)))})",
                    (key, *row.key, run, *(finite(m) if isinstance(m, float) else m for m in measured)),
                )
                claims.drop(self._connection, key, row.key)
            if run is not None:
                self._connection.execute("UPDATE runs SET played = played + ? WHERE run = ?", (added, run))
        return added

    def forget(self, key: str, episodes: Collection[Key]) -> None:
        """Take these episodes out, to be played again."""
        with self._writing():
            for table in ("episodes", "timings"):
                self._connection.executemany(
                    f"DELETE FROM {table} WHERE settings_key = ? AND mission = ? AND family = ? AND planner = ? "
                    "AND seed = ?",
                    [(key, *episode) for episode in episodes],
                )

    def begin_run(self, key: str, record: Mapping[str, Any]) -> int:
        """Note the start of a run under these settings; returns its number in this store."""
        with self._writing():
            return claims.begin_run(self._connection, key, record)

    def end_run(self, run: int, outcome: str) -> None:
        """Note how a run ended ("finished", "interrupted" or "failed") and give up its claims."""
        with self._writing():
            claims.end_run(self._connection, run, outcome)

    def stay_alive(self, run: int) -> None:
        """Say that the run still plays; its claims count for `claims.LEASE_SECONDS` from now."""
        with self._writing():
            claims.stay_alive(self._connection, run)

    def claim(self, key: str, run: int, episodes: Collection[Key]) -> Claimed:
        """Take what nobody has played and no living run is playing, in one transaction."""
        with self._writing():
            return claims.claim(self._connection, key, run, episodes)

    def runs(self, key: str) -> list[StoredRun]:
        """Every run under these settings, in the order of their starts."""
        return claims.runs(self._connection, key)

    def settings(self) -> list[StoredSettings]:
        """Every setting with rows or a request, the latest first."""
        found = self._connection.execute(
            "SELECT key, content, requested, (SELECT count(*) FROM episodes WHERE settings_key = key) "
            "FROM settings ORDER BY last_used DESC"
        ).fetchall()
        return [StoredSettings(k, json.loads(c), json.loads(r), n) for k, c, r, n in found]

    def keys(self, key: str) -> set[Key]:
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

    def timings(self, key: str) -> dict[Key, Timing]:
        """How long each episode took, by (mission, family, planner, seed)."""
        found = self._connection.execute(
            f"SELECT mission, family, planner, seed, {', '.join(MEASURED)} FROM timings WHERE settings_key = ?", (key,)
        )
        return {(m, f, p, s): _timing(values) for m, f, p, s, *values in found}

    def learned(self, key: str, mission: str, family: str, planner: str, seed: int) -> str | None:
        """What the planner carried out of this episode; None if nothing, or if the episode is not stored."""
        found = self._connection.execute(
            "SELECT learned FROM episodes WHERE settings_key = ? AND mission = ? AND family = ? AND planner = ? AND seed = ?",
            (key, mission, family, planner, seed),
        ).fetchone()
        return None if found is None else found[0]

    @contextmanager
    def _writing(self) -> Iterator[None]:
        """One transaction that holds the write lock from its start: nothing can change between what it reads and writes."""
        with _clear_errors(self.path), self._connection:
            self._connection.execute("BEGIN IMMEDIATE")
            yield


def _timing(values: Sequence[Any]) -> Timing:
    """From the columns `MEASURED`; what was not measured is nan there (SQLite has no nan)."""
    known = dict(zip(MEASURED, values, strict=True))
    filled: dict[str, Any] = {k: float("nan") if v is None and k != "traceback" else v for k, v in known.items()}
    return Timing(**filled)


def _connect(path: Path, read_only: bool = False) -> sqlite3.Connection:
    with _clear_errors(path):
        if read_only:
            # Not even the log's shared memory can be made there; nobody can write the file either.
            return sqlite3.connect(f"file:{quote(str(path.resolve()))}?immutable=1", uri=True)
        return sqlite3.connect(path, timeout=BUSY_SECONDS)


def _log_ahead(connection: sqlite3.Connection) -> None:
    """Write-ahead log; NORMAL loses nothing to a killed process, and to a power cut at most the last episodes."""

    def switch() -> None:
        connection.execute("PRAGMA journal_mode = WAL").fetchone()

    _patiently(switch)
    connection.execute("PRAGMA synchronous = NORMAL")


def _patiently(switch: Callable[[], None]) -> None:
    """SQLite does not wait for its lock while it changes the journal, and two runs may start in the same moment."""
    deadline = time.monotonic() + BUSY_SECONDS
    while True:
        try:
            return switch()
        except sqlite3.OperationalError as error:
            if "locked" not in str(error) or time.monotonic() > deadline:
                raise
            time.sleep(0.05)


def _verified(path: Path, connection: sqlite3.Connection) -> sqlite3.Connection:
    with _clear_errors(path):
        ours, found = is_ours(connection), version(connection)
    if not ours:
        with closing(connection):
            raise UserError(f"{path}: not a store of tab-marl episodes; choose another folder with --out")
    if found != SCHEMA_VERSION:
        with closing(connection):
            remedy = (
                "copy it to where it can be written, to bring it up to date"
                if found < SCHEMA_VERSION
                else "choose another folder with --out"
            )
            raise UserError(
                f"{path}: written by another version (store version {found}, this one reads {SCHEMA_VERSION}); {remedy}"
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
