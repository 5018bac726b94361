"""Who is playing what: runs on one store claim episodes before they play them, so that two runs share the work.

A claim counts while its run lives. Whether it does is seen at once on the same machine (its process is gone), and
elsewhere by its lease, which it moves on while it plays. If a run is taken for dead and is not, an episode is played
twice, with the same outcome, and the first to arrive is kept.
"""

from __future__ import annotations

import hashlib
import json
import os
import sqlite3
import time
import uuid
from collections.abc import Collection, Mapping
from dataclasses import dataclass, field
from datetime import UTC, datetime
from functools import lru_cache
from pathlib import Path
from typing import Any

LEASE_SECONDS = 60.0
BEAT_SECONDS = 10.0
"""How often a run moves its lease on."""

Key = tuple[str, str, str, int]
_WHERE = "settings_key = ? AND mission = ? AND family = ? AND planner = ? AND seed = ?"


@dataclass(frozen=True)
class Claimed:
    """What became of the episodes asked for."""

    granted: list[Key] = field(default_factory=list)
    """Ours to play."""
    stored: list[Key] = field(default_factory=list)
    """Played by somebody meanwhile."""
    held: list[Key] = field(default_factory=list)
    """Being played by another run."""


@dataclass(frozen=True)
class StoredRun:
    """One command's work on a store."""

    run: int
    started: str
    """UTC, ISO 8601."""
    ended: str | None
    """None while it plays, and for ever if it was killed."""
    outcome: str | None
    """finished, interrupted, failed; None as above."""
    played: int
    """Episodes that it added."""
    record: dict[str, Any]
    """`provenance.run_record`: versions, machine, settings, zoo, commit."""


def now() -> str:
    """The time in UTC, to the second."""
    return datetime.now(UTC).isoformat(timespec="seconds")


def begin_run(connection: sqlite3.Connection, key: str, record: Mapping[str, Any]) -> int:
    """Insert a run of this process and drop the claims of dead ones; returns its number."""
    for run, *owner in connection.execute(
        "SELECT run, machine, process, alive_until FROM runs WHERE run IN (SELECT run FROM claims)"
    ).fetchall():
        if not lives(*owner):
            connection.execute("DELETE FROM claims WHERE run = ?", (run,))
    made = connection.execute(
        "INSERT INTO runs (settings_key, started, record, machine, process, alive_until) VALUES (?, ?, ?, ?, ?, ?)",
        (key, now(), json.dumps(record, sort_keys=True), this_machine(), os.getpid(), time.time() + LEASE_SECONDS),
    )
    assert made.lastrowid is not None
    return made.lastrowid


def end_run(connection: sqlite3.Connection, run: int, outcome: str) -> None:
    """Note the end and drop the run's claims."""
    connection.execute("UPDATE runs SET ended = ?, outcome = ?, alive_until = 0 WHERE run = ?", (now(), outcome, run))
    connection.execute("DELETE FROM claims WHERE run = ?", (run,))


def stay_alive(connection: sqlite3.Connection, run: int) -> None:
    """Move the run's lease on."""
    connection.execute("UPDATE runs SET alive_until = ? WHERE run = ?", (time.time() + LEASE_SECONDS, run))


def claim(connection: sqlite3.Connection, key: str, run: int, episodes: Collection[Key]) -> Claimed:
    """Sort the episodes into granted, stored and held, and write the claims to those granted."""
    result = Claimed()
    for episode in episodes:
        where = (key, *episode)
        if connection.execute(f"SELECT 1 FROM episodes WHERE {_WHERE}", where).fetchone():
            result.stored.append(episode)
            continue
        holder = connection.execute(
            "SELECT run, machine, process, alive_until FROM claims JOIN runs USING (run) WHERE "
            + _WHERE.replace("settings_key", "claims.settings_key"),
            where,
        ).fetchone()
        if holder is not None and holder[0] != run and lives(*holder[1:]):
            result.held.append(episode)
            continue
        connection.execute("INSERT OR REPLACE INTO claims VALUES (?, ?, ?, ?, ?, ?)", (*where, run))
        result.granted.append(episode)
    return result


def drop(connection: sqlite3.Connection, key: str, episode: Key) -> None:
    """The episode is stored: nobody needs to hold it."""
    connection.execute(f"DELETE FROM claims WHERE {_WHERE}", (key, *episode))


def runs(connection: sqlite3.Connection, key: str) -> list[StoredRun]:
    """Every run under these settings."""
    found = connection.execute(
        "SELECT run, started, ended, outcome, played, record FROM runs WHERE settings_key = ? ORDER BY run", (key,)
    )
    return [
        StoredRun(n, start, end, outcome, played, json.loads(text)) for n, start, end, outcome, played, text in found
    ]


def lives(machine: str, process: int, alive_until: float) -> bool:
    """Whether a run of that process may still be playing."""
    if time.time() > alive_until:
        return False
    return machine != this_machine() or _process_exists(process)


def _process_exists(process: int) -> bool:
    if os.name != "posix":  # signal 0 would end the process there; its lease tells
        return True
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    except OSError:
        pass  # it is there, and another user's
    return True


@lru_cache(maxsize=1)
def this_machine() -> str:
    """A digest of what makes process numbers comparable: this boot of the machine, and the container. Names nobody."""
    try:
        parts = [Path("/proc/sys/kernel/random/boot_id").read_text(), os.readlink("/proc/self/ns/pid")]
    except OSError:  # not Linux
        parts = [str(uuid.getnode())]
    return hashlib.blake2b("|".join(parts).encode(), digest_size=8).hexdigest()
