"""Same rows whatever the workers, the interruptions and the order of things."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from tab_marl.evaluation.errors import UserError
from tab_marl.evaluation.runner import run
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
    settings = EvaluationSettings(**(SETTINGS | changes))
    with Store.create(folder) as store:
        store.use("k", {}, {})
        seen = []
        run(settings, ("a", "b", "c"), store, "k", play, seen.extend)
        learned = {r: store.learned("k", *r) for r in sorted(store.keys("k"))}
        return store.rows("k"), learned, seen


def test_one_worker_or_three_and_in_pieces(tmp_path, synthetic):
    one = played(tmp_path / "one", synthetic.play, workers=1)
    three = played(tmp_path / "three", synthetic.play, workers=3)
    assert len(one[0]) == 2 * 2 * 3 * 4 == len(one[2])
    assert one[:2] == three[:2]
    assert {r.adversary for r in one[0]} == {"a", "b", "c"}
    assert len({v for v in one[1].values() if v}) == 16, "every link of every chain learns something else"

    played(tmp_path / "pieces", synthetic.play, workers=1, episodes=2, planners=("TAB-POMCP", "MLE-POMCP"))
    played(tmp_path / "pieces", synthetic.play, workers=1, episodes=3, missions=("M4",))
    rows, learned, new = played(tmp_path / "pieces", synthetic.play, workers=2)
    assert (rows, learned) == one[:2]
    assert len(new) < 48
    assert played(tmp_path / "pieces", synthetic.play)[2] == [], "nothing is played twice"


def test_units_are_the_same_for_every_planner(tmp_path, synthetic):
    rows, _, _ = played(tmp_path / "a", synthetic.play, workers=1)
    units = {}
    for r in rows:
        units.setdefault((r.mission, r.family, r.seed), set()).add((r.adversary, r.slack))
    assert all(len(values) == 1 for values in units.values())
    other, _, _ = played(tmp_path / "b", synthetic.play, workers=1, seed=8)
    assert [r.slack for r in other] != [r.slack for r in rows]


def test_a_worker_that_dies_is_one_clear_line(tmp_path, synthetic):
    with pytest.raises(UserError, match="worker process died"):
        played(tmp_path, synthetic.play_and_break, workers=1)
    with Store.open(tmp_path) as store:
        assert {r.seed for r in store.rows("k")} == {0, 1, 2}


def _start(folder, episodes, workers):
    here = Path(__file__).parent
    return subprocess.Popen(
        [sys.executable, here / "synthetic_rows.py", str(folder), str(episodes), str(workers)],
        env=os.environ | {"PYTHONPATH": str(here)},
        stderr=subprocess.PIPE,
        start_new_session=True,
        text=True,
    )


def _wait_for_rows(folder, count):
    deadline = time.monotonic() + 60
    while time.monotonic() < deadline:
        try:
            with Store.open(folder) as store:
                key = store.settings()[0].key if store.settings() else ""
                if len(store.keys(key)) >= count:
                    return key
        except UserError:
            pass
        time.sleep(0.02)
    raise AssertionError("no rows in a minute")


def _group_is_gone(group):
    for _ in range(200):
        try:
            os.killpg(group, 0)
        except ProcessLookupError:
            return True
        time.sleep(0.05)
    return False


@pytest.mark.parametrize("how", [signal.SIGKILL, signal.SIGINT])
def test_killed_and_continued(tmp_path, how):
    process = _start(tmp_path / "killed", 12, 2)
    key = _wait_for_rows(tmp_path / "killed", 10)
    os.kill(process.pid, how)  # the parent alone: the workers must notice by themselves
    process.communicate(timeout=30)
    assert process.returncode != 0
    assert _group_is_gone(process.pid), "workers outlive their parent"
    with Store.open(tmp_path / "killed") as store:
        part = len(store.rows(key))
    assert 10 <= part < 2 * 3 * 12

    assert _start(tmp_path / "killed", 12, 2).wait(60) == 0
    assert _start(tmp_path / "whole", 12, 1).wait(60) == 0
    with Store.open(tmp_path / "killed") as killed, Store.open(tmp_path / "whole") as whole:
        assert killed.rows(key) == whole.rows(key)
        assert len(whole.rows(key)) == 72
        for row in whole.keys(key):
            assert killed.learned(key, *row) == whole.learned(key, *row)
