"""The store: round trip, refusal of foreign files, separation of settings, and one clear line when the disk says no."""

import math
import sqlite3
import subprocess
import sys
import time

import pytest

from tab_marl.evaluation import store as store_module
from tab_marl.evaluation.errors import UserError
from tab_marl.evaluation.evaluate import failed_episodes
from tab_marl.evaluation.rows import Timing
from tab_marl.evaluation.store import FILE_NAME, MEASURED, Store


@pytest.fixture
def store(tmp_path):
    with Store.create(tmp_path / "out") as store:
        store.use("k", {"seed": 1}, {"episodes": 2})
        yield store


def test_round_trip(store, synthetic):
    rows = [
        synthetic.row(seed=0, slack=1.234567890123),
        synthetic.row(seed=1, intercepted=False, completed=True, fallbacks=3, ego_first=True),
        synthetic.row(seed=2, intercepted=False, slack=math.nan, error="ValueError: boom", adversary=""),
    ]
    store.add("k", [(r, Timing(0, math.nan, math.nan, 1.5, "trace")) for r in rows])
    back = store.rows("k")
    assert [repr(r) for r in back] == [repr(r) for r in rows]  # repr: nan equals nan there
    assert store.timings("k")[rows[0].key].traceback == "trace"


def test_rows_are_visible_to_another_connection_at_once(store, synthetic):
    store.add("k", [(synthetic.row(), synthetic.timing())])
    with Store.open(store.path.parent) as other:
        assert len(other.rows("k")) == 1


def test_a_stored_episode_is_not_overwritten(store, synthetic):
    store.add("k", [(synthetic.row(steps=300), synthetic.timing())])
    store.add("k", [(synthetic.row(steps=999), synthetic.timing())])
    assert [r.physics_steps for r in store.rows("k")] == [300]


def test_a_batch_is_written_whole_or_not_at_all(store, synthetic):
    good, bad = synthetic.row(seed=0), synthetic.row(seed=1, adversary=object())
    with pytest.raises(sqlite3.Error):
        store.add("k", [(good, synthetic.timing()), (bad, synthetic.timing())])
    assert store.rows("k") == []


def test_settings_are_kept_apart(store, synthetic):
    store.use("other", {"seed": 2}, {})
    store.add("other", [(synthetic.row(steps=1), synthetic.timing())])
    store.add("k", [(synthetic.row(steps=2), synthetic.timing())])
    assert [r.physics_steps for r in store.rows("k")] == [2]
    assert [s.key for s in store.settings()] == ["other", "k"]  # the latest first
    store.use("k", {"seed": 1}, {"episodes": 5})
    assert store.settings()[0].key == "k" and store.settings()[0].requested == {"episodes": 5}


def test_learned_state_is_found_by_episode(store, synthetic):
    store.add("k", [(synthetic.row("MLE-POMCP", 4, learned='{"a": 1}'), synthetic.timing())])
    assert store.learned("k", "M1", "point", "MLE-POMCP", 4) == '{"a": 1}'
    assert store.learned("k", "M1", "point", "MLE-POMCP", 3) is None


def test_a_file_that_is_not_a_store(tmp_path):
    (tmp_path / FILE_NAME).write_text("hello, this is not a database, but it is long enough to be looked at as one")
    with pytest.raises(UserError, match="not a database"):
        Store.create(tmp_path)


def test_a_database_of_another_program(tmp_path):
    with sqlite3.connect(tmp_path / FILE_NAME) as other:
        other.execute("CREATE TABLE t (x)")
    with pytest.raises(UserError, match="not a store of tab-marl episodes"):
        Store.create(tmp_path)


def test_a_store_of_another_version(store):
    store._connection.execute("PRAGMA user_version = 99")
    with pytest.raises(UserError, match="store version 99"):
        Store.open(store.path.parent)


def test_nothing_stored(tmp_path):
    with pytest.raises(UserError, match="run tab-marl evaluate first"):
        Store.open(tmp_path)


