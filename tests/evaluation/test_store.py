"""The store: round trip, refusal of foreign files, separation of settings, and one clear line when the disk says no."""

import math
import sqlite3

import pytest

from tab_marl.evaluation.errors import UserError
from tab_marl.evaluation.rows import Timing
from tab_marl.evaluation.store import FILE_NAME, Store


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
