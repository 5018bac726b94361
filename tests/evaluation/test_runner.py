"""Same rows whatever the workers, the interruptions and the order of things."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from tab_marl.evaluation import runner
from tab_marl.evaluation.engines.local import LocalEngine
from tab_marl.evaluation.errors import UserError
from tab_marl.evaluation.runner import Watch, run
from tab_marl.evaluation.settings import EvaluationSettings
from tab_marl.evaluation.store import Store

SETTINGS = {
    "missions": ("M1", "M4"),
    "families": ("point", "ambiguous"),
    "planners": ("S-POMCP", "MLE-POMCP", "TAB-POMCP"),
    "episodes": 4,
    "seed": 7,
}


def played(folder, play, **changes):
    """(rows, what was learned, results as they came, notes); in this process, or in `workers` others."""
    import synthetic_rows

    workers = changes.pop("workers", 0)
    settings = EvaluationSettings(**(SETTINGS | changes))
    with Store.create(folder) as store:
        store.use("k", {}, {})
        seen, notes = [], []
        run_id = store.begin_run("k", {})
        engine = LocalEngine(play, workers) if workers else synthetic_rows.Inline(play)
        run(settings, ("a", "b", "c"), store, "k", engine, run_id, Watch(seen.extend, on_note=notes.append))
        store.end_run(run_id, "finished")
        learned = {r: store.learned("k", *r) for r in sorted(store.keys("k"))}
        return store.rows("k"), learned, seen, notes


def test_one_worker_or_three_and_in_pieces(tmp_path, synthetic):
    one = played(tmp_path / "one", synthetic.play)
    three = played(tmp_path / "three", synthetic.play, workers=3)
    assert len(one[0]) == 2 * 2 * 3 * 4 == len(one[2])
    assert one[:2] == three[:2]
    assert {r.adversary for r in one[0]} == {"a", "b", "c"}
    assert len({v for v in one[1].values() if v}) == 16, "every link of every chain learns something else"

    played(tmp_path / "pieces", synthetic.play, episodes=2, planners=("TAB-POMCP", "MLE-POMCP"))
    played(tmp_path / "pieces", synthetic.play, episodes=3, missions=("M4",))
    rows, learned, new, _ = played(tmp_path / "pieces", synthetic.play, workers=2)
    assert (rows, learned) == one[:2]
    assert len(new) < 48
    assert played(tmp_path / "pieces", synthetic.play)[2] == [], "nothing is played twice"


def test_units_are_the_same_for_every_planner(tmp_path, synthetic):
    rows, *_ = played(tmp_path / "a", synthetic.play)
    units = {}
    for r in rows:
        units.setdefault((r.mission, r.family, r.seed), set()).add((r.adversary, r.slack))
    assert all(len(values) == 1 for values in units.values())
    other, *_ = played(tmp_path / "b", synthetic.play, seed=8)
    assert [r.slack for r in other] != [r.slack for r in rows]


def test_an_episode_that_costs_its_worker_is_tried_again_then_recorded(tmp_path, synthetic, monkeypatch):
    monkeypatch.setenv("SYNTHETIC_MARKER", str(tmp_path / "died once"))
    rows, learned, _, notes = played(tmp_path / "a", synthetic.play_and_break, workers=2)
    good, good_learned, *_ = played(tmp_path / "b", synthetic.play)
    assert [r.key for r in rows] == [r.key for r in good], "nothing is dropped"
    failed = {r.key: r for r in rows if r.error is not None}
    assert set(failed) == {("M4", family, "TAB-POMCP", 3) for family in ("point", "ambiguous")}
    for row in failed.values():
        assert "lost 3 times, the last one killed by signal 9" in row.error
        assert row.horizon_steps > 0 and not row.intercepted
    # Everything else, what shared a worker with it and the chain that lost one included, is as if nothing had happened.
    assert [r for r in rows if r.key not in failed] == [r for r in good if r.key not in failed]
    assert learned == good_learned
    assert len(notes) == 2 * 3 + 1 and sum("recorded as failed" in note for note in notes) == 2


def test_a_machine_on_which_every_worker_dies_is_one_clear_line(tmp_path, synthetic, monkeypatch):
    monkeypatch.setattr(runner, "MOST_LOSSES_IN_A_ROW", 5)
    with pytest.raises(UserError, match=r"5 workers were lost .* killed by signal 9.*same command continues"):
        played(tmp_path, synthetic.play_and_always_break, workers=1)
    with Store.open(tmp_path) as store:
        assert store.rows("k") == [], "no episode is blamed for it"


def test_two_runs_on_one_store_share_the_work(tmp_path, whole):
    log = tmp_path / "log"
    both = [_start(tmp_path / "shared", 8, 1, "play_noting", log, players=2) for _ in range(2)]
    for process in both:
        said = process.communicate(timeout=200)
        assert process.returncode == 0, said
    lines = log.read_text().splitlines()
    episodes = [line.rsplit(" ", 1)[0] for line in lines]
    assert len(episodes) == len(set(episodes)) == 48, "nothing is played twice"
    assert len({line.rsplit(" ", 1)[1] for line in lines}) == 2, "both have played"
    assert _content(tmp_path / "shared") == whole
    with Store.open(tmp_path / "shared") as store:
        runs = store.runs(store.settings()[0].key)
    assert [r.outcome for r in runs] == ["finished", "finished"] and sum(r.played for r in runs) == 48


def test_killed_again_and_again(tmp_path, whole):
    log = tmp_path / "log"
    kills = (signal.SIGKILL, signal.SIGINT, signal.SIGKILL)
    for number, how in enumerate(kills):
        process = _start(tmp_path / "killed", 8, 2, "play_noting", log)
        wanted = _lines(log) + 1 + 3 * number
        deadline = time.monotonic() + 120
        while _lines(log) < wanted and time.monotonic() < deadline:
            time.sleep(0.002)
        os.kill(process.pid, how)  # the parent alone
        process.communicate(timeout=30)
        assert process.returncode != 0
        assert _group_is_gone(process.pid), "workers outlive their parent"
    assert _start(tmp_path / "killed", 8, 2, "play_noting", log).wait(120) == 0
    assert _content(tmp_path / "killed") == whole and len(whole[0]) == 48
    with Store.open(tmp_path / "killed") as store:
        assert store._connection.execute("PRAGMA integrity_check").fetchone() == ("ok",)
        assert store._connection.execute("SELECT count(*) FROM claims").fetchone() == (0,)
        runs = store.runs(store.settings()[0].key)
    assert [r.outcome for r in runs] == [None, None, None, "finished"] and sum(r.played for r in runs) == 48
    assert _lines(log) - 48 <= 12, "played twice: at most what two workers had in hand, a job of two planners each"


@pytest.fixture
def whole(tmp_path, synthetic):
    """The rows and what was learned, had nobody disturbed anything."""
    synthetic.evaluate_with(tmp_path / "whole", 8, synthetic.Inline(synthetic.play))
    return _content(tmp_path / "whole")


def _content(folder):
    with Store.open(folder) as store:
        key = store.settings()[0].key
        return store.rows(key), {k: store.learned(key, *k) for k in sorted(store.keys(key))}


def _lines(path):
    return len(path.read_text().splitlines()) if path.exists() else 0


def _start(folder, episodes, workers, play="play_slowly", log="", players=1):
    here = Path(__file__).parent
    return subprocess.Popen(
        [sys.executable, here / "synthetic_rows.py", str(folder), str(episodes), str(workers), play],
        env=os.environ | {"PYTHONPATH": str(here), "SYNTHETIC_MARKER": str(log), "SYNTHETIC_PLAYERS": str(players)},
        stderr=subprocess.PIPE,
        start_new_session=True,
        text=True,
    )


def _group_is_gone(group):
    for _ in range(200):
        try:
            os.killpg(group, 0)
        except ProcessLookupError:
            return True
        time.sleep(0.05)
    return False