def test_a_folder_that_cannot_be_made(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(UserError, match="cannot be written"):
        Store.create(tmp_path / "file" / "out")


def test_disk_full_is_one_clear_line_and_loses_nothing(store, synthetic):
    store.add("k", [(synthetic.row(seed=0), synthetic.timing())])
    pages = store._connection.execute("PRAGMA page_count").fetchone()[0]
    store._connection.execute(f"PRAGMA max_page_count = {pages}")  # the database may not grow: SQLITE_FULL
    with pytest.raises(UserError, match=r"disk is full.*same command continues"):
        store.add("k", [(synthetic.row(seed=s, error="x" * 500), synthetic.timing()) for s in range(1, 200)])
    assert [r.seed for r in store.rows("k")] == [0]
    store._connection.execute("PRAGMA max_page_count = 100000")
    store.add("k", [(synthetic.row(seed=1), synthetic.timing())])
    assert [r.seed for r in store.rows("k")] == [0, 1]


def downgraded(store):
    """The same file as version 1 wrote it."""
    for column in (
        "run",
        *(name for name in MEASURED if name.endswith("processor_seconds") or name == "processor_seconds"),
    ):
        store._connection.execute(f"ALTER TABLE timings DROP COLUMN {column}")
    for table in ("claims", "runs"):
        store._connection.execute(f"DROP TABLE {table}")
    store._connection.execute("PRAGMA user_version = 1")
    store._connection.commit()
    store.close()


def test_a_store_of_version_1_is_brought_up_to_date(store, synthetic):
    store.add("k", [(synthetic.row(seed=3), synthetic.timing())])
    before = store.rows("k")
    downgraded(store)
    with Store.open(store.path.parent) as again:
        assert again.rows("k") == before
        assert math.isnan(again.timings("k")[before[0].key].processor_seconds)
        assert again.runs("k") == []
        assert again.add("k", [(synthetic.row(seed=4), synthetic.timing())], again.begin_run("k", {})) == 1


def test_measured_times_come_back(store, synthetic):
    spent = Timing(7, 1.5, 2.5, 3.5, "text", 4.5, 0.5, 0.25, 4.25, 0.125)
    store.add("k", [(synthetic.row(), spent)])
    assert store.timings("k")[synthetic.row().key] == spent


def test_a_store_that_cannot_be_written_can_be_read(store, synthetic, monkeypatch):
    store.add("k", [(synthetic.row(), synthetic.timing())])
    store.close()
    monkeypatch.setattr(store_module.os, "access", lambda *_: False)  # the tests may run as root, who may do anything
    with Store.open(store.path.parent) as reader:
        assert len(reader.rows("k")) == 1
        with pytest.raises(UserError, match="readonly"):
            reader.use("k", {}, {})


ONE, TWO = ("M1", "point", "TAB-POMCP", 0), ("M1", "point", "TAB-POMCP", 1)


def test_claims_of_living_runs_hold_and_end_with_the_episode(store, synthetic):
    mine, other = store.begin_run("k", {}), store.begin_run("k", {})
    assert store.claim("k", mine, [ONE]).granted == [ONE]
    assert store.claim("k", mine, [ONE]).granted == [ONE], "a run may ask twice"
    got = store.claim("k", other, [ONE, TWO])
    assert (got.held, got.granted) == ([ONE], [TWO])
    assert store.add("k", [(synthetic.row(seed=0), synthetic.timing())], mine) == 1
    assert store.claim("k", other, [ONE]).stored == [ONE]
    assert store.claim("another", other, [ONE]).granted == [ONE], "of other settings nothing is held"
    store.end_run(other, "interrupted")
    assert store.claim("k", mine, [TWO]).granted == [TWO], "a run that ended holds nothing"


def ended_process():
    process = subprocess.Popen([sys.executable, "-c", ""])
    process.wait()
    return process.pid


def test_claims_of_the_dead_are_taken_over(store, synthetic):
    dead = store.begin_run("k", {})
    store.claim("k", dead, [ONE, TWO])
    store._connection.execute("UPDATE runs SET process = ? WHERE run = ?", (ended_process(), dead))
    store._connection.commit()
    mine = store.begin_run("k", {})
    assert store.claim("k", mine, [ONE]).granted == [ONE]
    # Were it not dead after all: the same episode arrives twice, and the first row stays.
    assert store.add("k", [(synthetic.row(seed=0, steps=300), synthetic.timing())], mine) == 1
    assert store.add("k", [(synthetic.row(seed=0, steps=999), synthetic.timing())], dead) == 0
    assert [r.physics_steps for r in store.rows("k")] == [300]
    assert [r.played for r in store.runs("k")] == [0, 1]


def test_a_run_elsewhere_lives_as_long_as_its_lease(store):
    there = store.begin_run("k", {})
    store.claim("k", there, [ONE])
    store._connection.execute(
        "UPDATE runs SET machine = 'another', process = ? WHERE run = ?", (ended_process(), there)
    )
    store._connection.commit()
    mine = store.begin_run("k", {})
    assert store.claim("k", mine, [ONE]).held == [ONE], "its process cannot be asked for from here"
    store._connection.execute("UPDATE runs SET alive_until = ? WHERE run = ?", (time.time() - 1, there))
    store._connection.commit()
    assert store.claim("k", mine, [ONE]).granted == [ONE]
    store.stay_alive(there)
    assert store._connection.execute("SELECT alive_until FROM runs WHERE run = ?", (there,)).fetchone()[0] > time.time()


def test_forgotten_episodes_can_be_played_again(store, synthetic):
    store.add("k", [(synthetic.row(seed=s), synthetic.timing()) for s in (0, 1)])
    store.forget("k", [ONE])
    assert store.keys("k") == {TWO} == set(store.timings("k"))


def test_failed_episodes_and_what_learned_from_them(store, synthetic):
    failed = [("S-POMCP", 1), ("MLE-POMCP", 1)]
    for planner in ("S-POMCP", "MLE-POMCP"):
        for seed in range(3):
            error = "ValueError: x" if (planner, seed) in failed else None
            store.add("k", [(synthetic.row(planner, seed, error=error), synthetic.timing())])
    found = {(k[2], k[3]) for k in failed_episodes(store, "k")}
    assert found == {("S-POMCP", 1), ("MLE-POMCP", 1), ("MLE-POMCP", 2)}
