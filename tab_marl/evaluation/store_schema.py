"""The store's tables, and how a store of an earlier version is brought up to date."""

from __future__ import annotations

import sqlite3

SCHEMA_VERSION = 2
APPLICATION_ID = 0x7AB3A21

EPISODES = """
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
) STRICT, WITHOUT ROWID
"""

# Since version 2. A claim says that a run is playing an episode; it counts while that run lives.
RUNS = """
CREATE TABLE runs (
    run INTEGER PRIMARY KEY,        -- counts up
    settings_key TEXT NOT NULL REFERENCES settings (key),
    started TEXT NOT NULL,          -- UTC, ISO 8601
    ended TEXT,                     -- NULL while it plays, and for ever if it was killed
    outcome TEXT,                   -- finished, interrupted or failed; NULL as above
    played INTEGER NOT NULL DEFAULT 0,  -- episodes that it added
    record TEXT NOT NULL,           -- JSON: versions, machine, settings, zoo, commit
    machine TEXT NOT NULL, process INTEGER NOT NULL,  -- who it is, to tell whether it lives; a digest, not a name
    alive_until REAL NOT NULL       -- seconds since 1970; moved on while it plays
) STRICT;
CREATE TABLE claims (
    settings_key TEXT NOT NULL, mission TEXT NOT NULL, family TEXT NOT NULL, planner TEXT NOT NULL, seed INTEGER NOT NULL,
    run INTEGER NOT NULL REFERENCES runs (run),
    PRIMARY KEY (settings_key, mission, family, planner, seed)
) STRICT, WITHOUT ROWID;
ALTER TABLE timings ADD COLUMN run INTEGER;
ALTER TABLE timings ADD COLUMN processor_seconds REAL;
ALTER TABLE timings ADD COLUMN preparation_processor_seconds REAL;
ALTER TABLE timings ADD COLUMN decision_processor_seconds REAL;
ALTER TABLE timings ADD COLUMN planner_processor_seconds REAL;
ALTER TABLE timings ADD COLUMN simulation_processor_seconds REAL
"""


def lay_out(connection: sqlite3.Connection) -> None:
    """Make the tables in an empty file, or add what version 1 lacked. Inside one transaction: all or nothing."""
    connection.execute("BEGIN IMMEDIATE")
    if not connection.execute("SELECT count(*) FROM sqlite_master").fetchone()[0]:
        _execute(connection, EPISODES)
        connection.execute(f"PRAGMA application_id = {APPLICATION_ID}")
        connection.execute("PRAGMA user_version = 1")
    if is_ours(connection) and version(connection) == 1:
        _execute(connection, RUNS)
        connection.execute(f"PRAGMA user_version = {SCHEMA_VERSION}")


def version(connection: sqlite3.Connection) -> int:
    """The version of the tables in this file."""
    return int(connection.execute("PRAGMA user_version").fetchone()[0])


def is_ours(connection: sqlite3.Connection) -> bool:
    """Whether this file is a store of episodes, and no other program's database."""
    return bool(connection.execute("PRAGMA application_id").fetchone()[0] == APPLICATION_ID)


def _execute(connection: sqlite3.Connection, statements: str) -> None:
    for statement in statements.split(";\n"):
        connection.execute(statement)
